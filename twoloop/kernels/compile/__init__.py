"""Callbacks and kernels compiled and kept on disk: all that touches private parts of numba."""

from twoloop.kernels.compile import versions  # noqa: F401 - before anything is used that another version may lack
