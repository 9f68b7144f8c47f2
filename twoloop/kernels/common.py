"""What every kernel shares: signatures, the workspace, return codes, counters and the compiling decorator.

Every callback of a mechanism has one fixed signature and works in place, so that the integrator is compiled once
and takes any mechanism (and any method) as a first-class function.
"""

import hashlib
from collections import namedtuple
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numba import njit, types
from numba.core.dispatcher import Dispatcher
from numba.extending import typeof_impl

from twoloop.caches import compile_kept
from twoloop.callbacks import KINDS, MATRIX, OPTIONAL, VECTOR, f8
from twoloop.kernels.lapack import N_ROUTINES

i8 = types.int64
INTEGERS = types.int64[::1]

# the callbacks of a mechanism, its parameters and its flags, as the kernels see them
Functions: Any = namedtuple("Functions", [*KINDS, "p", "flags"])  # type: ignore[misc]
FUNCTIONS = types.NamedTuple(
    [*(types.FunctionType(kind.signature) for kind in KINDS.values()), VECTOR, INTEGERS], Functions
)


@typeof_impl.register(Functions)
def _type_of_functions(value: Any, context: Any) -> Any:
    """Types any `Functions` alike; otherwise numba would compile the kernels again for the callbacks of each system."""
    return FUNCTIONS


# places in Functions.flags; BANDWIDTH is -1 where linear algebra is to be dense
CONSTANT_MASS, DIAGONAL_MASS, BANDWIDTH, FIRST_GIVEN = range(4)
GIVEN = {name: place for place, name in enumerate(OPTIONAL, FIRST_GIVEN)}  # whether an optional callback is given
N_FLAGS = FIRST_GIVEN + len(GIVEN)
GAMMA_GIVEN, FORCE_BY_Q_GIVEN, FORCE_BY_V_GIVEN, REACTION_BY_Q_GIVEN = (
    GIVEN[name] for name in ("gamma", "force_by_q", "force_by_v", "reaction_by_q")
)


class Work(NamedTuple):
    """Arrays that an evaluation writes; made once a run. Sizes: n_q coordinates, n_c constraints."""

    M: Any  # (n_q, n_q) mass matrix
    L: Any  # (n_q, n_q) of a constant M the inverse, else its factors, see ldl_factor; or banded ones, see banded.py
    Cq: Any  # (n_c, n_q) constraint Jacobian at the last position
    Cqd: Any  # (n_c, n_c) LU factors of its dependent columns
    S: Any  # (n_c, n_c) Cq M^-1 Cq^T and its factors
    W: Any  # (n_q, n_c) Cq^T with a diagonal M; else M^-1 Cq^T, column after column
    Cqx: Any  # (n_c, n_q) Jacobian at a displaced point (Q_d by differences); scratch for full pivoting
    Cq_of_S: Any  # (n_c, n_q) the Cq that S and W belong to, where M is constant, not diagonal; NaN: none
    Q: Any  # (n_q) force
    x: Any  # (n_q) scratch
    C: Any  # (n_c) constraint, and corrections
    Ct: Any  # (n_c) constraint rate
    Qd: Any  # (n_c) right-hand side of Cq a = Qd
    Qd_tried: Any  # (2, n_c) the same by differences over a double length, and with the length tried before
    g: Any  # (n_c) scratch
    lam: Any  # (n_c) multipliers of an evaluation that is not kept
    dependent: Any  # (n_c) columns of the dependent coordinates
    independent: Any  # (n_q - n_c) columns of the independent coordinates
    pivots: Any  # (n_c) row exchanges of the LU factors
    order: Any  # (n_q) scratch: column order of the full pivoting
    counters: Any  # (N_COUNTERS) see below
    lapack: Any  # addresses of lapack.ROUTINES; 0 where linear algebra is dense
    predicted: Any  # (n_c) dependent positions that the integration formula gives, before the constraints restore them
    notes: Any  # (N_NOTES) see below


_INTEGER_FIELDS = ("dependent", "independent", "pivots", "order", "counters", "lapack")
_MATRIX_FIELDS = ("M", "L", "Cq", "Cqd", "S", "W", "Cqx", "Cq_of_S", "Qd_tried")
WORK = types.NamedTuple(
    [MATRIX if n in _MATRIX_FIELDS else INTEGERS if n in _INTEGER_FIELDS else VECTOR for n in Work._fields],
    Work,
)

# places in Work.counters
(
    N_ACCEPTED,
    N_REJECTED_ERROR,
    N_REJECTED_CONVERGENCE,
    N_OUTER,
    N_INNER,
    N_EVALUATIONS,
    N_PARTITIONS,
    N_FACTORIZATIONS,
    N_JACOBIANS,
    N_COUNTERS,
) = range(10)

# places in Work.notes
(
    SENSITIVITY,  # max|Cqd^-1 Cqi| after the first step under this partition; 0: not known yet
    DEPARTURE,  # how far the predicted dependents were off in this attempt, see predictor.py
    ORIENTATION,  # sign of det C_qd at the last accepted state under this partition; 0: not known
    ORIENTATION_NEW,  # ... and at the end of this attempt
    FAULT_KIND,  # place in Functions of the callback that gave a value that is not finite; -1: none known
    FAULT_TIME,  # ... and when
    GAMMA_REQUIRED,  # relative accuracy that Q_d by differences must have, see differences.py
    GAMMA_SHARE,  # of the longest length over which to difference
    GAMMA_ACCURACY,  # reached when that share was chosen
    GAMMA_SCALE,  # largest entry of Q_d so far
    N_NOTES,
) = range(11)

# what a kernel returns: DONE, or why it could not
DONE, OUTER_DIVERGED, INNER_DIVERGED, SINGULAR, NOT_FINITE, MASS_NOT_DEFINITE, GAMMA_INACCURATE = range(7)

# (functions, work, options, memory, t, h, tolerances, state, new_state) -> (code, normalised error)
STEP = types.Tuple((i8, f8))(FUNCTIONS, WORK, VECTOR, VECTOR, f8, f8, VECTOR, VECTOR, VECTOR)
StepFunction = types.FunctionType(STEP)

# places in the array `tolerances` that a step gets; ESTIMATE is 0 for a fixed step, LEAST the smallest tolerance; from
# ATOL on stands the absolute tolerance of each coordinate and its velocity
RTOL, ESTIMATE, LEAST, ATOL = range(4)


@cache
def _stamp() -> str:
    """A digest of what kernels depend on: all their sources, and the table of callbacks."""
    digest = hashlib.sha256(repr((FUNCTIONS, GIVEN)).encode())
    for path in sorted(Path(__file__).parent.glob("*.py")):
        digest.update(path.read_bytes())
    return digest.hexdigest()


_ANNOUNCEMENT = "twoloop: compiling the integrator, two or three minutes; later processes read it from the disk"


def kernel(signature: Any) -> Callable[[Callable[..., Any]], Dispatcher]:
    """Compile a function of the integrator for `signature` and keep the machine code on disk."""

    def compile_now(function: Callable[..., Any]) -> Dispatcher:
        return compile_kept(function, signature, (_stamp(), ""), announcement=_ANNOUNCEMENT, **_OPTIONS)

    return compile_now


# NaN and infinity keep their meaning. Without numba's runtime no array can be allocated, so a step that would does not
# compile, and none is reference-counted, which costs an evaluation of the four-bar a third of its time
_OPTIONS: dict[str, Any] = {
    "error_model": "numpy",
    "fastmath": {"contract", "reassoc", "nsz", "arcp"},
    "nogil": True,
    "_nrt": False,
}
# a helper whose floating-point operations keep their order; said outright, because a callee inherits its caller's flags
exact = njit(**{**_OPTIONS, "fastmath": False})
compiled = njit(**_OPTIONS)  # a helper that kernels call
# a helper that vanishes in its caller: a call would pass the thirty fields of Functions and Work by value
inlined = njit(**_OPTIONS, inline="always")


def make_work(n_q: int, n_c: int) -> Work:
    """Allocate the workspace of one run."""
    return Work(
        M=np.zeros((n_q, n_q)),
        L=np.zeros((n_q, n_q)),
        Cqd=np.zeros((n_c, n_c)),
        S=np.zeros((n_c, n_c)),
        W=np.zeros((n_q, n_c)),
        Cq=np.zeros((n_c, n_q)),
        Cqx=np.zeros((n_c, n_q)),
        Cq_of_S=np.full((n_c, n_q), np.nan),
        Q=np.zeros(n_q),
        x=np.zeros(n_q),
        C=np.zeros(n_c),
        Ct=np.zeros(n_c),
        Qd=np.zeros(n_c),
        Qd_tried=np.zeros((2, n_c)),
        g=np.zeros(n_c),
        lam=np.zeros(n_c),
        dependent=np.zeros(n_c, dtype=np.int64),
        independent=np.zeros(n_q - n_c, dtype=np.int64),
        pivots=np.zeros(n_c, dtype=np.int64),
        order=np.zeros(n_q, dtype=np.int64),
        counters=np.zeros(N_COUNTERS, dtype=np.int64),
        lapack=np.zeros(N_ROUTINES, dtype=np.int64),
        predicted=np.zeros(n_c),
        notes=np.zeros(N_NOTES),
    )
