"""Random model files, to test readers of them."""
