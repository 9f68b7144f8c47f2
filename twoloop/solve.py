"""solve_dae: checks the input, chooses the method and runs it."""

from __future__ import annotations  # ArrayLike stays a word in help()

import os
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from operator import is_
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from twoloop.checks.arguments import (
    check_flag,
    check_positive,
    check_size,
    check_span,
    check_times,
    check_tolerance,
    check_vector,
    shown,
)
from twoloop.checks.consistency import ConstraintWarning
from twoloop.kernels.layout import give_back
from twoloop.methods.code_for import Compiled, check_compiled
from twoloop.methods.plan import Method
from twoloop.methods.presets import PRESETS
from twoloop.problem.events import check_events
from twoloop.problem.system import ConstrainedSystem, check_system
from twoloop.result.folder import begin_folder, check_folder, end_folder
from twoloop.result.result import Result, result_of
from twoloop.run.again import Output
from twoloop.run.asked import Asked
from twoloop.run.course import Course
from twoloop.run.interrupts import Interrupts, not_begun
from twoloop.run.kept import InMemory, OnDisk
from twoloop.run.launch import record_again, run_from
from twoloop.run.recorder import Wanted

Array = NDArray[np.float64]

ROUNDING = 1e-15
NO_BAR = nullcontext(lambda t: None)  # in the place of what shows how far a run is
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
    """Integrate a constrained mechanical system; its constraints hold at every step.

    Constraints that depend on others at the start are left out, named by a `ConstraintWarning`, checked at every step.
    Near a position where the constraints lose rank, steps of any method may give way to explicit ones across it.

    Parameters
    ----------
    system : ConstrainedSystem
        The problem.
    t_span : (float, float)
        Start and end, s; the end after the start.
    q0, v0 : array_like (n_q,)
        Consistent initial coordinates and velocities (see `consistent_state`).
    method : str or method object
        "auto" (default: explicit where nothing is stiff, Newton's method where stiffness is measured, see `Auto`),
        "Taylor", "DOP853", "Adams", "Gauss4" ... "Gauss16", "SunRadau5", "RadauIIA5", "RadauIIA9", "RadauIIA13",
        "TRBDF2", "ESDIRK4", "BDF", "Newmark", "PaperIRK", "PaperNewmark", or an object: `RungeKutta(...)`,
        `ESDIRK(...)`, `Newmark(...)`, ...
    rtol : float
    atol : float or array_like (n_q,)
        A step is accepted when the largest component of its estimated error over atol + rtol |value| is at most 1:
        that of positions and velocities, for `Newmark` that of the positions per unit step over the tolerances of the
        velocities (with error="richardson-paper" of `RungeKutta` the root mean square counts; with `error_tol` Newmark
        has its own test). An array holds for each coordinate and its velocity. But for the paper's two procedures the
        distance between the dependent positions that the formula predicts and those that the constraints give counts
        as an error, too, and must not exceed about a tenth of the motion in the step: so a step cannot end on another
        assembly of the mechanism.
    t_eval : array_like, optional
        Increasing times in t_span at which to store the solution, interpolated between the steps as by `sol`: these are
        the same with and without. None: every accepted step is stored. With `step_size`, and the two methods of the
        paper, nothing is interpolated: steps are shortened to land on the times.
    first_step : float, optional
        First step to try, s. None: chosen from the velocities and accelerations at the start, or from the Taylor series
        there.
    max_step : float
        Largest step, s. Methods that do not look at the equations between the ends and stages of their steps, all but
        "Taylor", take none that is longer than a hundredth of the run in any case. Forces and drives are looked at with
        time every two-thousandth of the run, and steps end where they change suddenly; what acts for a shorter time, or
        on a shorter way, may be passed over unseen: give its duration.
    max_steps : int, optional
        Largest number of accepted steps. None: no limit, but a run whose steps have become a thousand times shorter
        than before, so that the rest would take more than ten million of them, ends with the status STAGNATED.
    step_size : float, optional
        Constant step, s: no error control; only the last step is shortened, to end at t_span[1]. Times in `t_eval`
        must then be multiples of it. A step that does not converge ends the run.
    dense_output : bool
        Whether to keep what `result.sol(t)` needs, the state at any time t of the run (see `DenseSolution`).
    events : callable or list of callables, optional
        Functions event(t, q, v) -> float, plain or compiled by numba, whose zeros are looked for, by the rules of
        SciPy's `solve_ivp`: an attribute `terminal`, True or a number of occurrences, ends the run there; an
        attribute `direction`, 1 or -1, lets only zeros count at which the value rises or falls. The sign is looked at
        four times a step: two zeros closer than a quarter of a step, and one without a change of sign, are missed;
        `max_step` helps. A zero at the start counts. The time of an event is found to rounding of the dense solution.
        Other than terminal events leave the steps as they are.
    progress : bool, optional
        True: show a bar (needs the package rich).
    time_limit : float, optional
        Wall-clock time, s, after which the run ends with the status TIME_LIMIT. It is looked at about every 0.1 s, but
        not within a step, and for a small compiled system not before a thousand steps.
    check_derivatives : bool
        Whether C_q, C_t, gamma and tangents are compared with differences at the first start of a system, and all but
        the tangents again at a few states of runs: with exact derivatives where the callbacks run on symbols, else with
        differences. Of compiled callbacks only states beyond those of earlier runs are compared, and the 2nd, 4th, 8th,
        ... run as a whole. With other parameters (`with_parameters`) they are compared at the start as those of a new
        system; along runs, where they do not branch on parameters, as if these were coordinates.
    compiled : bool or "auto"
        Whether the equations of the mechanism become machine code of their own, for the methods "auto", "Taylor",
        "DOP853" and "Adams": as a rule two to four times as fast inside the integrator, less over a short call, and not
        always on stiff motion; after 0.1 to 6 s, which grow with the mechanism, once for equations of the same
        structure, as the code is kept on disk and reads its numbers. The callbacks must not
        branch on t, q or v. What near a singular position cannot be trusted to this code is computed without.
        "auto" (default): for small mechanisms with compiled callbacks, whose code takes some tenths of a second. This
        depends on the arguments of the call alone: the same call gives the same numbers whatever ran before.
    store : str or path, optional
        A folder to make, for runs of which the memory does not hold all: what the run keeps goes there as it comes,
        and arrays of the result, the dense solution's too, are read from there as they are used. Events stay in memory.
        `twoloop.load` reads the folder again, also that of a run that failed or whose process died.

    Returns
    -------
    Result
        After a failure, or Ctrl-C, with what was computed so far, `success=False` and a message that says what to try.

    Raises
    ------
    TypeError, ValueError
        If an argument is wrong: before any work, naming it. An exception of a Python callback or an event comes
        through unchanged, with a note that says which and at what time; so does what is wrong with an event's value.
    """
    check_system(system)
    given = (
        *(method, rtol, atol, first_step, max_step, max_steps, step_size),
        *(dense_output, progress, time_limit, check_derivatives, compiled),
    )
    known = system.shared.get("options")
    if known is None or not all(map(is_, given, known[0])):
        known = given, check_options(system, *given)
        if type(atol) is float:  # an array may be changed by who gives it
            system.shared["options"] = known
    asked: Asked = known[1]
    event_functions = None if events is None else check_events(events)
    t0, t1 = check_span(t_span)
    q0 = check_vector("q0", q0, system.n_q)
    v0 = check_vector("v0", v0, system.n_q)
    if step_size is not None and step_size > (t1 - t0) * (1.0 + SAME):
        raise ValueError(f"step_size must not exceed the length of t_span, {t1 - t0:g}; given {step_size!r}")
    times = None if t_eval is None else check_times(t_eval, t0, t1, step_size)
    folder = None if store is None else check_folder(store)
    with Interrupts() as interrupts:
        own, told = asked.own_tolerance, asked.told | {"system": system, "atol": asked.atol.copy()}
        at_ends = times is not None and set(times.tolist()) <= {t0, t1}
        if folder is event_functions is own is None and not progress:
            made = record_again(system, t0, t1, q0, v0, asked, Output(times, at_ends, bool(dense_output)))
            if made is not None and not interrupts.asked:
                fields, said_of_rows = made
                if said_of_rows:
                    warnings.warn(said_of_rows, ConstraintWarning, stacklevel=2)
                return result_of(fields | told)
        run = run_from(system, t0, t1, q0, v0, asked)
        if run.said_of_rows:
            warnings.warn(run.said_of_rows, ConstraintWarning, stacklevel=2)
        with_code = bool(run.plan.own)
        with _progress_bar(asked.method.name, t0, t1) if progress else NO_BAR as report:
            lands = run.plan.lands or step_size is not None or at_ends
            kept = InMemory() if folder is None else begin_folder(folder, system.n_q)
            wanted = Wanted(times, lands, bool(dense_output), event_functions, kept)
            record = Course(run, t1, wanted, report, time_limit, interrupts).to_end(check_derivatives)
        give_back(run.work)
        if own is not None:  # Newmark's own test, of positions, has its place
            told |= {"rtol": own, "atol": np.full(system.n_q, own), "untested": np.ones(len(record.h), dtype=bool)}
        result = result_of(vars(record) | told | {"compiled": with_code})
        if isinstance(kept, OnDisk):
            end_folder(kept, result)
        return result
    return result_of(vars(not_begun(system, t0, event_functions, asked.method.name)))


def check_options(
    system: ConstrainedSystem,
    method: Any,
    rtol: Any,
    atol: Any,
    first_step: Any,
    max_step: Any,
    max_steps: Any,
    step_size: Any,
    dense_output: Any,
    progress: Any,
    time_limit: Any,
    check_derivatives: Any,
    compiled: Any,
) -> Asked:
    """The options of a call as a run needs them; raises where one is wrong."""
    check_flag("dense_output", dense_output)
    if progress is not None:
        check_flag("progress", progress)
    compiled = check_compiled(compiled)
    check_flag("check_derivatives", check_derivatives)
    chosen = check_method(method)
    check_positive("rtol", rtol)
    atol = check_tolerance("atol", atol, system.n_q)
    if max(rtol, atol.min()) < ROUNDING:
        raise ValueError(
            f"rtol and atol must not both be below {ROUNDING:g}, where rounding hides the error; given {rtol!r} and "
            f"{float(atol.min())!r}"
        )
    if first_step is not None:
        check_positive("first_step", first_step)
    check_positive("max_step", max_step, infinite=True)
    if step_size is not None:
        check_positive("step_size", step_size)
        if first_step is not None or max_step != np.inf:
            raise ValueError("step_size is a constant step: give neither first_step nor max_step with it")
    if max_steps is not None:
        check_size("max_steps", max_steps, 1)
    if time_limit is not None:
        check_positive("time_limit", time_limit)
    if system.n_a > 0 and getattr(chosen, "variables", "velocities") == "momenta":
        raise ValueError(
            f"method with variables='momenta' needs constraints on positions only: there are no canonical variables "
            f"for the n_a = {system.n_a} nonholonomic rows of {system.name!r}. Take variables='velocities'"
        )
    sizes = first_step, float(max_step), max_steps, step_size
    return Asked(chosen, float(rtol), atol, *sizes, compiled, bool(check_derivatives))


def check_method(method: str | Method) -> Method:
    """The method of a name, or the object itself, or what is wrong with it."""
    known = ", ".join(PRESETS)
    if isinstance(method, str):
        if method not in PRESETS:
            raise ValueError(f"method must be one of {known}, or a method object; given {shown(method)}")
        return PRESETS[method]
    if isinstance(method, type) or not callable(getattr(method, "plan", None)):
        raise TypeError(
            f"method must be a name ({known}) or an object such as RungeKutta(gauss(3)); given {shown(method)}"
        )
    return method


@contextmanager
def _progress_bar(name: str, t0: float, t1: float) -> Iterator[Any]:
    """A function that takes the time reached, and draws it."""
    try:
        from rich.progress import Progress
    except ImportError as error:
        raise ImportError("progress=True needs the package rich: pip install rich") from error
    with Progress() as bar:
        task = bar.add_task(f"{name}, t = {t0:g} to {t1:g} s", total=t1 - t0)
        yield lambda t: bar.update(task, completed=t - t0)
