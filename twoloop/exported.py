"""What `twoloop` exports."""

from twoloop.checks.consistency import ConstraintWarning
from twoloop.ensembles.consistent_states import consistent_states
from twoloop.ensembles.ensemble import ensemble
from twoloop.ensembles.integrator import Integrator
from twoloop.ensembles.runs import Runs
from twoloop.impacts.motion import solve_with_stops
from twoloop.kernels.compile.callbacks import callback
from twoloop.methods.bdf import BDF
from twoloop.methods.dop853 import DOP853
from twoloop.methods.esdirk import ESDIRK
from twoloop.methods.newmark import Newmark
from twoloop.methods.presets import paper_irk, paper_newmark
from twoloop.methods.runge_kutta import RungeKutta
from twoloop.methods.taylor import Taylor
from twoloop.problem.drawing import Drawing
from twoloop.problem.joints import Joint
from twoloop.problem.stops import Stop
from twoloop.problem.system import ConstrainedSystem
from twoloop.result.certificate import Certificate, CertificateWarning
from twoloop.result.citations import citation
from twoloop.result.loading import load
from twoloop.result.result import Result
from twoloop.run.projection import ConsistentState, consistent_state
from twoloop.run.record import Statistics, Status
from twoloop.solve import solve_dae
from twoloop.sweeps.sweep import sweep

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
    "solve_with_stops",
    "sweep",
]
