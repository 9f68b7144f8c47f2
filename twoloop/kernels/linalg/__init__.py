"""Matrices: dense, banded, sparse; factors and solutions in place."""
