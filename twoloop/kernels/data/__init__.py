"""Arrays and numbers that all kernels share."""
