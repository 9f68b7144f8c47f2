"""What a simulator takes for the acceleration, told from its velocities, and which mistake would make it so."""

from collections.abc import Callable

import numpy as np

from twoloop.testing.changes import begun_later
from twoloop.testing.known_problem import Array, KnownProblem, solved
from twoloop.testing.simulated import Simulate, simulated

PLACES = range(0, 86, 5)  # of the known motion, from which the simulator is started
LATER = 10  # output times after which it is looked at
TELLS = 0.02  # relative difference from the true acceleration that is one
EXPLAINS = 0.05  # of that difference, which may remain
Mistake = Callable[[KnownProblem, float, Array, Array], Array]


def _with(**edits: Callable[..., Array]) -> Mistake:
    """The acceleration with some of M, Q, J and gamma replaced."""

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
    "the forces are those of the start: they are to be taken at (t, q, v)": _with(
        Q=lambda p, t, q, v: p.force(_start(p), p.q0, p.v0)
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


def mistaken_acceleration(simulate: Simulate, problem: KnownProblem, setting: float, by_steps: bool) -> str:
    """Which mistake explains the accelerations of a simulator, or ""; each is started on the known motion."""
    found: list[set[str]] = []
    for k in _telling(problem):
        later = begun_later(problem, k, LATER + 1)
        seen = _own_acceleration(simulate, later, setting, by_steps)
        if seen is None:
            continue
        t, q, v, a = seen
        true = later.acceleration(t, q, v)[0]
        if np.abs(a - true).max() < TELLS * np.abs(true).max():
            continue
        free = np.linalg.svd(later.jacobian(t, q))[2][np.linalg.matrix_rank(later.jacobian(t, q), rtol=1e-9) :]
        found.append(
            {name for name, mistake in MISTAKES.items() if _explains(a, true, _tried(mistake, later, t, q, v), free)}
        )
    common = set.intersection(*found) if len(found) > 1 else set()  # once may be chance
    return next((name for name in MISTAKES if name in common), "")


def _tried(mistake: Mistake, problem: KnownProblem, t: float, q: Array, v: Array) -> Array:
    try:
        return mistake(problem, t, q, v)
    except np.linalg.LinAlgError:
        return np.full(q.size, np.nan)


def _telling(problem: KnownProblem) -> list[int]:
    """Three places of the motion after which most mistakes show, away from singular positions."""
    motion = problem.reference
    assert motion is not None
    shows = {}
    for k in PLACES:
        t, q, v = motion.t[k + LATER], motion.q[k + LATER], motion.v[k + LATER]
        if any(motion.t[k] - 0.03 * t < singular < 1.03 * t for singular in problem.singular_times):
            continue
        later = begun_later(problem, k, LATER + 1)
        true = later.acceleration(t, q, v)[0]
        changes = [np.abs(_tried(mistake, later, t, q, v) - true).max() for mistake in MISTAKES.values()]
        shows[k] = sum(change > 0.1 * np.abs(true).max() for change in changes)
    return sorted(shows, key=lambda k: -shows[k])[:3]


def _own_acceleration(
    simulate: Simulate, problem: KnownProblem, setting: float, by_steps: bool
) -> tuple[float, Array, Array, Array] | None:
    """A state of a run near its end, and the acceleration there by differences; None where it does not run."""
    first, last = problem.t_span
    interval = (last - first) / (LATER + 1)
    step = 0.125 * interval
    times = first + interval * LATER + np.array([-step, 0.0, step])
    run = simulated(simulate, problem, np.concatenate([[first], times]), step if by_steps else setting)
    if not run.complete:
        return None
    q = run.q[2]
    if run.v is not None:
        return float(times[1]), q, run.v[2], (run.v[3] - run.v[1]) / (2.0 * step)
    return float(times[1]), q, (run.q[3] - run.q[1]) / (2.0 * step), (run.q[3] - 2.0 * q + run.q[1]) / step**2


def _explains(a: Array, true: Array, other: Array, free: Array) -> bool:
    """Whether a is the mistaken acceleration rather than the true one, as a whole or along what is free."""
    for project in (np.eye(a.size), free):
        gap, rest = np.linalg.norm(project @ (other - true)), np.linalg.norm(project @ (a - other))
        if gap > TELLS * np.linalg.norm(true) and rest < EXPLAINS * gap:
            return True
    return False
