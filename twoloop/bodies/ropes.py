"""Couple joint coordinates by functions, and bodies by ropes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import Any

import numpy as np

from twoloop.bodies.collection import add, documented
from twoloop.bodies.frames import point_of
from twoloop.bodies.loads import Gears, Row, function_rows
from twoloop.bodies.parts import COINCIDE, Body, ModelJoint, Numbers
from twoloop.checks.arguments import check_finite, check_positive, shown


@documented
class Ropes(Gears):
    """Adds couplings of joint coordinates and ropes to a model. Their constants are not parameters of the model."""

    def coupling(self, joints: Sequence[Any], function: Callable[..., Any], *, name: str | None = None) -> ModelJoint:
        """Couple joints: a function of their coordinates stays zero.

        The reaction is the force or torque on the bodies of the first joint.

        Parameters
        ----------
        joints : sequence of ModelJoint, str or (ModelJoint or str, str)
            Joints with coordinates; a pair with "angle" or "displacement" for cylindrical and screw joints. In space,
            angles are limited to 0.95 of a turn to either side (`gear` has no such limit).
        function : callable
            function(x1, x2, ...) of the coordinates in this order, rad or m from the position given; from numpy
            functions without branches.

        Examples
        --------
        >>> from twoloop.bodies import PlanarModel
        >>> model = PlanarModel(name="wheels")
        >>> for k in range(2):
        ...     wheel = model.disc(f"wheel {k}", 0.1, mass=1.0, position=(k, 0.0))
        ...     pin = model.revolute("ground", wheel, at=(k, 0.0), name=f"pin {k}")
        >>> cam = model.coupling(["pin 0", "pin 1"], lambda x, y: y - 0.2 * x**2)
        >>> problem = model.problem(positions={"pin 0": 2.0})
        >>> round(float(problem.joint_coordinate("pin 1").position(problem.q0)), 12)
        0.8
        """
        if isinstance(joints, (str, ModelJoint)) or not isinstance(joints, (tuple, list)) or not joints:
            raise TypeError(f"joints must be a list of joints or their names; given {shown(joints)}")
        if not callable(function):
            raise TypeError(f"function must be a function of {len(joints)} coordinates; given {shown(function)}")
        pairs = [each if isinstance(each, tuple) and len(each) == 2 else (each, None) for each in joints]
        coupled = [self._which(joint, which, "coupling") for joint, which in pairs]
        coordinates = [self.joint_coordinate(*each) for each in coupled]
        names = " and ".join(dict.fromkeys(joint.name for joint, _ in coupled))
        name = self._new_name(f"coupling of {names}", name)
        first = coupled[0][0]
        ends = first.a, first.b, first.point_a, first.point_b
        bodies = [body for joint, _ in coupled for body in (joint.a, joint.b)]

        def row(q: Any) -> Any:
            return function(*[each.position(q) for each in coordinates])

        rows = function_rows(f"coupling {name!r}", [row], bodies, ends)
        return add(self.joints, ModelJoint(name, "coupling", *ends[:2], rows, *ends[2:]))

    def rope(
        self,
        points: Sequence[tuple[Body | str, Any]],
        *,
        length: float | None = None,
        winch: ModelJoint | str | None = None,
        radius: float | None = None,
        name: str | None = None,
    ) -> ModelJoint:
        """Add a massless rope of constant length through points of bodies, which stays taut.

        Points between the first and the last one are small pulleys without friction, through which the rope runs. List
        points again for a block and tackle. A negative tension, the multiplier of its row, means that a rope would be
        slack. The reaction is the force of the rope on the last body, or on the first that moves if that is the ground.

        Parameters
        ----------
        points : sequence of (Body or str, array_like or BodyPoint)
            Bodies with the points, in space in the position given, m; or `body.point(...)`.
        length : float, optional
            m. None: the sum of the distances in the position given.
        winch : ModelJoint or str, optional
            A revolute joint whose drum winds the rope up at one end, as its angle grows. None: the length is constant.
        radius : float, optional
            Radius of the drum, m; negative if it winds up as the angle falls.

        Examples
        --------
        >>> from twoloop.bodies import PlanarModel
        >>> model = PlanarModel(name="Atwood")
        >>> left = model.particle("left", mass=1.0, position=(-0.1, -1.0))
        >>> right = model.particle("right", mass=2.0, position=(0.1, -1.0))
        >>> over = [(left, left.point(0.0, 0.0)), ("ground", (-0.1, 0.0)), ("ground", (0.1, 0.0)), (right, (0.1, -1.0))]
        >>> rope = model.rope(over)
        >>> model.problem().freedom.degrees
        3
        """
        if not isinstance(points, (tuple, list)) or len(points) < 2:
            raise TypeError(f"points must be a list of two or more pairs (body, point); given {shown(points)}")
        if not all(isinstance(each, (tuple, list)) and len(each) == 2 for each in points):
            raise TypeError(f"points must be pairs (body, point); given {shown(points)}")
        bodies = [self._body(f"points[{k}]", body) for k, (body, _) in enumerate(points)]
        places = [self._point(f"points[{k}]", at, bodies[k]) for k, (_, at) in enumerate(points)]
        if all(body is self.ground for body in bodies):
            raise ValueError("points of a rope must be on a body that moves; given points of the ground only")
        name = self._new_name("rope", name, bodies[0], bodies[-1])
        starts = [body.in_space(place) for body, place in zip(bodies, places, strict=True)]
        parts = [
            (one, other, float(np.linalg.norm(starts[other] - starts[one])))
            for one, other in pairwise(range(len(points)))
        ]
        free_parts = [(one, other) for one, other, _ in parts if bodies[one] is not bodies[other]]
        fixed = sum(apart for one, other, apart in parts if (one, other) not in free_parts)
        size = COINCIDE * float(np.abs(starts).max())
        if any(apart <= size for one, other, apart in parts if (one, other) in free_parts):
            raise ValueError(
                f"neighbouring points of {name!r} coincide in the position given: leave one out, or move it"
            )
        if length is not None:
            check_positive("length", length)
        total = sum(apart for *_, apart in parts) if length is None else float(length)
        if total <= fixed:
            raise ValueError(
                f"length of {name!r} must exceed the {fixed:g} m between points of the same body; given {total!r}"
            )

        def left(q: Any) -> Any:
            """Return the length that the parts between different bodies leave."""
            ends = [point_of(q, body.number, place) for body, place in zip(bodies, places, strict=True)]
            spans = (sum((x - y) * (x - y) for x, y in zip(ends[i], ends[j], strict=True)) for i, j in free_parts)
            return total - fixed - sum(np.sqrt(span) for span in spans)

        if (winch is None) != (radius is None):
            raise TypeError(f"winch and radius go together; given winch={shown(winch)}, radius={shown(radius)}")

        def row(q: Any) -> Any:
            """Return minus this length, so that the multiplier is the tension."""
            return -left(q)

        wound: Row = row
        turned: list[Body] = []
        if winch is not None and radius is not None:
            drum = self._joint(winch, ("revolute",), "rope")
            if check_finite("radius", radius) == 0.0:
                raise ValueError("radius of the drum must not be zero; leave winch and radius out")
            wound, turned = self._wound_row(drum, left, float(radius)), [drum.a, drum.b]
        path = tuple((body, Numbers(tuple(place))) for body, place in zip(bodies, places, strict=True))
        moving = [k for k, body in enumerate(bodies) if body is not self.ground]
        last = moving[-1] if bodies[-1] is not self.ground else moving[0]
        ends = self.ground, bodies[last], Numbers(tuple(starts[last])), path[last][1]
        rows = function_rows(f"rope {name!r}", [wound], [*bodies, *turned], ends)
        return add(self.joints, ModelJoint(name, "rope", *ends[:2], rows, *ends[2:], path=path))
