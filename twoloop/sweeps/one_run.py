"""Solve one run of a sweep and return its row of the table; check the cells of parameters and measures."""

from __future__ import annotations

import inspect
import math
import time
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from twoloop.checks.arguments import shown
from twoloop.result.result import Result
from twoloop.run.record import Status
from twoloop.solve import solve_dae

if TYPE_CHECKING:
    from twoloop.problem.problem import Problem

Row = dict[str, Any]
Work = tuple[Callable[..., Any], Callable[..., Any], dict[str, Any]]  # problem_of, measure, options

STANDARD_COLUMNS = ("status", "message", "seconds")
INTEGER_LIMIT = 2**63  # integers must be smaller to fit into a column


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


def one_run(work: Work, parameters: Row, first: bool = False) -> Row:
    """Solve a run and return its columns beside the parameters; errors are rows, but that of the `first` is raised."""
    problem_of, measure, options = work
    start = time.perf_counter()
    try:
        problem = problem_of(**parameters)
        if not hasattr(problem, "system"):
            raise TypeError(f"problem_of must return a Problem; it returned {shown(problem)}")
        call = {"t_span": problem.t_span, "q0": problem.q0, "v0": problem.v0, **options}
        result = solve_dae(problem.system, **call)
        if result.status is Status.INTERRUPTED:
            raise KeyboardInterrupt
        row = {"status": result.status.name, "message": result.message, "seconds": time.perf_counter() - start}
        return row | _checked_measures(measure(problem, result), {*parameters, *STANDARD_COLUMNS, "run"})
    except (Exception, SystemExit) as error:
        if first and not isinstance(error, ValueError):
            raise
        return failure_row(f"{type(error).__name__}: {error}", time.perf_counter() - start)


def failure_row(message: str, seconds: float = math.nan) -> Row:
    """Return the row of a run that raised an exception."""
    return {"status": "ERROR", "message": message, "seconds": seconds}


def _checked_measures(measures: Any, columns: set[str]) -> Row:
    """Return the new columns of a measure; raise TypeError if one exists already or is not a cell of a table."""
    if not isinstance(measures, Mapping):
        raise TypeError(f"measure must return a mapping of columns; it returned {shown(measures)}")
    row = {}
    for name, value in measures.items():
        if not isinstance(name, str):
            raise TypeError(f"measure must name its columns by strings; it returned {shown(name)}")
        if name in columns:
            raise TypeError(f"measure must return columns that the row has not already; it returned {name!r}")
        cell = value.item() if isinstance(value, (np.generic, np.ndarray)) and np.ndim(value) == 0 else value
        if not (cell is None or kind_of(cell) or _is_nan(cell)):
            raise TypeError(
                f"measure must return numbers, strings, True and False or None, cells of a table; {name!r} is "
                f"{shown(value)} of type {type(value).__name__}"
            )
        row[name] = cell
    return row


def kind_of(value: Any) -> str | None:
    """Return the kind of column that a cell belongs to; None if it fits any (a missing number) or no column."""
    if isinstance(value, bool):
        return "True and False"
    if isinstance(value, float) or (isinstance(value, int) and -INTEGER_LIMIT <= value < INTEGER_LIMIT):
        return None if math.isnan(value) else "numbers"
    return "strings" if isinstance(value, str) else None


def _is_nan(value: Any) -> bool:
    return isinstance(value, float) and math.isnan(value)


def fit_columns(row: Row, kinds: dict[str, str]) -> Row:
    """Return the row, or that of a failure if it does not fit the kinds of the columns, which it may extend.

    A Parquet column has one kind and valid text.
    """
    row = {k: value.encode(errors="replace").decode() if isinstance(value, str) else value for k, value in row.items()}
    for name, value in row.items():
        kind = kind_of(value)
        if kind is not None and kinds.setdefault(name, kind) != kind:
            return failure_row(
                f"TypeError: measure must fill a column with one kind; {name!r} had {kinds[name]}, now {shown(value)}",
                row["seconds"],
            )
    return row


def check_parameters(problem_of: Any, parameters: Any) -> list[Row]:
    """Return the parameters of all runs as plain cells; raise TypeError or ValueError, naming the argument."""
    if not callable(problem_of):
        raise TypeError(f"problem_of must be a function that returns a Problem; given {shown(problem_of)}")
    if isinstance(parameters, (str, Mapping)) or not isinstance(parameters, Sequence):
        raise TypeError(
            f"parameters must be a list of mappings, one for each run, such as [{{'theta3': 0.1}}, {{'theta3': 0.2}}]; "
            f"given {shown(parameters)}"
        )
    if not parameters:
        raise ValueError("parameters must contain at least one run; given none")
    signature, runs = inspect.signature(problem_of), []
    kinds: dict[str, str] = {}
    for number, run in enumerate(parameters):
        if not isinstance(run, Mapping):
            raise TypeError(f"parameters[{number}] must be a mapping of names to values; given {shown(run)}")
        if set(run) != set(parameters[0]):
            raise ValueError(
                f"parameters must all have the same names; [0] has {sorted(parameters[0])}, [{number}] {sorted(run)}"
            )
        taken = sorted(set(run) & {*STANDARD_COLUMNS, "run"})
        if taken:
            raise ValueError(f"parameters must not have the name of a standard column; given {taken[0]!r}")
        cells = {name: value.item() if isinstance(value, np.generic) else value for name, value in run.items()}
        for name, value in cells.items():
            kind = kind_of(value)
            if kind is None and not _is_nan(value):
                raise TypeError(
                    f"parameters[{number}][{name!r}] must be a number, a string, True or False, a cell of a table; "
                    f"given {shown(value)}. Give the parts one by one, and let problem_of put them together"
                )
            if kind is not None and kinds.setdefault(name, kind) != kind:
                raise TypeError(
                    f"parameters must be of one kind under one name, as they fill a column of a table; {name!r} has "
                    f"{kinds[name]}, and {shown(value)} in [{number}]"
                )
        try:
            signature.bind(**run)
        except TypeError as error:
            raise TypeError(f"problem_of does not take parameters[{number}]: {error}") from None
        runs.append(cells)
    return runs
