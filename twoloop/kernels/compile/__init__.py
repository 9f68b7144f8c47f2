"""Callbacks and kernels compiled and kept on disk: all that touches private parts of numba."""
