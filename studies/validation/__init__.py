"""Mechanisms that others published: which solver is right, to how many digits, on which of them."""

from studies.validation.study import main as main
