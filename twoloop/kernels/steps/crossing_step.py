"""Step across a singular position, where C_q loses rank, such as a parallelogram with its bars in line.

Near such a position no partition determines the dependent coordinates well. Although the motion is smooth, outer loops
on independent coordinates do not converge there, nor do iterations whose stages violate the constraints. This step is a
collocation at Gauss nodes whose stages are projected onto the constraints. Then the accelerations are those of the
motion, and the fixed-point iteration converges as it does elsewhere.

- If the smallest pivot of C_q is s times the largest of the run, rounding errors are eps/s in positions, eps/s^2 in
  velocities and eps/s^3 in accelerations (eps: machine epsilon). Nodes with too large rounding errors are left out:
  their accelerations are interpolated from nodes on both sides, because the motion through the position is analytic.
- The result depends on q and v at the beginning only: the accelerations there may consist of rounding errors.
- The end of the step is projected onto the constraints by corrections of least energy, then with a partition chosen
  there.
- The generated code of the mechanism projects the stages. If there is no generated code, or if its pivots are too
  small, the general code projects them, with a partition chosen at the stage.
- The step is rejected if the projection changes a stage by more than two tolerances: the stage is on another branch of
  the motion, or the polynomial is inaccurate.
"""

import numpy as np

from twoloop.kernels.control.singular_positions import EPS, MAX_NEAR_RATIO, MIN_NEAR_RATIO, near_pivot_ratio
from twoloop.kernels.control.step_size import commit_nothing, store_prediction
from twoloop.kernels.data.common import ATTEMPT, Attempt, Step, allowed_error, compiled, kernel, merged
from twoloop.kernels.data.indices import ATOL, DONE, ESTIMATE, GAP, OUTER_DIVERGED, RTOL, SINGULAR
from twoloop.kernels.evaluation.inner_loop import evaluate_state, project, renew_partition
from twoloop.kernels.linalg.dense import copy, sum_rows
from twoloop.kernels.steps.stages import lagrange_values

# indices in `options`: tolerances of the inner loop and of projections. The Gauss tableau follows: first A, A @ A and
# weights that yield Legendre coefficients (S, S each); then b, b @ A and c (S each)
INNER_TOL, THETA, N_SCALARS = range(3)
S = 20  # number of Gauss nodes, which are the stages
CONVERGED_CHANGE = 0.01  # the iteration has converged if a sweep changes accelerations by at most this (in tolerances)
# the iteration has also converged if a sweep changes accelerations by at most STALL_CHANGE tolerances, and by at least
# STALL_RATIO times the change by the sweep before: rounding errors then keep the change from decreasing. A change that
# increases is certainly noise. It may reach MAX_NOISE, because the end of the step averages the noise over all nodes
STALL_RATIO, STALL_CHANGE, MAX_NOISE = 0.5, 0.3, 2.0
# a step of fixed size fails if its last sweep changes velocities by more than this times ROUNDING, relative to 1 + |v|
MAX_FIXED_CHANGE = 1e11
MAX_SWEEPS, FEW_SWEEPS = 40, 12  # a step fails after MAX_SWEEPS; after FEW_SWEEPS, it leaves out more nodes than before
DISTANCE_FACTOR = 2.0  # after FEW_SWEEPS sweeps, the pivot below which nodes are left out is multiplied by this
MAX_LEFT_OUT_NODES = 9  # a step fails if more nodes than this are left out
# indices of the scalars at the end of `memory`. LARGEST_PIVOT to NODE_DISTANCE store arguments of `begin_polynomial`,
# and BASE the time (s) of its argument `base`. An attempt succeeds if its error, in tolerances, is at most MAX_ERROR;
# ERROR stores the error (inf: the iteration did not converge). BEGIN, DURATION and END: beginning, duration and end (s)
# of the polynomial that the last successful attempt computed; if there is none, END contains -inf
LARGEST_PIVOT, EARLIEST, MAY_APPROACH, NODE_DISTANCE, BASE, MAX_ERROR, ERROR, BEGIN, DURATION, END, N_STORED = range(11)
SHORTEST_PIECE, LONGEST_PIECE = 0.05, 0.2  # limits of (size of a piece) / (duration of polynomial), see `piece_ends`
NODE_GAP = 0.0767  # longest time between two successive nodes, relative to the duration of the polynomial
BACKWARD_FRACTION = 0.4  # largest fraction of a polynomial's duration that may lie before the step
ORDER, ERROR_FACTOR = 12.0, 0.5  # the error estimate has the factor ERROR_FACTOR, and is about proportional to h^ORDER
PROJECTION_WEIGHT = 0.5  # if a projection changes a stage by x tolerances, the error estimate is at least this times x
ROUNDING = 1e-13  # relative tolerance of the iteration in steps of fixed size, and of comparisons of times
MIN_PIVOT_RATIO = 0.5  # a step fails if the pivot at its end is below this * pivot at its start or `base`; see FAR_END
END_MARGIN = 2.0  # if MAY_APPROACH is 0, the end's pivot must be at least this * least pivot of nodes; see FAR_END
FAR_END = 0.3  # the pivot at the end of a step is large enough if it is at least this * largest pivot of the run so far
LATE = S - 4  # node near a polynomial's end: if its pivot exceeds the end's, the singular position lies beyond the end
# an attempt that computes a polynomial returns this as error and as step-size factor. So the step is repeated; it then
# follows the polynomial
REPEAT_FACTOR = 2.0
# a polynomial from an earlier state must reach the present one within MAX_DEVIATION tolerances, or within the error
# that rounding may have caused in velocities, ROUNDING_FACTOR * EPS / (ratio of pivots)^2
MAX_DEVIATION, ROUNDING_FACTOR = 1e3, 1e5
TINY = 1e-300  # lower bound of divisors that may be zero


def options_array(A, b, c, inner_tol, theta):
    """Return the array `options` of `crossing_step` for the Gauss tableau A, b, c of S stages."""
    degrees = np.arange(S)
    legendre = np.polynomial.legendre.legvander(2.0 * c - 1.0, S - 1).T * b * (2 * degrees + 1)[:, None]
    return np.concatenate([[inner_tol, theta], *map(np.ravel, [A, A @ A, legendre, b, b @ A, c])])


def memory_size(n):
    """Return the length of the array `memory` for n coordinates."""
    return (S + 7) * n + 3 * S + N_STORED


def begin_polynomial(memory, largest_pivot, earliest, may_approach, node_distance=1.0, base=None, max_error=1.0):
    """Discard the polynomial in `memory`, and store the conditions that the next one must satisfy.

    `largest_pivot` is the largest pivot of the run so far; no node may lie before the time `earliest` (s). If
    `may_approach`, the polynomial need not cross the singular position, but may end before it. The pivot below which
    nodes are left out is multiplied by `node_distance`. The polynomial goes through `base`, the time (s) and state
    [q, v, ...] of an earlier step; if `base` is None, it goes through the state at the beginning of the step. Its error
    must be at most `max_error` tolerances.
    """
    stored = memory[-N_STORED:]
    stored[:] = np.nan
    stored[LARGEST_PIVOT], stored[EARLIEST], stored[MAY_APPROACH] = largest_pivot, earliest, may_approach
    stored[NODE_DISTANCE], stored[MAX_ERROR], stored[END] = node_distance, max_error, -np.inf
    if base is not None:
        n = (memory.size - 3 * S - N_STORED) // (S + 7)
        stored[BASE], memory[(S + 5) * n : (S + 7) * n] = base[0], base[1][: 2 * n]


def piece_ends(memory, c, t):
    """Divide the polynomial in `memory`, from t on, into steps ("pieces"); return the times (s) at which they end.

    Pieces end at the end of the polynomial, at evaluated nodes next to a node that is left out, and at the first
    evaluated node where the piece is longer than LONGEST_PIECE. No piece is shorter than SHORTEST_PIECE.
    """
    stored = memory[-N_STORED:]
    left_out = memory[-N_STORED - 3 * S : -N_STORED - 2 * S] < 0.0
    least, ends = (t - stored[BEGIN]) / stored[DURATION], []
    for j in range(1, S - 1):
        length = c[j] - (ends[-1] if ends else least)
        may_end = left_out[j - 1] or left_out[j + 1] or length > LONGEST_PIECE
        if not left_out[j] and may_end and length > SHORTEST_PIECE and 1.0 - c[j] > SHORTEST_PIECE:
            ends.append(c[j])
    return [float(stored[BEGIN] + end * stored[DURATION]) for end in ends] + [float(stored[END])]


@compiled
def _velocity_weight(tolerances, m, n, h, state):
    """Return the reciprocal of the allowed error of velocity number m in a step of size h from `state`."""
    q, v = abs(state[m]), abs(state[n + m])
    if tolerances[ESTIMATE] == 0.0:
        return 1.0 / (ROUNDING * (1.0 + v))
    atol, rtol = tolerances[ATOL + m], tolerances[RTOL]
    allowed_v = atol + rtol * max(v, 0.5 * h * abs(state[2 * n + m]))
    return 1.0 / max(min(allowed_v, (atol + rtol * max(q, 0.5 * h * v)) / h), TINY)


@compiled
def _estimate_error(tolerances, h, state, legendre, a, n_kept):
    """Return an estimate of the error of a step, in tolerances, by the last Legendre coefficients of accelerations.

    Row k of `legendre` gives coefficient k of the accelerations a (S, n). The formula is that of collocation_code.py.
    `n_kept`: number of nodes that are not left out; coefficients of degree `n_kept` or higher are rounding errors.
    """
    n, largest = a.shape[1], 0.0
    for m in range(n):
        early_max = middle_max = late_max = 0.0
        for k in range(2, n_kept):
            value = 0.0
            for j in range(S):
                value += legendre[k, j] * a[j, m]
            if k < n_kept - 4:
                early_max = max(early_max, abs(value))
            elif k < n_kept - 2:
                middle_max = max(middle_max, abs(value))
            else:
                late_max = max(late_max, abs(value))
        middle_max = max(middle_max, late_max, TINY)
        decay, distant_decay = late_max / middle_max, late_max / max(early_max, middle_max)
        if n_kept == S:
            decay *= np.sqrt(decay)
        largest = max(largest, late_max * max(decay, distant_decay) * h * _velocity_weight(tolerances, m, n, h, state))
    return ERROR_FACTOR * largest


@merged
def _integrate_polynomial(h, c, A, AA, a, q, v, q_end, v_end):
    """Set q_end and v_end to the state at the time c h after the beginning of the polynomial of duration h.

    (q, v): state at the beginning; A, AA (S): weights of the accelerations a (S, n) in their first and second integral.
    """
    sum_rows(A, a, v_end)
    sum_rows(AA, a, q_end)
    for m in range(q.size):
        q_end[m] = q[m] + h * (c * v[m] + h * q_end[m])
        v_end[m] = v[m] + h * v_end[m]


@compiled
def _widest_gap(c, c0, kept):
    """Return the widest gap between evaluated nodes (kept[k] >= 0) in [c0, 1], the step's part of the polynomial."""
    widest, before = 0.0, c0
    for k in range(S):
        if kept[k] >= 0.0 and c[k] > c0:
            widest, before = max(widest, c[k] - before), c[k]
    return max(widest, 1.0 - before)


@merged
def _choose_partition_at_end(
    f, w, t, h, stored, min_pivot, min_node_pivot, tables, a, q_0, v_0, q_late, v_late, q1, v1
):
    """Set (q1, v1) to the end (at time t) of the polynomial of duration h; choose the partition there; return a code.

    The code is SINGULAR if the pivot at the end is below both `min_pivot` and FAR_END * largest pivot of the run: the
    end is too near the singular position, or before it. If MAY_APPROACH is 0, `min_pivot` is raised to at least the
    pivot at the node LATE, and at least END_MARGIN * `min_node_pivot`, the pivot below which nodes are left out.
    """
    A, AA, b, bA, c = tables
    if stored[MAY_APPROACH] == 0.0:
        _integrate_polynomial(h, c[LATE], A[LATE], AA[LATE], a, q_0, v_0, q_late, v_late)
        if renew_partition(f, w, t - (1.0 - c[LATE]) * h, q_late) == DONE:
            min_pivot = max(min_pivot, w.pivot, END_MARGIN * min_node_pivot)
    _integrate_polynomial(h, 1.0, b, bA, a, q_0, v_0, q1, v1)
    code = renew_partition(f, w, t, q1)
    return SINGULAR if code == DONE and w.pivot < min(min_pivot, FAR_END * stored[LARGEST_PIVOT]) else code


@compiled
def _fill_integral_weights(b, c, c0, weights_v, weights_q):
    """Store weights (S) that yield a polynomial's integral and double integral (0 to c0) from its values at nodes c."""
    weights_v[:] = 0.0
    weights_q[:] = 0.0
    for i in range(S):
        for j in range(S):
            value = c0 * b[i]
            for k in range(S):
                if k != j:
                    value *= (c0 * c[i] - c[k]) / (c[j] - c[k])
            weights_v[j] += value
            weights_q[j] += value * c0 * (1.0 - c[i])


@merged
def _set_beginning_state(h, c0, weights_v, weights_q, a, q, v, q_0, v_0):
    """Set (q_0, v_0) to the first state of a polynomial of duration h; (q, v): its state at the time c0 h."""
    sum_rows(weights_v, a, v_0)
    sum_rows(weights_q, a, q_0)
    for m in range(q.size):
        v_0[m] = v[m] - h * v_0[m]
        q_0[m] = q[m] - h * (c0 * v_0[m] + h * q_0[m])


@compiled
def _interpolate(x, c, nodes, a, value):
    """Store in `value` the value at time x of the polynomial through a[k] at time c[k], for all k >= 0 in `nodes`."""
    value[:] = 0.0
    for node in nodes:
        if node >= 0:
            k, weight = int(node), 1.0
            for other in nodes:
                if other >= 0 and other != node:
                    weight *= (x - c[int(other)]) / (c[k] - c[int(other)])
            for m in range(value.size):
                value[m] += weight * a[k, m]


@compiled
def _polynomial_at(time, duration, b, c, a, q_0, v_0, weights_v, weights_q, q, v, acceleration):
    """Set q, v and `acceleration` (n each) to the motion along the polynomial `time` seconds after its beginning."""
    fraction = time / duration
    _fill_integral_weights(b, c, fraction, weights_v, weights_q)
    sum_rows(weights_v, a, v)
    sum_rows(weights_q, a, q)
    for m in range(q.size):
        q[m] = q_0[m] + duration * (fraction * v_0[m] + duration * q[m])
        v[m] = v_0[m] + duration * v[m]
    _interpolate(fraction, c, range(S), a, acceleration)


@merged
def _deviates(tolerances, pivot_ratio, q, v, q_reached, v_reached):
    """Return True if a polynomial misses the present state (q, v), as short forces act before it, between its nodes.

    (q_reached, v_reached): state on the polynomial.
    """
    fastest = 0.0
    for m in range(v.size):
        fastest = max(fastest, abs(v[m]))
    rounding = ROUNDING_FACTOR * EPS / (pivot_ratio * pivot_ratio) * fastest
    for m in range(v.size):
        atol, rtol = tolerances[ATOL + m], tolerances[RTOL]
        if not abs(v_reached[m] - v[m]) <= max(rounding, MAX_DEVIATION * (atol + rtol * abs(v[m]))):
            return True
        if not abs(q_reached[m] - q[m]) <= max(rounding, MAX_DEVIATION * (atol + rtol * abs(q[m]))):
            return True
    return False


@merged
def _finish_piece(f, w, t, min_node_pivot, options, tolerances, stage, state, new_state):
    """Finish a step: project its end `stage` = [q, v, a], store it in `new_state`, and return an Attempt.

    If the smallest pivot is below `min_node_pivot`, or the projection fails, store the state without projection. If
    `min_node_pivot` is 0, always project the state, and return the code of a projection that fails.
    """
    n = w.Q.size
    q, q1, v1 = state[:n], new_state[:n], new_state[n : 2 * n]
    a1, lam1 = new_state[2 * n : 3 * n], new_state[3 * n :]
    copy(stage[0], q1)
    copy(stage[1], v1)
    code = renew_partition(f, w, t, q1)
    is_determined = code == DONE and w.pivot >= min_node_pivot
    if code == DONE:
        store_prediction(w, q1)
        w.orientation_new = w.orientation
        # polynomials conserve energy well, but leave the constraints along weak directions. Corrections of least energy
        # keep this energy; corrections of dependent coordinates alone would change it by the amount of the violation
        code = project(f, w, t, q1, v1, options[THETA], a1, lam1)
    if code == DONE:
        code = evaluate_state(f, w, t, q1, v1, options[INNER_TOL], a1, lam1)
    if min_node_pivot > 0.0 and not (is_determined and code == DONE):
        if code != DONE:
            copy(state[3 * n :], lam1)
        copy(stage[0], q1)
        copy(stage[1], v1)
        copy(stage[2], a1)
        return Attempt(DONE, 0.0, 0.0)
    error = 0.0
    for k in range(w.dependent.size):
        m = w.dependent[k]
        scale = allowed_error(tolerances, m, q[m], q1[m])
        error = max(error, abs(w.predicted[k] - q1[m]) / scale * tolerances[ESTIMATE])
    return Attempt(code, error, 0.0)


def state_at(memory, options, t):
    """Return the state [q, v, a] (3 n) on the polynomial in `memory` at the time t (s)."""
    stored, n = memory[-N_STORED:], (memory.size - 3 * S - N_STORED) // (S + 7)
    b, _, c = options[N_SCALARS + 3 * S * S :].reshape((3, S))
    a, stage = memory[: S * n].reshape((S, n)), memory[S * n : (S + 5) * n].reshape((5, n))
    fraction, duration, (q_0, v_0) = (t - stored[BEGIN]) / stored[DURATION], stored[DURATION], stage[3:]
    # row k: values of the Lagrange polynomials at Gauss node k of the time from stored[BEGIN] to t; last row: at t
    weights = lagrange_values(c, fraction * np.append(c, 1.0))
    weights_v = fraction * b @ weights[:-1]
    weights_q = fraction**2 * (b * (1.0 - c)) @ weights[:-1]
    q, v = q_0 + duration * (fraction * v_0 + duration * (weights_q @ a)), v_0 + duration * (weights_v @ a)
    return np.concatenate([q, v, weights[-1] @ a])


@kernel(ATTEMPT)
def crossing_step(f, w, options, memory, t, h, tolerances, state, new_state):
    """Attempt a step along the polynomial in `memory`; if the step ends beyond this polynomial, compute a new one."""
    n = w.Q.size
    q, v, q1, v1 = state[:n], state[n : 2 * n], new_state[:n], new_state[n : 2 * n]
    A, AA, legendre = options[N_SCALARS : N_SCALARS + 3 * S * S].reshape((3, S, S))
    b, bA, c = options[N_SCALARS + 3 * S * S :].reshape((3, S))
    a, stage, offset = memory[: S * n].reshape((S, n)), memory[S * n : (S + 5) * n].reshape((5, n)), (S + 7) * n
    q_stage, v_stage, a_stage, q_0, v_0 = stage[0], stage[1], stage[2], stage[3], stage[4]
    kept, weights_v, weights_q = memory[offset : offset + 3 * S].reshape((3, S))  # kept[j] = j; -1: node j is left out
    stored = memory[offset + 3 * S :]
    largest_pivot, earliest, time_of_base = stored[LARGEST_PIVOT], stored[EARLIEST], stored[BASE]
    is_estimated, uses_generated_code = tolerances[ESTIMATE] == 1.0, f.is_generated == 1
    min_node_pivot, duration, t_base = MIN_NEAR_RATIO, h, t
    q_base, v_base = memory[(S + 5) * n : (S + 6) * n], memory[(S + 6) * n : (S + 7) * n]
    if is_estimated:
        min_node_pivot = stored[NODE_DISTANCE] * near_pivot_ratio(tolerances)
    if t + h <= stored[END] + ROUNDING * stored[DURATION] + 4.0 * np.spacing(abs(t)):
        begin, duration = stored[BEGIN], stored[DURATION]
        _polynomial_at(t + h - begin, duration, b, c, a, q_0, v_0, weights_v, weights_q, q_stage, v_stage, a_stage)
        return _finish_piece(f, w, t + h, min_node_pivot * largest_pivot, options, tolerances, stage, state, new_state)
    stored[ERROR], stored[END] = np.inf, -np.inf
    if time_of_base <= t:
        duration, t_base = t + h - time_of_base, time_of_base
    else:
        copy(q, q_base)
        copy(v, v_base)
        if is_estimated:
            duration = h + max(0.0, min(h * BACKWARD_FRACTION / (1.0 - BACKWARD_FRACTION), t - earliest))
    begin, c0 = t + h - duration, (duration - h) / duration
    c_base = c0 if t_base == t else 0.0  # (time from the polynomial's beginning to `base`) / (polynomial's duration)
    _fill_integral_weights(b, c, c_base, weights_v, weights_q)
    n_before_base = 0  # number of nodes before the state `base`
    while n_before_base < S and c[n_before_base] < c_base:
        n_before_base += 1
    w.n_outer += 1
    code = renew_partition(f, w, t_base, q_base)
    pivot = w.pivot if code == DONE else 0.0
    tables, states = (A, AA, b, bA, c), (q_0, v_0, q_stage, v_stage, q1, v1)
    for j in range(S):
        copy(state[2 * n : 3 * n], a[j])
        kept[j] = j
    previous_change, has_converged, largest_move, n_kept = np.inf, False, 0.0, S
    last_0, last_1, last_2 = -1, -1, -1  # the last evaluated nodes, from which the first sweep extrapolates; -1: none
    for sweep in range(MAX_SWEEPS):
        change, largest_move = 0.0, 0.0
        chooses_nodes = sweep in (0, 2, FEW_SWEEPS)  # True: this sweep chooses anew which nodes are left out
        if chooses_nodes:
            n_kept = S
        if is_estimated and chooses_nodes and sweep == FEW_SWEEPS:
            min_node_pivot = min(DISTANCE_FACTOR * min_node_pivot, MAX_NEAR_RATIO)
        for i in range(S):
            # order of nodes: from the state `base` backwards in time, then from `base` forwards
            j = n_before_base - 1 - i if i < n_before_base else i
            if sweep == 0:
                if i == n_before_base:
                    last_0, last_1, last_2 = -1, -1, -1
                    for k in range(n_before_base):
                        if kept[k] >= 0.0:
                            last_0, last_1, last_2 = k, last_0, last_1
                if last_0 >= 0:
                    for k in range(S):
                        if k >= j if i >= n_before_base else k <= j or k >= n_before_base:
                            _interpolate(c[k], c, (last_0, last_1, last_2), a, a[k])
            time = begin + c[j] * duration
            _set_beginning_state(duration, c_base, weights_v, weights_q, a, q_base, v_base, q_0, v_0)
            _integrate_polynomial(duration, c[j], A[j], AA[j], a, q_0, v_0, q_stage, v_stage)
            code = DONE
            renews_partition = not uses_generated_code or chooses_nodes
            if chooses_nodes:
                code = renew_partition(f, w, time, q_stage)
                kept[j] = j
                if code == DONE:  # a run that began near a singular position may have its largest pivot at this stage
                    stored[LARGEST_PIVOT] = largest_pivot = max(largest_pivot, w.pivot)
                if is_estimated and (code != DONE or w.pivot < min_node_pivot * largest_pivot):
                    kept[j], n_kept, code = -1.0, n_kept - 1, DONE
            elif renews_partition and kept[j] >= 0.0:
                code = renew_partition(f, w, time, q_stage)
            if kept[j] < 0.0:
                if not chooses_nodes:
                    _interpolate(c[j], c, kept, a, a[j])
                continue
            while True:
                if code == DONE:
                    code = project(f, w, time, q_stage, v_stage, options[THETA], a_stage, w.lam)
                if renews_partition or w.used_general == 0.0:
                    break
                # pivots of the generated code were too small, and the general code used the partition of another
                # stage: repeat the projection with a partition chosen at this stage
                renews_partition, uses_generated_code = True, False
                _integrate_polynomial(duration, c[j], A[j], AA[j], a, q_0, v_0, q_stage, v_stage)
                code = renew_partition(f, w, time, q_stage)
            if code != DONE:
                return Attempt(code, np.inf, 0.0)
            _integrate_polynomial(duration, c[j], A[j], AA[j], a, q_0, v_0, q1, v1)
            for m in range(n):
                weight = _velocity_weight(tolerances, m, n, h, state)
                change = max(change, h * abs(a_stage[m] - a[j, m]) * weight)
                largest_move = max(largest_move, abs(v1[m] - v_stage[m]) * weight, abs(q1[m] - q_stage[m]) / h * weight)
            copy(a_stage, a[j])
            last_0, last_1, last_2 = j, last_0, last_1
        if not np.isfinite(change):
            return Attempt(OUTER_DIVERGED, np.inf, 0.0)
        if chooses_nodes:
            if n_kept < S - MAX_LEFT_OUT_NODES:
                return Attempt(SINGULAR, np.inf, 0.0)
            if is_estimated and _widest_gap(c, c0, kept) * duration > tolerances[GAP] * (1.0 + ROUNDING):
                return Attempt(OUTER_DIVERGED, np.inf, 0.0)
            for j in range(S):
                if kept[j] < 0.0:
                    _interpolate(c[j], c, kept, a, a[j])
        else:
            may_stall = STALL_CHANGE if change < previous_change else MAX_NOISE
            has_stalled = sweep > 3 and STALL_RATIO * previous_change <= change <= may_stall
            if change <= CONVERGED_CHANGE or has_stalled:
                has_converged = True
                break
        _set_beginning_state(duration, c_base, weights_v, weights_q, a, q_base, v_base, q_0, v_0)
        # already after two sweeps, test the pivot at the end: q is accurate enough, and this test finds most failures
        if sweep == 1 and is_estimated:
            min_pivots = MIN_PIVOT_RATIO * pivot, min_node_pivot * largest_pivot
            code = _choose_partition_at_end(f, w, t + h, duration, stored, *min_pivots, tables, a, *states)
            if code != DONE:
                return Attempt(code, np.inf, 0.0)
        previous_change = change
    if not (has_converged if is_estimated else max(change, largest_move) <= MAX_FIXED_CHANGE):
        return Attempt(OUTER_DIVERGED, np.inf, 0.0)
    error = 0.0
    if is_estimated:
        error = max(_estimate_error(tolerances, h, state, legendre, a, n_kept), PROJECTION_WEIGHT * largest_move)
        error = max(error, b[S // 2] * change)  # rounding errors of the accelerations at one node
        stored[ERROR] = error
        if not error <= stored[MAX_ERROR]:
            return Attempt(DONE, max(error, REPEAT_FACTOR), 0.0)
    _set_beginning_state(duration, c_base, weights_v, weights_q, a, q_base, v_base, q_0, v_0)
    if is_estimated and t_base < t:
        code = renew_partition(f, w, t, q)
        _polynomial_at(t - begin, duration, b, c, a, q_0, v_0, weights_v, weights_q, q_stage, v_stage, a_stage)
        ratio = max(w.pivot / largest_pivot, EPS)
        if code != DONE or _deviates(tolerances, ratio, q, v, q_stage, v_stage):
            return Attempt(OUTER_DIVERGED, np.inf, 0.0)
    # a step of fixed size ends where it must, even if this is nearer to the singular position than its beginning
    min_pivots = MIN_PIVOT_RATIO * pivot if is_estimated else 0.0, min_node_pivot * largest_pivot
    code = _choose_partition_at_end(f, w, t + h, duration, stored, *min_pivots, tables, a, *states)
    if code != DONE:
        return Attempt(code, np.inf, 0.0)
    if is_estimated:  # the step has variable size: repeat it along this polynomial
        stored[BEGIN], stored[DURATION], stored[END] = begin, duration, t + h
        return Attempt(DONE, REPEAT_FACTOR, REPEAT_FACTOR)
    copy(q1, q_stage)
    copy(v1, v_stage)
    return _finish_piece(f, w, t + h, 0.0, options, tolerances, stage, state, new_state)


CROSSING = Step(crossing_step, commit_nothing)
