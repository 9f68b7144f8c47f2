"""BDF with a fixed step and order on the index-3 form, as a substitute for ADAMS GSTIFF, which is not available.

GSTIFF is Gear's method on the index-3 equations with variable order and step, fixed coefficients, and its own error
test and starting procedure. This has the same formulas and equations with a fixed step and order, as intended by HMAX =
HINIT. Its numbers show the behaviour of such formulas; they are not numbers of ADAMS.
"""

import math
import time
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numba import njit

from references.driver import STORED as STEPS_STORED
from references.driver import Task, TimeLimit, adapter, user_call
from references.equations.accelerations import lu_factor, lu_solve
from references.lines import Line
from references.scipy.index1 import solve_index1
from twoloop.checks.arguments import check_choice, check_size, check_times
from twoloop.kernels.compile.caches import compiled_when_called
from twoloop.kernels.data.common import Kit
from twoloop.problem.problem import Array
from twoloop.problem.system import ConstrainedSystem
from twoloop.result.result import Result

STARTS = {
    "ramp": "orders 1, 2, ... at the full step until the order is reached",
    "accurate": "first states by DOP853 with projection, to 1e-12",
}
HIGHEST = 6  # BDF of order 7 is unstable for any step

START_TOLERANCE = 1e-12
MAX_NEWTON = 10
NEWTON_TOL = 1e-12  # correction of a coordinate at convergence, relative to max(1, |q|)
SLOW = 0.1  # larger ratios of successive corrections trigger a new Newton matrix
DIFFERENCE = 1e-7  # step of finite differences of the residual, relative to max(1, |q|)
FIRST_STEPS = 100  # steps of the first call of the compiled loop
CALL = 0.05  # s; the number of steps per call is doubled up to this time, because a call costs 0.1 ms
WHOLE = 1e-6  # tolerance, in steps, of the test that t_span is a multiple of the step

DONE, NOT_CONVERGED, SINGULAR, NOT_FINITE = range(4)
_REASONS = {
    NOT_CONVERGED: f"Newton's method does not converge in {MAX_NEWTON} iterations",
    SINGULAR: "Newton's matrix is singular",
    NOT_FINITE: "Newton's method meets values that are not finite",
}
NEWTON, MATRICES, STEPS, STORED, N_COUNTERS = range(5)  # indices of the counters


@adapter(velocity_rows=False)
def solve_gear(task: Task, step: float, order: int = 2, *, start: str = "ramp") -> Result:
    """Integrate the index-3 equations by BDF with a fixed step and order, as a substitute for ADAMS GSTIFF.

    At t_{n+1} the unknowns q, v and lam satisfy q' = v and M v' + C_q^T lam = Q, with q' and v' by the backward
    differentiation formula of the order, and C = 0. Neither C_q v + C_t = 0 nor C_q a = Q_d is imposed.

    Parameters
    ----------
    step, order : float, int
        Step size, s, of which t_span must be a multiple; 1 to 6.
    start : {"ramp", "accurate"}
        Computation of the first `order` states.

        "ramp": the order increases from 1 by one per step, as in Gear's codes (C. W. Gear, Commun. ACM 14 (1971)
        176-179) including GSTIFF. Here all steps are equal, so the start causes an error of order 2 in the step for any
        order; unless it is at rest, the first multipliers and accelerations have errors that do not vanish.

        "accurate": by `solve_index1` with projection and tolerances of 1e-12, to show the error of the formula alone.
        Not included in cpu_time.
    others : see `references.driver`
        t_eval (None: every step) contains multiples of the step after t_span[0].

    Returns
    -------
    Result
        `a` is the BDF derivative of v, `lam` the solution of Newton's method. Statistics: n_accepted, n_outer (Newton
        iterations) and n_factorizations (Newton matrices). A completed run may be wrong, because the error is not
        controlled. At small steps an undamped motion loses energy with orders 1, 2, 5, 6, and gains it with 3 and 4.

    Notes
    -----
    With q = q* + h b v and v = v* + h b a, where q* and v* are combinations of past values and b is the coefficient of
    the formula, v and a follow from q. The equation of motion is multiplied by (h b)^2, and (h b)^2 lam is the unknown:
    the condition number of [[M + O(h), C_q^T], [C_q, 0]] is then bounded as h tends to zero.
    """
    system, n, t0, length = task.system, task.system.n_q, task.t0, task.t1 - task.t0
    n_steps = round(length / step)
    if n_steps < 1 or abs(length / step - n_steps) > WHOLE:
        raise ValueError(f"step must divide t_span, whose length is {length!r}, into whole steps; given {step!r}")
    if check_size("order", order, 1) > HIGHEST:
        raise ValueError(f"order must be at most {HIGHEST}, BDF of higher order is unstable; given {order}")
    check_choice("start", start, tuple(STARTS))
    keep = np.arange(n_steps + 1)
    if task.times is not None:
        keep = np.rint((check_times(task.times, t0, task.t1, step) - t0) / (length / n_steps)).astype(np.int64)

    h = length / n_steps
    n_given = min(order, n_steps) if start == "accurate" else 1
    first = _first_states(task, np.array([t0 + k * h for k in range(n_given)]))
    if not first.success:
        return replace(first, message=f"The accurate start failed. {first.message}")
    given = np.ascontiguousarray(np.vstack([first.q, first.v, first.a, first.lam]).T)
    rows, past = np.empty((keep.size, given.shape[1])), np.zeros((HIGHEST, given.shape[1]))
    counters, limit = np.zeros(N_COUNTERS, dtype=np.int64), TimeLimit(task.time_limit)
    code, n_done, stride, fixed = DONE, -1, FIRST_STEPS, (t0, h, order, _formulas(), keep, rows, counters)
    with user_call:
        while code == DONE and n_done < n_steps and not limit.passed():
            called, last = time.monotonic(), min(n_done + stride, n_steps)
            code = _integrate(Kit(system.functions), n, given, past, n_done + 1, last, *fixed)
            n_done, stride = last, stride * (2 if time.monotonic() - called < CALL else 1)

    n_done, stored = int(counters[STEPS]), int(counters[STORED])
    name, failure = f"BDF of order {order}", ""
    if limit.exceeded:
        failure = limit.message(name, t0 + n_done * h, "take a larger step")
    elif code != DONE:
        lower = " or a lower order" if order > 1 else ""
        failure = f"{name} failed in the step to t = {t0 + (n_done + 1) * h:.10g}: {_REASONS[code]}. "
        failure += f"Take a smaller step{lower}."
    counts = {"n_accepted": n_done, "n_outer": int(counters[NEWTON]), "n_factorizations": int(counters[MATRICES])}
    return task.result(
        name, np.asarray(t0 + h * keep[:stored], float), rows[:stored].T, failure, h=np.full(n_done, h), **counts
    )


def _first_states(task: Task, times: Array) -> Result:
    """Return the states at the first times; for a failed run those before its failure."""
    if times.size == 1:
        return task.result("the start", times, task.y0[:, None])
    options: dict[str, Any] = {"stabilisation": "projection", "t_eval": times, "time_limit": task.time_limit}
    span, tolerances = (float(times[0]), float(times[-1])), (START_TOLERANCE, START_TOLERANCE)
    return solve_index1(task.system, span, task.q0, task.v0, "DOP853", *tolerances, **options)  # type: ignore[no-any-return]


def _formulas() -> Array:
    """Return the coefficients of orders 1 to 6, one row each: b and alpha_i, then weights of extrapolation.

    y_0 = h b y'_0 + sum_i alpha_i y_-i, from sum_{j=1}^k 1/j nabla^j y_0 = h y'_0 (Hairer, Norsett & Wanner I, III.1).
    """
    table = np.zeros((HIGHEST, 1 + 2 * HIGHEST))
    for k in range(1, HIGHEST + 1):
        c = [sum((-1) ** i * math.comb(j, i) / j for j in range(max(i, 1), k + 1)) for i in range(k + 1)]
        table[k - 1, 0] = 1.0 / c[0]
        for i in range(1, k + 1):
            table[k - 1, i] = -c[i] / c[0]
            table[k - 1, HIGHEST + i] = (-1) ** (i + 1) * math.comb(k, i)
    return table


class _Space(NamedTuple):
    """Arrays of one run."""

    M: Any  # (n_q, n_q)
    Cq: Any  # (n_c, n_q)
    Q: Any  # (n_q)
    C: Any  # (n_c)
    v: Any  # (n_q)


@njit(error_model="numpy")
def _residual(f, w, t, q, forces, q_past, v_past, hb, r):  # type: ignore[no-untyped-def]
    """Compute r = [(h b)^2 (M a - Q) + C_q^T forces, C] at q, leaving v in w.v and C_q in w.Cq."""
    n, m = q.size, forces.size
    w.M[:, :] = 0.0
    w.Cq[:, :] = 0.0
    w.Q[:] = 0.0
    w.C[:] = 0.0
    for i in range(n):
        w.v[i] = (q[i] - q_past[i]) / hb
    f.mass(t, q, f.p, w.M)
    f.force(t, q, w.v, f.p, w.Q)
    f.jacobian(t, q, f.p, w.Cq)
    f.constraint(t, q, f.p, w.C)
    for i in range(n):
        r[i] = -hb * hb * w.Q[i]
        for j in range(n):
            r[i] += w.M[i, j] * (q[j] - q_past[j] - hb * v_past[j])
    for k in range(m):
        r[n + k] = w.C[k]
        for i in range(n):
            r[i] += w.Cq[k, i] * forces[k]


@njit(error_model="numpy")
def _matrix(f, w, t, q, forces, q_past, v_past, hb, r, displaced, J):  # type: ignore[no-untyped-def]
    """Compute the derivative of the residual r with respect to [q, forces], partly by differences."""
    n, m = q.size, forces.size
    J[:, :] = 0.0
    for k in range(m):
        for i in range(n):
            J[i, n + k] = w.Cq[k, i]
            J[n + k, i] = w.Cq[k, i]
    for j in range(n):
        original = q[j]
        q[j] += DIFFERENCE * max(1.0, abs(original))
        displacement = q[j] - original
        _residual(f, w, t, q, forces, q_past, v_past, hb, displaced)
        q[j] = original
        for i in range(n):
            J[i, j] = (displaced[i] - r[i]) / displacement


@njit(error_model="numpy")
def _newton(f, w, t, q, forces, q_past, v_past, hb, r, displaced, J, pivots, counters):  # type: ignore[no-untyped-def]
    """Solve for q and forces = (h b)^2 lam from their initial values; return DONE or an error code."""
    n = q.size
    previous, renew = np.inf, True
    for _ in range(MAX_NEWTON):
        _residual(f, w, t, q, forces, q_past, v_past, hb, r)
        counters[NEWTON] += 1
        if renew:
            _matrix(f, w, t, q, forces, q_past, v_past, hb, r, displaced, J)
            counters[MATRICES] += 1
            if not lu_factor(J, pivots):
                return SINGULAR if np.isfinite(r).all() else NOT_FINITE
        lu_solve(J, pivots, r)
        size, correction = 1.0, 0.0
        for i in range(n):
            q[i] -= r[i]
            size = max(size, abs(q[i]))
            correction = max(correction, abs(r[i]))
        for k in range(forces.size):
            forces[k] -= r[n + k]
        if not np.isfinite(r).all():
            return NOT_FINITE
        if correction <= NEWTON_TOL * size:
            return DONE
        renew = correction > SLOW * previous
        previous = correction
    return NOT_CONVERGED


@compiled_when_called(error_model="numpy")
def _integrate(  # type: ignore[no-untyped-def]
    f, n, given, past, first, last, t0, h, order, formulas, keep, rows, counters
):
    """Take steps `first` to `last` and store those numbered in `keep`.

    `given`, `past` and `rows` contain states [q v a lam]: of the start; of step i in row i % HIGHEST; those stored.
    """
    m = given.shape[1] - 3 * n
    w = _Space(np.zeros((n, n)), np.zeros((m, n)), np.zeros(n), np.zeros(m), np.zeros(n))
    r, displaced, pivots = np.zeros(n + m), np.zeros(n + m), np.zeros(n + m, dtype=np.int64)
    J = np.zeros((n + m, n + m))
    combined, new = np.zeros(2 * n), past[(first - 1) % HIGHEST].copy()
    for step in range(first, last + 1):
        if step < given.shape[0]:
            for j in range(new.size):
                new[j] = given[step, j]
        else:
            k = min(order, step)
            hb = h * formulas[k - 1, 0]
            combined[:] = 0.0
            new[n : 2 * n] = 0.0
            for i in range(1, k + 1):
                for j in range(2 * n):
                    combined[j] += formulas[k - 1, i] * past[(step - i) % HIGHEST, j]
                for j in range(n, 2 * n):
                    new[j] += formulas[k - 1, HIGHEST + i] * past[(step - i) % HIGHEST, j]
            for j in range(n):
                new[j] = combined[j] + hb * new[n + j]
            forces = new[3 * n :] * (hb * hb)
            q_past, v_past, t = combined[:n], combined[n:], t0 + step * h
            code = _newton(f, w, t, new[:n], forces, q_past, v_past, hb, r, displaced, J, pivots, counters)
            if code != DONE:
                return code
            for j in range(n):
                new[n + j] = (new[j] - combined[j]) / hb
                new[2 * n + j] = (new[n + j] - combined[n + j]) / hb
            for j in range(m):
                new[3 * n + j] = forces[j] / (hb * hb)
        past[step % HIGHEST] = new
        counters[STEPS] = step
        if counters[STORED] < keep.size and keep[counters[STORED]] == step:
            rows[counters[STORED]] = new
            counters[STORED] += 1
    return DONE


def solve_gear_stored(
    system: ConstrainedSystem, t_span: tuple[float, float], *start: Array, step: float, order: int, **options: Any
) -> Result:
    """As `solve_gear`; about `STEPS_STORED` steps are stored."""
    n_steps = round((t_span[1] - t_span[0]) / step)
    stored_times = t_span[0] + np.arange(0, n_steps, max(1, n_steps // STEPS_STORED)) * step
    return solve_gear(system, t_span, *start, step, order, t_eval=np.append(stored_times, t_span[1]), **options)  # type: ignore[no-any-return]


def name_of(order: int, start: str = "accurate") -> str:
    """Return the name of a line."""
    return f"GSTIFF stand-in, order {order}" + (", ramp" if start == "ramp" else "")


HOW: dict[str, Any] = {"compared": False, "setting": "h", "stores_steps": True}
LINES = tuple(
    Line(
        *(name_of(order, start), "twoloop", "stand-in", solve_gear_stored, {"order": order, "start": start}),
        **HOW | {"fixed": {"order": order}},
    )
    for order in range(1, HIGHEST + 1)
    for start in ("accurate", "ramp")
)
