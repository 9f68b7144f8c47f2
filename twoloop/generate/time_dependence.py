"""Whether what callbacks give may change suddenly, or much over a short way, by what they are traced to."""

import math
from typing import Any, NamedTuple

from twoloop.generate.graph import Affine, Graph, Untraceable
from twoloop.generate.parameter_expressions import Parameter
from twoloop.generate.trace_cache import Evaluator, TraceCache, derive_cached
from twoloop.generate.traced_values import unchecked
from twoloop.kernels.evaluation.operations import (
    ARCTANGENT,
    COSINE,
    EXPONENTIAL,
    PRODUCT,
    RECIPROCAL,
    SINE,
    SQUARE_ROOT,
    SUM,
)
from twoloop.problem.system import ConstrainedSystem

BY_TIME = ("force", "constraint_rate", "nonholonomic_rate")  # callbacks that a change with time is looked for in ...
BY_STATE = ("force", "mass", "constraint", "jacobian", "nonholonomic")  # ... and one with the state
SMOOTH = (PRODUCT, SUM, SINE, COSINE)  # polynomials and vibrations: nothing happens in a short time alone ...
HIGHEST = 8  # ... up to this degree: a high power of a cosine is a pulse
HIGHEST_OF_STATE = 32  # degree in q and v up to which it is seen from afar; so are roots, not exp ...
HIGHEST_INVERSE = 4  # ... and quotients up to this one ...
FASTEST = 4.0  # times a coordinate or a speed: the fastest vibration with these that long steps resolve
SLOWEST = -2.0  # ... that fall off no faster than this power: 1 / (1 + (x / w)**2), not its square
LARGEST = 300  # coordinates: to trace the forces of more takes up to seconds, the looks of a run a tenth of it
TIME = 1  # the bit of t, the first input of a graph


class Sudden(NamedTuple):
    """Whether something may act for a short time, at a given time and at given places or speeds."""

    by_time: bool
    by_state: bool


class Dependence(NamedTuple):
    """What is known of a family of systems."""

    sudden: Sudden
    narrow: bool  # whether something may be narrow, see `may_be_narrow`
    kinds: frozenset[str]  # of callbacks that ran on symbols

    def of(self, system: ConstrainedSystem, evaluate: Evaluator) -> "Dependence":
        """That of one of the systems: the same."""
        return self


def may_be_sudden(system: ConstrainedSystem, ran_on_symbols: bool) -> Sudden:
    """Whether forces, C_t or b may act for a short time; so may what cannot be traced.

    Functions called in Python run on symbols only if the force has done so: they may keep what they are given.
    """
    if system.n_q > LARGEST:
        return Sudden(True, False)
    known = _known(system, ran_on_symbols)
    return Sudden(True, True) if known is None else known.sudden


def may_be_narrow(system: ConstrainedSystem, ran_on_symbols: bool) -> bool:
    """Whether what callbacks give may change much over a short way, though not suddenly.

    So may quotients and roots of the state. Of 1 / (1 + (x / w)**2) what is far away tells, but over long steps less
    than a step needs to know. Stages of long steps may meet a fast vibration at like phases.
    """
    if any(may_be_sudden(system, ran_on_symbols)):
        return True
    known = _known(system, ran_on_symbols)
    return known is None or known.narrow


def _known(system: ConstrainedSystem, ran_on_symbols: bool) -> Dependence | None:
    if system.called_in_python and not ran_on_symbols:
        return None
    try:
        known: Dependence = derive_cached(system, "dependence", _traced(system), unchecked)
    except Untraceable:
        return None
    return known


def _traced(system: ConstrainedSystem) -> Any:
    def make(family: TraceCache) -> Dependence:
        equations = family.equations(system)

        def needed(kinds: tuple[str, ...]) -> list[int]:
            forms = [form for kind in kinds if kind in system.given for form in equations.of(kind).ravel()]
            return equations.graph.needed_by(forms)

        graph = equations.graph
        by_state = needed(BY_STATE)
        sudden = Sudden(_by_time(graph, needed(BY_TIME)), _by_state(graph, by_state, system.n_q))
        narrow = _is_narrow(graph, sorted({*by_state, *needed(BY_TIME)}))
        return Dependence(sudden, narrow, frozenset(graph.traced))

    return make


def _by_time(graph: Graph, needed: list[int]) -> bool:
    degrees = {0: 1.0}  # in time, or in vibrations with it; 0 of what is not here
    for i in needed:
        operation = graph.operations[i]
        if operation is not None and graph.inputs_of[i] & TIME:
            degrees[i] = _degree(degrees, *operation)
            if operation[0] not in SMOOTH or degrees[i] > HIGHEST:
                return True
    return False


def _by_state(graph: Graph, needed: list[int], n_q: int) -> bool:
    degrees: dict[int, float] = dict.fromkeys(range(1, 2 * n_q + 1), 1.0)
    vibrations: dict[int, float] = {}  # the degree in sines and cosines, whose high powers are flat between pulses
    inverse: dict[int, float] = {}  # the highest degree of what is divided by; the slope of an arctangent is a quotient
    growth = degrees.copy()  # power by which something grows far away
    for i in needed:
        operation = graph.operations[i]
        if operation is not None and graph.inputs_of[i] & ~TIME:
            kind, argument, *_ = operation
            degrees[i] = _degree(degrees, *operation)
            vibrations[i] = max(_degree(vibrations, *operation), float(kind in (SINE, COSINE)))
            inverse[i] = _degree(inverse, *operation)
            if kind in (RECIPROCAL, ARCTANGENT):
                inverse[i] += _degree(degrees, kind, argument)
            growth[i] = _growth(growth, *operation)
            if kind == EXPONENTIAL or degrees[i] > HIGHEST_OF_STATE or inverse[i] > HIGHEST_INVERSE:
                return True
            if growth[i] < SLOWEST or vibrations[i] > HIGHEST:
                return True
    return False


def _is_narrow(graph: Graph, needed: list[int]) -> bool:
    """Whether a quantity is a quotient or a root, a vibration with time, or a fast one with the state.

    How fast one of a coordinate is that a parameter multiplies is not known.
    """
    rates: dict[int, float] = {}  # how many times faster than a coordinate or a speed something changes at most
    for i in needed:
        operation = graph.operations[i]
        if operation is None:
            continue
        kind, *factors = operation
        if kind not in SMOOTH:
            return True
        rates[i] = _rate(rates, *factors)
        if kind in (SINE, COSINE) and (rates[i] > FASTEST or graph.inputs_of[i] & TIME):
            return True
    return False


def _degree(degrees: dict[int, float], kind: int, *factors: Affine | None) -> float:
    """The degree of a product is the sum of those of its factors, of a root half that of its argument, else that."""
    first, *others = (
        max((degrees.get(i, 0.0) for i in form.terms), default=0.0) for form in factors if form is not None
    )
    return first + sum(others) if kind == PRODUCT else 0.5 * first if kind == SQUARE_ROOT else first


def _growth(powers: dict[int, float], kind: int, *factors: Affine | None) -> float:
    """By which power it grows far away; it falls off with its reciprocal, and vibrations do neither."""
    power = _degree(powers, kind, *factors)
    return 0.0 if kind in (SINE, COSINE) else -power if kind == RECIPROCAL else power


def _rate(rates: dict[int, float], *factors: Affine | None) -> float:
    """The rate of a product is the sum of those of its factors, of a sum the largest of those of its terms."""
    return sum(
        max(
            (math.inf if type(c) is Parameter else abs(c) * rates.get(i, 1.0) for i, c in form.terms.items()),
            default=0.0,
        )
        for form in factors
        if form is not None
    )
