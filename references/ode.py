"""What the adapters of solvers of y' = f(t, y), y = [q, v], share: the Result of their states."""

import numpy as np
from numpy.typing import NDArray

from twoloop.result import Result, Statistics, Status
from twoloop.system import ConstrainedSystem

Array = NDArray[np.float64]

OUTPUTS = 1001  # instants of the default t_eval of solvers that do not store their steps

ADVICE = (
    "Look for a discontinuity, a singular position or a value that is not finite near this time, or try other "
    "tolerances or another method."
)


def output_times(times: Array | None, t0: float, t1: float) -> Array:
    """The instants at which to store the solution: those given, or `OUTPUTS` evenly."""
    return np.linspace(t0, t1, OUTPUTS) if times is None else times


def ode_result(
    system: ConstrainedSystem,
    t: Array,
    states: Array,
    failure: str,
    end: str,
    statistics: Statistics,
    h: Array | None = None,
) -> Result:
    """The Result of states (2 n_q, n_t); `failure` is the message of a run that failed, `end` that of one that did not.

    `a` and `lam` (with the sign of M a + C_q^T lam = Q) are those of eq. (6) at the states, of least norm where they
    are not unique.
    """
    n, m = system.n_q, system.n_c
    a, lam = np.empty((n, t.size)), np.empty((m, t.size))
    matrix, right = np.zeros((n + m, n + m)), np.empty(n + m)
    for k in range(t.size):
        q, v = states[:n, k].copy(), states[n:, k].copy()
        if not (np.isfinite(q).all() and np.isfinite(v).all()):
            a[:, k] = lam[:, k] = np.nan
            continue
        matrix[:n, :n], right[:n] = system.mass(t[k], q), system.force(t[k], q, v)
        if m:
            matrix[n:, :n] = system.jacobian(t[k], q)
            matrix[:n, n:] = matrix[n:, :n].T
            right[n:] = system.gamma(t[k], q, v)
        solution = np.linalg.lstsq(matrix, right, rcond=None)[0]
        a[:, k], lam[:, k] = solution[:n], solution[n:]
    return Result(
        t=t,
        q=states[:n],
        v=states[n:],
        a=a,
        lam=lam,
        h=np.empty(0) if h is None else h,
        status=Status.SOLVER_FAILED if failure else Status.REACHED_END,
        message=failure or end,
        stats=statistics,
    )
