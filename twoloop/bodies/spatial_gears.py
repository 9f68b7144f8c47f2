"""Rows of gears and racks in space, where Euler parameters give rotations up to whole turns."""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import numpy as np

from twoloop.bodies.gears import Gears, Row
from twoloop.bodies.parts import Body, ModelJoint
from twoloop.bodies.places import placed, turned
from twoloop.bodies.rotation import euler_parameters
from twoloop.bodies.row_function import RowFunction
from twoloop.bodies.spatial_rows import relative
from twoloop.checks.arguments import Array

MOST_TEETH = 1000
EXACT = 4.0 * np.finfo(np.float64).eps  # relative difference of a ratio and its fraction
MESHES = 1e-6  # rad: larger differences after assembly are another tooth
HALF_TURN = 3.0  # rad, with a margin

Complex = tuple[Any, Any]


@dataclass(frozen=True, eq=False)
class GearRow:
    """The angle m (rotation of other) - n (rotation of one), over m, up to whole turns."""

    one: ModelJoint
    other: ModelJoint
    n: int
    m: int

    def __call__(self, q: Any) -> Any:
        """Return the angle, for numbers or symbols."""
        c, s = _power(_rotation(q, self.one), abs(self.n))
        return _angle(_times(_power(_rotation(q, self.other), self.m), (c, s if self.n < 0 else -s))) / self.m

    def off(self, q: Array) -> float:
        """Return the angle from the tooth in mesh in the position given; zero after more than half a turn from it."""
        one, other = (_angle(_rotation(q, joint)) for joint in (self.one, self.other))
        meant = one * self.n / self.m
        return float(other - meant) if max(abs(one), abs(meant)) < HALF_TURN else 0.0


class SpatialGears(Gears):
    """Writes a coupled rotation as the argument of a unit complex number, which does not depend on whole turns."""

    def _gear_row(self, one: ModelJoint, other: ModelJoint, ratio: float) -> Row:
        exact = Fraction(ratio).limit_denominator(MOST_TEETH)
        n, m = exact.numerator, exact.denominator
        if abs(n) > MOST_TEETH or abs(n / m - ratio) > EXACT * abs(ratio):
            raise ValueError(
                f"ratio of a gear in space must be a ratio of whole numbers up to {MOST_TEETH}, such as -17 / 43 of "
                f"the teeth, as coordinates in space do not count turns; given {ratio!r}"
            )
        return GearRow(one, other, n, m)

    def _rack_row(self, pinion: ModelJoint, slide: ModelJoint, radius: float) -> Row:
        start = _slid(self._start(), slide)

        def row(q: Any) -> Any:
            turns, (c, s) = (_slid(q, slide) - start) / radius, _rotation(q, pinion)
            return radius * _angle(_times((np.cos(turns), np.sin(turns)), (c, -s)))

        return row

    def _check_branches(self, t: float, q: Array) -> None:
        """Raise if assembly has moved a gear to another tooth."""
        for joint in self.joints:
            row = joint.rows[0].motion
            if isinstance(row, RowFunction) and isinstance(row.function, GearRow) and abs(row.function.off(q)) > MESHES:
                raise ValueError(
                    f"{joint.name!r} does not mesh at t = {t:g} as in the position given: {row.function.other.name!r} "
                    f"is {row.function.off(q):.6g} rad off. Give poses nearer to the start of the motion"
                )


def _slid(q: Any, slide: ModelJoint) -> Any:
    """Return the displacement of b on a along the axis."""
    ends = ((slide.a, slide.point_a), (slide.b, slide.point_b))
    one, other = (placed(q, body, np.array(point.values)) for body, point in ends)
    axis = turned(q, slide.a, slide.axes[0])
    return sum(n * (y - x) for n, x, y in zip(axis, one, other, strict=True))


def _rotation(q: Any, joint: ModelJoint) -> Complex:
    """Return cosine and sine of the rotation of b on a since the position given."""
    axis, other = joint.axes
    zero = euler_parameters(relative(joint.a, axis, joint.b, other))
    w, *e = _product(_product(_parameters(q, joint.a, -1.0), _parameters(q, joint.b)), (zero[0], *-zero[1:]))
    half = w, sum(n * x for n, x in zip(axis, e, strict=True))
    c, s = _times(half, half)
    size = half[0] * half[0] + half[1] * half[1]
    return c / size, s / size


def _parameters(q: Any, body: Body, sign: float = 1.0) -> Any:
    """Return the Euler parameters of a body, or with sign -1 those of the inverse rotation."""
    if body.number < 0:
        return 1.0, 0.0, 0.0, 0.0
    w, *e = (q[j] for j in body.coordinates[3:])
    return w, *(sign * x for x in e)


def _product(one: Any, other: Any) -> Any:
    from twoloop.bodies.spatial_places import product  # compiled on import

    return product.py_func(*one, *other)


def _times(a: Complex, b: Complex) -> Complex:
    return a[0] * b[0] - a[1] * b[1], a[0] * b[1] + a[1] * b[0]


def _power(z: Complex, n: int) -> Complex:
    made = z if n & 1 else None
    while n := n >> 1:
        z = _times(z, z)
        if n & 1:
            made = z if made is None else _times(made, z)
    assert made is not None
    return made


def _angle(z: Complex) -> Any:
    """Return the argument of a unit complex number, linear in the angles that it is made of."""
    return 2.0 * np.arctan(z[1] / (1.0 + z[0]))
