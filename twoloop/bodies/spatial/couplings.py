"""Build gears, racks and wheels in space, where Euler parameters give rotations up to whole turns."""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from twoloop.bodies.collection import add, documented
from twoloop.bodies.coordinates import SpatialAngle
from twoloop.bodies.frames import point_of, vector_of
from twoloop.bodies.functions import RateFunction, RowFunction
from twoloop.bodies.loads import Row, function_rows, listed
from twoloop.bodies.model_problem import Model
from twoloop.bodies.parameter_layout import RATE_FUNCTION, ROW_FUNCTION
from twoloop.bodies.parts import Body, JointRow, ModelJoint, Numbers
from twoloop.bodies.rotation import cross, euler_parameters, euler_product, perpendiculars, spin_of
from twoloop.checks.arguments import Array, check_positive, check_vector

MOST_TEETH = 1000  # largest numerator and denominator of a gear ratio
EXACT = 4.0 * np.finfo(np.float64).eps  # largest relative difference of a ratio from a fraction of whole numbers
MESHES = 1e-6  # rad: larger differences after assembly mean that another tooth is in mesh
HALF_TURN = 3.0  # rad: half a turn, less a margin

Complex = tuple[Any, Any]


@dataclass(frozen=True, eq=False)
class GearRow:
    """Evaluate the angle m (rotation of other) - n (rotation of one), over m, up to whole turns."""

    one: SpatialAngle
    other: SpatialAngle
    n: int
    m: int

    def __call__(self, q: Any) -> Any:
        """Return the angle, for numbers or symbols."""
        c, s = _power(_rotation(q, self.one), abs(self.n))
        return _angle(_times(_power(_rotation(q, self.other), self.m), (c, s if self.n < 0 else -s))) / self.m

    def off(self, q: Array) -> float:
        """Return the angle from the tooth in mesh in the position given; zero if more than half a turn from it."""
        one = float(self.one.position(q))  # NaN near a whole turn, which then counts as more than half a turn
        other = float(_angle(_rotation(q, self.other)))
        meant = one * self.n / self.m
        return other - meant if max(abs(one), abs(meant)) < HALF_TURN else 0.0


@documented
class SpatialCouplings(Model):
    """Adds gears, racks and rolling wheels to a spatial model.

    A coupled rotation is the argument of a unit complex number, which does not depend on whole turns.
    """

    def _gear_row(self, one: ModelJoint, other: ModelJoint, ratio: float) -> Row:
        exact = Fraction(ratio).limit_denominator(MOST_TEETH)
        n, m = exact.numerator, exact.denominator
        if abs(n) > MOST_TEETH or abs(n / m - ratio) > EXACT * abs(ratio):
            raise ValueError(
                f"ratio of a gear in space must be a ratio of whole numbers up to {MOST_TEETH}, such as -17 / 43 of "
                f"the teeth, as coordinates in space do not count turns; given {ratio!r}"
            )
        return GearRow(self._hinge(one), self._hinge(other), n, m)

    def _wound_row(self, pinion: ModelJoint, moved: Row, radius: float) -> Row:
        hinge = self._hinge(pinion)

        def row(q: Any) -> Any:
            turns, (c, s) = moved(q) / radius, _rotation(q, hinge)
            return radius * _angle(_times((np.cos(turns), np.sin(turns)), (c, -s)))

        return row

    def _zero(self, joint: ModelJoint) -> Array:
        """Return the relative Euler parameters of a hinge in the position given, with the sign of the initial ones."""
        axis_a, axis_b = joint.axes
        zero = euler_parameters(relative(joint.a, axis_a, joint.b, axis_b))
        e_a, e_b = (euler_parameters(body.rotation) for body in (joint.a, joint.b))
        given = euler_product((e_a[0], *-e_a[1:]), e_b)
        return zero if zero @ given > 0.0 else -zero

    def _check_branches(self, t: float, q: Array) -> None:
        """Raise if assembly has moved a gear to another tooth."""
        for joint in self.joints:
            row = joint.rows[0].motion
            if isinstance(row, RowFunction) and isinstance(row.function, GearRow) and abs(row.function.off(q)) > MESHES:
                raise ValueError(
                    f"{joint.name!r} does not mesh at t = {t:g} as in the position given: {row.function.other.joint!r} "
                    f"is {row.function.off(q):.6g} rad off. Give poses nearer to the start of the motion"
                )

    def rolling(
        self,
        wheel: Body | str,
        *,
        radius: float,
        axis: Any,
        foot: ArrayLike = (0.0, 0.0, 0.0),
        normal: ArrayLike = (0.0, 0.0, 1.0),
        name: str | None = None,
    ) -> ModelJoint:
        """Let a thin wheel, whose centre of mass is its centre, roll without slipping on a plane of the ground.

        The reaction is that on the wheel, about its centre.

        Parameters
        ----------
        wheel : Body or str
        radius : float
            m.
        axis : array_like (3,) or BodyDirection
            Axle of the wheel, in space in the position given.
        foot, normal : array_like (3,)
            A point of the plane, m, and its normal on the side of the wheel.
        """
        on = self._moving_body("wheel", wheel)
        name = self._new_name("rolling", name, on)
        check_positive("radius", radius)
        axle = self._direction("axis", axis, on)
        n, place = self._direction("normal", normal, self.ground), check_vector("foot", foot, 3)
        if not _upright(n, on.rotation @ axle)[1] > FLAT:
            raise ValueError(f"axis of {name!r} must not be across the plane: a wheel that lies flat does not roll")

        def height(q: Any) -> Any:
            above = sum(n[i] * (q[on.coordinates[i]] - place[i]) for i in range(3))
            return above - radius * _upright(n, vector_of(q, on.number, axle))[1]

        def slip(q: Any, v: Any, along: Any) -> Any:
            cosine, size = _upright(n, d := vector_of(q, on.number, axle))
            arm = [-radius / size * (n[i] - cosine * d[i]) for i in range(3)]
            turning = cross(spin_of(q, v, on.number), arm)
            return sum(along[i] * (v[on.coordinates[i]] + turning[i]) for i in range(3))

        columns = on.coordinates
        places = listed(columns)
        points = Numbers(tuple(on.position)), Numbers((0.0, 0.0, 0.0))
        rates = [
            RateFunction(f"rolling {name!r}", lambda q, v, along=along: slip(q, v, along), columns)
            for along in perpendiculars(n)
        ]
        ends = self.ground, on, *points, places
        rows = (
            JointRow(ROW_FUNCTION, 1, *ends, RowFunction(f"rolling {name!r}", height, columns)),
            *(JointRow(RATE_FUNCTION, 1, *ends, each) for each in rates),
        )
        return add(self.joints, ModelJoint(name, "rolling", self.ground, on, rows, *points))

    def rolling_ball(
        self,
        ball: Body | str,
        *,
        radius: float,
        on: Body | str = "ground",
        foot: Any = (0.0, 0.0, 0.0),
        normal: Any = (0.0, 0.0, 1.0),
        name: str | None = None,
    ) -> ModelJoint:
        """Let a ball, whose centre of mass is its centre, roll without slipping on a plane of a body (non-holonomic).

        The ball may spin about the normal. The reaction is that on the body of the plane, or on the ball if this is the
        ground.

        Parameters
        ----------
        ball : Body or str
        radius : float
            m.
        on : Body or str
            The body with the plane, such as a turntable.
        foot : array_like (3,) or BodyPoint
            A point of the plane, m.
        normal : array_like (3,) or BodyDirection
            Normal of the plane, on the side of the ball.

        Examples
        --------
        >>> from twoloop.bodies import SpatialModel
        >>> model = SpatialModel(gravity=(0.0, -1.0, -9.8), name="slope")
        >>> ball = model.sphere("ball", 0.1, mass=2.0, position=(0.0, 0.0, 0.1))
        >>> contact = model.rolling_ball(ball, radius=0.1)
        >>> model.problem().freedom.degrees
        3
        """
        moving, plane = self._moving_body("ball", ball), self._body("on", on)
        self._different("rolling ball", plane, moving)
        name = self._new_name("rolling ball", name, plane, moving)
        check_positive("radius", radius)
        place, n = self._point("foot", foot, plane), self._direction("normal", normal, plane)

        def height(q: Any) -> Any:
            centre = (q[j] for j in moving.coordinates[:3])
            apart = zip(vector_of(q, plane.number, n), centre, point_of(q, plane.number, place), strict=True)
            return sum(x * (y - z) for x, y, z in apart) - radius

        def slip(q: Any, v: Any, along: Any) -> Any:
            down = [-radius * x for x in vector_of(q, plane.number, n)]
            turning = cross(spin_of(q, v, moving.number), down)
            rates = [v[j] + x for j, x in zip(moving.coordinates, turning, strict=False)]
            if plane is not self.ground:
                arm = [q[i] + x - q[j] for i, j, x in zip(moving.coordinates, plane.coordinates, down, strict=False)]
                carried = cross(spin_of(q, v, plane.number), arm)
                rates = [x - v[j] - y for x, j, y in zip(rates, plane.coordinates, carried, strict=False)]
            return sum(x * y for x, y in zip(vector_of(q, plane.number, along), rates, strict=True))

        ends = plane, moving, Numbers(tuple(place)), Numbers((0.0, 0.0, 0.0))
        rows = function_rows(f"rolling ball {name!r}", [height], (plane, moving), ends)
        columns = tuple(sorted((*plane.coordinates, *moving.coordinates)))
        for along in perpendiculars(n):
            rate = RateFunction(f"rolling ball {name!r}", lambda q, v, along=along: slip(q, v, along), columns)
            rows += (JointRow(RATE_FUNCTION, 1, *ends, listed(columns), rate),)
        return add(self.joints, ModelJoint(name, "rolling ball", *ends[:2], rows, *ends[2:]))


def relative(a: Body, axis_a: Array, b: Body, axis_b: Array) -> Array:
    """Return the rotation of b relative to a that aligns their axes and is nearest to the given rotation."""
    given: Array = a.rotation.T @ b.rotation
    axis_b_in_a = given @ axis_b
    turn, c = np.cross(axis_b_in_a, axis_a), float(axis_b_in_a @ axis_a)
    if c < 0.0 and np.linalg.norm(turn) < 1e-6:  # opposite axes: half a turn about any perpendicular direction
        half = perpendiculars(axis_a)[0]
        return np.asarray((2.0 * np.outer(half, half) - np.eye(3)) @ given)
    cross = np.array([[0.0, -turn[2], turn[1]], [turn[2], 0.0, -turn[0]], [-turn[1], turn[0], 0.0]])
    return np.asarray((np.eye(3) + cross + cross @ cross / (1.0 + c)) @ given)


def _rotation(q: Any, hinge: SpatialAngle) -> Complex:
    """Return cosine and sine of the rotation of b on a since the position given."""
    half = hinge.half(q)
    c, s = _times(half, half)
    size = half[0] * half[0] + half[1] * half[1]
    return c / size, s / size


def _times(a: Complex, b: Complex) -> Complex:
    return a[0] * b[0] - a[1] * b[1], a[0] * b[1] + a[1] * b[0]


def _power(z: Complex, n: int) -> Complex:
    power = z if n & 1 else None
    while n := n >> 1:
        z = _times(z, z)
        if n & 1:
            power = z if power is None else _times(power, z)
    assert power is not None
    return power


def _angle(z: Complex) -> Any:
    """Return the argument of a unit complex number, which is linear in the angles from which it was computed."""
    return 2.0 * np.arctan(z[1] / (1.0 + z[0]))


FLAT = 1e-6  # smallest sine of the angle between axle and normal


def _upright(n: Any, axle: Any) -> tuple[Any, Any]:
    """Return cosine and sine of the angle between a normal and the axle."""
    cosine = sum(one * other for one, other in zip(n, axle, strict=True))
    return cosine, np.sqrt(1.0 - cosine * cosine)
