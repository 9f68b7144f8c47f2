"""Two-loop state-space integration of constrained mechanical systems, M q'' + C_q^T lam = Q, C(q, t) = 0.

The names are imported when the first of them is asked for, so that `twoloop.testing` does without numba and SciPy.
"""

from importlib import import_module
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from twoloop.exported import *  # noqa: F403
# ruff: noqa: F405, a test compares the names below with those of `exported`

__version__ = "0.1.0"

__all__ = [
    "BDF",
    "DOP853",
    "ESDIRK",
    "Certificate",
    "CertificateWarning",
    "ConsistentState",
    "ConstrainedSystem",
    "ConstraintWarning",
    "Drawing",
    "Integrator",
    "Joint",
    "Newmark",
    "Result",
    "RungeKutta",
    "Runs",
    "Statistics",
    "Status",
    "Stop",
    "Taylor",
    "callback",
    "citation",
    "consistent_state",
    "consistent_states",
    "ensemble",
    "load",
    "paper_irk",
    "paper_newmark",
    "solve_dae",
    "solve_with_friction",
    "solve_with_stops",
    "sweep",
]


def __getattr__(name: str) -> Any:
    if name in __all__:
        exported = import_module("twoloop.exported")
        globals().update({each: getattr(exported, each) for each in __all__})
        return globals()[name]
    if not name.startswith("_") and find_spec(f"twoloop.{name}") is not None:
        return import_module(f"twoloop.{name}")
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
