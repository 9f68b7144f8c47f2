"""Mechanisms from SymPy: what a chain of n links costs to derive, to compile, to start again and to evaluate."""

from studies.symbolic_size.study import main as main
