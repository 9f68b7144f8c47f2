"""Build planar models and evaluate their compiled callbacks."""
