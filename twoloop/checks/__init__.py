"""Checks before and during a run: arguments, bounds of arrays, starts, derivatives."""
