"""Decide from traces whether forces or drives may act for a short time, or vary much over a short distance."""

import math
from collections.abc import Callable, Iterable, Mapping
from types import MappingProxyType
from typing import Any, NamedTuple

from twoloop.generate.graph import Affine, Graph, Untraceable
from twoloop.generate.parameter_expressions import Parameter
from twoloop.generate.program import Algebra
from twoloop.generate.trace import Evaluator, TraceCache, derive_cached
from twoloop.generate.traced_values import accept_traces
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

TIME_CALLBACKS = ("force", "constraint_rate", "nonholonomic_rate")  # callbacks whose dependence on time is analysed
# callbacks whose dependence on the state is analysed
STATE_CALLBACKS = ("force", "mass", "constraint", "jacobian", "nonholonomic")
SMOOTH_OPERATIONS = (PRODUCT, SUM, SINE, COSINE)  # operations without short pulses if degrees are at most MAX_DEGREE
MAX_DEGREE = 8  # polynomials in time, or in sines and cosines, have no short pulses up to this degree
MAX_DEGREE_OF_STATE = 32  # polynomials in q and v, and their roots, have no short pulses up to this degree
MAX_DEGREE_OF_DIVISOR = 4  # up to this total degree of its divisors, in q and v, a quotient has no short pulses
FASTEST_DECAY = -2.0  # quotients that decay as x^p with smaller p may have short pulses; 1 / (1 + (x / w)**2) has none
MAX_RATE = 4.0  # a sine is not steep if its argument changes by at most this per unit of a coordinate or velocity
# systems with more coordinates are not traced for this analysis: that may take ten times as long as sampling the forces
MAX_COORDINATES = 300
TIME_MASK = 1  # bit mask of t, the first input of a graph


class ShortForces(NamedTuple):
    """Whether forces or drives may have short pulses, as functions of t, and as functions of q or v."""

    by_time: bool  # a force, C_t or b may have short pulses as a function of time
    by_state: bool  # a force may have short pulses as a function of q or v


class Dependence(NamedTuple):
    """Result of the analysis of the callbacks of systems; all systems of a trace cache share it."""

    short_forces: ShortForces
    is_steep: bool  # whether forces or drives may be steep, see `forces_may_be_steep`
    kinds: frozenset[str]  # kinds of callbacks that were traced

    def specialize(self, system: ConstrainedSystem, evaluate: Evaluator) -> "Dependence":
        """Return this result, which is the same for all systems of the trace cache."""
        return self


def find_short_forces(system: ConstrainedSystem, force_was_traced: bool) -> ShortForces:
    """Return whether forces, C_t or b may have short pulses in time, and whether forces may have them in q or v.

    If callbacks cannot be traced, both are true. Systems with more than MAX_COORDINATES coordinates are not traced, and
    only the first is true. Python functions may store their arguments: they are traced only if the force was.
    """
    if system.n_q > MAX_COORDINATES:
        return ShortForces(True, False)
    dependence = _dependence(system, force_was_traced)
    return ShortForces(True, True) if dependence is None else dependence.short_forces


def forces_may_be_steep(system: ConstrainedSystem, force_was_traced: bool) -> bool:
    """Return whether forces may act for a short time, or vary much over a distance shorter than a step.

    Quotients and roots may vary in this way: the stages of a long step may evaluate 1 / (1 + (x / w)**2) on its flanks,
    but not at its peak. Stages may also evaluate a fast vibration at nearly equal phases.
    """
    if any(find_short_forces(system, force_was_traced)):
        return True
    dependence = _dependence(system, force_was_traced)
    return dependence is None or dependence.is_steep


def _dependence(system: ConstrainedSystem, force_was_traced: bool) -> Dependence | None:
    """Return the cached analysis of a system; None if its callbacks cannot, or should not yet, be traced."""
    if system.called_in_python and not force_was_traced:
        return None
    try:
        dependence: Dependence = derive_cached(system, "dependence", _make_analysis(system), accept_traces)
    except Untraceable:
        return None
    return dependence


def _make_analysis(system: ConstrainedSystem) -> Any:
    def analyse(cache: TraceCache) -> Dependence:
        equations = cache.equations(system)

        def quantities_of(kinds: tuple[str, ...]) -> list[int]:
            exprs = [expr for kind in kinds if kind in system.given for expr in equations.expressions(kind).ravel()]
            return equations.graph.quantities_for(exprs)

        graph = equations.graph
        by_state, by_time = quantities_of(STATE_CALLBACKS), quantities_of(TIME_CALLBACKS)
        short_forces = ShortForces(_has_time_pulses(graph, by_time), _has_state_pulses(graph, by_state, system.n_q))
        is_steep = _quantities_may_be_steep(graph, sorted({*by_state, *by_time}))
        return Dependence(short_forces, is_steep, frozenset(graph.traced))

    return analyse


class DegreeAlgebra(Algebra[float]):
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

    def affine(self, expr: Affine) -> float:
        """Return the degree of an affine expression, which is the largest degree of its terms."""
        return max((self.values.get(i, 0.0) for i in expr.terms), default=0.0)

    def product(self, a: float, b: float) -> float:
        """Return the degree of a product of factors of degrees a and b."""
        return a + b


class TrigonometricDegrees(DegreeAlgebra):
    """Algebra of degrees in sines and cosines; their high powers are nearly zero between short pulses."""

    functions = MappingProxyType(
        {**DegreeAlgebra.functions, **dict.fromkeys((SINE, COSINE), lambda degree: max(degree, 1.0))}
    )


class GrowthExponents(DegreeAlgebra):
    """Algebra of growth: a value is the exponent p with which a quantity grows, like x^p, for large inputs x."""

    functions = MappingProxyType(
        {**DegreeAlgebra.functions, RECIPROCAL: lambda p: -p, **dict.fromkeys((SINE, COSINE), lambda p: 0.0)}
    )


class DivisorDegrees(DegreeAlgebra):
    """Algebra of divisors: a value is the sum of the degrees of all divisors in a quantity.

    Arguments of arctangents count, too, because the derivatives of arctangents are quotients.
    """

    def __init__(self, degrees: DegreeAlgebra):
        super().__init__()
        self._degrees = degrees

    def operation(self, kind: int, first: Affine, second: Affine | None) -> float:
        """Return the total degree of the divisors in the result of an operation."""
        degree = super().operation(kind, first, second)
        return degree + self._degrees.affine(first) if kind in (RECIPROCAL, ARCTANGENT) else degree


class DerivativeBounds(DegreeAlgebra):
    """Algebra of rates: a value bounds the derivative of a quantity with respect to any one coordinate or velocity.

    If a parameter is a factor, the bound is infinite, because the parameter may have any value.
    """

    def affine(self, expr: Affine) -> float:
        """Return the largest bound of a derivative among the terms of an affine expression."""
        return max(
            (math.inf if type(c) is Parameter else abs(c) * self.values.get(i, 1.0) for i, c in expr.terms.items()),
            default=0.0,
        )


def _has_time_pulses(graph: Graph, quantities: list[int]) -> bool:
    """Return whether one of the `quantities` may have short pulses as a function of time."""
    dependent = [i for i in quantities if graph.input_masks[i] & TIME_MASK]
    degrees = DegreeAlgebra([0])  # degrees of quantities as polynomials in time, or in sines and cosines of time
    degrees.run(graph, dependent)
    return any(graph.kind(i) not in SMOOTH_OPERATIONS or degrees.values[i] > MAX_DEGREE for i in dependent)


def _has_state_pulses(graph: Graph, quantities: list[int], n_q: int) -> bool:
    """Return whether one of the `quantities` may have short pulses as a function of q or v."""
    dependent = [i for i in quantities if graph.input_masks[i] & ~TIME_MASK]
    inputs = range(1, 2 * n_q + 1)
    degrees, vibrations, growth = DegreeAlgebra(inputs), TrigonometricDegrees(), GrowthExponents(inputs)
    divisors = DivisorDegrees(degrees)
    for algebra in (degrees, vibrations, growth, divisors):
        algebra.run(graph, dependent)
    return any(
        graph.kind(i) == EXPONENTIAL
        or degrees.values[i] > MAX_DEGREE_OF_STATE
        or divisors.values[i] > MAX_DEGREE_OF_DIVISOR
        or growth.values[i] < FASTEST_DECAY
        or vibrations.values[i] > MAX_DEGREE
        for i in dependent
    )


def _quantities_may_be_steep(graph: Graph, quantities: list[int]) -> bool:
    """Return whether one of the `quantities` may vary much over a distance shorter than a step.

    Such a quantity uses an operation other than sums, products, sines and cosines; or a sine or cosine of time; or a
    sine or cosine of an argument whose derivative by a coordinate or velocity exceeds MAX_RATE.
    """
    if any(graph.kind(i) not in SMOOTH_OPERATIONS for i in quantities):
        return True
    rates = DerivativeBounds()
    rates.run(graph, quantities)
    vibrations = [i for i in quantities if graph.kind(i) in (SINE, COSINE)]
    return any(rates.values[i] > MAX_RATE or graph.input_masks[i] & TIME_MASK for i in vibrations)
