"""Linear algebra of dense, banded and sparse matrices: factors and solutions, computed in place."""
