"""Arrays, indices and types that all kernels share."""
