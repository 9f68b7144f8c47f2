"""Solve many runs of a mechanism in parallel, as a table that can be resumed; failures are rows.

Runs execute in processes, in threads, or on a Dask cluster; a worker that dies costs its run alone.
"""

from __future__ import annotations

import inspect
import multiprocessing
import os
import pickle
import signal
import time
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from concurrent.futures import Executor, ThreadPoolExecutor, as_completed
from contextlib import closing
from multiprocessing.connection import Connection, wait
from typing import TYPE_CHECKING, Any

from twoloop.checks.arguments import (
    check_choice,
    check_flag,
    check_path,
    check_positive,
    check_size,
    check_span,
    needed,
)
from twoloop.kernels.compile.caches import n_compiled
from twoloop.result.result import Result
from twoloop.run.options import check_method
from twoloop.run.signals import SignalHandlers
from twoloop.solve import progress_bar, solve_dae
from twoloop.sweeps.one_run import (
    STANDARD_COLUMNS,
    Row,
    Work,
    check_parameters,
    ends,
    failure_row,
    fit_columns,
    kind_of,
    one_run,
    read_rows,
    sweep_settings,
    write_rows,
)

if TYPE_CHECKING:
    from twoloop.problem.problem import Problem

RENEWED_AFTER = 150  # compiled functions per worker before it is replaced: LLVM keeps some MB of each
POLL_INTERVAL = 1.0  # s between checks that workers are alive: a child of a dead worker may keep its connection open


def solve_runs(
    work: Work, parameters: list[Row], numbers: list[int], n_workers: int, parallel: str, client: Any
) -> Generator[tuple[int, Row]]:
    """Yield the numbers and rows of these runs as they finish; the first run is solved in this process."""
    if not numbers:
        return
    yield numbers[0], one_run(work, parameters[numbers[0]], first=True)
    runs = {number: parameters[number] for number in numbers[1:]}
    if client is None and parallel == "processes":
        yield from _in_processes(work, runs, n_workers)
    elif runs:
        with client.get_executor(pure=False) if client is not None else ThreadPoolExecutor(n_workers) as executor:
            yield from _in_executor(executor, work, runs)


def _in_executor(executor: Executor, work: Work, runs: dict[int, Row]) -> Iterator[tuple[int, Row]]:
    """Yield rows from threads or from a cluster."""
    tasks = {executor.submit(one_run, work, run): number for number, run in runs.items()}
    try:
        for task in as_completed(tasks):
            try:
                row = task.result()
            except Exception as error:  # raised by the cluster: `one_run` raises none
                row = failure_row(f"{type(error).__name__}: {error}")
            yield tasks[task], row
    finally:
        for task in tasks:
            task.cancel()


def _in_processes(work: Work, runs: dict[int, Row], n_workers: int) -> Iterator[tuple[int, Row]]:
    """Yield rows from processes, which are replaced when they die or have grown.

    Raises KeyboardInterrupt if a run did. Raises RuntimeError if a worker dies before it can begin.
    """
    remaining = list(reversed(runs.items()))
    workers: list[_Worker] = []
    try:
        while remaining or workers:
            while remaining and len(workers) < n_workers:
                workers.append(_Worker(work, *remaining.pop()))
            # returns as soon as a worker has sent something or has died
            wait([worker.connection for worker in workers], POLL_INTERVAL)
            for worker in list(workers):
                yield from worker.rows()
                if worker.number is not None and worker.dead:
                    yield worker.number, failure_row(worker.cause_of_death())
                if worker.number is None and remaining and not worker.grown and not worker.dead:
                    worker.start(*remaining.pop())
                elif worker.number is None or worker.dead:
                    worker.terminate()
                    workers.remove(worker)
    finally:
        for worker in workers:
            worker.terminate()


class _Worker:
    """Worker process, and the number of the run that it is working on."""

    def __init__(self, work: Work, number: int, run: Row):
        # spawned: a fork of a process with threads may deadlock
        context = multiprocessing.get_context("spawn")
        self.connection, remote = context.Pipe()
        self.process = context.Process(target=_serve, args=(remote, work))
        self.process.start()
        remote.close()
        self.ready = self.grown = self.dead = False
        self.start(number, run)

    def start(self, number: int, run: Row) -> None:
        """Send a run to the worker."""
        self.number: int | None = number
        try:
            self.connection.send(run)
        except OSError:
            self.dead = True

    def rows(self) -> Iterator[tuple[int, Row]]:
        """Yield the rows since the last call; note if the worker has died."""
        try:
            alive = self.process.is_alive()  # before polling, so that nothing sent before the death is lost
            while self.connection.poll():
                message = self.connection.recv()
                if message == "ready":
                    self.ready = True
                    continue
                row, n_functions = message
                if row is None:
                    raise KeyboardInterrupt
                assert self.number is not None
                number, self.number, self.grown = self.number, None, n_functions >= RENEWED_AFTER
                yield number, row
            self.dead = self.dead or not alive
        except (EOFError, OSError):
            self.dead = True

    def cause_of_death(self) -> str:
        """Return the cause of death in words."""
        self.process.join(10.0 * POLL_INTERVAL)
        code = self.process.exitcode
        if code is not None and code < 0:
            cause = f"ended by signal {-code} ({signal.strsignal(-code)})"
        else:
            cause = f"ended with exit code {code}"
        if not self.ready:
            raise RuntimeError(
                f"a worker process {cause} before its first run, see what it says above. A script must start its sweep "
                "under if __name__ == '__main__', and functions must be in a module that another process can import"
            )
        return f"the worker process {cause} in this run"

    def terminate(self) -> None:
        """Terminate the worker."""
        self.connection.close()
        self.process.terminate()
        self.process.join(POLL_INTERVAL)
        if self.process.is_alive():
            self.process.kill()
            self.process.join()


def _serve(connection: Connection, work: Work) -> None:
    """Process runs in a worker until there are no more."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent handles Ctrl-C
    n_before = n_compiled()
    connection.send("ready")
    while True:
        try:
            run = connection.recv()
        except EOFError:
            return
        try:
            row: Row | None = one_run(work, run)
        except KeyboardInterrupt:
            row = None
        connection.send((row, n_compiled() - n_before))


PARALLEL = ("processes", "threads")
SAVE_INTERVAL = 10.0  # s


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

    The first run is solved in the calling process: it compiles what is missing once for all workers, and an error in
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
        Keyword arguments of `solve_dae`: method, rtol, t_eval, events, time_limit, ...

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
    Each run is a call of `solve_dae`, and its row does not depend on how runs are distributed. A process that dies
    costs its own run only. Runs that differ in parameters and starts alone are faster by `ensemble`.

    Examples
    --------
    >>> from twoloop import sweep
    >>> from twoloop.mechanisms import four_bar
    >>> grid = [{"theta3": 0.0}, {"theta3": 0.1}]
    >>> rows = sweep(four_bar, grid, t_span=(0.0, 1.0), parallel="threads")
    >>> rows["status"].tolist()
    ['REACHED_END', 'REACHED_END']
    """
    check_choice("parallel", parallel, PARALLEL)
    check_flag("progress", progress)
    n_workers = (os.cpu_count() or 1) if workers is None else check_size("workers", workers, 1)
    runs = check_parameters(problem_of, parameters)
    _check_options(options)
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
        settings = sweep_settings(work)
        rows = read_rows(pandas, path, runs, settings)

    def table() -> Any:
        numbers = sorted(rows)
        columns = None if rows else [*runs[0], *STANDARD_COLUMNS]
        return pandas.DataFrame([rows[number] for number in numbers], numbers, columns).rename_axis("run")

    missing = [number for number in range(len(runs)) if number not in rows]
    kinds = {name: kind for row in rows.values() for name, value in row.items() if (kind := kind_of(value))}
    with (
        SignalHandlers() as handlers,
        progress_bar(progress, f"{len(runs)} runs", len(runs)) as report,
        closing(solve_runs(work, runs, missing, n_workers, parallel, client)) as solved,
    ):
        last_save = time.monotonic()
        try:
            for number, row in solved:
                handlers.call_delayed()  # the exception of a handler is no failure of a run
                rows[number] = {**runs[number], **fit_columns(row, kinds)}
                report(len(rows))
                if path is not None and time.monotonic() - last_save > SAVE_INTERVAL:
                    write_rows(table(), path, settings)
                    last_save = time.monotonic()
        finally:
            if path is not None and rows:
                write_rows(table(), path, settings)
    return table()


def _check_options(options: dict[str, Any]) -> None:
    set_by_sweep = ("system", "t_span", "q0", "v0", "store")
    names = [name for name in inspect.signature(solve_dae).parameters if name not in set_by_sweep]
    unknown = [name for name in options if name not in names]
    if unknown:
        raise TypeError(
            f"sweep has no argument {unknown[0]!r}; those that it hands to solve_dae are {', '.join(names)}"
        )
    check_method(options.get("method", "auto"))
    for name in {"rtol", "time_limit"} & set(options):
        check_positive(name, options[name])


def _check_pickles(work: Work) -> None:
    for name, value in zip(("problem_of", "measure", "options"), work, strict=True):
        try:
            pickle.dumps(value)
        except Exception as error:
            raise TypeError(
                f"{name} cannot be sent to another process: write its functions at the top level of a module, or take "
                f"parallel='threads'. Pickle says: {error}"
            ) from None
