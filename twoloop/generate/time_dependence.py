"""Decide from traces whether callbacks may change suddenly, or much over a short distance."""

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

BY_TIME = ("force", "constraint_rate", "nonholonomic_rate")  # callbacks whose dependence on time matters ...
BY_STATE = ("force", "mass", "constraint", "jacobian", "nonholonomic")  # ... and on the state
SMOOTH = (
    PRODUCT,
    SUM,
    SINE,
    COSINE,
)  # operations of polynomials and vibrations: their values never change suddenly ...
HIGHEST = 8  # ... up to this degree: a high power of a cosine is a pulse
# degree in q and v up to which steps notice a change before they meet it; likewise for roots, but not for exp ...
HIGHEST_OF_STATE = 32
HIGHEST_INVERSE = 4  # ... and for quotients up to this degree ...
SLOWEST = -2.0  # ... if they decay no faster than this power: 1 / (1 + (x / w)**2), but not its square
FASTEST = 4.0  # radians of a vibration per unit of a coordinate or speed, up to which long steps resolve it
# largest number of coordinates: tracing more takes up to seconds; sampling forces in a run takes a tenth of that
LARGEST = 300
TIME = 1  # bit mask of t, the first input of a graph


class Sudden(NamedTuple):
    """Whether forces or drives may act for a short time: at some times, or at some positions or speeds."""

    by_time: bool
    by_state: bool


class Dependence(NamedTuple):
    """Dependence on time and state of the callbacks that several systems share."""

    sudden: Sudden
    narrow: bool  # see `may_be_narrow`
    kinds: frozenset[str]  # kinds of callbacks that were traced

    def of(self, system: ConstrainedSystem, evaluate: Evaluator) -> "Dependence":
        """Return the dependence of one of these systems: it does not depend on parameters."""
        return self


def may_be_sudden(system: ConstrainedSystem, ran_on_symbols: bool) -> Sudden:
    """Return whether forces, C_t or b may act for a short time; callbacks that cannot be traced may.

    Functions called in Python are traced only if the force was before: they may keep their arguments.
    """
    if system.n_q > LARGEST:
        return Sudden(True, False)
    dependence = _dependence(system, ran_on_symbols)
    return Sudden(True, True) if dependence is None else dependence.sudden


def may_be_narrow(system: ConstrainedSystem, ran_on_symbols: bool) -> bool:
    """Return whether forces may change over a distance shorter than a step, though not suddenly.

    Quotients and roots of the state may: a step notices 1 / (1 + (x / w)**2) before it meets it, but long steps may
    step over its peak. The stages of a long step may sample a fast vibration at like phases.
    """
    if any(may_be_sudden(system, ran_on_symbols)):
        return True
    dependence = _dependence(system, ran_on_symbols)
    return dependence is None or dependence.narrow


def _dependence(system: ConstrainedSystem, ran_on_symbols: bool) -> Dependence | None:
    if system.called_in_python and not ran_on_symbols:
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
        sudden = Sudden(_by_time(graph, needed(BY_TIME)), _by_state(graph, by_state, system.n_q))
        narrow = _is_narrow(graph, sorted({*by_state, *needed(BY_TIME)}))
        return Dependence(sudden, narrow, frozenset(graph.traced))

    return make


class Degrees(Algebra[float]):
    """Algebra of degrees: the degree of each quantity in some inputs; other inputs are constants."""

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
        """Return the largest degree of the terms of a sum."""
        return max((self.values.get(i, 0.0) for i in expression.terms), default=0.0)

    def product(self, a: float, b: float) -> float:
        """Return the degree of a product, the sum of those of its factors."""
        return a + b


class Vibrations(Degrees):
    """Algebra of degrees in sines and cosines, whose high powers are flat between pulses."""

    functions = MappingProxyType(
        {**Degrees.functions, **dict.fromkeys((SINE, COSINE), lambda degree: max(degree, 1.0))}
    )


class Growth(Degrees):
    """Algebra of growth: powers by which quantities grow far away; negative for reciprocals, zero for vibrations."""

    functions = MappingProxyType(
        {
            **Degrees.functions,
            RECIPROCAL: lambda power: -power,
            **dict.fromkeys((SINE, COSINE), lambda power: 0.0),
        }
    )


class Divisors(Degrees):
    """Algebra of divisors: their highest degree in each quantity; an arctangent counts, as its slope is a quotient."""

    def __init__(self, degrees: Degrees):
        super().__init__()
        self._degrees = degrees

    def operation(self, kind: int, first: Affine, second: Affine | None) -> float:
        """Return the highest degree of the divisors of an operation's result."""
        degree = super().operation(kind, first, second)
        return degree + self._degrees.affine(first) if kind in (RECIPROCAL, ARCTANGENT) else degree


class Rates(Degrees):
    """Algebra of rates: how many times faster than a coordinate or a speed each quantity changes at most.

    The rate of a coordinate times a parameter is infinite, as the parameter may have any value.
    """

    def affine(self, expression: Affine) -> float:
        """Return the largest rate of the terms."""
        return max(
            (
                math.inf if type(c) is Parameter else abs(c) * self.values.get(i, 1.0)
                for i, c in expression.terms.items()
            ),
            default=0.0,
        )


def _by_time(graph: Graph, needed: list[int]) -> bool:
    depending = [i for i in needed if graph.inputs_of[i] & TIME]
    degrees = Degrees([0])  # degrees in time, or in vibrations with time
    degrees.run(graph, depending)
    return any(graph.kind(i) not in SMOOTH or degrees.values[i] > HIGHEST for i in depending)


def _by_state(graph: Graph, needed: list[int], n_q: int) -> bool:
    depending = [i for i in needed if graph.inputs_of[i] & ~TIME]
    inputs = range(1, 2 * n_q + 1)
    degrees, vibrations, growth = Degrees(inputs), Vibrations(), Growth(inputs)
    divisors = Divisors(degrees)
    for algebra in (degrees, vibrations, growth, divisors):
        algebra.run(graph, depending)
    return any(
        graph.kind(i) == EXPONENTIAL
        or degrees.values[i] > HIGHEST_OF_STATE
        or divisors.values[i] > HIGHEST_INVERSE
        or growth.values[i] < SLOWEST
        or vibrations.values[i] > HIGHEST
        for i in depending
    )


def _is_narrow(graph: Graph, needed: list[int]) -> bool:
    """Return whether a quantity is a quotient or a root, a vibration in time, or a fast vibration in the state."""
    if any(graph.kind(i) not in SMOOTH for i in needed):
        return True
    rates = Rates()
    rates.run(graph, needed)
    vibrations = [i for i in needed if graph.kind(i) in (SINE, COSINE)]
    return any(rates.values[i] > FASTEST or graph.inputs_of[i] & TIME for i in vibrations)
