"""Equations of a mechanism in the forms required by other solvers."""
