"""The equations of a mechanism in the forms that other solvers take."""
