"""Comparison of callbacks at states of a finished run: derivatives, and the recorded traces."""

import warnings
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from twoloop.checks.derivatives import wrong_derivative
from twoloop.checks.structure import unlike_itself
from twoloop.generate.derived_callbacks import exact_derivatives, generic_states
from twoloop.generate.traced_values import CLEAR, FEW, CheckedRegion, Sample
from twoloop.problem.callbacks import PythonFunctions
from twoloop.problem.system import ConstrainedSystem
from twoloop.run.record import Status

if TYPE_CHECKING:
    from twoloop.run.run import Run

Array = NDArray[np.float64]

LATER = 4  # states of the run at which derivatives are checked again, including the last one


def compare_callbacks(
    run: "Run", sample: Sample, end: float, check_derivatives: bool, status: Status, message: str
) -> tuple[Status, str]:
    """Return the status and the message, changed if callbacks are wrong at states of the run.

    Compiled callbacks are not compared again in the region where they were: see CheckedRegion.
    """
    region = checked_region_of(run, check_derivatives)
    parameters = run.varied_parameters
    everywhere = region.is_due() or run.system.called_in_python
    everywhere = everywhere or (parameters is not None and not region.knows(parameters))
    region.count()
    if not everywhere and end <= run.compared_until[0]:
        return status, message
    before = status
    status, message = compare_callbacks_at(run, region, sample.states(), check_derivatives, status, message, everywhere)
    if status == before:
        run.compared_until[0] = end
        if parameters is not None:
            region.add_parameters(parameters)
    return status, message


def checked_region_of(run: "Run", check_derivatives: bool) -> CheckedRegion:
    """Return the region in which callbacks were compared, in runs of this system and kind."""
    if run.region is not None:
        return run.region
    what = (check_derivatives, *map(id, run.traced))  # the system keeps these objects, so that their ids stay unique
    return run.system.remembered(("territory", what), CheckedRegion)  # type: ignore[no-any-return]


def compare_callbacks_at(
    run: "Run",
    region: CheckedRegion,
    states: Array,
    check_derivatives: bool,
    status: Status,
    message: str,
    everywhere: bool = False,
) -> tuple[Status, str]:
    """Compare callbacks at states [t, q, v] of the run, the last first, outside the checked region or everywhere."""
    first = states[-1]
    if not everywhere:
        states = region.without_known(states)
    before = status
    if len(states) > 0:
        if check_derivatives:
            status, message = _derivatives_again(run, states, first, status, message)
        status, message = _traces(run, states, status, message)
        if status == before and run.system.called_in_python and run.control[run.a.FIXED_STEP] == 0.0:
            unlike = find_changed_force(run.system)
            unlike = unlike or find_nondeterminism(run.system, states[:: 1 + len(states) // FEW])
            if unlike is not None:
                status, message = Status.WRONG_TRACE, f"In the run {unlike}. {message}"
    if status == before:
        region.add(states)
    return status, message


def _derivatives_again(run: "Run", states: Array, first: Array, status: Status, message: str) -> tuple[Status, str]:
    """Return the status and the message, changed if a derivative or a constant mass is wrong at states of the run."""
    n = run.system.n_q
    chosen = states[:: 1 + (len(states) - 1) // LATER][::-1]
    some = [(float(each[0]), each[1 : 1 + n], each[1 + n :]) for each in chosen]
    exact = exact_derivatives(run.system)
    fine = exact is not None and exact.wrong(run.system, generic_states(some)) is None
    difference = unlike_itself(run.system, some, float(first[0]), first[1 : 1 + n])
    for t, q, v in () if fine or difference is not None else some:
        wrong = wrong_derivative(run.system, t, q, v)
        if wrong is not None:
            difference = t, wrong
            break
    if difference is None:
        return status, message
    return Status.WRONG_DERIVATIVE, f"At t = {difference[0]:.10g} of the run {difference[1]} {message}"


def find_nondeterminism(system: ConstrainedSystem, states: Array) -> str | None:
    """Describe how a force called in Python differs when it is evaluated again at the same state [t, q, v], or None."""
    n, forces = system.n_q, []
    with warnings.catch_warnings(), np.errstate(all="ignore"):
        warnings.simplefilter("ignore")
        for t, *state in (*states, *states[::-1]):
            try:
                forces.append(system.force(t, np.array(state[:n]), np.array(state[n:])))
            except Exception:  # the state is outside the domain of the force
                forces.append(np.full(n, np.nan))
    once, again = np.array(forces[: len(states)]), np.array(forces[len(states) :][::-1])
    both = np.isfinite(once) & np.isfinite(again)
    off = np.abs(np.subtract(once, again, out=np.zeros_like(once), where=both))
    if not off.max() > CLEAR * np.abs(once[both]).max(initial=0.0):
        return None
    k, entry = np.unravel_index(off.argmax(), off.shape)
    return _differs(system.name, float(states[k, 0]), int(entry), once[k, entry], again[k, entry])


def python_functions(system: ConstrainedSystem) -> PythonFunctions | None:
    """Return the functions of a system that are called in Python, or None."""
    return PythonFunctions.registry.get(float(system.functions.p[0])) if system.called_in_python else None


def find_changed_force(system: ConstrainedSystem) -> str | None:
    """Describe how a force called in Python differs from what it was in the run for the same arguments, or None.

    A force may change slowly, as with the clock, or once, as after 1000 calls: two calls at the end do not show that.
    """
    functions = python_functions(system)
    samples = [] if functions is None else functions.samples.copy()
    with warnings.catch_warnings(), np.errstate(all="ignore"):
        warnings.simplefilter("ignore")
        for arguments, value in samples:
            assert functions is not None
            try:
                again = np.asarray(functions.functions["force"](float(arguments[0]), *map(np.copy, arguments[1:])))
            except Exception:  # the state is outside the domain of the force
                continue
            both = np.isfinite(value) & np.isfinite(again)
            off = np.abs(np.subtract(value, again, out=np.zeros(len(value)), where=both))
            if off.max(initial=0.0) > CLEAR * np.abs(value[both]).max(initial=0.0):
                entry = int(off.argmax())
                return _differs(system.name, float(arguments[0]), entry, value[entry], again[entry])
    return None


def _differs(name: str, t: float, entry: int, once: float, again: float) -> str:
    return (
        f"force of {name!r} gives something else when it is called again with the same t, q and v: at "
        f"t = {t:.10g} entry {entry} is {once:.9g}, and then {again:.9g}. It must "
        "depend on its arguments alone: steps are tried, rejected and sampled in advance"
    )


def _traces(run: "Run", states: Any, status: Status, message: str) -> tuple[Status, str]:
    """Return the status and the message, changed if a callback differs from its recorded trace."""
    for traced in run.traced:
        wrong = traced.wrong(run.system, states)
        if wrong is not None:
            return Status.WRONG_TRACE, f"In the run {wrong}. {message}"
    return status, message
