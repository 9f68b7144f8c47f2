"""Derive C_q, C_t and gamma exactly from traced callbacks.

If the user gives no callback for C_q or gamma, a program derived from the other callbacks replaces it. The callbacks
that the user gives are compared with exact derivatives, which are more reliable than finite differences.
"""

import copy
from collections.abc import Sequence
from functools import cache, partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from twoloop.checks.derivatives import FIRST_TIME_SCALE
from twoloop.checks.scales import generic_factors, sizes
from twoloop.generate.graph import MAX_TRACED_OPERATIONS, Affine, Untraceable
from twoloop.generate.program import OperationTable
from twoloop.generate.trace import GAMMA_SOURCES, Equations, Evaluator, TraceCache, derive_cached
from twoloop.generate.traced_values import CallbackTraces, Check, accept_traces
from twoloop.problem.system import ConstrainedSystem

# callbacks that are derived if the user does not give them, with the attribute of the system that counts their rows
DERIVABLE_CALLBACKS = {"jacobian": "n_c", "gamma": "n_c", "nonholonomic_gamma": "n_a"}


class DerivedPrograms:
    """Programs that replace missing callbacks, shared by all systems whose callbacks have the same traces.

    programs : for each replaced callback, its program, and the indices of the results in the array of the callback.
    traced : the traces that the programs were derived from.
    """

    def __init__(self, programs: dict[str, tuple[OperationTable, list[int]]], traced: CallbackTraces):
        self.programs, self.traced, self.kinds = programs, traced, traced.kinds

    def specialize(self, system: ConstrainedSystem, evaluate: Evaluator) -> "DerivedSystem":
        """Return a copy of `system` with these programs as callbacks; `evaluate` computes their coefficients."""
        functions: dict[str, Any] = {}
        for name, (program, indices) in self.programs.items():
            vectors = program.replace_coefficients(evaluate).as_arrays(indices)
            functions |= dict(zip((f"{name}_program", f"{name}_numbers"), vectors, strict=True))
        derived = copy.copy(system)
        derived.functions = system.functions._replace(**functions)
        return DerivedSystem(derived, self.traced.specialize(system, evaluate))


class DerivedSystem(NamedTuple):
    """System with programs in place of missing callbacks, and the traces that the programs were derived from."""

    system: ConstrainedSystem
    traced: CallbackTraces

    @property
    def kinds(self) -> frozenset[str]:
        """Return the names of the callbacks that were traced, such as "mass"."""
        return self.traced.kinds


def derive_callbacks(system: ConstrainedSystem, check: Check) -> tuple[ConstrainedSystem, tuple[CallbackTraces, ...]]:
    """Return a system with programs in place of missing callbacks for C_q and gamma, and the traces of the programs.

    If no callback is missing, or callbacks cannot be traced, return `system` itself and an empty tuple. In the second
    case, finite differences replace missing callbacks. `check` raises Untraceable if the traces are wrong.
    """
    missing = [kind for kind, size in DERIVABLE_CALLBACKS.items() if getattr(system, size) and kind not in system.given]
    if not missing:
        return system, ()
    try:
        derived: DerivedSystem = derive_cached(
            system, "programs", partial(_derive_programs, system, missing), lambda derived: check(derived.traced)
        )
    except Untraceable:
        return system, ()
    return derived.system, (derived.traced,)


def _derive_programs(system: ConstrainedSystem, missing: Sequence[str], cache: TraceCache) -> DerivedPrograms:
    equations = cache.equations(system)
    programs = {}
    for name, exprs in _missing_derivatives(equations, missing).items():
        program = OperationTable.from_results(equations.graph, 1 + 2 * system.n_q, dict(enumerate(exprs.values())))
        if len(program.rows) > MAX_TRACED_OPERATIONS:
            raise Untraceable(f"{name} takes {len(program.rows)} operations")
        programs[name] = program, list(exprs)
    return DerivedPrograms(programs, CallbackTraces(system, equations.graph))


def _missing_derivatives(equations: Equations, missing: Sequence[str]) -> dict[str, dict[int, Affine]]:
    """Return missing derivatives, "gamma" (of C, then of A) and "jacobian" (nonzeros), as {flat index: expression}."""
    system = equations.system
    gamma: dict[int, Affine] = {}
    for kind, first in (("gamma", 0), ("nonholonomic_gamma", system.n_c)):
        if kind in missing:
            gamma |= dict(enumerate(equations.expressions(kind), first))
    if "jacobian" not in missing:
        return {"gamma": gamma} if gamma else {}
    entries = enumerate(equations.expressions("jacobian").ravel())
    return {"gamma": gamma, "jacobian": {k: expr for k, expr in entries if expr.terms or expr.constant}}


Array = NDArray[np.float64]

MAX_ENTRIES = 50_000  # callbacks are not compared with exact derivatives if G = [C_q; A] has more entries than this
# callbacks and exact derivatives are compared at states displaced from the start: each coordinate by these multiples of
# its typical magnitude, the time by these multiples of FIRST_TIME_SCALE
DISPLACEMENTS = (0.0, 1e-3, 0.03)


def exact_derivatives(system: ConstrainedSystem, check: Check = accept_traces) -> CallbackTraces | None:
    """Return the exact derivatives C_q, C_t and gamma as traces, to be compared with callbacks.

    Return None if G has more than MAX_ENTRIES entries, callbacks cannot be traced, or `check` rejects the traces.
    """
    if system.n_q * (system.n_c + system.n_a) > MAX_ENTRIES:
        return None
    try:
        traced: CallbackTraces = derive_cached(system, "derivatives", partial(_trace_derivatives, system), check)
    except Untraceable:
        return None
    return traced


def _trace_derivatives(system: ConstrainedSystem, cache: TraceCache) -> CallbackTraces:
    equations = cache.equations(system)
    callbacks = [kind for kind in ("jacobian", *GAMMA_SOURCES) if kind in system.given]
    exprs = {kind: equations.derivatives(kind) for kind in (*callbacks, *(["constraint_rate"] if system.n_c else []))}
    # derivatives of a wrong trace are wrong: so the traces that are differentiated are also compared with callbacks
    exprs |= {kind: equations.expressions(kind) for kind in ("constraint", "nonholonomic", "nonholonomic_rate")}
    return CallbackTraces(system, equations.graph, exprs)


def has_exact_derivatives(system: ConstrainedSystem, t: float, q: Array, v: Array) -> bool:
    """Return True if callbacks for C_q, C_t and gamma agree with exact derivatives at states near a start (t, q, v).

    If values differ, or callbacks cannot be traced, return False. Raise ValueError if the constraints C depend on time,
    perhaps only far from the start, but there is no callback for C_t.
    """
    direction = generic_factors(len(q)) * sizes(q)
    states = [(t + displacement * FIRST_TIME_SCALE, q + displacement * direction) for displacement in DISPLACEMENTS]

    def check(traced: CallbackTraces) -> None:
        try:
            with np.errstate(all="ignore"):
                difference = traced.difference(system, generic_states([(*state, v) for state in states]))
        except Exception as error:  # the state is outside the domain of the callbacks
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
    """Return rows [t, q, v] with t and q of `states`, and random v, whose max|v| is at least that of `states`."""
    times, positions, velocities = (np.array(values, dtype=float) for values in zip(*states, strict=True))
    generic_v = np.array([sizes(q) for q in positions]) * _random_factors(*positions.shape)
    scale = max(1.0, float(np.abs(velocities).max()) / float(np.abs(generic_v).max()))
    return np.column_stack([times, positions, scale * generic_v])


@cache
def _random_factors(n_states: int, n_q: int) -> Array:
    """Return an array (n_states, n_q) of random factors, the same in every call: 0.5 to 1.5 with random signs."""
    random = np.random.default_rng(1)
    return random.uniform(0.5, 1.5, (n_states, n_q)) * random.choice((-1.0, 1.0), (n_states, n_q))
