"""Decide from traces whether forces or drives may be short, or vary much over a short distance."""

import math
from collections.abc import Callable, Iterable, Mapping
from types import MappingProxyType
from typing import Any, NamedTuple

from twoloop.generate.graph import Affine, Graph, Untraceable
from twoloop.generate.parameter_expressions import Parameter
from twoloop.generate.program import Algebra
from twoloop.generate.trace import Evaluator, TraceCache, derive_cached
from twoloop.generate.traced_values import unchecked
from twoloop.kernels.evaluation.operations import (
    ARCTANGENT,
    COSINE,
    EXPONENTIAL,
    LOGARITHM,
    PRODUCT,
    RECIPROCAL,
    SINE,
    SQUARE_ROOT,
    SUM,
)
from twoloop.problem.system import ConstrainedSystem

BY_TIME = ("force", "constraint_rate", "nonholonomic_rate")  # callbacks whose dependence on time is analysed
# callbacks whose dependence on the state is analysed
BY_STATE = ("force", "mass", "constraint", "jacobian", "nonholonomic")
SMOOTH = (PRODUCT, SUM, SINE, COSINE)  # operations whose results, up to MAX_DEGREE, have no short pulses
MAX_DEGREE = 8  # largest degree, in time or in sines and cosines, that excludes pulses, such as cos(t)**100
MAX_DEGREE_OF_STATE = 32  # largest degree of polynomials in q and v, and of their roots, without short pulses
MAX_DEGREE_OF_DIVISOR = 4  # largest degree of the divisors of a quotient without short pulses
# lowest power of x with which such a quotient may decay for large x: 1 / (1 + (x / w)**2) is allowed, its square is not
SLOWEST_DECAY = -2.0
MAX_RATE = 4.0  # largest rate of a vibration's angle, rad per unit of a coordinate or speed, that long steps resolve
# largest number of coordinates for which callbacks are traced for this analysis: for more, tracing takes up to seconds,
# and sampling the forces in a run a tenth of that
MAX_COORDINATES = 300
TIME = 1  # bit mask of t, the first input of a graph


class ShortForces(NamedTuple):
    """Whether forces or drives may act for a short time: at certain times; at certain positions or speeds."""

    by_time: bool
    by_state: bool


class Dependence(NamedTuple):
    """Result of the analysis of callbacks that several systems share."""

    short: ShortForces
    steep: bool  # see `may_be_steep`
    kinds: frozenset[str]  # kinds of callbacks that were traced

    def of(self, system: ConstrainedSystem, evaluate: Evaluator) -> "Dependence":
        """Return this result for one of the systems: it is the same for all parameters."""
        return self


def may_be_short(system: ConstrainedSystem, force_was_traced: bool) -> ShortForces:
    """Return whether forces, C_t or b may act for a short time; callbacks that cannot be traced may.

    Functions called in Python may store their arguments. They are traced only if the force was traced before
    (`force_was_traced`).
    """
    if system.n_q > MAX_COORDINATES:
        return ShortForces(True, False)
    dependence = _dependence(system, force_was_traced)
    return ShortForces(True, True) if dependence is None else dependence.short


def may_be_steep(system: ConstrainedSystem, force_was_traced: bool) -> bool:
    """Return whether forces may be short, or may vary much over a distance shorter than a step.

    Quotients and roots of the state may do so: a long step may pass over the peak of 1 / (1 + (x / w)**2), although
    its flanks are noticed. The stages of a long step may sample a fast vibration at nearly the same phase.
    """
    if any(may_be_short(system, force_was_traced)):
        return True
    dependence = _dependence(system, force_was_traced)
    return dependence is None or dependence.steep


def _dependence(system: ConstrainedSystem, force_was_traced: bool) -> Dependence | None:
    if system.called_in_python and not force_was_traced:
        return None
    try:
        dependence: Dependence = derive_cached(system, "dependence", _analyse(system), unchecked)
    except Untraceable:
        return None
    return dependence


def _analyse(system: ConstrainedSystem) -> Any:
    def make(cache: TraceCache) -> Dependence:
        equations = cache.equations(system)

        def needed(kinds: tuple[str, ...]) -> list[int]:
            forms = [form for kind in kinds if kind in system.given for form in equations.of(kind).ravel()]
            return equations.graph.needed_by(forms)

        graph = equations.graph
        by_state = needed(BY_STATE)
        short = ShortForces(_is_short_in_time(graph, needed(BY_TIME)), _is_short_in_state(graph, by_state, system.n_q))
        steep = _is_steep(graph, sorted({*by_state, *needed(BY_TIME)}))
        return Dependence(short, steep, frozenset(graph.traced))

    return make


class Degrees(Algebra[float]):
    """Algebra of degrees: the value of a quantity is its degree, as if it were a polynomial in some of the inputs."""

    functions: Mapping[int, Callable[[float], float]] = MappingProxyType(
        {
            **dict.fromkeys((RECIPROCAL, EXPONENTIAL, SINE, COSINE, LOGARITHM, ARCTANGENT), lambda degree: degree),
            SQUARE_ROOT: lambda degree: 0.5 * degree,
        }
    )

    def __init__(self, inputs: Iterable[int] = ()):
        super().__init__()
        self.values = dict.fromkeys(inputs, 1.0)

    def affine(self, expression: Affine) -> float:
        """Return the degree of a sum, the largest degree of its terms."""
        return max((self.values.get(i, 0.0) for i in expression.terms), default=0.0)

    def product(self, a: float, b: float) -> float:
        """Return the degree of a product, the sum of the degrees of its factors."""
        return a + b


class Vibrations(Degrees):
    """Algebra of degrees in sines and cosines, whose high powers are flat between pulses."""

    functions = MappingProxyType(
        {**Degrees.functions, **dict.fromkeys((SINE, COSINE), lambda degree: max(degree, 1.0))}
    )


class Growth(Degrees):
    """Algebra of growth: power of x with which a quantity grows for large x; negative for reciprocals."""

    functions = MappingProxyType(
        {
            **Degrees.functions,
            RECIPROCAL: lambda power: -power,
            **dict.fromkeys((SINE, COSINE), lambda power: 0.0),
        }
    )


class Divisors(Degrees):
    """Algebra of divisors: total degree of all divisors in a quantity; an arctangent counts, as its slope is one."""

    def __init__(self, degrees: Degrees):
        super().__init__()
        self._degrees = degrees

    def operation(self, kind: int, first: Affine, second: Affine | None) -> float:
        """Return the degree of the divisors in the result of an operation."""
        degree = super().operation(kind, first, second)
        return degree + self._degrees.affine(first) if kind in (RECIPROCAL, ARCTANGENT) else degree


class Rates(Degrees):
    """Algebra of rates: upper bound of the derivative of each quantity with respect to a coordinate or speed.

    The rate of a coordinate times a parameter is infinite, as the parameter may have any value.
    """

    def affine(self, expression: Affine) -> float:
        """Return the largest rate of the terms of a sum."""
        return max(
            (
                math.inf if type(c) is Parameter else abs(c) * self.values.get(i, 1.0)
                for i, c in expression.terms.items()
            ),
            default=0.0,
        )


def _is_short_in_time(graph: Graph, needed: list[int]) -> bool:
    depending = [i for i in needed if graph.inputs_of[i] & TIME]
    degrees = Degrees([0])  # degrees in time, or in vibrations with time
    degrees.run(graph, depending)
    return any(graph.kind(i) not in SMOOTH or degrees.values[i] > MAX_DEGREE for i in depending)


def _is_short_in_state(graph: Graph, needed: list[int], n_q: int) -> bool:
    depending = [i for i in needed if graph.inputs_of[i] & ~TIME]
    inputs = range(1, 2 * n_q + 1)
    degrees, vibrations, growth = Degrees(inputs), Vibrations(), Growth(inputs)
    divisors = Divisors(degrees)
    for algebra in (degrees, vibrations, growth, divisors):
        algebra.run(graph, depending)
    return any(
        graph.kind(i) == EXPONENTIAL
        or degrees.values[i] > MAX_DEGREE_OF_STATE
        or divisors.values[i] > MAX_DEGREE_OF_DIVISOR
        or growth.values[i] < SLOWEST_DECAY
        or vibrations.values[i] > MAX_DEGREE
        for i in depending
    )


def _is_steep(graph: Graph, needed: list[int]) -> bool:
    """Return whether a quantity is a quotient, a root, a vibration in time, or a fast vibration in the state."""
    if any(graph.kind(i) not in SMOOTH for i in needed):
        return True
    rates = Rates()
    rates.run(graph, needed)
    vibrations = [i for i in needed if graph.kind(i) in (SINE, COSINE)]
    return any(rates.values[i] > MAX_RATE or graph.inputs_of[i] & TIME for i in vibrations)
