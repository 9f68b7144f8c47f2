"""The arrays and numbers that all kernels share."""
