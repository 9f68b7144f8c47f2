"""Programs in the place of C_q and Gamma that no callback gives: exact derivatives of what was traced."""

import copy
from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from twoloop.generate.families import Evaluator, Family, of_family
from twoloop.generate.programs import Program, program_of
from twoloop.generate.traced_equations import Equations
from twoloop.generate.traced_values import Check, Traced
from twoloop.generate.tracing import MOST_OPERATIONS, Form, Untraceable
from twoloop.kernels.evaluation.operations import KIND, MADE, RESULT
from twoloop.problem.system import ConstrainedSystem

ROWS = {"jacobian": "n_c", "gamma": "n_c", "nonholonomic_gamma": "n_a"}  # what may be derived, and of how many rows


class Derived:
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

    def of(self, system: ConstrainedSystem, evaluate: Evaluator) -> "Standing":
        """What stands for one of the systems."""
        functions: dict[str, Any] = {}
        for name, (program, places) in self.programs.items():
            constants, coefficients = evaluate(program.constants), evaluate(program.coefficients)
            vectors = _packed(program._replace(constants=constants, coefficients=coefficients), places)
            functions |= dict(zip((f"{name}_program", f"{name}_numbers"), vectors, strict=True))
        other = copy.copy(system)
        other.functions = system.functions._replace(**functions)
        return Standing(other, self.traced.of(system, evaluate))


class Standing(NamedTuple):
    """A system with such programs, and what they were traced from."""

    system: ConstrainedSystem
    traced: Traced

    @property
    def kinds(self) -> frozenset[str]:
        """Kinds of callbacks that were traced."""
        return self.traced.kinds


def standing_for(system: ConstrainedSystem, check: Check) -> tuple[ConstrainedSystem, tuple[Traced, ...]]:
    """The system with programs in the place of C_q and Gamma that no callback gives, and what they were traced from.

    As it is, and nothing, where all is given, or cannot be traced: then differences stand for it.
    """
    absent = [kind for kind, size in ROWS.items() if getattr(system, size) and kind not in system.given]
    if not absent:
        return system, ()
    try:
        made: Standing = of_family(system, "programs", partial(_made, system, absent), lambda made: check(made.traced))
    except Untraceable:
        return system, ()
    return made.system, (made.traced,)


def _made(system: ConstrainedSystem, absent: Sequence[str], family: Family) -> Derived:
    equations = family.equations(system)
    programs = {}
    for name, forms in _results(equations, absent).items():
        program = program_of(equations.graph, 1 + 2 * system.n_q, dict(enumerate(forms.values())))
        if len(program.rows) > MOST_OPERATIONS:
            raise Untraceable(f"{name} takes {len(program.rows)} operations")
        programs[name] = program, list(forms)
    return Derived(programs, Traced(system, equations.graph))


def _results(equations: Equations, absent: Sequence[str]) -> dict[str, dict[int, Form]]:
    """The forms that a program makes, each by its place."""
    system = equations.system
    gamma: dict[int, Form] = {}
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
