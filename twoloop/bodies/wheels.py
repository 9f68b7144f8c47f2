"""Wheels that roll without slipping on a plane in space (non-holonomic)."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from twoloop.bodies.documented import documented
from twoloop.bodies.parameter_layout import RATE, WRITTEN
from twoloop.bodies.parts import Body, JointRow, ModelJoint, Numbers
from twoloop.bodies.places import turned
from twoloop.bodies.rotation import perpendiculars
from twoloop.bodies.row_function import RateFunction, RowFunction
from twoloop.bodies.spatial_shapes import SpatialShapes
from twoloop.checks.arguments import check_positive, check_vector

FLAT = 1e-6  # smallest sine of the angle between axle and normal


@documented
class Wheels(SpatialShapes):
    """Adds rolling wheels to a spatial model."""

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
            return above - radius * _upright(n, turned(q, on, axle))[1]

        def slip(q: Any, v: Any, along: Any) -> Any:
            cosine, size = _upright(n, d := turned(q, on, axle))
            e, u = ([x[j] for j in on.coordinates[3:]] for x in (q, v))
            both = _cross(e[1:], u[1:])
            spin = [2.0 * (e[0] * u[i + 1] - u[0] * e[i + 1] + both[i]) for i in range(3)]
            arm = [-radius / size * (n[i] - cosine * d[i]) for i in range(3)]
            turning = _cross(spin, arm)
            return sum(along[i] * (v[on.coordinates[i]] + turning[i]) for i in range(3))

        columns = on.coordinates
        places = Numbers((float(len(columns)), *map(float, columns)))
        points = Numbers(tuple(on.position)), Numbers((0.0, 0.0, 0.0))
        rates = [
            RateFunction(f"rolling {name!r}", lambda q, v, along=along: slip(q, v, along), columns)
            for along in perpendiculars(n)
        ]
        ends = self.ground, on, *points, places
        rows = (
            JointRow(WRITTEN, 1, *ends, RowFunction(f"rolling {name!r}", height, columns)),
            *(JointRow(RATE, 1, *ends, each) for each in rates),
        )
        return self._add_joint(ModelJoint(name, "rolling", self.ground, on, rows, *points))


def _upright(n: Any, axle: Any) -> tuple[Any, Any]:
    """Return cosine and sine of the angle between a normal and the axle."""
    cosine = sum(one * other for one, other in zip(n, axle, strict=True))
    return cosine, np.sqrt(1.0 - cosine * cosine)


def _cross(a: Any, b: Any) -> list[Any]:
    return [a[i - 2] * b[i - 1] - a[i - 1] * b[i - 2] for i in range(3)]
