"""Measure the properties of a simulator on one problem, relative to the known motion; findings and their report."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from twoloop.testing.problem import Array, KnownProblem, Motion, Quantity, SimulatorRun, Transformed, to_original


@dataclass(frozen=True)
class Finding:
    """Outcome for one property of a simulator on a problem.

    Attributes
    ----------
    problem, property : str
    measured : float or str
        A number, or a description.
    allowed : float or str
        Largest number that passes (for an order, the smallest), or the required outcome.
    passed : bool
    hint : str
        Likely cause; empty if passed.

    Examples
    --------
    >>> import numpy as np
    >>> from twoloop.testing import check_simulator
    >>> def simulate(problem, times, tolerance):
    ...     rows = np.tile(problem.q0, (len(times), 1))  # a simulator that does not move
    ...     return rows
    >>> report = check_simulator(simulate, "pendulum", tolerances=(1e-4, 1e-6))
    >>> finding = report.findings[0]
    >>> finding.problem, isinstance(finding.passed, bool)
    ('pendulum', True)
    """

    problem: str
    property: str
    measured: float | str
    allowed: float | str
    passed: bool
    hint: str = ""

    def __str__(self) -> str:
        return f"{self.problem}: {self.property}: {outcome_text(self)}. {self.hint}".rstrip()


@dataclass(frozen=True)
class Report:
    """Outcome of `check_simulator`.

    Attributes
    ----------
    findings : tuple of Finding
        All properties of all problems, passed or failed.
    skipped : tuple of (str, str, str)
        Problem, property and the reason why it was not measured.

    Examples
    --------
    >>> import numpy as np
    >>> from twoloop.testing import check_simulator
    >>> def simulate(problem, times, tolerance):
    ...     rows = np.tile(problem.q0, (len(times), 1))  # a simulator that does not move
    ...     return rows
    >>> report = check_simulator(simulate, "pendulum", tolerances=(1e-4, 1e-6))
    >>> report.passed, len(report.failures) > 0
    (False, True)
    """

    findings: tuple[Finding, ...]
    skipped: tuple[tuple[str, str, str], ...] = ()

    @property
    def passed(self) -> bool:
        """True if all measured properties passed."""
        return not self.failures

    @property
    def failures(self) -> tuple[Finding, ...]:
        """The failed properties, in the order of the problems."""
        return tuple(finding for finding in self.findings if not finding.passed)

    def __str__(self) -> str:
        names = _unique(finding.problem for finding in self.findings)
        lines = [f"{len(self.findings)} properties on {len(names)} problems: {_verdict(len(self.failures))}"]
        for name in names:
            findings = [finding for finding in self.findings if finding.problem == name]
            failed = [finding for finding in findings if not finding.passed]
            lines.append(f"  {name}: {'passed' if not failed else f'{len(failed)} of {len(findings)} failed'}")
            lines += [f"    {finding.property}: {outcome_text(finding)}" for finding in failed]
            lines += [f"    -> {hint}" for hint in _unique(finding.hint for finding in failed if finding.hint)]
        return "\n".join(lines)

    def to_markdown(self) -> str:
        """Return the report as Markdown tables: failures with hints, then all measured properties."""
        lines = [f"# Simulator check: {_verdict(len(self.failures))}", ""]
        if self.failures:
            lines += ["| problem | property | measured | allowed | hint |", "|---|---|--:|--:|---|"]
            lines += [*(_table_row(failure, failure.hint) for failure in self.failures), ""]
        lines += ["| problem | property | measured | allowed | |", "|---|---|--:|--:|---|"]
        for finding in self.findings:
            verdict = "passed" if finding.passed else "**failed**"
            lines.append(_table_row(finding, verdict))
        for problem, name, reason in self.skipped:
            lines.append(_table_row(Finding(problem, name, "not measured", "", False), reason))
        return "\n".join(lines) + "\n"


def _table_row(row: Finding, last: str) -> str:
    cells = (row.problem, row.property, _format_value(row.measured), _format_value(row.allowed), last)
    return "| " + " | ".join(cell.replace("|", "\\|").replace("\n", " ") for cell in cells) + " |"


def outcome_text(row: Finding) -> str:
    """Return the measured and the allowed value as text."""
    return f"{_format_value(row.measured)}, allowed {_format_value(row.allowed)}"


def _verdict(n_failures: int) -> str:
    return "all hold" if n_failures == 0 else f"{n_failures} do{'es' * (n_failures == 1)} not hold"


def _unique(names: Iterable[str]) -> list[str]:
    return list(dict.fromkeys(names))


def _format_value(value: float | str) -> str:
    """Return a number with three digits, or a text unchanged."""
    return value if isinstance(value, str) else f"{value:.3g}"


ERROR_FACTOR = 1000.0  # allowed global error in tolerances (which apply per step), times the growth of perturbations
MAX_ERROR = 0.3  # largest error allowed at any tolerance
POSITION_FACTOR = 10.0  # allowed position constraint violation, in tolerances
VELOCITY_FACTOR = 100.0  # allowed velocity constraint violation, in tolerances
STEP_VIOLATION = 1e-8  # allowed position constraint violation with fixed steps
ROUNDING = 1e-9  # with fixed steps, errors below this number times the growth of perturbations are not compared
UNRESOLVED = 1e-2  # error allowed for steps that do not resolve a stiff vibration
LAM_DIGITS = 6.0  # digits of the known multipliers required for a comparison
LEAST_ORDER = 0.7  # required order if none is given
UNUSED_SHARE = 0.01  # if the last tolerance changes nothing, only this fraction of the allowed error is allowed at it
ORDER_SLACK = 0.6  # tolerance of the observed order


@dataclass(frozen=True)
class Settings:
    """Tolerances, or numbers of equal steps over the span, from the coarsest to the finest; seconds of a run."""

    tolerances: tuple[float, ...] | None
    steps: tuple[int, ...] | None
    order: float | None
    time_limit: float | None

    def values(self, problem: KnownProblem) -> list[float]:
        """Return the settings for the simulator: tolerances, or step sizes, s."""
        if self.tolerances is not None:
            return list(self.tolerances)
        assert self.steps is not None
        return [(problem.t_span[1] - problem.t_span[0]) / n for n in self.steps]


@dataclass(frozen=True, eq=False)
class Observation:
    """The completed runs of a problem, from the coarsest to the finest, with their settings."""

    problem: KnownProblem
    motion: Motion
    settings: list[float]
    runs: list[SimulatorRun]

    def errors(self, kind: str) -> list[Array]:
        """Return the errors (n_t,) of "q" or "v" of each run, relative to the largest value of the motion."""
        scale = dict(zip("qv", self.motion.scales, strict=True))[kind]
        reference = getattr(self.motion, kind)
        return [np.abs(getattr(run, kind) - reference).max(axis=1) / scale for run in self.runs]

    @property
    def rounding(self) -> Array:
        """Return the errors (n_t,) attributed to rounding in fixed-step runs."""
        stiff = UNRESOLVED if "stiff" in self.problem.tags else 0.0
        return ROUNDING * self.motion.growth + stiff

    def floor(self, kind: str) -> Array:
        """Return the smallest meaningful errors (n_t,): accuracy of the reference and amplified rounding."""
        return 10.0 * 10.0 ** -self.motion.digits[kind] + 0.1 * ROUNDING * self.motion.growth


def error_limit(motion: Motion, tolerance: float) -> Array:
    """Return the largest allowed error (n_t,) at a tolerance, without the floor."""
    return np.minimum(MAX_ERROR, ERROR_FACTOR * tolerance * motion.growth)


def constraint_violations(
    problem: KnownProblem, run: SimulatorRun, scales: tuple[float, float]
) -> tuple[Array, Array | None]:
    """Return the distances (n_t,) of q and v from the constraints, relative to the largest values of the motion."""
    distances, velocity_distances = np.zeros(run.t.size), np.zeros(run.t.size)
    for k, (t, q) in enumerate(zip(run.t, run.q, strict=True)):
        J = problem.jacobian(t, q)
        values = [problem.constraint(t, q)]
        if run.v is not None:
            values.append(J @ run.v[k] + problem.constraint_rate(t, q))
        # scaled rows, so that the rank does not depend on units; near singular positions, only the part that C_q spans
        size = np.linalg.norm(J, axis=1)
        size = np.where(size > 0.0, size, 1.0)[:, None]
        corrections = np.linalg.lstsq(J / size, np.column_stack(values) / size, rcond=1e-6)[0]
        distances[k] = np.abs(corrections[:, 0]).max() / scales[0]
        if run.v is not None:
            velocity_distances[k] = np.abs(corrections[:, 1]).max() / scales[1]
    return distances, None if run.v is None else velocity_distances


def invariant_drifts(problem: KnownProblem, quantity: Quantity, run: SimulatorRun, motion: Motion) -> Array:
    """Return the change (n_t,) of an invariant relative to the range of the kinetic energy, or to the invariant."""
    assert run.v is not None
    values = np.array([quantity(*state) for state in zip(run.t, run.q, run.v, strict=True)])
    initial = quantity(problem.t_span[0], problem.q0, problem.v0)
    if quantity is not problem.energy:
        return np.abs(values - initial) / max(abs(initial), 1e-12)
    states = zip(motion.t, motion.q, motion.v, strict=True)
    return np.abs(values - initial) / max(0.5 * v @ problem.mass(t, q) @ v for t, q, v in states)


def constraint_forces(problem: KnownProblem, motion: Motion, lam: Array) -> Array:
    """Return C_q^T lam (n_t, n_q) on the known motion, unique even if the multipliers are not."""
    states = zip(motion.t, motion.q, lam, strict=True)
    return np.array([problem.jacobian(t, q).T @ multipliers for t, q, multipliers in states])


def multiplier_errors(observed: Observation) -> list[Array]:
    """Return the relative errors (n_t,) of the constraint forces of each run; 0 if these forces are unknown."""
    problem, motion = observed.problem, observed.motion
    reference = constraint_forces(problem, motion, motion.lam)
    scale = max(1e-12, np.abs(reference).max())
    comparable = motion.digits["lam"] > LAM_DIGITS
    comparable[0] = False  # many simulators have no multipliers at the start
    run_forces = [constraint_forces(problem, motion, run.lam) for run in observed.runs if run.lam is not None]
    return [np.where(comparable, np.abs(forces - reference).max(axis=1) / scale, 0.0) for forces in run_forces]


def convergence_order(coarse: Array, fine: Array, ratio: float, floor: Array) -> float | None:
    """Return the observed order from errors (n_t,) of two runs, at times where both are above rounding and below 1."""
    usable = np.logical_and.accumulate(coarse < 0.1) & (np.maximum.accumulate(fine) > 10.0 * floor)
    if not usable.any() or fine[usable].max() == 0.0:
        return None
    return float(np.log(coarse[usable].max() / fine[usable].max()) / np.log(ratio))


def remaining_error(errors: list[Array], changes: list[Array], floor: Array) -> tuple[float, float]:
    """Return an error of the finest run and its limit: three times the change by the last refinement.

    Errors much smaller than the largest are ignored, because they may be zero crossings.
    """
    limit = np.maximum(3.0 * np.maximum.accumulate(changes[-1]), floor)
    worst = int(np.argmax(np.where(errors[-1] > 0.1 * errors[-1].max(), errors[-1] / limit, 0.0)))
    return float(errors[-1][worst]), float(limit[worst])


def measure_properties(observed: Observation, settings: Settings) -> Iterator[Finding]:
    """Yield all properties that can be measured on these runs."""
    finest = observed.runs[-1]
    kinds = ["q"] if finest.v is None else ["q", "v"]
    for kind in kinds:
        yield from (tolerance_findings if settings.tolerances else step_findings)(observed, settings, kind)
    if settings.tolerances and settings.tolerances[-1] < float(np.finfo(np.float32).eps):
        states = [array[1:] for array in (finest.q, finest.v) if array is not None]  # the start may be exact
        single = all(np.array_equal(array, array.astype(np.float32)) for array in states)
        yield Finding(observed.problem.name, "precision", "single" if single else "double", "double", not single)
    yield from constraint_findings(observed, settings)
    if finest.v is not None:
        problem = observed.problem
        invariants = dict(problem.invariants) | ({} if problem.energy is None else {"energy": problem.energy})
        for name, quantity in invariants.items():
            yield invariant_finding(observed, settings, name, quantity)
    if finest.lam is not None:
        yield multiplier_finding(observed, settings)


def _worst_finding(name: str, observed: Observation, errors: list[Array], limits: list[Array]) -> Finding:
    """Return the finding for the time and run with the largest ratio of an error to its limit."""
    ratios = [np.max(run_errors / limit) for run_errors, limit in zip(errors, limits, strict=True)]
    k = int(np.argmax(ratios))
    worst = int(np.argmax(errors[k] / limits[k]))
    value, limit = float(errors[k][worst]), float(limits[k][worst])
    return Finding(observed.problem.name, name, value, limit, value <= limit)


def tolerance_findings(observed: Observation, settings: Settings, kind: str) -> Iterator[Finding]:
    """Yield the error at the tolerance where it is largest relative to its limit."""
    limits = [error_limit(observed.motion, setting) for setting in observed.settings]
    if ignores_last_setting(observed):  # the error must then be far below a last tolerance that changes nothing
        limits[-1] = limits[-1] * UNUSED_SHARE
    limits = [limit + observed.floor(kind) for limit in limits]
    yield _worst_finding(f"error of {kind}", observed, observed.errors(kind), limits)


def ignores_last_setting(observed: Observation) -> bool:
    """Return True if the last two settings give the same numbers."""
    return len(observed.runs) > 1 and np.array_equal(observed.runs[-2].q, observed.runs[-1].q)


def step_findings(observed: Observation, settings: Settings, kind: str) -> Iterator[Finding]:
    """Yield the error with the finest steps, its limit as the steps tend to zero, and the order."""
    name, errors = observed.problem.name, observed.errors(kind)
    largest, floor = float(errors[-1].max()), observed.rounding + observed.floor(kind)
    yield Finding(name, f"error of {kind}", largest, MAX_ERROR, largest <= MAX_ERROR)
    if largest > MAX_ERROR:
        return
    changes = refinement_changes(observed, kind)
    value, limit = remaining_error(errors, changes, floor)
    yield Finding(name, f"limit of {kind}", value, limit, value <= limit)
    order = observed_order(observed, kind)
    if order is not None:
        required = LEAST_ORDER if settings.order is None else settings.order - ORDER_SLACK
        yield Finding(name, f"order of {kind}", order, required, order >= required)


def refinement_changes(observed: Observation, kind: str) -> list[Array]:
    """Return the changes (n_t,) from each setting to the next, relative to the largest value of the motion."""
    scale = dict(zip("qv", observed.motion.scales, strict=True))[kind]
    values = [getattr(run, kind) for run in observed.runs]
    return [np.abs(fine - coarse).max(axis=1) / scale for coarse, fine in pairwise(values)]


def observed_order(observed: Observation, kind: str) -> float | None:
    """Return the order of the errors over the last refinement, or if the limit is wrong, the order of the changes."""
    floor = observed.rounding + observed.floor(kind)
    errors, changes, steps = observed.errors(kind), refinement_changes(observed, kind), observed.settings
    value, limit = remaining_error(errors, changes, floor)
    if value <= limit:
        return convergence_order(errors[-2], errors[-1], steps[-2] / steps[-1], floor)
    return convergence_order(changes[-2], changes[-1], steps[-2] / steps[-1], floor) if len(changes) > 1 else None


def constraint_findings(observed: Observation, settings: Settings) -> Iterator[Finding]:
    """Yield the distances of positions and velocities from the constraints.

    With fixed steps, distances of velocities may also vanish with the step size, as in methods that only enforce C = 0.
    """
    violations = [constraint_violations(observed.problem, run, observed.motion.scales) for run in observed.runs]
    floor = 10.0 * 10.0 ** -observed.motion.digits["q"] + 1e-12
    if settings.tolerances:
        limits = [POSITION_FACTOR * setting + floor for setting in observed.settings]
        yield _worst_finding("constraints", observed, [violation[0] for violation in violations], limits)
    else:
        yield _worst_finding("constraints", observed, [violations[-1][0]], [STEP_VIOLATION + floor])
    rates = [violation[1] for violation in violations if violation[1] is not None]
    if rates and settings.tolerances:
        limits = [VELOCITY_FACTOR * setting + 10.0 * floor for setting in observed.settings]
        yield _worst_finding("velocity constraints", observed, rates, limits)
    elif rates:
        converging = rates[-2].max() > 2.0**LEAST_ORDER * rates[-1].max()
        limit = np.full(floor.shape, MAX_ERROR) if converging else STEP_VIOLATION + observed.rounding
        yield _worst_finding("velocity constraints", observed, [rates[-1]], [limit])


def invariant_finding(observed: Observation, settings: Settings, name: str, quantity: Quantity) -> Finding:
    """Return the drift of the energy, or of another invariant."""
    motion = observed.motion
    run_drifts = [invariant_drifts(observed.problem, quantity, run, motion) for run in observed.runs]
    floor = 10.0 * (observed.floor("q") + observed.floor("v"))
    if settings.tolerances:
        limits = [3.0 * error_limit(motion, setting) + floor for setting in observed.settings]
        return _worst_finding(name, observed, run_drifts, limits)
    return _convergence_finding(observed, name, run_drifts, floor + observed.rounding)


def multiplier_finding(observed: Observation, settings: Settings) -> Finding:
    """Return the errors of C_q^T lam."""
    errors, motion = multiplier_errors(observed), observed.motion
    floor = observed.floor("v") + 10.0 * 10.0 ** -motion.digits["lam"]
    if settings.tolerances:
        limits = [
            np.minimum(MAX_ERROR, 10.0 * error_limit(motion, setting) + np.sqrt(setting)) + floor
            for setting in observed.settings
        ]
        return _worst_finding("multipliers", observed, errors, limits)
    floor = np.minimum(MAX_ERROR, floor + 1e3 * ROUNDING * motion.growth + observed.rounding)
    return _convergence_finding(observed, "multipliers", errors, floor)


def _convergence_finding(observed: Observation, name: str, errors: list[Array], floor: Array) -> Finding:
    """Pass if the error of the finest run is at most three times its change by the last refinement."""
    largest = float(errors[-1].max())
    limit = min(MAX_ERROR, max(float(np.max(floor)), 3.0 * float(np.abs(errors[-1] - errors[-2]).max())))
    return Finding(observed.problem.name, name, largest, limit, largest <= limit)


def transformed_finding(
    observed: Observation, settings: Settings, name: str, transformed: Transformed, run: SimulatorRun, setting: float
) -> Finding:
    """Return the error of a run in another frame or other units, compared with the error of the original run."""
    problem, motion = observed.problem, observed.motion
    if not run.complete:
        outcome = run.error or "numbers that are not finite"
        return Finding(problem.name, name, outcome, "a run, as of the original", False)
    original_errors = observed.errors("q")[observed.settings.index(setting)]
    observation = Observation(problem, motion, [setting], [to_original(run, transformed)])
    if settings.tolerances:
        limit = np.maximum(error_limit(motion, setting), 10.0 * original_errors.max()) + observed.floor("q")
    else:
        limit = 30.0 * np.maximum.accumulate(original_errors) + 1e-6 + observed.rounding
    return _worst_finding(name, observation, observation.errors("q"), [limit])
