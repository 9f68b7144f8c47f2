"""Assembles a ready problem from the rows collected."""

from typing import Any

from twoloop.checks.arguments import Array
from twoloop.mechanisms.computed import computed
from twoloop.problem.problem import Problem


def ready(rows: Any, name: str, q0: Array, v0: Array, end: float, **known: Any) -> Problem:
    """Return the problem of the rows collected, starting at t = 0; `known` overrides their attributes."""
    known = {"energy": rows.energy, "drawing": rows.drawing, **known}
    known.setdefault("reference", computed(name))
    system = known.pop("system", None) or rows.system(name)
    return Problem(name=name, system=system, q0=q0, v0=v0, t_span=(0.0, end), **known)
