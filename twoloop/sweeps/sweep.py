"""Many runs of one mechanism with different parameters and starts: parallel, with failures as rows, resumable."""

from __future__ import annotations

import inspect
import os
import pickle
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from typing import TYPE_CHECKING, Any

from twoloop.checks.arguments import check_choice, check_flag, check_path, check_positive, check_size, check_span
from twoloop.checks.optional import needed
from twoloop.result.result import Result
from twoloop.solve import check_method, solve_dae
from twoloop.sweeps import saved_sweep
from twoloop.sweeps.cells import OWN, Row, check_parameters, fitting, kind_of
from twoloop.sweeps.one_run import Work, ends
from twoloop.sweeps.shared_out import all_rows

if TYPE_CHECKING:
    from twoloop.problem.problem import Problem

PARALLEL = ("processes", "threads")
SAVE_EVERY = 10.0  # s


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
        Keyword arguments of `solve_dae`: method, rtol, t_eval, events, time_limit, ...

    Returns
    -------
    pandas.DataFrame
        One row per run in the order of `parameters`, indexed by "run". Columns: the parameters, "status" (that of
        `Result.status`, or "ERROR" if the run raised an exception), "message", "seconds" of wall-clock time (of runs
        made together an equal share), and the measures.

    Raises
    ------
    ImportError
        If pandas, pyarrow, dask or rich is required but missing.
    TypeError, ValueError
        If an argument is invalid, functions cannot be sent to other processes, or `out` belongs to another sweep.

    Notes
    -----
    Runs of compiled callbacks that differ in parameters and starts only are made together in SIMD lanes, as by
    `ensemble`, if states at given times are all that is asked for: with `t_eval`, or with the default measures, and no
    options but these and method, rtol, atol, t_span and check_derivatives. Some runs of each task are still made by
    `solve_dae`. Of those made in lanes,

    - messages say "in lanes", and numbers agree with those of single runs within the tolerances;
    - t, q, v, a, lam, energy and reactions of the `Result` are of the lanes. Where `measure` asks for anything else,
      such as `stats` or `h`, the run is made singly, too. The default measures have the counts of the lanes;
    - the default measures look at the energy at 101 evenly spaced times, instead of at every step;
    - `problem_of` is called twice: for lanes, and again just before `measure`. If the second problem is another, the
      run is a single one. So `problem_of` should be cheap, and must not depend on earlier calls.

    All other runs are separate calls of `solve_dae`, whose rows do not depend on how they are distributed. A process
    that dies affects a single run: the others of its task are repeated one by one.

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
    given = check_parameters(problem_of, parameters)
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
    kinds = {name: kind for row in rows.values() for name, value in row.items() if (kind := kind_of(value))}
    with (
        _bar(progress, len(given)) as report,
        closing(all_rows(work, given, left, n_workers, parallel, client)) as made,
    ):
        saved = time.monotonic()
        try:
            for number, row in made:
                rows[number] = {**given[number], **fitting(row, kinds)}
                report(len(rows))
                if path is not None and time.monotonic() - saved > SAVE_EVERY:
                    saved_sweep.write(table(), path, settings)
                    saved = time.monotonic()
        finally:
            if path is not None and rows:
                saved_sweep.write(table(), path, settings)
    return table()


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
