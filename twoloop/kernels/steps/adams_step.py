"""Attempt steps of the Adams methods of orders 1 to 12: predict, evaluate, correct, evaluate, for all coordinates.

Order and step size are variable. The history consists of modified divided differences phi_i of the accelerations, as in
Krogh's DVDQ and Shampine and Gordon's STEP, here for second-order equations: velocities are the integral of the
polynomial through the accelerations, and positions are its double integral. The first evaluation is at the predicted
state, which is near the constraints, but not on them; the second is at the corrected state, projected onto the
constraints. Differences of all coordinates are stored, so that a new partition needs no conversion.

Notation: t_n are the times of accepted steps, h = t_{n+1} - t_n, psi_i(n) = t_n - t_{n-i}, psi_0 = 0; i counts from 1,
as in the literature. At the time t_n + s h, the polynomial through the last k accelerations is the sum over i of
c_i(s) beta_i phi_i(n), with beta_i = prod_{j<i} psi_j(n+1) / psi_j(n) and
c_i(s) = prod_{j=0}^{i-2} (s h + psi_j(n)) / psi_{j+1}(n+1). Its integrals have the coefficients g_i = int c_i ds for
velocities, and G_i = int (1 - s) c_i ds for positions. `f` is the kit, and `w` the workspace.
"""

import numpy as np

from twoloop.kernels.control.step_size import prediction_error, store_prediction
from twoloop.kernels.data.common import ATTEMPT, COMMIT, Attempt, Step, inlined, kernel, merged
from twoloop.kernels.data.indices import ATOL, DONE, RTOL
from twoloop.kernels.evaluation.inner_loop import evaluate_without_projection, project

HIGHEST = 12  # largest order, as in Shampine and Gordon's STEP; the quadrature with NODES would be exact even for 13
N_TERMS = HIGHEST + 2  # number of stored differences of accelerations; each has a coefficient for v and one for q
ERROR_FACTOR = 5.0  # factor on the error estimate, because the errors of many short steps add up
SAFETY = 0.8  # safety factor: ratio of the next step size to the size for which the estimate would equal the tolerance
GROWTH, SHRINKAGE = 1.2, 0.5  # largest ratio of successive step sizes; smallest ratio after a rejected step
START_GROWTH = 2.0  # largest ratio of successive step sizes while the order still rises with every step
LEAST_FACTOR = 0.1  # smallest ratio of successive step sizes if a predicted position is far from the constraints
RESTART_AFTER = 3  # number of successive rejected steps after which the method restarts with order 1

# eight Gauss nodes on [0, 1] and their weights: this quadrature is exact for polynomials up to degree 15
NODES, WEIGHTS = (0.5 * (1.0 + x) if k == 0 else 0.5 * x for k, x in enumerate(np.polynomial.legendre.leggauss(8)))
POSITION_WEIGHTS = WEIGHTS * (1.0 - NODES)  # weights with which c(s) at NODES yields the integral of (1 - s) c(s)


def _error_constants():
    """Return the error constants |g_k - g_{k+1}| of equal steps for orders k = 0 ... HIGHEST (g: see module docstring).

    The estimated velocity error is h |g_k - g_{k+1}| d, where d are the evaluated minus the predicted accelerations.
    """
    coefficients = np.ones(HIGHEST + 1)
    for k in range(1, HIGHEST + 1):
        coefficients[k] = -np.sum(coefficients[:k] / np.arange(k + 1.0, 1.0, -1.0))
    return np.abs(coefficients)


# error constants of equal steps. They replace smaller constants for the actual step sizes: after a decrease of the step
# size, error estimates with smaller constants would miss jumps of forces
ERROR_CONSTANTS = _error_constants()

THETA, N_OPTIONS = range(2)  # THETA: index in `options` of the tolerance of projections, see `project`
# indices of the scalars in `memory`. After the scalars, `memory` contains N_ROWS rows of coefficients, two tables of
# differences, and two scratch rows, see _row, _difference_table and _scratch_rows
(
    CURRENT,  # index (0 or 1) of the table of differences of the last accepted step; an attempt fills the other table
    ORDER,  # order of the next attempt
    DEPTH,  # number of accelerations in the history, at most N_TERMS
    AGE,  # number of accepted steps since the last change of the order or the last rejected step
    STARTING,  # 1: the history has just begun, and the order rises with every step; 0: error estimates choose the order
    FAILED,  # number of successive rejected attempts
    NEXT_ORDER,  # order chosen at the end of an attempt for the next one
    N_SCALARS,
) = range(8)
# indices of rows in `memory`. PSI: times (s) from earlier states to the last state. NEW_PSI: times from these states to
# the end of the step. BETA: factors that adapt differences to the step size. G_VELOCITY, G_POSITION: coefficients g_i
# (for v) and G_i (for q) of the differences. C_AT_NODES: scratch for c_i(s) at NODES
PSI, NEW_PSI, BETA, G_VELOCITY, G_POSITION, C_AT_NODES, N_ROWS = range(7)


def memory_size(n_q: int) -> int:
    """Return the length of `memory` for n_q coordinates."""
    return N_SCALARS + N_ROWS * (N_TERMS + 2) + 2 * (N_TERMS + 1) * _padded_size(n_q) + 2 * _padded_size(n_q)


def _padded_size(n_q: int) -> int:
    return (n_q + 3) // 4 * 4


@inlined
def _row(memory, index):
    """Return a view (N_TERMS + 2) of a row of coefficients in `memory`; `index` is the row's index, such as PSI."""
    start = N_SCALARS + index * (N_TERMS + 2)
    return memory[start : start + N_TERMS + 2]


@inlined
def _difference_table(memory, n, index):
    """Return a view of difference table `index` (0 or 1): N_TERMS + 1 rows of n entries, padded to a multiple of 4.

    Row i - 1 contains the predicted difference phi_i of accelerations. The last row is the correction to add to each.
    """
    width = (n + 3) // 4 * 4
    start = N_SCALARS + N_ROWS * (N_TERMS + 2) + int(index) * (N_TERMS + 1) * width
    return memory[start : start + (N_TERMS + 1) * width].reshape((N_TERMS + 1, width))


@inlined
def _scratch_rows(memory, n):
    """Return two padded scratch rows (n): first for mean accelerations in a step, later for 1 / (allowed errors)."""
    width = (n + 3) // 4 * 4
    start = N_SCALARS + N_ROWS * (N_TERMS + 2) + 2 * (N_TERMS + 1) * width
    return memory[start : start + width], memory[start + width : start + 2 * width]


@kernel(COMMIT)
def commit_adams(f, w, options, memory, tolerances, accepted):
    """Add an accepted attempt to the history in `memory`; after a rejected one, reduce the order or restart."""
    if not accepted:
        memory[FAILED] += 1.0
        memory[AGE] = 0.0
        if memory[ORDER] > 1.0:
            memory[STARTING] = 0.0
        memory[ORDER] = min(memory[ORDER], memory[NEXT_ORDER])
        if memory[FAILED] >= RESTART_AFTER:
            memory[DEPTH] = 0.0
        return
    memory[FAILED] = 0.0
    memory[CURRENT] = 1.0 - memory[CURRENT]
    psi, new_psi = _row(memory, PSI), _row(memory, NEW_PSI)
    for i in range(N_TERMS):
        psi[i] = new_psi[i]
    memory[DEPTH] = min(memory[DEPTH] + 1.0, float(N_TERMS))
    memory[AGE] = memory[AGE] + 1.0 if memory[ORDER] == memory[NEXT_ORDER] else 0.0
    memory[ORDER] = memory[NEXT_ORDER]


@merged
def _begin_history(memory, n, state):
    """Reset `memory` to order 1 and a history that contains only the accelerations of `state`."""
    table = _difference_table(memory, n, memory[CURRENT])
    table[:, :] = 0.0
    for m in range(n):
        table[N_TERMS, m] = state[2 * n + m]
    _row(memory, PSI)[:] = 0.0
    memory[ORDER] = memory[DEPTH] = memory[NEXT_ORDER] = 1.0
    memory[STARTING] = 1.0
    memory[FAILED] = memory[AGE] = 0.0


@merged
def _compute_coefficients(memory, h, k):
    """Store the coefficients of a step of size h at order k: the rows NEW_PSI to G_POSITION of `memory`."""
    psi, new_psi, beta = _row(memory, PSI), _row(memory, NEW_PSI), _row(memory, BETA)
    g, G, c = _row(memory, G_VELOCITY), _row(memory, G_POSITION), _row(memory, C_AT_NODES)
    new_psi[0] = h
    for i in range(N_TERMS):
        new_psi[i + 1] = psi[i] + h
    beta[0] = 1.0
    for i in range(k):  # first all quotients, then all products, so that the divisions can overlap
        beta[i + 1] = new_psi[i] / psi[i] if psi[i] > 0.0 else 0.0
    for i in range(k):
        beta[i + 1] *= beta[i]
    for m in range(8):
        c[m] = 1.0
    previous_psi = 0.0  # psi_i = t_n - t_{n-i} (s), the duration of the last i accepted steps; psi_0 = 0
    for i in range(k + 2):
        velocity_integral = 0.0
        position_integral = 0.0
        for m in range(8):
            velocity_integral += WEIGHTS[m] * c[m]
            position_integral += POSITION_WEIGHTS[m] * c[m]
        g[i], G[i] = velocity_integral, position_integral
        inverse = 1.0 / new_psi[i]
        for m in range(8):
            c[m] *= (NODES[m] * h + previous_psi) * inverse
        previous_psi = psi[i]


@merged
def _predict_state(memory, h, k, old, new, state, q1, v1, n):
    """From differences `old`, predict (q1, v1) and the differences `new` at the end of a step of size h and order k."""
    beta, g, G = _row(memory, BETA), _row(memory, G_VELOCITY), _row(memory, G_POSITION)
    mean_v, mean_q = _scratch_rows(memory, n)
    for m in range(0, old.shape[1], 4):
        d0, d1, d2, d3 = old[N_TERMS, m], old[N_TERMS, m + 1], old[N_TERMS, m + 2], old[N_TERMS, m + 3]
        # old[k] + d0 is the difference phi_{k+1}; row k + 1 of `new` serves to estimate errors of order k + 1
        b = beta[k]
        new[k + 1, m] = -b * (old[k, m] + d0)
        new[k + 1, m + 1] = -b * (old[k, m + 1] + d1)
        new[k + 1, m + 2] = -b * (old[k, m + 2] + d2)
        new[k + 1, m + 3] = -b * (old[k, m + 3] + d3)
        new[k, m] = 0.0
        new[k, m + 1] = 0.0
        new[k, m + 2] = 0.0
        new[k, m + 3] = 0.0
        e0, e1, e2, e3 = 0.0, 0.0, 0.0, 0.0
        x0, x1, x2, x3 = 0.0, 0.0, 0.0, 0.0
        y0, y1, y2, y3 = 0.0, 0.0, 0.0, 0.0
        for i in range(k - 1, -1, -1):
            b, c, r = beta[i], g[i], G[i]
            p0 = b * (old[i, m] + d0)
            p1 = b * (old[i, m + 1] + d1)
            p2 = b * (old[i, m + 2] + d2)
            p3 = b * (old[i, m + 3] + d3)
            e0 += p0
            e1 += p1
            e2 += p2
            e3 += p3
            x0 += c * p0
            x1 += c * p1
            x2 += c * p2
            x3 += c * p3
            y0 += r * p0
            y1 += r * p1
            y2 += r * p2
            y3 += r * p3
            new[i, m] = e0
            new[i, m + 1] = e1
            new[i, m + 2] = e2
            new[i, m + 3] = e3
        mean_v[m] = x0
        mean_v[m + 1] = x1
        mean_v[m + 2] = x2
        mean_v[m + 3] = x3
        mean_q[m] = y0
        mean_q[m + 1] = y1
        mean_q[m + 2] = y2
        mean_q[m + 3] = y3
    for m in range(n):
        v0 = state[n + m]
        v1[m] = v0 + h * mean_v[m]
        q1[m] = state[m] + h * (v0 + h * mean_q[m])


@merged
def _estimate_error(g, G, h, order, largest_v, largest_q):
    """Return the estimated error of a step of size h by the method of a given order, in units of the tolerances.

    `largest_v`: max|phi / (tolerance of velocity)|; `largest_q`: max|phi / (tolerance of position)|; phi is the
    difference phi_{order+1} of accelerations. g, G: coefficients g_i and G_i, see the module docstring.
    """
    return max(h * abs(g[order - 1] - g[order]) * largest_v, h * h * abs(G[order - 1] - G[order]) * largest_q)


@merged
def _choose_order(memory, h, k, table, d, n):
    """Choose the next order (NEXT_ORDER); return the estimated error, in tolerances, and (next step size) / h.

    The rules are those of STEP (Shampine and Gordon). The order k decreases if errors estimated for lower orders do not
    exceed that for k. It increases if k + 1 steps had order k, and the error for order k + 1 is below that for k. While
    STARTING is 1, it rises in every step. `table`: predicted differences; `d`: evaluated minus predicted accelerations.
    """
    g, G = _row(memory, G_VELOCITY), _row(memory, G_POSITION)
    weight_v, weight_q = _scratch_rows(memory, n)
    v0 = v1 = v2 = v3 = q0 = q1 = q2 = q3 = 0.0
    lower, lowest = max(k - 1, 0), max(k - 2, 0)
    for m in range(n):
        a, b = weight_v[m], weight_q[m]
        x = abs(d[m])
        v0, q0 = max(v0, x * a), max(q0, x * b)
        x = abs(table[lower, m] + d[m])
        v1, q1 = max(v1, x * a), max(q1, x * b)
        x = abs(table[lowest, m] + d[m])
        v2, q2 = max(v2, x * a), max(q2, x * b)
        x = abs(table[k + 1, m] + d[m])
        v3, q3 = max(v3, x * a), max(q3, x * b)
    error = _estimate_error(g, G, h, k, v0, q0)
    below = _estimate_error(g, G, h, k - 1, v1, q1) if k > 1 else np.inf
    far_below = _estimate_error(g, G, h, k - 2, v2, q2) if k > 2 else 0.0
    order, expected = k, error
    if (k > 2 and max(below, far_below) <= error) or (k == 2 and below <= 0.5 * error):
        order, expected = k - 1, below
    is_starting = memory[STARTING] == 1.0 and order == k and k < HIGHEST
    if error <= 1.0:
        memory[STARTING] = 1.0 if is_starting else 0.0
        if is_starting:
            order, expected = k + 1, error
        elif order == k and k < HIGHEST and memory[AGE] >= k + 1 and memory[DEPTH] > k:
            above = _estimate_error(g, G, h, k + 1, v3, q3)
            if k > 1 and below <= min(error, above):
                order, expected = k - 1, below
            elif above < (0.5 * error if k == 1 else error):
                order, expected = k + 1, above
    memory[NEXT_ORDER] = float(order)
    error = max(error, h * ERROR_CONSTANTS[k] * v0)
    if not np.isfinite(error):
        return np.inf, 0.0
    if error > 1.0:
        return error, max(SAFETY * error ** (-1.0 / (k + 1.0)), SHRINKAGE)
    error_root = expected ** (1.0 / (order + 1.0))
    return error, SAFETY / min(max(error_root, SAFETY / (START_GROWTH if is_starting else GROWTH)), 1.0)


@kernel(ATTEMPT, vectorized=True)
def adams_step(f, w, options, memory, t, h, tolerances, state, new_state):
    """Attempt a step of size h by an Adams method; choose the order and the size of the next step."""
    n = w.Q.size
    q, v = state[:n], state[n : 2 * n]
    q1, v1, a1, lam1 = new_state[:n], new_state[n : 2 * n], new_state[2 * n : 3 * n], new_state[3 * n :]
    if memory[DEPTH] == 0.0:
        _begin_history(memory, n, state)
    k = int(memory[ORDER])
    w.n_outer += 1
    old, new = _difference_table(memory, n, memory[CURRENT]), _difference_table(memory, n, 1.0 - memory[CURRENT])
    _compute_coefficients(memory, h, k)
    _predict_state(memory, h, k, old, new, state, q1, v1, n)
    memory[NEXT_ORDER] = max(k - 1.0, 1.0)  # order of the next attempt if an evaluation fails in this one
    code = evaluate_without_projection(f, w, t + h, q1, v1, a1)
    if code != DONE:
        return Attempt(code, np.inf, 0.0)
    weight_v, weight_q = _scratch_rows(memory, n)
    d = new[N_TERMS]
    rtol = tolerances[RTOL]
    for m in range(n):
        d[m] = a1[m] - new[0, m]
    for m in range(n):
        weight_v[m] = ERROR_FACTOR / (tolerances[ATOL + m] + rtol * max(abs(v[m]), abs(v1[m])))
    for m in range(n):
        weight_q[m] = ERROR_FACTOR / (tolerances[ATOL + m] + rtol * max(abs(q[m]), abs(q1[m])))
    error, factor = _choose_order(memory, h, k, new, d, n)
    if not error <= 1.0:
        return Attempt(DONE, error, factor)
    g, G = _row(memory, G_VELOCITY)[k], _row(memory, G_POSITION)[k]
    for m in range(n):
        q1[m] += h * h * G * d[m]
        v1[m] += h * g * d[m]
    store_prediction(w, q1)
    code = project(f, w, t + h, q1, v1, options[THETA], a1, lam1)
    if code != DONE:
        return Attempt(code, np.inf, 0.0)
    for m in range(n):
        d[m] = a1[m] - new[0, m]
    distance = prediction_error(w, tolerances, h, q, v, q1)
    if distance > 0.0:
        factor = min(factor, max(SAFETY / distance, LEAST_FACTOR))
    return Attempt(DONE, max(error, distance), factor)


ADAMS = Step(adams_step, commit_adams)
