"""Assembles a ready problem from the rows collected, or from a model."""

from typing import TYPE_CHECKING, Any

from twoloop.checks.arguments import Array
from twoloop.mechanisms.computed import computed
from twoloop.problem.problem import Problem

if TYPE_CHECKING:
    from twoloop.bodies.model import Model


def ready(rows: Any, name: str, q0: Array, v0: Array, end: float, **known: Any) -> Problem:
    """Return the problem of the rows collected, starting at t = 0; `known` overrides their attributes."""
    known = {"energy": rows.energy, "drawing": rows.drawing, **known}
    known.setdefault("reference", computed(name))
    system = known.pop("system", None) or rows.system(name)
    return Problem(name=name, system=system, q0=q0, v0=v0, t_span=(0.0, end), **known)


def ready_model(model: "Model", end: float, **known: Any) -> Problem:
    """Return the problem of a model with what is known of the mechanism, starting at t = 0."""
    made = model.problem((0.0, end))
    parts = {name: getattr(made, name) for name in ("name", "system", "q0", "v0", "t_span", "energy", "drawing")}
    return Problem(**{**parts, "coordinates": made.coordinates, "reference": computed(made.name), **known})
