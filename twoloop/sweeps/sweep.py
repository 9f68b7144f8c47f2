"""Solve many runs of a mechanism in parallel, as a table that can be resumed; failures are rows."""

from __future__ import annotations

import inspect
import os
import pickle
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
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
from twoloop.result.result import Result
from twoloop.run.options import check_method
from twoloop.solve import solve_dae
from twoloop.sweeps import saved_rows
from twoloop.sweeps.executors import solve_runs
from twoloop.sweeps.one_run import STANDARD_COLUMNS, Row, Work, check_parameters, ends, fit_columns, kind_of

if TYPE_CHECKING:
    from twoloop.problem.problem import Problem

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
        settings = saved_rows.settings(work)
        rows = saved_rows.read(pandas, path, runs, settings)

    def table() -> Any:
        numbers = sorted(rows)
        columns = None if rows else [*runs[0], *STANDARD_COLUMNS]
        return pandas.DataFrame([rows[number] for number in numbers], numbers, columns).rename_axis("run")

    missing = [number for number in range(len(runs)) if number not in rows]
    kinds = {name: kind for row in rows.values() for name, value in row.items() if (kind := kind_of(value))}
    with (
        _progress_bar(progress, len(runs)) as report,
        closing(solve_runs(work, runs, missing, n_workers, parallel, client)) as solved,
    ):
        last_save = time.monotonic()
        try:
            for number, row in solved:
                rows[number] = {**runs[number], **fit_columns(row, kinds)}
                report(len(rows))
                if path is not None and time.monotonic() - last_save > SAVE_INTERVAL:
                    saved_rows.write(table(), path, settings)
                    last_save = time.monotonic()
        finally:
            if path is not None and rows:
                saved_rows.write(table(), path, settings)
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


@contextmanager
def _progress_bar(progress: bool, n: int) -> Iterator[Callable[[int], None]]:
    """Yield a function that takes the number of finished rows and draws a progress bar if requested."""
    if not progress:
        yield lambda n_done: None
        return
    with needed("rich.progress", "rich", "progress=True").Progress() as bar:
        task = bar.add_task(f"{n} runs", total=n)
        yield lambda n_done: bar.update(task, completed=n_done)
