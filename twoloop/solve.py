"""solve_dae: checks the input, chooses the method and runs it."""

from __future__ import annotations  # ArrayLike stays a word in help()

import os
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from twoloop.checks.arguments import check_span, check_times, check_vector, is_vector, needed
from twoloop.checks.consistency import ConstraintWarning
from twoloop.kernels.layout import keep_unused_workspace
from twoloop.methods.plan import Method
from twoloop.methods.presets import Compiled
from twoloop.problem.events import check_events
from twoloop.problem.system import ConstrainedSystem, check_system
from twoloop.result.result import Result
from twoloop.result.storage import begin_folder, check_folder, end_folder
from twoloop.run.cached import STEPS, RepeatRequest, cached_result, fields_of, set_up
from twoloop.run.fallbacks import MAX_REPETITIONS, gap_for_repetition, may_have_missed_changes
from twoloop.run.loop import IntegrationLoop, Interrupts, interrupted_fields
from twoloop.run.options import options_of
from twoloop.run.record import OutputRequest, Status, record_of
from twoloop.run.run import SMALL_SYSTEM, Run
from twoloop.run.signals import is_keyboard_interrupt

Array = NDArray[np.float64]

LONGEST = 0.1  # s of wall-clock time that the first chunk of steps may take
SAME = 1e-9  # relative: a step and a span that differ by less are one, however they were rounded


def solve_dae(
    system: ConstrainedSystem,
    t_span: tuple[float, float],
    q0: ArrayLike,
    v0: ArrayLike,
    method: str | Method = "auto",
    rtol: float = 1e-8,
    atol: ArrayLike = 1e-8,
    *,
    t_eval: ArrayLike | None = None,
    first_step: float | None = None,
    max_step: float = np.inf,
    max_steps: int | None = None,
    step_size: float | None = None,
    dense_output: bool = False,
    events: Any = None,
    progress: bool | None = None,
    time_limit: float | None = None,
    check_derivatives: bool = True,
    compiled: Compiled = "auto",
    store: str | os.PathLike[str] | None = None,
) -> Result:
    """Integrate a constrained mechanical system and keep its constraints closed at every step.

    Parameters
    ----------
    system : ConstrainedSystem
        The system to integrate.
    t_span : (float, float)
        Start and end, s; the end after the start.
    q0, v0 : array_like (n_q,)
        Consistent initial coordinates and velocities; `consistent_state` makes them from rough ones.
    method : str or method object
        "auto" (default), "Lobatto16", "Taylor", "DOP853", "Adams", "Gauss4" ... "Gauss16", "SunRadau5", "RadauIIA5",
        "RadauIIA9", "RadauIIA13", "TRBDF2", "ESDIRK4", "BDF", "Newmark", "PaperIRK" or "PaperNewmark". Or an object,
        such as `RungeKutta(...)`, `ESDIRK(...)` or `Newmark(...)`.
    rtol : float
        Relative tolerance of the error of a step.
    atol : float or array_like (n_q,)
        Absolute tolerance of the error of a step. An array has one number for each coordinate and its velocity.
    t_eval : array_like, optional
        Increasing times in t_span at which to store the solution. None: at every accepted step.
    first_step : float, optional
        First step to try, s. None: chosen from the state at the start.
    max_step : float
        Largest step, s. Forces shorter than 1/2000 of the run can be missed; then set this to their duration.
    max_steps : int, optional
        Largest number of accepted steps. None: no limit, but a run that would not end is stopped.
    step_size : float, optional
        Constant step, s, without error control. Times in `t_eval` must then be multiples of it.
    dense_output : bool
        Whether to keep what `result.sol(t)` needs, the state at any time t of the run. See `DenseSolution`.
    events : callable or list of callables, optional
        Functions event(t, q, v) -> float, plain or compiled by numba, whose zeros are found. As in SciPy's
        `solve_ivp`, they may have the attributes `terminal` and `direction`.
    progress : bool, optional
        True: show a bar (needs the package rich).
    time_limit : float, optional
        Wall-clock time of all steps, s, after which the run ends with the status TIME_LIMIT.
    check_derivatives : bool
        Whether to compare C_q, C_t, gamma and the tangents with exact derivatives or differences. This is done at the
        first start of a system and at a few states of its runs.
    compiled : bool or "auto"
        Whether to generate machine code for the equations of the mechanism, for "auto", "Lobatto16", "Taylor", "DOP853"
        and "Adams". "auto" (default): for small mechanisms with compiled callbacks, and always for "Lobatto16".
    store : str or path, optional
        A new folder in which a run that does not fit into memory is written as it is computed. `twoloop.load` reads
        it again.

    Returns
    -------
    Result
        After a failure, or Ctrl-C, it holds what was computed so far, with `success=False` and a message that says what
        to try.

    Raises
    ------
    TypeError, ValueError
        If an argument is wrong: before any work, naming the argument. An exception from a Python callback or an event
        is passed on unchanged, with a note that says which one was called and at what time.

    Notes
    -----
    *Method.* "auto" is "Lobatto16" with generated code, else explicit, with Newton's method while the problem is found
    to be stiff, see `Auto`. Near a singular position, any method may take steps by collocation across it.

    *Constraints.* Rows that depend on others at the start are left out and checked at every step; a
    `ConstraintWarning` names them.

    *Tolerances.* A step is accepted if the largest component of its estimated error, divided by atol + rtol |value|,
    is at most 1. Positions and velocities count. For `Newmark`, the error of the positions per unit step counts, with
    the tolerances of the velocities, unless it has an `error_tol`. With error="richardson-paper" of `RungeKutta`, the
    root mean square counts. The dependent positions are tested, too, except in the paper's two procedures: the distance
    between those that the formula predicts and those that the constraints give counts as an error, and must not exceed
    about a tenth of the motion in the step. So no step ends on another assembly of the mechanism.

    Errors of steps before and after a singular position may grow much. So "auto", "Lobatto16", "Taylor", "Adams" and
    "DOP853" go on with 2 % of the tolerances once they come near one (but not less than 1e-14 for each coordinate). If
    this happens in the first third of a run or in its first 32 steps, the run begins again, unless its states are in
    files, rows are redundant, or it began beside a singular position.

    *Output times.* The solution is interpolated between the steps as by `sol`, and the steps do not change. With
    `step_size`, and with the two methods of the paper, steps are shortened to end at the times of `t_eval`.

    *Short forces.* "Taylor" evaluates the equations within its steps, and "Lobatto16" in those longer than 5.5
    hundredths of the run, or than one where callbacks have quotients, roots or fast vibrations. Other methods evaluate
    them at the ends and stages of steps, and take no step longer than a hundredth of the run ("DOP853": 3.75
    hundredths where there are no such callbacks and no position was nearly singular). Forces and drives that may change
    suddenly with time are also evaluated every two-thousandth of the run, and at least eight times per step; steps end
    where they change. A run that meets a change too short for this is repeated, up to twice, with more evaluations.
    If these are too few, a `ConstraintWarning` says how long the change lasts.

    *Runs that do not end.* Without `max_steps`, a run ends as STAGNATED if the rest would take more than 1e7 steps as
    short as the last and these are a thousand times shorter than before, or more than 1e11 steps and there is neither
    a time limit nor a terminal event.

    *Events.* A zero at the start counts. The sign is checked four times per step, and at least every 400th of t_span:
    two zeros between two checks can be missed, and so can one without a change of sign. The time of an event is that
    of the dense solution, to rounding. Events that are not terminal do not change the steps.

    *Derivatives.* They are compared with exact ones if the callbacks run on symbols. For compiled callbacks, only
    states outside the region of earlier runs are compared, and the 2nd, 4th, 8th, ... run as a whole. A system with
    other parameters (`with_parameters`) is checked at the start like a new one.

    *Generated code* usually makes the integrator five to nine times as fast. Making it takes about a second, once for
    equations of the same structure, as it is kept on disk. The callbacks must not branch on t, q or v. Near a singular
    position, steps that cannot be trusted to this code are computed without it. The choice by "auto" depends only on
    the arguments, so the same call gives the same numbers whatever ran before.

    Examples
    --------
    >>> from twoloop import solve_dae
    >>> from twoloop.mechanisms import four_bar
    >>> problem = four_bar()
    >>> result = solve_dae(problem.system, (0.0, 1.0), problem.q0, problem.v0)
    >>> result.message
    'Reached the end, t = 1.'
    >>> bool(result.success), result.q.shape == (9, result.t.size)
    (True, True)
    """
    check_system(system)
    options = options_of(
        system,
        method,
        rtol,
        atol,
        first_step,
        max_step,
        max_steps,
        step_size,
        dense_output,
        progress,
        time_limit,
        check_derivatives,
        compiled,
    )
    event_functions = None if events is None else check_events(events)
    t0, t1 = check_span(t_span)
    if is_vector(q0, system.n_q) and is_vector(v0, system.n_q):
        q0, v0 = np.ascontiguousarray(q0), np.ascontiguousarray(v0)
    else:
        q0, v0 = check_vector("q0", q0, system.n_q), check_vector("v0", v0, system.n_q)
    if step_size is not None and step_size > (t1 - t0) * (1.0 + SAME):
        raise ValueError(f"step_size must not exceed the length of t_span, {t1 - t0:g}; given {step_size!r}")
    times = None if t_eval is None else check_times(t_eval, t0, t1, step_size)
    folder = None if store is None else check_folder(store)
    interrupts = Interrupts()
    try:
        at_ends = times is not None and times.size <= 2 and set(times.tolist()) <= {t0, t1}
        run, every, spent, repeats = None, np.inf, 0.0, MAX_REPETITIONS
        in_time = time_limit is None or (time_limit >= LONGEST and system.n_q <= SMALL_SYSTEM)
        if folder is event_functions is options.own_tolerance is None and in_time and not progress:
            output = STEPS if times is None and not dense_output else OutputRequest(times, at_ends, bool(dense_output))
            outcome = cached_result(system, t0, t1, q0, v0, options, output, time_limit, interrupts)
            if isinstance(outcome, tuple) and (not interrupts.n_signals or outcome[0]["status"] == Status.INTERRUPTED):
                fields, rows_warning = outcome
                if rows_warning:
                    warnings.warn(rows_warning, ConstraintWarning, stacklevel=2)
                return record_of(Result, fields)
            if isinstance(outcome, RepeatRequest):
                every, spent, repeats = outcome.max_gap, outcome.cpu_time, MAX_REPETITIONS - 1
            elif isinstance(outcome, Run):
                run = outcome
        interrupts.install_handlers()
        q0, v0 = check_vector("q0", q0, system.n_q), check_vector("v0", v0, system.n_q)
        deadline = None
        for left in range(repeats, -1, -1):
            if run is None:
                run, _ = set_up(system, t0, t1, q0, v0, options)
                if every < np.inf:
                    run.control[run.a.TIME_SPACING] = every
            if left == repeats and run.rows_warning:
                warnings.warn(run.rows_warning, ConstraintWarning, stacklevel=2)
            with_code = bool(run.plan.own)
            with progress_bar(progress, f"{options.method.name}, t = {t0:g} to {t1:g} s", t1 - t0) as show:
                files = None if folder is None else begin_folder(folder, system.n_q)
                output = OutputRequest(times, at_ends, bool(dense_output), event_functions, files)
                if deadline is None and time_limit is not None:  # setting up does not count
                    deadline = time.monotonic() + time_limit
                limit = None if deadline is None else max(0.0, deadline - time.monotonic())
                last = left == 0 or folder is not None
                loop = IntegrationLoop(run, t1, output, interrupts, lambda t: show(t - t0), limit, last)
                record = loop.integrate_to_end(check_derivatives)
            keep_unused_workspace(run.work)
            if last or record.status < 0 or not may_have_missed_changes(run):
                break
            every, spent, run = gap_for_repetition(run), spent + record.stats.cpu_time, None
        if spent > 0.0:
            record = replace(record, stats=replace(record.stats, cpu_time=spent + record.stats.cpu_time))
        result = record_of(Result, fields_of(record, options, system, with_code, t1))
        if files is not None:
            end_folder(files, result)
        return result
    except (KeyboardInterrupt, SystemError) as error:
        if not (is_keyboard_interrupt(error) and interrupts.returns_result(error)):
            raise
    finally:
        interrupts.restore_handlers()
    return record_of(Result, interrupted_fields(system, t0, event_functions, options.method.name))


@contextmanager
def progress_bar(is_shown: bool | None, label: str, total: float) -> Iterator[Callable[[float], None]]:
    """Yield a function that takes how much of `total` is done, and draws it if the bar is shown."""
    if not is_shown:
        yield lambda done: None
        return
    with needed("rich.progress", "rich", "progress=True").Progress() as bar:
        task = bar.add_task(label, total=total)
        yield lambda done: bar.update(task, completed=done)
