"""Derive C_q, C_t and Gamma exactly from traced callbacks.

Missing callbacks are replaced by programs. Given callbacks are compared with the exact derivatives instead of finite
differences.
"""

import copy
from collections.abc import Sequence
from functools import cache, partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from twoloop.checks.derivatives import FIRST_TIME_SCALE
from twoloop.checks.scales import generic_factors, sizes
from twoloop.generate.graph import MOST_OPERATIONS, Affine, Untraceable
from twoloop.generate.program import OperationTable
from twoloop.generate.trace import OF_ROWS, Equations, Evaluator, TraceCache, derive_cached
from twoloop.generate.traced_values import Check, Traced, unchecked
from twoloop.problem.system import ConstrainedSystem

# callbacks that are derived if they are not given, with the attributes of a system that count their rows
DERIVABLE = {"jacobian": "n_c", "gamma": "n_c", "nonholonomic_gamma": "n_a"}


class DerivedPrograms:
    """Programs that replace missing callbacks, shared by the systems of a trace cache.

    Parameters
    ----------
    programs : dict
        For each missing callback its program, and the flat indices of the array entries that the program computes.
    traced : Traced
        The traces from which they were derived.
    """

    def __init__(self, programs: dict[str, tuple[OperationTable, list[int]]], traced: Traced):
        self.programs, self.traced, self.kinds = programs, traced, traced.kinds

    def of(self, system: ConstrainedSystem, evaluate: Evaluator) -> "DerivedSystem":
        """Return a system with these programs in place of its missing callbacks."""
        functions: dict[str, Any] = {}
        for name, (program, places) in self.programs.items():
            vectors = program.with_numbers(evaluate).packed(places)
            functions |= dict(zip((f"{name}_program", f"{name}_numbers"), vectors, strict=True))
        derived = copy.copy(system)
        derived.functions = system.functions._replace(**functions)
        return DerivedSystem(derived, self.traced.of(system, evaluate))


class DerivedSystem(NamedTuple):
    """System with derived programs, and the traces from which the programs were derived."""

    system: ConstrainedSystem
    traced: Traced

    @property
    def kinds(self) -> frozenset[str]:
        """Return the kinds of callbacks that were traced."""
        return self.traced.kinds


def with_derived_callbacks(system: ConstrainedSystem, check: Check) -> tuple[ConstrainedSystem, tuple[Traced, ...]]:
    """Return a system with programs for C_q and Gamma in place of missing callbacks, and the traces of the programs.

    If no callback is missing, or callbacks cannot be traced, return the system itself without traces: finite
    differences then replace missing callbacks.
    """
    absent = [kind for kind, size in DERIVABLE.items() if getattr(system, size) and kind not in system.given]
    if not absent:
        return system, ()
    try:
        derived: DerivedSystem = derive_cached(
            system, "programs", partial(_derive_programs, system, absent), lambda derived: check(derived.traced)
        )
    except Untraceable:
        return system, ()
    return derived.system, (derived.traced,)


def _derive_programs(system: ConstrainedSystem, absent: Sequence[str], cache: TraceCache) -> DerivedPrograms:
    equations = cache.equations(system)
    programs = {}
    for name, forms in _results(equations, absent).items():
        program = OperationTable.of(equations.graph, 1 + 2 * system.n_q, dict(enumerate(forms.values())))
        if len(program.rows) > MOST_OPERATIONS:
            raise Untraceable(f"{name} takes {len(program.rows)} operations")
        programs[name] = program, list(forms)
    return DerivedPrograms(programs, Traced(system, equations.graph))


def _results(equations: Equations, absent: Sequence[str]) -> dict[str, dict[int, Affine]]:
    """Return, for each missing callback, a dict of expressions by the flat indices of the array entries."""
    system = equations.system
    gamma: dict[int, Affine] = {}
    for kind, first in (("gamma", 0), ("nonholonomic_gamma", system.n_c)):
        if kind in absent:
            gamma |= dict(enumerate(equations.of(kind), first))
    if "jacobian" not in absent:
        return {"gamma": gamma} if gamma else {}
    entries = enumerate(equations.of("jacobian").ravel())
    return {"gamma": gamma, "jacobian": {k: form for k, form in entries if form.terms or form.constant}}


Array = NDArray[np.float64]

MOST_ENTRIES = 50_000  # largest number of entries of C_q that are derived for a comparison
# displacements at which derivatives are compared, relative to the sizes of coordinates, and to FIRST_TIME_SCALE
DISPLACEMENTS = (0.0, 1e-3, 0.03)


def exact_derivatives(system: ConstrainedSystem, check: Check = unchecked) -> Traced | None:
    """Return traces of the exact derivatives, with which the given derivatives of a system must agree.

    Return None if there are too many entries, callbacks cannot be traced, or `check` refuses the traces.
    """
    if system.n_q * (system.n_c + system.n_a) > MOST_ENTRIES:
        return None
    try:
        traced: Traced = derive_cached(system, "derivatives", partial(_trace_derivatives, system), check)
    except Untraceable:
        return None
    return traced


def _trace_derivatives(system: ConstrainedSystem, cache: TraceCache) -> Traced:
    equations = cache.equations(system)
    given = [kind for kind in ("jacobian", *OF_ROWS) if kind in system.given]
    forms = {kind: equations.derived(kind) for kind in (*given, *(["constraint_rate"] if system.n_c else []))}
    # the derivatives are those of traces, so these callbacks must agree with their traces
    forms |= {kind: equations.of(kind) for kind in ("constraint", "nonholonomic", "nonholonomic_rate")}
    return Traced(system, equations.graph, forms)


def exact_near(system: ConstrainedSystem, t: float, q: Array, v: Array) -> bool:
    """Return whether the given C_q, C_t and Gamma are the exact derivatives of the traced callbacks near a start.

    Raises
    ------
    ValueError
        If C_t is not given, but by its trace C depends on time, although not near the start.
    """
    away = generic_factors(len(q)) * sizes(q)
    places = [(t + share * FIRST_TIME_SCALE, q + share * away) for share in DISPLACEMENTS]

    def check(traced: Traced) -> None:
        try:
            with np.errstate(all="ignore"):
                difference = traced.difference(system, generic_states([(*place, v) for place in places]))
        except Exception as error:  # outside the domain of the callbacks
            raise Untraceable(str(error)) from error
        if difference is not None:
            raise Untraceable(difference)

    exact = exact_derivatives(system, check)
    if exact is not None and "constraint_rate" in exact.nonzero_kinds and "constraint_rate" not in system.given:
        raise ValueError(
            f"constraint_rate of {system.name!r} is not given, but constraint depends on t, though not near t = {t:g}: "
            "give constraint_rate, the derivative of constraint with respect to t"
        )
    return exact is not None


def generic_states(states: Sequence[tuple[float, Array, Array]]) -> Array:
    """Return rows [t, q, v] with random velocities, none of them zero, that are about as large as the given ones."""
    times, positions, velocities = (np.array(each, dtype=float) for each in zip(*states, strict=True))
    generic = np.array([sizes(q) for q in positions]) * _factors(*positions.shape)
    speed = max(1.0, float(np.abs(velocities).max()) / float(np.abs(generic).max()))
    return np.column_stack([times, positions, speed * generic])


@cache
def _factors(n_states: int, n_q: int) -> Array:
    """Return fixed random factors between 0.5 and 1.5, of either sign."""
    random = np.random.default_rng(1)
    return random.uniform(0.5, 1.5, (n_states, n_q)) * random.choice((-1.0, 1.0), (n_states, n_q))
