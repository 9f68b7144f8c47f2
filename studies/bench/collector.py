"""Collect the rows of the bench: one row for each case, solver, setting and repetition.

A study lists `Run`s, `collect` makes the rows, `tables` summarises them. A case is a mechanism with its reference. The
solvers are in `solvers.py`, the measures of the quality of a run in `metrics.py`.
"""

import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import count
from typing import Any

import numpy as np
import pandas as pd

from references.driver import user_call
from references.lines import CannotRun
from studies.bench import metrics
from studies.bench.apart import Alarm
from studies.bench.cli import say, track
from studies.bench.reference_motion import ReferenceMotion, make_reference
from studies.bench.store import Array, KeptRows, Row
from twoloop import ConstrainedSystem, Result, Statistics, solve_dae
from twoloop.mechanisms import Problem

INSTANTS = 1000  # common instants of a case that names none
WARM_UP = 1e-3  # of the time span, run once by each solver on each case before anything is timed ...
COMPILING = 600.0  # ... with this limit in s: the first runs compile for minutes
AROUND = 10.0  # times the limit of a run, for all that an adapter does beside the user's call: building, output
CALLS, SETTLING = 9, 3  # calls that are timed, and before them some that bring code and data into the caches again
LATER = 1e-9  # of the time span, by which starts lie apart at which runs of ours are timed
BUILDING = 10.0  # s that building or compiling takes at most: the first call of a setting, where shorter, may hold it
REPEATS = 5
FILE = "file"  # family of solvers from files
REMEMBERING = ("two-loop", FILE)  # families that know a start when they see it again, or may
NOTHING_RUN = ("NOT_APPLICABLE", "NOT_AVAILABLE")  # statuses of rows for which no solver was started
ONCE = (*NOTHING_RUN, "TIME_LIMIT")  # which is not asked again
_COUNT = count(1)  # of new starts


class NotApplicable(Exception):
    """Raised by a solver of the catalogue for a case that it cannot run; the text says why."""


@dataclass(frozen=True)
class Case:
    """A mechanism, a time span, and what runs are measured by."""

    name: str  # in tables and rows
    problem: Problem
    t_end: float  # s, that runs last
    # known() -> ReferenceMotion where the motion is known; None: two unlike methods make one
    known: Callable[[], ReferenceMotion] | None = None
    n_instants: int = INSTANTS  # common instants, evenly spaced in (0, t_end]
    # whether the problem's energy is an invariant of the true motion. None: as the problem says, and where it does not,
    # as the reference shows.
    conserved: bool | None = None
    watched: tuple[int, ...] | None = None  # coordinates by which "out of phase" is judged. None: all.
    # s, for solvers of fixed step. None: t_end over 1000, 3000, 10,000, 30,000 and 100,000.
    step_sizes: tuple[float, ...] | None = None
    # for solvers that have one. None: those of the solver, from 1e-3 down; a stiff case asks for looser ones.
    tolerances: tuple[float, ...] | None = None
    time_limit: float = 60.0  # CPU seconds that the call of a run may use that its user writes
    timed: float = 0.1  # s of CPU time: a shorter run is timed by calling it again, CALLS times
    note: str = ""  # what is assumed
    # s, at which runs start; other than 0 for solvers of ours alone, which take their span from `start`
    t0: float = 0.0

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

    @cached_property
    def motion_at_start(self) -> Callable[[float], Any]:
        """States of the motion in the beginning, by the time."""
        system, _, q0, v0 = self.start
        options: dict[str, Any] = {"rtol": 1e-12, "atol": 1e-12, "dense_output": True}
        solution = solve_dae(system, (0.0, WARM_UP * self.t_end), q0, v0, **options).sol
        assert solution is not None
        return solution

    @property
    def start(self) -> tuple[ConstrainedSystem, tuple[float, float], Array, Array]:
        """System, time span, q0 and v0, as all solvers take them."""
        return self.problem.system, (self.t0, self.t0 + self.t_end), self.problem.q0, self.problem.v0

    def steps(self) -> tuple[float, ...]:
        return self.step_sizes or tuple(self.t_end / n for n in (1e3, 3e3, 1e4, 3e4, 1e5))


@dataclass(frozen=True)
class Solver:
    """A solver of the catalogue."""

    name: str  # its line in tables and figures
    family: str  # whose it is: "two-loop" (this project), "SUNDIALS", "SciPy", "Exudyn", "stand-in"
    # what calls the mechanism's functions: "compiled" code, or "Python", which costs microseconds a call
    called_from: str
    # whether the positions stay on the constraints to the solver's tolerance; False: they drift, or are off by the
    # solver's errors
    keeps_constraints: bool
    # what the one number is that varies: "tol" (relative and absolute), "err_out" (the paper's), "h" (fixed step, s)
    setting: str
    # run(case, value, repeat) -> Result, from 0 to case.t_end, within case.time_limit where the solver has such a
    # limit. `repeat` counts from 0; a solver whose error scatters with rounding alone varies its input by it.
    run: Callable[[Case, float, int], Result]
    values: tuple[float, ...] = ()  # values of the setting, loose to tight. Empty: those of the case, for "h".
    # settings that do not vary, numbers or texts, for the row
    fixed: Mapping[str, float | str] = field(default_factory=dict)
    # whether it runs the mechanism's functions once, or has a model of its own, and calls none during a run
    traces: bool = False
    # used(value, result) -> what a solver that chooses among methods took, between which nothing is interpolated
    used: Callable[[float, Result], str] | None = None
    builds_each: bool = False  # whether it compiles or builds anew for each value of the setting, not once a case
    builds_span: bool = False  # whether what it builds holds the time span, so that its warm-up is a whole run

    def took(self, value: float, result: Result | None) -> str:
        """The method that a run took, where the solver chooses; else nothing."""
        return "" if self.used is None or result is None else self.used(value, result)

    def grid(self, case: Case) -> tuple[float, ...]:
        """The values of the setting to run on a case."""
        if self.setting == "tol" and case.tolerances:
            return case.tolerances
        return self.values or case.steps()


@dataclass(frozen=True)
class Run:
    """One cell: a solver on a case at one value of its setting, repeated."""

    case: Case
    solver: Solver
    value: float
    group: str = ""  # part of the study to which the rows belong
    repeats: int = REPEATS

    @property
    def settings(self) -> dict[str, float | str]:
        """Names and values of the settings, for the row."""
        return {**self.solver.fixed, self.solver.setting: self.value}

    def label(self, repeat: int) -> str:
        """The run in a line of progress."""
        values = {name: value for name, value in self.settings.items() if isinstance(value, float)}
        settings = " ".join(f"{name}={value:g}".replace("e-0", "e-") for name, value in values.items())
        again = f" (repetition {repeat + 1} of {self.repeats})" if repeat else ""
        return f"{self.case.name}: {self.solver.name} {settings}{again}"

    def key(self, repeat: int) -> str:
        """What tells one row from all others of the study."""
        settings = " ".join(f"{name}={value!r}" for name, value in sorted(self.settings.items()))
        return f"{self.group} | {self.case.name} to {self.case.t_end!r} | {self.solver.name} | {settings} | {repeat}"


Timed = tuple[Result | None, str, str, dict[str, Any]]  # result, status, message, columns of times
Measure = Callable[[Run, Result], dict[str, Any]]
Warm = set[tuple[int, str, float] | str]  # what has been compiled, see `warm_up`, and the settings called so far


def collect(runs: Iterable[Run], kept: KeptRows, measure: Measure | None = None) -> pd.DataFrame:
    """Make the rows of all runs that are not kept yet: one row a repetition.

    The repetitions of a run are interleaved with those of all others, so that a slow minute of the machine falls on all
    alike; what hits its limit or cannot be run is asked once. A run that fails, exceeds its time limit, or cannot be
    made is a row whose status and message say so.

    `runs`: no two with the same key. `kept`: of the study's `Output`; rows are on disk as soon as they are made.
    `measure`: measure(run, result) -> further columns, of values that JSON holds. Not called where there is no result.

    The rows are in the order of the runs, the repetitions of a run one below the other.

    Raises ValueError if two runs have the same key.
    """
    runs = list(runs)
    order = {run.key(k): (run, k) for run in runs for k in range(run.repeats)}
    if len(order) < sum(run.repeats for run in runs):
        raise ValueError("two runs of the study have the same group, case, solver and settings")
    rounds = range(max((run.repeats for run in runs), default=0))
    left = [(run, k) for k in rounds for run in runs if k < run.repeats and run.key(k) not in kept]
    for case in {id(run.case): run.case for run, _ in left}.values():
        say(f"reference motion of {case.name} to {case.t_end:g} s ...")
        _ = case.scale  # makes the reference, which is not to be timed with anything
    warm: Warm = set()
    # a line for each run, and for its repetitions as far as they take their time
    for run, k in track(left, lambda each: each[0].label(each[1]), lambda each: each[1] == 0):
        if k == 0 or kept[run.key(0)]["status"] not in ONCE:
            kept.add(run.key(k), row_of(run, k, measure, warm))
    return pd.DataFrame([kept[key] for key in order if key in kept])


def row_of(run: Run, k: int, measure: Measure | None, warm: Warm) -> Row:
    """Make a repetition of a run and measure it over the motion."""
    case, solver = run.case, run.solver
    row: Row = {"group": run.group, "case": case.name, "problem": case.problem.name, "solver": solver.name}
    row |= {"family": solver.family, "called_from": called_from(run), "keeps_constraints": solver.keeps_constraints}
    row |= {**run.settings, "t_end": case.t_end, "repeat": k}
    warm_up(run, k, warm)
    result, status, message, times = timed(run, k, warm)
    stats = Statistics() if result is None else result.stats
    row |= {**times, "status": status, "message": message, "used": solver.took(run.value, result)}
    rejected = [n for n in (stats.n_rejected_error, stats.n_rejected_convergence) if n is not None]
    row |= {"n_steps": stats.n_accepted, "n_rejected": sum(rejected) if rejected else None}
    for name in ("n_evaluations", "n_outer", "n_inner", "n_partitions", "n_factorizations", "n_jacobians"):
        row[name] = getattr(stats, name)
    row["floor"] = case.reference.floor
    if result is None:
        return row | metrics.COLUMNS
    try:
        row |= metrics.measure(case, result)
        return row if measure is None else row | measure(run, result)
    except (ArithmeticError, ValueError, np.linalg.LinAlgError) as error:  # the rest of the night goes on
        why = f"{status}, but it cannot be measured: {type(error).__name__}: {error}"
        return row | metrics.COLUMNS | {"status": "NOT_MEASURED", "message": why}


def timed(run: Run, repeat: int, warm: Warm | None = None) -> Timed:
    """A run, its status and message, and what it takes, each call the same: all studies time in this place.

    call_s is the CPU time of the call that a user writes: of solve_dae all of it, of another project's solver what its
    adapter marks (`references.driver`). Where it is shorter than `case.timed`, it is the median of CALLS more, as some
    of ours compare the callbacks along the run, after SETTLING others: the first ones after other work take up to five
    times as long. call_mean_s is their mean. Those of ours begin a little later in the motion, each at a start that no
    call has had, as `solve_dae` remembers starts. The first call of a setting in a process, by `warm` or as the first
    repetition, does not count where it may hold a build. inside_s is what the solver says of the time in its own loop.
    """
    result, status, message, spent = attempt(run, repeat)
    first = repeat == 0 if warm is None else run.key(0) not in warm
    if warm is not None:
        warm.add(run.key(0))
    if first and _may_hold_a_build(run, status, spent):
        result, status, message, spent = attempt(run, repeat)
    if result is None:
        return None, status, message, {"call_s": None, "call_mean_s": None, "inside_s": None, "calls": 0}
    calls = [(spent, result.stats.cpu_time)]
    if result.success and spent < run.case.timed:
        new = run.solver.family in REMEMBERING
        runs = [from_new_start(run) if new else run for _ in range(SETTLING + CALLS)]  # no solver runs between calls
        again = [attempt(each, repeat) for each in runs][SETTLING:]
        calls = [(spent, each.stats.cpu_time) for each, _, _, spent in again if each is not None] or calls
    (call, inside), mean = np.median(calls, axis=0).tolist(), float(np.mean(calls, axis=0)[0])
    times = {"call_s": call or None, "call_mean_s": mean or None, "inside_s": inside or None, "calls": len(calls)}
    return result, status, message, times


def from_new_start(run: Run) -> Run:
    """The same run from a state of the motion soon after the start, at which no run has begun."""
    case = run.case
    t0 = next(_COUNT) * LATER * case.t_end
    state = case.motion_at_start(t0)
    return replace(run, case=replace(case, problem=replace(case.problem, q0=state.q, v0=state.v), t0=t0))


def _may_hold_a_build(run: Run, status: str, spent: float) -> bool:
    """Whether the first call of a setting may have built what the warm-up, at another one, did not take."""
    if status == "TIME_LIMIT":
        return run.case.time_limit <= BUILDING
    return status == "REACHED_END" and 0.0 < run.case.timed <= spent < BUILDING


def warm_up(run: Run, repeat: int, warm: Warm, limit: float = COMPILING) -> None:
    """Let a run compile what it calls, by the beginning of it, unless `warm` has it; a failure comes in the run."""
    what = (id(run.case), run.solver.name, run.value if run.solver.builds_each else 0.0)
    if what in warm:
        return
    warm.add(what)
    if not run.solver.builds_span:
        span = 10.0 * run.value if run.solver.setting == "h" else WARM_UP * run.case.t_end
        run = replace(run, case=replace(run.case, t_end=min(span, run.case.t_end), time_limit=limit))
    attempt(run, repeat, limit)


def called_from(run: Run) -> str:
    """What calls the mechanism: Python wherever functions that are called are Python themselves."""
    in_python = run.case.problem.system.called_in_python and not run.solver.traces
    return "Python" if in_python else run.solver.called_from


def attempt(run: Run, repeat: int, around: float | None = None) -> tuple[Result | None, str, str, float]:
    """Make a run; return its result or None, a status, a message, and the CPU time of the user's call, s.

    The limit applies to the user's call; the adapter may take `around` s in all, by default AROUND times as much.
    """
    result, status, message, spent = None, "", "", 0.0
    user_call.forget()
    limit = run.case.time_limit
    try:
        with Alarm(limit, AROUND * limit if around is None else around) as alarm:
            began = time.process_time()
            result = run.solver.run(run.case, run.value, repeat)
            spent = time.process_time() - began
    except (NotApplicable, CannotRun) as why:  # of ours, and of adapters
        status, message = "NOT_APPLICABLE", str(why)
    except ImportError as error:
        status, message = "NOT_AVAILABLE", str(error)
    except RuntimeError as error:
        # references/ say so what is to be installed for a package that is not there
        status = "NOT_AVAILABLE" if isinstance(error.__context__, ImportError) else "RAISED"
        message = str(error)
    except Exception as error:  # a solver that raises must not end a night of runs: the row says what it raised
        status, message = "RAISED", f"{type(error).__name__}: {error}"
    if alarm.rang:  # whatever a foreign library has made of the exception
        return None, "TIME_LIMIT", alarm.rang, 0.0
    if result is None:
        return None, status, message, 0.0
    spent = spent if user_call.seconds is None else user_call.seconds
    if result.status.name == "INTERRUPTED":  # Ctrl-C, which solve_dae turns into a partial result
        raise KeyboardInterrupt
    if not result.success and "time_limit =" in result.message:  # as the adapters in references/ say it
        return result, "TIME_LIMIT", result.message, spent
    return result, result.status.name, result.message, spent
