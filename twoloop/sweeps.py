"""Many runs of one mechanism: different parameters and starts, side by side, failures as rows, resumable."""

from __future__ import annotations

import inspect
import multiprocessing
import os
import pickle
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Executor, Future, ProcessPoolExecutor, ThreadPoolExecutor, as_completed
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from twoloop import saved_sweep
from twoloop.checks import check_choice, check_flag, check_positive, check_size, shown
from twoloop.optional import needed
from twoloop.result import Result, Status
from twoloop.solve import check_method, solve_dae

if TYPE_CHECKING:
    from twoloop.mechanisms.problem import Problem

Row = dict[str, Any]
Work = tuple[Callable[..., Any], Callable[..., Any], dict[str, Any]]  # problem_of, measure, options

OWN = ("status", "message", "seconds")  # columns of every row
ERROR = "ERROR"  # the status of a run that raised instead of ending
PARALLEL = ("processes", "threads")
BATCHES = 16  # tasks for each worker, so that all end at about the same time ...
LARGEST_BATCH = 16  # ... of this many runs at most
SAVE_EVERY = 10.0  # s


def ends(problem: Problem, result: Result) -> dict[str, Any]:
    """What a sweep measures where it is not told: the last time, steps, evaluations and the largest energy error."""
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

    The first run is made here: it compiles what is missing, once for all workers, and a mistake in `problem_of`,
    `measure` or `options` comes through at once. After that, a run that fails is a row that says why.

    Parameters
    ----------
    problem_of : callable
        problem_of(**parameters) -> Problem, such as a ready mechanism or a function of one's own. A `ValueError` of
        it, for a geometry that does not assemble, is a row.
    parameters : sequence of mappings
        One for each run, all with the same names. Values are numbers, strings, or True and False.
    measure : callable
        measure(problem, result) -> mapping of further columns. By default the last time, counts, and the largest
        energy error where the energy is an invariant.
    workers : int, optional
        Processes or threads. None: one for each core.
    parallel : {"processes", "threads"}
        Processes are new ones that read the compiled code from the cache; functions must then be at the top level of a
        module, and a script must start its sweep under `if __name__ == "__main__"`. Threads share all, take any
        functions, and fall short where runs are so short that Python's share counts: kernels release its lock,
        the checks before and after a run do not.
    client : dask.distributed.Client, optional
        Run on its cluster instead. `workers` and `parallel` do not count then.
    out : path, optional
        A file of Parquet (needs pyarrow) in which rows are kept, every ten seconds and at the end, also after Ctrl-C.
        If it exists, the runs that it has are not made again, failed ones neither.
    progress : bool
        Show a bar (needs rich).
    t_span : (float, float), optional
        Of all runs, s. None: that of each problem.
    **options
        Of `solve_dae`: method, rtol, t_eval, events, time_limit, ... With check_derivatives=False, once the derivatives
        are known to be right, runs of some milliseconds take about two thirds of the time. compiled=True compiles
        anew for other parameters, some 0.1 s, which pays for long runs only.

    Returns
    -------
    pandas.DataFrame
        A row for each run, in the order of `parameters`, whose place is the index "run". Columns: the parameters,
        "status" (of `Result.status`, or "ERROR" where the run raised an exception), "message", "seconds" of wall-clock
        time, and what was measured.

    Raises
    ------
    ImportError
        If pandas, pyarrow, dask or rich is missing where it is needed.
    TypeError, ValueError
        If an argument is wrong, functions cannot be sent to other processes, or `out` holds another sweep.
    """
    check_choice("parallel", parallel, PARALLEL)
    check_flag("progress", progress)
    n_workers = (os.cpu_count() or 1) if workers is None else check_size("workers", workers, 1)
    given = _check_parameters(problem_of, parameters)
    options = _check_options(options) | ({} if t_span is None else {"t_span": t_span})
    work: Work = (problem_of, measure, options)
    if client is not None or parallel == "processes":
        _check_pickles(work)
    pandas = needed("pandas", "pandas", "sweep")
    path = None if out is None else Path(out)
    settings = saved_sweep.settings(work)
    rows: dict[int, Row] = {} if path is None else saved_sweep.read(pandas, path, given, settings)

    def table() -> Any:
        made = pandas.DataFrame([rows[number] for number in sorted(rows)], index=sorted(rows)).rename_axis("run")
        return made if len(made) else pandas.DataFrame(columns=[*given[0], *OWN]).rename_axis("run")

    left = [number for number in range(len(given)) if number not in rows]
    with _bar(progress, len(given)) as report:
        saved = time.monotonic()
        try:
            for number, row in _all_rows(work, given, left, n_workers, parallel, client):
                rows[number] = {**given[number], **row}
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
) -> Iterator[tuple[int, Row]]:
    """Numbers and rows of the runs that are left, as they come; the first is made here."""
    if not left:
        return
    yield left[0], one_run(work, given[left[0]], first=True)
    rest = left[1:]
    size = min(max(len(rest) // (BATCHES * n_workers), 1), LARGEST_BATCH)
    with _executor(n_workers, parallel, client) as executor:
        tasks: dict[Future[list[Row]], list[int]] = {}
        for k in range(0, len(rest), size):
            numbers = rest[k : k + size]
            tasks[executor.submit(batch, work, [given[number] for number in numbers])] = numbers
        try:
            for task in as_completed(tasks):
                yield from zip(tasks[task], task.result(), strict=True)
        finally:
            for task in tasks:
                task.cancel()


def _executor(n_workers: int, parallel: str, client: Any) -> Executor:
    if client is not None:
        return client.get_executor(pure=False)  # type: ignore[no-any-return]
    if parallel == "threads":
        return ThreadPoolExecutor(n_workers)
    # not forked: a fork of a process with threads may stand still
    return ProcessPoolExecutor(n_workers, mp_context=multiprocessing.get_context("spawn"))


def batch(work: Work, given: list[Row]) -> list[Row]:
    """The rows of some runs, in the worker that makes them."""
    return [one_run(work, each) for each in given]


def one_run(work: Work, given: Row, first: bool = False) -> Row:
    """The columns of a run beside its parameters; of the first, mistakes in the functions are not rows."""
    problem_of, measure, options = work
    began = time.perf_counter()
    try:
        problem = problem_of(**given)
        call = {"t_span": problem.t_span, "q0": problem.q0, "v0": problem.v0, **options}
        result = solve_dae(problem.system, **call)
        if result.status is Status.INTERRUPTED:
            raise KeyboardInterrupt
        seconds = time.perf_counter() - began
        row = {"status": result.status.name, "message": result.message, "seconds": seconds}
        return row | _check_measured(measure(problem, result), {*given, *OWN})
    except Exception as error:
        if first and not isinstance(error, ValueError):
            raise
        seconds = time.perf_counter() - began
        return {"status": ERROR, "message": f"{type(error).__name__}: {error}", "seconds": seconds}


def _check_measured(measured: Any, known: set[str]) -> Row:
    if not isinstance(measured, Mapping):
        raise TypeError(f"measure must return a mapping of columns; it returned {shown(measured)}")
    twice = sorted(set(measured) & known)
    if twice:
        raise TypeError(f"measure must return columns that the row has not already; it returned {twice[0]!r}")
    return dict(measured)


def _check_parameters(problem_of: Any, parameters: Any) -> list[Row]:
    if not callable(problem_of):
        raise TypeError(f"problem_of must be a function that returns a Problem; given {shown(problem_of)}")
    if isinstance(parameters, (str, Mapping)) or not isinstance(parameters, Sequence):
        raise TypeError(
            f"parameters must be a list of mappings, one for each run, such as [{{'theta3': 0.1}}, {{'theta3': 0.2}}]; "
            f"given {shown(parameters)}"
        )
    if not parameters:
        raise ValueError("parameters must be of one run at least; given none")
    signature, made = inspect.signature(problem_of), []
    for number, each in enumerate(parameters):
        if not isinstance(each, Mapping):
            raise TypeError(f"parameters[{number}] must be a mapping of names to values; given {shown(each)}")
        if set(each) != set(parameters[0]):
            raise ValueError(
                f"parameters must all have the same names; [0] has {sorted(parameters[0])}, [{number}] {sorted(each)}"
            )
        taken = sorted(set(each) & {*OWN, "run"})
        if taken:
            raise ValueError(f"parameters must not be named as the columns of every row are; given {taken[0]!r}")
        for name, value in each.items():
            if not isinstance(value, (bool, int, float, str, np.generic)):
                raise TypeError(
                    f"parameters[{number}][{name!r}] must be a number, a string, True or False, a cell of a table; "
                    f"given {shown(value)}. Give the parts one by one, and let problem_of put them together"
                )
        try:
            signature.bind(**each)
        except TypeError as error:
            raise TypeError(f"problem_of does not take parameters[{number}]: {error}") from None
        made.append({name: value.item() if isinstance(value, np.generic) else value for name, value in each.items()})
    return made


def _check_options(options: dict[str, Any]) -> dict[str, Any]:
    known = [name for name in inspect.signature(solve_dae).parameters if name not in ("system", "t_span", "q0", "v0")]
    unknown = [name for name in options if name not in known]
    if unknown:
        raise TypeError(f"sweep has no argument {unknown[0]!r}, nor has solve_dae; options are {', '.join(known)}")
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
    """A function that takes the number of rows; draws a bar when asked to."""
    if not progress:
        yield lambda done: None
        return
    with needed("rich.progress", "rich", "progress=True").Progress() as bar:
        task = bar.add_task(f"{n} runs", total=n)
        yield lambda done: bar.update(task, completed=done)
