"""What is known of the end of a motion, and a run measured by it: decimals, energy, constraints, right or wrong."""

import warnings

import numpy as np

from studies.bench import metrics
from studies.bench.collector import NOTHING_RUN, Case, Run, called_from, timed
from studies.bench.reference_motion import ReferenceMotion
from studies.bench.store import Array, Row
from twoloop import ConstrainedSystem, Result
from twoloop.mechanisms import Problem, Reference

JUDGED = "judged by the problem's own condition"  # group of runs
TIME_LIMIT = 3.0  # s of a run
INSTANTS = 101  # of solvers that store none of their steps; not a multiple of a half period of any
DECADES = 2  # a run is right within so many decades of its tolerance, where the problem has no condition of its own
EXACT = 1e-3  # what misses its tolerance by more, but is right to this, is inexact and not wrong
LEVELS = ("q", "v", "lam")
SAID = "reported failure"  # outcome of a run that ends with a message


def unknown() -> ReferenceMotion:
    """Stand in for the motion of a case whose end alone is known, and that nothing may ask for."""
    raise NotImplementedError("validation measures at the end of a run")


def case_of(problem: Problem, judged: bool = False) -> Case:
    """To the end of the reference; `judged`: over the time that the problem's own condition asks for."""
    known, rule = problem.reference, problem.condition
    assert known is not None
    t_end, n_instants = (rule.t_end, rule.n_outputs) if judged and rule is not None else (known.t, INSTANTS)
    return Case(
        problem.name, problem, t_end, unknown, n_instants, conserved=problem.conserved, time_limit=TIME_LIMIT, timed=0.0
    )


def truth(problem: Problem, t_end: float) -> Reference:
    """The state known at the end: that of the closed form, where there is one, else the reference."""
    known = problem.reference
    assert known is not None
    if known.t == t_end:
        return known
    assert problem.motion is not None
    q, v = problem.motion(t_end)
    return Reference(t_end, q, v, "closed form", digits=known.digits)


def error(given: Array, known: Array | None) -> float | None:
    """Largest difference over max(1, largest known value); None where none is known."""
    if known is None or given.shape != known.shape or np.isnan(known).all():
        return None
    there = ~np.isnan(known)
    return float(np.abs(given - known)[there].max()) / max(1.0, float(np.abs(known[there]).max()))


def digits(size: float | None, most: float) -> float | None:
    """Decimals that an error leaves right, no more than the reference holds."""
    if size is None or not np.isfinite(size):
        return None
    return min(most, float(-np.log10(max(size, 1e-17))))


def condition_error(run: Run, result: Result) -> float | None:
    """The error by the problem's own rule; None of a run that is not to be judged by it."""
    case, problem = run.case, run.case.problem
    if run.group != JUDGED:
        return None
    assert problem.condition is not None and problem.motion is not None
    motion, times = problem.motion, case.instants

    def states(t: Array) -> tuple[Array, Array]:
        q, v = zip(*(motion(float(each)) for each in t), strict=True)
        return np.array(q).T, np.array(v).T

    dq, dv = metrics.deviation(result, ReferenceMotion(states, 0.0, ""), times)
    q, v = states(times)
    return problem.condition.error(q + dq, v + dv, q, v)


def violations(system: ConstrainedSystem, result: Result) -> dict[str, float]:
    """Largest residuals of the constraints at the end in position, velocity and acceleration, all rows."""
    t, q, v, a = float(result.t[-1]), *(np.ascontiguousarray(x[:, -1]) for x in (result.q, result.v, result.a))
    gammas = ((system.n_c, system.gamma), (system.n_a, system.nonholonomic_gamma))
    bias = np.concatenate([gamma(t, q, v) for n, gamma in gammas if n])
    levels = {"q": system.constraint(t, q) if system.n_c else np.zeros(0), "v": system.velocity_constraint(t, q, v)}
    levels |= {"a": system.rows(t, q) @ a - bias}
    return {f"violation_{level}": float(np.abs(size).max(initial=0.0)) for level, size in levels.items()}


def drift(problem: Problem, result: Result) -> float | None:
    """Largest change of the energy over the largest kinetic energy; None where it is no invariant or nothing moved."""
    if not problem.conserved:
        return None
    t, q, v = result.t, result.q, result.v
    energy = problem.energy(t, q, v)
    kinetic = float((energy - problem.energy(t, q, 0.0 * v)).max())
    if kinetic == 0.0:  # a run that failed at its start
        return None
    return float(np.abs(energy - problem.energy(t[0], problem.q0, problem.v0)).max()) / kinetic


def row_of(run: Run) -> Row:
    """A run, measured by what is known of the end."""
    case, problem = run.case, run.case.problem
    row: Row = {"group": run.group, "case": case.name, "solver": run.solver.name, "family": run.solver.family}
    row |= {"called_from": called_from(run), **run.settings, "t_end": case.t_end}
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        result, status, message, times = timed(run, 0)
    row |= {**times, "status": status, "message": message, "warnings": len(said)}
    row["used"] = run.solver.took(run.value, result)
    for name in ("n_accepted", "n_evaluations"):
        row[name] = None if result is None else getattr(result.stats, name)
    known = truth(problem, case.t_end)
    unknown = [f"{what}_{level}" for what in ("error", "digits") for level in LEVELS]
    row |= dict.fromkeys((*unknown, "energy", "condition", *(f"violation_{level}" for level in "qva")))
    row["floor"] = 10.0 ** -known.digits["q"]
    if result is not None and result.t.size > 1 and np.isfinite(result.q).all():
        row |= {"energy": drift(problem, result), **violations(problem.system, result)}
        if result.success and abs(result.t[-1] - case.t_end) < 1e-9 * case.t_end:
            for level in LEVELS:
                size = error(getattr(result, level)[:, -1], getattr(known, level))
                row[f"error_{level}"] = size
                row[f"digits_{level}"] = digits(size, known.digits.get(level, 0.0))
            row["condition"] = condition_error(run, result)
    return row | {"outcome": outcome(row, problem, run.value)}


def outcome(row: Row, problem: Problem, tolerance: float) -> str:
    """Judge a run: "right", "inexact" or "wrong" if it reached the end, SAID if it did not, or "not run".

    An answer with three digits that misses its tolerance may just mean that the tolerance was too loose. A run that the
    adapter of another solver refuses is "not run", because this says nothing about the solver.
    """
    refused = row["status"] == "RAISED" and row["family"] != "two-loop"
    if refused or row["status"] in NOTHING_RUN:
        return "not run"
    if row["error_q"] is None:
        return SAID
    if row["condition"] is not None and problem.condition is not None:
        return "right" if row["condition"] <= problem.condition.high else "wrong"
    if row["error_q"] <= 10.0**DECADES * max(tolerance, row["floor"]):
        return "right"
    return "inexact" if row["error_q"] <= EXACT else "wrong"
