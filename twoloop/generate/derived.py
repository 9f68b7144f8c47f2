"""Programs in the place of C_q and Gamma that no callback gives: exact derivatives of what was traced."""

import copy
from collections.abc import Sequence
from typing import Any

import numpy as np

from twoloop.generate.programs import Program, program_of
from twoloop.generate.traced_equations import Equations
from twoloop.generate.traced_values import Check, Traced
from twoloop.generate.tracing import Form, Untraceable
from twoloop.kernels.evaluation.operations import KIND, MADE, RESULT
from twoloop.problem.system import ConstrainedSystem

ROWS = {"jacobian": "n_c", "gamma": "n_c", "nonholonomic_gamma": "n_a"}  # what may be derived, and of how many rows
MOST = 20_000  # operations of a program


def standing_for(system: ConstrainedSystem, check: Check) -> tuple[ConstrainedSystem, tuple[Traced, ...]]:
    """The system with programs in the place of C_q and Gamma that no callback gives, and what they were traced from.

    As it is, and nothing, where all is given, or cannot be traced: then differences stand for it.
    """
    absent = [kind for kind, size in ROWS.items() if getattr(system, size) and kind not in system.given]
    if not absent:
        return system, ()
    made = system.remembered("programs", lambda: _made(system, absent))
    if made is None:
        return system, ()
    other, traced = made
    try:
        check(traced)
    except Untraceable:
        return system, ()
    return other, (traced,)


def _made(system: ConstrainedSystem, absent: Sequence[str]) -> tuple[ConstrainedSystem, Traced] | None:
    """The system with programs, as vectors; None: the constraints cannot be traced, or are too long."""
    equations = Equations(system)
    try:
        results = _results(equations, absent)
    except Untraceable:
        return None
    programs: dict[str, Any] = {}
    for name, forms in results.items():
        program = program_of(equations.graph, 1 + 2 * system.n_q, dict(enumerate(forms.values())))
        if len(program.rows) > MOST:
            return None
        vectors = _packed(program, list(forms))
        programs |= dict(zip((f"{name}_program", f"{name}_numbers"), vectors, strict=True))
    other = copy.copy(system)
    other.functions = system.functions._replace(**programs)
    return other, Traced(system, equations.graph)


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
