"""LU coordinate partitioning: which coordinates are independent."""

from twoloop.kernels.common import (
    DONE,
    N_FACTORIZATIONS,
    N_PARTITIONS,
    ORIENTATION,
    SENSITIVITY,
    SINGULAR,
    compiled,
    inlined,
)
from twoloop.kernels.linalg import lu_solve

RANK_TOLERANCE = 1e-11  # a pivot below this fraction of the largest one counts as zero
CHANGED = -1  # returned beside DONE: there is another partition now
WORSE = 3.0  # a partition is renewed when max|C_qd^-1 C_qi| exceeds this multiple of what it was at first


@compiled
def full_pivoting(A, order):
    """Gauss elimination of A (n_c, n_q) with full pivoting, in place.

    `order` becomes the column order: the first n_c are the dependent coordinates. Returns the numerical rank.
    """
    n_c, n_q = A.shape
    for j in range(n_q):
        order[j] = j
    largest = 0.0
    for k in range(n_c):
        top = 0.0
        r = k
        s = k
        for i in range(k, n_c):
            for j in range(k, n_q):
                if abs(A[i, j]) > top:
                    top = abs(A[i, j])
                    r = i
                    s = j
        if k == 0:
            largest = top
        if not top > RANK_TOLERANCE * largest:
            return k
        if r != k:
            for j in range(n_q):
                A[k, j], A[r, j] = A[r, j], A[k, j]
        if s != k:
            order[k], order[s] = order[s], order[k]
            for i in range(n_c):
                A[i, k], A[i, s] = A[i, s], A[i, k]
        for i in range(k + 1, n_c):
            factor = A[i, k] / A[k, k]
            if factor != 0.0:
                for j in range(k + 1, n_q):
                    A[i, j] -= factor * A[k, j]
    return n_c


@inlined
def _insert_sorted(source, target):
    for k in range(source.size):
        i = k
        while i > 0 and target[i - 1] > source[k]:
            target[i] = target[i - 1]
            i -= 1
        target[i] = source[k]


@inlined
def _take_order(w):
    n_c = w.C.size
    # ascending, so that the same set is always the same partition
    _insert_sorted(w.order[:n_c], w.dependent)
    _insert_sorted(w.order[n_c:], w.independent)
    w.notes[SENSITIVITY] = 0.0
    w.notes[ORIENTATION] = 0.0


@compiled
def partition(f, w, t, q):
    """Choose dependent and independent coordinates at (t, q); SINGULAR where C_q has not full rank."""
    w.Cqx[:, :] = 0.0
    f.jacobian(t, q, f.p, w.Cqx)
    n_c = w.C.size
    rank = full_pivoting(w.Cqx, w.order)
    w.counters[N_FACTORIZATIONS] += 1
    w.counters[N_PARTITIONS] += 1
    if rank < n_c:
        return SINGULAR
    _take_order(w)
    return DONE


@compiled
def partition_of_midpoint(f, w, t_mid, state, new_state):
    """Take the partition that full pivoting finds in the middle of a step; DONE (= 0) where it is the present one.

    Both directions of a step have the same middle, so that the choice, and with it the map of a symmetric tableau,
    is symmetric in time: where the partition changes, no direction is preferred, as it is by waiting until it has to be
    renewed.
    The middle is that of the attempt made under the current partition, and is not looked at again once the step has
    been redone under the new one: where two choices tie to within the difference of the two attempts, O(h^(p+1)), the
    reverse step may choose the other.
    """
    n = w.Q.size
    for j in range(n):
        w.x[j] = 0.5 * (state[j] + new_state[j])
    w.Cqx[:, :] = 0.0
    f.jacobian(t_mid, w.x, f.p, w.Cqx)
    n_c = w.C.size
    w.counters[N_FACTORIZATIONS] += 1
    if full_pivoting(w.Cqx, w.order) < n_c:
        return SINGULAR
    same = True
    for m in w.independent:
        found = False
        for k in range(n_c, n):
            found = found or w.order[k] == m
        same = same and found
    if same:
        return DONE
    w.counters[N_PARTITIONS] += 1
    _take_order(w)
    return CHANGED


@compiled
def partition_is_worn(w):
    """Whether dependents move much faster per independent than when the partition was chosen.

    Measures max|C_qd^-1 C_qi| with C_q and the factors of C_qd as they stand after an accepted step. Full pivoting
    leaves it near 1; it grows without bound where the independent coordinates stop being valid.
    """
    largest = 0.0
    for m in w.independent:
        for i in range(w.g.size):
            w.g[i] = w.Cq[i, m]
        lu_solve(w.Cqd, w.pivots, w.g)
        for i in range(w.g.size):
            largest = max(largest, abs(w.g[i]))
    if w.notes[SENSITIVITY] == 0.0:  # first look at a new partition
        w.notes[SENSITIVITY] = max(largest, 1.0)
    return not largest <= WORSE * w.notes[SENSITIVITY]
