"""ensemble: thousands of runs of one system, with parameters and starts of their own, in lanes and threads."""

from __future__ import annotations  # ArrayLike stays a word in help()

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from twoloop.checks.arguments import Array, check_positive, check_size, check_span, check_times, check_tolerance
from twoloop.ensembles.in_lanes import LOOKS, SHORT, WHY, LaneRuns, threads_of
from twoloop.ensembles.lane_methods import IN_LANES, LaneMethod, is_involved, lane_methods
from twoloop.ensembles.runs import Runs
from twoloop.ensembles.starts import Starts, all_starts, far_off, system_of
from twoloop.generate.tracing import Untraceable
from twoloop.problem.system import ConstrainedSystem, check_system
from twoloop.result.result import Result
from twoloop.run.record import Status
from twoloop.solve import check_method, solve_dae

Integers = NDArray[np.int64]

FAR = 1e5  # tolerances, by which a motion that is not chaotic does not end elsewhere
CALL = 1e-3  # s of a call of solve_dae beside its steps
SHOWN = 5  # numbers of runs in a message
FIRST = "the first, which checks the system"  # why it is made singly
CLOSER, TIGHT = 0.1, 1e-9  # of the tolerances: those of the first run, unless they are as tight as this
WORTH = 20.0  # times what the runs of a call take singly: what their code may take to compile, as it is kept


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
) -> Runs:
    """Integrate many runs of one system, each with parameters and a start of its own.

    Runs use machine code made for the system, one run in each lane of the processor's vectors. Each run has its own
    steps, which are checked as those of a single run. A lane whose run has ended takes the next one. All parameters use
    the same code, which is kept on disk.

    What lanes cannot do is made by `solve_dae`, run by run: runs that come near a singular position, systems whose
    callbacks branch or that have nonholonomic rows, events, and other methods. So are runs whose forces or drives were
    seen to act for less than a thousandth of the run, with a `max_step` of half of that, and runs that take less than a
    twentieth of the estimated time to make their code. The first run is also made by `solve_dae`, with all of its
    checks, and with a tenth of the tolerances where these are above 1e-9, as lanes are compared with it. At the end of
    every other run, the callbacks are compared with what was found there.

    Parameters
    ----------
    system : ConstrainedSystem
    t_span : (float, float)
        Start and end of all runs, s.
    q0, v0 : array_like (n_q,) or (n_runs, n_q)
        Consistent starts (see `consistent_states`): one for all runs, or one for each.
    parameters : array_like (n_runs, n_p), optional
        Of each run, instead of `system.parameters`. None: these.
    rtol, atol, t_eval, events
        As for `solve_dae`; t_eval None: states are stored at the start and the end.
    method : str or method object
        "auto", "Taylor", "DOP853", "RadauIIA5", "RadauIIA9" and "RadauIIA13" go in lanes. "auto" takes Taylor series
        there, and DOP853 for runs that these cannot do and for systems that have none; at tolerances from 1e-9 on it
        takes DOP853 first where series take more than six operations a coordinate, no force may act for a short time,
        and no callback has quotients, roots or fast vibrations. If the first run came to Newton's method, it takes a
        Radau method for all runs, of order 5 at tolerances from 9e-7 on and of order 9 below, with errors tested as by
        `Auto`.
    threads : int, optional
        None: one for each core that this process may use. Results do not depend on it.

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
    In lanes, as in a single run, the equations are evaluated at least every hundredth of the run. So no step of a Radau
    method is longer, and no step of DOP853 longer than 3.75 hundredths, as the widest gap between its stages is 4/15 of
    a step, or than a hundredth where a callback has quotients, roots or fast vibrations. Where a force may act for a
    short time, steps are no longer than a two-thousandth of the run; a single run evaluates only the forces there.
    Stages are off the constraints by the error of the formula. This includes the Radau methods, whose unknowns are here
    the accelerations of all coordinates. The end of each step is put on the constraints. States at `t_eval` within a
    step are the ends of shorter steps from its beginning. A run that would take more than 100,000 steps is made by
    `solve_dae`. So is one that by series meets a place at which the equations have no values.
    """
    check_system(system)
    t0, t1 = check_span(t_span)
    chosen = check_method(method)
    check_positive("rtol", rtol)
    tolerance = check_tolerance("atol", atol, system.n_q)
    times = np.array([t0, t1]) if t_eval is None else check_times(t_eval, t0, t1, None)
    n_threads = threads_of(None if threads is None else check_size("threads", threads, 1))
    starts = all_starts(system, t0, q0, v0, parameters)
    n_runs = len(starts.q)
    q, v = np.full((2, n_runs, system.n_q, len(times)), np.nan)
    status, n_steps = np.zeros((2, n_runs), dtype=np.int64)
    options = {"rtol": float(rtol), "atol": tolerance, "t_eval": times, "method": chosen, "events": events}
    messages: dict[int, str] = {}

    def single(run: int, max_step: float = np.inf) -> Result:
        result = _alone(system, starts, run, (t0, t1), options | {"max_step": max_step})
        if result.status is Status.INTERRUPTED:  # as in lanes, and not of this run alone
            raise KeyboardInterrupt
        q[run, :, : len(result.t)], v[run, :, : len(result.t)] = result.q, result.v
        q[run, :, len(result.t) :], v[run, :, len(result.t) :] = np.nan, np.nan
        status[run], n_steps[run] = int(result.status), result.stats.n_accepted or 0
        if not result.success:
            messages[run] = result.message
        return result

    may_go = events is None and method in IN_LANES and n_runs > 1
    if may_go and float(rtol) > TIGHT and tolerance.min() > TIGHT:  # lanes are compared with it
        options |= {"rtol": CLOSER * float(rtol), "atol": CLOSER * tolerance}
    first = single(0)  # which checks the system, derivatives and all
    options |= {"rtol": float(rtol), "atol": tolerance}
    in_lanes, why = np.zeros(n_runs, dtype=bool), ""
    made_by: dict[str, int] = {}
    reasons: dict[int, str] = {}
    methods: list[LaneMethod] = []
    if events is not None:
        why = "events are looked for in single runs only"
    elif method not in IN_LANES:
        why = f"{chosen.name} does not go in lanes"
    elif n_runs > 1:
        stiff = (first.stats.n_jacobians or 0) > 0
        involved = method == "auto" and not stiff and is_involved(system)
        methods = lane_methods(str(method), stiff, system.n_q, float(rtol), float(tolerance.min()), involved)
    for each in methods:
        left = np.flatnonzero(~in_lanes)
        if len(left) == 1:
            break
        try:
            lanes = LaneRuns(system, starts, each)
            singly = len(left) * (first.stats.cpu_time + CALL)
            if lanes.own.seconds_to_build > WORTH * singly:
                raise Untraceable(f"to compile them does not pay for these runs, which take about {singly:.2g} s")
            fine, refused = _in_lanes(lanes, left, t1, times, options, n_threads, (q, v, n_steps))
        except Untraceable as reason:
            why = why or str(reason)
        else:
            in_lanes[left[fine]], made_by[each.name] = True, int(fine.sum())
            reasons |= refused
    for run in np.flatnonzero(~in_lanes).tolist():
        if run > 0:  # what was met in short looks is to be met again
            single(run, (t1 - t0) / LOOKS if reasons.get(run) == WHY[SHORT] else np.inf)
    reasons = {run: reasons.get(run, why) for run in np.flatnonzero(~in_lanes).tolist()}
    if made_by or not why:
        reasons[0] = FIRST
    return Runs(times, q, v, status, n_steps, ~in_lanes, _message(status, made_by, reasons), messages, reasons)


def _in_lanes(
    lanes: LaneRuns,
    which: Integers,
    t1: float,
    times: Array,
    options: dict[str, Any],
    threads: int,
    out: tuple[Array, Array, Integers],
) -> tuple[NDArray[np.bool_], dict[int, str]]:
    """Which of these runs were made, and why others were not.

    The first is there already, made singly, and has to end where lanes have it.

    Raises
    ------
    Untraceable
        If it does not.
    """
    q, v, n_steps = out
    system, starts = lanes.system, lanes.starts
    for run in which[far_off(lanes.kit, starts)[which]].tolist():
        _check_start(system, starts, run)
    within = times[times > starts.t0]
    ends = within if within.size and within[-1] == t1 else np.append(within, t1)
    new_q, new_v = np.full((2, len(which), system.n_q, len(ends)), np.nan)
    rtol, atol = options["rtol"], options["atol"]
    status, steps, at_end = lanes.make(which, t1, ends, rtol, atol, threads, new_q, new_v)
    fine = lanes.judge(which, status, t1, rtol, float(atol.min()), new_q, new_v, at_end)
    allowed = FAR * (atol + rtol * np.abs(q[0, :, -1]))
    if fine[0] and times[-1] == t1 and (np.abs(new_q[0, :, -1] - q[0, :, -1]) > allowed).any():
        raise Untraceable(f"the first run ends elsewhere by itself, {FAR:g} tolerances and more away")
    fine[0] = False
    n, runs = len(within), which[fine]
    for states, own, start in ((q, new_q, starts.q), (v, new_v, starts.v)):
        if len(which) == len(states):  # twice as fast as by their numbers
            np.copyto(states[:, :, len(times) - n :], own[:, :, :n], where=fine[:, None, None])
        else:
            states[runs, :, len(times) - n :] = own[fine, :, :n]
        if n < len(times):
            states[runs, :, 0] = start[runs]
    n_steps[runs] = steps[fine]
    return fine, {int(which[i]): WHY[int(status[i])] for i in np.flatnonzero(~fine).tolist() if which[i] > 0}


def _alone(
    system: ConstrainedSystem, starts: Starts, run: int, span: tuple[float, float], options: dict[str, Any]
) -> Result:
    own = system_of(system, starts, run)
    try:
        return solve_dae(own, span, starts.q[run], starts.v[run], **options)
    except ValueError as error:
        raise _of_run(run, error) from error


def _check_start(system: ConstrainedSystem, starts: Starts, run: int) -> None:
    """Raise unless the start of a run is consistent."""
    from twoloop.checks.consistency import check_start

    try:
        check_start(system_of(system, starts, run), starts.t0, starts.q[run], starts.v[run], derivatives=False)
    except ValueError as error:
        raise _of_run(run, error) from error


def _of_run(run: int, error: ValueError) -> ValueError:
    """The error of a single run, with its number, and the function for many runs in the place of that for one."""
    return ValueError(f"run {run}: {error}".replace("twoloop.consistent_state(", "twoloop.consistent_states("))


def _message(status: Integers, made_by: dict[str, int], reasons: dict[int, str]) -> str:
    failed, n_runs = int((status < 0).sum()), len(status)
    said = f"{n_runs - failed} of {n_runs} runs reached the end or an event"
    alike: dict[str, list[int]] = {}
    for run, reason in reasons.items():
        alike.setdefault(reason, []).append(run)
    if not made_by and FIRST not in alike:
        return f"{said}; none went in lanes: {reasons[0]}."
    in_lanes = "".join(f"{count} in lanes by {name}, " for name, count in made_by.items() if count > 0)
    others = "".join(f"; {_numbered(runs)}: {reason}" for reason, runs in alike.items() if reason != FIRST)
    return f"{said}; {in_lanes}{len(reasons)} made singly: {FIRST}{others}."


def _numbered(runs: list[int]) -> str:
    """How many runs, and which."""
    told = ", ".join(map(str, runs[:SHOWN])) + (", ..." if len(runs) > SHOWN else "")
    return f"run {told}" if len(runs) == 1 else f"{len(runs)} runs ({told})"
