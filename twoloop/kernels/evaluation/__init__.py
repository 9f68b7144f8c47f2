"""One evaluation: constraints, partition, inner loop, accelerations, and the way back to the constraints."""
