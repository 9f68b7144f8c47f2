"""The program by which the matrix of a large system is factored, made once from where its entries are.

    [M  G^T]
    [G   0 ]  = L D L^T

in the order of static_order.py, with pivots of one row and no look at the numbers: see static_factors.py. A slot holds
a number of the factors: the pivots in their order, then the columns of L, each downwards.
"""

from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from twoloop.kernels.algebra.static_order import elimination_order
from twoloop.kernels.data.common import inlined

Integers = NDArray[np.int64]
Entries = tuple[Integers, Integers]  # rows and columns

# places in the program; then what `_sections` names
N_COORDINATES, N_PIVOTS, N_OFF, N_UPDATES, N_OF_MASS, N_OF_JACOBIAN, N_STIFFENED, N_HEAD = range(8)
FEW_UPDATES = 3_000_000  # multiplications of a program: up to here, it pays for any matrix of this kind ...
SPARSE = 1e-3  # ... and beyond, where they are at most this share of n^3 ...
MOST_UPDATES = 30_000_000  # ... and no more than this, for their memory: four bytes each


def static_program(
    n_q: int,
    n_rows: int,
    mass: Entries,
    jacobian: Entries,
    together: Iterable[Sequence[int]] = (),
    stiff_rows: Sequence[int] = (),
) -> NDArray[np.int32] | None:
    """The program for M and G with these entries; None where there would be too many updates.

    Parameters
    ----------
    n_q, n_rows : int
    mass, jacobian : (rows, columns)
        Of M, both triangles, and of G. An entry may occur more than once: the numbers are added.
    together : iterable of sequence of int
        Coordinates of one body each, as far as they are known.
    stiff_rows : sequence of int
        Rows g along which M is to be stiffened, by a multiple of g g^T, whose entries M has.
    """
    order = elimination_order(n_q, n_rows, mass, jacobian, together, stiff_rows)
    return program_in_order(order, n_q, mass, jacobian, stiff_rows)


def program_in_order(
    order: Integers, n_q: int, mass: Entries, jacobian: Entries, stiff_rows: Sequence[int], both: bool = False
) -> NDArray[np.int32] | None:
    """The same for an order. `both`: of unsymmetric factors, whose rows of U stand N_OFF behind the columns of L."""
    n = len(order)
    position = np.empty(n, dtype=np.int64)
    position[order] = np.arange(n)
    rows = np.concatenate([position[mass[0]], position[n_q + jacobian[0]]])
    columns = np.concatenate([position[mass[1]], position[jacobian[1]]])
    low, high = np.minimum(rows, columns), np.maximum(rows, columns)
    below = _columns_of_factors(n, low, high)
    sizes = np.array([len(each) for each in below], dtype=np.int64)
    if (sizes * (sizes + 1) // 2).sum() > max(FEW_UPDATES, min(MOST_UPDATES, SPARSE * n**3)):
        return None
    begin = np.concatenate([[0], np.cumsum(sizes)])
    row_of = np.concatenate([np.zeros(0, np.int64), *below])
    column_of = np.repeat(np.arange(n), sizes)
    keys = column_of * n + row_of  # ascending

    def slots(column: Integers, row: Integers) -> Integers:
        found = n + np.searchsorted(keys, column * n + row)
        return np.where(column == row, column, found)

    firsts, seconds = [row_of[:0]], [row_of[:0]]
    for each in below:
        i, j = _pairs(len(each))
        firsts.append(each[i])
        seconds.append(each[j])
    targets = slots(np.concatenate(firsts), np.concatenate(seconds))
    source = slots(low, high)
    n_mass = len(mass[0])
    above = rows[:n_mass] < columns[:n_mass]  # the other triangle: without U, of a slot that is never read
    source[:n_mass][above] = source[:n_mass][above] + len(keys) if both else n + len(keys)
    which, first, second = _products(jacobian[0], stiff_rows)
    one, other = (position[jacobian[1][each]] for each in (first, second))
    stiffened = [which, first, second, slots(np.minimum(one, other), np.maximum(one, other))]
    head = [n_q, n, len(keys), len(targets), n_mass, len(jacobian[0]), len(which)]
    parts = [order, begin, row_of, targets, *mass, source[:n_mass], *jacobian, source[n_mass:], *stiffened]
    return np.concatenate([np.array(head), *parts]).astype(np.int32)


def _products(rows: Integers, chosen: Sequence[int]) -> tuple[Integers, Integers, Integers]:
    """All products of two entries of one of these rows: the row, and where the entries are."""
    parts: list[tuple[Integers, Integers, Integers]] = [(rows[:0], rows[:0], rows[:0])]
    where = np.argsort(rows, kind="stable")
    ordered = rows[where]
    for row in chosen:
        here = where[np.searchsorted(ordered, row) : np.searchsorted(ordered, row + 1)]
        one, other = _pairs(len(here))
        parts.append((np.full(len(one), row), here[one], here[other]))
    which, first, second = (np.concatenate(each) for each in zip(*parts, strict=True))
    return which, first, second


_PAIRS: dict[int, Entries] = {}


def _pairs(m: int) -> Entries:
    """First and second of all pairs of m things, each with itself too."""
    if m not in _PAIRS:
        _PAIRS[m] = tuple(each.astype(np.int64) for each in np.triu_indices(m))  # type: ignore[assignment]
    return _PAIRS[m]


def _columns_of_factors(n: int, low: Integers, high: Integers) -> list[Integers]:
    """The rows below the diagonal of each column of L, ascending: a column passes its own on to the first of them."""
    below: list[set[int]] = [set() for _ in range(n)]
    for column, row in zip(low.tolist(), high.tolist(), strict=True):
        below[column].add(row)
    made = []
    for column in range(n):
        below[column].discard(column)
        rows = sorted(below[column])
        if rows:
            below[rows[0]].update(rows[1:])
        made.append(np.array(rows, dtype=np.int64))
        below[column] = set()
    return made


@inlined
def behind(program):
    """Where what stands behind these sections begins."""
    first = N_HEAD + 2 * program[N_PIVOTS] + 1 + program[N_OFF] + program[N_UPDATES]
    return first + 3 * (program[N_OF_MASS] + program[N_OF_JACOBIAN]) + 4 * program[N_STIFFENED]


@inlined
def order_of(program):
    """Which coordinate, or n_q + which row, each pivot is of."""
    return program[N_HEAD : N_HEAD + program[N_PIVOTS]]


@inlined
def columns_of(program):
    """Where the columns of L begin, and the last one ends; and the place of each entry among the pivots."""
    first = N_HEAD + program[N_PIVOTS]
    middle = first + program[N_PIVOTS] + 1
    return program[first:middle], program[middle : middle + program[N_OFF]]


@inlined
def targets_of(program):
    """The slots that the updates change, pivot by pivot."""
    first = N_HEAD + 2 * program[N_PIVOTS] + 1 + program[N_OFF]
    return program[first : first + program[N_UPDATES]]


@inlined
def mass_of(program):
    """Rows, columns and slots of the values of M."""
    n = program[N_OF_MASS]
    first = N_HEAD + 2 * program[N_PIVOTS] + 1 + program[N_OFF] + program[N_UPDATES]
    return program[first : first + n], program[first + n : first + 2 * n], program[first + 2 * n : first + 3 * n]


@inlined
def jacobian_of(program):
    """Rows, columns and slots of the values of G."""
    n = program[N_OF_JACOBIAN]
    first = N_HEAD + 2 * program[N_PIVOTS] + 1 + program[N_OFF] + program[N_UPDATES] + 3 * program[N_OF_MASS]
    return program[first : first + n], program[first + n : first + 2 * n], program[first + 2 * n : first + 3 * n]


@inlined
def stiffened_of(program):
    """Rows, two entries of each, and slots of the products that M is stiffened by."""
    n = program[N_STIFFENED]
    first = N_HEAD + 2 * program[N_PIVOTS] + 1 + program[N_OFF] + program[N_UPDATES]
    first += 3 * (program[N_OF_MASS] + program[N_OF_JACOBIAN])
    middle = first + 2 * n
    slots = program[middle + n : middle + 2 * n]
    return program[first : first + n], program[first + n : middle], program[middle : middle + n], slots
