"""Identify mistakes in a simulator from its accelerations, which are estimated from its velocities."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from twoloop.testing.problem import Array, KnownProblem, Simulate, restart_at, run_simulator, solve_saddle_point

START_INDICES = range(0, 86, 5)  # indices of the known motion from which the simulator is started
N_LATER = 10  # number of output times from the start to the measurement of the simulator's acceleration
ACCURATE = 0.2  # places are preferred if the uncertainty of their acceleration is at most this fraction
SIGNIFICANT = 3.0  # a difference of accelerations is significant above this multiple of the estimated error
UNEXPLAINED = 0.15  # largest remaining fraction of the difference for an accepted explanation
FIT_RESIDUAL = 0.05  # largest remaining fraction for explanations with a fitted factor
DAMPING = "there is a force (a damping?) of"
TIE = 1e-4  # fits count as equal if their residuals differ by at most this
Mistake = Callable[[KnownProblem, float, Array, Array], Array]


def _replace_term(term: str, mistaken_term: Callable[..., Array]) -> Mistake:
    """Return a function that computes accelerations with one of M, Q, J and gamma replaced."""

    def mistaken(problem: KnownProblem, t: float, q: Array, v: Array) -> Array:
        terms = {
            "M": problem.mass(t, q),
            "Q": problem.force(t, q, v),
            "J": problem.jacobian(t, q),
            "gamma": problem.gamma(t, q, v),
        }
        return solve_saddle_point(**terms | {term: mistaken_term(problem, t, q, v)})[0]

    return mistaken


def _scale_multipliers(factor: float) -> Mistake:
    """Return a function that computes accelerations with constraint forces multiplied by a factor."""

    def mistaken(problem: KnownProblem, t: float, q: Array, v: Array) -> Array:
        lam = problem.acceleration(t, q, v)[1]
        force = problem.force(t, q, v) - factor * problem.jacobian(t, q).T @ lam
        return np.asarray(np.linalg.lstsq(problem.mass(t, q), force, rcond=1e-12)[0], dtype=float)

    return mistaken


def _start(p: KnownProblem) -> float:
    return p.t_span[0]


MISTAKES: dict[str, Mistake] = {
    "gamma has the other sign: the accelerations obey C_q a = +gamma, here C_q a = -gamma": _replace_term(
        "gamma", lambda p, t, q, v: -p.gamma(t, q, v)
    ),
    "gamma is left out: the accelerations obey C_q a = gamma, here C_q a = 0": _replace_term(
        "gamma", lambda p, t, q, v: 0.0 * p.gamma(t, q, v)
    ),
    "the part of gamma that depends on time (C_tt) is left out, or taken at a fixed time": _replace_term(
        "gamma", lambda p, t, q, v: p.gamma(t, q, v) - p.gamma(t, q, 0.0 * v)
    ),
    "the velocities are left out of gamma": _replace_term("gamma", lambda p, t, q, v: p.gamma(t, q, 0.0 * v)),
    "the forces have the other sign": _replace_term("Q", lambda p, t, q, v: -p.force(t, q, v)),
    "the forces are left out": _replace_term("Q", lambda p, t, q, v: 0.0 * q),
    "the forces that depend on the velocities (gyroscopic, centrifugal) are left out": _replace_term(
        "Q", lambda p, t, q, v: p.force(t, q, 0.0 * v)
    ),
    "the forces that depend on the velocities (gyroscopic, centrifugal) have the other sign": _replace_term(
        "Q", lambda p, t, q, v: 2.0 * p.force(t, q, 0.0 * v) - p.force(t, q, v)
    ),
    "the forces that depend on the velocities (gyroscopic, centrifugal) are twice as large": _replace_term(
        "Q", lambda p, t, q, v: 2.0 * p.force(t, q, v) - p.force(t, q, 0.0 * v)
    ),
    "the forces are those of the start: they are to be taken at (t, q, v)": _replace_term(
        "Q", lambda p, t, q, v: p.force(_start(p), p.q0, p.v0)
    ),
    "the forces are those of the time at the start: they are to be taken at (t, q, v)": _replace_term(
        "Q", lambda p, t, q, v: p.force(_start(p), q, v)
    ),
    "the forces are those of t = 0: they are to be taken at (t, q, v)": _replace_term(
        "Q", lambda p, t, q, v: p.force(0.0, q, v)
    ),
    "the forces are those of the time since the start: t begins at times[0], not at 0": _replace_term(
        "Q", lambda p, t, q, v: p.force(t - _start(p), q, v)
    ),
    "the forces are those of the positions at the start: they are to be taken at (t, q, v)": _replace_term(
        "Q", lambda p, t, q, v: p.force(t, p.q0, v)
    ),
    "only the diagonal of the mass matrix is used": _replace_term(
        "M", lambda p, t, q, v: np.diag(np.diag(p.mass(t, q)))
    ),
    "the mass matrix is that of the start: it is to be taken at (t, q)": _replace_term(
        "M", lambda p, t, q, v: p.mass(_start(p), p.q0)
    ),
    "the mass matrix is left out": _replace_term("M", lambda p, t, q, v: np.eye(q.size)),
    "C_q is that of the start: it is to be taken at (t, q)": _replace_term(
        "J", lambda p, t, q, v: p.jacobian(_start(p), p.q0)
    ),
    "the forces of the constraints are left out": _scale_multipliers(0.0),
    "the forces of the constraints have the other sign: M a + C_q^T lam = Q": _scale_multipliers(-1.0),
}


@dataclass(frozen=True, eq=False)
class ObservedAcceleration:
    """Acceleration `a` of a simulator at one of its states, its uncertainty `doubt`, and the `true` acceleration."""

    problem: KnownProblem
    t: float
    q: Array
    v: Array
    a: Array
    doubt: float
    true: Array
    free: Array  # basis (n_free, n_q) of the admissible directions

    @property
    def is_accurate(self) -> bool:
        """Return True if the uncertainty is a small part of the acceleration."""
        return self.doubt < ACCURATE * max(float(np.linalg.norm(self.a)), float(np.linalg.norm(self.true)))


def find_mistake(simulate: Simulate, problem: KnownProblem, setting: float, *, by_steps: bool, fit: bool) -> str:
    """Return the mistake that explains the accelerations of a simulator started on the known motion, or "".

    `fit`: also try forces or masses that are wrong by a factor, which errors of a coarse method can resemble.
    """
    starts = (restart_at(problem, k, N_LATER + 1) for k in _start_indices(problem))
    attempts = (_observe(simulate, start, setting, by_steps) for start in starts)
    observations = [sample for sample in attempts if sample is not None]
    accurate = [sample for sample in observations if sample.is_accurate]
    samples = accurate if len(accurate) > 1 else observations
    if len(samples) < 2:  # agreement with a single sample may be a coincidence
        return ""
    best, smallest = "", UNEXPLAINED
    for name, mistake in MISTAKES.items():
        mistaken = [_try_mistake(mistake, sample.problem, sample.t, sample.q, sample.v) for sample in samples]
        for free_only in (False, True):
            remaining, total = 0.0, 0.0
            for sample, mistaken_a in zip(samples, mistaken, strict=True):
                project = sample.free if free_only else np.eye(sample.a.size)
                error, effect = (np.linalg.norm(project @ (a - sample.true)) for a in (sample.a, mistaken_a))
                if min(error, effect) > SIGNIFICANT * sample.doubt:
                    total += float(error**2)
                remaining += float(np.linalg.norm(project @ (sample.a - mistaken_a)) ** 2)
            if total > 0.0 and np.sqrt(remaining / total) < smallest:
                best, smallest = name, float(np.sqrt(remaining / total))
    return best or (_fit_factor(samples) if fit else "")


def _fit_factor(samples: list[ObservedAcceleration]) -> str:
    """Return the force or mass that explains the accelerations if wrong by a factor, or ""."""
    candidates: dict[str, list[tuple[Array, Array]]] = {}
    significant = False
    for sample in samples:
        state = sample.t, sample.q, sample.v
        M, Q = sample.problem.mass(*state[:2]), sample.problem.force(*state)
        residual, inertial_force = sample.free @ (M @ sample.a - Q), np.diag(M) * sample.a
        significant |= bool(np.linalg.norm(residual) > SIGNIFICANT * np.linalg.norm(M, 2) * sample.doubt)
        candidates.setdefault("the forces are", []).append((residual, sample.free @ Q))
        candidates.setdefault(DAMPING, []).append((residual, sample.free @ sample.v))
        for k, kind in enumerate(sample.problem.coordinates):
            candidates.setdefault(f"the force on q[{k}] ({kind}) is", []).append((residual, sample.free[:, k] * Q[k]))
            candidates.setdefault(f"the mass or inertia of q[{k}] ({kind}) is", []).append(
                (residual, -sample.free[:, k] * inertial_force[k])
            )
    residuals: dict[str, float] = {}
    for name, terms in candidates.items() if significant else ():
        residual, term = (np.concatenate(parts) for parts in zip(*terms, strict=True))
        if term.any():
            factor = float(residual @ term / (term @ term))
            remaining = float(np.linalg.norm(residual - factor * term) / np.linalg.norm(residual))
            if remaining < FIT_RESIDUAL:
                size = f"{factor:.2g} v" if name == DAMPING else _factor_text(1.0 + factor)
                residuals[f"{name} {size}"] = remaining
    # force and mass of a free coordinate are equivalent: name all factors that fit, the force first
    smallest = min(residuals.values(), default=0.0)
    return ", or ".join(name for name, remaining in residuals.items() if remaining <= smallest + TIE)


def _factor_text(factor: float) -> str:
    texts = {0.0: "left out", -1.0: "of the other sign"}
    text = next((word for value, word in texts.items() if abs(factor - value) < FIT_RESIDUAL), "")
    if not text and abs(factor - 1.0) < 0.1:
        return f"{100.0 * abs(factor - 1.0):.2g} % too {'large' if factor > 1.0 else 'small'}"
    return text or f"{factor:.3g} times as large as given"


def _try_mistake(mistake: Mistake, problem: KnownProblem, t: float, q: Array, v: Array) -> Array:
    try:
        return mistake(problem, t, q, v)
    except np.linalg.LinAlgError:
        return np.full(q.size, np.nan)


def _start_indices(problem: KnownProblem) -> list[int]:
    """Return three start times, away from singular positions, after which most mistakes are visible."""
    motion = problem.reference
    assert motion is not None
    visible = {}
    for k in START_INDICES:
        t, q, v = motion.t[k + N_LATER], motion.q[k + N_LATER], motion.v[k + N_LATER]
        if any(motion.t[k] - 0.03 * t < singular < 1.03 * t for singular in problem.singular_times):
            continue
        restarted = restart_at(problem, k, N_LATER + 1)
        exact = restarted.acceleration(t, q, v)[0]
        changes = [np.abs(_try_mistake(mistake, restarted, t, q, v) - exact).max() for mistake in MISTAKES.values()]
        visible[k] = sum(change > 0.1 * np.abs(exact).max() for change in changes)
    return sorted(visible, key=lambda k: -visible[k])[:3]


def _observe(simulate: Simulate, problem: KnownProblem, setting: float, by_steps: bool) -> ObservedAcceleration | None:
    """Return a state near the end of a run and its acceleration by differences; None if the run fails."""
    first, last = problem.t_span
    interval = (last - first) / (N_LATER + 1)
    step = 0.125 * interval
    times = first + interval * N_LATER + step * np.arange(-2.0, 3.0)
    try:
        run = run_simulator(simulate, problem, np.concatenate([[first], times]), step if by_steps else setting)
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
