"""Evaluation of a state: constraints, partition, inner loop, accelerations, and the projection onto the constraints."""
