"""What goes on where a run's own steps cannot: another plan, a step to load, one across what is singular, a jump."""

from functools import cache

import numpy as np
from numpy.typing import NDArray

from twoloop.kernels.compile.linking import direct
from twoloop.kernels.data import codes, noted, tolerances
from twoloop.kernels.data.kit import Kit
from twoloop.kernels.steps.named_step import loaded
from twoloop.methods.plan import INNER_TOL, LARGEST_MOVE, Plan
from twoloop.methods.tableaux import gauss
from twoloop.run.discontinuities import state_behind_jump
from twoloop.run.run import Run
from twoloop.run.workspace import kit_of, kit_with

Array = NDArray[np.float64]

# of the longest of the last steps: lengths tried for a step across a singular position, on which no stage should fall
BRIDGES = tuple(0.85**k for k in range(28))
CLEAR = 0.3  # of the largest pivot that C_q had: where the run's own steps go on


def give_way(run: Run) -> None:
    """Go on with the plan that takes over where values of this one are not finite."""
    substitute = run.plan.substitute
    assert substitute is not None
    run.plan, run.memory = substitute.fresh(), substitute.memory  # in which no run writes
    _renew_kit(run)
    run.substituted = True
    run.control_by(run.plan)
    run.limit_steps()
    run.clock[run.a.FAILURE_CODE] = codes.DONE
    run.clock[run.a.H_NEXT] = run.clock[run.a.H_FAILED]
    run.clock[: run.a.N_PAST] = 0.0


def load(run: Run) -> None:
    """Load the step that a run has come to."""
    loaded(run.plan.second)
    _renew_kit(run)


def _renew_kit(run: Run) -> None:
    """Have kernels call what the run's plan names now."""
    if run.static is None:
        run.kit = kit_with(run.system, run.functions.flags, run.plan)
    else:
        run.kit = kit_of(run.system, run.t0, run.state[: run.system.n_q], run.plan, run.static)
    run.functions = run.kit.functions


def bridge(run: Run) -> tuple[Plan, Array]:
    """The plan and the controls for steps across a singular position, see kernels/steps/bridge.py."""
    a, clock = run.a, run.clock
    run.crossings.append([(float(clock[a.T]), run.state.copy())])
    plan = _plan_across(run.system.n_q)
    control = run.control.copy()
    control[: a.N_RULE] = plan.rule
    control[a.SYMMETRIC], control[a.BRIDGE], control[a.MAX_ATTEMPTS] = 0.0, 0.0, 1.0
    control[a.GIVES_WAY] = control[a.IN_A_ROW] = 0.0
    if control[a.FIXED_STEP] == 0.0:
        control[a.MAX_STEP] = min(run.max_step, run.tolerances[tolerances.GAP])
    clock[a.H_LIMIT], clock[a.LIMIT_AGE] = np.inf, 0.0
    run.lengths = [float(clock[a.H_LONG]) * part for part in BRIDGES]
    clock[a.H_NEXT] = run.lengths.pop(0)
    return plan, control


def _plan_across(n_q: int) -> Plan:
    """The plan of steps across a singular position."""
    from twoloop.kernels.steps import bridge

    return Plan(bridge.BRIDGING, _options_across(), np.zeros(bridge.memory_size(n_q)), exponent=1.0 / bridge.ORDER)


@cache
def _options_across() -> Array:
    """Compute the options of such steps once: the tableau takes longer than most steps across."""
    from twoloop.kernels.steps import bridge

    tableau = gauss(bridge.S)
    return bridge.options_array(tableau.A, tableau.b, tableau.c, INNER_TOL, LARGEST_MOVE)


def bridging_kit(kit: Kit) -> Kit:
    """What steps across call; it stays with what the run's own steps call."""
    from twoloop.kernels.steps.bridge import BRIDGING

    known = vars(kit)
    if "bridging" not in known:
        known["bridging"] = Kit(kit.functions, kit.general, BRIDGING)
    return known["bridging"]  # type: ignore[no-any-return]


def beyond(run: Run, plan: Plan, control: Array, code: int, accepted: int) -> tuple[Plan, Array, int]:
    """What goes on after an attempt at a step across: the same, or the run's own steps again."""
    a = run.a
    if code == a.PAUSED and accepted == 0 and run.lengths:
        run.clock[a.H_NEXT], run.clock[a.H_LIMIT] = run.lengths.pop(0), np.inf
        return plan, control, code
    if code == a.PAUSED and accepted > 0 and (run.work.notes[noted.PIVOT] < CLEAR * run.clock[a.LARGEST_PIVOT]):
        run.lengths = [float(run.clock[a.H_LONG]) * part for part in BRIDGES]
        return plan, control, code
    if code not in (a.PAUSED, a.STEP_TOO_SMALL, a.FIXED_STEP_FAILED, a.RANK_LOST):
        return plan, control, code
    if accepted == 0:  # there is no way across: the run's own steps go on as far as they can
        run.control[a.BRIDGE] = 0.0
    run.crossings[-1].append((float(run.clock[a.T]), run.state.copy()))
    run.plan.memory[:] = run.memory
    run.clock[: a.N_PAST] = 0.0
    return run.plan, run.control, a.PAUSED


def leap(run: Run, t1: float) -> bool:
    """Make ready the step over a jump of C_t or b, after which the method begins anew; whether there is one."""
    a, clock, n = run.a, run.clock, run.system.n_q
    end = float(clock[a.JUMP_TO])
    state = state_behind_jump(run.system, end, run.state[:n], run.state[n : 2 * n])
    if state is None:
        return False
    run.new_state[: 2 * n] = state
    run.work.notes[noted.KINK_AFTER] = t1
    if direct(run.kernels.start)(run.kit, run.work, end, run.new_state) != codes.DONE:
        return False
    run.jumps.append(end)
    run.plan.memory[:] = run.memory
    clock[a.LEAPS] = 1.0
    clock[a.H_LIMIT], clock[a.LIMIT_AGE] = run.plan.limit_start, 0.0
    if end < t1:
        clock[a.H_NEXT] = min(clock[a.H_NEXT], run.first_step(end, t1, run.new_state))
    return True
