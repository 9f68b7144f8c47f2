"""The matrix of one Newton iteration from the tangents that a system gives, without a band, for diagonal_step.py.

With v = T v_i + u, T = [I; -Cqd^-1 Cqi], the corrections d of the independent accelerations solve

    T^T (M - z^2 K - z D) T d = T^T M T r,    K, D = derivatives by q, v of Q - Cq^T lam, lam held.

It is factored as it stands, and no inverse of T^T M T is applied to the derivatives, as newton_dense.py does for the
many systems of a Runge-Kutta method: half the work where a matrix serves one iteration only. What is left out is the
same: how T and M change with the position, in which there is no stiffness.
"""

from twoloop.kernels.data.codes import DONE, SINGULAR
from twoloop.kernels.data.common import compiled
from twoloop.kernels.data.counters import N_FACTORIZATIONS, N_JACOBIANS
from twoloop.kernels.data.flags import FORCE_BY_V_GIVEN
from twoloop.kernels.evaluation.inner_loop import find_tangents
from twoloop.kernels.linalg.dense import copy, ldl_factor, ldl_solve, lu_factor, lu_solve
from twoloop.kernels.steps import newton_memory as at
from twoloop.kernels.steps.newton_dense import reduce
from twoloop.kernels.steps.newton_memory import pivots_of, space, square, vector
from twoloop.kernels.steps.newton_tangents import tangent_by_q, tangent_by_v

ASYMMETRY = 1e-12  # of the largest entry: what counts as rounding


@compiled
def _symmetric(A):
    largest, off = 0.0, 0.0
    for i in range(A.shape[0]):
        largest = max(largest, abs(A[i, i]))
        for j in range(i):
            off = max(off, abs(A[i, j] - A[j, i]))
    return off <= ASYMMETRY * largest


@compiled
def _fill(w, memory, n, m, z, H):
    """T^T M T - z^2 T^T K T - z T^T D T into H."""
    N, Kr, Dr = space(w, n, at.SYSTEMS), space(w, n, at.BY_Q), space(w, n, at.BY_V)
    square = z * z
    if memory[at.DAMPED] == 1.0:
        for i in range(m * m):
            H[i] = N[i] - square * Kr[i] - z * Dr[i]
    else:
        for i in range(m * m):
            H[i] = N[i] - square * Kr[i]


@compiled
def factor_again(w, memory, z):
    """Factors of the matrix at the last state for another z."""
    n, m = w.Q.size, w.independent.size
    numbers = space(w, n, at.FILTER)
    H = square(numbers, m)
    w.counters[N_FACTORIZATIONS] += 1
    _fill(w, memory, n, m, z, numbers)
    memory[at.SYMMETRIC] = 0.0
    if _symmetric(H):
        if ldl_factor(H):
            memory[at.SYMMETRIC] = 1.0
            return DONE
        _fill(w, memory, n, m, z, numbers)  # not definite, as of a compressed beam
    return DONE if lu_factor(H, pivots_of(memory, 1, n, 0)) > 0.0 else SINGULAR


@compiled
def factor_iteration(f, w, memory, t, q, v, z):
    """Factors of the matrix at a state that was evaluated just before, with its multipliers in w.lam."""
    n = q.size
    m = w.independent.size
    w.counters[N_JACOBIANS] += 1
    numbers = space(w, n, at.FILTER)
    K, R = numbers.reshape((n, n)), space(w, n, at.SYSTEMS).reshape((n, n))
    AT = space(w, n, at.SYSTEMS + 1)[: n * m].reshape((n, m))
    code = tangent_by_q(f, w, t, q, v, n - 1, vector(memory, 1, n, at.Q_MOVED), K, R)
    if code == DONE:
        code = find_tangents(f, w, t, q)
    if code != DONE:
        return code
    reduce(w, K, AT, square(space(w, n, at.BY_Q), m))
    memory[at.DAMPED] = f.flags[FORCE_BY_V_GIVEN]
    code = tangent_by_v(f, t, q, v, n - 1, K)
    if code != DONE:
        return code
    if memory[at.DAMPED] == 1.0:
        reduce(w, K, AT, square(space(w, n, at.BY_V), m))
    reduce(w, w.M, AT, square(space(w, n, at.SYSTEMS), m))
    return factor_again(w, memory, z)


@compiled
def _solve(w, memory, x):
    m = x.size
    H = square(space(w, w.Q.size, at.FILTER), m)
    if memory[at.SYMMETRIC] == 1.0:
        ldl_solve(H, x)
    else:
        lu_solve(H, pivots_of(memory, 1, w.Q.size, 0), x)


@compiled
def solve_iteration(w, memory, residual, a):
    """The correction of the independents of a, added; it replaces the residual (n_q)."""
    n = w.Q.size
    m = w.independent.size
    N, x = square(space(w, n, at.SYSTEMS), m), vector(memory, 1, n, at.V_MOVED)[:m]
    for i in range(m):
        total = 0.0
        for j in range(m):
            total += N[i, j] * residual[w.independent[j]]
        x[i] = total
    _solve(w, memory, x)
    for i in range(m):
        residual[w.independent[i]] = x[i]
        a[w.independent[i]] += x[i]


@compiled
def filter_by_iteration(w, memory, z, e_q, e_v):
    """e_v (n_dof) becomes (I - z^2 J_q - z J_v)^-1 (e_v + z J_q e_q)."""
    n = w.Q.size
    m = e_q.size
    N, Kr = square(space(w, n, at.SYSTEMS), m), square(space(w, n, at.BY_Q), m)
    x = vector(memory, 1, n, at.V_MOVED)[:m]
    for i in range(m):
        total = 0.0
        for j in range(m):
            total += N[i, j] * e_v[j] + z * Kr[i, j] * e_q[j]
        x[i] = total
    _solve(w, memory, x)
    copy(x, e_v)
