"""Ablation of the paper's idea: five ways of treating the constraints in otherwise identical Runge-Kutta codes.

Tableau, fixed-point iteration over the stages, factorisations, convergence test and step-size control are the same. The
variants differ in the treatment of the stages' coordinates and of the end of a step: see the branches on `variant`.
"""

import time
from typing import Any, NamedTuple

import numpy as np
from numba import njit

from references.driver import Task, TimeLimit, adapter
from references.equations.accelerations import cholesky, cholesky_solve, lu_factor, lu_solve
from twoloop.checks.arguments import check_choice
from twoloop.kernels.compile.caches import compiled_when_called
from twoloop.kernels.data.common import Kit
from twoloop.kernels.data.indices import CONSTANT_MASS, GIVEN
from twoloop.kernels.evaluation.partition import full_pivoting
from twoloop.methods.tableaux import Tableau
from twoloop.result.result import Result

POSITIONS, FROZEN, PROJECTED, STABILISED, UNPROJECTED = range(5)

SAFETY, FASTEST, SLOWEST = 0.9, 5.0, 0.5  # fac, facmax, facmin of the paper
AGAIN, HELD = 0.7, 10  # after divergence: bound of the step, relative to the failed one, for this many steps
MOST_SWEEPS, MOST_NEWTON = 100, 10
HOPELESS = 1e3  # relative to the first change of the stages: divergence
KEPT = 1e-9  # correction of q at convergence; the remaining error is its square
LEAST_STEP = 1e-12  # relative to the time span
ROUNDING = 1e-14  # tolerance of the test whether the last stage is the end of the step

DONE, NOT_CONVERGED, SINGULAR, TOO_SMALL = range(4)
EVALUATIONS, FACTORIZATIONS, SWEEPS, NEWTON, STEPS, REFUSED, DIVERGED, PARTITIONS, N_COUNTERS = range(9)
COUNTERS = (  # names in `Statistics`
    *("n_evaluations", "n_factorizations", "n_outer", "n_inner", "n_accepted"),
    *("n_rejected_error", "n_rejected_convergence", "n_partitions"),
)
T, H, LONGEST, HOLD, MU, N_PLACES = range(6)  # indices in `where`: step-size control and largest |mu|


class _Space(NamedTuple):
    """Arrays of one run."""

    M: Any  # (n, n) factors of the mass matrix
    Cq: Any  # (m, n)
    W: Any  # (s, m, n) rows of C_q M^-1, by stage
    S: Any  # (m, m) factors of C_q M^-1 C_q^T
    D: Any  # (m, m) factors of C_qd
    pivots: Any  # (m)
    C: Any  # (m)
    q: Any  # (s, n) stages
    v: Any  # (s, n)
    a: Any  # (s, n)
    lam: Any  # (s, m)
    mu: Any  # (s, m)
    off: Any  # (2, s, m) corrections of the multipliers
    Kq: Any  # (s, n)
    Kv: Any  # (s, n)
    order: Any  # (n) of the columns of C_q, dependents first


@njit(error_model="numpy")
def _matrices(f, w, t, q, W, counters):  # type: ignore[no-untyped-def]
    """Compute C_q, C_q M^-1 and the factors of C_q M^-1 C_q^T at q; return False if they are singular."""
    m, n = w.Cq.shape
    if f.flags[CONSTANT_MASS] == 0 or counters[EVALUATIONS] == 0:
        w.M[:, :] = 0.0
        f.mass(t, q, f.p, w.M)
        counters[FACTORIZATIONS] += 1
        if not cholesky(w.M):
            return False
    w.Cq[:, :] = 0.0
    f.jacobian(t, q, f.p, w.Cq)
    for i in range(m):
        for j in range(n):
            W[i, j] = w.Cq[i, j]
        cholesky_solve(w.M, W[i])
        for k in range(i + 1):
            w.S[i, k] = 0.0
            for j in range(n):
                w.S[i, k] += w.Cq[k, j] * W[i, j]
    counters[FACTORIZATIONS] += 1
    return cholesky(w.S)


@njit(error_model="numpy")
def _free(f, w, t, q, v, a, counters):  # type: ignore[no-untyped-def]
    """Compute a = M^-1 Q."""
    a[:] = 0.0
    f.force(t, q, v, f.p, a)
    cholesky_solve(w.M, a)
    counters[EVALUATIONS] += 1


@njit(error_model="numpy")
def _loaded(a, W, lam):  # type: ignore[no-untyped-def]
    """Subtract M^-1 C_q^T lam from a."""
    for i in range(lam.size):
        for j in range(a.size):
            a[j] -= W[i, j] * lam[i]


@njit(error_model="numpy")
def _accelerate(f, w, t, q, v, a, lam, W, counters):  # type: ignore[no-untyped-def]
    """Compute a and lam of eq. (6); return False if it is singular."""
    if not _matrices(f, w, t, q, W, counters):
        return False
    _free(f, w, t, q, v, a, counters)
    lam[:] = 0.0
    f.gamma(t, q, v, f.p, lam)
    for i in range(lam.size):
        lam[i] = -lam[i]
        for j in range(a.size):
            lam[i] += w.Cq[i, j] * a[j]
    cholesky_solve(w.S, lam)
    _loaded(a, W, lam)
    return True


@njit(error_model="numpy")
def _residual(f, w, t, q, v, r):  # type: ignore[no-untyped-def]
    """Compute r = C_q v + C_t with the C_q of w."""
    r[:] = 0.0
    f.constraint_rate(t, q, f.p, r)
    for i in range(r.size):
        for j in range(v.size):
            r[i] += w.Cq[i, j] * v[j]


@njit(error_model="numpy")
def _satisfy(f, w, t, q, v, enough, counters):  # type: ignore[no-untyped-def]
    """Solve eq. (15) for dependent positions, until a correction is below `enough`, and eq. (14) for velocities."""
    m, correction = w.C.size, np.inf
    for tries in range(MOST_NEWTON + 1):
        w.Cq[:, :] = 0.0
        f.jacobian(t, q, f.p, w.Cq)
        for i in range(m):
            for j in range(m):
                w.D[i, j] = w.Cq[i, w.order[j]]
        counters[FACTORIZATIONS] += 1
        if not lu_factor(w.D, w.pivots):
            return False
        if correction <= enough:
            break
        if tries == MOST_NEWTON:
            return False
        counters[NEWTON] += 1
        w.C[:] = 0.0
        f.constraint(t, q, f.p, w.C)
        lu_solve(w.D, w.pivots, w.C)
        correction = 0.0
        for j in range(m):
            q[w.order[j]] -= w.C[j]
            correction = max(correction, abs(w.C[j]) / max(1.0, abs(q[w.order[j]])))
        if not np.isfinite(correction):
            return False
    _residual(f, w, t, q, v, w.C)
    lu_solve(w.D, w.pivots, w.C)
    for j in range(m):
        v[w.order[j]] -= w.C[j]
    return True


@njit(error_model="numpy")
def _project(f, w, t, q, v, counters):  # type: ignore[no-untyped-def]
    """Project q and v onto the constraints orthogonally in the norm of M; return False if that does not converge."""
    correction = np.inf
    for tries in range(MOST_NEWTON + 1):
        if not _matrices(f, w, t, q, w.W[0], counters):
            return False
        if correction <= KEPT:
            break
        if tries == MOST_NEWTON:
            return False
        counters[NEWTON] += 1
        w.C[:] = 0.0
        f.constraint(t, q, f.p, w.C)
        correction = _least_change(w, w.W[0], q)
    _residual(f, w, t, q, v, w.C)
    _least_change(w, w.W[0], v)
    return True


@njit(error_model="numpy")
def _least_change(w, W, x):  # type: ignore[no-untyped-def]
    """Subtract M^-1 C_q^T S^-1 C from x; return the largest change relative to max(1, |x|)."""
    cholesky_solve(w.S, w.C)
    largest = 0.0
    for j in range(x.size):
        change = 0.0
        for i in range(w.C.size):
            change += W[i, j] * w.C[i]
        x[j] -= change
        change = abs(change) / max(1.0, abs(x[j]))
        if not change <= largest:  # True for NaN
            largest = change
    return largest


@njit(error_model="numpy")
def _partition(f, w, t, q, counters):  # type: ignore[no-untyped-def]
    """Choose the dependent coordinates by Gaussian elimination with full pivoting; return False for dependent rows."""
    m, n = w.Cq.shape
    P = np.zeros((m, n))
    f.jacobian(t, q, f.p, P)
    for j in range(n):
        w.order[j] = j
    counters[FACTORIZATIONS] += 1
    counters[PARTITIONS] += 1
    return full_pivoting(P, w.order, np.arange(m), np.zeros(m), 0, m, m) == m


@njit(error_model="numpy")
def _combine(y, h, weights, K, out):  # type: ignore[no-untyped-def]
    """Compute out = y + h sum(weights K)."""
    for i in range(y.size):
        total = 0.0
        for j in range(weights.size):
            total += weights[j] * K[j, i]
        out[i] = y[i] + h * total


@njit(error_model="numpy")
def _update(y, h, K, new, largest):  # type: ignore[no-untyped-def]
    """Overwrite K with new; return the largest change of h K relative to max(1, |y|), or `largest`."""
    for i in range(y.size):
        change = h * abs(new[i] - K[i]) / max(1.0, abs(y[i]))
        if not change <= largest:  # True for NaN
            largest = change
        K[i] = new[i]
    return largest


@njit(error_model="numpy")
def _sweep(f, w, variant, A, c, inverse, t, h, q, v, loop_tol, counters):  # type: ignore[no-untyped-def]
    """Compute all stages from the previous ones; return the largest change; NaN if a matrix is singular."""
    s, m = w.lam.shape
    change = 0.0
    for j in range(s):
        t_j, q_j, v_j = t + c[j] * h, w.q[j], w.v[j]
        _combine(q, h, A[j], w.Kq, q_j)
        _combine(v, h, A[j], w.Kv, v_j)
        if variant == POSITIONS:
            if not _satisfy(f, w, t_j, q_j, v_j, np.sqrt(loop_tol), counters):
                return np.nan
        elif variant == FROZEN:
            for k in range(m):
                q_j[w.order[k]] = q[w.order[k]]
                v_j[w.order[k]] = v[w.order[k]]
        if variant == STABILISED:
            if not _matrices(f, w, t_j, q_j, w.W[j], counters):
                return np.nan
            for k, y in enumerate((q_j, v_j)):
                if k == 0:
                    w.C[:] = 0.0
                    f.constraint(t_j, q_j, f.p, w.C)
                else:
                    _residual(f, w, t_j, q_j, v_j, w.C)
                _least_change(w, w.W[j], y)  # effect of the corrections of the multipliers on the stage
                w.off[k, j] = w.C
            _free(f, w, t_j, q_j, v_j, w.a[j], counters)
        elif not _accelerate(f, w, t_j, q_j, v_j, w.a[j], w.lam[j], w.W[j], counters):
            return np.nan
    if variant == STABILISED:
        for j in range(s):
            for l in range(s):
                for i in range(m):
                    w.mu[j, i] += inverse[j, l] / h * w.off[0, l, i]
                    w.lam[j, i] += inverse[j, l] / h * w.off[1, l, i]
            _loaded(w.v[j], w.W[j], w.mu[j])
            _loaded(w.a[j], w.W[j], w.lam[j])
    for j in range(s):
        change = _update(q, h, w.Kq[j], w.v[j], change)
        change = _update(v, h, w.Kv[j], w.a[j], change)
    counters[SWEEPS] += 1
    return change


@njit(error_model="numpy")
def _step(  # type: ignore[no-untyped-def]
    f, w, variant, A, b, c, inverse, t, h, start, end, loop_tol, where, counters
):
    """Take a step from the state `start` = [q v a lam] to `end`; return DONE or an error code."""
    s, n = w.q.shape
    q, v = start[:n], start[n : 2 * n]
    if variant <= FROZEN and not _partition(f, w, t, q, counters):
        return SINGULAR
    w.mu[:, :] = 0.0
    for j in range(s):
        w.Kq[j] = v
        w.Kv[j] = start[2 * n : 3 * n]
        w.lam[j] = start[3 * n :]
    first, sweeps, change = 0.0, 0, np.inf
    while not change <= loop_tol:
        change = _sweep(f, w, variant, A, c, inverse, t, h, q, v, loop_tol, counters)
        sweeps += 1
        first = change if sweeps == 1 else first
        if sweeps == MOST_SWEEPS or not change <= HOPELESS * first:
            return NOT_CONVERGED
    q1, v1 = end[:n], end[n : 2 * n]
    _combine(q, h, b, w.Kq, q1)
    _combine(v, h, b, w.Kv, v1)
    projected = True
    if variant <= FROZEN:
        projected = _satisfy(f, w, t + h, q1, v1, KEPT, counters)
    elif variant == PROJECTED or (variant == STABILISED and np.abs(A[-1] - b).max() >= ROUNDING):
        projected = _project(f, w, t + h, q1, v1, counters)
    if not projected:
        return SINGULAR
    where[MU] = max(where[MU], np.abs(w.mu).max() if w.mu.size else 0.0)
    if not _accelerate(f, w, t + h, q1, v1, end[2 * n : 3 * n], end[3 * n :], w.W[0], counters):
        return SINGULAR
    return DONE


@njit(error_model="numpy")
def _error(n, tol, states):  # type: ignore[no-untyped-def]
    """Return eq. (27) for positions and velocities from the states at start, end (one step), middle, and end (two)."""
    total = 0.0
    for i in range(2 * n):
        scale = tol + tol * max(abs(states[0, i]), abs(states[1, i]))
        total += ((states[1, i] - states[3, i]) / scale) ** 2
    return np.sqrt(total / (2 * n))


@compiled_when_called(error_model="numpy")
def run(  # type: ignore[no-untyped-def]
    f, n, m, s, variant, order, A, b, c, inverse, t0, t1, n_steps, tol, loop_tol, state, where, rows, counters
):
    """Take one step per row of `rows`, each [t q v a lam]: `n_steps` equal ones, or under control if that is 0.

    The first call fills its single row with the initial state.
    """
    M, Cq, W, S, D = np.zeros((n, n)), np.zeros((m, n)), np.zeros((s, m, n)), np.zeros((m, m)), np.zeros((m, m))
    pivots, C, lam, mu = np.zeros(m, dtype=np.int64), np.zeros(m), np.zeros((s, m)), np.zeros((s, m))
    q, v, a, Kq, Kv = np.zeros((s, n)), np.zeros((s, n)), np.zeros((s, n)), np.zeros((s, n)), np.zeros((s, n))
    corrections, places = np.zeros((2, s, m)), np.zeros(n, dtype=np.int64)
    w = _Space(M, Cq, W, S, D, pivots, C, q, v, a, lam, mu, corrections, Kq, Kv, places)
    if rows.shape[0] == 1:
        parts = state[:n], state[n : 2 * n], state[2 * n : 3 * n], state[3 * n :]
        good = _accelerate(f, w, t0, *parts, w.W[0], counters)
        rows[0, 0] = t0
        rows[0, 1:] = state
        return DONE if good else SINGULAR
    w.M[:, :] = 0.0
    f.mass(where[T], state[:n], f.p, w.M)
    cholesky(w.M)
    states = np.zeros((4, state.size))  # start, end by one step, middle, end by two half steps
    n_stored = 0
    while n_stored < rows.shape[0] and where[T] < t1:
        t, h = where[T], where[H]
        last = counters[STEPS] + 1 == n_steps if n_steps > 0 else t + 1.01 * h >= t1
        if n_steps == 0 and h < LEAST_STEP * (t1 - t0):
            return TOO_SMALL
        h = t1 - t if last else h
        states[0] = state
        code, part = DONE, 0
        while code == DONE and part < (1 if n_steps > 0 else 3):
            begin, share, start = ((0.0, 1.0, 0), (0.0, 0.5, 0), (0.5, 0.5, 2))[part]
            place = (t + begin * h, share * h, states[start], states[part + 1])
            code = _step(f, w, variant, A, b, c, inverse, *place, loop_tol, where, counters)
            part += 1
        if n_steps > 0 and code != DONE:
            return code
        if code != DONE:
            counters[DIVERGED] += 1
            where[LONGEST], where[HOLD], where[H] = AGAIN * h, HELD, 0.5 * h
            continue
        if n_steps == 0:
            error = _error(n, tol, states)
            factor = min(FASTEST, max(SLOWEST, SAFETY * max(error, 1e-12) ** (-1.0 / (order + 1))))
            if not error <= 1.0:
                counters[REFUSED] += 1
                where[H] = h * min(factor, SAFETY)
                continue
            where[HOLD] -= 1.0
            if where[HOLD] <= 0.0:
                where[LONGEST] = t1 - t0
            where[H] = min(h * factor, where[LONGEST])
        counters[STEPS] += 1
        where[T] = t1 if last else t0 + counters[STEPS] * h if n_steps > 0 else t + h
        state[:] = states[part]
        rows[n_stored, 0] = where[T]
        rows[n_stored, 1:] = state
        n_stored += 1
    return DONE


VARIANTS = {
    "positions in every stage": "the paper: dependent q and v from the constraints at every stage, in every iteration",
    "dependents frozen": "dependent q and v as at the beginning of the step, until its end",
    "projected once a step": "index 1: all coordinates integrated, put onto the constraints at the end (Eich 1993)",
    "stabilised index 2": "Gear, Gupta & Leimkuhler: M q' = M v - C_q^T mu, C = 0 and C_q v + C_t = 0 at the stages",
    "unprojected": "index 1: all coordinates integrated, constraints left to themselves",
}
FROZEN_ORDER = 1  # order with dependents frozen, for any tableau

LOOP_SHARE = 1e-4  # tolerance of the stage iteration relative to that of the step, as 1e-9 to 1e-5 in the paper
LEAST_LOOP = 1e-11  # rounding errors on the beam are about 1e-12
CHUNK = 100  # steps per compiled call, after which the clock is checked
FIRST = 1e-3  # first step with step-size control, relative to the time span
REASONS = {
    NOT_CONVERGED: "the stage iteration does not converge",
    SINGULAR: "a matrix is singular, or the constraints cannot be solved",
    TOO_SMALL: "the step has become too small",
}


@adapter(velocity_rows=False)
def solve_variant(
    task: Task, variant: str, tableau: Tableau, *, step: float | None = None, tol: float | None = None
) -> tuple[Result, float]:
    """Integrate by a Runge-Kutta tableau with one of five treatments of the constraints.

    Parameters
    ----------
    variant : str
        One of `VARIANTS`, which describes each.
    tableau : Tableau
        Implicit, with an invertible A.
    step : float, optional
        Fixed step size, s, rounded so that t_span is a multiple of it.
    tol : float, optional
        Instead of a fixed step: rtol = atol of eqs. (26), (27), (31), from one step and two half steps, keeping the
        latter. The stage iteration ends at a change of 1e-4 tol relative to max(1, |y|), but at least 1e-11, which is
        used for fixed steps.
    others : see `references.driver`
        The system must have `gamma` and independent position constraints; no t_eval.

    Returns
    -------
    result : Result
        States at the ends of steps. Statistics: n_evaluations, of eq. (6); n_factorizations, of all matrices, and
        partitions; n_outer, sweeps over all stages; n_inner, Newton iterations.
    mu : float
        Largest |mu| of the stabilised form, M q' = M v - C_q^T mu; 0 for the others.

    Notes
    -----
    All stages of a sweep are computed from those of the previous sweep. The multipliers of the stabilised form follow
    from the residuals of the stages by a Newton step with the matrices of each stage. Unless the last stage is the end
    of the step, the end is projected onto the constraints (U. Ascher and L. Petzold, SIAM J. Numer. Anal. 28 (1991)
    1097-1120); otherwise the method loses its order.
    """
    check_choice("variant", variant, tuple(VARIANTS))
    if (step is None) == (tol is None):
        raise ValueError(f"give either step, for fixed steps, or tol; given step={step!r}, tol={tol!r}")
    system, span, variant_index = task.system, task.t1 - task.t0, list(VARIANTS).index(variant)
    if not system.functions.flags[GIVEN["gamma"]]:
        raise ValueError(f"system must have gamma; given {system.name!r} without it")
    if np.linalg.matrix_rank(tableau.A) < tableau.stages:
        raise ValueError(f"tableau must have an invertible A; that of {tableau.name} is singular")

    n, m, s = system.n_q, system.n_c, tableau.stages
    order = FROZEN_ORDER if variant_index == FROZEN else tableau.order
    coefficients = [np.ascontiguousarray(x) for x in (tableau.A, tableau.b, tableau.c, np.linalg.inv(tableau.A))]
    counters, where = np.zeros(N_COUNTERS, dtype=np.int64), np.zeros(N_PLACES)
    n_steps, tol = 0 if step is None else max(1, round(span / step)), tol or 0.0
    where[T], where[H] = task.t0, span / n_steps if n_steps else FIRST * span
    where[LONGEST], loop_tol = span, max(LOOP_SHARE * tol, LEAST_LOOP)
    state, chunks = np.concatenate([task.y0, np.zeros(n + m)]), [np.empty((1, 1 + 3 * n + m))]
    given = n, m, s, variant_index, order, *coefficients, task.t0, task.t1, n_steps, tol, loop_tol, state, where
    limit, began = TimeLimit(task.time_limit), time.process_time()
    code = run(Kit(system.functions), *given, chunks[0], counters)  # initial a and lam
    while code == DONE and where[T] < task.t1 and not limit.passed():
        chunks.append(np.empty((CHUNK, 1 + 3 * n + m)))
        n_before = counters[STEPS]
        code = run(Kit(system.functions), *given, chunks[-1], counters)
        chunks[-1] = chunks[-1][: counters[STEPS] - n_before]
    counts: dict[str, Any] = dict(zip(COUNTERS, counters.tolist(), strict=True))
    counts["cpu_time"] = time.process_time() - began
    rows, name = np.concatenate(chunks).T, f"{tableau.name}, {variant}"
    t, failure = float(rows[0, -1]), ""
    if limit.exceeded:
        failure = limit.message(name, t, "take longer steps")
    elif code != DONE:
        failure = f"{name} failed after t = {t:.10g}: {REASONS[code]}. Take shorter steps."
    return task.result(name, rows[0], rows[1:], failure, h=np.diff(rows[0]), **counts), float(where[MU])
