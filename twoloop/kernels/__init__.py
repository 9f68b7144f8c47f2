"""Kernels: the compiled numerics of a run, and the compiler that builds and caches them."""
