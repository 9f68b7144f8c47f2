"""How files of mechanisms make their problem of the rows that they have collected."""

from typing import Any

from twoloop.checks.arguments import Array
from twoloop.mechanisms.computed import computed
from twoloop.problem.problem import Problem


def ready(rows: Any, name: str, q0: Array, v0: Array, end: float, **known: Any) -> Problem:
    """The problem of rows that were collected, from t = 0 on; what is `known` stands in the place of what they say."""
    known = {"energy": rows.energy, "drawing": rows.drawing, **known}
    known.setdefault("reference", computed(name))
    system = known.pop("system", None) or rows.system(name)
    return Problem(name=name, system=system, q0=q0, v0=v0, t_span=(0.0, end), **known)
