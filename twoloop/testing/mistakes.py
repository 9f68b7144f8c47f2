"""Identifies mistakes in a simulator from its accelerations, which are estimated from its velocities."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from twoloop.testing.changes import begun_later
from twoloop.testing.known_problem import Array, KnownProblem, solved
from twoloop.testing.simulated import Simulate, simulated

START_INDICES = range(0, 86, 5)  # indices of the known motion from which the simulator is started
N_LATER = 10  # number of output times after which its acceleration is measured
CLEAR = 0.2  # places whose accelerations are known to this part go before others
SURE = 3.0  # a difference of accelerations is significant above this multiple of the estimated error
EXPLAINS = 0.15  # largest remaining fraction of the difference for an accepted explanation
FITS = 0.05  # the same for explanations with a fitted factor
DAMPING = "there is a force (a damping?) of"
TIE = 1e-4  # fits whose residuals differ by less count as equal
Mistake = Callable[[KnownProblem, float, Array, Array], Array]


def _with(**edits: Callable[..., Array]) -> Mistake:
    """Return the acceleration with some of M, Q, J and gamma replaced."""

    def mistaken(problem: KnownProblem, t: float, q: Array, v: Array) -> Array:
        parts = {
            "M": problem.mass(t, q),
            "Q": problem.force(t, q, v),
            "J": problem.jacobian(t, q),
            "right": problem.gamma(t, q, v),
        }
        return solved(**{name: edits[name](problem, t, q, v) if name in edits else parts[name] for name in parts})[0]

    return mistaken


def _unconstrained(sign: float) -> Mistake:
    def mistaken(problem: KnownProblem, t: float, q: Array, v: Array) -> Array:
        lam = problem.acceleration(t, q, v)[1]
        right = problem.force(t, q, v) - sign * problem.jacobian(t, q).T @ lam
        return np.asarray(np.linalg.lstsq(problem.mass(t, q), right, rcond=1e-12)[0], dtype=float)

    return mistaken


def _start(p: KnownProblem) -> float:
    return p.t_span[0]


MISTAKES: dict[str, Mistake] = {
    "gamma has the other sign: the accelerations obey C_q a = +gamma, here C_q a = -gamma": _with(
        right=lambda p, t, q, v: -p.gamma(t, q, v)
    ),
    "gamma is left out: the accelerations obey C_q a = gamma, here C_q a = 0": _with(
        right=lambda p, t, q, v: 0.0 * p.gamma(t, q, v)
    ),
    "the part of gamma that depends on time (C_tt) is left out, or taken at a fixed time": _with(
        right=lambda p, t, q, v: p.gamma(t, q, v) - p.gamma(t, q, 0.0 * v)
    ),
    "the velocities are left out of gamma": _with(right=lambda p, t, q, v: p.gamma(t, q, 0.0 * v)),
    "the forces have the other sign": _with(Q=lambda p, t, q, v: -p.force(t, q, v)),
    "the forces are left out": _with(Q=lambda p, t, q, v: 0.0 * q),
    "the forces that depend on the velocities (gyroscopic, centrifugal) are left out": _with(
        Q=lambda p, t, q, v: p.force(t, q, 0.0 * v)
    ),
    "the forces that depend on the velocities (gyroscopic, centrifugal) have the other sign": _with(
        Q=lambda p, t, q, v: 2.0 * p.force(t, q, 0.0 * v) - p.force(t, q, v)
    ),
    "the forces that depend on the velocities (gyroscopic, centrifugal) are twice as large": _with(
        Q=lambda p, t, q, v: 2.0 * p.force(t, q, v) - p.force(t, q, 0.0 * v)
    ),
    "the forces are those of the start: they are to be taken at (t, q, v)": _with(
        Q=lambda p, t, q, v: p.force(_start(p), p.q0, p.v0)
    ),
    "the forces are those of the time at the start: they are to be taken at (t, q, v)": _with(
        Q=lambda p, t, q, v: p.force(_start(p), q, v)
    ),
    "the forces are those of t = 0: they are to be taken at (t, q, v)": _with(Q=lambda p, t, q, v: p.force(0.0, q, v)),
    "the forces are those of the time since the start: t begins at times[0], not at 0": _with(
        Q=lambda p, t, q, v: p.force(t - _start(p), q, v)
    ),
    "the forces are those of the positions at the start: they are to be taken at (t, q, v)": _with(
        Q=lambda p, t, q, v: p.force(t, p.q0, v)
    ),
    "only the diagonal of the mass matrix is used": _with(M=lambda p, t, q, v: np.diag(np.diag(p.mass(t, q)))),
    "the mass matrix is that of the start: it is to be taken at (t, q)": _with(
        M=lambda p, t, q, v: p.mass(_start(p), p.q0)
    ),
    "the mass matrix is left out": _with(M=lambda p, t, q, v: np.eye(q.size)),
    "C_q is that of the start: it is to be taken at (t, q)": _with(J=lambda p, t, q, v: p.jacobian(_start(p), p.q0)),
    "the forces of the constraints are left out": _unconstrained(0.0),
    "the forces of the constraints have the other sign: M a + C_q^T lam = Q": _unconstrained(-1.0),
}


@dataclass(frozen=True, eq=False)
class ObservedAcceleration:
    """Acceleration of a simulator at one of its states, its uncertainty, and the true one."""

    problem: KnownProblem
    t: float
    q: Array
    v: Array
    a: Array
    doubt: float
    true: Array
    free: Array  # basis (n_free, n_q) of the admissible directions


def mistaken_acceleration(
    simulate: Simulate, problem: KnownProblem, setting: float, *, by_steps: bool, fit: bool
) -> str:
    """Return the mistake that explains the accelerations of a simulator started on the known motion, or "".

    `fit`: also try forces or masses that are wrong by a factor, which errors of a coarse method can resemble.
    """
    tries = (_observed(simulate, begun_later(problem, k, N_LATER + 1), setting, by_steps) for k in _starts(problem))
    seen = [each for each in tries if each is not None]
    clear = [each for each in seen if each.doubt < CLEAR * max(np.linalg.norm(each.a), np.linalg.norm(each.true))]
    places = clear if len(clear) > 1 else seen
    if len(places) < 2:  # a single one may be a coincidence
        return ""
    best, least = "", EXPLAINS
    for name, mistake in MISTAKES.items():
        others = [_acceleration_with(mistake, each.problem, each.t, each.q, each.v) for each in places]
        for free_only in (False, True):
            rest, gap = 0.0, 0.0
            for each, other in zip(places, others, strict=True):
                project = each.free if free_only else np.eye(each.a.size)
                off = np.linalg.norm(project @ (each.a - each.true))
                if off > SURE * each.doubt and np.linalg.norm(project @ (other - each.true)) > SURE * each.doubt:
                    gap += float(off**2)
                rest += float(np.linalg.norm(project @ (each.a - other)) ** 2)
            if gap > 0.0 and np.sqrt(rest / gap) < least:
                best, least = name, float(np.sqrt(rest / gap))
    return best or (_scaled(places) if fit else "")


def _scaled(places: list[ObservedAcceleration]) -> str:
    """Return the force or mass that explains the accelerations if wrong by a factor, or ""."""
    pairs: dict[str, list[tuple[Array, Array]]] = {}
    sure = False
    for each in places:
        state = each.t, each.q, each.v
        M, Q = each.problem.mass(*state[:2]), each.problem.force(*state)
        off, inertia = each.free @ (M @ each.a - Q), np.diag(M) * each.a
        sure |= bool(np.linalg.norm(off) > SURE * np.linalg.norm(M, 2) * each.doubt)
        pairs.setdefault("the forces are", []).append((off, each.free @ Q))
        pairs.setdefault(DAMPING, []).append((off, each.free @ each.v))
        for k, kind in enumerate(each.problem.coordinates):
            pairs.setdefault(f"the force on q[{k}] ({kind}) is", []).append((off, each.free[:, k] * Q[k]))
            pairs.setdefault(f"the mass or inertia of q[{k}] ({kind}) is", []).append(
                (off, -each.free[:, k] * inertia[k])
            )
    fits: dict[str, float] = {}
    for name, both in pairs.items() if sure else ():
        off, part = (np.concatenate(each) for each in zip(*both, strict=True))
        if part.any():
            more = float(off @ part / (part @ part))
            rest = float(np.linalg.norm(off - more * part) / np.linalg.norm(off))
            if rest < FITS:
                fits[f"{name} {more:.2g} v" if name == DAMPING else f"{name} {_times(1.0 + more)}"] = rest
    # force and mass of a free coordinate are equivalent: name all that fit, the force first
    least = min(fits.values(), default=0.0)
    return ", or ".join(name for name, rest in fits.items() if rest <= least + TIE)


def _times(factor: float) -> str:
    told = {0.0: "left out", -1.0: "of the other sign"}
    near = next((word for value, word in told.items() if abs(factor - value) < FITS), "")
    if not near and abs(factor - 1.0) < 0.1:
        return f"{100.0 * abs(factor - 1.0):.2g} % too {'large' if factor > 1.0 else 'small'}"
    return near or f"{factor:.3g} times as large as given"


def _acceleration_with(mistake: Mistake, problem: KnownProblem, t: float, q: Array, v: Array) -> Array:
    try:
        return mistake(problem, t, q, v)
    except np.linalg.LinAlgError:
        return np.full(q.size, np.nan)


def _starts(problem: KnownProblem) -> list[int]:
    """Return three start times, away from singular positions, after which most mistakes are visible."""
    motion = problem.reference
    assert motion is not None
    shows = {}
    for k in START_INDICES:
        t, q, v = motion.t[k + N_LATER], motion.q[k + N_LATER], motion.v[k + N_LATER]
        if any(motion.t[k] - 0.03 * t < singular < 1.03 * t for singular in problem.singular_times):
            continue
        later = begun_later(problem, k, N_LATER + 1)
        true = later.acceleration(t, q, v)[0]
        changes = [np.abs(_acceleration_with(mistake, later, t, q, v) - true).max() for mistake in MISTAKES.values()]
        shows[k] = sum(change > 0.1 * np.abs(true).max() for change in changes)
    return sorted(shows, key=lambda k: -shows[k])[:3]


def _observed(simulate: Simulate, problem: KnownProblem, setting: float, by_steps: bool) -> ObservedAcceleration | None:
    """Return a state near the end of a run and its acceleration by differences; None if the run fails."""
    first, last = problem.t_span
    interval = (last - first) / (N_LATER + 1)
    step = 0.125 * interval
    times = first + interval * N_LATER + step * np.arange(-2.0, 3.0)
    try:
        run = simulated(simulate, problem, np.concatenate([[first], times]), step if by_steps else setting)
    except (TypeError, ValueError):  # the simulator accepts no other times than those of the motion
        return None
    if not run.complete:
        return None
    t, q, x = float(times[2]), run.q[3], run.q[1:]
    by_q = (8.0 * (x[3] - x[1]) - (x[4] - x[0])) / (12.0 * step)
    if run.v is not None:
        v, u = run.v[3], run.v[1:]
        rough, a = (u[3] - u[1]) / (2.0 * step), (8.0 * (u[3] - u[1]) - (u[4] - u[0])) / (12.0 * step)
    else:
        v, rough = by_q, (x[3] - 2.0 * x[2] + x[1]) / step**2
        a = (16.0 * (x[3] + x[1]) - 30.0 * x[2] - (x[4] + x[0])) / (12.0 * step**2)
    true, J = problem.acceleration(t, q, v)[0], problem.jacobian(t, q)
    values, directions = np.linalg.svd(J)[1:]
    free = directions[int((values > 1e-9 * values[0]).sum()) :]
    return ObservedAcceleration(problem, t, q, v, a, float(np.linalg.norm(a - rough)), true, free)
