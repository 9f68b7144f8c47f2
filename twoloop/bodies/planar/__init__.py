"""Build planar models."""
