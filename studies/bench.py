"""The bench: a case (a mechanism and its reference) x a solver x a setting x a repetition is a row; one collector.

A study lists `Run`s, `collect` makes the rows, `tables` summarises them. Mechanisms stand in `cases/`, solvers in
`solvers.py`, what a row says of the quality of a run in `metrics.py`.
"""

import multiprocessing
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import closing, contextmanager
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from studies import metrics
from studies.reference_motion import ReferenceMotion, make_reference
from studies.store import KeptRows, Row
from twoloop import Result, Statistics
from twoloop.mechanisms import Problem

Array = NDArray[np.float64]

INSTANTS = 1000  # common instants of a case that names none
WARM_UP = 1e-3  # of the time span, run once by each solver on each case before anything is timed ...
COMPILING = 600.0  # ... with this limit in s: the first runs compile for minutes
MOST_CALLS = 20
ONCE = 1.0  # s of CPU; the time of a run that takes longer hardly varies, and it is not repeated
NOTHING_RUN = ("NOT_APPLICABLE", "NOT_AVAILABLE")  # statuses of rows for which no solver was started


class NotApplicable(Exception):
    """Raised by a solver of the catalogue for a case that it cannot run; the text says why."""


class TimeLimit(Exception):
    """Raised in a run that has used up its CPU time."""


@dataclass(frozen=True)
class Case:
    """A mechanism, a time span, and what runs are measured by.

    Attributes
    ----------
    name : str
        In tables and rows.
    problem : Problem
    t_end : float
        s; runs start at 0.
    known : callable or None
        known() -> ReferenceMotion where the motion is known; None: two unlike methods make one.
    n_instants : int
        Common instants, evenly spaced in (0, t_end].
    conserved : bool or None
        Whether the problem's energy is an invariant of the true motion. None: as the problem says, and where it does
        not, as the reference shows.
    invariants : mapping
        Further ones: column to invariant(t, q, v), for columns of states.
    watched : tuple of int or None
        Coordinates by which "out of phase" is judged. None: all.
    step_sizes : tuple of float or None
        s, for solvers of fixed step. None: t_end over 1000, 3000, 10,000, 30,000 and 100,000.
    tolerances : tuple of float or None
        For solvers that have one. None: those of the solver, from 1e-3 down; a stiff case asks for looser ones.
    time_limit : float
        CPU seconds that a run may use.
    timed : float
        s of CPU time: a shorter run is timed by calling it again until it has used so much.
    tags : tuple of str
        Class of the problem, "smooth", "stiff", "long", for tables over several cases.
    note : str
        What is assumed.
    """

    name: str
    problem: Problem
    t_end: float
    known: Callable[[], ReferenceMotion] | None = None
    n_instants: int = INSTANTS
    conserved: bool | None = None
    invariants: Mapping[str, Callable[[Array, Array, Array], Array]] = field(default_factory=dict)
    watched: tuple[int, ...] | None = None
    step_sizes: tuple[float, ...] | None = None
    tolerances: tuple[float, ...] | None = None
    time_limit: float = 60.0
    timed: float = 0.02
    tags: tuple[str, ...] = ()
    note: str = ""

    @cached_property
    def instants(self) -> Array:
        """The common instants (n_instants,), the last of which is t_end."""
        return np.linspace(0.0, self.t_end, self.n_instants + 1)[1:]

    @cached_property
    def reference(self) -> ReferenceMotion:
        """The motion against which errors are measured; made when first asked for."""
        return make_reference(self.problem, self.t_end) if self.known is None else self.known()

    @cached_property
    def scale(self) -> metrics.Scale:
        """Largest kinetic energy and ranges of the reference."""
        conserved = self.problem.conserved if self.conserved is None else self.conserved
        if conserved is None:
            conserved = metrics.keeps_energy(self.problem, self.reference, self.instants)
        return metrics.Scale(self.problem, self.reference, self.instants, conserved)

    def steps(self) -> tuple[float, ...]:
        """Fixed steps, s."""
        return self.step_sizes or tuple(self.t_end / n for n in (1e3, 3e3, 1e4, 3e4, 1e5))


@dataclass(frozen=True)
class Solver:
    """A solver of the catalogue.

    Attributes
    ----------
    name : str
        Its line in tables and figures.
    family : str
        Whose it is: "two-loop" (this project), "SUNDIALS", "SciPy", "Exudyn", "stand-in".
    called_from : str
        What calls the mechanism's functions: "compiled" code, or "Python", which costs microseconds a call.
    keeps_constraints : bool
        Whether the positions stay on the constraints to the solver's tolerance; False: they drift, or are off by the
        solver's errors.
    setting : str
        What the one number is that varies: "tol" (relative and absolute), "err_out" (the paper's), "h" (fixed step, s).
    run : callable
        run(case, value, repeat) -> Result, from 0 to case.t_end, within case.time_limit where the solver has such a
        limit. `repeat` counts from 0; a solver whose error scatters with rounding alone varies its input by it.
    values : tuple of float
        Values of the setting, loose to tight. Empty: those of the case, for "h".
    fixed : mapping
        Settings that do not vary, numbers or texts, for the row.
    traces : bool
        Whether it runs the mechanism's functions once, or has a model of its own, and calls none during a run.
    own_accelerations : bool
        Whether the accelerations in its results are not those of eq. (6) at its q and v.
    builds_each : bool
        Whether it compiles or builds anew for each value of the setting, not once a case.
    """

    name: str
    family: str
    called_from: str
    keeps_constraints: bool
    setting: str
    run: Callable[[Case, float, int], Result]
    values: tuple[float, ...] = ()
    fixed: Mapping[str, float | str] = field(default_factory=dict)
    own_accelerations: bool = False
    traces: bool = False
    builds_each: bool = False

    def grid(self, case: Case) -> tuple[float, ...]:
        """The values of the setting to run on a case."""
        if self.setting == "tol" and case.tolerances:
            return case.tolerances
        return self.values or case.steps()


@dataclass(frozen=True)
class Run:
    """One cell: a solver on a case at one value of its setting, repeated.

    Attributes
    ----------
    group : str
        Part of the study to which the rows belong.
    """

    case: Case
    solver: Solver
    value: float
    group: str = ""
    repeats: int = 3

    @property
    def settings(self) -> dict[str, float | str]:
        """Names and values of the settings, for the row."""
        return {**self.solver.fixed, self.solver.setting: self.value}

    def key(self, repeat: int) -> str:
        """What tells one row from all others of the study."""
        settings = " ".join(f"{name}={value!r}" for name, value in sorted(self.settings.items()))
        return f"{self.group} | {self.case.name} to {self.case.t_end!r} | {self.solver.name} | {settings} | {repeat}"


Measure = Callable[[Run, Result], dict[str, Any]]


def collect(runs: Iterable[Run], kept: KeptRows, measure: Measure | None = None, processes: int = 1) -> pd.DataFrame:
    """Make the rows of all runs that are not kept yet: one row a repetition.

    The repetitions of a run are interleaved with those of all others, so that a slow minute of the machine falls on all
    alike; one that takes more than ONCE seconds, or hits its limit, is made once. A run that fails, exceeds its time
    limit, or cannot be made is a row whose status and message say so.

    Parameters
    ----------
    runs : iterable of Run
        No two with the same key.
    kept : KeptRows
        Of the study's `Output`; rows are on disk as soon as they are made.
    measure : callable, optional
        measure(run, result) -> further columns, of values that JSON holds. Not called where there is no result.
    processes : int
        More than 1: runs side by side, for long studies whose times are not compared.

    Returns
    -------
    DataFrame
        In the order of the runs, the repetitions of a run one below the other.

    Raises
    ------
    ValueError
        If two runs have the same key.
    """
    runs = list(runs)
    order = {run.key(k): (run, k) for run in runs for k in range(run.repeats)}
    if len(order) < sum(run.repeats for run in runs):
        raise ValueError("two runs of the study have the same group, case, solver and settings")
    rounds = range(max((run.repeats for run in runs), default=0))
    left = [(run, k) for k in rounds for run in runs if k < run.repeats and run.key(k) not in kept]
    for case in {id(run.case): run.case for run, _ in left}.values():
        _ = case.scale  # makes the reference, which is not to be timed with anything
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    bar = Progress(*columns, disable=not sys.stdout.isatty())
    with closing(_rows_of(left, kept, measure, processes)) as made, bar as progress:
        task = progress.add_task("".ljust(50), total=len(order), completed=len(order) - len(left))
        for run, k, row in made:
            kept.add(run.key(k), row)
            progress.update(task, advance=1, description=f"{run.case.name}: {run.solver.name}"[:50].ljust(50))
    return pd.DataFrame([kept[key] for key in order if key in kept])


def _rows_of(
    left: list[tuple[Run, int]], kept: KeptRows, measure: Measure | None, processes: int
) -> Generator[tuple[Run, int, Row], None, None]:
    if processes == 1:
        warm: set[tuple[int, str, float]] = set()
        for run, k in left:
            first = kept[run.key(0)] if k > 0 else {}
            if first.get("status") != "TIME_LIMIT" and (first.get("cpu_s") or 0.0) <= ONCE:
                yield run, k, row_of(run, k, measure, warm)
        return
    _shared[:] = [(run, k, measure) for run, k in left]  # cases and solvers hold functions that cannot be sent
    pool = ProcessPoolExecutor(processes, multiprocessing.get_context("fork"), _end_with_parent)
    try:
        futures = {pool.submit(_shared_row, i): left[i] for i in range(len(left))}
        for future in as_completed(futures):
            yield *futures[future], future.result()
    finally:
        pool.shutdown(wait=False, cancel_futures=True)


_shared: list[tuple[Run, int, Measure | None]] = []  # as the workers inherit it


def _shared_row(i: int) -> Row:
    run, k, measure = _shared[i]
    return row_of(run, k, measure, set())


def _end_with_parent() -> None:
    """End this worker when the study is killed, which a worker of a pool does not notice by itself."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the parent's business

    def wait() -> None:
        parent = multiprocessing.parent_process()
        assert parent is not None
        parent.join()
        os._exit(1)

    threading.Thread(target=wait, daemon=True).start()


def row_of(run: Run, k: int, measure: Measure | None, warm: set[tuple[int, str, float]]) -> Row:
    """Make a repetition of a run and measure it over the motion; `warm` is what `build` has compiled."""
    case, solver = run.case, run.solver
    row: Row = {"group": run.group, "case": case.name, "problem": case.problem.name, "solver": solver.name}
    row |= {"family": solver.family, "called_from": called_from(run), "keeps_constraints": solver.keeps_constraints}
    row |= {**run.settings, "t_end": case.t_end, "repeat": k}
    row["build_s"] = build(run, k, warm)
    result, status, message = attempt(run, k)
    stats = Statistics() if result is None else result.stats
    spent = [] if result is None else [stats.cpu_time]
    while spent and sum(spent) < case.timed and len(spent) < MOST_CALLS:  # too short for the clock
        again = attempt(run, k)[0]
        if again is None:
            break
        spent.append(again.stats.cpu_time)
    row |= {"cpu_s": (sum(spent) / len(spent) or None) if spent else None, "calls": len(spent)}
    row |= {"status": status, "message": message}
    rejected = [n for n in (stats.n_rejected_error, stats.n_rejected_convergence) if n is not None]
    row |= {"n_steps": stats.n_accepted, "n_rejected": sum(rejected) if rejected else None}
    for name in ("n_evaluations", "n_outer", "n_inner", "n_partitions", "n_factorizations", "n_jacobians"):
        row[name] = getattr(stats, name)
    row["floor"] = case.reference.floor
    if result is None:
        return row | metrics.COLUMNS
    invariants = dict(case.invariants)
    try:
        given = case.problem, result, case.reference, case.instants, case.scale, case.watched, invariants
        row |= metrics.measure(*given)
        return row if measure is None else row | measure(run, result)
    except (ArithmeticError, ValueError, np.linalg.LinAlgError) as error:  # the rest of the night goes on
        why = f"{status}, but it cannot be measured: {type(error).__name__}: {error}"
        return row | metrics.COLUMNS | {"status": "NOT_MEASURED", "message": why}


def build(run: Run, repeat: int, built: set[tuple[int, str, float]], limit: float = COMPILING) -> float | None:
    """Let a run compile what it calls, unless `built` has it: its CPU time, s, with that of compilers."""
    what = (id(run.case), run.solver.name, run.value if run.solver.builds_each else 0.0)
    if what in built:
        return None
    built.add(what)
    began = os.times()
    warm_up(run, repeat, limit)
    return sum(os.times()[:4]) - sum(began[:4])


def warm_up(run: Run, repeat: int, limit: float = COMPILING) -> None:
    """Compile what a run calls, by the beginning of it; a failure comes back in the run itself."""
    span = 10.0 * run.value if run.solver.setting == "h" else WARM_UP * run.case.t_end
    attempt(replace(run, case=replace(run.case, t_end=min(span, run.case.t_end), time_limit=limit)), repeat)


def called_from(run: Run) -> str:
    """What calls the mechanism: Python wherever functions that are called are Python themselves."""
    in_python = run.case.problem.system.called_in_python and not run.solver.traces
    return "Python" if in_python else run.solver.called_from


def attempt(run: Run, repeat: int) -> tuple[Result | None, str, str]:
    """Make a run: its result, where there is one, a status and a message."""
    try:
        with _limited(run.case.time_limit):
            result = run.solver.run(run.case, run.value, repeat)
    except NotApplicable as why:
        return None, "NOT_APPLICABLE", str(why)
    except TimeLimit:
        return None, "TIME_LIMIT", f"Stopped after {run.case.time_limit:g} s of CPU time, the limit of a run."
    except ImportError as error:
        return None, "NOT_AVAILABLE", str(error)
    except RuntimeError as error:
        # references/ say so what is to be installed for a package that is not there
        status = "NOT_AVAILABLE" if isinstance(error.__context__, ImportError) else "RAISED"
        return None, status, str(error)
    except Exception as error:  # a solver that raises must not end a night of runs: the row says what it raised
        return None, "RAISED", f"{type(error).__name__}: {error}"
    if result.status.name == "INTERRUPTED":  # Ctrl-C, which solve_dae turns into a partial result
        raise KeyboardInterrupt
    if not result.success and "time_limit =" in result.message:  # as the adapters in references/ say it
        return result, "TIME_LIMIT", result.message
    return result, result.status.name, result.message


@contextmanager
def _limited(seconds: float) -> Iterator[None]:
    """Raise TimeLimit in this process after so many seconds of its CPU time, where the system can.

    Compiled code is not interrupted but at its return to Python.
    """
    if not hasattr(signal, "setitimer") or threading.current_thread() is not threading.main_thread():
        yield
        return

    began = time.process_time()

    def stop(*_: object) -> None:
        if time.process_time() - began >= seconds:
            raise TimeLimit

    # a timer of wall-clock time: one of CPU time makes the clocks of CPU time advance in ticks of 4 ms on Linux
    before = signal.signal(signal.SIGALRM, stop)
    # again and again: an exception raised in a callback of a foreign solver may be swallowed by it
    signal.setitimer(signal.ITIMER_REAL, 1.1 * seconds, min(1.0, 0.5 * seconds))  # a solver's own limit comes first
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)
