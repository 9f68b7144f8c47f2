"""The tables that the loops of `series_loops` read: which quantities times which coefficients make which.

Operations of one kind that do not depend on one another, and whose forms have about as many terms, are a run, in groups
of four.
"""

from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

from twoloop.generate.coefficients import Coefficients, Terms, in_the_code
from twoloop.generate.series import SeriesProgram, Table
from twoloop.generate.series_groups import WIDTH, rounded, terms_of
from twoloop.generate.tracing import rounded as told_apart
from twoloop.kernels.evaluation.operations import ARCTANGENT, LOGARITHM, PENDING, PRODUCT, SINE, SUM

OF_TWO = (PRODUCT, LOGARITHM, ARCTANGENT)  # operations of two arguments
UNROLLED = 4  # terms of a form up to which they are no loop of their own
FEW = 3  # groups; a run of fewer takes over those of the next, whose forms have more terms


class Forms(NamedTuple):
    """Forms in groups of four: by group and term, four columns and coefficients side by side."""

    n_terms: int
    columns: list[int]
    factors: list[float] | None  # of each term, 1 or -1, if all are these ...
    coefficients: int  # ... else at which place of the numbers they begin
    constants: int | None  # at which place they begin, if there are any


class Run(NamedTuple):
    """Groups of operations of one kind, which are done in a loop."""

    kind: int
    place: int  # of the first in a row of factors
    n_groups: int
    quantity: int  # the first that they make, the others follow ...
    results: list[int]  # ... but those of sines and cosines, which are these
    forms: list[Forms]  # arguments


class Scattered(NamedTuple):
    """Forms that are entries of a right-hand side, and which."""

    n_groups: int
    places: list[int]
    forms: Forms


class Side(NamedTuple):
    """The runs of early, or of late, operations, and where their factors stand in a row."""

    runs: list[Run]
    waiting: list[Run]  # for the second factors that wait for the solution of an order
    begin: int
    end: int


Form = tuple[Terms, float]


class LoopTables:
    """The tables of a program.

    Attributes
    ----------
    early, late : Side
    rows, balance : list of Scattered
        Entries of the right-hand sides.
    n_quantities : int
        Places of an order: of the program's quantities, and of forms that are summed up once.
    """

    def __init__(self, program: SeriesProgram, numbers: Coefficients):
        self._numbers = numbers
        self._places: dict[Any, int] = {}  # of forms that are summed up
        self.n_quantities = rounded(program.n_nodes) + WIDTH
        self.early = self._side(program.early, 0, 1 + 3 * program.n_q + program.n_rows)
        self.late = self._side(program.late, self.early.end, program.n_nodes - len(program.late.first.column))
        self.rows = self._scattered(terms_of(program.rows, program.row_places.tolist()), program.row_places.tolist())
        balance, places = terms_of(program.balance, program.balance_places.tolist()), program.balance_places.tolist()
        self.balance = self._scattered(balance, places)

    def _side(self, table: Table, place: int, quantity: int) -> Side:
        first, second = (terms_of(sums, range(len(sums.column))) for sums in (table.first, table.second))
        runs: list[Run] = []
        waiting: list[Run] = []
        begins_at = place
        for kind, begin, end in table.groups[:, :3].tolist():
            operations, used = range(begin, end), [first, second] if kind in OF_TWO else [first]
            runs += self._sums([each[o] for each in used for o in operations])
            for members in _in_runs(kind, begin, end, lambda _: 1):
                forms = [self._summed([each[o] for o in members]) for each in used]
                results = [quantity + o for o in members] if kind == SINE else []
                runs.append(Run(kind, place, len(members) // WIDTH, quantity + members[0], results, forms))
                if kind == PENDING:
                    own = [second[o] for o in members]
                    waiting += [*self._sums(own), runs[-1]._replace(forms=[self._summed(own)])]
                place += len(members)
        return Side(runs, waiting, begins_at, place)

    def _summed(self, forms: Sequence[Form]) -> Forms:
        """Forms as the quantities that they are, or that they were summed up to."""
        columns = [form[0][0][0] if _is_quantity(form) else self._places[_key(form)] for form in forms]
        return self._forms([(((column, 1.0),), 0.0) for column in columns])

    def _sums(self, forms: Sequence[Form]) -> list[Run]:
        """Runs that sum up those forms that are no quantities and were not summed up before."""
        new = {_key(form): form for form in forms if not _is_quantity(form)}
        kept = sorted((form for key, form in new.items() if key not in self._places), key=lambda form: len(form[0]))
        first = self.n_quantities
        self._places |= {_key(form): first + k for k, form in enumerate(kept)}
        self.n_quantities += rounded(len(kept))
        return [
            Run(SUM, 0, len(members) // WIDTH, first + members[0], [], [self._forms([kept[k] for k in members])])
            for members in _in_runs(SUM, 0, len(kept), lambda k: len(kept[k][0]))
        ]

    def _scattered(self, forms: Sequence[Form], places: Sequence[int]) -> list[Scattered]:
        order = sorted(range(len(forms)), key=lambda k: len(forms[k][0]))
        made = []
        for run in _in_runs(PRODUCT, 0, len(order), lambda k: len(forms[order[k]][0])):
            members = [order[k] for k in run]
            own = self._forms([forms[k] for k in members])
            made.append(Scattered(len(members) // WIDTH, [places[k] for k in members], own))
        return made

    def _forms(self, forms: Sequence[Form]) -> Forms:
        n_terms = max(len(terms) for terms, _ in forms)
        padded = [[*terms, *[(0, 0.0)] * (n_terms - len(terms))] for terms, _ in forms]
        groups = range(0, len(forms), WIDTH)
        ordered = [padded[g + lane][t] for g in groups for t in range(n_terms) for lane in range(WIDTH)]
        factors: Any = []
        for t in range(n_terms):
            factors += {in_the_code(terms[t][1]) for terms in padded}
        allowed = (1.0, -1.0) if n_terms <= UNROLLED else (1.0,)
        plain = len(factors) == n_terms and all(factor in allowed for factor in factors)
        coefficients = 0 if plain else self._numbers.in_memory(c for _, c in ordered)
        there = any(constant != 0.0 for _, constant in forms)
        constants = self._numbers.in_memory(constant for _, constant in forms) if there else None
        return Forms(n_terms, [i for i, _ in ordered], factors if plain else None, coefficients, constants)


def _key(form: Form) -> Any:
    terms, constant = form
    return tuple((i, told_apart(c)) for i, c in terms), told_apart(constant)


def _is_quantity(form: Form) -> bool:
    terms, constant = form
    return len(terms) == 1 and in_the_code(terms[0][1]) == 1.0 and in_the_code(constant) == 0.0


def _in_runs(kind: int, begin: int, end: int, size: Callable[[int], int]) -> Iterator[list[int]]:
    """Operations of one kind in runs of forms of about one size; each in groups of four, of which the last is repeated.

    Of sines the cosines of the same angles are the second half of a group.
    """
    halves = 2 if kind == SINE else 1
    half, each = (end - begin) // halves, WIDTH // halves
    run: list[int] = []
    sizes: list[int] = []
    for part in range(0, half, each):
        members = [begin + h * half + min(part + k, half - 1) for h in range(halves) for k in range(each)]
        largest = max(map(size, members))
        if len(sizes) >= FEW and largest != sizes[-1]:
            yield run
            run, sizes = [], []
        run += members
        sizes.append(largest)
    if run:
        yield run
