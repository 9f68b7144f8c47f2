"""Check a finished run: compare its callbacks with their traces, and rerun pieces of the run with another method."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from contextlib import suppress
from itertools import cycle, islice
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from twoloop.checks.derivatives import wrong_derivative
from twoloop.checks.structure import run_inconsistency
from twoloop.generate.derived_callbacks import exact_derivatives, generic_states
from twoloop.generate.traced_values import CLEAR_DIFFERENCE, MAX_STATES_IN_PYTHON, CheckedRegion
from twoloop.kernels.compile.callbacks import KINDS
from twoloop.kernels.data import indices
from twoloop.methods import dop853
from twoloop.methods.dop853 import DOP853
from twoloop.methods.runge_kutta import RungeKutta
from twoloop.methods.tableaux import radau_iia
from twoloop.problem.callbacks import PythonFunctions
from twoloop.problem.system import ConstrainedSystem
from twoloop.run.fallbacks import apply_jump
from twoloop.run.record import Status
from twoloop.run.run import Run

Array = NDArray[np.float64]

# after a run, calls of a Python force are repeated: one for each CALLS_PER_REPETITION calls, but at most MAX_REPEATED.
# So a force that changes in one of a hundred calls is found
CALLS_PER_REPETITION, MAX_REPEATED = 8, 256
FIRST_FORCE = "first force"  # key of `system.derived`: value of an untraced `force` at the start of a run
N_DERIVATIVES = 4  # number of states of a run at which derivatives are checked after the run, including the last state


def checked_region_of(run: Run, check_derivatives: bool) -> CheckedRegion:
    """Return the region of states where earlier runs compared callbacks with their traces (recorded operations)."""
    if run.region is not None:
        return run.region
    key = (check_derivatives, *map(id, run.traced))  # the system keeps the traces, so that their ids stay unique
    return run.system.remembered(("checked region", key), CheckedRegion)  # type: ignore[no-any-return]


def check_callbacks_along_run(
    run: Run,
    states: Callable[[bool], Array],
    end: float,
    check_derivatives: bool,
    status: Status,
    message: str,
    is_due: bool,
    is_inside: bool = False,
) -> tuple[Status, str]:
    """After a run, compare callbacks with their traces at states of the run; return its final status and message.

    If all callbacks are right, return `status` and `message`; else another status, and a message that begins with the
    difference. Python forces are called twice, and must return equal values. If `check_derivatives`, derivatives are
    compared with exact ones, or with finite differences. `end`: time at which the run ended.

    `is_due`: if True, states to compare are chosen from `states(True)`: rows [t, q, v]; the last is the run's start.
    If False, this is also done if varied parameters are outside the region of earlier comparisons, see `CheckedRegion`.
    Otherwise, states are chosen from those rows of `states(False)` that are outside this region; no states are compared
    if `is_inside` (the whole run is inside the region), or if `end` <= run.compared_until[0].
    """
    if changed := describe_changed_value(run):
        return Status.WRONG_TRACE, f"{changed} {message}"
    region, parameters, old_status = checked_region_of(run, check_derivatives), run.varied_parameters, status
    all_states = is_due or (parameters is not None and not region.contains_parameters(parameters))
    if not all_states and (is_inside or end <= run.compared_until[0]):
        run.compared_until[0] = max(run.compared_until[0], end)
        return status, message
    chosen = states(all_states)
    first_state = chosen[-1]
    if not all_states:
        chosen = region.states_outside(chosen)
    if len(chosen) > 0:
        if check_derivatives:
            status, message = _check_derivatives(run, chosen, first_state, status, message)
        if wrong := next(filter(None, (traced.difference(run.system, chosen) for traced in run.traced)), None):
            status, message = Status.WRONG_TRACE, f"In the run {wrong}. {message}"
        if status == old_status and run.system.called_in_python and run.control[run.a.FIXED_STEP] == 0.0:
            difference = find_nondeterminism(run.system, chosen[:: 1 + len(chosen) // MAX_STATES_IN_PYTHON])
            if difference is not None:
                status, message = Status.WRONG_TRACE, f"In the run {difference}. {message}"
    if status == old_status:
        region.add(chosen)
        run.compared_until[0] = end
        if parameters is not None:
            region.add_parameters(parameters)
    return status, message


def _check_derivatives(run: Run, states: Array, first_state: Array, status: Status, message: str) -> tuple[Status, str]:
    """Compare callbacks for derivatives with exact derivatives or finite differences; return a status and a message.

    M, `kinematics` and callbacks for entries of sparse matrices are checked, too. Without a mistake, return `status`
    and `message`; else WRONG_DERIVATIVE and a message with the mistake. `first_state`: first [t, q, v] of the run.
    """
    n = run.system.n_q
    chosen_states = states[:: 1 + (len(states) - 1) // N_DERIVATIVES][::-1]
    checked_states = [(float(each[0]), each[1 : 1 + n], each[1 + n :]) for each in chosen_states]
    exact = exact_derivatives(run.system)
    derivatives_agree = exact is not None and exact.difference(run.system, generic_states(checked_states)) is None
    difference = run_inconsistency(run.system, checked_states, float(first_state[0]), first_state[1 : 1 + n])
    for t, q, v in () if derivatives_agree or difference is not None else checked_states:
        mistake = wrong_derivative(run.system, t, q, v)
        if mistake is not None:
            difference = t, mistake
            break
    if difference is None:
        return status, message
    return Status.WRONG_DERIVATIVE, f"At t = {difference[0]:.10g} of the run {difference[1]} {message}"


def find_nondeterminism(system: ConstrainedSystem, states: Array) -> str | None:
    """Describe the error if two calls of a Python force at one of `states` (rows [t, q, v]) differ; None: no error."""
    n, forces = system.n_q, []
    with warnings.catch_warnings(), np.errstate(all="ignore"):
        warnings.simplefilter("ignore")
        for t, *state in (*states, *states[::-1]):
            try:
                forces.append(system.force(t, np.array(state[:n]), np.array(state[n:])))
            except Exception:  # the force is not defined at this state
                forces.append(np.full(n, np.nan))
    first_forces, second_forces = np.array(forces[: len(states)]), np.array(forces[len(states) :][::-1])
    comparable = np.isfinite(first_forces) & np.isfinite(second_forces)
    differences = np.abs(np.subtract(first_forces, second_forces, out=np.zeros_like(first_forces), where=comparable))
    if not differences.max() > CLEAR_DIFFERENCE * np.abs(first_forces[comparable]).max(initial=0.0):
        return None
    k, entry = np.unravel_index(differences.argmax(), differences.shape)
    return _change_text(
        system.name, "force", float(states[k, 0]), int(entry), first_forces[k, entry], second_forces[k, entry]
    )


def python_functions(system: ConstrainedSystem) -> PythonFunctions | None:
    """Return the object with a system's functions that are called in Python, or None if it has none."""
    return PythonFunctions.registry.get(float(system.functions.p[0])) if system.called_in_python else None


def first_force(system: ConstrainedSystem, t0: float, q0: Array, v0: Array) -> tuple[Any, Array] | None:
    """Return ((t0, q0, v0), value of the compiled force) for `describe_changed_value`; None if the force fails.

    If callbacks are called in Python, the run will record calls of the force: discard older records, and return None.
    """
    if functions := python_functions(system):
        functions.restart()
        return None
    with suppress(Exception):  # the checks of the start, or the run, will report the error
        return (t0, q0.copy(), v0.copy()), np.asarray(system.force(t0, q0, v0))
    return None


def describe_changed_value(run: Run) -> str | None:
    """Repeat calls of callbacks that were recorded before or in a run; describe a changed value, or return None.

    Two calls after the run would not reveal a value that changes slowly (with the clock) or once (after 1000 calls).
    """
    system, functions = run.system, python_functions(run.system)
    if run.control[run.a.FIXED_STEP] != 0.0:
        return None
    if functions is None:
        return _changed_value(run, "force", system.force, system.derived.get(FIRST_FORCE, []), 1)
    for kind, samples in functions.samples.items():
        wanted = min(MAX_REPEATED, functions.n_calls[kind] // CALLS_PER_REPETITION) if kind == "force" else 0
        n_repeated = max(len(samples), wanted)
        if samples and (text := _changed_value(run, kind, functions.functions[kind], samples, n_repeated)):
            return text
    return None


def _changed_value(
    run: Run, kind: str, function: Callable[..., Any], samples: list[Any], n_repeated: int
) -> str | None:
    """Repeat calls of a callback, `samples` of (arguments, value) in turn; describe a changed value, or return None.

    Constraints are zero up to rounding, which may differ: a changed one must displace a coordinate by the tolerance.
    """
    system = run.system
    with warnings.catch_warnings(), np.errstate(all="ignore"):
        warnings.simplefilter("ignore")
        for arguments, value in islice(cycle(samples), n_repeated):
            try:
                new_value = np.asarray(function(float(arguments[0]), *map(np.copy, arguments[1:])))
            except Exception:  # the state is outside the domain of the function
                continue
            comparable = np.isfinite(value) & np.isfinite(new_value)
            differences = np.abs(np.subtract(value, new_value, out=np.zeros_like(value), where=comparable))
            if differences.max(initial=0.0) > CLEAR_DIFFERENCE * np.abs(value[comparable]).max(initial=0.0):
                k, t, q = int(differences.argmax()), float(arguments[0]), arguments[1]
                least = run.tolerances[indices.LEAST] * max(1.0, np.abs(q).max())
                if kind == "constraint" and differences.max() <= least * np.abs(system.jacobian(t, q)).max():
                    continue
                return f"In the run {_change_text(system.name, kind, t, k, value.flat[k], new_value.flat[k])}."
    return None


def _change_text(name: str, kind: str, t: float, entry: int, first_value: float, second_value: float) -> str:
    state = "t, q and v" if len(KINDS[kind].state) > 1 else "t and q"
    return (
        f"{kind} of {name!r} gives something else when it is called again with the same {state}: at "
        f"t = {t:.10g} entry {entry} is {first_value:.9g}, and then {second_value:.9g}. It must "
        "depend on its arguments alone: steps are tried, rejected and sampled in advance"
    )


CHUNK_ATTEMPTS = 256  # largest number of attempted steps in one call of `advance`
FIRST_FRACTION = 0.1  # (first step size) / (duration of a piece), unless the last piece has proposed a step size
MAX_BUFFER_SIZE = 100_000  # largest number of floats in the buffer of states


class RerunPiece(NamedTuple):
    """Result of a rerun of a piece: rows [q, v] at the requested times, largest step size (s), number of steps."""

    states: Array
    longest: float
    n_steps: int


class IndependentRerun:
    """Integrator that reruns pieces of a run with another method, to check it; a piece starts at a state of the run.

    (t, q, v): any state of the run, to set up the arrays. `method`: "explicit" for `DOP853`; for stiff pieces
    "all" or "positions", a Radau method whose error test includes all components, or only positions.
    """

    def __init__(
        self,
        system: ConstrainedSystem,
        t: float,
        q: Array,
        v: Array,
        method: str,
        rtol: float,
        atol: Array,
        max_step: float,
    ):
        tableau = radau_iia(7)
        stiff = RungeKutta(tableau, outer="newton", tested="all" if method == "all" else "positions")
        chosen = DOP853() if method == "explicit" else stiff
        nodes = dop853.C if method == "explicit" else tableau.c  # times of evaluations, as fractions of a step
        self.spacing = float(np.diff(np.unique(np.concatenate([[0.0], nodes, [1.0]]))).max())
        plan = chosen.plan(system.n_q, rtol, float(atol.min()), False)
        self.run = Run(system, plan, t, q, v, rtol, atol, None)
        a, control = self.run.a, self.run.control
        control[a.MAX_STEP], control[a.MAY_CROSS], control[a.STORE_ALL] = max_step, 0.0, 0.0
        control[a.MAX_ATTEMPTS] = CHUNK_ATTEMPTS
        self.run.work.notes[indices.GAMMA_REQUIRED] = np.inf  # any error of gamma is allowed: the checked run tested it
        n_rows = max(2, min(CHUNK_ATTEMPTS, MAX_BUFFER_SIZE // len(self.run.state)))
        rows = (np.empty(n_rows), np.empty((n_rows, len(self.run.state))))
        self.buffers, self.n_filled = (*rows, np.empty((CHUNK_ATTEMPTS, a.N_STEP_COLUMNS))), np.zeros(2, dtype=np.int64)
        self.next_step = np.inf

    def integrate(self, t0: float, state: Array, times: Array, max_attempts: int) -> RerunPiece | None:
        """Integrate from [q, v] at t0 to all `times`; return None on failure, or after about `max_attempts` steps."""
        run, a, n = self.run, self.run.a, len(state)
        proposed_step, self.next_step = self.next_step, np.inf
        if run.restart(t0, state[: n // 2], state[n // 2 :]) != indices.DONE:
            return None
        t1 = float(times[-1])
        run.clock[a.H_NEXT] = proposed_step if proposed_step < np.inf else FIRST_FRACTION * (t1 - t0)
        run.work.notes[indices.NEXT_JUMP] = t1
        states: list[Array] = []
        longest, n_total = 0.0, 0
        buffers, filled = self.buffers, self.n_filled
        for _ in range(0, max_attempts + len(times), len(buffers[0])):
            code = run.advance(times, buffers, filled)
            n_rows, n_steps = filled.tolist()
            states.append(buffers[1][:n_rows, :n].copy())
            longest, n_total = max(longest, float(buffers[2][:n_steps, a.H].max(initial=0.0))), n_total + n_steps
            if code == a.ALL_OUTPUT_DONE:
                self.next_step = float(run.clock[a.H_NEXT])
                return RerunPiece(np.concatenate(states), longest, n_total)
            if code != a.PAUSED and not (code == a.AT_DISCONTINUITY and apply_jump(run, t1)):
                break
        return None
