"""Multipliers of least norm of a large system with redundant rows, however many of them there are.

Of all lam with the same G^T lam = b, the least is G x for some x. It solves

    [0  G^T] [ x ]   [b]
    [G  -1 ] [lam] = [0]

which is singular in x, as not all motion is held. With W in the place of 0, a small diagonal positive matrix, it is
quasi-definite, and has factors in any order (Vanderbei 1995, doi 10.1137/0805005): those of the static program. As b
is a sum of rows of G, refined solutions come to the lam that is looked for: a part of b along a direction in which G
is small by s, over the columns' own size, loses the factor 1 + s^2 / SHARE each time.
"""

from twoloop.kernels.algebra.linalg import copy
from twoloop.kernels.algebra.static_factors import factor, solve
from twoloop.kernels.algebra.static_program import N_OFF, N_PIVOTS, jacobian_of, order_of
from twoloop.kernels.data.codes import DONE, NEEDS_DENSE
from twoloop.kernels.data.common import compiled

SHARE = 1e-11  # of the squares of a column of G: W
ENOUGH = 1e-14  # of the largest force: what may be left of b
ALLOWED = 1e-9  # ... and what may be left where it no longer shrinks
MOST = 30  # solutions


@compiled
def _load(program, jacobian, n_q, weights, values):
    """The numbers of the matrix into their slots; `weights` is room for n_q numbers."""
    rows, columns, slots = jacobian_of(program)
    for j in range(n_q):
        weights[j] = 0.0
    largest = 0.0
    for k in range(rows.size):
        weights[columns[k]] += jacobian[k] * jacobian[k]
        largest = max(largest, weights[columns[k]])
    order, n = order_of(program), program[N_PIVOTS]
    for s in range(n + program[N_OFF]):
        values[s] = 0.0
    for k in range(n):
        values[k] = SHARE * (weights[order[k]] if weights[order[k]] > 0.0 else largest) if order[k] < n_q else -1.0
    for k in range(rows.size):
        values[slots[k]] += jacobian[k]


@compiled
def _residual(program, jacobian, force, x, r):
    """[b - G^T lam, lam - G x] for x = [x, lam]; the largest of its forces over the largest of b."""
    n_q, largest, left = force.size, 0.0, 0.0
    copy(force, r[:n_q])
    for i in range(n_q, x.size):
        r[i] = x[i]
    rows, columns, _ = jacobian_of(program)
    for k in range(rows.size):
        i, j = n_q + rows[k], columns[k]
        r[j] -= jacobian[k] * x[i]
        r[i] -= jacobian[k] * x[j]
    for j in range(n_q):
        largest, left = max(largest, abs(force[j])), max(left, abs(r[j]))
    return left / largest if largest > 0.0 else 0.0


@compiled
def least_norm(f, w, lam):
    """The multipliers of least norm with the same G^T lam, in the place of lam; NEEDS_DENSE if they are not found."""
    program, n_q = f.static_program, w.Q.size
    n = program[N_PIVOTS]
    n_factors = n + program[N_OFF] + 1
    values, counts, without = w.minimum[:n_factors], w.z, w.g
    force, x = w.minimum[n_factors : n_factors + n_q], w.minimum[n_factors + n_q :]
    change, y, weights = w.solutions[:n], w.solutions[n : 2 * n], w.solutions[2 * n : 3 * n]
    rows, columns, _ = jacobian_of(program)
    for j in range(n_q):
        force[j] = 0.0
    for k in range(rows.size):
        force[columns[k]] += w.jacobian_values[k] * lam[rows[k]]
    _load(program, w.jacobian_values, n_q, weights, values)
    for i in range(lam.size):
        counts[i], without[i] = 1.0, 0.0
    if not factor(program, counts, values, w.pivot_sizes, 0.0) > 0.0:
        return NEEDS_DENSE
    for i in range(n):
        x[i] = 0.0
    before = _residual(program, w.jacobian_values, force, x, change)
    for _ in range(MOST):
        if before <= ENOUGH:
            break
        solve(program, values, without, change, y)
        for i in range(n):
            x[i] += change[i]
        left = _residual(program, w.jacobian_values, force, x, change)
        if not left < before:
            before = left
            break
        before = left
    if not before <= ALLOWED:
        return NEEDS_DENSE
    copy(x[n_q:], lam)
    return DONE
