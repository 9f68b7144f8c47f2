"""Integrate thousands of runs of one system (`ensemble`), in SIMD lanes and threads, or one at a time."""

from __future__ import annotations  # so that help() shows the name ArrayLike

import time
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from twoloop.checks.arguments import Array, check_positive, check_size, check_span, check_times, check_tolerance
from twoloop.ensembles.lanes import (
    IN_LANES,
    N_SHORT,
    REASONS,
    SHORT_FORCE,
    LaneRuns,
    is_series_costly,
    lane_methods,
    threads_of,
)
from twoloop.ensembles.starts import Starts, all_starts, generic_system, is_inconsistent, system_of
from twoloop.generate.graph import Untraceable
from twoloop.methods.plan import Method
from twoloop.problem.system import ConstrainedSystem, check_system
from twoloop.result.result import Result
from twoloop.run.options import check_method
from twoloop.run.record import Status
from twoloop.run.signals import SignalHandlers
from twoloop.solve import solve_dae

Integers = NDArray[np.int64]


@dataclass(frozen=True)
class Runs:
    """Results of many runs, one run per entry of the first axis.

    Attributes
    ----------
    t : ndarray (n_t,)
        Times, s: `t_eval`, or start and end.
    q, v : ndarray (n_runs, n_q, n_t)
        Coordinates and velocities; NaN at times that a run did not reach.
    status : ndarray (n_runs,)
        As `Result.status`: 0 where the end was reached, negative where a run failed.
    success : ndarray (n_runs,) of bool
    n_steps : ndarray (n_runs,)
        Accepted steps.
    n_evaluations : ndarray (n_runs,)
        Solutions for accelerations, as `Statistics` counts them.
    singly : ndarray (n_runs,) of bool
        Runs that `solve_dae` integrated one at a time, not in SIMD lanes.
    message : str
        How many runs reached the end, how many were integrated in lanes and by which method, how many one at a time and
        why.
    messages : dict of int to str
        Messages of `solve_dae` for the runs that failed, by their numbers.
    reasons : dict of int to str
        Why runs were integrated one at a time, by their numbers.

    Examples
    --------
    >>> import numpy as np
    >>> from twoloop import ensemble
    >>> from twoloop.mechanisms import pendulum
    >>> problem = pendulum()
    >>> speeds = np.array([0.0, 0.5, 1.0])
    >>> v0 = np.outer(speeds, [0.0, 1.0])  # along the circle
    >>> runs = ensemble(problem.system, (0.0, 1.0), problem.q0, v0, t_eval=[0.0, 0.5, 1.0])
    >>> runs.v.shape, runs.status.shape
    ((3, 2, 3), (3,))
    """

    t: Array
    q: Array
    v: Array
    status: Integers
    n_steps: Integers
    n_evaluations: Integers
    singly: NDArray[np.bool_]
    message: str
    messages: dict[int, str]
    reasons: dict[int, str]

    @property
    def success(self) -> NDArray[np.bool_]:
        """Whether each run reached its end."""
        success: NDArray[np.bool_] = self.status >= 0
        return success

    def __len__(self) -> int:
        return len(self.status)

    def __repr__(self) -> str:
        return f"<{len(self)} runs to t = {self.t[-1]:g}: {self.message}>"


Flags = NDArray[np.bool_]

MAX_DISTANCE = 1e5  # largest distance of a run in lanes from the first run, in tolerances, unless the motion is chaotic
CALL = 1e-3  # time, s, that a call of solve_dae takes besides its steps
# largest ratio of compilation time to the time of single runs; it may exceed 1, as code is cached for later calls
MAX_COMPILATION = 20.0


@dataclass
class LaneEnsemble:
    """Runs of one system from t0 to t1, and their results so far."""

    system: ConstrainedSystem
    starts: Starts
    t1: float
    times: Array  # output times
    rtol: float
    atol: Array
    method: Method
    events: Any

    def __post_init__(self) -> None:
        n_runs = len(self.starts.q)
        # coordinates and velocities (n_runs, n_q, n_t); NaN where there is no result yet
        self.q, self.v = np.full((2, n_runs, self.system.n_q, len(self.times)), np.nan)
        self.status, self.n_steps, self.n_evaluations = np.zeros((3, n_runs), dtype=np.int64)
        self.methods: list[str] = []  # methods that integrated runs in lanes
        self.method_of = np.full(n_runs, -1, dtype=np.int8)  # index in `methods` for each run in lanes; -1: none
        self.reasons: dict[int, str] = {}  # why runs were left to `solve_dae`, by their numbers
        self.messages: dict[int, str] = {}  # messages of the runs that failed, by their numbers
        self.refusal = ""  # why no run was integrated in lanes, or why the first method integrated no run
        self.deadline = np.inf  # time of `time.monotonic` at which runs stop; compilation delays it

    @property
    def in_lanes(self) -> Flags:
        """Whether each run was integrated in lanes."""
        in_lanes: Flags = self.method_of >= 0
        return in_lanes

    def integrate_in_lanes(self, method: str, first: Result, threads: int) -> None:
        """Integrate the runs that can be integrated in lanes, by the methods of a preset.

        `first` is the first run, integrated by `solve_dae`. It shows whether the motion is stiff and what runs cost,
        and its end is compared with the end of the same run in lanes. Raise ValueError if a start is not consistent.
        """
        stiff = (first.stats.n_jacobians or 0) > 0
        series_is_costly = method == "auto" and not stiff and is_series_costly(generic_system(self.system, self.starts))
        tolerances = self.rtol, float(self.atol.min())
        for each in lane_methods(method, stiff, self.system.n_q, *tolerances, series_is_costly):
            remaining = np.flatnonzero(~self.in_lanes)
            if len(remaining) == 1:
                break
            try:
                began = time.monotonic()
                lanes = LaneRuns(self.system, self.starts, each)
                self.deadline += time.monotonic() - began
                time_singly = len(remaining) * (first.stats.cpu_time + CALL)
                if lanes.generated.seconds_to_build > MAX_COMPILATION * time_singly:
                    raise Untraceable(
                        f"to compile them does not pay for these runs, which take about {time_singly:.2g} s"
                    )
                self._integrate(lanes, remaining, first, threads)
            except Untraceable as reason:
                self.refusal = self.refusal or str(reason)

    def solve_singly(self, run: int, time_limit: float, factor: float = 1.0) -> Result:
        """Integrate a run by `solve_dae`, with `factor` times the tolerances, and record its result."""
        options: dict[str, Any] = {"time_limit": time_limit} if time_limit < np.inf else {}
        if self.reasons.get(run) == REASONS[SHORT_FORCE]:  # lanes found short forces in this run
            options["max_step"] = (self.t1 - self.starts.t0) / N_SHORT
        options |= {"method": self.method, "rtol": factor * self.rtol, "atol": factor * self.atol}
        options |= {"t_eval": self.times, "events": self.events}
        start, system = (self.starts.q[run], self.starts.v[run]), system_of(self.system, self.starts, run)
        try:
            result = solve_dae(system, (self.starts.t0, self.t1), *start, **options)
        except ValueError as error:
            raise add_run_number(run, error) from error
        if result.status is Status.INTERRUPTED:  # Ctrl-C ends all runs, as it does in lanes
            raise KeyboardInterrupt
        for out, states in ((self.q, result.q), (self.v, result.v)):
            out[run, :, : len(result.t)], out[run, :, len(result.t) :] = states, np.nan
        self.status[run], self.n_steps[run] = int(result.status), result.stats.n_accepted or 0
        self.n_evaluations[run] = result.stats.n_evaluations or 0
        self.messages.pop(run, None)
        if not result.success:
            self.messages[run] = result.message
        return result

    def _integrate(self, lanes: LaneRuns, numbers: Integers, first: Result, threads: int) -> None:
        """Integrate the runs `numbers` in lanes; raise Untraceable if run 0 does not end where `first` does."""
        starts, t1, times, rtol, atol = self.starts, self.t1, self.times, self.rtol, self.atol
        for run in numbers[is_inconsistent(lanes.kit, starts)[numbers]].tolist():
            _check_start(self.system, starts, run)
        inner_times = times[times > starts.t0]
        output_times = inner_times if inner_times.size and inner_times[-1] == t1 else np.append(inner_times, t1)
        q, v = np.full((2, len(numbers), self.system.n_q, len(output_times)), np.nan)
        status, steps, evaluations, at_end = lanes.integrate(
            numbers, t1, output_times, rtol, atol, threads, q, v, self.deadline
        )
        is_valid = lanes.find_valid_runs(numbers, status, t1, rtol, float(atol.min()), q, v, at_end)
        if is_valid[0] and first.success:
            reference = first.q[:, -1:]
            deviations = np.abs(q[0][:, output_times == first.t[-1]] - reference)  # empty if there is no such time
            if (deviations > MAX_DISTANCE * (atol[:, None] + rtol * np.abs(reference))).any():
                raise Untraceable(f"the first run ends elsewhere by itself, {MAX_DISTANCE:g} tolerances and more away")
        is_valid[0] = False
        n, valid_runs = len(inner_times), numbers[is_valid]
        for states, new_states, start in ((self.q, q, starts.q), (self.v, v, starts.v)):
            if len(numbers) == len(states):  # a copy by a mask is twice as fast as a copy by indices
                np.copyto(states[:, :, len(times) - n :], new_states[:, :, :n], where=is_valid[:, None, None])
            else:
                states[valid_runs, :, len(times) - n :] = new_states[is_valid, :, :n]
            if n < len(times):
                states[valid_runs, :, 0] = start[valid_runs]
        self.n_steps[valid_runs], self.n_evaluations[valid_runs] = steps[is_valid], evaluations[is_valid]
        self.method_of[valid_runs] = len(self.methods)
        self.methods.append(lanes.method.name)
        remaining = np.flatnonzero(~is_valid)
        self.reasons |= {int(numbers[i]): REASONS[int(status[i])] for i in remaining.tolist() if numbers[i] > 0}


def _check_start(system: ConstrainedSystem, starts: Starts, run: int) -> None:
    """Raise unless the start of a run is consistent."""
    from twoloop.checks.consistency import check_start

    try:
        check_start(system_of(system, starts, run), starts.t0, starts.q[run], starts.v[run], derivatives=False)
    except ValueError as error:
        raise add_run_number(run, error) from error


def add_run_number(run: int, error: ValueError) -> ValueError:
    """Return the error of a single run with the number of the run, and with `consistent_states` in its advice."""
    return ValueError(f"run {run}: {error}".replace("twoloop.consistent_state(", "twoloop.consistent_states("))


MAX_LISTED = 5  # largest number of runs that a message names
FIRST_RUN_REASON = "the first, which checks the system"  # reason for which the first run is not in lanes
N_ROUNDS = 3  # number of attempts for a run that is integrated singly, with increasing time limits
# a single run may take at least this share of the remaining time, and this multiple of the longest single run so far
MAX_SHARE, MAX_MULTIPLE = 0.1, 3.0
MAX_FIRST_SHARE = 0.5  # largest share of the time limit that the first run takes
TIME_LIMIT_MESSAGE = (
    "time_limit ended before the run began or, in lanes, ended: raise it, loosen rtol and atol, or shorten t_span."
)
# factor on the tolerances of the first run; applied only to tolerances above TIGHT_TOLERANCE
FIRST_RUN_FACTOR, TIGHT_TOLERANCE = 0.1, 1e-9


def ensemble(
    system: ConstrainedSystem,
    t_span: tuple[float, float],
    q0: ArrayLike,
    v0: ArrayLike,
    *,
    parameters: ArrayLike | None = None,
    rtol: float = 1e-8,
    atol: ArrayLike = 1e-8,
    t_eval: ArrayLike | None = None,
    method: str = "auto",
    events: Any = None,
    threads: int | None = None,
    time_limit: float | None = None,
) -> Runs:
    """Integrate many runs of one system, each with parameters and a start of its own.

    Runs use code generated for the system, one run in each SIMD lane of the processor. Each run has its own steps,
    which are checked like those of a single run. A lane whose run has ended takes the next run. The code serves all
    parameters and is cached on disk.

    `solve_dae` integrates some runs one at a time:

    - the first run, with all checks, and with a tenth of the tolerances if they are above 1e-9: the lanes are compared
      with it
    - runs with a step that ends near a singular position; runs with events, nonholonomic rows, callbacks that branch,
      or other methods
    - runs whose forces or drives act for less than a thousandth of the run, with a `max_step` of half of that
    - all runs, if they take less than a twentieth of the estimated time to compile their code

    At the end of every run in lanes, the equations are evaluated by the callbacks, and compared with its state.

    Parameters
    ----------
    system : ConstrainedSystem
    t_span : (float, float)
        Start and end of all runs, s.
    q0, v0 : array_like (n_q,) or (n_runs, n_q)
        Consistent starts (see `consistent_states`): one for all runs, or one for each.
    parameters : array_like (n_runs, n_p), optional
        Parameters of each run. None: `system.parameters` for all.
    rtol, atol, t_eval, events
        As for `solve_dae`; t_eval None: states are stored at the start and the end.
    method : str or method object
        "auto", "Taylor", "DOP853", "RadauIIA5", "RadauIIA9" and "RadauIIA13" run in lanes. There "auto" takes Taylor
        series, and DOP853 for runs and systems that have no series. It takes DOP853 first if the tolerances are 1e-9 or
        larger, series take more than six operations a coordinate, no force may act for a short time, and no callback
        has quotients, roots or fast vibrations. If the first run switched to Newton's method, it takes a Radau method
        for all runs: of order 5 at tolerances of 9e-7 and larger, else of order 9, with the error test of `Auto`.
    threads : int, optional
        None: one for each core that this process may use. Results do not depend on it.
    time_limit : float, optional
        Wall-clock time of all runs, s, without compilation. Runs that have not ended by then get the status TIME_LIMIT
        and, if they were integrated one at a time, keep their states so far. Runs that are integrated one at a time
        share the remaining time, so that a run that never ends does not take all of it.

    Returns
    -------
    Runs
        A run that fails has a negative status, and its states are NaN from where it stopped.

    Raises
    ------
    TypeError, ValueError
        If an argument is wrong, naming it, or a start is not consistent, naming the run.
    KeyboardInterrupt
        At Ctrl-C. Nothing is kept.

    Notes
    -----
    In lanes, as in a single run, the equations are evaluated at least every hundredth of the run. Steps of a Radau
    method are no longer than this. Steps of DOP853 are no longer than 3.75 hundredths, because the widest gap between
    its stages is 4/15 of a step; if a callback has quotients, roots or fast vibrations, no longer than a hundredth. If
    a force may act for a short time, steps are no longer than a two-thousandth of the run; a single run then evaluates
    only the forces so often. Stages violate the constraints by the error of the formula, also in the Radau methods,
    whose unknowns in lanes are the accelerations of all coordinates. The end of each step is projected onto the
    constraints. States at `t_eval` within a step are the ends of shorter steps from its beginning. `solve_dae`
    integrates runs that would take more than 100,000 steps, and runs by series in which the equations become undefined.

    Examples
    --------
    >>> import numpy as np
    >>> from twoloop import ensemble
    >>> from twoloop.mechanisms import pendulum
    >>> problem = pendulum()
    >>> speeds = np.array([0.0, 0.5, 1.0])
    >>> v0 = np.outer(speeds, [0.0, 1.0])  # along the circle
    >>> runs = ensemble(problem.system, (0.0, 1.0), problem.q0, v0, t_eval=[0.0, 0.5, 1.0])
    >>> runs.q.shape, bool(runs.success.all())  # runs, coordinates, times
    ((3, 2, 3), True)
    """
    check_system(system)
    t0, t1 = check_span(t_span)
    if time_limit is not None:
        check_positive("time_limit", time_limit)
    method_object = check_method(method)
    check_positive("rtol", rtol)
    tolerance = check_tolerance("atol", atol, system.n_q)
    times = np.array([t0, t1]) if t_eval is None else check_times(t_eval, t0, t1, None)
    n_threads = threads_of(None if threads is None else check_size("threads", threads, 1))
    starts = all_starts(system, t0, q0, v0, parameters)
    runs = LaneEnsemble(system, starts, t1, times, float(rtol), tolerance, method_object, events)
    if events is not None:
        runs.refusal = "events are looked for in single runs only"
    elif method not in IN_LANES:
        runs.refusal = f"{method_object.name} does not go in lanes"
    with SignalHandlers():
        return _integrate(runs, str(method), n_threads, np.inf if time_limit is None else float(time_limit))


def _integrate(runs: LaneEnsemble, method: str, threads: int, time_limit: float) -> Runs:
    """Integrate the first run, then the others, in lanes unless `runs.refusal` says why not."""
    n_runs, may_use_lanes = len(runs.status), not runs.refusal and len(runs.status) > 1
    # the first run checks the system and its derivatives; lanes are compared with it, so it gets smaller tolerances
    is_tight = min(runs.rtol, float(runs.atol.min())) <= TIGHT_TOLERANCE
    factor = FIRST_RUN_FACTOR if may_use_lanes and not is_tight else 1.0
    first_limit = time_limit if n_runs == 1 else MAX_FIRST_SHARE * time_limit
    first = runs.solve_singly(0, first_limit, factor)
    used = first_limit if first.status is Status.TIME_LIMIT else min(first.stats.cpu_time, first_limit)
    runs.deadline = time.monotonic() + time_limit - used
    if may_use_lanes:
        runs.integrate_in_lanes(method, first, threads)
    singly = ~runs.in_lanes
    numbers = np.flatnonzero(singly).tolist()
    _share_time(numbers, first_limit, runs)
    reasons = {run: runs.reasons.get(run, runs.refusal) for run in numbers}
    if runs.methods or not runs.refusal:
        reasons[0] = FIRST_RUN_REASON
    message, counts = _summary(runs, reasons), (runs.n_steps, runs.n_evaluations)
    return Runs(runs.times, runs.q, runs.v, runs.status, *counts, singly, message, runs.messages, reasons)


def _share_time(run_numbers: list[int], first_limit: float, runs: LaneEnsemble) -> None:
    """Integrate runs one at a time; each has a share of the time limit, and later rounds share the rest.

    `first_limit`: the time limit that the first run has had.
    """
    queue = [run for run in run_numbers if run > 0 or runs.status[run] == Status.TIME_LIMIT]
    limits, longest = dict.fromkeys(queue, 0.0) | {0: first_limit}, 0.0
    for _ in range(N_ROUNDS):
        for position, run in enumerate(queue):
            began = time.monotonic()
            remaining = runs.deadline - began
            limit = min(
                remaining, max(remaining / (len(queue) - position), MAX_SHARE * remaining, MAX_MULTIPLE * longest)
            )
            if limit > 2.0 * limits[run]:  # each attempt starts from t0
                limits[run] = limit
                if runs.solve_singly(run, limit).success:
                    longest = max(longest, time.monotonic() - began)
            elif limits[run] == 0.0:
                runs.status[run], runs.messages[run] = int(Status.TIME_LIMIT), TIME_LIMIT_MESSAGE
                if runs.times[0] == runs.starts.t0:
                    runs.q[run, :, 0], runs.v[run, :, 0] = runs.starts.q[run], runs.starts.v[run]
        queue = [run for run in queue if runs.status[run] == Status.TIME_LIMIT]


def _summary(runs: LaneEnsemble, reasons: dict[int, str]) -> str:
    failed, n_runs = int((runs.status < 0).sum()), len(runs.status)
    ending_text = f"{n_runs - failed} of {n_runs} runs reached the end or an event"
    by_reason: dict[str, list[int]] = {}
    for run, reason in reasons.items():
        by_reason.setdefault(reason, []).append(run)
    if not runs.methods and FIRST_RUN_REASON not in by_reason:
        return f"{ending_text}; none went in lanes: {reasons[0]}."
    counts = ((name, int((runs.method_of == k).sum())) for k, name in enumerate(runs.methods))
    in_lanes = "".join(f"{count} in lanes by {name}, " for name, count in counts if count > 0)
    others = "".join(
        f"; {_describe_numbers(runs)}: {reason}" for reason, runs in by_reason.items() if reason != FIRST_RUN_REASON
    )
    return f"{ending_text}; {in_lanes}{len(reasons)} made singly: {FIRST_RUN_REASON}{others}."


def _describe_numbers(runs: list[int]) -> str:
    """Describe how many runs are in a list, with the numbers of the first ones."""
    numbers = ", ".join(map(str, runs[:MAX_LISTED])) + (", ..." if len(runs) > MAX_LISTED else "")
    return f"run {numbers}" if len(runs) == 1 else f"{len(runs)} runs ({numbers})"
