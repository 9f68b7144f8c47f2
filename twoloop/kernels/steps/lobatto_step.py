"""Take implicit Runge-Kutta steps of order 16 at nine Lobatto nodes: the paper's outer loop, in SIMD lanes.

The stages are found by fixed-point iteration without any Jacobian, as in the paper, all of them at once. The generated
code of generate/collocation_code.py does the arithmetic; this file chooses the step size. (M. Antonana, J. Makazaga and
A. Murua use the same iteration for ordinary differential equations at high precision, arXiv 2511.03655.)

One sweep over the stages multiplies their error by the contraction rho, which grows with the step size and with the
derivatives of the accelerations. Two things limit the step size:

- convergence: a target number of sweeps has to suffice;
- accuracy: the last Legendre coefficients of the accelerations have to be as small as the tolerance requires.

The integrator calls for one step at a time, or for several in a row while it has nothing to check between them. The
ends of steps in a row are projected onto the constraints together, one in each lane.
"""

import math

from twoloop.kernels.control import loop_state as at
from twoloop.kernels.control.singular_positions import COLLAPSED, SHORT_STEP, SINGULAR_PIVOT
from twoloop.kernels.control.step_size import count_step, departure, off_grid, store_prediction
from twoloop.kernels.data import collocation as room_at
from twoloop.kernels.data.collocation import CONVERGED, GUESSED, LANES, NOT_COMPUTED, REFUSED, places
from twoloop.kernels.data.common import (
    ATTEMPT,
    MANY,
    SETTLE,
    SLACK,
    Attempt,
    Step,
    allowed,
    compiled,
    inlined,
    kernel,
    merged,
)
from twoloop.kernels.data.indices import (
    BY_GENERAL,
    DEFECT,
    DONE,
    ESTIMATE,
    LEAST,
    LOOK,
    N_ACCEPTED,
    N_EVALUATIONS,
    N_FACTORIZATIONS,
    N_INNER,
    N_OUTER,
    N_REJECTED_ERROR,
    NEAR_NOW,
    NEARLY_SINGULAR,
    ORIENTATION_NEW,
    OUTER_DIVERGED,
    PIVOT,
    ROUNDED,
    SINGULAR,
    UNSUITED,
)
from twoloop.kernels.evaluation.inner_loop import check_redundant, project, renew_partition
from twoloop.kernels.evaluation.partition import MIN_CORRECTION
from twoloop.kernels.linalg.dense import copy

# FREE: longest step, in units of LOOK, whose nodes alone are close enough; longer ones are also checked between nodes
THETA, N_ITERATED, N_ROWS, FREE, N_OPTIONS = range(5)

WANTED_START = 0.12  # target of the contraction in the first step, between the limits of collocation_code.py
MOST_STARTS = 4  # largest number of guesses of the first step size
SHORTER, SAFETY = 0.6, 0.75  # factor after a step that did not converge; safety factor of the error
# number of steps limited by convergence after which another method takes over, because the motion is stiff; and the
# value of CURVED below which accelerations hardly vary within a step
LIMITED, STRAIGHT = 24.0, 0.1
# number of parts of a step at whose ends pivots are checked, and their least ratio to the pivot at the beginning
N_CHECKED, MUCH_NEARER = 4, 0.4
# tolerance below which another method takes over after a singular position: here five more runs of A02 were wrong
TIGHT_TOLERANCE = 1e-8
REFUSALS = 12.0  # limit of FAILURES: an accepted step lowers it by 1, a step that did not converge raises it by 2
# longest part of a step without an evaluation if also checked between nodes, relative to the step
CHECKED_GAP = 0.0908
N_EARLY, GROWTH_EARLY, GROWTH = 6, 4.0, 1.3  # largest factor: in the first N_EARLY steps, and after them
GROWTH_AT_ONCE = 30.0  # largest factor after a step at the beginning that needed a single sweep
LEAST_TREND, MAX_EXTRAPOLATION = 0.4, 3.0  # limits of the trend of the step size, and of its factor by the error
_places = merged(places)


def memory_size(n, n_iterated, n_rows):
    """Return the length of `memory`, with a margin for its alignment."""
    return places(n, n_iterated, n_rows)[-1] + LANES


@inlined
def _aligned(memory):
    """Return the memory from the first address that is aligned for vector loads."""
    return memory[(-(memory.ctypes.data >> 3)) & (LANES - 1) :]


@merged
def _predict_from_rejected(f, room, state):
    """Make the polynomial of a step whose error is too large predict the shorter step that replaces it."""
    f.retry_nodes(room, state)
    if room[room_at.KEPT_DEGREE] == 0.0:
        room[room_at.KEPT_DEGREE] = max(room[room_at.DEGREE], 3.0)
    room[room_at.DEGREE], room[room_at.H_BEFORE], room[room_at.PREDICTS] = 8.0, room[room_at.H], 1.0


@compiled
def _collocate(f, w, options, room, tolerances, t, h, state):
    """Iterate the stages of a step; return how the iteration ended, the error, and the factor of the next step size."""
    first, estimated = room[room_at.PREDICTS] == 0.0, tolerances[ESTIMATE] == 1.0
    longest = tolerances[LOOK] / CHECKED_GAP
    if estimated and h > longest * (1.0 + SLACK):
        return REFUSED, h / longest, longest / h
    room[room_at.T], room[room_at.H], room[room_at.DEFECT] = t, h, -1.0
    room[room_at.MAY_GUESS] = 0.0
    if first:
        room[room_at.H_BEFORE], room[room_at.DEGREE], room[room_at.RHO] = h, 0.0, WANTED_START
        room[room_at.MAY_GUESS] = 1.0 if estimated and room[room_at.STARTS] < MOST_STARTS else 0.0
    ended = int(f.attempt_nodes(room, state, tolerances, f.own_numbers))
    m = int(room[room_at.SWEEPS])
    w.counters[N_OUTER] += m
    w.counters[N_EVALUATIONS] += LANES * m
    w.counters[N_FACTORIZATIONS] += LANES * m
    if ended == GUESSED:
        room[room_at.STARTS] += 1.0
        return ended, 2.0, min(max(WANTED_START / room[room_at.RHO], 0.05), 30.0)
    if ended != CONVERGED:
        room[room_at.FAILURES] += 2.0
        return ended, 2.0, SHORTER
    if not estimated:
        return CONVERGED, 0.0, 1.0
    error = room[room_at.ERROR]
    if not error <= 1.0:
        _predict_from_rejected(f, room, state)
        return REFUSED, error, min(max(0.9 * room[room_at.FACTOR_OF_ERROR], 0.3), 0.9)
    most = GROWTH_EARLY if room[room_at.N_STEPS] < N_EARLY else GROWTH
    if most > GROWTH and m == 1:
        most = GROWTH_AT_ONCE
    if h > options[FREE] * tolerances[LOOK] * (1.0 + SLACK):
        w.counters[N_EVALUATIONS] += LANES
        defect = f.audit_nodes(room, state, f.own_numbers)
        if defect < 0.0:
            return NOT_COMPUTED, 2.0, SHORTER
        of_defect = 0.9 * room[room_at.FACTOR_OF_DEFECT]
        if defect > 1.0:
            _predict_from_rejected(f, room, state)
            return REFUSED, defect, max(0.3, of_defect)
        room[room_at.DEFECT] = defect
        most = min(most, of_defect)
    most = min(most, longest / h)
    beyond = room[room_at.SWEEPS] - room[room_at.TARGETED]
    # stiff: accelerations hardly vary within the step, and yet it takes almost all its sweeps
    limited = room[room_at.CURVED] < STRAIGHT and beyond >= -1.0
    room[room_at.LIMITED] = max(0.0, room[room_at.LIMITED] + (1.0 if limited else -1.0))
    factor = room[room_at.FACTOR]
    # extrapolate the step size that accuracy allows: it mostly changes as it did from the step before to this one
    allowed_h = h * min(room[room_at.FACTOR_OF_ERROR], MAX_EXTRAPOLATION)
    if error > 1e-6 and room[room_at.CURVED] >= STRAIGHT:
        trend = 1.0 if first else min(max(allowed_h / room[room_at.ALLOWED_H], LEAST_TREND), 1.0)
        factor = min(factor, SAFETY * trend * room[room_at.FACTOR_OF_ERROR])
    room[room_at.ALLOWED_H] = allowed_h
    if beyond > 1.0:
        most = min(most, 0.9)
    return CONVERGED, error, min(max(factor, 0.4), most)


@merged
def _accept(room):
    """Make the polynomial of this step predict the next one."""
    if room[room_at.KEPT_DEGREE] > 0.0:
        room[room_at.NEXT_DEGREE], room[room_at.KEPT_DEGREE] = room[room_at.KEPT_DEGREE], 0.0
    room[room_at.WHICH] = 1.0 - room[room_at.WHICH]
    room[room_at.DEGREE], room[room_at.H_BEFORE] = room[room_at.NEXT_DEGREE], room[room_at.H]
    room[room_at.PREDICTS], room[room_at.FAILURES] = 1.0, max(0.0, room[room_at.FAILURES] - 1.0)
    room[room_at.N_STEPS] += 1.0


@merged
def _is_unsuited(w, room, tolerances):
    """Return whether another method has to take over: near a singular position, or if stiffness limits the steps."""
    stiff = room[room_at.LIMITED] >= LIMITED or room[room_at.FAILURES] >= REFUSALS
    near = w.notes[NEAR_NOW] == 1.0 or tolerances[LEAST] < TIGHT_TOLERANCE
    return stiff or (w.notes[NEARLY_SINGULAR] == 1.0 and near)


@compiled
def _passes_singular(f, w, t, h, state, new_state):
    """Return whether C_q is much nearer to losing rank within a step than at its beginning.

    Stages off the constraints have wrong accelerations near a singular position: other steps have to cross it. The
    motion within the step is approximated by the cubic through its ends.
    """
    n, pivot = w.Q.size, w.notes[PIVOT]
    for k in range(1, N_CHECKED):
        s = k / N_CHECKED
        rest = 1.0 - s
        for m in range(n):
            q0, v0, q1, v1 = state[m], h * state[n + m], new_state[m], h * new_state[n + m]
            w.y[m] = q0 + s * s * (3.0 - 2.0 * s) * (q1 - q0) + s * rest * (rest * v0 - s * v1)
        if renew_partition(f, w, t + s * h, w.y) != DONE or w.notes[PIVOT] < MUCH_NEARER * pivot:
            return True
    return False


@kernel(SETTLE)
def settle_lobatto(f, w, options, memory, tolerances, accepted):
    """Commit or discard an attempt: the polynomial of an accepted step predicts the next one."""
    room = _aligned(memory)
    if accepted and room[room_at.TRIED] == 1.0:
        _accept(room)
    room[room_at.TRIED] = 0.0


@kernel(ATTEMPT)
def lobatto_step(f, w, options, memory, t, h, tolerances, state, new_state):
    """Attempt one step and project its end onto the constraints."""
    room, n = _aligned(memory), w.Q.size
    room[room_at.TRIED] = 0.0
    if tolerances[ESTIMATE] == 1.0 and _is_unsuited(w, room, tolerances):
        return Attempt(UNSUITED, math.inf, 0.0)
    ended, error, factor = _collocate(f, w, options, room, tolerances, t, h, state)
    if ended == NOT_COMPUTED or (ended == REFUSED and tolerances[ESTIMATE] == 0.0):
        return Attempt(OUTER_DIVERGED, math.inf, 0.0)
    if ended != CONVERGED:
        return Attempt(DONE, error, factor)
    w.notes[DEFECT] = room[room_at.DEFECT]
    f.end_nodes(room, state, new_state)
    room[room_at.TRIED] = 1.0
    q1, v1, a1, lam1 = new_state[:n], new_state[n : 2 * n], new_state[2 * n : 3 * n], new_state[3 * n :]
    store_prediction(w, q1)
    code = project(f, w, t + h, q1, v1, options[THETA], a1, lam1)
    if code == DONE:
        error = max(error, departure(w, tolerances, h, state[:n], state[n : 2 * n], q1))
    if code == DONE and error <= 1.0 and w.notes[NEARLY_SINGULAR] == 1.0 and tolerances[ESTIMATE] == 1.0:
        w.notes[NEAR_NOW] = 2.0  # also check the pivots after the step
        if _passes_singular(f, w, t, h, state, new_state):
            code = SINGULAR
    return Attempt(code, error, factor if error <= 1.0 else 0.0)


@merged
def _project_all(f, w, options, room, n, n_ends, out_t, out_state):
    """Project the first n_ends rows onto the constraints, one in each lane; compute accelerations and multipliers."""
    ends = _places(n, int(options[N_ITERATED]), int(options[N_ROWS]))[5]
    for k in range(LANES):
        row = min(k, n_ends - 1)
        room[ends + k] = out_t[row]
        for i in range(2 * n):
            room[ends + LANES * (1 + i) + k] = out_state[row, i]
        room[room_at.FINE + k] = 1.0
    least = max(options[THETA], MIN_CORRECTION * w.notes[ROUNDED])
    f.correct_ends(room, f.own_numbers)
    for _ in range(4):
        f.project_ends(room, f.own_numbers)
        w.counters[N_INNER] += n_ends
        w.counters[N_FACTORIZATIONS] += n_ends
        moved = 0.0
        for k in range(n_ends):
            moved = max(moved, room[room_at.MOVED + k])
        if moved <= least:
            break
    for k in range(n_ends):
        if not room[room_at.MOVED + k] <= least:
            room[room_at.FINE + k] = 0.0


@merged
def _adopt_projection(f, w, options, room, tolerances, driven, n, k, t, row, state):
    """Replace `row` by its projection in lane k; return whether the projection moved it by the tolerance at most.

    Where constraints depend on time (`driven`), velocities are compared, too: a change that the accelerations at the
    nodes do not explain may be due to a discontinuity of the drive, see discontinuities.py.
    """
    _, _, _, _, _, ends, end_a, lam, _ = _places(n, int(options[N_ITERATED]), int(options[N_ROWS]))
    if room[room_at.FINE + k] == 0.0:
        return False
    for i in range(n):
        q = room[ends + LANES * (1 + i) + k]
        if not abs(q - row[i]) <= allowed(tolerances, i, q, q):
            return False
        v = room[ends + LANES * (1 + n + i) + k]
        if driven and not abs(v - row[n + i]) <= allowed(tolerances, i, v, v):
            return False
    for i in range(n):
        row[i], row[n + i] = room[ends + LANES * (1 + i) + k], room[ends + LANES * (1 + n + i) + k]
        row[2 * n + i] = room[end_a + LANES * i + k]
    for i in range(state.size - 3 * n):
        row[3 * n + i] = room[lam + LANES * i + k]
    if w.rows_v.size < w.Rate.size:
        w.notes[BY_GENERAL] = 0.0
        if check_redundant(f, w, t, row[:n], row[n : 2 * n]) != DONE:
            return False
    copy(row, state)
    return True


@merged
def _may_follow(w, room, tolerances, control, clock, h):
    """Return whether a step of this length may be taken before the integrator checks the previous one."""
    long = clock[at.H_LONG]
    if h <= control[at.SHORTEST] or h < COLLAPSED * long or _is_unsuited(w, room, tolerances):
        return False
    near = control[at.BRIDGE] == 1.0 and w.notes[PIVOT] < SINGULAR_PIVOT * clock[at.LARGEST_PIVOT]
    return not (near and h < SHORT_STEP * long)


@merged
def _advance(f, w, options, room, tolerances, control, clock, goal, state, n_most, out_t, out_state, out_steps):
    """Take at most n_most steps in a row without projecting their ends; return their number."""
    n, t, n_ends = w.Q.size, clock[at.T], 0
    while n_ends < n_most and t < goal:
        wanted = min(clock[at.H_NEXT], control[at.MAX_STEP])
        if not _may_follow(w, room, tolerances, control, clock, wanted):
            break
        h, reaches = off_grid(control, t, wanted, goal - t, False)
        if reaches:
            h = goal - t
        ended, _, factor = _collocate(f, w, options, room, tolerances, t, h, state)
        if ended == NOT_COMPUTED:
            break
        if ended != CONVERGED:
            clock[at.H_NEXT] = h * factor
            w.counters[N_REJECTED_ERROR] += 1 if ended == REFUSED else 0
            continue
        f.end_nodes(room, state, state)
        _accept(room)
        t = goal if reaches else t + h
        out_t[n_ends], out_steps[n_ends, at.H] = t, h
        room[room_at.DEFECTS + n_ends] = room[room_at.DEFECT]
        copy(state[: 2 * n], out_state[n_ends, : 2 * n])
        # a step cut short by an output time says little about the next
        clock[at.H_NEXT] = max(h * factor, wanted) if h < wanted else h * factor
        n_ends += 1
    return n_ends


@kernel(MANY)
def lobatto_steps(
    f, w, options, memory, tolerances, control, clock, goal, state, new_state, out_t, out_state, out_steps
):
    """Take steps in a row, at most as many as there are lanes, and project their ends together; return their number.

    A group ends when the number of accepted steps is a multiple of the lanes, even if the integrator has paused within
    it: then the grouping depends on the run alone, and results can be repeated.
    """
    room, n = _aligned(memory), w.Q.size
    if out_t.size < LANES or w.notes[NEARLY_SINGULAR] == 1.0:
        return 0
    if control[at.FIRST_GIVEN] == 1.0:
        room[room_at.STARTS] = MOST_STARTS
    n_most = LANES - w.counters[N_ACCEPTED] % LANES
    if n_most > control[at.MAX_STEPS] - w.counters[N_ACCEPTED]:
        n_most = int(control[at.MAX_STEPS]) - w.counters[N_ACCEPTED]
    copy(state, new_state)
    driven = control[at.DRIVEN] == 1.0
    n_ends = _advance(f, w, options, room, tolerances, control, clock, goal, state, n_most, out_t, out_state, out_steps)
    if n_ends == 0:
        return 0
    _project_all(f, w, options, room, n, n_ends, out_t, out_state)
    for k in range(n_ends):
        h = out_steps[k, at.H]
        if not _adopt_projection(f, w, options, room, tolerances, driven, n, k, out_t[k], out_state[k], state):
            if k == 0:
                copy(new_state, state)
            clock[at.H_NEXT], room[room_at.PREDICTS] = SHORTER * h, 0.0
            return k
        clock[at.T] = out_t[k]
        w.notes[DEFECT], w.notes[ORIENTATION_NEW] = room[room_at.DEFECTS + k], 0.0
        count_step(w, tolerances, control, clock, h, out_steps[k])
    return n_ends


LOBATTO = Step(lobatto_step, settle_lobatto, lobatto_steps)
