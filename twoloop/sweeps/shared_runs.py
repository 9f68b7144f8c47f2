"""Runs of a sweep whose problems share their callbacks: made together, as `ensemble` makes them."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any

import numpy as np

from twoloop.checks.arguments import Array, check_span, check_times, check_tolerance
from twoloop.ensembles.in_turn import ManyRuns
from twoloop.ensembles.lane_methods import IN_LANES
from twoloop.ensembles.starts import Starts, far_off, kit_to_write
from twoloop.kernels.data.common import PROGRAMS
from twoloop.kernels.layout import give_back
from twoloop.problem.adapters import ConstantMatrix
from twoloop.problem.system import ConstrainedSystem
from twoloop.result.result import Result, result_of
from twoloop.run.between import interpolator_of
from twoloop.run.launch import run_from
from twoloop.run.record import DEFAULTS, Later, Statistics, Status
from twoloop.solve import check_options
from twoloop.sweeps.cells import Row
from twoloop.sweeps.digests import digest_of
from twoloop.sweeps.one_run import Work, call_of, ends, failed_by, one_run, problem_for, row_of, solved

if TYPE_CHECKING:
    from twoloop.problem.problem import Problem

OPTIONS = {"t_span", "method", "rtol", "atol", "t_eval", "check_derivatives"}  # with which runs may go together
TIMES = 101  # of a run at which its energy is looked at, where nothing else is measured
TOLERANCE = 1e-8  # of a run that was given none
ROOM = 5_000_000  # numbers of the states of runs that are made together


def may_be_shared(work: Work) -> bool:
    """Whether states at given times are all that runs have to leave, and lanes know the method."""
    _, measure, options = work
    method = options.get("method", "auto")
    by_times = measure is ends or options.get("t_eval") is not None
    return by_times and options.keys() <= OPTIONS and isinstance(method, str) and method in IN_LANES


def batch(work: Work, given: list[Row]) -> list[Row]:
    """The rows of some runs; executed by a worker."""
    if len(given) == 1 or not may_be_shared(work):
        return [one_run(work, each) for each in given]
    return _Batch(work, given).rows()


class _Batch:
    """Runs of which some may share their callbacks.

    All problems are made before the first is solved. Where that matters, as they leave something in globals that
    `problem_of`, `measure` or callbacks read, or change arrays of one another, runs are made one by one.
    """

    def __init__(self, work: Work, given: list[Row]):
        self.work, self.given = work, given
        self.made: dict[int, Row] = {}
        self.problems: dict[int, Problem] = {}
        self.starts: dict[int, tuple[bytes, bytes]] = {}
        self.seconds: dict[int, float] = {}  # that `problem_of` took

    def rows(self) -> list[Row]:
        """One for each run."""
        before = self._reached()
        if before is None or not self._build(before):
            return [self.made.get(k) or one_run(self.work, each) for k, each in enumerate(self.given)]
        groups: dict[Any, list[int]] = {}
        for number, problem in self.problems.items():
            span = call_of(self.work, problem)["t_span"]
            groups.setdefault((tuple(span), *_callbacks_of(problem.system)), []).append(number)
        wanted = self.work[2].get("t_eval")
        for numbers in groups.values():
            n_states = 2 * self.problems[numbers[0]].system.n_q * (TIMES if wanted is None else np.size(wanted))
            most = max(1, ROOM // n_states)
            for k in range(0, len(numbers), most):
                self._solve(numbers[k : k + most])
        return [self.made[k] for k in range(len(self.given))]

    def _reached(self) -> str | None:
        """A digest of all that the functions reach; None where that cannot be read."""
        try:
            return digest_of("work", self.work[:2])
        except ValueError:
            return None

    def _build(self, before: str) -> bool:
        """Make the problems; whether these left what the functions reach as it was."""
        for number, each in enumerate(self.given):
            began = time.perf_counter()
            try:
                self.problems[number] = problem_for(self.work, each)
                self.starts[number] = _start_of(self.problems[number])
            except (Exception, SystemExit) as error:
                self.made[number] = failed_by(error, began)
            self.seconds[number] = time.perf_counter() - began
            if number == 0 and self._reached() != before:
                if number in self.problems:
                    self._solve_singly(number)
                return False
        if self._reached() == before and all(_start_of(each) == self.starts[k] for k, each in self.problems.items()):
            return True
        self.made = {}
        return False

    def _solve_singly(self, number: int, **closer: float) -> Result | None:
        """Make the row of a run as if there were no others; its result, if there is one."""
        began, problem, result = time.perf_counter() - self.seconds[number], self.problems[number], None
        try:
            result = solved(self.work, problem, **closer)
            seconds = time.perf_counter() - began
            self.made[number] = row_of(self.work, self.given[number], problem, result, seconds)
        except (Exception, SystemExit) as error:
            self.made[number] = failed_by(error, began)
        return result

    def _solve(self, numbers: list[int]) -> None:
        """Make the rows of runs that share their callbacks; the first that raises nothing is that of `ensemble`."""
        first = None
        while numbers and first is None:
            beginning, first = numbers[0], self._solve_singly(numbers[0])
            numbers = numbers[1:]
        if first is None or not numbers:
            return
        runs = _Runs(self.work, [self.problems[number] for number in (beginning, *numbers)])
        runs.make(first)
        for k, number in enumerate(numbers, start=1):
            if not self._take(number, runs, k):
                self._solve_singly(number, **runs.closer(k))

    def _take(self, number: int, runs: _Runs, k: int) -> bool:
        """Make the row of a run by what lanes left of it; False if there is nothing, or measures ask for more."""
        if not runs.has(k):
            return False
        problem, seconds = self.problems[number], self.seconds[number] + runs.seconds
        try:
            row = row_of(self.work, self.given[number], problem, runs.result(k, problem.system), seconds)
        except (Exception, SystemExit):  # it may be for what is None there
            return False
        if any(value is None for value in row.values()):
            return False
        self.made[number] = row
        return True


class _Runs:
    """Runs that share their callbacks, in lanes as far as they go."""

    def __init__(self, work: Work, problems: list[Problem]):
        options, system = work[2], problems[0].system
        self.method = options.get("method", "auto")
        self.rtol = float(options.get("rtol", TOLERANCE))
        self.atol = check_tolerance("atol", options.get("atol", TOLERANCE), system.n_q)
        t0, t1 = check_span(call_of(work, problems[0])["t_span"])
        wanted = options.get("t_eval")
        times = np.linspace(t0, t1, TIMES) if wanted is None else check_times(wanted, t0, t1, None)
        rows = ([each.q0 for each in problems], [each.v0 for each in problems])
        q0, v0 = (np.array(each, dtype=float, order="C") for each in rows)
        starts = Starts(t0, q0, v0, np.array([each.system.parameters for each in problems]))
        refused = far_off(kit_to_write(system), starts)
        refused[0] = False  # it was made by itself already
        self.which = np.flatnonzero(~refused)
        self.places = {int(run): place for place, run in enumerate(self.which)}
        self.runs = ManyRuns(system, starts.some(self.which), t1, times, self.rtol, self.atol)
        self.seconds = 0.0

    def make(self, first: Result) -> None:
        """Have lanes make what they can; the first of the runs is there."""
        began = time.perf_counter()
        self.runs.make_in_lanes(self.method, first, threads=1)
        self.seconds = (time.perf_counter() - began) / max(1, int(self.runs.in_lanes.sum()))

    def has(self, run: int) -> bool:
        """Whether lanes made a run."""
        return run in self.places and bool(self.runs.in_lanes[self.places[run]])

    def closer(self, run: int) -> dict[str, float]:
        """What a run that is left is to be made with."""
        step = self.runs.max_step(self.places[run]) if run in self.places else np.inf
        return {} if step == np.inf else {"max_step": step}

    def result(self, run: int, system: ConstrainedSystem) -> Result:
        """What lanes left of a run, and of other fields None, as of a foreign solver."""
        runs, place = self.runs, self.places[run]
        q, v, times = runs.q[place].copy(), runs.v[place].copy(), runs.times.copy()
        later = Later(lambda: _accelerations(system, runs, place))
        counts = int(runs.n_steps[place]), int(runs.n_evaluations[place])
        method = runs.methods[runs.turn[place]]
        told = {
            **{"t": times, "q": q, "v": v, "a": later, "lam": later, "h": None, "system": system},
            **{"status": Status.REACHED_END, "message": f"Reached the end, t = {runs.t1:g}, in lanes by {method}."},
            "stats": Statistics(n_accepted=counts[0], n_evaluations=counts[1], cpu_time=self.seconds),
            **{"method": method, "rtol": self.rtol, "atol": self.atol.copy(), "compiled": True},
        }
        return result_of(DEFAULTS | told)


def _start_of(problem: Problem) -> tuple[bytes, bytes]:
    return np.asarray(problem.q0, dtype=float).tobytes(), np.asarray(problem.v0, dtype=float).tobytes()


def _accelerations(system: ConstrainedSystem, runs: ManyRuns, k: int) -> dict[str, Array]:
    """Accelerations and multipliers at the states of a run, found as those between the steps of single runs."""
    none = (None, np.inf, None, None, False, None, None, False, False)
    asked = check_options(system, "auto", runs.rtol, runs.atol, *none)
    starts = runs.starts
    run = run_from(system, starts.t0, runs.t1, starts.q[k], starts.v[k], asked)
    n, states = system.n_q, np.concatenate([runs.q[k], runs.v[k]]).T
    found = np.full((len(states), len(run.state) - 2 * n), np.nan)
    interpolator_of(run, run.state[: 3 * n]).complete(runs.times, states, found)
    give_back(run.work)
    return {"a": found[:, :n].T, "lam": found[:, n:].T}


def _callbacks_of(system: ConstrainedSystem) -> tuple[Any, ...]:
    """Equal for systems that differ in nothing but their parameters, as long as these live."""
    sizes = system.n_q, system.n_c, system.n_a, system.bandwidth, system.constant_mass, system.parameters.size
    entries = [(kind, *(each.tobytes() for each in pair)) for kind, pair in sorted(system.entries.items())]
    programs = [getattr(system.functions, name).tobytes() for name in PROGRAMS]
    functions = system.python_functions or system.given
    return *sizes, *entries, *programs, *((kind, _identity(each)) for kind, each in sorted(functions.items()))


def _identity(function: Any) -> Any:
    return function.matrix.tobytes() if isinstance(function, ConstantMatrix) else id(function)
