"""The linear algebra of newton.py for systems of any structure: (n_dof, n_dof) matrices, J_q and J_v by differences."""

from twoloop.kernels.common import DONE, N_FACTORIZATIONS, N_JACOBIANS, SINGULAR, compiled, inlined
from twoloop.kernels.inner import evaluate
from twoloop.kernels.linalg import copy, lu_factor, lu_solve
from twoloop.kernels.newton_memory import (
    A_NEW,
    BY_Q,
    BY_V,
    DAMPED,
    FILTER,
    GAMMA0,
    N_EIGEN_SCALARS,
    N_REAL,
    Q_MOVED,
    V_MOVED,
    count_eigenvalues,
    eigen_place,
    pivots_of,
    space,
    system_space,
    vector,
)
from twoloop.kernels.runge_kutta import INNER_TOL

DIFFERENCE = 1e-7  # displacement for the derivatives, relative to max(1, |value|)


@inlined
def _square(numbers, m):
    return numbers[: m * m].reshape((m, m))


@compiled
def derivatives(f, w, options, memory, s, t, q, v, a):
    """J_q and J_v at (t, q, v) by differences of the two-loop right side, whose value there is a."""
    n = q.size
    m = w.independent.size
    Jq, Jv = _square(space(memory, s, n, BY_Q), m), _square(space(memory, s, n, BY_V), m)
    q_moved, v_moved = vector(memory, s, n, Q_MOVED), vector(memory, s, n, V_MOVED)
    a_new = vector(memory, s, n, A_NEW)
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
def factor(w, options, memory, s, h):
    """Factors of I - (h l)^2 J_q - h l J_v for gamma0, real, and for the other eigenvalues l, complex."""
    n = w.Q.size
    m = w.independent.size
    Jq, Jv = _square(space(memory, s, n, BY_Q), m), _square(space(memory, s, n, BY_V), m)
    place = eigen_place(options, s)
    n_eigen = count_eigenvalues(options, s)
    n_real = int(options[place + N_REAL])
    damped = memory[DAMPED] == 1.0
    filter_matrix = _square(space(memory, s, n, FILTER), m)
    hl = h * options[place + GAMMA0]
    for i in range(m):
        for j in range(m):
            filter_matrix[i, j] = -hl * hl * Jq[i, j]
            if damped:
                filter_matrix[i, j] -= hl * Jv[i, j]
        filter_matrix[i, i] += 1.0
    w.counters[N_FACTORIZATIONS] += 1
    if not lu_factor(filter_matrix, pivots_of(memory, s, n, n_eigen, 0)) > 0.0:
        return SINGULAR
    place += N_EIGEN_SCALARS + s
    for k in range(n_eigen):
        z = h * complex(options[place], options[place + 1])
        place += 2 + 4 * s
        if k == 0 and n_real > 0:  # the eigenvalue is gamma0
            continue
        matrix = _square(system_space(memory, s, n, k), m)
        for i in range(m):
            for j in range(m):
                matrix[i, j] = -z * z * Jq[i, j]
                if damped:
                    matrix[i, j] -= z * Jv[i, j]
            matrix[i, i] += 1.0
        w.counters[N_FACTORIZATIONS] += 1
        if not lu_factor(matrix, pivots_of(memory, s, n, n_eigen, 1 + k)) > 0.0:
            return SINGULAR
    return DONE


@compiled
def solve(w, options, memory, s, k, x):
    """Solve the k-th eigenvalue's system; x (n_dof) is overwritten."""
    n = w.Q.size
    m = x.size
    n_eigen = count_eigenvalues(options, s)
    if k == 0 and options[eigen_place(options, s) + N_REAL] > 0.0:  # the eigenvalue is gamma0
        real = vector(memory, s, n, V_MOVED)[:m]
        for i in range(m):
            real[i] = x[i].real
        lu_solve(_square(space(memory, s, n, FILTER), m), pivots_of(memory, s, n, n_eigen, 0), real)
        for i in range(m):
            x[i] = real[i]
    else:
        lu_solve(_square(system_space(memory, s, n, k), m), pivots_of(memory, s, n, n_eigen, 1 + k), x)


@compiled
def filter_error(w, options, memory, s, h, e_q, e_v):
    """e_v becomes (I - (h gamma0)^2 J_q - h gamma0 J_v)^-1 (e_v + h gamma0 J_q e_q), all (n_dof)."""
    n = w.Q.size
    m = e_q.size
    n_eigen = count_eigenvalues(options, s)
    gamma0 = options[eigen_place(options, s) + GAMMA0]
    Jq = _square(space(memory, s, n, BY_Q), m)
    for i in range(m):
        total = 0.0
        for j in range(m):
            total += Jq[i, j] * e_q[j]
        e_v[i] += h * gamma0 * total
    lu_solve(_square(space(memory, s, n, FILTER), m), pivots_of(memory, s, n, n_eigen, 0), e_v)
