"""Decide from traces whether forces or drives may act for a short time, or vary much over a short distance.

The formulas of the callbacks decide. A *short pulse* is a large value only in a short range of t, or of q or v, such as
that of 1 / (1 + x^4) or of a high power of a sine. Evaluations at the steps of a run may miss such a pulse.
"""

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
# callbacks whose dependence on q and v is analysed
STATE_CALLBACKS = ("force", "mass", "constraint", "jacobian", "nonholonomic")
SMOOTH_OPERATIONS = (PRODUCT, SUM, SINE, COSINE)  # a function of time with another operation may have short pulses
MAX_DEGREE = 8  # polynomials in time, or in sines and cosines, of a higher degree may have short pulses
MAX_DEGREE_OF_STATE = 32  # polynomials in q and v of a higher degree, or square roots of these, may have short pulses
MAX_DEGREE_OF_DIVISOR = 4  # a quantity may have short pulses if the degrees of its divisors in q and v add up to more
FASTEST_DECAY = -2.0  # a quantity may have short pulses if it decays as x^p with p below this value, like 1 / (1 + x^4)
MAX_RATE = 4.0  # a force may be steep if it has a sine or cosine of x, and dx/dq or dx/dv is larger than this
# systems with more coordinates than this are not traced: tracing may take ten times as long as sampling the forces
MAX_COORDINATES = 300
TIME_MASK = 1  # a quantity depends on t (input 0 of the graph) if this bit is 1 in its entry of `Graph.input_masks`


class ShortForces(NamedTuple):
    """Whether forces or drives may have short pulses: large values only in a short range of t, or of q or v."""

    by_time: bool  # a force, C_t, or b in A v + b = 0, may have short pulses as a function of time
    by_state: bool  # a force, M, C, C_q, or A in A v + b = 0, may have short pulses as a function of q or v


class Dependence(NamedTuple):
    """Result of the analysis of a system's callbacks; systems that differ only in parameters share it."""

    short_forces: ShortForces
    is_steep: bool  # whether forces or drives may vary much over a distance shorter than a step
    kinds: frozenset[str]  # names of the callbacks that were traced

    def specialize(self, system: ConstrainedSystem, evaluate: Evaluator) -> "Dependence":
        """Return this object: the result does not depend on parameters."""
        return self


def find_short_forces(system: ConstrainedSystem, force_was_traced: bool) -> ShortForces:
    """Return whether forces or drives of a system may have short pulses as functions of time, and of the state.

    If callbacks cannot be traced, `by_time` and `by_state` are True. Systems with more than MAX_COORDINATES coordinates
    are not traced; then `by_time` is True, and `by_state` is False. Callbacks that are called in Python may store their
    arguments, so symbols might reach later calls. Such callbacks are traced only if `force_was_traced` is True.
    """
    if system.n_q > MAX_COORDINATES:
        return ShortForces(True, False)
    dependence = _dependence(system, force_was_traced)
    return ShortForces(True, True) if dependence is None else dependence.short_forces


def forces_may_be_steep(system: ConstrainedSystem, force_was_traced: bool) -> bool:
    """Return whether forces or drives may act for a short time, or vary much over a distance shorter than a step.

    If they may, long steps are not safe: a step might evaluate the force 1 / (1 + (x / w)**2) only on both sides of the
    peak, or a fast vibration at nearly equal phases. `force_was_traced`: see `find_short_forces`.
    """
    if any(find_short_forces(system, force_was_traced)):
        return True
    dependence = _dependence(system, force_was_traced)
    return dependence is None or dependence.is_steep


def _dependence(system: ConstrainedSystem, force_was_traced: bool) -> Dependence | None:
    """Return the analysis of a system, cached or new; None if callbacks cannot or must not be traced."""
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
    """Algebra whose values are degrees of quantities as polynomials in `inputs`; sin x, 1 / x, ... count like x."""

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
        """Return the largest degree of the terms of an affine expression."""
        return max((self.values.get(i, 0.0) for i in expr.terms), default=0.0)

    def product(self, a: float, b: float) -> float:
        """Return the degree of a product, given the degrees a and b of its factors."""
        return a + b


class TrigonometricDegrees(DegreeAlgebra):
    """Algebra whose values are degrees of polynomials in sines and cosines: a high power of a sine has short pulses."""

    functions = MappingProxyType(
        {**DegreeAlgebra.functions, **dict.fromkeys((SINE, COSINE), lambda degree: max(degree, 1.0))}
    )


class GrowthExponents(DegreeAlgebra):
    """Algebra whose values are exponents p: for large values x of an input, the quantity grows like x^p."""

    functions = MappingProxyType(
        {**DegreeAlgebra.functions, RECIPROCAL: lambda p: -p, **dict.fromkeys((SINE, COSINE), lambda p: 0.0)}
    )


class DivisorDegrees(DegreeAlgebra):
    """Algebra whose values are sums of the degrees of all divisors in a quantity, such as 2 + 1 for 1 / x^2 / (1 + y).

    In a sum of terms, only the largest value counts. Arctangents of x count as divisions by x: their derivative is
    x' / (1 + x^2). `degrees`: algebra that has computed the degrees of all quantities.
    """

    def __init__(self, degrees: DegreeAlgebra):
        super().__init__()
        self._degrees = degrees

    def operation(self, kind: int, first: Affine, second: Affine | None) -> float:
        """Return the sum of the degrees of all divisors in the result of an operation."""
        degree = super().operation(kind, first, second)
        return degree + self._degrees.affine(first) if kind in (RECIPROCAL, ARCTANGENT) else degree


class DerivativeBounds(DegreeAlgebra):
    """Algebra whose values are rough bounds of the derivatives of quantities with respect to t, q and v.

    Factors of products are assumed to be at most 1. A coefficient that depends on parameters makes the bound infinite.
    """

    def affine(self, expr: Affine) -> float:
        """Return the largest bound of the terms of an affine expression."""
        return max(
            (math.inf if type(c) is Parameter else abs(c) * self.values.get(i, 1.0) for i, c in expr.terms.items()),
            default=0.0,
        )


def _has_time_pulses(graph: Graph, quantities: list[int]) -> bool:
    dependent = [i for i in quantities if graph.input_masks[i] & TIME_MASK]
    degrees = DegreeAlgebra([0])  # degrees as polynomials in input 0 (time), or in its sines and cosines
    degrees.run(graph, dependent)
    return any(graph.kind(i) not in SMOOTH_OPERATIONS or degrees.values[i] > MAX_DEGREE for i in dependent)


def _has_state_pulses(graph: Graph, quantities: list[int], n_q: int) -> bool:
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
