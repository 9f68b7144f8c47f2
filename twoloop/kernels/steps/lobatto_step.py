"""Steps by collocation at nine Lobatto nodes, of order 16: the outer loop of the paper's procedure, in lanes.

The stages of an implicit Runge-Kutta step are iterated without any Jacobian, as the paper does, all of them at once:
see generate/collocation_code.py, whose functions do the arithmetic. (M. Antonana, J. Makazaga and A. Murua do so for
ordinary differential equations at high precision, arXiv 2511.03655.) Here the length of a step is chosen. A sweep over
the stages shrinks their error by rho, which grows with the step and with the derivatives of the accelerations; the
length is such that a given number of sweeps suffices, or such that the top coefficients of the accelerations in
Legendre polynomials are as small as the tolerance asks for. The integrator asks for one step after another; or several
are made in a row, while nothing else has to be looked at, and put on the constraints side by side.
"""

import math

from twoloop.kernels.algebra.linalg import copy
from twoloop.kernels.control import clock as at
from twoloop.kernels.control.predictor import departure, keep_predicted
from twoloop.kernels.control.progress import count_step
from twoloop.kernels.data import collocation as room_at
from twoloop.kernels.data.codes import DONE, OUTER_DIVERGED, UNSUITED
from twoloop.kernels.data.collocation import LANES, places
from twoloop.kernels.data.common import ATTEMPT, MANY, SETTLE, Attempt, Step, compiled, inlined, kernel, merged
from twoloop.kernels.data.counters import (
    N_ACCEPTED,
    N_EVALUATIONS,
    N_FACTORIZATIONS,
    N_INNER,
    N_OUTER,
    N_REJECTED_ERROR,
)
from twoloop.kernels.data.noted import BY_GENERAL, DEFECT, NEARLY_SINGULAR, ORIENTATION_NEW, ROUNDED
from twoloop.kernels.data.tolerances import ESTIMATE, LOOK, ROUNDING, allowed
from twoloop.kernels.evaluation.calls import check_redundant, project
from twoloop.kernels.evaluation.gamma import representable
from twoloop.kernels.evaluation.onto_constraints import ABOVE_ROUNDING

# FREE: how many times LOOK a step may be long that nothing is looked at within, beside the nodes
THETA, N_ITERATED, N_ROWS, FREE, N_OPTIONS = range(5)

KAPPA = 0.05  # of the tolerance: what the iteration may leave; errors are then at most those of other methods of ours
TARGET = 6.0  # sweeps that a step is to take
MORE = 7  # sweeps beyond the target, after which a step is refused
SLOW = 0.8  # contraction that is too slow
LEAST_RHO, MOST_RHO = 1e-3, 0.9
SLOW_START, FAST_START, WANTED_START = 0.3, 0.04, 0.12  # contraction of the first step: between the first two is well
MOST_STARTS = 4
STAGNANT, NOISE = 0.5, 1e-13  # changes that fall no further, and are this small relative to the values, are rounding
# of steps without an estimate of their error; forces may have rounding errors of their own
ROUNDING_OF_FIXED, NOISE_OF_FIXED, MOST_OF_FIXED = 1e-16, 1e-9, 60.0
ORDER, SHARE = 12.0, 0.5  # of the estimate of the error; and what it counts
SHORTER, SAFETY = 0.6, 0.65
UNFORESEEN = 10.0  # an error that is so large is looked at elsewhere
LIMITED, STRAIGHT = 24.0, 0.1  # such steps, after which another method goes on; what the iteration leaves of CURVED
REFUSALS = 12.0  # of REFUSED, which each accepted step lessens by 1 and each that did not converge raises by 2
BETWEEN = 0.0908  # of a step, the longest part that an audit leaves unseen: half that between two nodes
ALLOWED = 16.0  # the defect between nodes, over the tolerances: most of it does not last to the end
EARLY, GROWTH_EARLY, GROWTH = 6, 4.0, 1.3
MADE, REFUSED, GUESSED, LEFT = range(4)
_places = merged(places)


def memory_size(n, n_iterated, n_rows):
    """Length of `memory`, with room to begin at an aligned place."""
    return places(n, n_iterated, n_rows)[-1] + LANES


@inlined
def _room(memory):
    """The memory from an aligned place on."""
    return memory[(-(memory.ctypes.data >> 3)) & (LANES - 1) :]


@merged
def _sweeps(f, room, tolerances, state, first):
    """Iterate the stages: how that ended, after how many sweeps, the last change, and how many there should be."""
    estimated = tolerances[ESTIMATE] == 1.0
    target, kappa, noise, most = TARGET, KAPPA, NOISE, MOST_OF_FIXED
    if room[room_at.DEGREE] >= 7.0:
        target += 2.0
    elif room[room_at.DEGREE] >= 6.0:
        target += 1.0
    if estimated:
        most = target + MORE
    else:
        kappa, noise = ROUNDING_OF_FIXED, NOISE_OF_FIXED
    noise *= room[room_at.SIZE] * room[room_at.STRICTER]
    rho, before, m = room[room_at.RHO], math.inf, 0.0
    while True:
        change = room[room_at.STRICTER] * f.sweep_nodes(room, state, f.own_numbers)
        m += 1.0
        if not change >= 0.0:
            return LEFT, m, change, target
        if m > 1.0:
            rho = min(max(change / before, LEAST_RHO), MOST_RHO) if before > 0.0 else LEAST_RHO
            room[room_at.RHO] = rho
        begins = first and estimated and m == 2.0 and room[room_at.STARTS] < MOST_STARTS and change > 0.0
        if begins and not FAST_START <= rho <= SLOW_START:
            return GUESSED, m, change, target
        if rho * change <= kappa or (m > 2.0 and change >= STAGNANT * before and change <= noise):
            return MADE, m, change, target
        if not change < math.inf or (m > 3.0 and rho >= SLOW and estimated) or m >= most:
            return REFUSED, m, change, target
        before = change


@compiled
def _collocate(f, w, options, room, tolerances, t, h, state):
    """The stages of a step: how it ended, its error, and the factor for the next one."""
    first, estimated = room[room_at.PREDICTS] == 0.0, tolerances[ESTIMATE] == 1.0
    longest = tolerances[LOOK] / BETWEEN
    if estimated and h > longest * (1.0 + ROUNDING):
        return REFUSED, h / longest, longest / h
    room[room_at.T], room[room_at.H], room[room_at.DEFECT] = t, h, -1.0
    if first:
        room[room_at.H_BEFORE], room[room_at.DEGREE], room[room_at.RHO] = h, 0.0, WANTED_START
    f.begin_nodes(room, state, tolerances)
    ended, m, change, target = _sweeps(f, room, tolerances, state, first)
    rho = room[room_at.RHO]
    w.counters[N_OUTER] += int(m)
    w.counters[N_EVALUATIONS] += LANES * int(m)
    w.counters[N_FACTORIZATIONS] += LANES * int(m)
    if ended == GUESSED:
        room[room_at.STARTS] += 1.0
        return ended, 2.0, min(max(WANTED_START / rho, 0.05), 30.0)
    if ended != MADE:
        room[room_at.REFUSED] += 2.0
        return ended, 2.0, SHORTER
    if not estimated:
        return MADE, 0.0, 1.0
    f.judge_nodes(room, state)
    error = SHARE * room[room_at.ERROR]
    if not error <= 1.0:
        return REFUSED, error, min(max(0.9 * error ** (-1.0 / ORDER), 0.3), 0.9)
    most = GROWTH_EARLY if room[room_at.N_STEPS] < EARLY else GROWTH
    if h > options[FREE] * tolerances[LOOK] * (1.0 + ROUNDING):
        w.counters[N_EVALUATIONS] += LANES
        defect = f.audit_nodes(room, state, f.own_numbers)
        if defect < 0.0:
            return LEFT, 2.0, SHORTER
        defect = max(0.0, defect - NOISE * room[room_at.LARGEST]) / ALLOWED
        if defect > 1.0:
            return REFUSED, min(defect, UNFORESEEN), max(0.3, 0.9 * defect ** (-1.0 / 9.0))
        room[room_at.DEFECT] = defect
        most = min(most, 0.9 * max(defect, 1e-9) ** (-1.0 / 9.0))
    most = min(most, longest / h)
    left = math.log2(rho * change / KAPPA + 1e-30) + (target - m) * math.log2(rho)
    factor = 2.0 ** (-(left + 1.0) / (target + 2.0))
    # the motion hardly bends within the step, which nonetheless takes about all its sweeps
    limited = room[room_at.CURVED] < STRAIGHT and m >= target - 1.0
    room[room_at.LIMITED] = max(0.0, room[room_at.LIMITED] + (1.0 if limited else -1.0))
    if error > 1e-6 and room[room_at.CURVED] >= STRAIGHT:
        factor = min(factor, SAFETY * error ** (-1.0 / ORDER))
    if m > target + 1.0:
        most = min(most, 0.9)
    return MADE, error, min(max(factor, 0.4), most)


@merged
def _next_degree(room):
    """The degree of the polynomial that would have predicted the end of this step best, near the one that it had."""
    if room[room_at.PREDICTS] == 0.0:
        return 3.0
    least = math.inf
    for k in range(LANES):
        least = min(least, room[room_at.WORST + k])
    best = LANES
    for k in range(LANES - 1, -1, -1):
        if room[room_at.WORST + k] <= 1.2 * least:
            best = k + 1
    degree = min(max(float(best), room[room_at.DEGREE] - 2.0), room[room_at.DEGREE] + 2.0)
    return min(max(degree, 2.0), 8.0)


@merged
def _accept(room):
    """The polynomial of this step predicts the next."""
    room[room_at.WHICH] = 1.0 - room[room_at.WHICH]
    room[room_at.DEGREE], room[room_at.H_BEFORE] = room[room_at.NEXT_DEGREE], room[room_at.H]
    room[room_at.PREDICTS], room[room_at.REFUSED] = 1.0, max(0.0, room[room_at.REFUSED] - 1.0)
    room[room_at.N_STEPS] += 1.0


@merged
def _is_unsuited(w, room):
    """Whether another method should go on: near a singular position, and where stiffness limits the steps."""
    stiff = room[room_at.LIMITED] >= LIMITED or room[room_at.REFUSED] >= REFUSALS
    return stiff or w.notes[NEARLY_SINGULAR] == 1.0


@kernel(SETTLE)
def settle_lobatto(f, w, options, memory, tolerances, accepted):
    """The polynomial of an accepted step predicts the next."""
    room = _room(memory)
    if accepted and room[room_at.TRIED] == 1.0:
        _accept(room)
    room[room_at.TRIED] = 0.0


@kernel(ATTEMPT)
def lobatto_step(f, w, options, memory, t, h, tolerances, state, new_state):
    """One attempt."""
    room, n = _room(memory), w.Q.size
    room[room_at.TRIED] = 0.0
    if tolerances[ESTIMATE] == 1.0 and _is_unsuited(w, room):
        return Attempt(UNSUITED, math.inf, 0.0)
    ended, error, factor = _collocate(f, w, options, room, tolerances, t, h, state)
    if ended == LEFT or (ended == REFUSED and tolerances[ESTIMATE] == 0.0):
        return Attempt(OUTER_DIVERGED, math.inf, 0.0)
    if ended != MADE:
        return Attempt(DONE, error, factor)
    w.notes[DEFECT] = room[room_at.DEFECT]
    f.end_nodes(room, state, new_state)
    room[room_at.NEXT_DEGREE], room[room_at.TRIED] = _next_degree(room), 1.0
    q1, v1, a1, lam1 = new_state[:n], new_state[n : 2 * n], new_state[2 * n : 3 * n], new_state[3 * n :]
    keep_predicted(w, q1)
    code = project(f, w, t + h, q1, v1, options[THETA], a1, lam1)
    if code == DONE:
        error = max(error, departure(w, tolerances, h, state[:n], state[n : 2 * n], q1))
    return Attempt(code, error, factor if error <= 1.0 else 0.0)


@merged
def _project_all(f, w, options, room, n, n_ends, out_t, out_state):
    """Put the states of so many rows on the constraints, in the lanes of `room`, with accelerations and multipliers."""
    ends = _places(n, int(options[N_ITERATED]), int(options[N_ROWS]))[4]
    for k in range(LANES):
        row = min(k, n_ends - 1)
        room[ends + k] = out_t[row]
        for i in range(2 * n):
            room[ends + LANES * (1 + i) + k] = out_state[row, i]
        room[room_at.FINE + k] = 1.0
    least = max(options[THETA], ABOVE_ROUNDING * w.notes[ROUNDED])
    f.closer_ends(room, f.own_numbers)
    for _ in range(4):
        f.nearer_ends(room, f.own_numbers)
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
def _take(f, w, options, room, tolerances, n, k, t, row, state):
    """Make `row`, a state beside the constraints, that of lane k, on them; whether it was near enough."""
    _, _, _, _, ends, end_a, lam, _ = _places(n, int(options[N_ITERATED]), int(options[N_ROWS]))
    if room[room_at.FINE + k] == 0.0:
        return False
    for i in range(n):
        q = room[ends + LANES * (1 + i) + k]
        if not abs(q - row[i]) <= allowed(tolerances, i, q, q):
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
def _make(f, w, options, room, tolerances, control, clock, goal, state, n_most, out_t, out_state, out_steps):
    """Steps in a row, at most so many, beside the constraints; how many."""
    n, t, n_ends = w.Q.size, clock[at.T], 0
    while n_ends < n_most:
        h = min(clock[at.H_NEXT], control[at.MAX_STEP])
        short = h < 0.5 * clock[at.H_LONG] or h <= control[at.SHORTEST]
        if short or h > 0.5 * (goal - t) or _is_unsuited(w, room):
            return n_ends
        h = representable(t, h)
        ended, error, factor = _collocate(f, w, options, room, tolerances, t, h, state)
        if ended == GUESSED or (ended == REFUSED and error <= UNFORESEEN):
            clock[at.H_NEXT] = h * factor
            w.counters[N_REJECTED_ERROR] += 1 if ended == REFUSED else 0
            continue
        if ended != MADE:
            return n_ends
        f.end_nodes(room, state, state)
        room[room_at.NEXT_DEGREE] = _next_degree(room)
        _accept(room)
        t += h
        out_t[n_ends], out_steps[n_ends, at.H] = t, h
        room[room_at.DEFECTS + n_ends] = room[room_at.DEFECT]
        copy(state[: 2 * n], out_state[n_ends, : 2 * n])
        clock[at.H_NEXT] = h * factor
        n_ends += 1
    return n_ends


@kernel(MANY)
def lobatto_steps(
    f, w, options, memory, tolerances, control, clock, goal, state, new_state, out_t, out_state, out_steps
):
    """Steps in a row while nothing else has to be looked at, at most as many as there are lanes; how many.

    Such a group ends where the number of steps is a multiple of that, whatever else makes the integrator pause: what is
    put on the constraints together depends on nothing but the run.
    """
    room, n = _room(memory), w.Q.size
    if out_t.size < LANES:
        return 0
    if control[at.FIRST_GIVEN] == 1.0:
        room[room_at.STARTS] = MOST_STARTS
    n_most = LANES - w.counters[N_ACCEPTED] % LANES
    if n_most > control[at.MAX_STEPS] - w.counters[N_ACCEPTED]:
        n_most = int(control[at.MAX_STEPS]) - w.counters[N_ACCEPTED]
    copy(state, new_state)
    n_ends = _make(f, w, options, room, tolerances, control, clock, goal, state, n_most, out_t, out_state, out_steps)
    if n_ends == 0:
        return 0
    _project_all(f, w, options, room, n, n_ends, out_t, out_state)
    for k in range(n_ends):
        h = out_steps[k, at.H]
        if not _take(f, w, options, room, tolerances, n, k, out_t[k], out_state[k], state):
            if k == 0:
                copy(new_state, state)
            clock[at.H_NEXT], room[room_at.PREDICTS] = SHORTER * h, 0.0
            return k
        clock[at.T] = out_t[k]
        w.notes[DEFECT], w.notes[ORIENTATION_NEW] = room[room_at.DEFECTS + k], 0.0
        count_step(w, tolerances, control, clock, h, out_steps[k])
    return n_ends


LOBATTO = Step(lobatto_step, settle_lobatto, lobatto_steps)
