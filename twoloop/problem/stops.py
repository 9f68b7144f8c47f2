"""Stops that a motion may run against."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from twoloop.checks.arguments import check_call, check_finite, check_not_negative, check_text


@dataclass(frozen=True)
class Stop:
    """A one-sided constraint: its gap stays at zero or above, by impacts or by a force, and it may rub.

    Attributes
    ----------
    gap : callable
        gap(t, q), m or rad: positive where the stop is not touched. It is run once on symbols, so that its derivatives
        are exact: numpy's functions, without branches.
    restitution : float
        From 0 to 1: the speed at which the gap opens after an impact over that at which it closed before.
    name : str
    friction : float
        Coefficient of Coulomb friction, zero or more.
    slide : callable, optional
        slide(t, q), m: how far the point in contact is along the surface, for friction in a plane.

    Raises
    ------
    TypeError, ValueError
        If an attribute is wrong.

    Examples
    --------
    >>> from twoloop import Stop
    >>> floor = Stop(lambda t, q: q[1], restitution=0.5, name="floor")  # the second coordinate stays above zero
    >>> floor.name, floor.restitution
    ('floor', 0.5)
    """

    gap: Callable[[Any, Any], Any]
    restitution: float = 0.0
    name: str = "stop"
    friction: float = 0.0
    slide: Callable[[Any, Any], Any] | None = None

    def __post_init__(self) -> None:
        check_text("name", self.name)
        if not callable(self.gap):
            raise TypeError(f"gap of {self.name!r} must be a function of t and q; given {self.gap!r}")
        check_call(f"gap of {self.name!r}", "gap", self.gap, ("t", "q"))
        value = check_finite(f"restitution of {self.name!r}", self.restitution)
        if not 0.0 <= value <= 1.0:
            raise ValueError(f"restitution of {self.name!r} must be from 0 to 1; given {value!r}")
        rubs = check_not_negative(f"friction of {self.name!r}", self.friction) > 0.0
        if rubs or self.slide is not None:
            if not callable(self.slide):
                why = ", as it rubs" if rubs else ""
                raise TypeError(f"slide of {self.name!r} must be a function of t and q{why}; given {self.slide!r}")
            check_call(f"slide of {self.name!r}", "slide", self.slide, ("t", "q"))
