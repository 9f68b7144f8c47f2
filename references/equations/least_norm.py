"""Accelerations and multipliers at stored states, with minimum norm of non-unique multipliers."""

import numpy as np

from references.equations.accelerations import compiled_gamma
from references.equations.rows import independent_rows
from twoloop.problem.problem import Array
from twoloop.problem.system import ConstrainedSystem

SAMPLES = 5  # states at which the rank is determined, because it may be lower at singular positions


def accelerations(system: ConstrainedSystem, t: Array, states: Array) -> tuple[Array, Array]:
    """Return accelerations and multipliers of eq. (6) at states (2 n_q, n_t); NaN if a state is not finite."""
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
    found = np.full((t.size, n + m), np.nan)
    if finite.any():
        found[finite] = _solved(matrices[finite], right[finite], n)
    return found[:, :n].T, found[:, n:].T


def _solved(matrices: Array, right: Array, n: int) -> Array:
    """Return minimum-norm solutions (n_t, n + n_c) of equations with the matrices [M C_q^T; C_q 0]."""
    Cq = matrices[:, n:, :n]
    some = np.unique(np.linspace(0, len(Cq) - 1, SAMPLES).astype(int))
    chosen = np.array(max((independent_rows(each) for each in Cq[some]), key=len), dtype=int)
    kept = np.concatenate([np.arange(n), n + chosen])
    try:
        solution = np.linalg.solve(matrices[:, kept[:, None], kept], right[:, kept, None])
    except np.linalg.LinAlgError:
        return np.asarray(np.linalg.pinv(matrices, hermitian=True) @ right[:, :, None])[:, :, 0]
    lam = solution[:, n:]
    if chosen.size < Cq.shape[1]:  # C_q = T C_r: minimum-norm lam with T^T lam = lam_r
        Cr = Cq[:, chosen]
        T = np.linalg.solve(Cr @ Cr.mT, Cr @ Cq.mT).mT
        lam = T @ np.linalg.solve(T.mT @ T, lam)
    return np.concatenate([solution[:, :n], lam], axis=1)[:, :, 0]
