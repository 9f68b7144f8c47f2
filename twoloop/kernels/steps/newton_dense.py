"""The linear algebra of newton_step.py for systems of any structure: (n_dof, n_dof) matrices.

J_q and J_v come by differences of the two-loop right-hand side. Where the system gives the tangents K and D (see
newton_tangents.py), (T^T M T) J_q = T^T K T with T = [I; -Cqd^-1 Cqi], and J_v likewise: as in newton_banded.py that
leaves out how T and M change with the position and Q_d with the velocity, in which there is no stiffness; fixed steps
in which a body turns by some 0.4 rad on its constraints may then fail where differences of the right-hand side
converge.
"""

from twoloop.kernels.data.codes import DONE, SINGULAR
from twoloop.kernels.data.common import compiled
from twoloop.kernels.data.counters import N_FACTORIZATIONS, N_JACOBIANS
from twoloop.kernels.data.flags import FORCE_BY_Q_GIVEN, FORCE_BY_V_GIVEN
from twoloop.kernels.evaluation.inner_loop import evaluate, find_tangents
from twoloop.kernels.linalg.dense import copy, ldl_factor, ldl_solve_rows, lu_factor, lu_solve
from twoloop.kernels.linalg.markowitz_lu import columns_of
from twoloop.kernels.steps import newton_memory as at
from twoloop.kernels.steps.newton_memory import (
    count_eigenvalues,
    eigen_place,
    pivots_of,
    space,
    square,
    system_space,
    vector,
)
from twoloop.kernels.steps.newton_tangents import DIFFERENCE, displaced_with_all, tangent_by_q, tangent_by_v
from twoloop.kernels.steps.stages import INNER_TOL


@compiled
def reduce(w, A, AT, B):
    """B = T^T A T with T = [I; w.D^T]; AT (n_q, n_dof) is scratch."""
    n, m = AT.shape
    columns = columns_of(w.index)
    for i in range(n):
        for k in range(m):
            AT[i, k] = A[i, w.independent[k]]
        for c in range(columns.size):
            factor = A[i, columns[c]]
            if factor != 0.0:
                for k in range(m):
                    AT[i, k] += factor * w.D[k, c]
    for l in range(m):
        copy(AT[w.independent[l]], B[l])
        for c in range(columns.size):
            factor = w.D[l, c]
            if factor != 0.0:
                row = AT[columns[c]]
                for k in range(m):
                    B[l, k] += factor * row[k]


@compiled
def _from_tangents(f, w, memory, s, t, q, v):
    """J_q and J_v from the tangents that the system gives, at a state that was evaluated just before."""
    n = q.size
    m = w.independent.size
    w.counters[N_JACOBIANS] += 1
    # factors are not needed any more: their spaces hold K or D, then T^T M T and T^T A
    K, R = square(space(w, n, at.FILTER), n), square(space(w, n, at.SYSTEMS), n)
    code = tangent_by_q(f, w, t, q, v, n - 1, vector(memory, s, n, at.Q_MOVED), K, R)
    if code != DONE:
        return code
    AT = space(w, n, at.SYSTEMS + 1)[: n * m].reshape((n, m))
    code = find_tangents(f, w, t, q)
    if code != DONE:
        return code
    Jq, Jv = square(space(w, n, at.BY_Q), m), square(space(w, n, at.BY_V), m)
    N = square(space(w, n, at.SYSTEMS), m)
    reduce(w, w.M, AT, N)
    if not ldl_factor(N):
        return SINGULAR
    reduce(w, K, AT, Jq)
    ldl_solve_rows(N, Jq)
    memory[at.DAMPED] = f.flags[FORCE_BY_V_GIVEN]
    code = tangent_by_v(f, t, q, v, n - 1, K)
    if code == DONE and memory[at.DAMPED] == 1.0:
        reduce(w, K, AT, Jv)
        ldl_solve_rows(N, Jv)
    return code


@compiled
def derivatives(f, w, options, memory, s, t, q, v, a):
    """J_q and J_v at (t, q, v), where the value of the two-loop right-hand side, evaluated just before, is a."""
    if f.flags[FORCE_BY_Q_GIVEN] == 1 and w.Rate.size == w.C.size:
        return _from_tangents(f, w, memory, s, t, q, v)
    n = q.size
    m = w.independent.size
    Jq, Jv = square(space(w, n, at.BY_Q), m), square(space(w, n, at.BY_V), m)
    q_moved, v_moved = vector(memory, s, n, at.Q_MOVED), vector(memory, s, n, at.V_MOVED)
    a_new = vector(memory, s, n, at.A_NEW)
    w.counters[N_JACOBIANS] += 1
    for column in range(m):
        j = w.independent[column]
        copy(q, q_moved)
        copy(v, v_moved)
        q_moved[j] += DIFFERENCE * max(1.0, abs(q[j]))
        size = q_moved[j] - q[j]
        code = evaluate(f, w, t, q_moved, v_moved, options[INNER_TOL], a_new)
        if code != DONE:
            return code
        for row in range(m):
            i = w.independent[row]
            Jq[row, column] = (a_new[i] - a[i]) / size
    # one displacement of all velocities tells whether there is anything to difference
    copy(q, q_moved)
    for column in range(m):
        j = w.independent[column]
        v_moved[j] = displaced_with_all(v[j], column)
    code = evaluate(f, w, t, q_moved, v_moved, options[INNER_TOL], a_new)
    if code != DONE:
        return code
    memory[at.DAMPED] = 0.0
    for i in w.independent:
        if a_new[i] != a[i]:
            memory[at.DAMPED] = 1.0
    if memory[at.DAMPED] == 0.0:
        return DONE
    for column in range(m):
        j = w.independent[column]
        copy(q, q_moved)
        copy(v, v_moved)
        v_moved[j] += DIFFERENCE * max(1.0, abs(v[j]))
        size = v_moved[j] - v[j]
        code = evaluate(f, w, t, q_moved, v_moved, options[INNER_TOL], a_new)
        if code != DONE:
            return code
        for row in range(m):
            i = w.independent[row]
            Jv[row, column] = (a_new[i] - a[i]) / size
    return DONE


@compiled
def factor_filter(w, options, memory, s, h):
    """Factors of I - z^2 J_q - z J_v, z = h gamma0."""
    n = w.Q.size
    m = w.independent.size
    Jq, Jv = square(space(w, n, at.BY_Q), m), square(space(w, n, at.BY_V), m)
    matrix = square(space(w, n, at.FILTER), m)
    z = h * options[eigen_place(s) + at.GAMMA0]
    for i in range(m):
        for j in range(m):
            matrix[i, j] = -z * z * Jq[i, j]
            if memory[at.DAMPED] == 1.0:
                matrix[i, j] -= z * Jv[i, j]
        matrix[i, i] += 1.0
    w.counters[N_FACTORIZATIONS] += 1
    return DONE if lu_factor(matrix, pivots_of(memory, s, n, 0)) > 0.0 else SINGULAR


@compiled
def factor(w, options, memory, s, h):
    """Factors of I - (h l)^2 J_q - h l J_v for gamma0, real, and for the other eigenvalues l, complex."""
    n = w.Q.size
    m = w.independent.size
    Jq, Jv = square(space(w, n, at.BY_Q), m), square(space(w, n, at.BY_V), m)
    place = eigen_place(s)
    n_eigen = count_eigenvalues(options, s)
    n_real = int(options[place + at.N_REAL])
    damped = memory[at.DAMPED] == 1.0
    code = factor_filter(w, options, memory, s, h)
    if code != DONE:
        return code
    place += at.N_EIGEN_SCALARS + s
    for k in range(n_eigen):
        z = h * complex(options[place], options[place + 1])
        place += 2 + 4 * s
        if k == 0 and n_real > 0:  # the eigenvalue is gamma0
            continue
        matrix = square(system_space(w, n, k), m)
        for i in range(m):
            for j in range(m):
                matrix[i, j] = -z * z * Jq[i, j]
                if damped:
                    matrix[i, j] -= z * Jv[i, j]
            matrix[i, i] += 1.0
        w.counters[N_FACTORIZATIONS] += 1
        if not lu_factor(matrix, pivots_of(memory, s, n, 1 + k)) > 0.0:
            return SINGULAR
    return DONE


@compiled
def solve(w, options, memory, s, k, x):
    """Solve the k-th eigenvalue's system; x (n_dof) is overwritten."""
    n = w.Q.size
    m = x.size
    if k == 0 and options[eigen_place(s) + at.N_REAL] > 0.0:  # the eigenvalue is gamma0
        real = vector(memory, s, n, at.V_MOVED)[:m]
        for i in range(m):
            real[i] = x[i].real
        lu_solve(square(space(w, n, at.FILTER), m), pivots_of(memory, s, n, 0), real)
        for i in range(m):
            x[i] = real[i]
    else:
        lu_solve(square(system_space(w, n, k), m), pivots_of(memory, s, n, 1 + k), x)


@compiled
def filter_error(w, options, memory, s, h, e_q, e_v):
    """e_v becomes (I - (h gamma0)^2 J_q - h gamma0 J_v)^-1 (e_v + h gamma0 J_q e_q), all (n_dof)."""
    n = w.Q.size
    m = e_q.size
    gamma0 = options[eigen_place(s) + at.GAMMA0]
    Jq = square(space(w, n, at.BY_Q), m)
    for i in range(m):
        total = 0.0
        for j in range(m):
            total += Jq[i, j] * e_q[j]
        e_v[i] += h * gamma0 * total
    lu_solve(square(space(w, n, at.FILTER), m), pivots_of(memory, s, n, 0), e_v)
