"""Coefficients that generated code reads when it runs, so that it serves all mechanisms of the same structure."""

import math
from collections.abc import Iterable, Mapping
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from twoloop.generate.graph import Affine, rounded
from twoloop.generate.parameter_expressions import Parameter, ParameterTape, Powers, array_of
from twoloop.generate.program import Program

Terms = tuple[tuple[int, float], ...]  # quantities and their coefficients

IN_THE_CODE = (0.0, 1.0, -1.0)  # coefficients that are literals in the code, as they need no multiplication
ROUNDING = 8.0 * 2.0**-52  # relative: coefficients that differ by less from one of IN_THE_CODE are replaced by it


class Coefficient(float):
    """Coefficient that is read from an index of a memory; equal to no other, whatever their values.

    Coefficients that vary with parameters may have a memory of their own.
    """

    __slots__ = ("place", "varies")
    place: int
    varies: bool

    def __new__(cls, value: float, place: int, varies: bool = False) -> "Coefficient":
        """Create the coefficient stored at an index of the array of numbers."""
        coefficient = super().__new__(cls, value)
        coefficient.place, coefficient.varies = place, varies
        return coefficient

    def __eq__(self, other: object) -> bool:
        return self is other

    def __hash__(self) -> int:
        return id(self)

    def __repr__(self) -> str:
        return f"{'varying' if self.varies else 'number'} {self.place}"


class Coefficients:
    """Numbering of the coefficients of expressions: assigns indices in the order of their first use.

    Equal expressions share their places. `apart`: coefficients that vary with parameters have a memory of their own, as
    each SIMD lane has other values.
    """

    def __init__(self, apart: bool = False) -> None:
        self._apart = apart
        self._values: list[float] = []
        self._formulas: Any = np.zeros(0)
        self._varying: dict[tuple[float, Powers], Parameter] = {}
        self._numbered: dict[tuple[Terms, float], tuple[Terms, float]] = {}
        self._of_forms: dict[Any, tuple[Terms, float]] = {}

    @property
    def values(self) -> NDArray[np.float64]:
        """Return the numbers that the code reads."""
        return np.array(self._values, dtype=np.float64)

    @property
    def formulas(self) -> Any:
        """Return these numbers as expressions in the parameters; the array object changes only if numbers are added."""
        if len(self._formulas) != len(self._values):
            self._formulas = array_of(self._values)
        return self._formulas

    def of(self, terms: Terms, constant: float = 0.0) -> tuple[Terms, float]:
        """Replace the numbers of terms and a constant by coefficients."""
        key = tuple((i, rounded(c)) for i, c in terms), rounded(constant)
        numbers = self._numbered.get(key)
        if numbers is None:
            numbers = self._numbered[key] = tuple((i, self._number(c)) for i, c in terms), self._number(constant)
        return numbers

    def of_form(self, form: Affine) -> tuple[Terms, float]:
        """Replace the numbers of an affine expression by coefficients."""
        numbers = self._of_forms.get(form.key)
        if numbers is None:
            numbers = self._of_forms[form.key] = self.of(tuple(form.terms.items()), form.constant)
        return numbers

    def structure(self, program: Program, given: Mapping[int, int] = MappingProxyType({})) -> Iterable[Any]:
        """List what code for a program depends on, but for values of numbers; `given`: indices of given quantities."""
        graph, forms = program.graph, program.forms
        needed = graph.needed_by(forms, given)
        name: dict[int, Any] = {i: f"input {i}" for i, each in enumerate(graph.operations) if each is None}
        name |= {i: k for k, i in enumerate(needed)}
        name |= {i: f"kept {place}" for i, place in given.items()}

        def described(form: Affine) -> Any:
            terms, constant = self.of_form(form)
            return [(name[i], c) for i, c in terms], constant

        yield [described(form) for form in forms]
        for i in needed:
            kind, *arguments = graph.operations[i]  # type: ignore[misc]
            yield kind, [described(each) for each in arguments if isinstance(each, Affine)]

    @property
    def n_varying(self) -> int:
        """Return the number of coefficients that vary with parameters."""
        return len(self._varying)

    def for_parameters(self, record: ParameterTape, parameters: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the varying coefficients for parameters (n_runs, n_p), one row for each run."""
        return record.evaluate(list(self._varying.values()), parameters)

    def _number(self, value: float) -> float:
        if type(value) is Parameter:  # a parameter's present value is no literal
            if self._apart:
                expression = value.scale, value.powers
                self._varying.setdefault(expression, value)
                return Coefficient(value, list(self._varying).index(expression), varies=True)
        elif (exact := in_the_code(value)) is not None:
            return exact
        self._values.append(value)
        return Coefficient(value, len(self._values) - 1)


def in_the_code(value: float) -> float | None:
    """Return the literal for a number, or None if it must be a coefficient."""
    if type(value) is Parameter or not math.isfinite(value):
        return None
    near = float(round(value))
    return near if near in IN_THE_CODE and abs(value - near) <= ROUNDING * abs(near) else None
