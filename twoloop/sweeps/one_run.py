"""One run of a sweep: the problem, its solution and its row."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

from twoloop.checks.arguments import shown
from twoloop.result.result import Result
from twoloop.run.record import Status
from twoloop.solve import solve_dae
from twoloop.sweeps.cells import OWN, Row, check_measured, failed

if TYPE_CHECKING:
    from twoloop.problem.problem import Problem

Work = tuple[Callable[..., Any], Callable[..., Any], dict[str, Any]]  # problem_of, measure, options


def ends(problem: Problem, result: Result) -> dict[str, Any]:
    """Return the default measures of a sweep: last time, steps, evaluations and the largest energy error.

    The energy error is NaN unless the problem declares its energy an invariant.

    Examples
    --------
    >>> from twoloop import solve_dae
    >>> from twoloop.mechanisms import four_bar
    >>> problem = four_bar()
    >>> result = solve_dae(problem.system, (0.0, 1.0), problem.q0, problem.v0)
    >>> from twoloop.sweeps.one_run import ends
    >>> measures = ends(problem, result)
    >>> "energy_error" in measures
    True
    """
    energy = result.energy if problem.conserved and result.t.size else np.array([np.nan])
    return {
        "t": result.t[-1] if result.t.size else np.nan,
        "n_accepted": result.stats.n_accepted,
        "n_evaluations": result.stats.n_evaluations,
        "energy_error": float(np.abs(energy - energy[0]).max()),
    }


def problem_for(work: Work, given: Row) -> Problem:
    """The problem of a run; raises what `problem_of` raises, and TypeError unless it is a problem."""
    problem = work[0](**given)
    if not hasattr(problem, "system"):
        raise TypeError(f"problem_of must return a Problem; it returned {shown(problem)}")
    return problem  # type: ignore[no-any-return]


def call_of(work: Work, problem: Problem) -> dict[str, Any]:
    """The arguments of `solve_dae` beside the system."""
    return {"t_span": problem.t_span, "q0": problem.q0, "v0": problem.v0, **work[2]}


def solved(work: Work, problem: Problem, **more: float) -> Result:
    """The result of a run; raises KeyboardInterrupt where that ended it."""
    result = solve_dae(problem.system, **call_of(work, problem) | more)
    if result.status is Status.INTERRUPTED:
        raise KeyboardInterrupt
    return result


def one_run(work: Work, given: Row, solve: Callable[[Work, Problem], Result] = solved, first: bool = False) -> Row:
    """The columns of a run other than its parameters; errors are rows, but that of the `first` is raised."""
    began = time.perf_counter()
    try:
        problem = problem_for(work, given)
        result = solve(work, problem)
        row = {"status": result.status.name, "message": result.message, "seconds": time.perf_counter() - began}
        return row | check_measured(work[1](problem, result), {*given, *OWN, "run"})
    except (Exception, SystemExit) as error:
        if first and not isinstance(error, ValueError):
            raise
        return failed(f"{type(error).__name__}: {error}", time.perf_counter() - began)
