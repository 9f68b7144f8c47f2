"""Numbers that code made for a mechanism reads when it runs: one code serves all mechanisms of its structure."""

import math
from collections.abc import Iterable, Mapping
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from twoloop.generate.graph import Affine, Graph, rounded
from twoloop.generate.parameter_expressions import Parameter, ParameterTape, Powers, array_of

Terms = tuple[tuple[int, float], ...]  # quantities and their coefficients

IN_THE_CODE = (0.0, 1.0, -1.0)  # which take no multiplication, and what differs from these by rounding
ROUNDING = 8.0 * 2.0**-52


class Coefficient(float):
    """A coefficient that stands at a place in memory; equal to no other, whatever their values are.

    Those that vary with parameters stand in a place of their own.
    """

    __slots__ = ("place", "varies")
    place: int
    varies: bool

    def __new__(cls, value: float, place: int, varies: bool = False) -> "Coefficient":
        """A number for a place."""
        made = super().__new__(cls, value)
        made.place, made.varies = place, varies
        return made

    def __eq__(self, other: object) -> bool:
        return self is other

    def __hash__(self) -> int:
        return id(self)

    def __repr__(self) -> str:
        return f"{'varying' if self.varies else 'number'} {self.place}"


class Coefficients:
    """The coefficients of forms, in the order in which these are met first; the same form has the same numbers.

    `apart`: those that vary with parameters stand in a memory of their own, as each lane has its own.
    """

    def __init__(self, apart: bool = False) -> None:
        self._apart = apart
        self._values: list[float] = []
        self._formulas: Any = np.zeros(0)
        self._varying: dict[tuple[float, Powers], Parameter] = {}
        self._known: dict[tuple[Terms, float], tuple[Terms, float]] = {}
        self._of_forms: dict[Any, tuple[Terms, float]] = {}

    @property
    def values(self) -> NDArray[np.float64]:
        """What code reads."""
        return np.array(self._values, dtype=np.float64)

    @property
    def formulas(self) -> Any:
        """The same, as formulas where they know their parameters: one array, until there are more."""
        if len(self._formulas) != len(self._values):
            self._formulas = array_of(self._values)
        return self._formulas

    def of(self, terms: Terms, constant: float = 0.0) -> tuple[Terms, float]:
        """Terms and constant with numbers in their places."""
        key = tuple((i, rounded(c)) for i, c in terms), rounded(constant)
        known = self._known.get(key)
        if known is None:
            known = self._known[key] = tuple((i, self._number(c)) for i, c in terms), self._number(constant)
        return known

    def of_form(self, form: Affine) -> tuple[Terms, float]:
        """The same of a form."""
        known = self._of_forms.get(form.key)
        if known is None:
            known = self._of_forms[form.key] = self.of(tuple(form.terms.items()), form.constant)
        return known

    def structure(
        self, graph: Graph, forms: Iterable[Affine], kept: Mapping[int, int] = MappingProxyType({})
    ) -> Iterable[Any]:
        """What code for these forms depends on, the values of its numbers apart; `kept`: at which places others are."""
        forms = list(forms)
        needed = graph.needed_by(forms, kept)
        name: dict[int, Any] = {i: f"input {i}" for i, each in enumerate(graph.operations) if each is None}
        name |= {i: k for k, i in enumerate(needed)}
        name |= {i: f"kept {place}" for i, place in kept.items()}

        def told(form: Affine) -> Any:
            terms, constant = self.of_form(form)
            return [(name[i], c) for i, c in terms], constant

        yield [told(form) for form in forms]
        for i in needed:
            kind, *arguments = graph.operations[i]  # type: ignore[misc]
            yield kind, [told(each) for each in arguments if isinstance(each, Affine)]

    @property
    def n_varying(self) -> int:
        """How many vary with parameters."""
        return len(self._varying)

    def for_parameters(self, record: ParameterTape, parameters: NDArray[np.float64]) -> NDArray[np.float64]:
        """Those that vary, for parameters (n_runs, n_p), a row a run."""
        return record.evaluate(list(self._varying.values()), parameters)

    def _number(self, value: float) -> float:
        if type(value) is Parameter:  # which is another number for other parameters, whatever it is now
            if self._apart:
                made_of = value.scale, value.powers
                self._varying.setdefault(made_of, value)
                return Coefficient(value, list(self._varying).index(made_of), varies=True)
        elif (near := in_the_code(value)) is not None:
            return near
        self._values.append(value)
        return Coefficient(value, len(self._values) - 1)


def in_the_code(value: float) -> float | None:
    """A number as it may stand in the code, if it may."""
    if type(value) is Parameter or not math.isfinite(value):
        return None
    near = float(round(value))
    return near if near in IN_THE_CODE and abs(value - near) <= ROUNDING * abs(near) else None
