"""What the adapters of solvers of y' = f(t, y), y = [q, v], share: the Result of their states."""

from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import qr

from twoloop.problem.system import ConstrainedSystem
from twoloop.result.result import Result
from twoloop.run.record import Statistics, Status

Array = NDArray[np.float64]

DEPENDENT = 1e-10  # of the largest pivot: rows of C_q with a smaller one depend on the others
SAMPLES = 5  # states at which the rank is looked for
OUTPUTS = 1001  # instants of the default t_eval of solvers that do not store their steps

ADVICE = (
    "Look for a discontinuity, a singular position or a value that is not finite near this time, or try other "
    "tolerances or another method."
)


def output_times(times: Array | None, t0: float, t1: float) -> Array:
    """The instants at which to store the solution: those given, or `OUTPUTS` evenly."""
    return np.linspace(t0, t1, OUTPUTS) if times is None else times


def states_at(solver: Any, span: tuple[float, float], times: Array, *start: Array) -> SimpleNamespace:
    """The states of a solver of scikit-sundae at times that the same steps have reached before."""
    t0, t1 = span
    shown = [solver.init_step(t0, *start)]
    if times.size and times[-1] > t0:
        solver.step(t1, "onestep", t1)  # the length of the first step depends on where it is to go
        shown += [solver.step(stop, tstop=t1) for stop in times[times > t0].tolist()]
    if not (times.size and times[0] == t0):
        shown = shown[1:]
    size = start[0].size
    y, yp = (np.array([getattr(each, name, each.y) for each in shown]).reshape(-1, size) for name in ("y", "yp"))
    return SimpleNamespace(t=times, y=y, yp=yp)


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
    a, lam = _accelerations(system, t, states)
    return Result(
        t=t,
        q=states[: system.n_q],
        v=states[system.n_q :],
        a=a,
        lam=lam,
        h=np.empty(0) if h is None else h,
        status=Status.SOLVER_FAILED if failure else Status.REACHED_END,
        message=failure or end,
        stats=statistics,
    )


def _accelerations(system: ConstrainedSystem, t: Array, states: Array) -> tuple[Array, Array]:
    """Accelerations and multipliers of eq. (6) at states (2 n_q, n_t); NaN where a state is not finite."""
    n, m, f = system.n_q, system.n_c, system.functions
    rows, finite = np.ascontiguousarray(states.T), np.isfinite(states).all(axis=0)
    matrices, right = np.zeros((t.size, n + m, n + m)), np.zeros((t.size, n + m))
    M, Cq = np.zeros((n, n)), np.zeros((m, n))
    for k in np.flatnonzero(finite):
        time, q, v = float(t[k]), rows[k, :n], rows[k, n:]
        M[:], Cq[:] = 0.0, 0.0
        f.mass(time, q, f.p, M)
        f.force(time, q, v, f.p, right[k, :n])
        if m:
            f.jacobian(time, q, f.p, Cq)
            f.gamma(time, q, v, f.p, right[k, n:])
        matrices[k, :n, :n], matrices[k, n:, :n], matrices[k, :n, n:] = M, Cq, Cq.T
    matrices, right = matrices[finite], right[finite]
    a, lam = np.full((t.size, n), np.nan), np.full((t.size, m), np.nan)
    if len(matrices):
        a[finite], lam[finite] = _solved(matrices, right, n)
    return a.T, lam.T


def _solved(matrices: Array, right: Array, n: int) -> tuple[Array, Array]:
    """Solutions (n_t, n), (n_t, n_c) of linear equations with the matrices [M C_q^T; C_q 0], of least norm."""
    Cq = matrices[:, n:, :n]
    some = np.linspace(0, len(Cq) - 1, SAMPLES).astype(int)  # at a singular position more rows depend on others
    chosen = max((_independent(each) for each in Cq[some]), key=len)
    kept = np.concatenate([np.arange(n), n + chosen])
    try:
        solution = np.linalg.solve(matrices[:, kept[:, None], kept], right[:, kept, None])
    except np.linalg.LinAlgError:
        solution = np.linalg.pinv(matrices, hermitian=True) @ right[:, :, None]
        return solution[:, :n, 0], solution[:, n:, 0]
    a, lam = np.asarray(solution[:, :n], np.float64), np.asarray(solution[:, n:], np.float64)
    if chosen.size < Cq.shape[1]:  # C_q = T C_r: of all with T^T lam = lam_r the one of least norm
        Cr = Cq[:, chosen]
        T = np.linalg.solve(Cr @ Cr.mT, Cr @ Cq.mT).mT
        lam = T @ np.linalg.solve(T.mT @ T, lam)
    return a[:, :, 0], lam[:, :, 0]


def _independent(Cq: Array) -> NDArray[np.int64]:
    """Rows of C_q that do not depend on one another, as many as there are."""
    _, triangle, order = qr(Cq.T, mode="economic", pivoting=True)
    diagonal = np.abs(np.diagonal(triangle))
    return np.sort(order[: np.count_nonzero(diagonal > DEPENDENT * diagonal.max(initial=0.0))])
