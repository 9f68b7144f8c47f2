"""Advance by many steps with step-size control, until the last output time, a full buffer or a failure.

`advance` serves all methods: the functions of a method are in the kit `f`, its data in `options` and `memory`. Common
arguments: `w`: workspace (`Work`); `clock`, `control`: state and settings of the loop, see loop_state.py; `t`, `size`:
time and step size (s); `state`, `new_state`: [q, v, a, lam] before and after a step.
"""

import numpy as np

from twoloop.kernels.control import loop_state as at
from twoloop.kernels.control.discontinuities import (
    JUMP,
    RAMP,
    SMOOTH,
    limit_to_discontinuity,
    locate_discontinuity,
    unexplained_velocity_change,
)
from twoloop.kernels.control.loop_state import EXPONENT, FACTOR_MIN, SAFETY
from twoloop.kernels.control.singular_positions import (
    SHORT_STEP,
    check_partition,
    comes_near_singular,
    ends_near_singular,
    is_near_singular,
    is_too_short_near_singular,
    prepare_projected_repetition,
    record_pivot_at_output,
)
from twoloop.kernels.control.step_size import (
    EQUAL_SPACINGS,
    count_step,
    record_accepted_step,
    size_off_grid,
    size_on_grid,
    step_size_ratio,
)
from twoloop.kernels.data.collocation import LANES
from twoloop.kernels.data.common import INTEGERS, KIT, MATRIX, VECTOR, WORK, f8, i8, kernel, merged
from twoloop.kernels.data.indices import (
    DONE,
    FIXED_ORDER,
    GAP,
    INNER_DIVERGED,
    NEEDS_DENSE,
    NOT_FINITE,
    NOT_LOADED,
    SINGULAR,
    UNSUITED,
)
from twoloop.kernels.evaluation.inner_loop import (
    accelerations,
    adopt_midpoint_partition,
    check_redundant_rows,
    find_tangents,
    prepare_mass,
    renew_partition,
)
from twoloop.kernels.evaluation.partition import PARTITION_CHANGED
from twoloop.kernels.linalg.dense import copy

SUDDEN_ERROR = 10.0  # a force is assumed to jump within a rejected step whose error, in tolerances, exceeds this
MAX_RATIO_AFTER_REJECTION = 0.95  # the next step size is at most this times the size of a rejected step
FIRST_JUDGED_STEP = 2  # number of accepted steps before a trial judges proposed step sizes: the first size is a guess


@kernel(i8(KIT, WORK, f8, VECTOR))
def start(f, w, t, state):
    """Before the first step, choose the partition, and store a and lam in `state`; return DONE or a failure code."""
    n = w.Q.size
    q, v = state[:n], state[n : 2 * n]
    w.last_jump = t  # a drive may start suddenly: treat t as the time of a jump of the constraint rates C_t and b
    code = prepare_mass(f, w, t, q)
    if code == DONE:
        code = renew_partition(f, w, t, q)
    if code == DONE:
        code = find_tangents(f, w, t, q)
    if code == DONE:
        code = accelerations(f, w, t, q, v, state[2 * n : 3 * n], state[3 * n :])
    # the size of Gamma, which sets the allowed error of finite differences for Gamma, is now known: compute Gamma again
    if code == DONE and f.gamma_given == 0:
        code = accelerations(f, w, t, q, v, state[2 * n : 3 * n], state[3 * n :])
    return code


@merged
def _locate_rate_jump(f, w, t, size, tolerances, accepted, state, new_state):
    """Return how C_t and b change in a step (SMOOTH, RAMP or JUMP), and when (s) a ramp or jump begins and ends."""
    n = w.Q.size
    q, v = state[:n], state[n : 2 * n]
    if not accepted:
        return locate_discontinuity(f, w, t, t + size, q, v, v, tolerances)
    if not unexplained_velocity_change(tolerances, size, state, new_state, n) > 1.0:
        return SMOOTH, t, t
    for m in range(n):
        w.y[m] = (new_state[m] - state[m]) / size
    return locate_discontinuity(f, w, t, t + size, q, v, w.y, tolerances)


@merged
def _attempt_step(f, w, options, memory, tolerances, control, clock, t, size, crosses_jump, state, new_state):
    """Attempt a step; return a code, the step's error in tolerances, and (next step size) / size, or 0 if unknown.

    If `crosses_jump`, compute nothing: `new_state` is the state after a jump of C_t or b. Code DONE: no failure.
    """
    w.orientation_new = 0.0
    if clock[at.FAILURE_CODE] == DONE:
        w.fault_kind = -1.0
    if crosses_jump:
        w.defect = 0.0
        w.orientation_new = w.orientation
        return DONE, 0.0, 0.0
    w.defect = -1.0
    code, error, factor = f.attempt(f, w, options, memory, t, size, tolerances, state, new_state)
    if code == DONE and np.isfinite(error) and control[at.SYMMETRIC] == 1.0:
        code = adopt_midpoint_partition(f, w, t + 0.5 * size, state, new_state)
        if code == PARTITION_CHANGED:
            f.commit(f, w, options, memory, tolerances, False)
            code, error, factor = f.attempt(f, w, options, memory, t, size, tolerances, state, new_state)
    if code == DONE and not np.isfinite(error):
        code = NOT_FINITE
    return code, error, factor


@merged
def _must_repeat_at_jump(f, w, tolerances, control, clock, t, size, accepted, state, new_state):
    """Return True if a step must be repeated with another end, because C_t or b jumps or has a steep ramp in the step.

    For a jump, store the times just before and after it in clock[JUMP_FROM] and clock[JUMP_TO]. A ramp matters
    only if the step was `accepted` and its size is not fixed. For a ramp, store the next step size in clock[H_NEXT].
    """
    kind, low, high = _locate_rate_jump(f, w, t, size, tolerances, accepted, state, new_state)
    if kind == JUMP:
        clock[at.JUMP_FROM] = t if low - t <= EQUAL_SPACINGS * np.spacing(abs(t)) else low
        clock[at.JUMP_TO] = high
        w.next_jump = clock[at.JUMP_FROM]
        return True
    if kind == RAMP and accepted and control[at.FIXED_STEP] == 0.0:
        clock[at.H_NEXT] = max(low - t, high - low)
        return True
    return False


@merged
def _handle_failure(f, w, control, clock, t, size, code, t_repeated, state):
    """Prepare to repeat a step that failed with `code`, and return CONTINUE; or return a code that ends `advance`.

    A step is repeated with a smaller size, a new partition, or both. A step of fixed size is repeated only once, with a
    new partition. `t_repeated`: time (s) from which a step of fixed size was last repeated.
    """
    n = w.Q.size
    needs_partition = code in (SINGULAR, INNER_DIVERGED)
    if code == NEEDS_DENSE or is_too_short_near_singular(f, clock, size):
        return at.NEEDS_DENSE
    w.n_rejected_convergence += 1
    if prepare_projected_repetition(f, w, control, clock, size):
        return at.CONTINUE
    clock[at.FAILURE_CODE] = code
    clock[at.H_FAILED] = size
    if code in (NOT_FINITE, UNSUITED) and control[at.MAY_SWITCH] == 1.0:
        return at.SWITCH_METHOD
    if control[at.FIXED_STEP] > 0.0:
        if not needs_partition or t == t_repeated:
            return at.NEAR_SINGULAR if is_near_singular(f, w, control, clock, t, state[:n]) else at.FIXED_STEP_FAILED
    else:
        if size < SHORT_STEP * clock[at.H_LONG] and is_near_singular(f, w, control, clock, t, state[:n]):
            return at.NEAR_SINGULAR
        clock[at.H_LIMIT] = control[at.LIMIT_FACTOR] * size
        clock[at.LIMIT_AGE] = 0.0
        clock[at.H_NEXT] = 0.5 * size
    if needs_partition and renew_partition(f, w, t, state[:n]) != DONE:
        return at.NEEDS_DENSE if f.form == FIXED_ORDER else at.RANK_LOST
    return at.CONTINUE


@merged
def _handle_rejection(f, w, control, clock, t, size, proposed_size, state):
    """After a step with too large an error, store the size (s) of its repetition in clock[H_NEXT]; return CONTINUE.

    If the step is short and a singular position is near, return a code that ends `advance`. `proposed_size`: size (s)
    that the error allows.
    """
    n = w.Q.size
    w.n_rejected_error += 1
    clock[at.FAILURE_CODE] = DONE
    if prepare_projected_repetition(f, w, control, clock, size):
        return at.CONTINUE
    clock[at.H_NEXT] = min(proposed_size, MAX_RATIO_AFTER_REJECTION * size, size - np.spacing(abs(t + size)))
    if is_too_short_near_singular(f, clock, size):
        return at.NEEDS_DENSE
    if size < SHORT_STEP * clock[at.H_LONG] and is_near_singular(f, w, control, clock, t, state[:n]):
        return at.NEAR_SINGULAR
    return at.CONTINUE


@merged
def _can_take_many_steps(control, clock):
    """Return True if the method may now take many steps in one call, without checks by `advance` between them."""
    if control[at.TAKES_MANY] == 0.0 or control[at.FIXED_STEP] > 0.0 or clock[at.APPLIES_JUMP] == 1.0:
        return False
    if control[at.SPACING] > 0.0 or clock[at.T] == clock[at.JUMP_FROM]:
        return False
    return clock[at.FAILURE_CODE] == DONE


@merged
def _pass_output_time(f, w, clock, outputs, state):
    """Update clock[PIVOT_AT_OUTPUT] and clock[NEXT_OUTPUT] at an output time; return True if it was the last one."""
    record_pivot_at_output(f, w, clock, state)
    clock[at.NEXT_OUTPUT] += 1.0
    return int(clock[at.NEXT_OUTPUT]) == outputs.size


_ADVANCE_SIGNATURE = i8(KIT, WORK, *(VECTOR,) * 9, MATRIX, MATRIX, INTEGERS)


@kernel(_ADVANCE_SIGNATURE)
def advance(
    f, w, options, memory, tolerances, control, clock, state, new_state, outputs, out_t, out_state, out_steps, filled
):
    """Integrate from clock[T] and `state` to the last time in `outputs`; return an end code, see loop_state.py.

    - Update `clock` and `state` in place. `new_state` is scratch; but if clock[APPLIES_JUMP] is 1, it contains the
      state after a jump of C_t or b, and the first step crosses this jump.
    - Shorten steps so that they end at output times. A step size is the difference of two floating-point times, so that
      step sizes add up to the exact time.
    - Store times and states in out_t and out_state: after each accepted step if control[STORE_ALL] is 1, otherwise at
      output times only. Store each accepted step in a row of out_steps. Store the number of entries of out_t in
      filled[0], and the number of rows of out_steps in filled[1].
    """
    fixed_size = control[at.FIXED_STEP] > 0.0
    n = w.Q.size
    t_repeated = np.inf  # time (s) from which a step of fixed size was last repeated with a new partition
    filled[0] = 0
    filled[1] = 0
    n_attempts = 0.0
    while True:
        if filled[0] == out_t.size or filled[1] == out_steps.shape[0] or n_attempts >= control[at.MAX_ATTEMPTS]:
            return at.PAUSED
        if w.n_accepted >= control[at.MAX_STEPS]:
            return at.MAX_STEPS_REACHED
        if _can_take_many_steps(control, clock):
            first, target = filled[0], outputs[int(clock[at.NEXT_OUTPUT])]
            goal = min(target, clock[at.JUMP_FROM])
            if min(out_t.size - first, out_steps.shape[0] - filled[1]) < LANES and first + filled[1] > 0:
                return at.PAUSED
            views = out_t[first:], out_state[first:], out_steps[filled[1] :]
            n_taken = f.attempt_many(f, w, options, memory, tolerances, control, clock, goal, state, new_state, *views)
            if n_taken > 0:
                at_output = clock[at.T] == target
                if control[at.STORE_ALL] == 1.0:
                    filled[0] += n_taken
                elif at_output:
                    out_t[first] = target
                    copy(state, out_state[first])
                    filled[0] += 1
                filled[1] += n_taken
                n_attempts += n_taken
                if at_output and _pass_output_time(f, w, clock, outputs, state):
                    return at.ALL_OUTPUT_DONE
                end_code = check_partition(f, w, control, clock, out_steps[filled[1] - 1, at.H], at_output, state)
                if end_code != at.CONTINUE:
                    return end_code
                continue
        n_attempts += 1.0
        t = clock[at.T]
        jumps = clock[at.APPLIES_JUMP] == 1.0
        if t == clock[at.JUMP_FROM] and not jumps:
            return at.AT_DISCONTINUITY
        target = outputs[int(clock[at.NEXT_OUTPUT])]
        goal = min(target, clock[at.JUMP_TO] if jumps else clock[at.JUMP_FROM])
        h = control[at.FIXED_STEP] if fixed_size else min(clock[at.H_NEXT], clock[at.H_LIMIT], control[at.MAX_STEP])
        n_grid_steps = 1.0  # number (0 or 1) of grid times T_START + k h (steps of fixed size h) that this step reaches
        if fixed_size:
            size, n_grid_steps, reaches_goal = size_on_grid(clock, t, h, target, goal)
        else:
            size, reaches_goal = size_off_grid(control, t, h, goal - t, jumps)
        shortened = reaches_goal or (h > 0.5 * (goal - t) and not fixed_size)
        at_output = reaches_goal and goal == target
        if reaches_goal:
            size = goal - t
        samples_ahead = control[at.SPACING] > 0.0 and (control[at.BY_TIME] == 1.0 or size > control[at.SPACING])
        if (samples_ahead or t < clock[at.DISCONTINUITY_OF_MOTION] < t + size) and not jumps:
            full_size, last = size, outputs[outputs.size - 1]
            size = limit_to_discontinuity(f, w, tolerances, control, clock, t, full_size, last, state, new_state)
            if size < full_size:
                reaches_goal, at_output, shortened = False, False, True
        if not reaches_goal and size <= max(EQUAL_SPACINGS * np.spacing(abs(t)), control[at.SHORTEST]):
            return at.STEP_TOO_SMALL
        code, error, factor = _attempt_step(
            f, w, options, memory, tolerances, control, clock, t, size, jumps, state, new_state
        )
        if code == NOT_LOADED:
            return at.NEEDS_COMPILATION
        if w.time_is_up == 1.0:  # the time limit has passed, perhaps within this attempt: discard the attempt
            f.commit(f, w, options, memory, tolerances, False)
            return at.PAUSED
        # near a jump of a force, the error estimate may be too small: multiply it by JUMP_RATIO up to the time JUMP_END
        error_factor = control[at.JUMP_RATIO] if t < clock[at.JUMP_END] else 1.0
        accepted = code == DONE and error * error_factor <= 1.0
        if accepted and not reaches_goal and ends_near_singular(f, w, control, clock):
            f.commit(f, w, options, memory, tolerances, False)
            w.n_rejected_error += 1
            if not prepare_projected_repetition(f, w, control, clock, size):
                clock[at.H_NEXT], clock[at.PIVOT_HERE] = 0.5 * size, w.pivot
            continue
        if accepted and not jumps and comes_near_singular(f, w, control, clock, tolerances, t, size, state, new_state):
            f.commit(f, w, options, memory, tolerances, False)
            w.n_rejected_error += 1
            clock[at.FAILURE_CODE] = SINGULAR
            return at.NEAR_SINGULAR
        checks_rates = control[at.MAY_JUMP] == 1.0 and not jumps
        if checks_rates and _must_repeat_at_jump(f, w, tolerances, control, clock, t, size, accepted, state, new_state):
            f.commit(f, w, options, memory, tolerances, False)
            w.n_rejected_error += 1
            clock[at.FAILURE_CODE] = DONE
            continue
        if not jumps:
            f.commit(f, w, options, memory, tolerances, accepted)
        if code != DONE:
            end_code = _handle_failure(f, w, control, clock, t, size, code, t_repeated, state)
            if end_code != at.CONTINUE:
                return end_code
            if fixed_size:
                t_repeated = t
            continue
        if error > SUDDEN_ERROR and not accepted:
            clock[at.JUMP_END] = t + size
        error *= error_factor
        if factor == 0.0:
            factor = step_size_ratio(control, clock, size, error)
        elif error_factor > 1.0 and error > 0.0:  # limit the method's `factor`, which ignores `error_factor`
            factor = min(factor, max(control[FACTOR_MIN], control[SAFETY] * error ** -control[EXPONENT]))
        proposed_size = min(size * factor, clock[at.H_LIMIT])
        if not accepted and factor > 1.0:
            clock[at.H_NEXT] = size if control[at.FIRST_GIVEN] == 1.0 else proposed_size
            continue
        if not accepted:
            end_code = _handle_rejection(f, w, control, clock, t, size, proposed_size, state)
            if end_code != at.CONTINUE:
                return end_code
            continue
        if (
            w.rows_v.size < w.Rate.size
            and check_redundant_rows(f, w, t + size, new_state[:n], new_state[n : 2 * n]) != DONE
        ):
            clock[at.H_FAILED] = size
            return at.ROWS_VIOLATED
        count_step(w, tolerances, control, clock, size, out_steps[filled[1]])
        filled[1] += 1
        record_accepted_step(control, clock, size, error)
        clock[at.N_FIXED] += n_grid_steps
        if reaches_goal:
            clock[at.T] = goal
        else:
            clock[at.T] = clock[at.T_START] + clock[at.N_FIXED] * h if fixed_size else t + size
        if jumps:
            clock[at.JUMP_FROM], clock[at.APPLIES_JUMP] = np.inf, 0.0
        copy(new_state, state)
        if at_output or control[at.STORE_ALL] == 1.0:
            out_t[filled[0]] = clock[at.T]
            copy(state, out_state[filled[0]])
            filled[0] += 1
        # if this step was shortened, for example to end at an output time, the next one may have the intended size, h
        clock[at.H_NEXT] = max(proposed_size, h) if shortened else proposed_size
        clock[at.LIMIT_AGE] += 1.0
        if clock[at.LIMIT_AGE] > control[at.LIMIT_MEMORY]:
            clock[at.H_LIMIT] = control[at.LIMIT_START]
            clock[at.FAILURE_CODE] = DONE  # forget the last failure: it is too old to explain short steps
        if at_output and _pass_output_time(f, w, clock, outputs, state):
            return at.ALL_OUTPUT_DONE
        if fixed_size and not at_output:
            record_pivot_at_output(f, w, clock, state)
        if FIRST_JUDGED_STEP <= w.n_accepted <= control[at.TRIAL_STEPS] and clock[at.H_NEXT] <= tolerances[GAP]:
            clock[at.H_FAILED] = clock[at.H_NEXT]
            return at.SWITCH_METHOD
        if jumps:
            return at.PAUSED
        if control[at.SYMMETRIC] == 0.0:
            end_code = check_partition(f, w, control, clock, size, at_output, state)
            if end_code != at.CONTINUE:
                return end_code
