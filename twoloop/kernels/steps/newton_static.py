"""The linear algebra of Newton's method for large systems: sparse factors with a static program, of all coordinates.

As in newton_banded.py, but without dependent coordinates: residuals r are those of all accelerations, which hold the
constraints of the accelerations where stages are, and the corrections X solve

    [[M - z^2 K - z D, G^T], [G, 0]] [X; mu] = [M r; G r],    K, D = derivatives by q, v of Q - G^T lam, lam held.

What is left out is how G changes with the position: there is no stiffness in it. K and D are differenced in groups of
columns. Each time a displacement of all coordinates at once is compared with what they say: where entries are missing,
which no position showed when the pattern was looked for, other forms have to go on.
"""

import numpy as np

from twoloop.kernels.data.codes import DONE, NEEDS_DENSE, NOT_FINITE, SINGULAR
from twoloop.kernels.data.common import compiled, inlined
from twoloop.kernels.data.counters import N_EVALUATIONS, N_FACTORIZATIONS, N_JACOBIANS
from twoloop.kernels.data.finite import finite_vector
from twoloop.kernels.evaluation.sparse_inner_loop import fill_jacobian_values
from twoloop.kernels.linalg.dense import copy
from twoloop.kernels.linalg.sparse_lu import factor as factor_lu
from twoloop.kernels.linalg.sparse_lu import load, tangents_of
from twoloop.kernels.linalg.sparse_lu import solve as solve_lu
from twoloop.kernels.linalg.symbolic_factorization import N_OF_MASS, N_OFF, N_PIVOTS, jacobian_of, mass_of
from twoloop.kernels.steps import newton_memory as at
from twoloop.kernels.steps.newton_memory import count_eigenvalues, eigen_place
from twoloop.kernels.steps.newton_tangents import DIFFERENCE, displaced_with_all

MISSED = 0.2  # of what the entries of a row say of a displacement: more is said by entries that are missing
ROUNDING = 1e-13  # of the largest force: what a difference may be off at all
N_VECTORS = 3  # of all coordinates: the force, the same displaced, and what is displaced


def matrices_size(program: np.ndarray, n_mass: int, n_jacobian: int, n_eigenvalues: int) -> int:
    """Numbers in w.matrices: see _state, _vectors and _factors."""
    n = int(program[N_PIVOTS])
    n_tangents = int(program[N_OF_MASS]) - n_mass
    one = n + 2 * int(program[N_OFF])
    return n_mass + n_jacobian + 2 * n_tangents + (N_VECTORS + 7) * n + (1 + 2 * n_eigenvalues) * one


@inlined
def _state(f, w):
    """Numbers of M, G, K and D where they were taken, and of each row whether it counted, and what it stiffens M by."""
    n_mass, n_jacobian, n_rows = w.mass_values.size, w.jacobian_values.size, w.counts.size
    a = n_mass + n_jacobian
    b = a + mass_of(f.newton_program)[0].size - n_mass
    c = b + b - a
    numbers = w.matrices
    return (
        numbers[:n_mass],
        numbers[n_mass:a],
        numbers[a:b],
        numbers[b:c],
        numbers[c : c + n_rows],
        numbers[c + n_rows : c + 2 * n_rows],
    )


@inlined
def _vectors(f, w):
    """N_VECTORS vectors (n_q), sizes of pivots (N), and two complex vectors (N), behind those of _state."""
    n, begin = f.newton_program[N_PIVOTS], w.mass_values.size + w.jacobian_values.size
    begin += 2 * (mass_of(f.newton_program)[0].size - w.mass_values.size) + 2 * n
    n_q, numbers = w.Q.size, w.matrices
    middle = begin + N_VECTORS * n
    return (
        numbers[begin : begin + n_q],
        numbers[begin + n : begin + n + n_q],
        numbers[begin + 2 * n : begin + 2 * n + n_q],
        numbers[middle : middle + n],
        numbers[middle + n : middle + 3 * n].view(np.complex128),
        numbers[middle + 3 * n : middle + 5 * n].view(np.complex128),
    )


@inlined
def _factors(f, w, k):
    """The factors for gamma0, k = 0, or those of the (k - 1)-th eigenvalue, which are complex, as real numbers."""
    n = f.newton_program[N_PIVOTS]
    one = n + 2 * f.newton_program[N_OFF]
    begin = w.mass_values.size + w.jacobian_values.size + (N_VECTORS + 7) * n
    begin += 2 * (mass_of(f.newton_program)[0].size - w.mass_values.size)
    if k == 0:
        return w.matrices[begin : begin + one]
    return w.matrices[begin + (2 * k - 1) * one : begin + (2 * k + 1) * one]


@compiled
def _unbalanced(f, w, t, q, v, moved, out):
    """Q - G^T lam into `out`, lam being in w.lam; `moved`: whether G is to be taken anew. The largest number added."""
    w.counters[N_EVALUATIONS] += 1
    out[:] = 0.0
    f.force(t, q, v, f.p, out)
    if moved:
        fill_jacobian_values(f, w, t, q)
    largest = 0.0
    for j in range(out.size):
        largest = max(largest, abs(out[j]))
    rows, columns, _ = jacobian_of(f.newton_program)
    for k in range(rows.size):
        part = w.jacobian_values[k] * w.lam[rows[k]]
        largest = max(largest, abs(part))
        out[columns[k]] -= part
    return largest


@compiled
def _difference(f, w, t, q, v, by_v, base, other, moved, entries):
    """The entries of K, or of D, group by group: DONE, or NOT_FINITE."""
    rows, columns, begins = tangents_of(f.newton_program)
    given = v if by_v else q
    for group in range(begins.size - 1):
        copy(given, moved)
        first, last = begins[group], begins[group + 1]
        for k in range(first, last):
            j = columns[k]
            moved[j] = given[j] + DIFFERENCE * max(1.0, abs(given[j]))
        if by_v:
            _unbalanced(f, w, t, q, moved, False, other)
        else:
            _unbalanced(f, w, t, moved, v, True, other)
        for k in range(first, last):
            i, j = rows[k], columns[k]
            entries[k] = (other[i] - base[i]) / (moved[j] - given[j])
    return DONE if finite_vector(entries) else NOT_FINITE


@compiled
def _says_all(f, base, other, given, moved, largest, entries, said):
    """Whether these entries explain the change from base to other; `said` is room for numbers of all coordinates."""
    rows, columns, _ = tangents_of(f.newton_program)
    said[:] = 0.0
    for k in range(rows.size):
        i, j = rows[k], columns[k]
        part = entries[k] * (moved[j] - given[j])
        other[i] -= part
        said[i] += abs(part)
    worst = 0.0
    for i in range(base.size):
        worst = max(worst, abs(other[i] - base[i]) - MISSED * said[i])
    return worst <= ROUNDING * largest


@compiled
def derivatives(f, w, memory, t, q, v):
    """K and D at a state that was evaluated just before, with its multipliers in w.lam; NEEDS_DENSE: by others."""
    if f.newton_program.size == 0:
        return NEEDS_DENSE
    w.counters[N_JACOBIANS] += 1
    mass, jacobian, K, D, counts, stiffness = _state(f, w)
    base, other, moved, sizes, _, _ = _vectors(f, w)
    copy(w.mass_values, mass)
    copy(w.jacobian_values, jacobian)
    copy(w.counts, counts)
    copy(w.solutions[w.solutions.size - counts.size :], stiffness)
    largest = _unbalanced(f, w, t, q, v, False, base)
    code = _difference(f, w, t, q, v, False, base, other, moved, K)
    if code != DONE:
        return code
    for j in range(q.size):
        moved[j] = displaced_with_all(q[j], j)
    _unbalanced(f, w, t, moved, v, True, other)
    complete = _says_all(f, base, other, q, moved, largest, K, sizes[: q.size])
    copy(jacobian, w.jacobian_values)
    for j in range(q.size):
        moved[j] = displaced_with_all(v[j], j)
    _unbalanced(f, w, t, q, moved, False, other)
    memory[at.DAMPED] = 0.0
    for i in range(q.size):
        if other[i] != base[i]:
            memory[at.DAMPED] = 1.0
    if memory[at.DAMPED] == 0.0:
        D[:] = 0.0
        return DONE if complete else NEEDS_DENSE
    code = _difference(f, w, t, q, v, True, base, other, moved, D)
    if code != DONE:
        return code
    for j in range(q.size):
        moved[j] = displaced_with_all(v[j], j)
    _unbalanced(f, w, t, q, moved, False, other)
    complete = _says_all(f, base, other, v, moved, largest, D, sizes[: q.size]) and complete
    return DONE if complete else NEEDS_DENSE


@compiled
def _factor(f, w, z, values):
    mass, jacobian, K, D, counts, stiffness = _state(f, w)
    _, _, _, sizes, _, _ = _vectors(f, w)
    w.counters[N_FACTORIZATIONS] += 1
    load(f.newton_program, mass, jacobian, K, D, z, stiffness, values)
    return DONE if factor_lu(f.newton_program, counts, values, sizes) else SINGULAR


@compiled
def factor_filter(f, w, options, s, h):
    """Factors for gamma0, real."""
    return _factor(f, w, h * options[eigen_place(s) + at.GAMMA0], _factors(f, w, 0))


@compiled
def factor(f, w, options, s, h):
    """Factors for gamma0, real, and for the eigenvalues, complex."""
    place = eigen_place(s)
    n_eigen, n_real = count_eigenvalues(options, s), int(options[place + at.N_REAL])
    code = factor_filter(f, w, options, s, h)
    place += at.N_EIGEN_SCALARS + s
    for k in range(n_eigen):
        if code == DONE and (k > 0 or n_real == 0):  # else the eigenvalue is gamma0
            z = h * complex(options[place], options[place + 1])
            code = _factor(f, w, z, _factors(f, w, 1 + k).view(np.complex128))
        place += 2 + 4 * s
    return code


@compiled
def _right(f, w, r, right):
    """[M r; G r]."""
    mass, jacobian, _, _, _, _ = _state(f, w)
    right[:] = 0.0
    rows, columns, _ = mass_of(f.newton_program)
    for k in range(mass.size):
        right[rows[k]] += mass[k] * r[columns[k]]
    rows, columns, _ = jacobian_of(f.newton_program)
    for k in range(rows.size):
        right[w.Q.size + rows[k]] += jacobian[k] * r[columns[k]]


@compiled
def solve(f, w, options, s, k, x):
    """Solve the k-th eigenvalue's system; x (n_q) is overwritten."""
    _, _, real, _, right, y = _vectors(f, w)
    n, n_q = y.size, x.size
    if k == 0 and options[eigen_place(s) + at.N_REAL] > 0.0:  # the eigenvalue is gamma0
        for i in range(n_q):
            real[i] = x[i].real
        _right(f, w, real, right.view(np.float64)[:n])
        solve_lu(f.newton_program, _factors(f, w, 0), right.view(np.float64)[:n], y.view(np.float64)[:n])
        for i in range(n_q):
            x[i] = right.view(np.float64)[i]
    else:
        _right(f, w, x, right)
        solve_lu(f.newton_program, _factors(f, w, 1 + k).view(np.complex128), right, y)
        copy(right[:n_q], x)


@compiled
def filter_error(f, w, options, s, h, e_q, e_v):
    """e_v becomes (I - z^2 J_q - z J_v)^-1 (e_v + z J_q e_q), z = h gamma0."""
    _, _, K, _, _, _ = _state(f, w)
    _, _, _, _, right, y = _vectors(f, w)
    z, n = h * options[eigen_place(s) + at.GAMMA0], y.size
    x = right.view(np.float64)[:n]
    _right(f, w, e_v, x)
    rows, columns, _ = tangents_of(f.newton_program)
    for k in range(rows.size):
        x[rows[k]] += z * K[k] * e_q[columns[k]]
    solve_lu(f.newton_program, _factors(f, w, 0), x, y.view(np.float64)[:n])
    copy(x[: e_v.size], e_v)
