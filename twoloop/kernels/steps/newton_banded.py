"""The linear algebra of newton_step.py where M and the derivatives of the force have a band: cost in proportion to n_q.

The corrections x of the independent accelerations solve (I - z^2 J_q - z J_v) x = r with z = h l. Multiplied by
T^T M T, where v = T v_i are the velocities that the constraints allow, T = [I; -Cqd^-1 Cqi], this is

    T^T (M - z^2 K - z D) T x = T^T M T r,    K, D = derivatives by q, v of Q - Cq^T lam, lam held

but for how the dependent accelerations change with the position where T does. That term, zero for linear constraints,
has no stiffness, and a simplified Newton may leave it out: at a tolerance the steps are the same, but fixed steps in
which a body turns by some 0.4 rad on its constraints may fail where dense algebra converges. X = T x is also the
solution of a banded matrix with a border,

    [[M - z^2 K - z D, Cq^T], [Cq, 0]] [X; mu] = [M T r; 0].

K and D come from the system's tangents, or are differenced in groups of columns that share no row, 2 b + 1 of them for
every n_q (Curtis, Powell & Reid 1974, doi 10.1093/imamat/13.1.117).
"""

import numpy as np

from twoloop.kernels.data.codes import DONE, NOT_FINITE
from twoloop.kernels.data.common import compiled, inlined
from twoloop.kernels.data.counters import N_EVALUATIONS, N_FACTORIZATIONS, N_JACOBIANS
from twoloop.kernels.data.flags import BANDWIDTH, FORCE_BY_Q_GIVEN, FORCE_BY_V_GIVEN
from twoloop.kernels.evaluation.constraints import constraint_rows
from twoloop.kernels.evaluation.inner_loop import find_tangents
from twoloop.kernels.linalg.band import (
    DGBTRF,
    DGBTRS,
    ZGBTRF,
    ZGBTRS,
    add_banded_mass_times,
    factor_bordered,
    lu_band,
    solve_bordered,
)
from twoloop.kernels.linalg.dense import copy, copy_matrix
from twoloop.kernels.linalg.markowitz_lu import columns_of
from twoloop.kernels.steps import newton_memory as at
from twoloop.kernels.steps.newton_memory import (
    complex_vector,
    count_eigenvalues,
    eigen_place,
    pivots_of,
    space,
    system_space,
    vector,
)
from twoloop.kernels.steps.newton_tangents import DIFFERENCE, displaced_with_all, tangent_by_q, tangent_by_v


@inlined
def _band(numbers, n, b):
    """Entry (i, j) of K or D at [i, b + j - i]."""
    return numbers[: n * (2 * b + 1)].reshape((n, 2 * b + 1))


@inlined
def _constraints(w, n, r, b):
    """What stands behind K: the rows of C_q that count, w.D and the columns of its entries, where K was taken."""
    numbers = space(w, n, at.BY_Q)
    start = n * (2 * b + 1)
    Cq = numbers[start : start + r * n].reshape((r, n))
    start += r * n
    D = numbers[start : start + r * (n - r + 1)].reshape((n - r + 1, r))
    start += r * (n - r + 1)
    return Cq, D, numbers[start : start + r].view(np.int64)


@compiled
def _unbalanced(f, w, t, q, v):
    """Q - C_q^T lam into w.Q, with the multipliers in w.lam."""
    w.counters[N_EVALUATIONS] += 1
    w.Q[:] = 0.0
    f.force(t, q, v, f.p, w.Q)
    w.Gx[:, :] = 0.0
    constraint_rows(f, w, t, q, w.Gx)
    for i in range(w.lam.size):
        for j in range(q.size):
            w.Q[j] -= w.Gx[i, j] * w.lam[i]


@compiled
def _difference_groups(f, w, t, q, v, by_v, base, moved, b, band):
    """Columns j, j + 2 b + 1, ... at a time: DONE, or NOT_FINITE."""
    n = q.size
    given = v if by_v else q
    for group in range(2 * b + 1):
        copy(given, moved)
        for j in range(group, n, 2 * b + 1):
            moved[j] += DIFFERENCE * max(1.0, abs(given[j]))
        if by_v:
            _unbalanced(f, w, t, q, moved)
        else:
            _unbalanced(f, w, t, moved, v)
        for j in range(group, n, 2 * b + 1):
            size = moved[j] - given[j]
            for i in range(max(0, j - b), min(n, j + b + 1)):
                band[i, b + j - i] = (w.Q[i] - base[i]) / size
                if not np.isfinite(band[i, b + j - i]):
                    return NOT_FINITE
    return DONE


@compiled
def _copy_band(A, b, band):
    n = A.shape[0]
    for i in range(n):
        for j in range(max(0, i - b), min(n, i + b + 1)):
            band[i, b + j - i] = A[i, j]


@compiled
def _from_tangents(f, w, memory, s, t, q, v, b):
    n = q.size
    K, R = space(w, n, at.FILTER).reshape((n, n)), space(w, n, at.SYSTEMS).reshape((n, n))
    code = tangent_by_q(f, w, t, q, v, b, vector(memory, s, n, at.Q_MOVED), K, R)
    if code != DONE:
        return code
    _copy_band(K, b, _band(space(w, n, at.BY_Q), n, b))
    memory[at.DAMPED] = f.flags[FORCE_BY_V_GIVEN]
    code = tangent_by_v(f, t, q, v, b, K)
    if memory[at.DAMPED] == 1.0:
        _copy_band(K, b, _band(space(w, n, at.BY_V), n, b))
    return code


@compiled
def derivatives(f, w, memory, s, t, q, v):
    """K and D at a state that was evaluated just before."""
    n = q.size
    b = f.flags[BANDWIDTH]
    w.counters[N_JACOBIANS] += 1
    Cq, D, columns = _constraints(w, n, w.rows.size, b)
    for i in range(w.rows.size):
        copy(w.G[w.rows[i]], Cq[i])
    code = find_tangents(f, w, t, q)
    if code != DONE:
        return code
    copy_matrix(w.D, D)
    copy(columns_of(w.index), columns)
    if f.flags[FORCE_BY_Q_GIVEN] == 1:
        return _from_tangents(f, w, memory, s, t, q, v, b)
    base, moved = vector(memory, s, n, at.A_NEW), vector(memory, s, n, at.Q_MOVED)
    _unbalanced(f, w, t, q, v)
    copy(w.Q, base)
    code = _difference_groups(f, w, t, q, v, False, base, moved, b, _band(space(w, n, at.BY_Q), n, b))
    if code != DONE:
        return code
    # one displacement of all velocities tells whether there is anything to difference
    for j in range(n):
        moved[j] = displaced_with_all(v[j], j)
    _unbalanced(f, w, t, q, moved)
    memory[at.DAMPED] = 0.0
    for i in range(n):
        if w.Q[i] != base[i]:
            memory[at.DAMPED] = 1.0
    if memory[at.DAMPED] == 0.0:
        return DONE
    return _difference_groups(f, w, t, q, v, True, base, moved, b, _band(space(w, n, at.BY_V), n, b))


@compiled
def _fill(w, memory, b, z, numbers):
    """M - z^2 K - z D to where it is factored."""
    n = w.Q.size
    K, D = _band(space(w, n, at.BY_Q), n, b), _band(space(w, n, at.BY_V), n, b)
    damped = memory[at.DAMPED] == 1.0
    target = lu_band(numbers, n, b)
    for i in range(n):
        for j in range(max(0, i - b), min(n, i + b + 1)):
            value = w.M[i, j] - z * z * K[i, b + j - i]
            if damped:
                value -= z * D[i, b + j - i]
            target[j, 2 * b + i - j] = value


@compiled
def factor_filter(f, w, options, memory, s, h):
    """Factors of the bordered system of gamma0, real."""
    n = w.Q.size
    b = f.flags[BANDWIDTH]
    Cq, _, _ = _constraints(w, n, w.rows.size, b)
    numbers = space(w, n, at.FILTER)
    _fill(w, memory, b, h * options[eigen_place(s) + at.GAMMA0], numbers)
    w.counters[N_FACTORIZATIONS] += 1
    return factor_bordered(w, b, Cq, numbers, pivots_of(memory, s, n, 0), DGBTRF, DGBTRS)


@compiled
def factor(f, w, options, memory, s, h):
    """Factors of the bordered systems of gamma0, real, and of the eigenvalues, complex."""
    n = w.Q.size
    b = f.flags[BANDWIDTH]
    place = eigen_place(s)
    n_eigen = count_eigenvalues(options, s)
    n_real = int(options[place + at.N_REAL])
    Cq, _, _ = _constraints(w, n, w.rows.size, b)
    code = factor_filter(f, w, options, memory, s, h)
    place += at.N_EIGEN_SCALARS + s
    for k in range(n_eigen):
        if code != DONE:
            return code
        if k > 0 or n_real == 0:  # else the eigenvalue is gamma0
            system = system_space(w, n, k)
            _fill(w, memory, b, h * complex(options[place], options[place + 1]), system)
            w.counters[N_FACTORIZATIONS] += 1
            code = factor_bordered(w, b, Cq, system, pivots_of(memory, s, n, 1 + k), ZGBTRF, ZGBTRS)
        place += 2 + 4 * s
    return code


@compiled
def _all_coordinates(w, b, x, X):
    """X = T x; of x (n_q) the first n_dof numbers count, the others are scratch."""
    n_dof = w.independent.size
    _, D, columns = _constraints(w, w.Q.size, w.rows.size, b)
    for i in columns:
        X[i] = 0.0
    for k in range(n_dof):
        X[w.independent[k]] = x[k]
        for i in range(columns.size):
            X[columns[i]] += D[k, i] * x[k]


@compiled
def _solve_for_independents(w, b, numbers, pivots, substitute, x):
    """Solve with the full right-hand side x (n_q); its first n_dof numbers become the independents of the solution."""
    Cq, _, _ = _constraints(w, x.size, w.rows.size, b)
    solve_bordered(w, b, Cq, numbers, pivots, substitute, x)
    for k in range(w.independent.size):  # ascending, so that none is overwritten before its turn
        x[k] = x[w.independent[k]]


@compiled
def solve(f, w, options, memory, s, k, x):
    """Solve the k-th eigenvalue's system; the first n_dof numbers of x (n_q) are overwritten."""
    n = w.Q.size
    b = f.flags[BANDWIDTH]
    n_eigen = count_eigenvalues(options, s)
    pivots = pivots_of(memory, s, n, 1 + k)
    if k == 0 and options[eigen_place(s) + at.N_REAL] > 0.0:  # the eigenvalue is gamma0
        real, X = vector(memory, s, n, at.V_MOVED), vector(memory, s, n, at.Q_MOVED)
        for i in range(n):
            real[i] = x[i].real
        _all_coordinates(w, b, real, X)
        real[:] = 0.0
        add_banded_mass_times(f, w, X, real)
        pivots = pivots_of(memory, s, n, 0)
        _solve_for_independents(w, b, space(w, n, at.FILTER), pivots, DGBTRS, real)
        for i in range(n):
            x[i] = real[i]
    else:
        X = complex_vector(memory, s, n, n_eigen, 1)
        _all_coordinates(w, b, x, X)
        x[:] = 0.0
        add_banded_mass_times(f, w, X, x)
        _solve_for_independents(w, b, system_space(w, n, k), pivots, ZGBTRS, x)


@compiled
def filter_error(f, w, options, memory, s, h, e_q, e_v):
    """e_v becomes (I - z^2 J_q - z J_v)^-1 (e_v + z J_q e_q), z = h gamma0: the first n_dof numbers of each (n_q)."""
    n = w.Q.size
    b = f.flags[BANDWIDTH]
    z = h * options[eigen_place(s) + at.GAMMA0]
    K, X = _band(space(w, n, at.BY_Q), n, b), vector(memory, s, n, at.Q_MOVED)
    _all_coordinates(w, b, e_v, X)
    e_v[:] = 0.0
    add_banded_mass_times(f, w, X, e_v)
    _all_coordinates(w, b, e_q, X)
    for i in range(n):
        for j in range(max(0, i - b), min(n, i + b + 1)):
            e_v[i] += z * K[i, b + j - i] * X[j]
    pivots = pivots_of(memory, s, n, 0)
    _solve_for_independents(w, b, space(w, n, at.FILTER), pivots, DGBTRS, e_v)
