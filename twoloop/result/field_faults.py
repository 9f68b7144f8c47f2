"""Check the fields of a result against the equations and against one another, for `result.certify()`."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from twoloop.problem.system import ConstrainedSystem
from twoloop.run.dense_solution import Interpolator, ranks_at
from twoloop.run.record import Record, Status
from twoloop.run.singular_start import Branch, branch_at

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]

NEAR = 1e-9  # times count as equal if they differ by at most this, relative to the duration of the run
ROUNDING = 1e-9  # deviation attributed to rounding, relative to the largest acceleration or multiplier
SINGULAR_START = 1e-5  # largest error of the accelerations at a start in a singular position, relative to the largest
LIMIT_OF_A = 10.0  # a and lam may be off by what errors of this many tolerances in the stored state can cause
MIN_EFFECT = 1e-6  # errors of the state are assumed to change each a (or lam) by this times their largest effect on one
NEAR_SINGULAR = 0.02  # a position is near a singular one if (smallest / largest singular value) of [C_q; A] is smaller
PATTERNS = 3  # number of sign patterns of the perturbations by which the effect of a tolerance is measured


def all_states(result: Record) -> tuple[Array, Array]:
    """Return times and states [q, v] of a result: at `t`, at events, and at the steps of `sol`."""
    times, states = [result.t], [np.vstack([result.q, result.v]).T]
    if result.sol is not None:
        table = result.sol.table
        inside = table.t <= result.sol.t_max
        times.append(table.t[inside])
        states.append(table.states[inside, : states[0].shape[1]])
    for t, q, v in zip(result.t_events or (), result.q_events or (), result.v_events or (), strict=True):
        inside = t >= result.t[0]
        times.append(t[inside])
        states.append(np.hstack([q, v])[inside])
    return np.concatenate(times), np.concatenate(states)


def end_of_run(result: Record) -> float:
    """Return the time, s, that the run has reached according to its fields; -inf if unknown."""
    if result.status == Status.EVENT:
        return max((float(t[-1]) for t in result.t_events or () if len(t)), default=-np.inf)
    return -np.inf if result.t_end is None else result.t_end


def field_faults(result: Record, system: ConstrainedSystem, rtol: float, atol: Array, limit: float) -> Iterator[str]:
    """Yield contradictions in a result as clauses of a message; errors of up to `limit` tolerances are allowed."""
    shapes = list(_wrong_shapes(result, system))
    yield from shapes
    if shapes:
        return
    yield from _times_and_steps(result)
    yield from _start_faults(result, system, rtol, atol, limit)
    yield from _acceleration_faults(result, system, rtol, atol, limit)


def _wrong_shapes(result: Record, system: ConstrainedSystem) -> Iterator[str]:
    """Yield clauses about fields whose shapes do not fit the system and the number of times."""
    n_t, n_rows = len(result.t), system.n_c + system.n_a
    for name, n in (("q", system.n_q), ("v", system.n_q), ("a", system.n_q), ("lam", n_rows)):
        shape = np.shape(getattr(result, name))
        if shape != (n, n_t):
            yield f"{name} has shape {shape} instead of {(n, n_t)}"


def _times_and_steps(result: Record) -> Iterator[str]:
    """Yield clauses about contradictions between times, steps, counts and status."""
    t, h = result.t, result.h
    duration = abs(float(t[-1] - t[0]))
    if not (np.diff(t) >= 0.0).all():
        yield "the times of the result do not increase"
    if len(h) and not (np.isfinite(h).all() and (h >= 0.0).all()):
        yield "the sizes of the steps, h, are not all positive numbers"
    elif len(h) and h.sum() < duration * (1.0 - NEAR):
        yield f"the steps, h, add up to {h.sum():.6g} s, and the result covers {duration:.6g} s"
    sol, largest = result.sol, max(duration, abs(float(t[0])), abs(float(t[-1])))
    if sol is not None and min(t[0] - sol.t_min, sol.t_max - t[-1]) < -NEAR * largest:
        limits = f"t = {sol.t_min:.6g} to {sol.t_max:.6g}"
        yield f"the dense solution goes from {limits}, and the result from {t[0]:.6g} to {t[-1]:.6g}"
    n_accepted = result.stats.n_accepted
    if len(h) and n_accepted is not None and n_accepted != len(h):
        yield f"stats counts {n_accepted} accepted steps, and h has {len(h)}"
    if result.status == Status.EVENT and end_of_run(result) == -np.inf:
        yield "the status says that an event ended the run, and the result has no events"
    if result.t_end is None:
        return
    tolerance = NEAR * max(abs(result.t_end - float(t[0])), abs(result.t_end))
    if t[-1] > result.t_end + tolerance:
        yield f"the result goes on to t = {t[-1]:.6g}, beyond the end of the run at t = {result.t_end:.6g}"
    start = float(t[0]) if result.sol is None else result.sol.t_min
    if result.status == Status.REACHED_END and len(h) and start + h.sum() < result.t_end - tolerance:
        yield f"the status says that the end was reached, and the steps, h, end at t = {start + h.sum():.6g}"


def _start_faults(result: Record, system: ConstrainedSystem, rtol: float, atol: Array, limit: float) -> Iterator[str]:
    """Yield clauses about constraints that the first state violates; `certify` reintegrates the later states."""
    t, q, v = float(result.t[0]), result.q[:, 0], result.v[:, 0]
    if system.n_c + system.n_a == 0 or not np.isfinite([q, v]).all():
        return
    rows = np.abs(system.rows(t, q))
    allowed_q, allowed_v = (limit * (atol + rtol * np.abs(x)) for x in (q, v))
    violation = np.abs(system.constraint(t, q))
    if (violation > rows[: system.n_c] @ allowed_q + ROUNDING).any():
        yield f"the first state violates the constraints by {violation.max():.2g}"
    violation = np.abs(system.velocity_constraint(t, q, v))
    if (violation > rows @ allowed_v + np.abs(rows).sum(axis=1) * allowed_q.max() * np.abs(v).max() + ROUNDING).any():
        yield f"the first velocities violate the constraints by {violation.max():.2g}"


def _acceleration_faults(
    result: Record, system: ConstrainedSystem, rtol: float, atol: Array, limit: float
) -> Iterator[str]:
    """Yield clauses about stored a and lam that deviate from the solution of the equations at the stored states.

    A deviation is allowed if errors of LIMIT_OF_A tolerances in the state can cause it, or of `limit` tolerances near a
    singular position, where rounding changes a and lam; perturbed states measure this.
    """
    n, t = system.n_q, np.ascontiguousarray(result.t)
    states, stored = np.vstack([result.q, result.v]).T.copy(), np.vstack([result.a, result.lam]).T
    is_stored = ~np.isnan(stored).all(axis=1) & np.isfinite(states).all(axis=1)
    if not is_stored.any():
        return
    t, states, stored = t[is_stored], states[is_stored], stored[is_stored]
    at_start = t == t[0]
    if np.isnan(stored[at_start, n:]).all() and not at_start.all():
        rank, _ = ranks_at(system, float(t[0]), states[0, :n], states[0, n:], rtol)
        first = np.append(states[0], stored[0, :n])
        branch = branch_at(system, float(t[0]), first, rank, atol + rtol * np.abs(states[0, n:]).max())
        if isinstance(branch, Branch):  # a start in a singular position, where lam is not determined
            off = np.abs(stored[at_start, :n] - branch.a).max()
            if not off <= SINGULAR_START * np.abs(branch.a).max():
                yield f"a differs at the start, a singular position, by {off:.2g} from that of the branch with v0"
            t, states, stored = t[~at_start], states[~at_start], stored[~at_start]
    row = np.append(states[0], np.full(n, np.nan))  # the accelerations a are unknown
    ranks = ranks_at(system, float(t[0]), states[0, :n], states[0, n:], rtol)
    interpolator = Interpolator(system, float(t[0]), row, rtol, atol, ranks)
    interpolator.warns = False

    def evaluate(times: Array, rows: Array) -> Array:
        out = np.full(stored.shape, np.nan)
        interpolator.fill_accelerations(times, rows, out)
        return out

    exact = evaluate(t, states)
    largest = np.nanmax(np.abs(exact), axis=0, initial=0.0)
    # in equilibrium, accelerations are rounding errors of forces that cancel: so accelerations by the applied forces
    # without constraints count as their magnitude, too
    inertia = np.diagonal(system.mass(float(t[0]), states[0, :n]))
    forces = np.abs(system.force(float(t[0]), *states[0].reshape(2, n)))
    largest[:n] = np.maximum(largest[:n], np.divide(forces, inertia, out=np.zeros(n), where=inertia > 0.0))
    with np.errstate(invalid="ignore"):
        deviation = np.abs(stored - exact)

    def find_wrong(effect: Array) -> tuple[Flags, Array]:
        always_allowed = ROUNDING * largest + MIN_EFFECT * np.nanmax(effect, axis=0, initial=0.0)
        for part in (slice(0, n), slice(n, None)):  # a, lam
            always_allowed[part] = always_allowed[part].max(initial=0.0)
        allowed = LIMIT_OF_A * effect + always_allowed
        with np.errstate(invalid="ignore"):
            return np.isfinite(exact) & ~(deviation <= allowed), allowed

    effect = rtol * np.abs(exact)
    if not find_wrong(effect)[0].any():
        return  # states need not be perturbed, which takes long in large systems
    change = np.tile(atol, 2) + rtol * np.abs(states)
    shift = NEAR * float(t[-1] - t[0])
    for k in range(PATTERNS):
        signs = np.where((np.arange(2 * n) * (2 * k + 1)) % (k + 3) < (k + 3) / 2, 1.0, -1.0)
        for sign in (1.0, -1.0):
            with np.errstate(invalid="ignore"):
                effect = np.fmax(effect, np.abs(evaluate(t + sign * shift, states + sign * signs * change) - exact))
    is_wrong, allowed = find_wrong(effect)
    for i in np.flatnonzero(is_wrong.any(axis=1)):
        singular_values = np.linalg.svd(system.rows(float(t[i]), states[i, :n]), compute_uv=False)
        if ranks[1] > 0 and singular_values[ranks[1] - 1] < NEAR_SINGULAR * singular_values[0]:
            is_wrong[i] &= ~(deviation[i] <= limit / LIMIT_OF_A * allowed[i])
        if is_wrong[i].any():
            break
    for name, part in (("a", slice(0, n)), ("lam", slice(n, None))):
        if is_wrong[:, part].any():
            i, k = np.argwhere(is_wrong[:, part])[0]
            values = stored[i, part][k], exact[i, part][k]
            yield (
                f"{name}[{k}] is {values[0]:.6g} at t = {t[i]:.6g}, where the equations give {values[1]:.6g} at the "
                "stored state"
            )
