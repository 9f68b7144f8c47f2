"""Runs of a sweep whose problems share their callbacks: made together, as `ensemble` makes them."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from twoloop.checks.arguments import Array, check_span, check_times, check_tolerance, check_vector
from twoloop.ensembles.in_turn import CALL, ManyRuns
from twoloop.ensembles.lane_methods import IN_LANES
from twoloop.ensembles.starts import Starts, far_off, kit_to_write
from twoloop.kernels.data.common import PROGRAMS
from twoloop.kernels.layout import give_back
from twoloop.problem.system import ConstrainedSystem
from twoloop.result.result import Result
from twoloop.run.between import interpolator_of
from twoloop.run.launch import run_from
from twoloop.run.record import DEFAULTS, NOT_OF_STATES, Statistics, Status, record_of
from twoloop.solve import check_method, check_options
from twoloop.sweeps.cells import Row
from twoloop.sweeps.digests import digest_of
from twoloop.sweeps.one_run import Work, call_of, ends, one_run, problem_for, solved

if TYPE_CHECKING:
    from twoloop.problem.problem import Problem

OPTIONS = {"t_span", "method", "rtol", "atol", "t_eval", "check_derivatives"}  # with which runs may go together
TIMES = 101  # of a run at which its energy is looked at, where nothing else is measured
TOLERANCE = 1e-8  # of a run that was given none
ROOM = 5_000_000  # numbers of the states of runs that are made together
LONGEST = 10.0  # s, after which a task hands back what it has, so that it is saved
AHEAD = 0.2  # of this time, in which problems are made before their turn
FEW = 8  # problems after which it is clear whether any share their callbacks, and what it costs to make them: ...
DEAR = 2.0  # ... no more than so many times what their runs take singly
CHUNK = 2.0  # s that runs may take singly which lanes make at a time, as nothing interrupts these
NOTICED = 0.1  # s of problems that cost more, of which fewer are enough


def may_be_shared(work: Work) -> bool:
    """Whether states at given times are all that runs have to leave, and lanes know the method."""
    _, measure, options = work
    method = options.get("method", "auto")
    by_times = measure is ends or options.get("t_eval") is not None
    return by_times and options.keys() <= OPTIONS and isinstance(method, str) and method in IN_LANES


def batch(work: Work, given: list[Row]) -> list[Row]:
    """The rows of the first of these runs, as many as there is time for; executed by a worker."""
    began, rows = time.monotonic(), []
    runs = _Batch(work, given) if len(given) > 2 and may_be_shared(work) else None
    for number, each in enumerate(given):
        if number > 0 and time.monotonic() - began > LONGEST:
            break
        rows.append(one_run(work, each) if runs is None else runs.row(number))
    return rows


class _Start(NamedTuple):
    """What a run is, for lanes."""

    group: Any  # equal for runs that differ in what follows alone
    parameters: Array
    q0: Array
    v0: Array

    def same(self, other: _Start | None) -> bool:
        """Whether it is the same run."""
        return other is not None and self.group == other.group and all(map(np.array_equal, self[1:], other[1:]))


class _Batch:
    """Runs one after another, each with a problem of its own; where lanes have made an equal run, that is taken.

    So that lanes can make many at once, problems are made before their turn, and then anew: what `problem_of` leaves
    anywhere is there for `measure` as if there were no lanes. Where the second problem is another, its run is single.
    """

    def __init__(self, work: Work, given: list[Row]):
        self.work, self.given = work, given
        self.starts: dict[int, _Start] = {}
        self.systems: dict[Any, ConstrainedSystem] = {}  # one of each group, which also keeps its callbacks alive
        self.firsts: dict[Any, tuple[_Start, Result]] = {}  # a single run of each group
        self.made: dict[Any, _Runs] = {}  # by groups, what lanes made last
        self.number, self.seconds = 0, 0.0  # of the run that has its turn: its share of the time of lanes

    def row(self, number: int) -> Row:
        """That of a run; those before it have theirs."""
        self.number, self.seconds = number, 0.0
        if number > 0:
            self._make()
            row = one_run(self.work, self.given[number], self._result)
            return row | {"seconds": row["seconds"] + self.seconds}
        before = self._reached()
        row = one_run(self.work, self.given[0], self._result)
        if before is not None and before == self._reached():
            self._look_ahead()
        return row

    def _reached(self) -> str | None:
        """A digest of what the functions reach: most of those that keep something are known by it at once."""
        try:
            return digest_of("work", self.work[:2])
        except (ValueError, RecursionError):
            return None

    def _look_ahead(self) -> None:
        """Note what the runs are, unless that costs more than to solve them, or no two share their callbacks."""
        began = time.monotonic()
        single = [result.stats.cpu_time + CALL for _, result in self.firsts.values()]
        for number, each in enumerate(self.given[1:], start=1):
            try:
                problem = problem_for(self.work, each)
            except (Exception, SystemExit):  # it is said when its turn comes
                continue
            start = _start_of(self.work, problem)
            if start is not None:
                self.starts[number] = start
                self.systems.setdefault(start.group, problem.system)
            spent = time.monotonic() - began
            dear = spent > DEAR * number * max(single, default=spent)
            if (number >= FEW and (dear or self._none_share())) or (dear and spent > NOTICED):
                self.starts.clear()
                self.systems.clear()
                return
            if spent > AHEAD * LONGEST:
                return

    def _none_share(self) -> bool:
        return len(self.starts) < 2 or len(self.systems) >= len(self.starts)

    def _make(self) -> None:
        """Have lanes make those that share callbacks with the run that has its turn, if they have not yet."""
        start = self.starts.get(self.number)
        if start is None or start.group not in self.firsts:
            return
        known = self.made.get(start.group)
        if known is None or self.number not in known.places:
            first, result = self.firsts[start.group]
            in_time = int(CHUNK / (result.stats.cpu_time + CALL))
            most = max(1, min(ROOM // (2 * start.q0.size * _n_times(self.work)), max(in_time, FEW)))
            alike = [n for n, each in self.starts.items() if n >= self.number and each.group == start.group]
            starts = {number: self.starts[number] for number in alike[:most]}
            runs = self.made[start.group] = _Runs(self.work, self.systems[start.group], first, result, starts)
            if not runs.runs.in_lanes.any():  # nor will others
                for number in alike[most:]:
                    del self.starts[number]

    def _result(self, work: Work, problem: Problem) -> Result:
        """What lanes made of a run, else its own."""
        start, more = _start_of(work, problem), {}
        if start is not None and start.same(self.starts.get(self.number)) and start.group in self.made:
            runs = self.made[start.group]
            if runs.has(self.number):
                self.seconds = runs.seconds
                return runs.result(self.number, problem)
            more = runs.more(self.number)
        result = solved(work, problem, **more)
        if start is not None and self.number == 0:
            self.systems[start.group] = problem.system
        if start is not None and start.group in self.systems:
            self.firsts.setdefault(start.group, (start, result))
        return result


class _Runs:
    """Runs that share their callbacks, in lanes as far as they go.

    Parameters
    ----------
    work
    system : ConstrainedSystem
        One of the group.
    first, result
        A run of the group that was made singly, and its result.
    starts : dict of int to _Start
        Of the runs, by their numbers.
    """

    def __init__(self, work: Work, system: ConstrainedSystem, first: _Start, result: Result, starts: dict[int, _Start]):
        self.work, options = work, work[2]
        (t0, t1), *_ = first.group
        rtol, atol = (options.get(name, TOLERANCE) for name in ("rtol", "atol"))
        wanted = options.get("t_eval")
        times = np.linspace(t0, t1, TIMES) if wanted is None else check_times(wanted, t0, t1, None)
        runs = (first, *starts.values())
        q0, v0, parameters = (np.array([getattr(each, name) for each in runs]) for name in ("q0", "v0", "parameters"))
        given = Starts(t0, q0, v0, parameters)
        fine = ~far_off(kit_to_write(system), given)
        fine[0] = True  # it was made
        taken = np.array(list(starts))[fine[1:]].tolist()
        self.places = dict.fromkeys(starts, -1) | {number: place for place, number in enumerate(taken, start=1)}
        self.runs = ManyRuns(
            system, given.some(np.flatnonzero(fine)), t1, times, float(rtol), check_tolerance("atol", atol, system.n_q)
        )
        began = time.perf_counter()
        self.runs.make_in_lanes(options.get("method", "auto"), result, threads=1)
        self.seconds = (time.perf_counter() - began) / max(1, int(self.runs.in_lanes.sum()))

    def has(self, number: int) -> bool:
        """Whether lanes made a run."""
        return self.places[number] > 0 and bool(self.runs.in_lanes[self.places[number]])

    def more(self, number: int) -> dict[str, float]:
        """Options for a run that is left."""
        step = self.runs.max_step(self.places[number])
        return {} if step == np.inf else {"max_step": step}

    def result(self, number: int, problem: Problem) -> Result:
        """What lanes left of a run; for what they do not know it is made singly, when that is asked for."""
        work, runs, place, system = self.work, self.runs, self.places[number], problem.system
        counts = int(runs.n_steps[place]), int(runs.n_evaluations[place])
        stats = Statistics(n_accepted=counts[0], n_evaluations=counts[1], cpu_time=self.seconds)
        message = f"Reached the end, t = {runs.t1:g}, in lanes by {runs.methods[runs.turn[place]]}."

        def later(name: str) -> dict[str, Any]:
            return _accelerations(system, runs, place) if name in ("a", "lam") else _not_of_states(work, problem)

        told = {name: value for name, value in DEFAULTS.items() if name not in NOT_OF_STATES} | {
            **{"t": runs.times.copy(), "q": runs.q[place].copy(), "v": runs.v[place].copy()},
            **{"status": Status.REACHED_END, "message": message, "system": system, "later": later},
            **{"method": check_method(work[2].get("method", "auto")).name, "rtol": runs.rtol, "atol": runs.atol.copy()},
        }
        return record_of(Result, told | ({"stats": stats} if work[1] is ends else {}))


def _not_of_states(work: Work, problem: Problem) -> dict[str, Any]:
    """Counts, steps and what else only a single run tells."""
    result = solved(work, problem)
    return {name: getattr(result, name) for name in NOT_OF_STATES}


def _accelerations(system: ConstrainedSystem, runs: ManyRuns, place: int) -> dict[str, Array]:
    """Accelerations and multipliers at the states of a run, found as those between the steps of single runs."""
    none = (None, np.inf, None, None, False, None, None, False, False)
    asked = check_options(system, "auto", runs.rtol, runs.atol, *none)
    starts = runs.starts
    run = run_from(system, starts.t0, runs.t1, starts.q[place], starts.v[place], asked)
    n, states = system.n_q, np.concatenate([runs.q[place], runs.v[place]]).T
    found = np.full((len(states), len(run.state) - 2 * n), np.nan)
    interpolator_of(run, run.state[: 3 * n]).complete(runs.times, states, found)
    give_back(run.work)
    return {"a": found[:, :n].T, "lam": found[:, n:].T}


def _n_times(work: Work) -> int:
    wanted = work[2].get("t_eval")
    return TIMES if wanted is None else int(np.size(wanted))


def _start_of(work: Work, problem: Problem) -> _Start | None:
    """What a run is; None where callbacks are in Python, as these may read anything, or the start is not in order."""
    system = problem.system
    if not isinstance(system, ConstrainedSystem) or system.called_in_python:
        return None
    call = call_of(work, problem)
    try:
        span = check_span(call["t_span"])
        q0, v0 = (check_vector(name, call[name], system.n_q) for name in ("q0", "v0"))
    except (TypeError, ValueError):  # as `solve_dae` says
        return None
    return _Start((span, *_callbacks_of(system)), system.parameters, q0, v0)


def _callbacks_of(system: ConstrainedSystem) -> tuple[Any, ...]:
    """Equal for systems that differ in nothing but their parameters, as long as one of them lives."""
    sizes = system.n_q, system.n_c, system.n_a, system.bandwidth, system.constant_mass, system.parameters.size
    entries = [(kind, *(each.tobytes() for each in pair)) for kind, pair in sorted(system.entries.items())]
    programs = [getattr(system.functions, name).tobytes() for name in PROGRAMS]
    return *sizes, *entries, *programs, *((kind, id(function)) for kind, function in sorted(system.given.items()))
