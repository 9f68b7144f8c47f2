"""Derive C_q, C_t and Gamma exactly from traced callbacks.

Programs compute those that are not given. Those that are given are compared with what they must be, without
differences.
"""

import copy
from collections.abc import Sequence
from functools import cache, partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from twoloop.checks.derivatives import TIME
from twoloop.checks.scales import generic_factors, sizes
from twoloop.generate.graph import MOST_OPERATIONS, Affine, Untraceable
from twoloop.generate.program import Program, program_of
from twoloop.generate.trace import OF_ROWS, Equations
from twoloop.generate.trace_cache import Evaluator, TraceCache, derive_cached
from twoloop.generate.traced_values import Check, Traced, unchecked
from twoloop.kernels.evaluation.operations import KIND, MADE, RESULT
from twoloop.problem.system import ConstrainedSystem

ROWS = {"jacobian": "n_c", "gamma": "n_c", "nonholonomic_gamma": "n_a"}  # what may be derived, and of how many rows


class DerivedPrograms:
    """Programs in the place of what no callback gives, made once for all systems of a family.

    Parameters
    ----------
    programs : dict
        By name, each with the places to which its results belong.
    traced : Traced
        What they were traced from.
    """

    def __init__(self, programs: dict[str, tuple[Program, list[int]]], traced: Traced):
        self.programs, self.traced, self.kinds = programs, traced, traced.kinds

    def of(self, system: ConstrainedSystem, evaluate: Evaluator) -> "DerivedSystem":
        """What stands for one of the systems."""
        functions: dict[str, Any] = {}
        for name, (program, places) in self.programs.items():
            constants, coefficients = evaluate(program.constants), evaluate(program.coefficients)
            vectors = _packed(program._replace(constants=constants, coefficients=coefficients), places)
            functions |= dict(zip((f"{name}_program", f"{name}_numbers"), vectors, strict=True))
        other = copy.copy(system)
        other.functions = system.functions._replace(**functions)
        return DerivedSystem(other, self.traced.of(system, evaluate))


class DerivedSystem(NamedTuple):
    """A system with such programs, and what they were traced from."""

    system: ConstrainedSystem
    traced: Traced

    @property
    def kinds(self) -> frozenset[str]:
        """Kinds of callbacks that were traced."""
        return self.traced.kinds


def with_derived_callbacks(system: ConstrainedSystem, check: Check) -> tuple[ConstrainedSystem, tuple[Traced, ...]]:
    """The system with programs in the place of C_q and Gamma that no callback gives, and what they were traced from.

    As it is, and nothing, where all is given, or cannot be traced: then differences stand for it.
    """
    absent = [kind for kind, size in ROWS.items() if getattr(system, size) and kind not in system.given]
    if not absent:
        return system, ()
    try:
        made: DerivedSystem = derive_cached(
            system, "programs", partial(_made, system, absent), lambda made: check(made.traced)
        )
    except Untraceable:
        return system, ()
    return made.system, (made.traced,)


def _made(system: ConstrainedSystem, absent: Sequence[str], family: TraceCache) -> DerivedPrograms:
    equations = family.equations(system)
    programs = {}
    for name, forms in _results(equations, absent).items():
        program = program_of(equations.graph, 1 + 2 * system.n_q, dict(enumerate(forms.values())))
        if len(program.rows) > MOST_OPERATIONS:
            raise Untraceable(f"{name} takes {len(program.rows)} operations")
        programs[name] = program, list(forms)
    return DerivedPrograms(programs, Traced(system, equations.graph))


def _results(equations: Equations, absent: Sequence[str]) -> dict[str, dict[int, Affine]]:
    """The forms that a program makes, each by its place."""
    system = equations.system
    gamma: dict[int, Affine] = {}
    for kind, first in (("gamma", 0), ("nonholonomic_gamma", system.n_c)):
        if kind in absent:
            gamma |= dict(enumerate(equations.of(kind), first))
    if "jacobian" not in absent:
        return {"gamma": gamma} if gamma else {}
    entries = enumerate(equations.of("jacobian").ravel())
    return {"gamma": gamma, "jacobian": {k: form for k, form in entries if form.terms or form.constant}}


def _packed(program: Program, places: Sequence[int]) -> tuple[Any, Any]:
    """A program as kernels take one of a system; `places`: to what its results belong."""
    rows, n = program.rows.copy(), len(places)
    results = rows[:, KIND] == RESULT
    rows[results, MADE] += program.n_nodes
    head = [program.n_nodes + n, len(rows), len(program.columns), n]
    integers = np.concatenate([head, rows.ravel(), program.columns, places])
    return integers.astype(np.int64), np.concatenate([program.constants.ravel(), program.coefficients])


Array = NDArray[np.float64]

MOST = 50_000  # entries of C_q
NEAR = (0.0, 1e-3, 0.03)  # of the coordinates, and of TIME
BESIDE = 0.01  # of the box of a CheckedRegion, less than states of a run that are compared lie apart: no new place
ROUNDED = 1e-9  # of its longest side but that of the time: the same for coordinates that move by rounding alone


def exact_derivatives(system: ConstrainedSystem, check: Check = unchecked) -> Traced | None:
    """What the callbacks of a system should give, by those that they are derivatives of.

    None: there are no constraints or too many, or they cannot be traced, or `check` refuses what they were traced to.
    """
    if system.n_q * (system.n_c + system.n_a) > MOST:
        return None
    try:
        made: Traced = derive_cached(system, "derivatives", partial(_traced, system), check)
    except Untraceable:
        return None
    return made


def _traced(system: ConstrainedSystem, family: TraceCache) -> Traced:
    equations = family.equations(system)
    given = [kind for kind in ("jacobian", *OF_ROWS) if kind in system.given]
    forms = {kind: equations.derived(kind) for kind in (*given, *(["constraint_rate"] if system.n_c else []))}
    # of which the others are derivatives, if they are what they were traced to
    forms |= {kind: equations.of(kind) for kind in ("constraint", "nonholonomic", "nonholonomic_rate")}
    return Traced(system, equations.graph, forms)


def exact_near(system: ConstrainedSystem, t: float, q: Array, v: Array) -> bool:
    """Whether C_q, C_t and Gamma are, near a start, the derivatives of what callbacks were traced to.

    Raises
    ------
    ValueError
        If there is no C_t, and C was traced to depend on time, though not near the start.
    """
    away = generic_factors(len(q)) * sizes(q)
    places = [(t + share * TIME, q + share * away) for share in NEAR]

    def check(made: Traced) -> None:
        try:
            with np.errstate(all="ignore"):
                wrong = made.wrong(system, generic_states([(*place, v) for place in places]))
        except Exception as error:  # outside what the callbacks are made for
            raise Untraceable(str(error)) from error
        if wrong is not None:
            raise Untraceable(wrong)

    found = exact_derivatives(system, check)
    if found is not None and "constraint_rate" in found.not_zero and "constraint_rate" not in system.given:
        raise ValueError(
            f"constraint_rate of {system.name!r} is not given, but constraint depends on t, though not near t = {t:g}: "
            "give constraint_rate, the derivative of constraint with respect to t"
        )
    return found is not None


def generic_states(states: Sequence[tuple[float, Array, Array]]) -> Array:
    """Rows [t, q, v] of states (t, q, v), with velocities in which each coordinate matters and as fast as these."""
    times, positions, velocities = (np.array(each, dtype=float) for each in zip(*states, strict=True))
    generic = np.array([sizes(q) for q in positions]) * _factors(*positions.shape)
    speed = max(1.0, float(np.abs(velocities).max()) / float(np.abs(generic).max()))
    return np.column_stack([times, positions, speed * generic])


@cache
def _factors(n_states: int, n_q: int) -> Array:
    """Between 0.5 and 1.5, of either sign: always the same."""
    random = np.random.default_rng(1)
    return random.uniform(0.5, 1.5, (n_states, n_q)) * random.choice((-1.0, 1.0), (n_states, n_q))


def farthest(t: Array, rows: Array) -> Array:
    """Of the states of a run, rows [q, v], those [t, q, v] at which a number is the least or the largest."""
    states = np.column_stack([t, rows])
    return states[np.unique([states.argmin(axis=0), states.argmax(axis=0)])]


class CheckedRegion:
    """Where the states of runs were, at which callbacks were compared: a box of [t, q, v], and one of parameters.

    Attributes
    ----------
    known : ndarray (2, 1 + 2 n_q) or (2, 0)
        The least and the largest of each number of states that are in no new place.
    """

    def __init__(self) -> None:
        self._runs = 0
        self._parameters: tuple[Array, Array] | None = None  # the least and the largest, of runs of many systems
        self._box = np.zeros((2, 0))  # the least and the largest of each number
        self.known = self._box

    def is_due(self) -> bool:
        """Whether callbacks are to be compared wherever the next run goes: the 1st, 2nd, 4th, 8th, ..."""
        return (self._runs + 1) & self._runs == 0

    def count(self) -> None:
        """One more run was made."""
        self._runs += 1

    def without_known(self, states: Array) -> Array:
        """Those of the states, rows, of a run that lie in no place, or next to none, where one was compared."""
        if not self._box.size:
            return states
        least, largest = self.known
        new = (states < least) | (states > largest)
        return states[new.any(axis=1)] if new.any() else states[:0]

    def knows(self, parameters: Array) -> bool:
        """Whether parameters lie among those with which callbacks were compared, or next to them."""
        if self._parameters is None:
            return False
        least, largest = self._parameters
        beside = BESIDE * (largest - least)
        return bool((least - beside <= parameters).all() and (parameters <= largest + beside).all())

    def add_parameters(self, parameters: Array) -> None:
        """Take in those of a run in which nothing was wrong."""
        least, largest = self._parameters or (parameters, parameters)
        self._parameters = np.minimum(least, parameters), np.maximum(largest, parameters)

    def add(self, states: Array) -> None:
        """Take in states of a run in which nothing was wrong."""
        if len(states) == 0:
            return
        known = np.concatenate([states, self._box]) if self._box.size else states
        least, largest = self._box = np.array([known.min(axis=0), known.max(axis=0)])
        beside = BESIDE * (largest - least) + ROUNDED * float((largest - least)[1:].max())
        self.known = np.array([least - beside, largest + beside])
