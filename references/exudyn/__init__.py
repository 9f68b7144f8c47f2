"""Exudyn: models of its own."""
