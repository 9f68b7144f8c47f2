"""SUNDIALS IDA with its sparse solver, through scikit-sundae, for a system that provides its nonzero entries.

The equations are the stabilised ones of residual.py, the linear solver is SuperLU_MT, which is included in the wheels
of scikit-sundae, and the Jacobian is computed by differences of groups of columns without common rows. Both functions
are compiled and called through Python.
"""

import warnings
from collections.abc import Callable
from functools import lru_cache
from typing import Any

import numpy as np
from numba.core.dispatcher import Dispatcher
from scipy.optimize._numdiff import group_columns
from scipy.sparse import bmat, coo_array, csc_array, eye_array

from references.driver import CAUSES, Task, TimeLimit, adapter, imported, user_call
from references.equations.accelerations import cached
from references.equations.rows import accelerations
from references.sundials.library import SMALLEST_STEP
from references.sundials.residual import DIFFERENCE
from twoloop.problem.system import ConstrainedSystem
from twoloop.result.result import Result


@adapter(velocity_rows=False)
def solve_ida_sparse(task: Task, rtol: float = 1e-8, atol: float = 1e-8) -> Result:
    """Integrate a constrained mechanical system whose forces do not depend on the state, with IDA.

    Parameters and errors as in `references.driver`; the result contains the initial and final states only. Raises
    ValueError if the system has no `jacobian_values` and `mass_values`.
    """
    system, (t0, t1), limit = task.system, (task.t0, task.t1), TimeLimit(task.time_limit)
    if not {"jacobian", "mass"} <= system.entries.keys():
        raise ValueError(f"system must have jacobian_values and mass_values; {system.name!r} does not")
    f, n, m = system.functions, system.n_q, system.n_c
    residual = _residual_of(f.mass_values, f.force, f.constraint, f.constraint_rate, f.jacobian_values)
    entries = tuple(np.asarray(indices) for name in ("mass", "jacobian") for indices in system.entries[name])
    space = *entries, np.zeros(entries[0].size), np.zeros(entries[2].size)

    pattern = pattern_of_residual(system)
    # of each column; columns of a group have no common row
    groups, matrix = group_columns(pattern, np.arange(pattern.shape[1])), _matrix_of(residual)

    def resfn(t, y, yp, res):  # type: ignore[no-untyped-def]
        residual(n, t, np.array(y), np.array(yp), f.p, *space, res)  # copies of read-only arrays
        if limit.passed():
            res[:] = np.nan

    def jacfn(t, y, yp, res, cj, JJ):  # type: ignore[no-untyped-def]
        matrix(n, t, cj, np.array(y), np.array(yp), f.p, *space, groups, pattern.indptr, pattern.indices, JJ)

    a, lam = (indices[:, 0] for indices in accelerations(system, np.array([t0]), task.y0[:, None]))
    y, yp = np.concatenate([task.y0, np.zeros(2 * m)]), np.concatenate([task.v0, a, lam, np.zeros(m)])
    steps = {"min_step": SMALLEST_STEP * (t1 - t0), "max_step": t1 - t0, "max_num_steps": 10**9}
    sparse = {"linsolver": "sparse", "sparsity": pattern, "jacfn": jacfn}
    package = imported("sksundae.ida", "scikit-sundae", "references")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # about the unused pattern
        solver: Any = package.IDA(resfn, rtol=rtol, atol=atol, **sparse, **steps)
    jacfn(t0, y, yp, y, 1.0, np.zeros(pattern.nnz))  # compiles
    resfn(t0, y, yp, np.zeros_like(y))
    with user_call:
        solver.init_step(t0, y, yp)
        outcome = solver.step(t1, tstop=t1)
    failure = ""
    if outcome.status < 0 and limit.exceeded:
        failure = limit.message("IDA", float(outcome.t), "take looser tolerances")
    elif outcome.status < 0:
        failure = f"IDA failed after t = {outcome.t:.10g} with status {outcome.status}. {CAUSES} other tolerances."
    ends = [np.concatenate([y[: 2 * n], yp[n : 2 * n + m]]) for y, yp in ((y, yp), (outcome.y, outcome.yp))]
    counts = {"n_evaluations": int(outcome.nfev), "n_factorizations": int(outcome.njev)}
    return task.result("IDA", np.array([t0, float(outcome.t)]), np.transpose(ends), failure, **counts)


def pattern_of_residual(system: ConstrainedSystem) -> csc_array:
    """Return the sparsity pattern (n, n) of the residual in the unknowns q, v, Lam, Mu and their rates."""
    n, m = system.n_q, system.n_c
    M, G = (
        coo_array((np.ones(len(rows)), (rows, columns)), shape=(size, n))
        for size, (rows, columns) in ((n, system.entries["mass"]), (m, system.entries["jacobian"]))
    )
    products, identity = G.T @ G, eye_array(n)  # C_q^T lam couples coordinates that share a row
    blocks = [
        [identity + products, identity, None, G.T],
        [products, M, G.T, None],
        [G, None, None, None],
        [G, G, None, None],
    ]
    pattern = csc_array(bmat(blocks) != 0.0)
    # 64-bit indices make scikit-sundae corrupt the heap
    places = pattern.indices.astype(np.int32), pattern.indptr.astype(np.int32)
    return csc_array((pattern.data, *places), shape=pattern.shape)


@lru_cache(maxsize=8)
def _residual_of(
    mass: Dispatcher, force: Dispatcher, constraint: Dispatcher, rate: Dispatcher, jacobian: Dispatcher
) -> Callable[..., None]:
    """Return (n_q, t, y, y', p, rows and columns of M and C_q, workspaces for their values, res) -> None."""

    @cached
    def residual(n, t, y, yp, p, rows, columns, row_of, column_of, M, G, res):  # type: ignore[no-untyped-def]
        m = y.size // 2 - n
        q, v, Lam, Mu = y[:n], y[n : 2 * n], yp[2 * n : 2 * n + m], yp[2 * n + m :]
        res[:], M[:], G[:] = 0.0, 0.0, 0.0
        force(t, q, v, p, res[n : 2 * n])
        constraint(t, q, p, res[2 * n : 2 * n + m])
        rate(t, q, p, res[2 * n + m :])
        mass(t, q, p, M)
        jacobian(t, q, p, G)
        for j in range(n):
            res[j], res[n + j] = yp[j] - v[j], -res[n + j]
        for k in range(rows.size):
            res[n + rows[k]] += M[k] * yp[n + columns[k]]
        for k in range(row_of.size):
            i, j = row_of[k], column_of[k]
            res[j] += G[k] * Mu[i]
            res[n + j] += G[k] * Lam[i]
            res[2 * n + m + i] += G[k] * v[j]

    return residual


@lru_cache(maxsize=8)
def _matrix_of(residual: Callable[..., None]) -> Callable[..., None]:
    """Return the same with cj after t, and groups, pointers, rows and values of the columns: dF/dy + cj dF/dy'."""

    @cached
    def matrix(n, t, cj, y, yp, p, r, c, r_of, c_of, M, G, groups, begin, rows, values):  # type: ignore[no-untyped-def]
        here, displaced = np.zeros_like(y), np.zeros_like(y)
        residual(n, t, y, yp, p, r, c, r_of, c_of, M, G, here)
        for group in range(groups.max() + 1):
            x, rate = y.copy(), yp.copy()
            for j in range(y.size):
                if groups[j] == group:
                    x[j] += DIFFERENCE * max(1.0, abs(y[j]))
                    rate[j] += cj * (x[j] - y[j])
            residual(n, t, x, rate, p, r, c, r_of, c_of, M, G, displaced)
            for j in range(y.size):
                if groups[j] == group:
                    for k in range(begin[j], begin[j + 1]):
                        values[k] = (displaced[rows[k]] - here[rows[k]]) / (x[j] - y[j])

    return matrix
