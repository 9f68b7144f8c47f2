"""Couple joint coordinates by functions and tendons, and bodies by curves and ropes."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from itertools import pairwise
from typing import Any

import numpy as np

from twoloop.bodies.collection import add, documented
from twoloop.bodies.frames import point_of
from twoloop.bodies.functions import n_arguments
from twoloop.bodies.loads import CoordinateGap, Loads, Row, function_rows
from twoloop.bodies.parts import COINCIDE, Body, ModelJoint, Numbers
from twoloop.bodies.rotation import in_body_axes
from twoloop.bodies.tendons import SpringTension, Tendon, prescribed_tension
from twoloop.checks.arguments import check_finite, check_not_negative, check_positive, shown
from twoloop.problem.description import Stop


@documented
class Ropes(Loads):
    """Adds couplings of joints, curves and ropes to a model. Their constants are not parameters of the model."""

    def coupling(self, joints: Sequence[Any], function: Callable[..., Any], *, name: str | None = None) -> ModelJoint:
        """Couple joints: a function of their coordinates stays zero.

        The reaction is the force or torque on the bodies of the first joint.

        Parameters
        ----------
        joints : sequence of ModelJoint, str, Tendon or (ModelJoint or str, str)
            Joints with coordinates, or tendons; a pair with "angle" or "displacement" for cylindrical and screw joints.
            In space, angles are limited to 0.95 of a turn to either side (`gear` has no such limit).
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
        measures = [joint if hasattr(joint, "bodies") else self._single(joint, which) for joint, which in pairs]
        names = " and ".join(dict.fromkeys(each.joint for each in measures))
        name = self._new_name(f"coupling of {names}", name)
        a, b, at_a, at_b = measures[0].ends
        bodies = [body for each in measures for body in each.bodies]

        def row(q: Any) -> Any:
            return function(*[each.position(q) for each in measures])

        rows = function_rows(f"coupling {name!r}", [row], bodies, (a, b, at_a, at_b))
        return add(self.joints, ModelJoint(name, "coupling", a, b, rows, at_a, at_b))

    def point_on_curve(
        self, a: Body | str, b: Body | str, *, at: Any, curve: Callable[..., Any], name: str | None = None
    ) -> ModelJoint:
        """Keep a point of b on a curve of a, like a pin in a slot or the tip of a follower on its cam.

        Parameters
        ----------
        at : array_like (2 or 3,) or BodyPoint
            The point of b, in space in the position given, m.
        curve : callable
            In the plane curve(x, y), zero on the curve, e.g. `lambda x, y: y - 0.1 * np.cos(5.0 * x)`. In space
            curve(x, y, z): two values that are zero on a curve, or one that is zero on a surface. From numpy functions
            without branches; x, y and z in the axes of a relative to its centre of mass (ground: in space), m. The
            gradients must not vanish there, nor be parallel.

        Raises
        ------
        TypeError, ValueError
            If an argument is invalid, or the curve cannot be traced.

        Examples
        --------
        >>> import numpy as np
        >>> from twoloop.bodies import SpatialModel
        >>> model = SpatialModel(name="bead on a helix")
        >>> bead = model.particle("bead", mass=1.0, position=(1.0, 0.0, 0.0))
        >>> wire = model.point_on_curve(
        ...     "ground", bead, at=(1.0, 0.0, 0.0), curve=lambda x, y, z: (x - np.cos(z), y - np.sin(z))
        ... )
        >>> model.problem().freedom.degrees
        1
        """
        body_a, body_b = self._body("a", a), self._body("b", b)
        self._different("point_on_curve", body_a, body_b)
        name = self._new_name("point on curve", name, body_a, body_b)
        if not callable(curve):
            arguments = "x and y" if self.dimension == 2 else "x, y and z"
            raise TypeError(f"curve of {name!r} must be a function of {arguments}; given {curve!r}")
        point_b = self._point("at", at, body_b)
        point_a = body_a.local_point(body_b.in_space(point_b))
        values = np.asarray(curve(*point_a.tolist()))
        if self.dimension == 3 and values.size not in (1, 2):
            raise ValueError(
                f"curve of {name!r} must return two values for a curve, or one for a surface; it returned {values.size}"
            )

        def off(q: Any, k: int) -> Any:
            value = curve(*in_body_axes(q, body_a.number, point_of(q, body_b.number, point_b)))
            return value if self.dimension == 2 or values.ndim == 0 else value[k]

        ends = body_a, body_b, Numbers(tuple(point_a)), Numbers(tuple(point_b))
        rows = [partial(off, k=k) for k in range(1 if self.dimension == 2 else values.size)]
        joint_rows = function_rows(f"point on curve {name!r}", rows, ends[:2], ends)
        return add(self.joints, ModelJoint(name, "point on curve", *ends[:2], joint_rows, *ends[2:]))

    def _single(self, joint: ModelJoint | str, which: str | None) -> Tendon:
        """Return a joint coordinate as a tendon."""
        moved, which = self._which(joint, which, "coupling")
        coordinate = self.joint_coordinate(moved, which)
        head = coordinate.joint, coordinate.which, coordinate.a, coordinate.b
        return Tendon(*head, ((coordinate, 1.0),), (moved,))

    def tendon(
        self,
        joints: Mapping[Any, float],
        *,
        stiffness: float = 0.0,
        damping: float = 0.0,
        length: float = 0.0,
        force: Any = None,
        lower: float | None = None,
        upper: float | None = None,
        name: str | None = None,
    ) -> Tendon:
        """Add a tendon whose length is a linear combination of joint coordinates, such as over pulleys on hinges.

        Its tension acts on each joint in proportion to the coefficient of the joint. This is the fixed tendon of
        MuJoCo.

        Parameters
        ----------
        joints : mapping
            Coefficients by joints or their names: the radius of the pulley on a hinge, m, or a factor. The key of a
            coordinate of a cylindrical or screw joint is a pair, such as ("sleeve", "displacement").
        stiffness, damping : float
            N/m and N s/m; without a length in m, per rad.
        length : float
            Length at which the spring has no force, from the position given.
        force : float or callable, optional
            Tension beside that of the spring, positive where it shortens the tendon: a number, f(t) or
            f(t, length, rate).
        lower, upper : float, optional
            Limits of the length from the position given, for `solve_with_stops`.
        name : str, optional

        Returns
        -------
        Tendon
            Measures the length and its rate; `coupling` takes it like a joint.

        Raises
        ------
        TypeError, ValueError
            If an argument is invalid.

        Examples
        --------
        >>> from twoloop.bodies import PlanarModel
        >>> model = PlanarModel(name="finger")
        >>> for k in range(2):
        ...     part = model.rod(f"part {k}", (k, 0.0), (k + 1, 0.0), mass=1.0)
        >>> knuckle = model.revolute("ground", "part 0", at=(0.0, 0.0), name="knuckle")
        >>> tip = model.revolute("part 0", "part 1", at=(1.0, 0.0), name="tip")
        >>> flexor = model.tendon({"knuckle": -0.2, "tip": -0.1}, force=40.0)
        >>> model.problem().freedom.degrees
        2
        """
        if not isinstance(joints, Mapping) or not joints:
            raise TypeError(f"joints must be a mapping from joints, or their names, to numbers; given {shown(joints)}")
        pairs = {key if isinstance(key, tuple) and len(key) == 2 else (key, None): x for key, x in joints.items()}
        moved = [self._which(joint, which, "tendon") for joint, which in pairs]
        given = zip(moved, pairs.values(), strict=True)
        factors = [check_finite(f"joints[{each.name!r}]", factor) for (each, _), factor in given]
        name = self._new_name(f"tendon of {' and '.join(each.name for each, _ in moved)}", name)
        parts = tuple((self.joint_coordinate(*each), x) for each, x in zip(moved, factors, strict=True))
        kind = "angle" if all(which == "angle" for _, which in moved) else "displacement"
        first = moved[0][0]
        tendon = Tendon(name, kind, first.a.number, first.b.number, parts, tuple(each for each, _ in moved))
        k, c = check_not_negative("stiffness", stiffness), check_not_negative("damping", damping)
        rest = check_finite("length", length)
        arity = 0 if not callable(force) else n_arguments("force", force, (1, 3), "(t) or (t, length, rate)")
        if not arity and force is not None:
            check_finite("force", force)
        self.bound(tendon, lower, upper)
        if k or c:
            tendon.pull(self, SpringTension((k,), (c,), rest, rest), name)
        if force is not None:
            tendon.pull(self, partial(prescribed_tension, force, arity), self._new_name(f"force of {name}", None))
        return tendon

    def bound(self, tendon: Any, lower: float | None, upper: float | None) -> None:
        """Add limits to the length of a tendon; None: no limit."""
        if lower is not None and upper is not None and not lower < upper:
            raise ValueError(f"lower of {tendon.joint!r} must be below upper; given {lower!r}, {upper!r}")
        for bound, value, sign in (("lower", lower, 1.0), ("upper", upper, -1.0)):
            if value is not None:
                gap = CoordinateGap(tendon, check_finite(bound, value), sign)
                add(self.stops, Stop(gap, 0.0, self._new_name(f"{bound} limit of {tendon.joint}", None)))

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
            """Return the length of the rope minus the lengths of its parts between different bodies."""
            ends = [point_of(q, body.number, place) for body, place in zip(bodies, places, strict=True)]
            spans = (sum((x - y) * (x - y) for x, y in zip(ends[i], ends[j], strict=True)) for i, j in free_parts)
            return total - fixed - sum(np.sqrt(span) for span in spans)

        if (winch is None) != (radius is None):
            raise TypeError(f"winch and radius go together; given winch={shown(winch)}, radius={shown(radius)}")

        def row(q: Any) -> Any:
            """Return the negative of `left`, so that the multiplier is the tension."""
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
