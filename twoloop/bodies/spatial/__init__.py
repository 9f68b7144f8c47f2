"""Build spatial models."""
