"""Exudyn models and their runs."""
