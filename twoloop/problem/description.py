"""What is known of a system beside its equations: names, units, energy, drawing. Results take them from it."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

from numpy.typing import NDArray

from twoloop.problem.drawing import Drawing
from twoloop.problem.generated import GeneratedEnergy


@dataclass(frozen=True)
class Description:
    """Names and pictures for results; a `Problem` hands it to its system.

    Attributes
    ----------
    coordinates : tuple of str
        Names of the coordinates with their units, such as "x of crank (m)". Empty: q0, q1, ...
    energy : callable or None
        energy(t, q, v), J, of one state or of the columns of many.
    conserved : bool or None
        Whether the energy is an invariant; None: not known.
    drawing : Drawing or None
        What to draw.
    """

    coordinates: tuple[str, ...] = ()
    energy: Callable[[Any, Any, Any], Any] | None = None
    conserved: bool | None = None
    drawing: Drawing | None = None

    def with_parameters(self, p: NDArray[Any]) -> Description:
        """What of it holds for other parameters: an energy or a drawing may enclose the ones that it was made with."""
        if not isinstance(self.energy, GeneratedEnergy):
            return Description(self.coordinates)
        return Description(self.coordinates, replace(self.energy, parameters=tuple(p.tolist())), self.conserved)


_UNIT = re.compile(r"\s*\(([^()]*)\)")


def name_and_unit(coordinate: str) -> tuple[str, str]:
    """Split "x (m) of crank" into "x of crank" and "m"; the unit is "" where there is none, or "-"."""
    found = _UNIT.search(coordinate)
    if found is None:
        return coordinate, ""
    unit = found[1].strip()
    return _UNIT.sub("", coordinate, count=1), "" if unit == "-" else unit


def body_names(*bodies: str) -> tuple[str, ...]:
    """Names of the coordinates of planar bodies."""
    return tuple(f"{part} of {body}" for body in bodies for part in ("x (m)", "y (m)", "angle (rad)"))
