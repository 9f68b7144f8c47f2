"""Errors of runs relative to the known motion, and the limits for a tolerance or step size."""

from dataclasses import dataclass

import numpy as np

from twoloop.testing.known_problem import Array, KnownProblem, Motion, Quantity
from twoloop.testing.simulated import Simulated

SAFETY = 1000.0  # allowed global error in tolerances (which apply per step), times the growth of perturbations
MOST = 0.3  # largest error allowed at any tolerance
HELD = 10.0  # allowed position constraint violation, in tolerances
HELD_RATES = 100.0  # allowed velocity constraint violation, in tolerances
HELD_BY_STEPS = 1e-8  # allowed position constraint violation with fixed steps
ROUNDING = 1e-9  # with fixed steps, times the growth: smaller errors are not compared
UNRESOLVED = 1e-2  # error allowed for steps that do not resolve a stiff vibration
LAM_DIGITS = 6.0  # digits of the known multipliers required for a comparison


@dataclass(frozen=True)
class Settings:
    """Tolerances, or numbers of equal steps over the span, from the coarsest to the finest; seconds of a run."""

    tolerances: tuple[float, ...] | None
    steps: tuple[int, ...] | None
    order: float | None
    time_limit: float | None

    def of(self, problem: KnownProblem) -> list[float]:
        """Return the settings for the simulator: tolerances, or step sizes, s."""
        if self.tolerances is not None:
            return list(self.tolerances)
        assert self.steps is not None
        return [(problem.t_span[1] - problem.t_span[0]) / n for n in self.steps]


@dataclass(frozen=True, eq=False)
class Observed:
    """The completed runs of a problem, from the coarsest to the finest, with their settings."""

    problem: KnownProblem
    motion: Motion
    settings: list[float]
    runs: list[Simulated]

    def errors(self, kind: str) -> list[Array]:
        """Return the errors (n_t,) of "q" or "v" of each run, relative to the largest value of the motion."""
        scale = dict(zip("qv", self.motion.scales, strict=True))[kind]
        known = getattr(self.motion, kind)
        return [np.abs(getattr(run, kind) - known).max(axis=1) / scale for run in self.runs]

    @property
    def rounding(self) -> Array:
        """Return the errors (n_t,) attributed to rounding in fixed-step runs."""
        stiff = UNRESOLVED if "stiff" in self.problem.tags else 0.0
        return ROUNDING * self.motion.growth + stiff

    def floor(self, kind: str) -> Array:
        """Return the smallest meaningful errors (n_t,): accuracy of the reference and amplified rounding."""
        return 10.0 * 10.0 ** -self.motion.digits[kind] + 0.1 * ROUNDING * self.motion.growth


def allowed(motion: Motion, tolerance: float) -> Array:
    """Return the largest allowed error (n_t,) at a tolerance, without the floor."""
    return np.minimum(MOST, SAFETY * tolerance * motion.growth)


def violations(problem: KnownProblem, run: Simulated, scales: tuple[float, float]) -> tuple[Array, Array | None]:
    """Return the distances (n_t,) of q and v from the constraints, relative to the largest values of the motion."""
    off, rates = np.zeros(run.t.size), np.zeros(run.t.size)
    for k, (t, q) in enumerate(zip(run.t, run.q, strict=True)):
        J = problem.jacobian(t, q)
        values = [problem.constraint(t, q)]
        if run.v is not None:
            values.append(J @ run.v[k] + problem.constraint_rate(t, q))
        # scaled rows, so that the rank does not depend on units; near singular positions only the correctable part
        size = np.linalg.norm(J, axis=1)
        size = np.where(size > 0.0, size, 1.0)[:, None]
        moved = np.linalg.lstsq(J / size, np.column_stack(values) / size, rcond=1e-6)[0]
        off[k] = np.abs(moved[:, 0]).max() / scales[0]
        if run.v is not None:
            rates[k] = np.abs(moved[:, 1]).max() / scales[1]
    return off, None if run.v is None else rates


def drifts(problem: KnownProblem, quantity: Quantity, run: Simulated, motion: Motion) -> Array:
    """Return the change (n_t,) of an invariant relative to the range of the kinetic energy, or to the invariant."""
    assert run.v is not None
    values = np.array([quantity(*state) for state in zip(run.t, run.q, run.v, strict=True)])
    known = quantity(problem.t_span[0], problem.q0, problem.v0)
    if quantity is not problem.energy:
        return np.abs(values - known) / max(abs(known), 1e-12)
    states = zip(motion.t, motion.q, motion.v, strict=True)
    return np.abs(values - known) / max(0.5 * v @ problem.mass(t, q) @ v for t, q, v in states)


def forces_of_constraints(problem: KnownProblem, motion: Motion, lam: Array) -> Array:
    """Return C_q^T lam (n_t, n_q) on the known motion, unique even if the multipliers are not."""
    states = zip(motion.t, motion.q, lam, strict=True)
    return np.array([problem.jacobian(t, q).T @ own for t, q, own in states])


def lam_errors(observed: Observed) -> list[Array]:
    """Return the relative errors (n_t,) of the constraint forces of each run; 0 where they are unknown."""
    problem, motion = observed.problem, observed.motion
    known = forces_of_constraints(problem, motion, motion.lam)
    scale = max(1e-12, np.abs(known).max())
    told = motion.digits["lam"] > LAM_DIGITS
    told[0] = False  # many simulators have no multipliers at the start
    found = [forces_of_constraints(problem, motion, run.lam) for run in observed.runs if run.lam is not None]
    return [np.where(told, np.abs(forces - known).max(axis=1) / scale, 0.0) for forces in found]


def order(coarse: Array, fine: Array, ratio: float, floor: Array) -> float | None:
    """Return the observed order from errors (n_t,) of two runs, at times where both are above rounding and below 1."""
    usable = np.logical_and.accumulate(coarse < 0.1) & (np.maximum.accumulate(fine) > 10.0 * floor)
    if not usable.any() or fine[usable].max() == 0.0:
        return None
    return float(np.log(coarse[usable].max() / fine[usable].max()) / np.log(ratio))


def still_there(errors: list[Array], changes: list[Array], floor: Array) -> tuple[float, float]:
    """Return an error of the finest run and its limit: three times the change by the last refinement.

    Errors much smaller than the largest are ignored, because they may be zero crossings.
    """
    rest = np.maximum(3.0 * np.maximum.accumulate(changes[-1]), floor)
    worst = int(np.argmax(np.where(errors[-1] > 0.1 * errors[-1].max(), errors[-1] / rest, 0.0)))
    return float(errors[-1][worst]), float(rest[worst])
