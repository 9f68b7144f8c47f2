"""Mechanisms from SymPy expressions: energies or matrices become a compiled `ConstrainedSystem`. Extra `symbolic`."""

try:
    import sympy
except ImportError as error:
    raise ImportError(
        "twoloop.symbolic needs SymPy: pip install sympy, or this project with its extra: pip install '.[symbolic]'"
    ) from error

from twoloop.symbolic.lagrange import from_lagrangian
from twoloop.symbolic.matrices import from_matrices
from twoloop.symbolic.mechanics import from_method
from twoloop.symbolic.mechanism import SymbolicMechanism

del sympy

__all__ = ["SymbolicMechanism", "from_lagrangian", "from_matrices", "from_method"]
