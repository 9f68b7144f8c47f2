"""The operations of a program in groups that are done side by side, as vectors, by code compiled for a mechanism."""

from collections.abc import Sequence
from typing import NamedTuple

from twoloop.generate.coefficients import Coefficients, Terms
from twoloop.generate.series import SeriesProgram, Sums, Table
from twoloop.kernels.evaluation.operations import PENDING, SINE

# doubles of the widest vector: with 8, which this processor also has, a four-bar takes a third more time
WIDTH = 4


class Argument(NamedTuple):
    """A form."""

    terms: Terms
    constant: float


class Row(NamedTuple):
    """A form that is an entry of a right-hand side."""

    place: int
    terms: Terms
    constant: float


class Group(NamedTuple):
    """1, 2 or 4 operations of one kind that do not depend on one another; of fewer the last is repeated.

    Of sines the cosines of the same angles are the second half.
    """

    kind: int
    place: int  # of the first in a row of factors
    width: int
    quantities: list[int]  # that they make
    first: list[Argument]
    second: list[Argument]

    @property
    def pending(self) -> bool:
        """Whether the second factors wait for the solution of an order."""
        return self.kind == PENDING


class Groups:
    """The groups of a program.

    Attributes
    ----------
    early, late : list of Group
        In an order in which they can be done.
    rows, balance : list of Row
    width : int
        Of a row of factors, of all groups.
    first : int
        Number of the first quantity that an operation makes.
    n_early : int
        Number of quantities that early operations make.
    kept : set of int
        Quantities that late operations of an order use, and the balance.
    """

    def __init__(self, program: SeriesProgram, numbers: Coefficients):
        self.first = 1 + 3 * program.n_q + program.n_rows
        self.n_early = len(program.early.first.column)
        tables = [
            _groups(program.early, self.first, numbers),
            _groups(program.late, self.first + self.n_early, numbers),
        ]
        end = 0
        for width in (4, 2, 1):  # each of them aligned
            for groups in tables:
                for k, group in enumerate(groups):
                    if group.width == width:
                        groups[k] = group._replace(place=end)
                        end += width
        self.early, self.late = tables
        self.width = rounded(end)
        self.rows = _rows(program.rows, program.row_places.tolist(), numbers)
        self.balance = _rows(program.balance, program.balance_places.tolist(), numbers)
        arguments = [each for group in self.late for each in (*group.first, *group.second)]
        terms = [each.terms for each in arguments] + [row.terms for row in self.balance]
        self.kept = {quantity for each in terms for quantity, _ in each}

    @property
    def structure(self) -> tuple[object, ...]:
        """All that code for them depends on, the values of its numbers apart."""
        return self.early, self.late, self.rows, self.balance, self.first


def rounded(size: int) -> int:
    """A number of doubles behind which vectors may begin, so many or a few more."""
    return -(-size // WIDTH) * WIDTH


def _terms(sums: Sums, rows: Sequence[int]) -> list[Terms]:
    more: dict[int, list[tuple[int, float]]] = {row: [] for row in rows}
    for row, *term in zip(sums.row.tolist(), sums.more_column.tolist(), sums.more_coefficient.tolist(), strict=True):
        more[row].append((term[0], term[1]))
    firsts = zip(rows, sums.column.tolist(), sums.coefficient.tolist(), strict=True)
    return [tuple(term for term in ((i, c), *more[row]) if term[1] != 0.0) for row, i, c in firsts]


def terms_of(sums: Sums, rows: Sequence[int]) -> list[tuple[Terms, float]]:
    """Forms, which belong to these rows, as terms and constants."""
    return list(zip(_terms(sums, rows), sums.constant.tolist(), strict=True))


def _rows(sums: Sums, places: Sequence[int], numbers: Coefficients) -> list[Row]:
    return [Row(place, *numbers.of(*form)) for place, form in zip(places, terms_of(sums, places), strict=True)]


def _groups(table: Table, quantity: int, numbers: Coefficients) -> list[Group]:
    """Those of a table, whose first operation makes this quantity; they have no places yet."""
    first, second = (
        [Argument(*numbers.of(*each)) for each in terms_of(sums, range(len(sums.column)))]
        for sums in (table.first, table.second)
    )
    groups = []
    for kind, begin, end in table.groups[:, :3].tolist():
        halves = 2 if kind == SINE else 1
        size, most = (end - begin) // halves, WIDTH // halves
        for part in range(0, size, most):
            few = min(most, size - part)
            width = 1 << (few - 1).bit_length()
            members = [begin + h * size + part + min(k, few - 1) for h in range(halves) for k in range(width)]
            arguments = [first[o] for o in members], [second[o] for o in members]
            groups.append(Group(kind, 0, len(members), [quantity + o for o in members], *arguments))
    return groups
