"""Two-loop state-space integration of constrained mechanical systems, M q'' + C_q^T lam = Q, C(q, t) = 0."""

from twoloop.bdf import BDF
from twoloop.callbacks import callback
from twoloop.certificate import Certificate, CertificateWarning
from twoloop.citations import citation
from twoloop.consistency import ConstraintWarning
from twoloop.dop853 import DOP853
from twoloop.drawing import Drawing
from twoloop.esdirk import ESDIRK
from twoloop.joints import Joint
from twoloop.methods import Newmark, RungeKutta, paper_irk, paper_newmark
from twoloop.projection import ConsistentState, consistent_state
from twoloop.result import Result, Statistics, Status
from twoloop.solve import solve_dae
from twoloop.storage import load
from twoloop.sweeps import sweep
from twoloop.system import ConstrainedSystem
from twoloop.taylor import Taylor

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
    "Joint",
    "Newmark",
    "Result",
    "RungeKutta",
    "Statistics",
    "Status",
    "Taylor",
    "callback",
    "citation",
    "consistent_state",
    "load",
    "paper_irk",
    "paper_newmark",
    "solve_dae",
    "sweep",
]
