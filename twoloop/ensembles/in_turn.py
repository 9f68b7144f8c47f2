"""Runs of one system that go in lanes, by one method after another, and why the others do not."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from twoloop.checks.arguments import Array
from twoloop.ensembles.in_lanes import LOOKS, SHORT, WHY, LaneRuns
from twoloop.ensembles.lane_methods import is_involved, lane_methods
from twoloop.ensembles.starts import Starts, far_off, generic_system, system_of
from twoloop.generate.graph import Untraceable
from twoloop.problem.system import ConstrainedSystem
from twoloop.result.result import Result

Integers = NDArray[np.int64]
Flags = NDArray[np.bool_]

FAR = 1e5  # tolerances, by which a motion that is not chaotic does not end elsewhere
CALL = 1e-3  # s of a call of solve_dae beside its steps
WORTH = 20.0  # times what the runs of a call take singly: what their code may take to compile, as it is kept


@dataclass
class ManyRuns:
    """Runs of one system from t0 to t1, and what came of them so far.

    Attributes
    ----------
    system : ConstrainedSystem
    starts : Starts
    t1 : float
    times : ndarray (n_t,)
        At which states are wanted.
    rtol, atol : float, ndarray (n_q,)
    q, v : ndarray (n_runs, n_q, n_t)
        NaN where there is nothing yet.
    n_steps, n_evaluations : ndarray (n_runs,)
    methods : list of str
        Those that made runs in lanes.
    turn : ndarray (n_runs,)
        Which of them made each run; -1: none.
    reasons : dict
        Why others were left, by their numbers.
    why : str
        Why none was made, or the first method made none.
    """

    system: ConstrainedSystem
    starts: Starts
    t1: float
    times: Array
    rtol: float
    atol: Array
    q: Array = field(init=False)
    v: Array = field(init=False)
    n_steps: Integers = field(init=False)
    n_evaluations: Integers = field(init=False)
    turn: NDArray[np.int8] = field(init=False)
    methods: list[str] = field(default_factory=list)
    reasons: dict[int, str] = field(default_factory=dict)
    why: str = ""

    def __post_init__(self) -> None:
        n_runs = len(self.starts.q)
        self.q, self.v = np.full((2, n_runs, self.system.n_q, len(self.times)), np.nan)
        self.n_steps, self.n_evaluations = np.zeros((2, n_runs), dtype=np.int64)
        self.turn = np.full(n_runs, -1, dtype=np.int8)

    @property
    def in_lanes(self) -> Flags:
        """Which runs were made in lanes."""
        made: Flags = self.turn >= 0
        return made

    def make_in_lanes(self, method: str, first: Result, threads: int) -> None:
        """Make those that lanes can make, by the methods of a preset.

        `first` is the first run, made singly: it says whether the motion is stiff and what runs cost, and lanes have
        to end where it does.

        Raises
        ------
        ValueError
            If a start is not consistent, naming the run.
        """
        stiff = (first.stats.n_jacobians or 0) > 0
        involved = method == "auto" and not stiff and is_involved(generic_system(self.system, self.starts))
        tolerances = self.rtol, float(self.atol.min())
        for each in lane_methods(method, stiff, self.system.n_q, *tolerances, involved):
            left = np.flatnonzero(~self.in_lanes)
            if len(left) == 1:
                break
            try:
                lanes = LaneRuns(self.system, self.starts, each)
                singly = len(left) * (first.stats.cpu_time + CALL)
                if lanes.own.seconds_to_build > WORTH * singly:
                    raise Untraceable(f"to compile them does not pay for these runs, which take about {singly:.2g} s")
                self._make(lanes, left, first, threads)
            except Untraceable as reason:
                self.why = self.why or str(reason)

    def max_step(self, run: int) -> float:
        """Of a run that is left: what was met in short looks is to be met again."""
        return (self.t1 - self.starts.t0) / LOOKS if self.reasons.get(run) == WHY[SHORT] else np.inf

    def _make(self, lanes: LaneRuns, which: Integers, first: Result, threads: int) -> None:
        """Have these runs made.

        Raises
        ------
        Untraceable
            If the first one ends elsewhere than by itself.
        """
        starts, t1, times, rtol, atol = self.starts, self.t1, self.times, self.rtol, self.atol
        for run in which[far_off(lanes.kit, starts)[which]].tolist():
            _check_start(self.system, starts, run)
        within = times[times > starts.t0]
        ends = within if within.size and within[-1] == t1 else np.append(within, t1)
        q, v = np.full((2, len(which), self.system.n_q, len(ends)), np.nan)
        status, steps, evaluations, at_end = lanes.make(which, t1, ends, rtol, atol, threads, q, v)
        fine = lanes.judge(which, status, t1, rtol, float(atol.min()), q, v, at_end)
        if fine[0] and first.success:
            known = first.q[:, -1:]
            off = np.abs(q[0][:, ends == first.t[-1]] - known)  # of nothing, where that time is not among these
            if (off > FAR * (atol[:, None] + rtol * np.abs(known))).any():
                raise Untraceable(f"the first run ends elsewhere by itself, {FAR:g} tolerances and more away")
        fine[0] = False
        n, runs = len(within), which[fine]
        for states, own, start in ((self.q, q, starts.q), (self.v, v, starts.v)):
            if len(which) == len(states):  # twice as fast as by their numbers
                np.copyto(states[:, :, len(times) - n :], own[:, :, :n], where=fine[:, None, None])
            else:
                states[runs, :, len(times) - n :] = own[fine, :, :n]
            if n < len(times):
                states[runs, :, 0] = start[runs]
        self.n_steps[runs], self.n_evaluations[runs] = steps[fine], evaluations[fine]
        self.turn[runs] = len(self.methods)
        self.methods.append(lanes.method.name)
        left = np.flatnonzero(~fine)
        self.reasons |= {int(which[i]): WHY[int(status[i])] for i in left.tolist() if which[i] > 0}


def _check_start(system: ConstrainedSystem, starts: Starts, run: int) -> None:
    """Raise unless the start of a run is consistent."""
    from twoloop.checks.consistency import check_start

    try:
        check_start(system_of(system, starts, run), starts.t0, starts.q[run], starts.v[run], derivatives=False)
    except ValueError as error:
        raise of_run(run, error) from error


def of_run(run: int, error: ValueError) -> ValueError:
    """The error of a single run, with its number, and the function for many runs in the place of that for one."""
    return ValueError(f"run {run}: {error}".replace("twoloop.consistent_state(", "twoloop.consistent_states("))
