"""Build spatial models and evaluate their compiled callbacks."""
