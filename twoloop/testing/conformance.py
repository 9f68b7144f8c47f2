"""Conformance check of simulators of mechanisms against known motions."""

import threading
from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from twoloop.checks.arguments import check_call, shown
from twoloop.testing.hints import MOTION_PROPERTIES, Evidence, add_hints
from twoloop.testing.mechanisms import N_TIMES, as_list, select_problems
from twoloop.testing.problem import (
    KnownProblem,
    Motion,
    Simulate,
    SimulatorRun,
    TimeLimitedSimulator,
    change_frame,
    change_units,
    run_simulator,
)
from twoloop.testing.properties import Finding, Observation, Report, Settings, measure_properties, transformed_finding

Skipped = tuple[str, str, str]
TIME_LIMIT = 120.0  # s
REPORTS_END = "says that it ends"
UNBOUNDED_HINT = (
    "An iteration, or a step size that falls, has no bound: limit the numbers of iterations and of steps, and raise."
)
FALSE_SUCCESS_HINT = (
    "Success with a wrong answer: the motion has ended. Check that iterations converge, that C = 0 holds at the end of "
    "a step, and that numbers are finite; otherwise raise."
)
REDUNDANT_HINT = (
    "A row of C depends on the others here, and [M C_q^T; C_q 0] is singular: use least squares or remove such rows; "
    "for a simulator that does not support them, exclude this problem."
)
TRANSFORMATIONS = {"frame": change_frame, "units": change_units}


def check_simulator(
    simulate: Simulate,
    problems: str | KnownProblem | Iterable[str | KnownProblem] = "smoke",
    *,
    tolerances: Sequence[float] = (1e-4, 1e-6, 1e-8),
    steps: Sequence[int] | None = None,
    order: float | None = None,
    time_limit: float | None = TIME_LIMIT,
) -> Report:
    """Run a simulator of mechanisms on problems with known motions, and report the properties that fail.

    Parameters
    ----------
    simulate : callable
        simulate(problem, times, tolerance) -> q (n_t, n_q), or (q, v), or (q, v, lam) with lam (n_t, n_c) of
        M a + C_q^T lam = Q: one row for each of the `times` (n_t,), s, the first of which is the start. If the
        simulator fails, it raises any exception, or returns NaN from there on. `problem` is a `KnownProblem`.
    problems : {"smoke", "all"}, str, or sequence of str and KnownProblem
        A quick selection, all problems, or those named (`twoloop.testing.problems`).
    tolerances : sequence of float
        Tolerances in decreasing order.
    steps : sequence of int, optional
        For fixed-step simulators, instead of `tolerances`: numbers of steps over the span of each problem, multiples of
        100, so that steps end at the times. `simulate` then gets the step size, s.
    order : float, optional
        With `steps`: the order of the method. None: an observed order of 0.7 or more passes.
    time_limit : float, optional
        Wall-clock time of a run, s; a longer one fails. Runs are made in a thread: one that hangs is stopped as soon as
        it is in Python code, and left behind if it waits elsewhere. Machine code that holds the interpreter's lock
        cannot be stopped. None: no limit, and runs in the calling thread, where a debugger and signals work.

    Returns
    -------
    Report
        `report.passed`, `report.failures` (problem, property, measured, allowed, hint); `print(report)`.

    Raises
    ------
    TypeError, ValueError
        If an argument is out of range, or `simulate` does not return arrays of the expected shape.

    Notes
    -----
    Properties and limits on each problem. Errors are relative to the largest coordinate (velocity) of the motion, or
    1; G is the growth of perturbations up to a time (`Motion.growth`), which allows for errors on chaotic motions.

    - *error of q, v*: with tolerances at most 1000 G times the tolerance, and 0.3; with steps 0.3 at the finest.
    - *limit of q, v* (steps): the error as the steps tend to zero. The error of the finest run is at most three times
      the change by the last refinement; otherwise the model is wrong.
    - *order of q, v* (steps): the observed order of the last refinement, at least `order` - 0.6.
    - *precision* (tolerances below that of single precision): not all states are numbers of single precision.
    - *constraints*, *velocity constraints*: the distances from C = 0 and C_q v + C_t = 0, at most 10 and 100 tolerances
      at all times; with steps 1e-8, or, for velocities, decreasing with the steps.
    - *energy* and other invariants: drift relative to the largest kinetic energy, at most three times the limit for q;
      with steps a limit as above.
    - *multipliers*: relative errors of the forces C_q^T lam, which are unique also with redundant rows.
    - *frame*, *units*: the errors of the same problem in a rotated and translated frame, and in mm and g.
    - *runs*: all tolerances, or the two finest steps, reach the end; coarser runs may report a failure. No run passes
      `time_limit`.
    - *says that it ends*: on problems without a motion beyond some time, an exception or NaN.

    Examples
    --------
    >>> from twoloop.testing import check_simulator
    >>> from my_package.solver import simulate  # doctest: +SKIP
    >>> report = check_simulator(simulate)  # doctest: +SKIP
    >>> assert report.passed, str(report)  # doctest: +SKIP
    """
    if not callable(simulate):
        given = f"{shown(simulate)} of type {type(simulate).__name__}"
        raise TypeError(f"simulate must be a function of (problem, times, tolerance); given {given}")
    check_call("simulate", "simulate", simulate, ("problem", "times", "tolerance" if steps is None else "step"))
    settings = check_settings(tolerances, steps, order, time_limit)
    findings: list[Finding] = []
    skipped: list[Skipped] = []
    for problem in select_problems(problems):
        results, omissions = check_problem(simulate, problem, settings)
        findings += results
        skipped += omissions
    return Report(tuple(findings), tuple(skipped))


def check_settings(
    tolerances: Sequence[float], steps: Sequence[int] | None, order: float | None, time_limit: float | None
) -> Settings:
    """Return the validated settings of a check."""
    if time_limit is not None and not (_number(time_limit) and 0.0 < time_limit < threading.TIMEOUT_MAX):
        raise ValueError(f"time_limit must be a positive number of seconds, or None; given {time_limit!r}")
    if order is not None and not (_number(order) and order > 0.0):
        raise ValueError(f"order must be a positive number; given {order!r}")
    if steps is not None:
        given = as_list("steps", steps)
        whole = all(isinstance(n, int | np.integer) and n > 0 and n % (N_TIMES - 1) == 0 for n in given)
        if not whole or len(given) < 2 or given != sorted(set(given)):
            raise ValueError(
                f"steps must be two or more increasing numbers, each a multiple of {N_TIMES - 1}; given {steps!r}"
            )
        return Settings(None, tuple(given), order, time_limit)
    if order is not None:
        raise ValueError(f"order is for simulators of fixed steps, with steps=; given {order!r} without")
    values = as_list("tolerances", tolerances)
    if not values or not all(_number(value) and 0.0 < value < 1.0 for value in values):
        raise ValueError(f"tolerances must be numbers between 0 and 1; given {tolerances!r}")
    if values != sorted(set(values), reverse=True):
        raise ValueError(f"tolerances must fall from the first to the last; given {tolerances!r}")
    return Settings(tuple(float(value) for value in values), None, None, time_limit)


def _number(value: Any) -> bool:
    return isinstance(value, int | float | np.integer | np.floating) and not isinstance(value, bool)


def check_problem(simulate: Simulate, problem: KnownProblem, settings: Settings) -> tuple[list[Finding], list[Skipped]]:
    """Return the findings for all properties of one problem, and the properties that were not measured."""
    values, motion = settings.values(problem), problem.reference
    limited = TimeLimitedSimulator(simulate, settings.time_limit)
    if problem.ends is not None:
        return [_ending_finding(limited, problem, values[-1])], []
    if motion is None:
        raise ValueError(f"problems must have a known motion; {problem.name!r} has no reference")
    runs = [run_simulator(limited, problem, motion.t, value) for value in values]
    findings = [_completion_finding(problem, settings, values, runs)]
    complete = [(value, run) for value, run in zip(values, runs, strict=True) if run.complete]
    if not findings[0].passed:
        hint = UNBOUNDED_HINT if limited.timeout_message else _hint_from_start(limited, problem, settings, values)
        return [replace(findings[0], hint=hint)], [(problem.name, "everything else", "the run did not come to the end")]
    if len({(run.v is None, run.lam is None) for _, run in complete}) > 1:
        raise TypeError(f"simulate must return the same of q, v and lam in every run; on {problem.name!r} it did not")
    observation = Observation(problem, motion, *map(list, zip(*complete, strict=True)))
    findings += confirm_orders(limited, observation, settings, list(measure_properties(observation, settings)))
    skipped: list[Skipped] = []
    middle = observation.settings[len(observation.settings) // 2]
    for name, change in TRANSFORMATIONS.items():
        if any(not finding.passed and finding.property in ("error of q", "limit of q") for finding in findings):
            skipped.append((problem.name, name, "the motion itself is wrong"))
            continue
        if limited.timeout_message:
            skipped.append((problem.name, name, "a run before it did not end"))
            continue
        transformed = change(problem)
        run = run_simulator(limited, transformed.problem, motion.t, middle)
        findings.append(transformed_finding(observation, settings, name, transformed, run, middle))
    failed = {finding.property: finding for finding in findings if not finding.passed}
    return add_hints(findings, Evidence(observation, settings, failed, limited)), skipped


def confirm_orders(
    simulate: Simulate, observation: Observation, settings: Settings, findings: list[Finding]
) -> list[Finding]:
    """Return the findings after a second measurement, with steps of half the length, of orders that are too small.

    Errors may vanish by chance at one step size; then they seem to decrease slowly with smaller steps.
    """
    failed = {finding.property for finding in findings if not finding.passed}
    low_orders = {name for name in failed if name.startswith("order of")}
    if not low_orders:
        return findings
    half = 0.5 * observation.settings[-1]
    run = run_simulator(simulate, observation.problem, observation.motion.t, half)
    if not run.complete:
        return findings
    finer = replace(observation, settings=[*observation.settings[1:], half], runs=[*observation.runs[1:], run])
    finer_findings = {finding.property: finding for finding in measure_properties(finer, settings)}
    if not all(finer_findings[name].passed for name in finer_findings if name.startswith(MOTION_PROPERTIES)):
        return findings
    replaced = {name: finding for name, finding in finer_findings.items() if name in low_orders}
    return [replaced.get(finding.property, finding) for finding in findings]


def _hint_from_start(simulate: Simulate, problem: KnownProblem, settings: Settings, values: list[float]) -> str:
    """Return a hint from the first part of a run that does not reach the end."""
    motion = problem.reference
    assert motion is not None
    if "redundant" in problem.tags:
        return REDUNDANT_HINT
    for n in (N_TIMES // 10, 3):
        arrays = {name: getattr(motion, name)[: n + 1] for name in ("t", "q", "v", "lam", "growth")}
        beginning = Motion(**arrays, digits={name: digits[: n + 1] for name, digits in motion.digits.items()})
        try:
            runs = [run_simulator(simulate, problem, beginning.t, value) for value in values]
        except (TypeError, ValueError):  # the simulator accepts no other times than those of the motion
            return ""
        if not all(run.complete and run.v is not None for run in runs):
            continue
        observation = Observation(problem, beginning, values, runs)
        findings = list(measure_properties(observation, settings))
        failed = {finding.property: finding for finding in findings if not finding.passed}
        hinted = add_hints(findings, Evidence(observation, settings, failed, simulate))
        hint = next((finding.hint for finding in hinted if finding.hint), "")
        return f"Of the first {beginning.t[-1] - beginning.t[0]:.2g} s, which it does run: {hint}" if hint else ""
    return ""


def property_names(problem: KnownProblem, settings: Settings) -> list[str]:
    """Return the names of the properties measured on a problem for a simulator that returns q, v and lam."""
    if problem.ends is not None:
        return [REPORTS_END]
    kinds = ("error of",) if settings.tolerances else ("error of", "limit of", "order of")
    names = ["runs", *(f"{kind} {variable}" for variable in "qv" for kind in kinds)]
    names += [*(["precision"] if settings.tolerances else []), "constraints", "velocity constraints"]
    invariants = [*problem.invariants, *([] if problem.energy is None else ["energy"])]
    return [*names, *invariants, "multipliers", *TRANSFORMATIONS]


def _completion_finding(
    problem: KnownProblem, settings: Settings, values: list[float], runs: list[SimulatorRun]
) -> Finding:
    """Check that the required runs reach the end: all runs or, with fixed steps, the two finest runs."""
    outcomes = list(zip(values, runs, strict=True))
    required = [outcome for outcome in outcomes if outcome[1].timed_out] or outcomes[0 if settings.tolerances else -2 :]
    for value, run in required:
        if not run.complete:
            problem_text = run.error or _first_nonfinite(run)
            return Finding(problem.name, "runs", f"{problem_text} (at {value:.3g})", "the end of the motion", False)
    return Finding(problem.name, "runs", "the end", "the end of the motion", True)


def _first_nonfinite(run: SimulatorRun) -> str:
    for name, array in (("q", run.q), ("v", run.v), ("lam", run.lam)):
        if array is not None and not np.isfinite(array).all():
            return f"{name} is not finite from t = {run.t[np.argmin(np.isfinite(array).all(axis=1))]:.3g} s on"
    return "no numbers"


def _ending_finding(simulate: Simulate, problem: KnownProblem, setting: float) -> Finding:
    """Check a problem without a motion beyond some time: the simulator must report a failure."""
    assert problem.ends is not None
    run = run_simulator(simulate, problem, np.linspace(*problem.t_span, N_TIMES), setting)
    beyond = run.q[run.t > problem.ends + 1e-9]
    reported = not run.timed_out and (bool(run.error) or not np.isfinite(beyond).all(axis=1).any())
    outcome = run.error or ("NaN" if reported else f"finite numbers to t = {problem.t_span[1]:.3g} s")
    return Finding(
        problem.name,
        REPORTS_END,
        outcome,
        f"an exception, or NaN from t = {problem.ends:.3g} s on",
        reported,
        "" if reported else UNBOUNDED_HINT if run.timed_out else FALSE_SUCCESS_HINT,
    )
