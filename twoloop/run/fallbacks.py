"""Continue a run where its own steps cannot: with another method, across a singular position, or over a jump."""

from functools import cache

import numpy as np
from numpy.typing import NDArray

from twoloop.kernels.compile.linking import entry_point
from twoloop.kernels.data import indices
from twoloop.kernels.data.common import Kit
from twoloop.kernels.steps.lazy import loaded
from twoloop.methods.plan import INNER_TOL, LARGEST_MOVE, Plan
from twoloop.methods.tableaux import gauss
from twoloop.run.discontinuities import state_behind_jump
from twoloop.run.run import Run
from twoloop.run.workspace import kit_of, kit_with

Array = NDArray[np.float64]

# lengths to try for a step across a singular position, on which no stage should fall, over the longest last step
LENGTHS = tuple(0.85**k for k in range(28))
CLEAR = 0.3  # relative to the largest pivot that C_q had: above it the run's own steps continue


def may_cross(run: Run, code: int) -> bool:
    """Return whether steps across a singular position follow, also if the method asks for a switch near one."""
    a, notes = run.a, run.work.notes
    if code == a.SWITCH_METHOD:
        from twoloop.kernels.steps.lobatto_step import TIGHT

        near = notes[indices.NEARLY_SINGULAR] == notes[indices.NEAR_NOW] == 1.0
        return bool(near and run.control[a.BRIDGE] == 1.0 and run.tolerances[indices.LEAST] >= TIGHT)
    return code == a.NEAR_SINGULAR


def switch_method(run: Run) -> None:
    """Switch to the substitute plan, because the run's method is not suited, or its values are not finite."""
    substitute = run.plan.substitute
    assert substitute is not None
    run.plan, run.memory = substitute.fresh(), substitute.memory  # no run writes to this memory
    _renew_kit(run)
    run.substituted = True
    run.control_by(run.plan)
    run.limit_steps()
    run.clock[run.a.FAILURE_CODE] = indices.DONE
    run.clock[run.a.H_NEXT] = run.clock[run.a.H_FAILED]
    run.clock[: run.a.N_PAST] = 0.0


def load(run: Run) -> None:
    """Load the compiled step that a run needs next."""
    loaded(run.plan.second)
    _renew_kit(run)


def _renew_kit(run: Run) -> None:
    """Create the kit that calls the steps of the run's plan."""
    if run.static is None:
        run.kit = kit_with(run.system, run.functions.flags, run.plan)
    else:
        run.kit = kit_of(run.system, run.t0, run.state[: run.system.n_q], run.plan, run.static)
    run.functions = run.kit.functions


def cross_singularity(run: Run) -> tuple[Plan, Array]:
    """Return the plan and the controls for steps across a singular position, see kernels/steps/crossing_step.py."""
    a, clock = run.a, run.clock
    run.crossings.append([(float(clock[a.T]), run.state.copy())])
    from twoloop.kernels.steps.crossing_step import UNSEEN

    plan = _crossing_plan(run.system.n_q)
    control = run.control.copy()
    control[: a.N_RULE] = plan.rule
    control[a.SYMMETRIC], control[a.BRIDGE], control[a.MAX_ATTEMPTS] = 0.0, 0.0, 1.0
    control[a.MAY_SWITCH] = control[a.MAKES_MANY] = 0.0
    if control[a.FIXED_STEP] == 0.0:
        control[a.MAX_EVALUATION_GAP] = 1.0 if run.narrow else UNSEEN
        control[a.MAX_STEP] = min(run.max_step, run.tolerances[indices.GAP] / control[a.MAX_EVALUATION_GAP])
    clock[a.H_LIMIT], clock[a.LIMIT_AGE] = np.inf, 0.0
    run.lengths = lengths_across(float(clock[a.H_LONG]), float(control[a.MAX_STEP]))
    clock[a.H_NEXT] = run.lengths.pop(0)
    return plan, control


def lengths_across(longest: float, allowed: float) -> list[float]:
    """Return the lengths to try for a step across, s; each above the largest one allowed would be the same attempt."""
    first = min(longest, allowed)
    return [first, *(longest * part for part in LENGTHS if longest * part < first)]


def _crossing_plan(n_q: int) -> Plan:
    """Make the plan of steps across a singular position."""
    from twoloop.kernels.steps import crossing_step as kernels

    return Plan(kernels.CROSSING, _crossing_options(), np.zeros(kernels.memory_size(n_q)), exponent=1.0 / kernels.ORDER)


@cache
def _crossing_options() -> Array:
    """Compute the options of steps across, once: the tableau takes longer than most of these steps."""
    from twoloop.kernels.steps import crossing_step as kernels

    tableau = gauss(kernels.S)
    return kernels.options_array(tableau.A, tableau.b, tableau.c, INNER_TOL, LARGEST_MOVE)


def crossing_kit(kit: Kit) -> Kit:
    """Return the kit of steps across, which is cached with that of the run's own steps."""
    from twoloop.kernels.steps.crossing_step import CROSSING

    known = vars(kit)
    if "crossing" not in known:
        known["crossing"] = Kit(kit.functions, kit.general, CROSSING)
    return known["crossing"]  # type: ignore[no-any-return]


def after_crossing(run: Run, plan: Plan, control: Array, code: int, accepted: int) -> tuple[Plan, Array, int]:
    """Choose what follows an attempt at a step across: another length, another such step, or the run's own steps."""
    a = run.a
    if code == a.PAUSED and accepted == 0 and run.lengths:
        run.clock[a.H_NEXT], run.clock[a.H_LIMIT] = run.lengths.pop(0), np.inf
        return plan, control, code
    if code == a.PAUSED and accepted > 0 and (run.work.notes[indices.PIVOT] < CLEAR * run.clock[a.LARGEST_PIVOT]):
        run.lengths = lengths_across(float(run.clock[a.H_LONG]), float(control[a.MAX_STEP]))
        return plan, control, code
    if code not in (a.PAUSED, a.STEP_TOO_SMALL, a.FIXED_STEP_FAILED, a.RANK_LOST):
        return plan, control, code
    if accepted == 0:  # there is no way across: the run's own steps go on as far as they can
        run.control[a.BRIDGE] = 0.0
    run.crossings[-1].append((float(run.clock[a.T]), run.state.copy()))
    run.work.notes[indices.NEAR_NOW] = 0.0
    run.plan.memory[:] = run.memory
    run.clock[: a.N_PAST] = 0.0
    return run.plan, run.control, a.PAUSED


def apply_jump(run: Run, t1: float) -> bool:
    """Prepare the step over a jump of C_t or b, after which the method restarts; return whether there is one."""
    a, clock, n = run.a, run.clock, run.system.n_q
    end = float(clock[a.JUMP_TO])
    state = state_behind_jump(run.system, end, run.state[:n], run.state[n : 2 * n])
    if state is None:
        return False
    run.new_state[: 2 * n] = state
    run.work.notes[indices.KINK_AFTER] = t1
    if entry_point(run.kernels.start)(run.kit, run.work, end, run.new_state) != indices.DONE:
        return False
    run.jumps.append(end)
    run.plan.memory[:] = run.memory
    clock[a.APPLIES_JUMP] = 1.0
    clock[a.H_LIMIT], clock[a.LIMIT_AGE] = run.plan.limit_start, 0.0
    if end < t1:
        clock[a.H_NEXT] = min(clock[a.H_NEXT], run.first_step(end, t1, run.new_state))
    return True
