"""What the adapters of solvers of y' = f(t, y), y = [q, v], share: the Result of their states."""

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import qr

from references.driver import result_of
from references.equations.accelerations import compiled_gamma
from twoloop.problem.system import ConstrainedSystem
from twoloop.result.result import Result
from twoloop.run.record import Statistics

Array = NDArray[np.float64]

DEPENDENT = 1e-10  # of the largest pivot: rows of C_q with a smaller one depend on the others
SAMPLES = 5  # states at which the rank is looked for


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
    columns = np.concatenate([states, *accelerations(system, t, states)])
    return result_of(system.n_q, t, columns, end, failure, statistics, h)


def accelerations(system: ConstrainedSystem, t: Array, states: Array) -> tuple[Array, Array]:
    """Accelerations and multipliers of eq. (6) at states (2 n_q, n_t); NaN where a state is not finite."""
    n, m, f, gamma = system.n_q, system.n_c, system.functions, compiled_gamma(system)
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
            gamma(time, q, v, f.p, right[k, n:])
        matrices[k, :n, :n], matrices[k, n:, :n], matrices[k, :n, n:] = M, Cq, Cq.T
    matrices, right = matrices[finite], right[finite]
    a, lam = np.full((t.size, n), np.nan), np.full((t.size, m), np.nan)
    if len(matrices):
        a[finite], lam[finite] = _solved(matrices, right, n)
    return a.T, lam.T


def _solved(matrices: Array, right: Array, n: int) -> tuple[Array, Array]:
    """Solutions (n_t, n), (n_t, n_c) of linear equations with the matrices [M C_q^T; C_q 0], of least norm."""
    Cq = matrices[:, n:, :n]
    some = np.unique(
        np.linspace(0, len(Cq) - 1, SAMPLES).astype(int)
    )  # at a singular position more rows depend on others
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
