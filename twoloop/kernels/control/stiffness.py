"""Combine two methods in one run: an explicit one, and an implicit one for stiff parts of the motion.

The largest rate of the motion, rho (1/s), is the larger of two numbers: the square root of the largest eigenvalue of
dF/dq, and the largest eigenvalue of dF/dv, where F(q, v) are the accelerations. From time to time, rho is estimated by
a few power iterations; each costs one evaluation. Let h be the step size. If h rho is well below the stability limit of
the explicit method, the motion is not stiff. Near the limit, either stiffness or accuracy may determine h. Then a trial
begins: the implicit method takes some steps, with its errors multiplied by ten, and stays if it costs less per second.

A trial also begins at smaller h rho in three cases:

- rho is far above the rate at which the motion changes: then a component that decays at the rate rho may limit h;
- vibrations at the rate rho have velocities of at most a few tolerances: steps near the limit excite such vibrations;
- the whole run is expected to cost as much as a thousand trials.

If h rho is far above the limit, a trial begins whatever the run has cost. Otherwise, it waits until the run has cost as
much as a few trials, or is expected to cost as much as ten. Costs are counted in evaluations of the explicit method.
With generated code, an evaluation of the implicit method counts several times. The explicit method is tried again if
h rho is well below the limit, or if a second of motion costs more than it did with the explicit method. After an
unsuccessful trial, the number of estimates before the next trial doubles. `f` is the kit, and `w` the workspace.

Kernels call both methods by their addresses, so that each method is compiled in its own module.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from twoloop.kernels.control.loop_state import (
    DISPLACEMENT,
    ERROR_BEFORE,
    H_BEFORE,
    LEAST_ERROR,
    N_PAST,
    N_RULE,
    initial_direction,
)
from twoloop.kernels.control.step_size import project_and_evaluate, step_size_ratio
from twoloop.kernels.data.common import (
    ATTEMPT,
    COMMIT,
    Attempt,
    Step,
    allowed_error,
    compiled,
    gap_ratio,
    inlined,
    kernel,
    merged,
)
from twoloop.kernels.data.indices import DONE, ESTIMATE, FIXED_ORDER, GAP, MAX_GAP_RATIO, NOT_LOADED, OUTER_DIVERGED
from twoloop.kernels.evaluation.inner_loop import renew_partition
from twoloop.kernels.linalg.dense import copy

# the largest rate is first estimated after FIRST_ESTIMATE evaluations of the equations, later every BETWEEN_ESTIMATES
# evaluations. While the explicit method is active, both numbers are multiplied by options[COST_RATIO]
FIRST_ESTIMATE, BETWEEN_ESTIMATES = 100.0, 600.0
N_POWER_ITERATIONS = 4  # number of power iterations with dF/dq, and largest number with dF/dv (F: accelerations)
NEGLIGIBLE_DAMPING = 1e-3  # power iterations with dF/dv (F: accelerations) end if eigenvalue * step size is below this
ZERO_REPLACEMENT = 1e-3  # replaces zero components of the vector of a power iteration, whose largest component is 1
URGENT_RATIO = 3.0  # a trial is urgent (cost cannot delay it) if step size * largest rate / stability limit > this
# if Jacobians are computed by finite differences (about eight evaluations per coordinate), a trial that is not urgent
# (see URGENT_RATIO) also waits until the run has cost this number of evaluations per independent coordinate
MIN_COST_PER_COORDINATE = 64.0
TRIAL_COST = 300.0  # approximate cost of a trial of the implicit method, in evaluations of the implicit method
MIN_COST_IN_TRIALS = 3.0  # unless urgent (URGENT_RATIO), a trial waits until cost of the run / cost of a trial > this
COUNTED_FRACTION_OF_RUN = 0.3  # when a trial is considered, a run's cost counts as at least this * its expected total
# however small the largest rate is, a first trial begins when the run has cost as much as
# COST_OF_ANY_TRIAL * MIN_COST_IN_TRIALS trials. After k trials, the next one begins at k + 1 times this cost
COST_OF_ANY_TRIAL = 100.0
MIN_RATIO_TO_MOTION = 30.0  # the largest rate is far above `_motion_rate` if it exceeds this times `_motion_rate`
QUIET_FACTOR = 10.0  # vibrations count as small if their velocities are at most this number of tolerances
# a trial may begin because vibrations are small, or because the largest rate is far above `_motion_rate`, but only if
# step size * (largest rate) / (stability limit) exceeds this
MIN_HIDDEN_RATIO = 0.05
DIFFERENCE_STEP = 1e-4  # time step of the finite difference in `_motion_rate`, relative to 1 / (largest rate)
RETURN_BELOW = 0.4  # the explicit method is tried again if step size * (largest rate) / (stability limit) is below this
TRIAL_ERROR_FACTOR = 10.0  # multiplies errors of the implicit method on trial, so that it cannot win by larger errors
MEAN_WEIGHT = 0.8  # after a step: new mean step size = MEAN_WEIGHT * old mean + (1 - MEAN_WEIGHT) * size of the step
N_UNMEASURED_STEPS = 5.0  # number of accepted steps at the beginning of a trial that do not count in its cost
N_MEASURED_STEPS = 10.0  # number of accepted steps over which the cost of the method on trial is measured
MIN_GAIN = 1.2  # a trial succeeds if it divides the cost of a second of motion by at least this factor
N_ESTIMATES_AFTER_SUCCESS = 4.0  # number of estimates of the largest rate from a successful trial to the next trial

# values of memory[PHASE]. EXPLICIT, IMPLICIT: this method is in use. ON_TRIAL: the implicit method is on trial.
# BACK_ON_TRIAL: the explicit method is on trial, after the implicit method was in use
EXPLICIT, ON_TRIAL, IMPLICIT, BACK_ON_TRIAL = range(4)

# `options` begins with N_PAIR options of the pair, at the indices below. N_OF_EACH numbers of each method follow: the
# parameters of step-size control (loop_state.py) and, at REUSE_OF, `Plan.reuse`. The options of both methods come last.
# - LIMIT: stability limit of step size * (largest rate). After N_ESTIMATES estimates above LIMIT, a trial begins
# - MATRIX_COST: cost of a Jacobian, in evaluations of accelerations
# - COST_RATIO: cost of an evaluation by the second (implicit) method, in evaluations by the first (explicit) one
# - SIZE_1: number of options of the first method
LIMIT, N_ESTIMATES, MATRIX_COST, COST_RATIO, SIZE_1, N_PAIR = range(6)
REUSE_OF, N_OF_EACH = N_RULE, N_RULE + 1
N_OPTIONS = N_PAIR + 2 * N_OF_EACH  # index in `options` where the options of the first method begin

# indices of the first N_SCALARS numbers in `memory`. The vectors (n_q each) of the power iterations with dF/dq and
# dF/dv (F: accelerations) follow, then the memories of both methods
(
    PHASE,  # which method is in use or on trial: EXPLICIT, ON_TRIAL, IMPLICIT or BACK_ON_TRIAL
    STEPS,  # number of accepted steps since PHASE, the method in use or on trial, last changed
    MAY_ESTIMATE,  # 1: the largest rate may be estimated, as the last attempted step was accepted; 0: it was rejected
    NEXT_ESTIMATE,  # number of evaluations since the start of the run after which the largest rate is estimated again
    ESTIMATES_TO_WAIT,  # number of estimates of the largest rate that must still follow before the next trial may begin
    WAIT,  # value of ESTIMATES_TO_WAIT at the end of the last trial; each unsuccessful trial doubles it
    T_BEGIN,  # time (s) at which the measurement of the cost per second began; NaN: it begins with the next step
    COST_BEGIN,  # cost of the run up to the time T_BEGIN, in evaluations of the equations
    COST_PER_SECOND,  # cost of a second of motion before the last trial, in evaluations by the explicit method
    RATE,  # last estimate of the largest rate of the motion (1/s)
    FIRST_MEMORY,  # length of the memory of the first method
    H_MEAN,  # weighted mean of the last step sizes (s), see MEAN_WEIGHT
    HISTORY,  # size (s) of the last accepted step
    _HISTORY_ERROR,  # error of the last accepted step, in tolerances; 0: PHASE has changed since that step
    H_TRIED,  # size of the last attempted step (s)
    ERROR_TRIED,  # error of the last attempted step, in tolerances
    N_TRIALS,  # number of trials so far
    # number of estimates of step size * (largest rate) that were above LIMIT. An estimate below LIMIT sets the number
    # to 0 if a trial is cheap, compared with the cost of the run
    N_ABOVE_LIMIT,
    N_SCALARS,
) = range(19)


def switching_options(
    limit: float,
    estimates: int,
    matrix_cost: float,
    ratio: float,
    rules: ArrayLike,
    first: ArrayLike,
    second: ArrayLike,
) -> NDArray[np.float64]:
    """Return the array `options` of a pair of methods, the first one explicit, the second one implicit.

    `limit`, `estimates`, `matrix_cost` and `ratio` are the values of LIMIT, N_ESTIMATES, MATRIX_COST and COST_RATIO.
    `rules` has a row of N_OF_EACH numbers (see LIMIT) for each method. `first` and `second`: the methods' own options.
    """
    first = np.asarray(first)  # numbers or, if one trace serves all values of parameters, `Parameter` objects
    scalars = [limit, float(estimates), matrix_cost, ratio, float(first.size)]
    return np.concatenate([scalars, np.asarray(rules, dtype=np.float64).ravel(), first, np.asarray(second)])


def switching_memory(n_q: int, first: ArrayLike, second: ArrayLike) -> NDArray[np.float64]:
    """Return the initial `memory` of a pair of methods whose initial memories are `first` and `second`."""
    first, second = np.asarray(first), np.asarray(second)
    scalars = np.zeros(N_SCALARS)
    scalars[T_BEGIN], scalars[WAIT], scalars[FIRST_MEMORY] = np.nan, N_ESTIMATES_AFTER_SUCCESS, first.size
    directions = np.tile(initial_direction(n_q), 2)
    return np.concatenate([scalars, directions, first, second])


@merged
def _is_explicit(memory):
    return memory[PHASE] == EXPLICIT or memory[PHASE] == BACK_ON_TRIAL


@inlined
def _history_view(memory):
    return memory[HISTORY : HISTORY + N_PAST]


@inlined
def _method_memories(memory, n):
    begin_second = N_SCALARS + 2 * n + int(memory[FIRST_MEMORY])
    return memory[N_SCALARS + 2 * n : begin_second], memory[begin_second:]


@compiled
def _power_iteration(f, w, t, state, direction, by_v, Q, V, A):
    """Take one power iteration: multiply `direction` (n_q) by dF/dq or, if `by_v` is True, by dF/dv (F: accelerations).

    Only components of independent coordinates are used. Scale the product to a largest |component| of 1. Return the
    factor of growth, an estimate of the largest |eigenvalue|; 0 if F cannot be evaluated. (Q, V, A) is scratch.
    """
    n = Q.size
    q, v, a = state[:n], state[n : 2 * n], state[2 * n : 3 * n]
    columns = w.independent_v if by_v else w.independent
    largest = 1.0
    for m in range(n):
        largest = max(largest, abs(v[m]) if by_v else abs(q[m]))
    displacement = DISPLACEMENT * largest
    copy(q, Q)
    copy(v, V)
    displaced = V if by_v else Q
    for i in columns:
        displaced[i] += displacement * direction[i]
    if project_and_evaluate(f, w, t, Q, V, A) != DONE:
        return 0.0
    largest_change, displacement = 0.0, 0.0
    for i in columns:
        largest_change = max(largest_change, abs(A[i] - a[i]))
        displacement = max(displacement, abs(V[i] - v[i]) if by_v else abs(Q[i] - q[i]))
    if not (largest_change > 0.0 and np.isfinite(largest_change) and displacement > 0.0):
        return 0.0
    for i in columns:
        direction[i] = (A[i] - a[i]) / largest_change
    return largest_change / displacement


@compiled
def _largest_rate(f, w, memory, t, state, new_state):
    """Return rho, the largest rate (1/s) of the motion at `state`, by power iterations; `new_state` is scratch."""
    n = w.Q.size
    by_q, by_v = memory[N_SCALARS : N_SCALARS + n], memory[N_SCALARS + n : N_SCALARS + 2 * n]
    Q, V, A = new_state[:n], new_state[n : 2 * n], new_state[2 * n : 3 * n]
    growth_by_q = growth_by_v = 0.0
    # generated code does not renew the partition: its independent coordinates may hardly move now, so choose others
    is_explicit = memory[PHASE] == EXPLICIT
    if is_explicit and f.is_generated == 1 and renew_partition(f, w, t, state[:n]) != DONE:
        return 0.0
    for _ in range(N_POWER_ITERATIONS):
        growth_by_q = _power_iteration(f, w, t, state, by_q, False, Q, V, A)
    for _ in range(N_POWER_ITERATIONS):
        growth_by_v = _power_iteration(f, w, t, state, by_v, True, Q, V, A)
        if growth_by_v * memory[H_MEAN] < NEGLIGIBLE_DAMPING:
            break
    for m in range(n):  # a zero in the vector by_q or by_v could stay zero, and hide the motion of its coordinate
        if by_q[m] == 0.0:
            by_q[m] = ZERO_REPLACEMENT
        if by_v[m] == 0.0:
            by_v[m] = ZERO_REPLACEMENT
    return max(np.sqrt(growth_by_q), growth_by_v)


@compiled
def _motion_rate(f, w, t, state, rate, Q, V, A):
    """Return the rate (1/s) at which the motion changes: the larger of max|a| / max|v| and max|da/dt| / max|a|.

    Return inf if v or a is zero, or da/dt is unknown. `rate`: largest rate, see DIFFERENCE_STEP. (Q, V, A): scratch.
    """
    n = Q.size
    dt = DIFFERENCE_STEP / rate
    fastest = largest = change = 0.0
    for m in range(n):
        Q[m] = state[m] + dt * state[n + m]
        V[m] = state[n + m] + dt * state[2 * n + m]
    if project_and_evaluate(f, w, t + dt, Q, V, A) != DONE:
        return np.inf
    for i in w.independent_v:
        fastest = max(fastest, abs(state[n + i]))
        largest = max(largest, abs(state[2 * n + i]))
        change = max(change, abs(A[i] - state[2 * n + i]))
    if fastest == 0.0 or largest == 0.0:
        return np.inf
    return max(largest / fastest, change / (dt * largest))


@compiled
def _has_small_vibrations(w, tolerances, state, rate):
    """Return True if vibrations of angular frequency `rate` (1/s) have velocities of at most QUIET_FACTOR tolerances.

    The amplitude of velocities is a / rate, where the amplitude a of accelerations is taken from `state`.
    """
    n = w.Q.size
    for i in w.independent_v:
        v = state[n + i]
        if abs(state[2 * n + i]) > QUIET_FACTOR * rate * allowed_error(tolerances, i, v, v):
            return False
    return True


@compiled
def _cost_of_run(w, options):
    """Return the cost of the run so far in evaluations of the equations; a Jacobian costs options[MATRIX_COST]."""
    return w.n_evaluations + options[MATRIX_COST] * w.n_jacobians


@compiled
def _cost_per_second(w, options, memory, t):
    """Return the cost of a second of motion since T_BEGIN, in evaluations of the first method; t: present time."""
    cost_per_second = (_cost_of_run(w, options) - memory[COST_BEGIN]) / (t - memory[T_BEGIN])
    return cost_per_second if _is_explicit(memory) else options[COST_RATIO] * cost_per_second


@compiled
def _evaluations_between_estimates(options, memory):
    return BETWEEN_ESTIMATES * options[COST_RATIO] if _is_explicit(memory) else BETWEEN_ESTIMATES


@compiled
def _begin_phase(w, options, memory, phase, t):
    """Update `memory` for a `phase` that begins at t: set the error of the last step to 0, begin to measure costs."""
    memory[PHASE] = phase
    memory[STEPS] = 0.0
    memory[HISTORY + ERROR_BEFORE] = 0.0
    memory[T_BEGIN], memory[COST_BEGIN] = t, _cost_of_run(w, options)
    memory[NEXT_ESTIMATE] = w.n_evaluations + _evaluations_between_estimates(options, memory)


@compiled
def _judge_trial(w, options, memory, t):
    """Compare costs at the end of a trial; return the next phase, EXPLICIT or IMPLICIT; -1: the trial continues."""
    if memory[STEPS] == N_UNMEASURED_STEPS:
        memory[T_BEGIN], memory[COST_BEGIN] = t, _cost_of_run(w, options)
    if memory[STEPS] < N_UNMEASURED_STEPS + N_MEASURED_STEPS:
        return -1
    cost_per_second = _cost_per_second(w, options, memory, t)
    is_kept = cost_per_second * MIN_GAIN <= memory[COST_PER_SECOND]
    memory[WAIT] = N_ESTIMATES_AFTER_SUCCESS if is_kept else 2.0 * memory[WAIT]
    memory[ESTIMATES_TO_WAIT] = memory[WAIT]
    if memory[PHASE] == ON_TRIAL:
        return IMPLICIT if is_kept else EXPLICIT
    return EXPLICIT if is_kept else IMPLICIT


@compiled
def _phase_to_begin(f, w, options, memory, tolerances, t, state, new_state):
    """Estimate the motion's largest rate; return ON_TRIAL or BACK_ON_TRIAL if this trial must begin now, else -1."""
    n = w.Q.size
    memory[RATE] = _largest_rate(f, w, memory, t, state, new_state)
    cost_per_second, cost = _cost_per_second(w, options, memory, t), _cost_of_run(w, options)
    memory[T_BEGIN], memory[COST_BEGIN] = t, cost
    memory[NEXT_ESTIMATE] = w.n_evaluations + _evaluations_between_estimates(options, memory)
    memory[ESTIMATES_TO_WAIT] -= 1.0
    h_rho = memory[H_MEAN] * memory[RATE] / options[LIMIT]  # step size * (largest rate) / stability limit
    if h_rho > 1.0:
        memory[N_ABOVE_LIMIT] += 1.0
    if memory[ESTIMATES_TO_WAIT] > 0.0:
        return -1
    # `counted` is the cost of the run so far or, if larger, a fraction of the expected cost of the whole run. If a
    # trial is not cheap compared with `counted`, it begins only if it is urgent, that is, if h_rho > URGENT_RATIO
    counted, min_cost = cost, MIN_COST_IN_TRIALS * TRIAL_COST * options[COST_RATIO]
    if np.isfinite(tolerances[GAP]):
        counted = max(counted, COUNTED_FRACTION_OF_RUN * tolerances[GAP] / MAX_GAP_RATIO * cost_per_second)
    is_cheap = counted > min_cost and (
        f.force_by_q_given == 1 or counted > MIN_COST_PER_COORDINATE * w.independent.size
    )
    is_hidden = False
    if memory[PHASE] == EXPLICIT and is_cheap and h_rho > MIN_HIDDEN_RATIO:
        Q, V, A = new_state[:n], new_state[n : 2 * n], new_state[2 * n : 3 * n]
        is_hidden = _has_small_vibrations(w, tolerances, state, memory[RATE])
        if not is_hidden:
            is_hidden = memory[RATE] > MIN_RATIO_TO_MOTION * _motion_rate(f, w, t, state, memory[RATE], Q, V, A)
    # if a run is costly, a trial begins even if the largest rate is small: friction is stiff only while it reverses,
    # and all estimates may fall outside these short times. As first steps are short, `counted` may be too large early
    # in a run; therefore cost > min_cost is also required
    is_costly = is_cheap and cost > min_cost and counted > COST_OF_ANY_TRIAL * min_cost * (1.0 + memory[N_TRIALS])
    is_due = (
        h_rho > URGENT_RATIO or is_hidden or is_costly or (memory[N_ABOVE_LIMIT] >= options[N_ESTIMATES] and is_cheap)
    )
    if is_cheap and h_rho <= 1.0:  # as long as a trial is not cheap, keep N_ABOVE_LIMIT, which may start a trial later
        memory[N_ABOVE_LIMIT] = 0.0
    is_expensive = cost_per_second > MIN_GAIN * memory[COST_PER_SECOND]  # compared with the explicit method
    if (memory[PHASE] == EXPLICIT and is_due) or (memory[PHASE] == IMPLICIT and (h_rho < RETURN_BELOW or is_expensive)):
        memory[COST_PER_SECOND] = cost_per_second
        memory[N_TRIALS] += 1.0
        return ON_TRIAL if memory[PHASE] == EXPLICIT else BACK_ON_TRIAL
    return -1


@kernel(COMMIT)
def commit_switching(f, w, options, memory, tolerances, accepted):
    """Let the active method save (if `accepted`) or discard the data of its attempted step; count accepted steps."""
    first, second = _method_memories(memory, w.Q.size)
    begin = N_OPTIONS + int(options[SIZE_1])
    memory[MAY_ESTIMATE] = 0.0
    if _is_explicit(memory):
        f.commit_first(f, w, options[N_OPTIONS:begin], first, tolerances, accepted)
    else:
        f.commit_second(f, w, options[begin:], second, tolerances, accepted)
    if accepted:
        memory[STEPS] += 1.0
        memory[MAY_ESTIMATE] = 1.0
        history = _history_view(memory)
        history[H_BEFORE], history[ERROR_BEFORE] = memory[H_TRIED], memory[ERROR_TRIED]


@kernel(ATTEMPT)
def switching_step(f, w, options, memory, t, h, tolerances, state, new_state):
    """Begin or end a trial of the other method if that is due; then attempt a step by the active method.

    A trial begins or ends only after accepted steps, and never with steps of fixed size. The memory of a method is set
    to zero when the method becomes active. Each method has its own parameters of step-size control.
    """
    n = w.Q.size
    first, second = _method_memories(memory, n)
    if np.isnan(memory[T_BEGIN]):  # this is the first step of a run, or the first after a singular position
        memory[T_BEGIN], memory[COST_BEGIN] = t, _cost_of_run(w, options)
        memory[NEXT_ESTIMATE] = w.n_evaluations + FIRST_ESTIMATE * options[COST_RATIO]
    if memory[MAY_ESTIMATE] == 1.0 and tolerances[ESTIMATE] == 1.0:
        phase = -1  # new value of memory[PHASE]; -1: the value remains
        if memory[PHASE] == ON_TRIAL or memory[PHASE] == BACK_ON_TRIAL:
            phase = _judge_trial(w, options, memory, t)
        elif w.n_evaluations >= memory[NEXT_ESTIMATE]:
            phase = _phase_to_begin(f, w, options, memory, tolerances, t, state, new_state)
        if phase >= 0:
            was_explicit = _is_explicit(memory)
            _begin_phase(w, options, memory, phase, t)
            if was_explicit != _is_explicit(memory):
                started = second if was_explicit else first
                started[:] = 0.0
    is_explicit = _is_explicit(memory)
    w.explicit_step = 1.0 if is_explicit else 0.0
    begin = N_OPTIONS + int(options[SIZE_1])
    rule = options[N_PAIR : N_PAIR + N_OF_EACH] if is_explicit else options[N_PAIR + N_OF_EACH : N_OPTIONS]
    w.reuse = max(rule[REUSE_OF], w.rounded)
    if is_explicit:
        code, error, factor = f.attempt_first(f, w, options[N_OPTIONS:begin], first, t, h, tolerances, state, new_state)
        # a step of fixed size that does not converge cannot be shortened: repeat this step with the implicit method
        if code == OUTER_DIVERGED and tolerances[ESTIMATE] == 0.0 and f.form != FIXED_ORDER:
            _begin_phase(w, options, memory, IMPLICIT, t)
            second[:] = 0.0
            w.explicit_step = 0.0
            code, error, factor = f.attempt_second(f, w, options[begin:], second, t, h, tolerances, state, new_state)
    else:
        # reject steps that exceed tolerances[GAP], the longest allowed time between evaluations of the equations
        ratio = gap_ratio(tolerances, h)
        if ratio > 0.0:
            return Attempt(DONE, ratio, 1.0 / ratio)
        code, error, factor = f.attempt_second(f, w, options[begin:], second, t, h, tolerances, state, new_state)
    if code == NOT_LOADED:
        return Attempt(code, error, 0.0)
    memory[H_MEAN] = MEAN_WEIGHT * memory[H_MEAN] + (1.0 - MEAN_WEIGHT) * h
    if code != DONE or not np.isfinite(error):
        return Attempt(code, error, 0.0)
    if memory[PHASE] == ON_TRIAL:
        error *= TRIAL_ERROR_FACTOR
    memory[H_TRIED], memory[ERROR_TRIED] = h, max(error, rule[LEAST_ERROR])
    if factor == 0.0:
        factor = step_size_ratio(rule, _history_view(memory), h, error)
    if not is_explicit:
        factor = min(factor, max(tolerances[GAP] / h, 1.0))
    return Attempt(DONE, error, factor)


SWITCHING = Step(switching_step, commit_switching)
