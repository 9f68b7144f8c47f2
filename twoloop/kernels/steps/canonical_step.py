"""Implicit Runge-Kutta steps in canonical variables: independent coordinates q_i and their momenta p_i = T^T M v.

T (n_q, n_dof) has the identity in its independent rows and -C_qd^-1 C_qi in its dependent ones: the velocities that
the constraints allow are v = T v_i + u, with u_d = -C_qd^-1 C_t. Along a motion (T^T C_q^T = 0 removes the multipliers)

    p_i' = T^T (Q + M' v) + T'^T M v,    T'_d = -C_qd^-1 C_q' T,

where a dash is d/dt. If Q comes from a potential (and from a mass matrix that depends on q), these are Hamilton's
equations of the reduced system, and a symplectic tableau makes a symplectic map of them. C_q' T_k needs no second
derivatives of its own: Q_d(v) = -(C_qq v v + 2 C_qt v + C_tt) gives it exactly by
C_q' T_k = -[Q_d(v + T_k) - Q_d(v - T_k)] / 4.
"""

import numpy as np

from twoloop.kernels.algebra.factors import columns_of, rows_of, solve
from twoloop.kernels.algebra.linalg import copy, ldl_factor, ldl_solve
from twoloop.kernels.control.compensated_sums import N_RESTS, compensated, forget, keep_rest, rests
from twoloop.kernels.control.convergence import CONVERGED, MAX_ITERATIONS, UNDECIDED, judged
from twoloop.kernels.control.predictor import departure, keep_predicted
from twoloop.kernels.control.richardson import conclude
from twoloop.kernels.data.codes import DONE, MASS_NOT_DEFINITE, OUTER_DIVERGED
from twoloop.kernels.data.common import ATTEMPT, SETTLE, Attempt, Step, compiled, inlined, kernel
from twoloop.kernels.data.counters import N_EVALUATIONS, N_FACTORIZATIONS, N_OUTER, N_PARTITIONS
from twoloop.kernels.data.flags import CONSTANT_MASS
from twoloop.kernels.data.tolerances import ESTIMATE
from twoloop.kernels.evaluation.calls import accelerations, dependent_positions, find_gamma, find_tangents
from twoloop.kernels.evaluation.gamma import longest_difference
from twoloop.kernels.steps.stages import EXTRAPOLATION, FARTHEST, INNER_TOL, OUTER_TOL, STAGES, interpolate, tableau_of

# places in `memory`: scalars, then stage blocks (s, n), vectors (n), matrices; GOES_ON: the last attempt was accepted
GOES_ON, HAS_TRIAL, H_TRIAL, HAS_PREVIOUS, H_PREVIOUS, PARTITION_NUMBER, N_MEMORY_SCALARS = range(7)
V_PREVIOUS, R_PREVIOUS, V_TRIAL, R_TRIAL, V_HALF, R_HALF, Q_STAGE, P_STAGE, N_BLOCKS = range(9)
P_START, P_END, RATE, MV, V_NEW, SHIFTED, U, Q_FULL, V_FULL, Q_MID, V_MID, P_MID, REST = range(13)
N_VECTORS = REST + N_RESTS
TANGENT, REDUCED_MASS, N_MATRICES = range(3)


def memory_size(s: int, n_q: int) -> int:
    """Length of `memory` for s stages and n_q coordinates."""
    return N_MEMORY_SCALARS + N_BLOCKS * s * n_q + N_VECTORS * n_q + N_MATRICES * n_q * n_q + s


@inlined
def _block(memory, s, n, which):
    start = N_MEMORY_SCALARS + which * s * n
    return memory[start : start + s * n].reshape((s, n))


@inlined
def _vector(memory, s, n, which):
    start = N_MEMORY_SCALARS + (N_BLOCKS * s + which) * n
    return memory[start : start + n]


@inlined
def _matrix(memory, s, n, rows, columns, which):
    start = N_MEMORY_SCALARS + (N_BLOCKS * s + N_VECTORS + which * n) * n
    return memory[start : start + rows * columns].reshape((rows, columns))


@compiled
def _tangents(f, w, t, q, tangent, reduced, u):
    """Rows T_k, the velocity u at v_i = 0 and the factors of T^T M T at q on the constraints; C_q stays in w."""
    code = find_tangents(f, w, t, q)
    if code != DONE:
        return code
    columns, n_dof = columns_of(w.index), w.independent.size
    u[:] = 0.0
    for i in range(columns.size):
        u[columns[i]] = w.D[n_dof, i]
    tangent[:, :] = 0.0
    for k in range(n_dof):
        tangent[k, w.independent[k]] = 1.0
        for i in range(columns.size):
            tangent[k, columns[i]] = w.D[k, i]
    if f.flags[CONSTANT_MASS] == 0:
        w.M[:, :] = 0.0
        f.mass(t, q, f.p, w.M)
    for k in range(w.independent.size):
        _times_mass(w, tangent[k], w.x)
        for m in range(k, w.independent.size):
            total = 0.0
            for j in range(q.size):
                total += tangent[m, j] * w.x[j]
            reduced[k, m] = total
    w.counters[N_FACTORIZATIONS] += 1
    return DONE if ldl_factor(reduced) else MASS_NOT_DEFINITE


@compiled
def _times_mass(w, x, y):
    """y = M x."""
    for i in range(x.size):
        total = 0.0
        for j in range(x.size):
            total += w.M[i, j] * x[j]
        y[i] = total


@compiled
def _momenta(w, tangent, v, Mv, p):
    """p_k = T_k^T M v in the places of the independent coordinates; Mv = M v."""
    _times_mass(w, v, Mv)
    for k in range(w.independent.size):
        total = 0.0
        for j in range(v.size):
            total += tangent[k, j] * Mv[j]
        p[w.independent[k]] = total


@compiled
def _velocities(w, tangent, reduced, u, p, v):
    """v from p: T^T M T v_i = p - T^T M u."""
    _times_mass(w, u, w.x)
    v_i = w.Q[: w.independent.size]  # scratch
    for k in range(w.independent.size):
        total = p[w.independent[k]]
        for j in range(v.size):
            total -= tangent[k, j] * w.x[j]
        v_i[k] = total
    ldl_solve(reduced, v_i)
    copy(u, v)
    for k in range(w.independent.size):
        for j in range(v.size):
            v[j] += tangent[k, j] * v_i[k]


@compiled
def _mass_rate(f, w, t, q, v, shifted, y):
    """y += M' v, M differenced along the motion (central, order 4); w.L is free where M is not constant."""
    step = longest_difference(q, v)
    for k in range(4):
        shift = (-2.0, -1.0, 1.0, 2.0)[k] * step
        weight = (1.0, -8.0, 8.0, -1.0)[k] / (12.0 * step)
        for j in range(q.size):
            shifted[j] = q[j] + shift * v[j]
        w.L[:, :] = 0.0
        f.mass(t + shift, shifted, f.p, w.L)
        for i in range(q.size):
            for j in range(q.size):
                y[i] += weight * w.L[i, j] * v[j]


@compiled
def _momentum_rates(f, w, t, q, v, tangent, Mv, shifted, rate):
    """p_i' at (t, q, v) after `_tangents`; Mv is scratch."""
    w.counters[N_EVALUATIONS] += 1
    n_q = v.size
    rows, columns = rows_of(w.index), columns_of(w.index)
    w.Q[:] = 0.0
    f.force(t, q, v, f.p, w.Q)
    if f.flags[CONSTANT_MASS] == 0:
        _mass_rate(f, w, t, q, v, shifted, w.Q)
    _times_mass(w, v, Mv)
    for k in range(w.independent.size):
        total = 0.0
        for j in range(n_q):
            total += tangent[k, j] * w.Q[j]
        for j in range(n_q):
            shifted[j] = v[j] - tangent[k, j]
        code = find_gamma(f, w, t, q, shifted)
        for i in range(rows.size):
            w.z[i] = -w.Gamma[rows[i]]
        for j in range(n_q):
            shifted[j] = v[j] + tangent[k, j]
        if code == DONE:
            code = find_gamma(f, w, t, q, shifted)
        if code != DONE:
            return code
        for i in range(rows.size):
            w.z[i] = 0.25 * (w.z[i] + w.Gamma[rows[i]])  # -C_q' T_k
        solve(w.index, w.values, w.z)
        for i in range(rows.size):
            total += w.z[i] * Mv[columns[i]]
        rate[w.independent[k]] = total
    return DONE


@compiled
def _iterate(f, w, options, memory, tolerances, t, h, q, v0, p, V_stage, R_stage, q1, p1, v1, rest):
    """One step of size h from (q, p) by a fixed-point iteration.

    V_stage, R_stage hold predicted velocities and rates of p on entry.
    On return they have converged, and q1, p1, v1 are the end of the step, on the constraints; q1 and p1 are summed with
    compensation if there are rows of `rest`. Returns the code, and how far the prediction of the dependents was off.
    """
    s, A, _, b, _, c = tableau_of(options)
    n = q.size
    n_dof = w.independent.size
    tangent = _matrix(memory, s, n, n_dof, n, TANGENT)
    reduced = _matrix(memory, s, n, n_dof, n_dof, REDUCED_MASS)
    Q_stage, P_stage = _block(memory, s, n, Q_STAGE), _block(memory, s, n, P_STAGE)
    u, Mv, v, shifted = (
        _vector(memory, s, n, U),
        _vector(memory, s, n, MV),
        _vector(memory, s, n, V_NEW),
        _vector(memory, s, n, SHIFTED),
    )
    for j in range(s):
        for m in range(n):
            total = 0.0
            for k in range(s):
                total += A[j, k] * V_stage[k, m]
            Q_stage[j, m] = q[m] + h * total
    first = 0.0
    before = earlier = np.inf
    verdict = UNDECIDED
    for iteration in range(MAX_ITERATIONS):
        w.counters[N_OUTER] += 1
        for j in range(s):
            for m in w.independent:
                in_q = 0.0
                in_p = 0.0
                for k in range(s):
                    in_q += A[j, k] * V_stage[k, m]
                    in_p += A[j, k] * R_stage[k, m]
                Q_stage[j, m] = q[m] + h * in_q
                P_stage[j, m] = p[m] + h * in_p
        change = 0.0
        for j in range(s):
            code = dependent_positions(f, w, t + c[j] * h, Q_stage[j], v, options[INNER_TOL])
            if code == DONE:
                code = _tangents(f, w, t + c[j] * h, Q_stage[j], tangent, reduced, u)
            if code != DONE:
                return code, 0.0
            _velocities(w, tangent, reduced, u, P_stage[j], v)
            code = _momentum_rates(f, w, t + c[j] * h, Q_stage[j], v, tangent, Mv, shifted, R_stage[j])
            if code != DONE:
                return code, 0.0
            for m in w.independent:
                difference = abs(v[m] - V_stage[j, m])
                change = max(change, difference / max(abs(v[m]), 1.0))
                change = max(change, h * difference / max(abs(Q_stage[j, m]), 1.0))
            copy(v, V_stage[j])
        if iteration < 2:
            first = max(first, change)
        verdict = judged(change, earlier, first, iteration, options[OUTER_TOL], q)
        if verdict != UNDECIDED:
            break
        # of two iterations back: errors go from q to p in one iteration and back in the next
        earlier, before = before, change
    if verdict != CONVERGED:
        return OUTER_DIVERGED, 0.0
    for m in range(n):
        in_q = 0.0
        for k in range(s):
            in_q += b[k] * V_stage[k, m]
        if rest.shape[0] == 0:
            q1[m] = q[m] + h * in_q
        else:
            q1[m], rest[2, m] = compensated(q[m], rest[0, m], h * in_q)
    for m in w.independent:
        in_p = 0.0
        for k in range(s):
            in_p += b[k] * R_stage[k, m]
        if rest.shape[0] == 0:
            p1[m] = p[m] + h * in_p
        else:
            p1[m], rest[3, m] = compensated(p[m], rest[1, m], h * in_p)
    forget(w.dependent, rest)
    keep_predicted(w, q1)
    code, off = dependent_positions(f, w, t + h, q1, v1, options[INNER_TOL]), 0.0
    if code == DONE:
        off = departure(w, tolerances, h, q, v0, q1)
        code = _tangents(f, w, t + h, q1, tangent, reduced, u)
    if code == DONE:
        _velocities(w, tangent, reduced, u, p1, v1)
    return code, off


@inlined
def _rests_of(memory, s, n, tolerances):
    return rests(memory[N_MEMORY_SCALARS + (N_BLOCKS * s + REST) * n :], n, tolerances)


@kernel(SETTLE)
def settle_momenta(f, w, options, memory, tolerances, accepted):
    """The stages of an accepted step are what the next one is predicted from, and begins with."""
    s, n = int(options[STAGES]), w.Q.size
    memory[GOES_ON] = 0.0
    if accepted and memory[HAS_TRIAL] == 1.0:
        for j in range(s):
            copy(_block(memory, s, n, V_TRIAL)[j], _block(memory, s, n, V_PREVIOUS)[j])
            copy(_block(memory, s, n, R_TRIAL)[j], _block(memory, s, n, R_PREVIOUS)[j])
        memory[H_PREVIOUS] = memory[H_TRIAL]
        memory[HAS_PREVIOUS] = memory[GOES_ON] = 1.0
        keep_rest(_rests_of(memory, s, n, tolerances))
    memory[HAS_TRIAL] = 0.0


@kernel(ATTEMPT)
def momenta_step(f, w, options, memory, t, h, tolerances, state, new_state):
    """One attempt by a fixed-point iteration on (q_i, p_i); error and extrapolation as in `runge_kutta_step`."""
    s, _, _, _, _, c = tableau_of(options)
    n = w.Q.size
    n_dof = w.independent.size
    q, v = state[:n], state[n : 2 * n]
    q1, v1, a1, lam1 = new_state[:n], new_state[n : 2 * n], new_state[2 * n : 3 * n], new_state[3 * n :]
    v_previous, r_previous = _block(memory, s, n, V_PREVIOUS), _block(memory, s, n, R_PREVIOUS)
    v_trial, r_trial = _block(memory, s, n, V_TRIAL), _block(memory, s, n, R_TRIAL)
    v_half, r_half = _block(memory, s, n, V_HALF), _block(memory, s, n, R_HALF)
    p, p1, p_mid = _vector(memory, s, n, P_START), _vector(memory, s, n, P_END), _vector(memory, s, n, P_MID)
    q_full, v_full = _vector(memory, s, n, Q_FULL), _vector(memory, s, n, V_FULL)
    q_mid, v_mid = _vector(memory, s, n, Q_MID), _vector(memory, s, n, V_MID)
    rate, Mv = _vector(memory, s, n, RATE), _vector(memory, s, n, MV)
    tangent = _matrix(memory, s, n, n_dof, n, TANGENT)
    reduced = _matrix(memory, s, n, n_dof, n_dof, REDUCED_MASS)
    weights = memory[memory.size - s :]
    rest = _rests_of(memory, s, n, tolerances)
    # momenta and their rates belong to a partition: under another one they predict nothing
    same = memory[PARTITION_NUMBER] == w.counters[N_PARTITIONS]
    memory[PARTITION_NUMBER] = w.counters[N_PARTITIONS]
    if not same:
        memory[HAS_PREVIOUS] = 0.0
    ratio = h / memory[H_PREVIOUS] if memory[HAS_PREVIOUS] == 1.0 else np.inf
    if memory[GOES_ON] == 1.0 and tolerances[ESTIMATE] == 0.0 and ratio <= FARTHEST:
        copy(p1, p)  # to find them from v, which is rounded, would let the energy drift
    else:
        rest[:, :] = 0.0
        code = _tangents(f, w, t, q, tangent, reduced, _vector(memory, s, n, U))
        if code != DONE:
            return Attempt(code, np.inf, 0.0)
        _momenta(w, tangent, v, Mv, p)
    if ratio <= FARTHEST:
        for j in range(s):
            interpolate(c, 1.0 + ratio * c[j], v_previous, weights, v_trial[j])
            interpolate(c, 1.0 + ratio * c[j], r_previous, weights, r_trial[j])
    else:
        code = _momentum_rates(f, w, t, q, v, tangent, Mv, _vector(memory, s, n, SHIFTED), rate)
        if code != DONE:
            return Attempt(code, np.inf, 0.0)
        for j in range(s):
            copy(v, v_trial[j])
            copy(rate, r_trial[j])
    code, off = _iterate(f, w, options, memory, tolerances, t, h, q, v, p, v_trial, r_trial, q1, p1, v1, rest)
    if code != DONE:
        return Attempt(code, np.inf, 0.0)
    error = 0.0
    if tolerances[ESTIMATE] == 1.0:
        copy(q1, q_full)
        copy(v1, v_full)
        g = 0.5 * h
        for j in range(s):
            interpolate(c, 0.5 * c[j], v_trial, weights, v_half[j])
            interpolate(c, 0.5 * c[j], r_trial, weights, r_half[j])
        code, off_mid = _iterate(
            f, w, options, memory, tolerances, t, g, q, v, p, v_half, r_half, q_mid, p_mid, v_mid, rest
        )
        if code != DONE:
            return Attempt(code, np.inf, 0.0)
        for j in range(s):
            interpolate(c, 0.5 + 0.5 * c[j], v_trial, weights, v_half[j])
            interpolate(c, 0.5 + 0.5 * c[j], r_trial, weights, r_half[j])
        code, off = _iterate(
            f, w, options, memory, tolerances, t + g, g, q_mid, v_mid, p_mid, v_half, r_half, q1, p1, v1, rest
        )
        if code != DONE:
            return Attempt(code, np.inf, 0.0)
        off = max(off, off_mid)  # of the two half steps, from which the run goes on
        code, error = conclude(
            f, w, options[EXTRAPOLATION], options[INNER_TOL], t + h, tolerances, q, v, q_full, v_full, q1, v1
        )
        if code != DONE:
            return Attempt(code, np.inf, 0.0)
    code = accelerations(f, w, t + h, q1, v1, a1, lam1)
    memory[HAS_TRIAL] = 1.0
    memory[H_TRIAL] = h
    return Attempt(code, max(error, off), 0.0)


MOMENTA = Step(momenta_step, settle_momenta)
