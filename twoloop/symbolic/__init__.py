"""Mechanisms from SymPy expressions: energies or matrices become a compiled `ConstrainedSystem`. Extra `symbolic`."""

try:
    import sympy
except ImportError as error:
    raise ImportError(
        "twoloop.symbolic needs SymPy: pip install sympy, or this project with its extra: pip install '.[symbolic]'"
    ) from error

from twoloop.symbolic.mechanism import SymbolicMechanism, from_lagrangian, from_matrices, from_method

del sympy

__all__ = ["SymbolicMechanism", "from_lagrangian", "from_matrices", "from_method"]
