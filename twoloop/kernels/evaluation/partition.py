"""LU coordinate partitioning: which coordinates are independent, and which rows count."""

import numpy as np

from twoloop.kernels.algebra.elimination import SIZE
from twoloop.kernels.algebra.factors import factor, make_program, rows_of, sign_of
from twoloop.kernels.algebra.linalg import copy_matrix
from twoloop.kernels.algebra.patterns import note_pattern
from twoloop.kernels.data.codes import DONE, RANK_DIFFERS, SINGULAR
from twoloop.kernels.data.common import compiled, merged
from twoloop.kernels.data.counters import N_FACTORIZATIONS, N_PARTITIONS
from twoloop.kernels.data.flags import FORM, STATIC
from twoloop.kernels.data.noted import FACTORED, GENERATION, LEANING, ORIENTATION, PIVOT, RANK, RANK_V, SENSITIVITY
from twoloop.kernels.evaluation.constraints import constraint_rows

RANK_TOLERANCE = 1e-11  # a pivot below this counts as zero; rows are scaled to 1
CHANGED = -1  # returned beside DONE: there is another partition now
MANY = 200  # rows, which are not eliminated only to see how near a singular position is
WORSE = 3.0  # a partition is renewed when max|C_qd^-1 C_qi| exceeds this multiple of what it was at first


@compiled
def scale_rows(A):
    """Divide each row by a power of two, so that its largest entry is about 1."""
    for i in range(A.shape[0]):
        top = 0.0
        for j in range(A.shape[1]):
            top = max(top, abs(A[i, j]))
        if top > 0.0 and top < np.inf:
            scale = 2.0 ** -np.round(np.log2(top))
            for j in range(A.shape[1]):
                A[i, j] *= scale


@merged
def _largest_from(row, first):
    largest = 0.0
    for j in range(first, row.size):
        if abs(row[j]) > largest:
            largest = abs(row[j])
    return largest


@compiled
def full_pivoting(A, order, row_order, largest, first, last, most):
    """Gauss elimination of A with full pivoting, in place: pivots `first`, first + 1, ... from rows up to `last`.

    At most until there are `most` pivots. `order` and `row_order` become the order of columns and rows. Returns the
    number of pivots there are then, the numerical rank. `largest` is scratch: the largest entry of each row, looked for
    again where a row has changed.
    """
    n_q = A.shape[1]
    k = first
    for i in range(k, last):
        largest[i] = _largest_from(A[i], k)
    while k < min(last, n_q) and k < most:
        r = k
        for i in range(k + 1, last):
            if largest[i] > largest[r]:
                r = i
        if not largest[r] > RANK_TOLERANCE:
            return k
        s = k
        while abs(A[r, s]) != largest[r]:
            s += 1
        if r != k:
            row_order[k], row_order[r] = row_order[r], row_order[k]
            largest[r] = largest[k]
            for j in range(n_q):
                A[k, j], A[r, j] = A[r, j], A[k, j]
        if s != k:
            order[k], order[s] = order[s], order[k]
            for i in range(A.shape[0]):
                A[i, k], A[i, s] = A[i, s], A[i, k]
        for i in range(k + 1, A.shape[0]):
            factor = A[i, k] / A[k, k]
            if factor != 0.0:
                for j in range(k + 1, n_q):
                    A[i, j] -= factor * A[k, j]
                if i < last:
                    largest[i] = _largest_from(A[i], k + 1)
        k += 1
    return k


@compiled
def least_pivot(f, w, t, q):
    """The smallest of the pivots at a position, over the largest, of the rows as they are; the partition stays.

    Nothing is scaled: a row, or a column, may be short as the position is singular. That of factors, or of too many
    rows, is the smallest of the last partition.
    """
    if f.flags[FORM] == STATIC or w.rows_v.size > MANY:
        return w.notes[PIVOT]
    if w.rows_v.size == 0:
        return 1.0
    G, order, row_order = w.Gx, w.order, w.row_order
    G[:, :] = 0.0
    constraint_rows(f, w, t, q, G)
    for j in range(order.size):
        order[j] = j
    for i in range(row_order.size):
        row_order[i] = i
    rank = full_pivoting(G, order, row_order, w.g, 0, row_order.size, w.rows_v.size)
    if rank < w.rows_v.size:
        return 0.0
    smallest, largest = np.inf, 0.0
    for k in range(rank):
        smallest, largest = min(smallest, abs(G[k, k])), max(largest, abs(G[k, k]))
    return smallest / largest


@compiled
def _eliminate(w, most, most_v):
    """Order rows and columns of w.Gx: first what the constraints C need, then what the rows A add to it.

    Returns the rank of C_q and that of C_q and A together, neither counted beyond what is asked for.
    """
    G, order, row_order = w.Gx, w.order, w.row_order
    n_c, n_rows = w.C.size, w.Rate.size
    scale_rows(G)
    for j in range(order.size):
        order[j] = j
    for i in range(n_rows):
        row_order[i] = i
    rank = full_pivoting(G, order, row_order, w.g, 0, n_c, most)
    w.notes[PIVOT] = abs(G[rank - 1, rank - 1]) if rank > 0 else 1.0
    if n_rows == n_c:
        return rank, rank
    last = rank  # rows of A come next, in the place of what is redundant in C
    for i in range(n_c, n_rows):
        row_order[last], row_order[i] = row_order[i], row_order[last]
        for j in range(G.shape[1]):
            G[last, j], G[i, j] = G[i, j], G[last, j]
        last += 1
    return rank, full_pivoting(G, order, row_order, w.g, rank, last, most_v)


@merged
def _insert_sorted(source, target):
    for k in range(source.size):
        i = k
        while i > 0 and target[i - 1] > source[k]:
            target[i] = target[i - 1]
            i -= 1
        target[i] = source[k]


@compiled
def _take_order(w):
    """Make what `_eliminate` found the partition; False: C_qd is singular by its pattern."""
    rank, rank_v = w.rows.size, w.rows_v.size
    # ascending, so that the same set is always the same partition
    _insert_sorted(w.row_order[:rank], w.rows)
    _insert_sorted(w.order[:rank], w.dependent)
    _insert_sorted(w.order[rank:], w.independent)
    if w.Rate.size > w.C.size:
        _insert_sorted(w.row_order[:rank_v], w.rows_v)
        _insert_sorted(w.order[:rank_v], w.dependent_v)
        _insert_sorted(w.order[rank_v:], w.independent_v)
    w.notes[SENSITIVITY] = 0.0
    w.notes[LEANING] = 0.0
    w.notes[ORIENTATION] = 0.0
    w.notes[GENERATION] += 1.0
    if w.G_of_S.size > 0:
        w.G_of_S[0, 0] = np.nan
    if rank_v < w.Rate.size:
        w.index_a[SIZE] = 0  # there may be other rows that count
    return write_programs(w)


@compiled
def write_programs(w):
    """Choose the order of elimination for the numbers in w.G; False: singular."""
    _note_places(w)
    w.notes[FACTORED] = 0.0
    done = make_program(w.G, w.pattern, w.rows, w.dependent, w.index, w.values)
    if done and w.Rate.size > w.C.size:
        done = make_program(w.G, w.pattern, w.rows_v, w.dependent_v, w.index_v, w.values_v)
    return done


@compiled
def _note_places(w):
    """Where the entries of the rows are, see Work."""
    n_rows = w.Rate.size
    place = n_rows + 1
    for i in range(n_rows):
        w.places[i] = place
        for j in range(w.pattern.shape[1]):
            if w.pattern[i, j] != 0.0:
                w.places[place] = j
                place += 1
    w.places[n_rows] = place


@compiled
def note_entries(w):
    """Note the entries of w.G; whether there are new ones, so that its programs are to be written anew."""
    if not note_pattern(w.G, w.pattern):
        return False
    w.index_a[SIZE] = 0
    return True


@compiled
def partition(f, w, t, q):
    """Choose dependent and independent coordinates at (t, q), and the rows that count.

    SINGULAR where the rank is less than that of the partition before; RANK_DIFFERS, with the ranks in w.notes, where
    the workspace is made for others and this is the first partition.
    """
    w.entries[:] = 0.0
    constraint_rows(f, w, t, q, w.G)
    note_entries(w)
    copy_matrix(w.G, w.Gx)
    w.counters[N_FACTORIZATIONS] += 1
    w.counters[N_PARTITIONS] += 1
    first = w.notes[GENERATION] == 0.0
    most, most_v = (w.C.size, w.Rate.size) if first else (w.rows.size, w.rows_v.size)
    rank, rank_v = _eliminate(w, most, most_v)
    if first and (rank != w.rows.size or rank_v != w.rows_v.size):
        w.notes[RANK], w.notes[RANK_V] = rank, rank_v
        return RANK_DIFFERS
    if rank < w.rows.size or rank_v < w.rows_v.size:
        return SINGULAR
    return DONE if _take_order(w) else SINGULAR


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
    w.entries[:] = 0.0
    constraint_rows(f, w, t_mid, w.x, w.G)
    new = note_entries(w)
    copy_matrix(w.G, w.Gx)
    rank, rank_v = w.rows.size, w.rows_v.size
    w.counters[N_FACTORIZATIONS] += 1
    found, found_v = _eliminate(w, rank, rank_v)
    if found < rank or found_v < rank_v:
        return SINGULAR
    same = _same_set(w.independent, w.order[rank:])
    if same and not new and _same_set(w.independent_v, w.order[rank_v:]):
        return DONE
    w.counters[N_PARTITIONS] += 1
    return CHANGED if _take_order(w) else SINGULAR


@merged
def _same_set(a, b):
    same = True
    for m in a:
        found = False
        for k in b:
            found = found or k == m
        same = same and found
    return same


@compiled
def renew(f, w, t, q):
    """Choose a partition at an accepted state, and note the sign of det C_qd that its motion has to keep."""
    code = partition(f, w, t, q)
    w.notes[ORIENTATION] = 0.0
    if code != DONE:
        return code
    ratio = min(factor(w.entries, w.index, w.values), factor(w.entries, w.index_v, w.values_v))
    if not ratio > RANK_TOLERANCE:
        return SINGULAR
    w.notes[ORIENTATION] = sign_of(w.index, w.values)
    return DONE


@compiled
def _largest(D, n_dof):
    largest = 0.0
    for j in range(n_dof):
        for k in range(D.shape[1]):
            largest = max(largest, abs(D[j, k]))
    return largest


@compiled
def _largest_share(w):
    """Of the rows that count in a redundant one, all scaled to 1, as the last multipliers left them in w.minimum."""
    rows = rows_of(w.index_v)
    largest = 0.0
    place = 0
    for row in range(w.Rate.size):
        counts = False
        for k in w.rows_v:
            counts = counts or k == row
        if counts:
            continue
        size = _largest_from(w.G[row], 0)
        for k in range(rows.size):
            share = abs(w.minimum[place + k]) * _largest_from(w.G[rows[k]], 0)
            if share > largest * size:
                largest = share / size
        place += rows.size
    return largest


@compiled
def partition_is_poor(w):
    """Whether dependents move much faster per independent than when the partition was chosen.

    Measures max|C_qd^-1 C_qi|, which is in w.D. Full pivoting leaves it near 1; it grows without bound where the
    independent coordinates stop being valid. So does the share that rows which count have in a redundant one, where
    they come to depend on each other: C_qd is singular there, but not C_q.
    """
    largest = _largest(w.D, w.independent_v.size)
    if w.notes[SENSITIVITY] == 0.0:  # first look at a new partition
        w.notes[SENSITIVITY] = max(largest, 1.0)
    if not largest <= WORSE * w.notes[SENSITIVITY]:
        return True
    if w.rows_v.size == w.Rate.size or w.factors.size > 0:  # whose rows that count are chosen at every state
        return False
    share = _largest_share(w)
    if w.notes[LEANING] == 0.0:
        w.notes[LEANING] = max(share, 1.0)
    return not share <= WORSE * w.notes[LEANING]
