"""Many runs of one mechanism with different parameters and starts: parallel, with failures as rows, resumable."""

from __future__ import annotations

import inspect
import math
import os
import pickle
import time
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Executor, Future, ThreadPoolExecutor, wait
from contextlib import closing, contextmanager
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from twoloop.checks.arguments import check_choice, check_flag, check_path, check_positive, check_size, check_span, shown
from twoloop.checks.optional import needed
from twoloop.result.result import Result
from twoloop.run.record import Status
from twoloop.solve import check_method, solve_dae
from twoloop.sweeps import saved_sweep
from twoloop.sweeps.workers import in_processes

if TYPE_CHECKING:
    from twoloop.problem.problem import Problem

Row = dict[str, Any]
Work = tuple[Callable[..., Any], Callable[..., Any], dict[str, Any]]  # problem_of, measure, options

OWN = ("status", "message", "seconds")  # columns of all rows
ERROR = "ERROR"  # status of a run that raised an exception
PARALLEL = ("processes", "threads")
LARGEST_INTEGER = 2**63  # integers must be smaller to fit into a column
BATCHES = 16  # tasks per thread or cluster worker, for load balancing ...
LARGEST_BATCH = 16  # ... with at most this many runs each
SAVE_EVERY = 10.0  # s


def ends(problem: Problem, result: Result) -> dict[str, Any]:
    """Return the default measures of a sweep: last time, steps, evaluations and the largest energy error.

    The energy error is NaN unless the problem declares its energy an invariant.
    """
    energy = result.energy if problem.conserved and result.t.size else np.array([np.nan])
    return {
        "t": result.t[-1] if result.t.size else np.nan,
        "n_accepted": result.stats.n_accepted,
        "n_evaluations": result.stats.n_evaluations,
        "energy_error": float(np.abs(energy - energy[0]).max()),
    }


def sweep(
    problem_of: Callable[..., Problem],
    parameters: Sequence[Mapping[str, Any]],
    *,
    measure: Callable[[Problem, Result], Mapping[str, Any]] = ends,
    workers: int | None = None,
    parallel: str = "processes",
    client: Any = None,
    out: str | os.PathLike[str] | None = None,
    progress: bool = False,
    t_span: tuple[float, float] | None = None,
    **options: Any,
) -> Any:
    """Solve a mechanism for many sets of parameters.

    The first run is made in the calling process: it compiles what is missing once for all workers, and an error in
    `problem_of`, `measure` or `options` is raised at once. Afterwards, a run that fails, or whose process dies, becomes
    a row with the reason.

    Parameters
    ----------
    problem_of : callable
        ``problem_of(**parameters)`` returns a `Problem`: a ready mechanism or a function of your own. If it raises
        `ValueError`, e.g. for a geometry that does not assemble, the run becomes a row with this error.
    parameters : sequence of mappings
        One mapping per run, all with the same names. Values are numbers, strings or booleans, of the same kind under
        each name.
    measure : callable
        ``measure(problem, result)`` returns a mapping of further columns with numbers, strings, booleans or None, of
        one kind per column. Default: the last time, counts, and the largest energy error, which is NaN unless the
        problem declares its energy an invariant (`conserved`).
    workers : int, optional
        Number of processes or threads. None: one per core.
    parallel : {"processes", "threads"}
        Processes are spawned and read the compiled code from the cache; functions must then be at the top level of a
        module, and a script must start its sweep under `if __name__ == "__main__"`. Threads accept any functions but
        scale badly for short runs: the kernels release Python's lock, the checks before and after a run do not.
    client : dask.distributed.Client, optional
        Run on its cluster instead; `workers` and `parallel` are then ignored.
    out : path, optional
        Parquet file (needs pyarrow) to which rows are saved every ten seconds and at the end, also after Ctrl-C. If it
        exists, its runs are not repeated, including failed ones. It stores digests of the functions, of what they
        enclose and the globals that they use, and the version of this package: a file with others is rejected.
    progress : bool
        Show a progress bar (needs rich).
    t_span : (float, float), optional
        Time span of all runs, s. None: that of each problem.
    **options
        Keyword arguments of `solve_dae`: method, rtol, t_eval, events, time_limit, ... Once the derivatives are known
        to be right, check_derivatives=False makes short runs slightly faster.

    Returns
    -------
    pandas.DataFrame
        One row per run in the order of `parameters`, indexed by "run". Columns: the parameters, "status" (that of
        `Result.status`, or "ERROR" if the run raised an exception), "message", "seconds" of wall-clock time, and the
        measures.

    Raises
    ------
    ImportError
        If pandas, pyarrow, dask or rich is required but missing.
    TypeError, ValueError
        If an argument is invalid, functions cannot be sent to other processes, or `out` belongs to another sweep.

    Notes
    -----
    Every run is a separate call of `solve_dae`: `measure` has access to the whole `Result`, a crash affects a single
    run, and rows do not depend on how the runs are distributed or interrupted. If runs differ in parameters and starts
    only, and states at given times suffice, `ensemble` is much faster.
    """
    check_choice("parallel", parallel, PARALLEL)
    check_flag("progress", progress)
    n_workers = (os.cpu_count() or 1) if workers is None else check_size("workers", workers, 1)
    given = _check_parameters(problem_of, parameters)
    options = _check_options(options)
    if t_span is not None:
        check_span(t_span)
        options["t_span"] = t_span
    work: Work = (problem_of, measure, options)
    if client is not None or parallel == "processes":
        _check_pickles(work)
    pandas = needed("pandas", "pandas", "sweep")
    path = None if out is None else check_path(out, "out")
    rows: dict[int, Row] = {}
    if path is not None:
        settings = saved_sweep.settings(work)
        rows = saved_sweep.read(pandas, path, given, settings)

    def table() -> Any:
        made = pandas.DataFrame([rows[number] for number in sorted(rows)], index=sorted(rows)).rename_axis("run")
        return made if len(made) else pandas.DataFrame(columns=[*given[0], *OWN]).rename_axis("run")

    left = [number for number in range(len(given)) if number not in rows]
    kinds = {name: kind for row in rows.values() for name, value in row.items() if (kind := _kind(value))}
    with (
        _bar(progress, len(given)) as report,
        closing(_all_rows(work, given, left, n_workers, parallel, client)) as made,
    ):
        saved = time.monotonic()
        try:
            for number, row in made:
                rows[number] = {**given[number], **_fitting(row, kinds)}
                report(len(rows))
                if path is not None and time.monotonic() - saved > SAVE_EVERY:
                    saved_sweep.write(table(), path, settings)
                    saved = time.monotonic()
        finally:
            if path is not None and rows:
                saved_sweep.write(table(), path, settings)
    return table()


def _all_rows(
    work: Work, given: list[Row], left: list[int], n_workers: int, parallel: str, client: Any
) -> Generator[tuple[int, Row]]:
    """Yield numbers and rows of the remaining runs as they finish; the first run is made in this process."""
    if not left:
        return
    yield left[0], one_run(work, given[left[0]], first=True)
    rest = {number: given[number] for number in left[1:]}
    if client is None and parallel == "processes":
        for number, row, how in in_processes(partial(one_run, work), rest, n_workers):
            yield number, row or _failed(how)
    elif rest:
        with client.get_executor(pure=False) if client is not None else ThreadPoolExecutor(n_workers) as executor:
            yield from _by_executor(executor, work, rest, n_workers)


def _by_executor(executor: Executor, work: Work, rest: dict[int, Row], n_workers: int) -> Iterator[tuple[int, Row]]:
    """Yield rows from threads or a cluster, in batches; a batch lost with its worker is repeated run by run."""
    size = min(max(len(rest) // (BATCHES * n_workers), 1), LARGEST_BATCH)
    tasks: dict[Future[list[Row]], list[int]] = {}

    def submit(numbers: list[int]) -> None:
        tasks[executor.submit(batch, work, [rest[number] for number in numbers])] = numbers

    everything = list(rest)
    for k in range(0, len(everything), size):
        submit(everything[k : k + size])
    try:
        while tasks:
            for task in wait(tasks, return_when=FIRST_COMPLETED).done:
                numbers = tasks.pop(task)
                try:
                    yield from zip(numbers, task.result(), strict=True)
                except Exception as error:
                    if len(numbers) == 1:
                        yield numbers[0], _failed(f"{type(error).__name__}: {error}")
                    else:
                        for number in numbers:
                            submit([number])
    finally:
        for task in tasks:
            task.cancel()


def batch(work: Work, given: list[Row]) -> list[Row]:
    """Return the rows of some runs; executed by a worker."""
    return [one_run(work, each) for each in given]


def one_run(work: Work, given: Row, first: bool = False) -> Row:
    """Return the columns of a run other than its parameters; in the first run, errors in the functions are raised."""
    problem_of, measure, options = work
    began = time.perf_counter()
    try:
        problem = problem_of(**given)
        if not hasattr(problem, "system"):
            raise TypeError(f"problem_of must return a Problem; it returned {shown(problem)}")
        call = {"t_span": problem.t_span, "q0": problem.q0, "v0": problem.v0, **options}
        result = solve_dae(problem.system, **call)
        if result.status is Status.INTERRUPTED:
            raise KeyboardInterrupt
        seconds = time.perf_counter() - began
        row = {"status": result.status.name, "message": result.message, "seconds": seconds}
        return row | _check_measured(measure(problem, result), {*given, *OWN, "run"})
    except (Exception, SystemExit) as error:
        if first and not isinstance(error, ValueError):
            raise
        return _failed(f"{type(error).__name__}: {error}", time.perf_counter() - began)


def _failed(message: str, seconds: float = math.nan) -> Row:
    return {"status": ERROR, "message": message, "seconds": seconds}


def _check_measured(measured: Any, known: set[str]) -> Row:
    if not isinstance(measured, Mapping):
        raise TypeError(f"measure must return a mapping of columns; it returned {shown(measured)}")
    row = {}
    for name, value in measured.items():
        if not isinstance(name, str):
            raise TypeError(f"measure must name its columns by strings; it returned {shown(name)}")
        if name in known:
            raise TypeError(f"measure must return columns that the row has not already; it returned {name!r}")
        plain = value.item() if isinstance(value, (np.generic, np.ndarray)) and np.ndim(value) == 0 else value
        if not (plain is None or _kind(plain) or (isinstance(plain, float) and math.isnan(plain))):
            raise TypeError(
                f"measure must return numbers, strings, True and False or None, cells of a table; {name!r} is "
                f"{shown(value)} of type {type(value).__name__}"
            )
        row[name] = plain
    return row


def _kind(value: Any) -> str | None:
    """Return the kind of column that a cell belongs to; None if it fits any (a missing number) or no column."""
    if isinstance(value, bool):
        return "True and False"
    if isinstance(value, float) or (isinstance(value, int) and -LARGEST_INTEGER <= value < LARGEST_INTEGER):
        return None if math.isnan(value) else "numbers"
    return "strings" if isinstance(value, str) else None


def _fitting(row: Row, kinds: dict[str, str]) -> Row:
    """Return a row that fits the columns, whose kinds are extended; a Parquet column has one kind and valid text."""
    row = {k: value.encode(errors="replace").decode() if isinstance(value, str) else value for k, value in row.items()}
    for name, value in row.items():
        kind = _kind(value)
        if kind is not None and kinds.setdefault(name, kind) != kind:
            message = (
                f"TypeError: measure must fill a column with one kind; {name!r} had {kinds[name]}, now {shown(value)}"
            )
            return _failed(message, row["seconds"])
    return row


def _check_parameters(problem_of: Any, parameters: Any) -> list[Row]:
    if not callable(problem_of):
        raise TypeError(f"problem_of must be a function that returns a Problem; given {shown(problem_of)}")
    if isinstance(parameters, (str, Mapping)) or not isinstance(parameters, Sequence):
        raise TypeError(
            f"parameters must be a list of mappings, one for each run, such as [{{'theta3': 0.1}}, {{'theta3': 0.2}}]; "
            f"given {shown(parameters)}"
        )
    if not parameters:
        raise ValueError("parameters must contain at least one run; given none")
    signature, made = inspect.signature(problem_of), []
    kinds: dict[str, str] = {}
    for number, each in enumerate(parameters):
        if not isinstance(each, Mapping):
            raise TypeError(f"parameters[{number}] must be a mapping of names to values; given {shown(each)}")
        if set(each) != set(parameters[0]):
            raise ValueError(
                f"parameters must all have the same names; [0] has {sorted(parameters[0])}, [{number}] {sorted(each)}"
            )
        taken = sorted(set(each) & {*OWN, "run"})
        if taken:
            raise ValueError(f"parameters must not have the name of a standard column; given {taken[0]!r}")
        plain = {name: value.item() if isinstance(value, np.generic) else value for name, value in each.items()}
        for name, value in plain.items():
            kind = _kind(value)
            if kind is None and not (isinstance(value, float) and math.isnan(value)):
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
            signature.bind(**each)
        except TypeError as error:
            raise TypeError(f"problem_of does not take parameters[{number}]: {error}") from None
        made.append(plain)
    return made


def _check_options(options: dict[str, Any]) -> dict[str, Any]:
    of_a_run = ("system", "t_span", "q0", "v0", "store")
    known = [name for name in inspect.signature(solve_dae).parameters if name not in of_a_run]
    unknown = [name for name in options if name not in known]
    if unknown:
        raise TypeError(
            f"sweep has no argument {unknown[0]!r}; those that it hands to solve_dae are {', '.join(known)}"
        )
    check_method(options.get("method", "SunRadau5"))
    for name in {"rtol", "time_limit"} & set(options):
        check_positive(name, options[name])
    return options


def _check_pickles(work: Work) -> None:
    for name, each in zip(("problem_of", "measure", "options"), work, strict=True):
        try:
            pickle.dumps(each)
        except Exception as error:
            raise TypeError(
                f"{name} cannot be sent to another process: write its functions at the top level of a module, or take "
                f"parallel='threads'. Pickle says: {error}"
            ) from None


@contextmanager
def _bar(progress: bool, n: int) -> Iterator[Callable[[int], None]]:
    """Yield a function that takes the number of finished rows and draws a progress bar if requested."""
    if not progress:
        yield lambda done: None
        return
    with needed("rich.progress", "rich", "progress=True").Progress() as bar:
        task = bar.add_task(f"{n} runs", total=n)
        yield lambda done: bar.update(task, completed=done)
