"""Two-loop state-space integration of constrained mechanical systems, M q'' + C_q^T lam = Q, C(q, t) = 0.

A name is imported at its first use: `twoloop.testing` does without numba and SciPy, and `callback` without solvers.
"""

from importlib import import_module
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from twoloop.checks.consistency import ConstraintWarning
    from twoloop.ensembles.consistent_states import consistent_states
    from twoloop.ensembles.ensemble import Runs, ensemble
    from twoloop.ensembles.integrator import Integrator
    from twoloop.impacts.motion import solve_with_friction, solve_with_stops
    from twoloop.kernels.compile.callbacks import callback
    from twoloop.methods.dop853 import DOP853
    from twoloop.methods.paper import BDF, Newmark, paper_irk, paper_newmark
    from twoloop.methods.runge_kutta import ESDIRK, RungeKutta
    from twoloop.methods.taylor import Taylor
    from twoloop.problem.description import Drawing, Joint, Stop
    from twoloop.problem.problem import Problem
    from twoloop.problem.system import ConstrainedSystem
    from twoloop.result.certificate import Certificate, CertificateWarning
    from twoloop.result.result import Result, citation, load
    from twoloop.run.projection import ConsistentState, consistent_state
    from twoloop.run.record import Statistics, Status
    from twoloop.solve import solve_dae
    from twoloop.sweeps.sweep import sweep

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
    "Problem",
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

_NAMES_OF = {
    "checks.consistency": ("ConstraintWarning",),
    "ensembles.consistent_states": ("consistent_states",),
    "ensembles.ensemble": ("Runs", "ensemble"),
    "ensembles.integrator": ("Integrator",),
    "impacts.motion": ("solve_with_friction", "solve_with_stops"),
    "kernels.compile.callbacks": ("callback",),
    "methods.dop853": ("DOP853",),
    "methods.paper": ("BDF", "Newmark", "paper_irk", "paper_newmark"),
    "methods.runge_kutta": ("ESDIRK", "RungeKutta"),
    "methods.taylor": ("Taylor",),
    "problem.description": ("Drawing", "Joint", "Stop"),
    "problem.problem": ("Problem",),
    "problem.system": ("ConstrainedSystem",),
    "result.certificate": ("Certificate", "CertificateWarning"),
    "result.result": ("Result", "citation", "load"),
    "run.projection": ("ConsistentState", "consistent_state"),
    "run.record": ("Statistics", "Status"),
    "solve": ("solve_dae",),
    "sweeps.sweep": ("sweep",),
}
_PLACES = {name: f"twoloop.{module}" for module, names in _NAMES_OF.items() for name in names}


def __getattr__(name: str) -> Any:
    if name in _PLACES:
        globals()[name] = found = getattr(import_module(_PLACES[name]), name)
        return found
    if not name.startswith("_") and find_spec(f"twoloop.{name}") is not None:
        return import_module(f"twoloop.{name}")
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
