"""Steps of implicit Runge-Kutta methods by Newton's method in lanes, as `newton_step` has them, for stiff motion."""

import numpy as np

from twoloop.kernels.data.common import compiled, kernel, merged
from twoloop.kernels.lanes.lane_algebra import (
    copy_vectors,
    enlarge,
    factor_lanes,
    solve_lanes,
    sum_rows,
    table,
    vectors,
)
from twoloop.kernels.lanes.lane_control import N_HEAD, begin_control, choose_steps, end_steps, judge_steps, set_end
from twoloop.kernels.lanes.lane_newton import (
    BEGIN_Q,
    BEGIN_V,
    BY_Q,
    BY_V,
    E_Q,
    E_V,
    H_PREVIOUS,
    LARGEST_V,
    LASTING,
    ONCE,
    ONE,
    PREVIOUS,
    RAW,
    STAGES,
    START,
    SUMS,
    SYSTEMS,
    TO_GO,
    block_at,
    end_of_stages,
    factor_systems_of_lanes,
    find_derivatives,
    matrix_at,
    pivots_at,
    predict_stages,
    solve_stages,
    vector_at,
)
from twoloop.kernels.lanes.lane_room import (
    ACCEPTED,
    ATOL,
    ERROR,
    FINE,
    FRESH,
    GAP,
    LANES,
    N_NUMBERS,
    N_ROWS,
    RTOL,
    RUNNING,
    STEP,
    H,
    N,
    fill_field,
    places_of,
)
from twoloop.kernels.steps.lasting import OF_RUN, STEPS, TURNS
from twoloop.kernels.steps.newton_memory import GAMMA0, N_EIGEN_SCALARS, VELOCITIES, count_eigenvalues, eigen_place
from twoloop.kernels.steps.stages import tableau_of


@merged
def _allowed(control, room, state, new, j, place, k):
    """Of an error of entry `place` of a state, of coordinate j."""
    size = max(abs(room[(state + place) * LANES + k]), abs(room[(new + place) * LANES + k]))
    return control[ATOL + j] + control[RTOL] * size


@compiled
def _embedded(settings, own, A, room, memory):
    """The embedded estimate of the error, not filtered, into E_Q and E_V."""
    n, s = settings[N], A.shape[0]
    place = eigen_place(s)
    gamma0, e = own[place + GAMMA0], own[place + N_EIGEN_SCALARS : place + N_EIGEN_SCALARS + s]
    known, begin = table(room, block_at(memory, n, s, STAGES), s, n), vector_at(memory, n, BEGIN_V)
    e_q, e_v, sums = vector_at(memory, n, E_Q), vector_at(memory, n, E_V), vector_at(memory, n, SUMS)
    total = 0.0
    for i in range(s):
        total += e[i]
    for i in range(n * LANES):
        room[e_q * LANES + i] = (gamma0 + total) * room[begin * LANES + i]
    for j in range(s):  # velocities of the stages
        sum_rows(A[j], known, vectors(room, sums, n))
        for i in range(n * LANES):
            room[e_q * LANES + i] += e[j] * room[H * LANES + i % LANES] * room[sums * LANES + i]
    sum_rows(e, known, vectors(room, sums, n))
    for i in range(n * LANES):
        h = room[H * LANES + i % LANES]
        room[e_q * LANES + i] *= h
        room[e_v * LANES + i] = h * (gamma0 * room[(begin + n) * LANES + i] + room[sums * LANES + i])


@compiled
def _filter(settings, own, s, room, memory):
    """(I - z J)^-1 (E_Q, E_V), z = gamma0 H, J being the Jacobian of (v, F)."""
    n = settings[N]
    gamma0 = own[eigen_place(s) + GAMMA0]
    e_q, e_v, one = vector_at(memory, n, E_Q), vector_at(memory, n, E_V), vector_at(memory, n, ONE)
    by_q = matrix_at(memory, n, s, BY_Q)
    for i in range(n):
        for k in range(LANES):
            total = 0.0
            for j in range(n):
                total += room[(by_q + i * n + j) * LANES + k] * room[(e_q + j) * LANES + k]
            room[(one + i) * LANES + k] = room[(e_v + i) * LANES + k] + gamma0 * room[H * LANES + k] * total
    pivots = pivots_at(memory, n, s, count_eigenvalues(own, s), 0)
    solve_lanes(room, matrix_at(memory, n, s, SYSTEMS), pivots, n, 0, one)
    copy_vectors(room, one, e_v, n)
    for i in range(n * LANES):
        room[e_q * LANES + i] += gamma0 * room[H * LANES + i % LANES] * room[e_v * LANES + i]


@compiled
def _lasting_error(control, room, n, memory, z, state, new, k):
    """What an error of the velocities makes of the positions, see lasting.py."""
    raw, once, twice = vector_at(memory, n, RAW), vector_at(memory, n, ONCE), vector_at(memory, n, E_V)
    begin = vector_at(memory, n, BEGIN_V)
    largest = turn = fastest = change = 0.0
    for j in range(n):
        fastest = max(fastest, abs(room[(begin + j) * LANES + k]))
        change = max(change, abs(room[(begin + n + j) * LANES + k]))
        largest = max(largest, abs(room[(twice + j) * LANES + k]))
        bend = room[(twice + j) * LANES + k] - 2.0 * room[(once + j) * LANES + k] + room[(raw + j) * LANES + k]
        turn = max(turn, abs(bend))  # (z J)^2 e
    if largest > 0.0:
        room[(memory + LASTING) * LANES + k] = z * np.sqrt(largest / turn)
    lasting = room[(memory + LASTING) * LANES + k]
    if lasting * change * TURNS > fastest:
        lasting *= min(TURNS, lasting * change * TURNS / fastest) if fastest > 0.0 else TURNS
    return _over_velocities(control, room, n, twice, lasting, state, new, k)


@compiled
def _over_velocities(control, room, n, error_v, lasting, state, new, k):
    """Largest component of an error of the velocities that lasts so long, over the tolerances."""
    error = 0.0
    for j in range(n):
        share_q = lasting / _allowed(control, room, state, new, j, j, k)
        share_v = 1.0 / _allowed(control, room, state, new, j, n + j, k)
        error = max(error, abs(room[(error_v + j) * LANES + k]) * min(share_q, share_v))
    return error


@merged
def _own_time(control, room, n, memory, k):
    """The time in which the motion changes its velocities, s, see lasting.py."""
    begin = vector_at(memory, n, BEGIN_V)
    fastest = change = 0.0
    for j in range(n):
        fastest = max(fastest, abs(room[(begin + j) * LANES + k]))
        change = max(change, abs(room[(begin + n + j) * LANES + k]))
    longest = OF_RUN * control[GAP]
    return fastest / change if fastest < longest * change else longest


@compiled
def _slow_error(settings, control, own, s, room):
    """What an error of the velocities, in E_V, leaves in directions that are slow beside the step, as newton_step."""
    n = settings[N]
    state, new, _, _, _, _, _, memory = places_of(n, settings[N_ROWS], settings[N_NUMBERS])
    e_v, most, fine = vector_at(memory, n, E_V), memory + LARGEST_V, memory + TO_GO
    anywhere = False
    for k in range(LANES):
        error = 0.0
        if room[ERROR * LANES + k] <= 1.0:
            long = _own_time(control, room, n, memory, k)
            error = _over_velocities(control, room, n, e_v, long, state, new, k)
        room[most * LANES + k], room[fine * LANES + k] = error, room[FINE * LANES + k]
        anywhere = anywhere or error > 1.0
    if not anywhere:
        return
    by_q, by_v = matrix_at(memory, n, s, BY_Q), matrix_at(memory, n, s, BY_V)
    matrix = matrix_at(memory, n, s, SYSTEMS)
    for i in range(n * n):
        for k in range(LANES):
            z = STEPS * room[H * LANES + k]
            entry = -z * z * room[(by_q + i) * LANES + k] - z * room[(by_v + i) * LANES + k]
            room[(matrix + i) * LANES + k] = entry + (1.0 if i % (n + 1) == 0 else 0.0)
    pivots = pivots_at(memory, n, s, count_eigenvalues(own, s), 0)
    factor_lanes(room, matrix, pivots, n, 0)
    solve_lanes(room, matrix, pivots, n, 0, e_v)
    for k in range(LANES):
        error = room[most * LANES + k]
        if room[FINE * LANES + k] == 1.0:  # where the motion is unstable the solution may be large
            long = _own_time(control, room, n, memory, k)
            error = min(error, _over_velocities(control, room, n, e_v, long, state, new, k))
        room[FINE * LANES + k] = room[fine * LANES + k]
        if room[most * LANES + k] > 1.0:
            room[ERROR * LANES + k] = max(room[ERROR * LANES + k], error)


@compiled
def _estimate(settings, control, own, A, room):
    """ERROR of the steps: the embedded estimate, filtered for stiff components, over the tolerances."""
    n, s = settings[N], A.shape[0]
    state, new, _, _, _, _, _, memory = places_of(n, settings[N_ROWS], settings[N_NUMBERS])
    place = eigen_place(s)
    e_q, e_v = vector_at(memory, n, E_Q), vector_at(memory, n, E_V)
    _embedded(settings, own, A, room, memory)
    copy_vectors(room, e_v, vector_at(memory, n, RAW), n)
    _filter(settings, own, s, room, memory)
    tests_velocities = own[place + VELOCITIES] == 1.0
    fill_field(room, ERROR, 0.0)
    for j in range(n):
        atol, rtol = control[ATOL + j], control[RTOL]
        enlarge(room, ERROR, e_q + j, RUNNING, state + j, new + j, atol, rtol)
        if tests_velocities:
            enlarge(room, ERROR, e_v + j, RUNNING, state + n + j, new + n + j, atol, rtol)
    if tests_velocities:
        return
    copy_vectors(room, e_v, vector_at(memory, n, ONCE), n)
    _filter(settings, own, s, room, memory)
    for k in range(LANES):
        z = own[place + GAMMA0] * room[H * LANES + k]
        error = _lasting_error(control, room, n, memory, z, state, new, k)
        room[ERROR * LANES + k] = max(room[ERROR * LANES + k], error)
    _slow_error(settings, control, own, s, room)


@compiled
def _keep(room, memory, n, s):
    """The stages of accepted steps are what the next ones, and states within these, are predicted from."""
    stages, previous = block_at(memory, n, s, STAGES), block_at(memory, n, s, PREVIOUS)
    for k in range(LANES):
        if room[ACCEPTED * LANES + k] == 1.0:
            room[(memory + H_PREVIOUS) * LANES + k] = room[H * LANES + k]
            for i in range(s * n):
                room[(previous + i) * LANES + k] = room[(stages + i) * LANES + k]


@kernel(STEP, vectorized=True)
def step_by_newton(code, settings, control, options, room, status, n_steps, within):
    """A step, no longer than the gap within which the equations are looked at, or states within one, by others."""
    n = settings[N]
    state, _, _, _, a, _, _, memory = places_of(n, settings[N_ROWS], settings[N_NUMBERS])
    own = options[N_HEAD:]
    s, A, A2, b, bA, c = tableau_of(own)
    start, begin = vector_at(memory, n, START), vector_at(memory, n, BEGIN_Q)
    if not within:
        begin_control(options, control, room, n, state, a, start)
        for k in range(LANES):
            if room[FRESH * LANES + k] == 1.0:
                room[(memory + H_PREVIOUS) * LANES + k] = room[(memory + LASTING) * LANES + k] = 0.0
        choose_steps(room, control, status, n_steps)
        copy_vectors(room, state, begin, 2 * n)
        copy_vectors(room, start, begin + 2 * n, n)
        find_derivatives(code, settings, control, c, room)
    factor_systems_of_lanes(settings, own, s, room)
    predict_stages(settings, c, room, 0.0 if within else 1.0)
    solve_stages(code, settings, control, options, own, A, A2, c, room)
    end_of_stages(settings, b, bA, room)
    set_end(room, control)
    if not within:
        _estimate(settings, control, own, A, room)
        end_steps(code, settings, control, room, vector_at(memory, n, SUMS))
        judge_steps(options, room, n, a, start, status)
        _keep(room, memory, n, s)
