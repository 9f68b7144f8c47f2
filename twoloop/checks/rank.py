"""Rows that depend on others: which they are, how they are made of these, and how large solutions can be."""

import math

import numpy as np
from scipy.linalg import lapack, qr

from twoloop.checks.arguments import Array
from twoloop.kernels.compile.linking import entry_point

RANK_TOLERANCE = 1e-11  # of the largest diagonal entry of R
SHOWN = 5  # rows that depend on others, of which the equations are written out
MOST_TERMS, MOST_NAMED = 3, 8  # rows on which another depends: named with their coefficients, and named at all
WEAK = 1e-9  # of the largest singular value: directions that a pseudo-inverse has beyond doubt
NO_DIRECTION = 1e-12  # of a row: what rounding leaves of it without its part in others that it depends on


def eigenvalues(matrix: Array) -> Array:
    """Of a symmetric matrix, in order: LAPACK called at once takes a fifth of the time where it is small."""
    values: Array = lapack.dsyevd(matrix, compute_v=0)[0]
    return values


def orthogonalised(rows: Array, least: float) -> tuple[Array, Array, list[int]]:
    """Rows of length 1, the lower triangle that makes those rows of them that count, and which these are.

    A row counts if more of it than the share `least` is no combination of those before.
    """
    from twoloop.kernels.linalg.rank import independent_rows

    most, kept = min(rows.shape), np.zeros(len(rows), dtype=np.int64)
    basis, factors = np.zeros((most + 1, rows.shape[1])), np.zeros((most + 1, most + 1))
    n = entry_point(independent_rows)(np.ascontiguousarray(rows), least, basis, factors, kept)
    return basis[:n], factors[:n, :n], kept[:n].tolist()


def least_solution(rows: Array, values: Array) -> tuple[Array, Array] | None:
    """What the pseudo-inverse of rows, of length 1 or less, makes of values, and what that leaves of these.

    None where a direction is so weak that it may count or not.
    """
    from twoloop.kernels.linalg import rank as independent

    n_rows, n_q = rows.shape
    most, kept, x, left = min(n_rows, n_q) + 1, np.zeros(n_rows, dtype=np.int64), np.zeros(n_q), values.copy()
    basis, factors, shares = np.zeros((most, n_q)), np.zeros((most, most)), np.zeros((n_rows, most))
    gram, parts = np.zeros((n_rows, n_rows)), np.zeros((2, n_rows))
    room = basis, factors, kept, shares, gram, parts
    n = entry_point(independent.least_solution)(np.ascontiguousarray(rows), left, NO_DIRECTION, *room, x)
    inverse = entry_point(independent.size_of_inverse)(factors, n, parts[0])
    return (x, left) if WEAK * math.sqrt(n_rows) * inverse < 1.0 else None


def surely_above(ratio: float, rows: Array, rank: int) -> bool:
    """Whether so many singular values are above this share of the largest, by bounds that cost less than these."""
    from twoloop.kernels.linalg.rank import singular_values_exceed, size_of_inverse

    if rank == len(rows) > 0 and entry_point(singular_values_exceed)(
        np.ascontiguousarray(rows), ratio, np.empty((rank, rank))
    ):
        return True
    _, factors, kept = orthogonalised(rows, NO_DIRECTION)
    if len(kept) != rank or rank == 0:
        return False
    inverse = entry_point(size_of_inverse)(np.ascontiguousarray(factors), rank, np.zeros(rank))
    return bool(ratio * float(np.linalg.norm(rows)) * inverse < 1.0)


def redundant_rows(scaled: Array) -> list[int]:
    """Rows of a Jacobian, scaled to like size, that depend on the others, by QR with pivoting."""
    if scaled.size == 0:
        return []
    R, order = qr(scaled.T, mode="r", pivoting=True)
    diagonal = np.abs(np.diagonal(R))
    rank = int((diagonal > RANK_TOLERANCE * diagonal.max()).sum())
    return sorted(order[rank:].tolist())


def in_words(jacobian: Array, redundant: list[int]) -> str:
    """Which rows depend on which others, with the coefficients where these are few: many differ from start to start."""
    from twoloop.kernels.linalg.rank import shares_of_others

    (n_rows, n_q), shown = jacobian.shape, redundant[:SHOWN]
    others = [i for i in range(n_rows) if i not in redundant]
    most, rest = min(len(others), n_q) + 1, np.empty((len(others), n_q))
    lengths, shares = np.zeros(n_rows), np.zeros((len(shown), len(others)))
    order, kept = np.array([*others, *shown]), np.zeros(n_rows, dtype=np.int64)
    room = np.zeros((most, n_q)), np.zeros((most, most)), kept
    if not entry_point(shares_of_others)(
        np.ascontiguousarray(jacobian), order, RANK_TOLERANCE, rest, *room, shares, lengths
    ):
        shares[:] = np.linalg.lstsq(rest.T, jacobian[shown].T, rcond=None)[0].T
    return equations_in_words(redundant, others, shares, lengths)


def equations_in_words(redundant: list[int], others: list[int], shares: Array, lengths: Array) -> str:
    """The same from the shares (SHOWN, n) that the others have in the first rows, and the lengths of all rows."""
    equations = []
    counts = np.abs(shares) * lengths[others] > 1e-9 * lengths[redundant[: len(shares)], None]
    for i, factors, which in zip(redundant, shares.tolist(), counts, strict=False):
        of = which.nonzero()[0].tolist()
        if len(of) > MOST_TERMS:
            named = ", ".join(str(others[k]) for k in of[:MOST_NAMED])
            also = f" and {len(of) - MOST_NAMED} more" if len(of) > MOST_NAMED else ""
            equations.append(f"row {i} on rows {named}{also}")
            continue
        terms = " + ".join([f"{factors[k]:.4g} row {others[k]}" for k in of])
        equations.append(f"row {i} = {terms.replace('+ -', '- ') or '0'}")
    more = ", ..." if len(redundant) > SHOWN else ""
    return f"row(s) {redundant} depend on the others ({', '.join(equations)}{more})"
