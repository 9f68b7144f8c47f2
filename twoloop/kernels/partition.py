"""LU coordinate partitioning: which coordinates are independent."""

from twoloop.kernels.common import DONE, N_FACTORIZATIONS, N_PARTITIONS, SINGULAR, inlined

RANK_TOLERANCE = 1e-11  # a pivot below this fraction of the largest one counts as zero
WORSE = 0.1  # a partition is renewed when its pivot ratio falls below this fraction of its best


@inlined
def full_pivoting(A, order, rows):
    """Gauss elimination of A (n_c, n_q) with full pivoting, in place.

    `order` becomes the column order (the first n_c are the dependent coordinates), `rows` the row order.
    Returns the numerical rank and min|pivot| / max|pivot| over the pivots that count.
    """
    n_c, n_q = A.shape
    for j in range(n_q):
        order[j] = j
    for i in range(n_c):
        rows[i] = i
    largest = 0.0
    smallest = 0.0
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
            return k, 0.0
        smallest = top if k == 0 else min(smallest, top)
        if r != k:
            rows[k], rows[r] = rows[r], rows[k]
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
    return n_c, smallest / largest if n_c > 0 else 1.0


@inlined
def partition(f, w, t, q):
    """Choose dependent and independent coordinates at (t, q); SINGULAR where C_q has not full rank."""
    w.W[:, :] = 0.0
    f.jacobian(t, q, f.p, w.W)
    n_c = w.C.size
    rank, _ = full_pivoting(w.W, w.order, w.pivots)
    w.counters[N_PARTITIONS] += 1
    w.counters[N_FACTORIZATIONS] += 1
    if rank < n_c:
        return SINGULAR
    w.dependent[:] = w.order[:n_c]
    w.independent[:] = w.order[n_c:]
    # ascending, so that the same set is always the same partition
    w.dependent.sort()
    w.independent.sort()
    w.quality[0] = 0.0
    return DONE


@inlined
def partition_is_worn(w):
    """Whether C_qd, as factored last, is much worse conditioned than at its best under this partition."""
    if w.quality[1] > w.quality[0]:
        w.quality[0] = w.quality[1]
    return w.quality[1] < WORSE * w.quality[0]
