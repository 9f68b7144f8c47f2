"""Implicit Runge-Kutta steps whose outer loop is Newton's method: for stiff problems, where sweeps need tiny steps.

The unknowns are the stage accelerations a_j of the independent coordinates, as in `sweep_accelerations`:

    r_j = F(t_j, Q_j, V_j) - a_j = 0,  Q_j = q + c_j h v + h^2 sum_k (A A)_jk a_k,  V_j = v + h sum_k A_jk a_k,

F being the two-loop right side. With J_q, J_v, its derivatives by q_i and v_i at one state (simplified Newton), the
corrections solve (I - h^2 A A x J_q - h A x J_v) d = r. In the eigenvectors of A this falls apart into one real
(n_dof, n_dof) system I - (h l)^2 J_q - h l J_v for each real eigenvalue l and one complex for each pair, half the size
of those of a first-order form (Hairer & Wanner, Solving ODEs II, IV.8, for Radau IIA).
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from twoloop.kernels.common import (
    ATOL,
    DONE,
    ESTIMATE,
    N_FACTORIZATIONS,
    N_JACOBIANS,
    N_OUTER,
    N_PARTITIONS,
    OUTER_DIVERGED,
    RTOL,
    SINGULAR,
    STEP,
    compiled,
    inlined,
    kernel,
)
from twoloop.kernels.inner import accelerations, evaluate, restore
from twoloop.kernels.linalg import copy, lu_factor, lu_solve
from twoloop.kernels.runge_kutta import FARTHEST, INNER_TOL, N_SCALARS, OUTER_TOL, interpolate, tableau_of

MAX_ITERATIONS = 15
SLOW = 0.05  # contraction above which the derivatives are renewed before the next step
STAGNATION = 0.1  # of the step tolerance: corrections of this size that no longer shrink are rounding
STAGNATION_FIXED = 1e-9  # the same for fixed steps, relative to max(1, |value|)
DIFFERENCE = 1e-7  # displacement for the derivatives, relative to max(1, |value|)

# `options` is that of runge_kutta.py, then these scalars, the weights e (s) of the estimate and for each eigenvalue
# its real and imaginary part, the row of T^-1 and the column of T that belong to it (s real, s imaginary parts each)
N_REAL, N_PAIRS, GAMMA0, N_EIGEN_SCALARS = range(4)

# places in `memory`: advance() sets LAST_ACCEPTED after every attempt
(
    LAST_ACCEPTED,
    HAS_TRIAL,
    H_TRIAL,
    HAS_PREVIOUS,
    H_PREVIOUS,
    HAS_JACOBIAN,
    FRESH,  # the derivatives are those of the present state
    PARTITION_NUMBER,
    H_FACTORED,
    CONTRACTION,  # of the last iteration
    DAMPED,  # 0: J_v = 0
    ERROR_BEFORE,
    N_MEMORY_SCALARS,
) = range(13)
PREVIOUS, TRIAL, RESIDUAL, Q_STAGE, V_STAGE, N_BLOCKS = range(6)
A_NEW, Q_MOVED, V_MOVED, E_Q, E_V, Q_MID, V_MID, A_MID, N_VECTORS = range(9)


def memory_size(n_eigenvalues: int, s: int, n_q: int) -> int:
    """Length of `memory`: scalars, stage blocks, vectors, J_q, J_v, a filter matrix, complex ones with their pivots."""
    matrices = 3 + 2 * n_eigenvalues
    return (
        N_MEMORY_SCALARS + N_BLOCKS * s * n_q + N_VECTORS * n_q + matrices * n_q * n_q + (3 + n_eigenvalues) * n_q + s
    )


def newton_options(A: NDArray[np.float64], b: NDArray[np.float64], c: NDArray[np.float64]) -> NDArray[np.float64]:
    """The part of `options` that Newton's method needs besides runge_kutta.options_array.

    Raises
    ------
    ValueError
        If A has too few eigenvectors.
    """
    values, T = np.linalg.eig(A)
    if np.linalg.cond(T) > 1e8:
        raise ValueError("tableau has no basis of eigenvectors, as outer='newton' needs")
    inverse = np.linalg.inv(T)
    real = [k for k in range(len(b)) if values[k].imag == 0.0]
    pairs = [k for k in range(len(b)) if values[k].imag > 0.0]
    gamma0 = float(values[real[0]].real) if real else float(np.abs(values).min())
    parts: list[Any] = [[len(real), len(pairs), gamma0], _estimate_weights(b, c, gamma0)]
    for k in real + pairs:
        row, column = inverse[k], T[:, k]
        parts += [[values[k].real, values[k].imag], row.real, row.imag, column.real, column.imag]
    return np.concatenate([np.asarray(part, dtype=np.float64) for part in parts])


def _estimate_weights(b: NDArray[np.float64], c: NDArray[np.float64], gamma0: float) -> NDArray[np.float64]:
    """Weights e: gamma0 f(y_n) + sum_j e_j f(Y_j) is a quadrature of order s less the method's own.

    Hairer & Wanner II, (IV.8.16). With c_1 = 0 the stages hold f(y_n) already: then the last stage is left out.
    """
    s = len(b)
    moments = 1.0 / np.arange(1.0, s + 1.0)
    if c[0] > 1e-10:
        moments[0] -= gamma0
        embedded = np.linalg.solve(np.vander(c, increasing=True).T, moments)
    else:
        embedded = np.zeros(s)
        embedded[:-1] = np.linalg.solve(np.vander(c[:-1], increasing=True).T, moments[:-1])
        embedded[0] -= gamma0
    return np.asarray(embedded - b)


@inlined
def _block(memory, s, n, which):
    start = N_MEMORY_SCALARS + which * s * n
    return memory[start : start + s * n].reshape((s, n))


@inlined
def _vector(memory, s, n, which):
    start = N_MEMORY_SCALARS + (N_BLOCKS * s + which) * n
    return memory[start : start + n]


@inlined
def _matrix(memory, s, n, m, which):
    """J_q, J_v, then the filter: (m, m)."""
    start = N_MEMORY_SCALARS + (N_BLOCKS * s + N_VECTORS + which * n) * n
    return memory[start : start + m * m].reshape((m, m))


@inlined
def _system(memory, s, n, m, k):
    """Factors for the k-th eigenvalue, complex (m, m), and its pivots."""
    start = N_MEMORY_SCALARS + (N_BLOCKS * s + N_VECTORS + (3 + 2 * k) * n) * n
    return memory[start : start + 2 * m * m].view(np.complex128).reshape((m, m))


@inlined
def _tail(memory, s, n, n_eigen, k):
    """The k-th vector (n) behind the matrices: 0 ... n_eigen pivots (the filter's first), then a complex one."""
    start = N_MEMORY_SCALARS + (N_BLOCKS * s + N_VECTORS + (3 + 2 * n_eigen) * n) * n + k * n
    return memory[start : start + n]


@inlined
def _eigen(options, s):
    """First place of the eigenvalue scalars."""
    return N_SCALARS + 2 * s * s + 3 * s


JQ, JV, FILTER = range(3)


@compiled
def _derivatives(f, w, options, memory, s, t, q, v, a):
    """J_q and J_v at (t, q, v) by differences of the two-loop right side, whose value there is a."""
    n = q.size
    m = w.independent.size
    Jq, Jv = _matrix(memory, s, n, m, JQ), _matrix(memory, s, n, m, JV)
    q_moved, v_moved = _vector(memory, s, n, Q_MOVED), _vector(memory, s, n, V_MOVED)
    a_new = _vector(memory, s, n, A_NEW)
    w.counters[N_JACOBIANS] += 1
    for column in range(m):
        j = w.independent[column]
        copy(q, q_moved)
        copy(v, v_moved)
        q_moved[j] += DIFFERENCE * max(1.0, abs(q[j]))
        size = q_moved[j] - q[j]
        code = evaluate(f, w, t, q_moved, v_moved, options[INNER_TOL], a_new, w.lam)
        if code != DONE:
            return code
        for row in range(m):
            i = w.independent[row]
            Jq[row, column] = (a_new[i] - a[i]) / size
    # one displacement of all velocities tells whether there is anything to difference
    copy(q, q_moved)
    for column in range(m):
        j = w.independent[column]
        v_moved[j] = v[j] + DIFFERENCE * max(1.0, abs(v[j])) * (1.0 + 0.37 * (column % 7))
    code = evaluate(f, w, t, q_moved, v_moved, options[INNER_TOL], a_new, w.lam)
    if code != DONE:
        return code
    memory[DAMPED] = 0.0
    for i in w.independent:
        if a_new[i] != a[i]:
            memory[DAMPED] = 1.0
    if memory[DAMPED] == 0.0:
        return DONE
    for column in range(m):
        j = w.independent[column]
        copy(q, q_moved)
        copy(v, v_moved)
        v_moved[j] += DIFFERENCE * max(1.0, abs(v[j]))
        size = v_moved[j] - v[j]
        code = evaluate(f, w, t, q_moved, v_moved, options[INNER_TOL], a_new, w.lam)
        if code != DONE:
            return code
        for row in range(m):
            i = w.independent[row]
            Jv[row, column] = (a_new[i] - a[i]) / size
    return DONE


@compiled
def _factor(w, options, memory, s, h):
    """Factors of I - (h l)^2 J_q - h l J_v for every eigenvalue l, and for gamma0."""
    n = w.Q.size
    m = w.independent.size
    Jq, Jv = _matrix(memory, s, n, m, JQ), _matrix(memory, s, n, m, JV)
    place = _eigen(options, s)
    n_eigen = int(options[place + N_REAL] + options[place + N_PAIRS])
    damped = memory[DAMPED] == 1.0
    filter_matrix = _matrix(memory, s, n, m, FILTER)
    hl = h * options[place + GAMMA0]
    for i in range(m):
        for j in range(m):
            filter_matrix[i, j] = -hl * hl * Jq[i, j]
            if damped:
                filter_matrix[i, j] -= hl * Jv[i, j]
        filter_matrix[i, i] += 1.0
    pivots = _tail(memory, s, n, n_eigen, 0).view(np.int64)
    w.counters[N_FACTORIZATIONS] += 1
    if not lu_factor(filter_matrix, pivots) > 0.0:
        return SINGULAR
    place += N_EIGEN_SCALARS + s
    for k in range(n_eigen):
        z = h * complex(options[place], options[place + 1])
        place += 2 + 4 * s
        matrix = _system(memory, s, n, m, k)
        for i in range(m):
            for j in range(m):
                matrix[i, j] = -z * z * Jq[i, j]
                if damped:
                    matrix[i, j] -= z * Jv[i, j]
            matrix[i, i] += 1.0
        pivots = _tail(memory, s, n, n_eigen, 1 + k).view(np.int64)
        w.counters[N_FACTORIZATIONS] += 1
        if not lu_factor(matrix, pivots) > 0.0:
            return SINGULAR
    memory[H_FACTORED] = h
    return DONE


@compiled
def _correct(w, options, memory, s, residual, A_stage):
    """Solve for the corrections of the stage accelerations and add them; `residual` becomes the corrections."""
    n = w.Q.size
    m = w.independent.size
    place = _eigen(options, s)
    n_real = int(options[place + N_REAL])
    n_eigen = n_real + int(options[place + N_PAIRS])
    start = N_MEMORY_SCALARS + (N_BLOCKS * s + N_VECTORS + (3 + 2 * n_eigen) * n) * n + (1 + n_eigen) * n
    x = memory[start : start + 2 * m].view(np.complex128)
    place += N_EIGEN_SCALARS + s
    d = _block(memory, s, n, Q_STAGE)  # free between two evaluations
    d[:, :] = 0.0
    for k in range(n_eigen):
        row = place + 2
        column = row + 2 * s
        place += 2 + 4 * s
        for i in range(m):
            total = complex(0.0, 0.0)
            for j in range(s):
                total += complex(options[row + j], options[row + s + j]) * residual[j, w.independent[i]]
            x[i] = total
        lu_solve(_system(memory, s, n, m, k), _tail(memory, s, n, n_eigen, 1 + k).view(np.int64), x)
        twice = 1.0 if k < n_real else 2.0
        for j in range(s):
            re, im = options[column + j], options[column + s + j]
            for i in range(m):
                d[j, w.independent[i]] += twice * (re * x[i].real - im * x[i].imag)
    for j in range(s):
        for i in w.independent:
            residual[j, i] = d[j, i]
            A_stage[j, i] += d[j, i]


@compiled
def _iterate(f, w, options, memory, t, h, tolerances, q, v, A_stage):
    """Newton's method for the stage accelerations, predicted in A_stage: DONE, or why not."""
    s, A, A2, _, _, c = tableau_of(options)
    n = q.size
    residual = _block(memory, s, n, RESIDUAL)
    Q_stage, V_stage = _block(memory, s, n, Q_STAGE), _block(memory, s, n, V_STAGE)
    a_new = _vector(memory, s, n, A_NEW)
    before = 0.0
    floor = STAGNATION_FIXED
    if tolerances[ESTIMATE] == 1.0:
        floor = STAGNATION * min(tolerances[ATOL], tolerances[RTOL])
    for iteration in range(MAX_ITERATIONS):
        w.counters[N_OUTER] += 1
        for j in range(s):
            for m in range(n):
                in_q = 0.0
                in_v = 0.0
                for k in range(s):
                    in_q += A2[j, k] * A_stage[k, m]
                    in_v += A[j, k] * A_stage[k, m]
                Q_stage[j, m] = q[m] + c[j] * h * v[m] + h * h * in_q
                V_stage[j, m] = v[m] + h * in_v
        for j in range(s):
            code = evaluate(f, w, t + c[j] * h, Q_stage[j], V_stage[j], options[INNER_TOL], a_new, w.lam)
            if code != DONE:
                return code
            for m in range(n):
                residual[j, m] = a_new[m] - A_stage[j, m]
                A_stage[j, m] = a_new[m]
            for m in w.independent:
                A_stage[j, m] -= residual[j, m]
        change = 0.0
        scale_q, scale_v = 1.0, 1.0
        for j in range(s):
            for m in w.independent:
                scale_q = max(scale_q, abs(Q_stage[j, m]))
                scale_v = max(scale_v, abs(V_stage[j, m]))
        _correct(w, options, memory, s, residual, A_stage)
        for j in range(s):
            for m in w.independent:
                in_q = 0.0
                in_v = 0.0
                for k in range(s):
                    in_q += A2[j, k] * residual[k, m]
                    in_v += A[j, k] * residual[k, m]
                change = max(change, h * abs(in_v) / scale_v, h * h * abs(in_q) / scale_q)
        if not np.isfinite(change):
            return OUTER_DIVERGED
        if iteration > 0:
            contraction = change / before if before > 0.0 else 0.0
            memory[CONTRACTION] = contraction
            if contraction >= 0.9:
                return DONE if change <= floor else OUTER_DIVERGED
            if contraction / (1.0 - contraction) * change <= options[OUTER_TOL]:
                return DONE
            # will it get there in time?
            left = MAX_ITERATIONS - 1 - iteration
            if change * contraction**left / (1.0 - contraction) > max(options[OUTER_TOL], floor):
                return OUTER_DIVERGED
        elif change <= 1e-3 * options[OUTER_TOL]:
            return DONE
        before = change
    return DONE if before <= floor else OUTER_DIVERGED


@compiled
def _estimate(w, options, memory, h, tolerances, q, v, a, A_stage, q1, v1):
    """Largest component, over atol + rtol |value|, of the embedded error estimate, filtered for stiff components."""
    s, A, _, _, _, _ = tableau_of(options)
    n = q.size
    m = w.independent.size
    place = _eigen(options, s)
    gamma0 = options[place + GAMMA0]
    n_eigen = int(options[place + N_REAL] + options[place + N_PAIRS])
    e = options[place + N_EIGEN_SCALARS : place + N_EIGEN_SCALARS + s]
    e_q, e_v = _vector(memory, s, n, E_Q), _vector(memory, s, n, E_V)
    Jq = _matrix(memory, s, n, m, JQ)
    for i in range(m):
        j = w.independent[i]
        in_q = gamma0 * v[j]
        in_v = gamma0 * a[j]
        for k in range(s):
            speed = v[j]
            for l in range(s):
                speed += h * A[k, l] * A_stage[l, j]
            in_q += e[k] * speed
            in_v += e[k] * A_stage[k, j]
        e_q[i] = h * in_q
        e_v[i] = h * in_v
    for i in range(m):
        total = 0.0
        for j in range(m):
            total += Jq[i, j] * e_q[j]
        e_v[i] += h * gamma0 * total
    lu_solve(_matrix(memory, s, n, m, FILTER), _tail(memory, s, n, n_eigen, 0).view(np.int64), e_v[:m])
    error = 0.0
    for i in range(m):
        j = w.independent[i]
        in_q = e_q[i] + h * gamma0 * e_v[i]
        error = max(error, abs(in_q) / (tolerances[ATOL] + tolerances[RTOL] * max(abs(q[j]), abs(q1[j]))))
        error = max(error, abs(e_v[i]) / (tolerances[ATOL] + tolerances[RTOL] * max(abs(v[j]), abs(v1[j]))))
    return error


@kernel(STEP)
def newton_step(f, w, options, memory, t, h, tolerances, state, new_state):
    """One attempt with Newton's method as the outer loop and an embedded estimate of the error."""
    s, _, _, b, bA, c = tableau_of(options)
    n = w.Q.size
    q, v, a = state[:n], state[n : 2 * n], state[2 * n : 3 * n]
    q1, v1, a1, lam1 = new_state[:n], new_state[n : 2 * n], new_state[2 * n : 3 * n], new_state[3 * n :]
    previous, trial = _block(memory, s, n, PREVIOUS), _block(memory, s, n, TRIAL)
    weights = memory[memory.size - s :]
    q_mid, v_mid, a_mid = _vector(memory, s, n, Q_MID), _vector(memory, s, n, V_MID), _vector(memory, s, n, A_MID)
    if memory[LAST_ACCEPTED] == 1.0:
        memory[FRESH] = 0.0
        if memory[HAS_TRIAL] == 1.0:
            for j in range(s):
                copy(trial[j], previous[j])
            memory[H_PREVIOUS] = memory[H_TRIAL]
            memory[HAS_PREVIOUS] = 1.0
    memory[HAS_TRIAL] = 0.0
    if memory[PARTITION_NUMBER] != w.counters[N_PARTITIONS]:
        memory[HAS_JACOBIAN] = 0.0
        memory[PARTITION_NUMBER] = w.counters[N_PARTITIONS]
    if memory[FRESH] == 0.0 and memory[CONTRACTION] > SLOW:
        memory[HAS_JACOBIAN] = 0.0
    while True:
        if memory[HAS_JACOBIAN] == 0.0:
            # stiff directions turn as the body moves: halfway they are at most half a step's turn from any stage's
            for m in range(n):
                q_mid[m] = q[m] + 0.5 * h * (v[m] + 0.25 * h * a[m])
                v_mid[m] = v[m] + 0.5 * h * a[m]
            code = evaluate(f, w, t + 0.5 * h, q_mid, v_mid, options[INNER_TOL], a_mid, w.lam)
            if code != DONE:
                return code, np.inf
            code = _derivatives(f, w, options, memory, s, t + 0.5 * h, q_mid, v_mid, a_mid)
            if code != DONE:
                return code, np.inf
            memory[HAS_JACOBIAN] = 1.0
            memory[FRESH] = 1.0
            memory[H_FACTORED] = 0.0
        if memory[H_FACTORED] != h:
            code = _factor(w, options, memory, s, h)
            if code != DONE:
                memory[HAS_JACOBIAN] = 0.0
                return code, np.inf
        ratio = h / memory[H_PREVIOUS] if memory[HAS_PREVIOUS] == 1.0 else np.inf
        for j in range(s):
            if ratio <= FARTHEST:
                interpolate(c, 1.0 + ratio * c[j], previous, weights, trial[j])
            else:
                copy(a, trial[j])
        code = _iterate(f, w, options, memory, t, h, tolerances, q, v, trial)
        if code == DONE:
            break
        if memory[FRESH] == 1.0:
            return code, np.inf
        memory[HAS_JACOBIAN] = 0.0
    for m in range(n):
        in_q = 0.0
        in_v = 0.0
        for k in range(s):
            in_q += bA[k] * trial[k, m]
            in_v += b[k] * trial[k, m]
        q1[m] = q[m] + h * v[m] + h * h * in_q
        v1[m] = v[m] + h * in_v
    code = restore(f, w, t + h, q1, v1, options[INNER_TOL])
    if code != DONE:
        return code, np.inf
    error = 0.0
    if tolerances[ESTIMATE] == 1.0:
        error = _estimate(w, options, memory, h, tolerances, q, v, a, trial, q1, v1)
    code = accelerations(f, w, t + h, q1, v1, a1, lam1)
    memory[HAS_TRIAL] = 1.0
    memory[H_TRIAL] = h
    return code, error
