"""Add the loads of an MJCF file to its model: springs, friction, armature, a medium; also loops and the start."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from typing import Any
from xml.etree.ElementTree import Element

import numpy as np

from twoloop.bodies.file_parts import (
    SAME,
    FileJoint,
    Part,
    Pose,
    body_of,
    name_of,
    numbers,
    pose_of,
    start_point,
    start_pose,
    text_of,
)
from twoloop.bodies.frames import vector_of
from twoloop.bodies.mjcf_actuators import FILTERS, TendonsAndActuators, activation_of, is_single, trimmed
from twoloop.bodies.parameter_layout import HINGE_ROTOR, SLIDE_ROTOR
from twoloop.bodies.parts import Body, Force, ModelJoint, Numbers
from twoloop.bodies.rotation import (
    euler_parameters,
    euler_product,
    parameters_of,
    rate_of_vector,
    rotation_matrix,
    spin_of,
)
from twoloop.bodies.tendons import SpringTension
from twoloop.checks.arguments import Array, shown

SMALL = 1e-9  # the spring of a ball is linear if the sine of half its angle is smaller
AT_REST = 1e-12  # rad/s or m/s: joints with a smaller rate in a keyframe rest, as rounding may contradict closed loops
AGREES = 1e-6  # tolerance of the pose that a weld prescribes, m and entries of the rotation matrix


class Loads(TendonsAndActuators):
    """Add to a model the loads on its bodies; `reader`: the reader of the file."""

    def __init__(self, reader: Any):
        super().__init__(reader)
        names = {each.get("name", "") for group in reader.root.findall("actuator") for each in group}
        if unknown := self.commands.keys() - names:
            raise ValueError(f"commands has {min(unknown)!r}, but the file has no actuator of that name")

    def start(self, key: str | int | None) -> None:
        """Set positions and rates of the joints from a keyframe, and commands from its ctrl unless given otherwise."""
        if key is None:
            return
        keys = [each for group in self.reader.root.findall("keyframe") for each in group]
        names = [each.get("name", str(k)) for k, each in enumerate(keys)]
        if isinstance(key, str) and key not in names:
            raise ValueError(
                f"key must be a keyframe of the file, {', '.join(map(repr, names)) or 'none'}; given {key!r}"
            )
        if not isinstance(key, str) and (isinstance(key, bool) or not isinstance(key, int) or not 0 <= key < len(keys)):
            raise ValueError(f"key must be a name or a number below {len(keys)}, of a keyframe; given {shown(key)}")
        chosen = keys[names.index(key) if isinstance(key, str) else key]
        sizes = {"free": (7, 6), "ball": (4, 3), "hinge": (1, 1), "slide": (1, 1)}
        totals = [sum(sizes[each.kind][k] for each in self.reader.ordered) for k in range(2)]
        state = [
            numbers(chosen.attrib[what], total, f"{what} of the keyframe {key!r}") if what in chosen.attrib else None
            for what, total in zip(("qpos", "qvel"), totals, strict=True)
        ]
        at = [0, 0]
        for joint in self.reader.ordered:
            parts = []
            for k in range(2):
                begin, at[k] = at[k], at[k] + sizes[joint.kind][k]
                values = state[k]
                parts.append(None if values is None else values[begin : at[k]])
            q, v = parts
            if q is not None and joint.kind in ("hinge", "slide"):
                joint.position = float(q[0]) - self._unit(joint) * float(joint.attributes.get("ref", 0.0))
            elif q is not None:
                R = rotation_matrix(q[-4:] / np.linalg.norm(q[-4:]))
                joint.position = R if joint.kind == "ball" else Pose(q[:3], R)
            if v is not None and np.abs(v).max() > AT_REST:
                joint.rate = float(v[0]) if joint.kind in ("hinge", "slide") else v
        actuators = [each for group in self.reader.root.findall("actuator") for each in group]
        activations = [activation_of(each, self.reader.attributes(each, "main")) for each in actuators]
        names = [each.get("name", f"actuator {k}") for k, each in enumerate(actuators)]
        active = [name for name, activation in zip(names, activations, strict=True) if activation != "none"]
        several = {each.tag for each in actuators} & {"pid", "orientation"}  # kinds that may have several commands
        unknown = {*activations} - {"none", "muscle", *FILTERS}
        for what, given, which, unclear in (
            ("ctrl", self.commands, names, several),
            ("act", self.activations, active, unknown),
        ):
            if what in chosen.attrib and unclear:
                self.ignored.append(f"{what} of the keyframe {key!r}, the commands or activations of actuators")
            elif what in chosen.attrib:
                values = numbers(chosen.attrib[what], len(which), f"{what} of the keyframe {key!r}").tolist()
                given |= dict(zip(which, values, strict=True)) | given

    def read(self, scale: float) -> None:
        """Add everything; `scale`: factor of all masses."""
        reader = self.reader
        for joint in reader.ordered:
            self._joint(joint)
        passive = not {"stiffness", "damping"} <= reader.without
        compensated = passive and any(factor > 0.0 for _, _, factor in reader.gravcomp)  # MuJoCo: else not at all
        for part, lump, factor in reader.gravcomp if compensated else ():
            weight = -scale * factor * lump.mass * self.model.gravity
            if weight.any():
                self.model.force(body_of(self.model, part), start_point(part, lump.centre), weight)
        if passive:
            self._medium()
        sections = {tag: [each for group in reader.root.findall(tag) for each in group] for tag in READ}
        for tag, elements in sections.items():
            for each in elements if tag == "actuator" else ():
                self._passive(each)
            before = len(self.model.forces)
            for number, each in enumerate(elements):
                getattr(self, f"_{tag}")(each, number)
            if tag == "actuator":
                self.model.actuators = tuple(self.model.forces[before:])

    def _medium(self) -> None:
        """Add the forces of the medium on each body of the file."""
        medium = self.reader.medium
        if not (medium.density or medium.viscosity):
            return
        for number, (part, lump) in enumerate(self.reader.wetted):
            body, local = self._of(part), lump.transformed(part.pose.inverse())
            own = replace(local, centre=body.local_point(start_point(part, lump.centre)))
            names = [self.reader.free(None, f"{what} of the medium {number}") for what in ("drag", "twist")]
            medium.act(self.model, body, own, names)

    def _joint(self, joint: FileJoint) -> None:
        """Add armature, spring, damper, friction and limits of a joint."""
        given, name = joint.attributes, joint.name
        single = is_single(joint)
        armature, friction = (float(given.get(key, 0.0)) for key in ("armature", "frictionloss"))
        if armature and single:
            self.model.rotor(joint.joint, armature, name=self.reader.free(None, f"armature of {name}"))
        elif armature:
            self._rotors(joint, armature)
        if friction and single:
            self.model.dry_friction(joint.joint, friction, name=self.reader.free(None, f"friction of {name}"))
            self.ignored.append(f"frictionloss of joint {name!r} by solve_dae (solve_with_friction has it)")
        elif friction:
            self.ignored.append(f"frictionloss of joint {name!r}")
        self.ignored += [f"springyield of joint {name!r}"] if "springyield" in given else []
        if given.get("actuatorgravcomp", "false") == "true" and self.reader.gravcomp:
            limited = self.reader.limited(given, "actuatorfrclimited", "actuatorfrcrange")
            if limited or "actuation" in self.reader.disabled or self.reader.root.find("actuator/*") is None:
                self.ignored.append(f"actuatorgravcomp of joint {name!r}")
        self._spring(joint, single)
        if joint.kind != "free" and self.reader.limited(joint.attributes):
            self._limits(joint, single)

    def _limits(self, joint: FileJoint, single: bool) -> None:
        if not (self.reader.limits and single):
            self.ignored.append(f"limits of joint {joint.name!r}")
            return
        low, high = self._unit(joint) * numbers(joint.attributes.get("range", ""), 2, f"range of joint {joint.name!r}")
        zero = self._reference(joint) + joint.displacement
        try:
            self.model.limit(joint.joint, lower=float(low - zero), upper=float(high - zero))
        except ValueError:  # e.g. a hinge in space
            self.ignored.append(f"limits of joint {joint.name!r}")

    def _rotors(self, joint: FileJoint, armature: float) -> None:
        """Add the armature of a ball or free joint; the rates of these joints are components along fixed axes."""
        part = next(each for each in self.reader.parts if joint in each.freed)
        body, parent = self._of(part), self._of(part.parent)
        assert part.start is not None
        numbers = Numbers((armature,), (f"inertia of armature of {joint.name} (kg m^2)",))
        axes = [Numbers(tuple(body.local_direction(part.start.R[:, k]))) for k in range(3)]
        for k in range(3):
            own = self.reader.free(None, f"armature {k + 1} of {joint.name}")
            self.model.forces.append(Force(own, HINGE_ROTOR, body, parent, axes[k], None, numbers))
        if joint.kind == "free":
            origin = Numbers(tuple(body.local_point(part.start.x)))
            for k in range(3):
                own = self.reader.free(None, f"armature {k + 4} of {joint.name}")
                axis = Numbers(tuple(np.eye(3)[k]))
                self.model.forces.append(
                    Force(own, SLIDE_ROTOR, self.model.ground, body, axis, origin, numbers, point_on_first=origin)
                )

    def _spring(self, joint: FileJoint, single: bool) -> None:
        """Add the spring and damper of a joint; the spring is unstressed at springref, and ref is the file's pose."""
        given = joint.attributes
        stiffness, damping = (trimmed(given.get(key, "0")) for key in ("stiffness", "damping"))
        times = [float(x) for x in given.get("springdamper", "0 0").split()]
        if any(times) and not single:
            self.ignored.append(f"springdamper of joint {joint.name!r}")
        elif len(times) == 2 and min(times) > 0.0:
            inertia, without = self._inertia([joint], [1.0]), self.reader.without
            stiffness[0] = 0.0 if "stiffness" in without else inertia / (times[0] * times[1]) ** 2
            damping[0] = 0.0 if "damping" in without else 2.0 * inertia / times[0]
        if not any((*stiffness, *damping)):
            return
        linear = len(stiffness) == len(damping) == 1
        if not single and linear and (joint.kind == "ball" or not stiffness[0]):
            self._resist(joint, stiffness[0], damping[0])
        elif not single:
            self.ignored.append(f"stiffness and damping of joint {joint.name!r}")
        elif linear:
            rest = self._unit(joint) * (float(given.get("springref", 0.0)) - float(given.get("ref", 0.0)))
            self._law(joint, stiffness[0], damping[0], rest - joint.displacement, None)
        else:
            tendon, _ = self._combination(None, [(joint, 1.0)])
            rest = self._unit(joint) * float(given.get("springref", 0.0))
            assert tendon is not None
            tendon.pull(
                self.model,
                SpringTension(stiffness, damping, rest, rest),
                self.reader.free(None, f"spring of {joint.name}"),
            )

    def _resist(self, joint: FileJoint, stiffness: float, damping: float) -> None:
        """Add spring (no torque in the reference pose) and damper of a ball, or the damper of a free joint."""
        part = next(each for each in self.reader.parts if joint in each.freed)
        body, parent = self._of(part), self._of(part.parent)
        outer = np.eye(3) if part.parent is None else part.parent.pose.R
        zero = euler_parameters(part.pose.R.T @ outer)
        start = [euler_parameters(each.rotation) for each in (parent, body)]
        start[0][1:] *= -1.0
        if euler_product(zero, euler_product(*start))[0] < 0.0:  # take the sign for an angle within half a turn
            zero = -zero
        numbers_of = stiffness, damping, tuple(zero.tolist())
        turn = _Resisting(body, parent, *numbers_of, 1.0)
        self.model.torque(body, turn, name=self.reader.free(None, f"damper of {joint.name}"))
        if parent is not self.model.ground:
            back = _Resisting(body, parent, *numbers_of, -1.0)
            self.model.torque(parent, back, name=self.reader.free(None, f"reaction of the damper of {joint.name}"))
        if joint.kind == "free":
            assert part.start is not None
            origin = body.local_point(part.start.x)
            slow = partial(_drag, body, origin, damping)
            self.model.force(body, body.point(*origin), slow, name=self.reader.free(None, f"drag of {joint.name}"))

    def _equality(self, element: Element, number: int) -> None:
        given = self.reader.attributes(element, "main", "equality")
        if self.reader.disabled & {"constraint", "equality"} or given.get("active", "true") == "false":
            return
        what = name_of(element)
        if element.tag in ("joint", "tendon") and self._couple(given, element.tag):
            return
        if element.tag not in ("connect", "weld"):
            self.ignored.append(f"equality: {what}")
            return
        between_sites = "site1" in given
        if between_sites:
            frames = [self.reader.frame(f"site {given[key]}") for key in ("site1", "site2")]
        else:
            frames = [self.reader.frame(given.get(key, "world")) for key in ("body1", "body2")]
        (part_1, frame_1), (part_2, frame_2) = frames
        body_1, body_2 = self._of(part_1), self._of(part_2)
        if body_1 is body_2:  # the two bodies of the file are fixed to each other
            self.ignored += [f"equality: {what}, within one body"] if between_sites or "relpose" in given else []
            return
        name = self.reader.free(given.get("name"), f"{element.tag} of {body_1.name} and {body_2.name}")
        if element.tag == "connect":
            points = frame_1.x, frame_2.x
            if not between_sites:
                points = (frame_1.point(numbers(given.get("anchor", ""), 3, f"anchor of {what}")),) * 2
            at = self._on(body_1, part_1, points[0]), self._on(body_2, part_2, points[1])
            self.model.spherical(body_1, body_2, at=at, name=name)
            return
        if float(given.get("torquescale", 1.0)) == 0.0:
            raise ValueError(f"torquescale of {what} must not be zero: give a connect where bodies may turn")
        wanted = numbers(given.get("relpose", "0 1 0 0 0 0 0"), 7, f"relpose of {what}")
        asked = frame_2
        if between_sites:
            asked = frame_1
        elif wanted[3:].any():
            pose = pose_of({"pos": text_of(wanted[:3]), "quat": text_of(wanted[3:])}, what, True, "xyz")
            asked = frame_1.then(pose)
        # the pose of body 2 that the weld prescribes, and its pose at the start
        meant, has = (start_pose(part_1, asked), start_pose(part_2, frame_2))
        off = max(np.abs(meant.x - has.x).max(), np.abs(meant.R - has.R).max())
        if off > AGREES:
            raise ValueError(
                f"{what} must hold the pose that the bodies have at the start; it is off by {off:.3g}: correct the "
                "poses, or start from a keyframe where they agree (key=...)"
            )
        self.model.fixed(body_1, body_2, name=name)

    def _on(self, body: Body, part: Part | None, at: Array) -> Any:
        return body.point(*body.local_point(start_point(part, at)))

    def _couple(self, given: dict[str, str], kind: str) -> bool:
        """Make a joint or tendon move as a polynomial of another one; return False if models do not support this."""
        names = [given[key] for key in (f"{kind}1", f"{kind}2") if key in given]
        if kind == "tendon":
            pairs = [self.tendons.get(name, (None, 0.0)) for name in names]
            ends, offsets = [each for each, _ in pairs], [-reference for _, reference in pairs]
        else:
            joints = [self.reader.joints.get(name) for name in names]
            if not all(each is not None and is_single(each) for each in joints):
                return False
            ends, offsets = [each.joint for each in joints], [each.displacement for each in joints]
        if not names or None in ends:
            return False
        text = given.get("polycoef", "").split()
        coefficients = numbers(" ".join([*text, *"01000"[len(text) :]]), 5, f"polycoef of a {kind} equality")
        own = self.reader.free(given.get("name"), f"equality of {' and '.join(names)}")
        couple(self.model, ends, offsets, tuple(coefficients.tolist()), own)
        return True


READ = ("tendon", "equality", "actuator")  # sections, in order


def couple(
    model: Any, ends: Sequence[Any], offsets: Sequence[float], coefficients: tuple[float, ...], name: str
) -> None:
    """Make the first of two joints or tendons move as a polynomial of the second, or keep one in place.

    Two hinges whose angles are proportional become gears, if the poses fit: gears may turn without limits.
    """
    hinges = [isinstance(end, ModelJoint) and end.kind == "revolute" for end in ends]
    linear = len(ends) == 2 and all(hinges) and coefficients[1] != 0.0 and not any(coefficients[2:])
    if linear and abs(polynomial(coefficients, (0.0, 0.0), *offsets)) <= SAME:
        with suppress(ValueError):  # a ratio that is not one of whole numbers
            model.gear(ends[1], ends[0], ratio=coefficients[1], name=name)
            return
    model.coupling(list(ends), partial(polynomial, coefficients, tuple(offsets)), name=name)


def polynomial(coefficients: tuple[float, ...], offsets: tuple[float, ...], first: Any, *second: Any) -> Any:
    """Return x1 - (c0 + c1 x2 + ...), a row that couples two joint coordinates, or x1 - c0 for one coordinate.

    `first` and `second` are displacements from the start of the model, numbers or symbols; `offsets`, added to them,
    are the displacements of the joints at the start from the reference pose of the file.
    """
    total: Any = coefficients[0]
    for x in second:
        total = 0.0
        for coefficient in coefficients[::-1]:
            total = total * (x + offsets[1]) + coefficient
    return first + offsets[0] - total


@dataclass(frozen=True, eq=False)
class _Resisting:
    """Evaluate the torque of a spring and damper against the rotation of a body relative to another."""

    body: Body
    parent: Body
    stiffness: float
    damping: float
    zero: tuple[float, ...]  # inverse of the relative Euler parameters at which the torque is zero
    sign: float

    def __call__(self, t: Any, q: Any, v: Any) -> Any:
        own, other = self.body.number, self.parent.number
        spins = zip(spin_of(q, v, own), spin_of(q, v, other), strict=True)
        torque = [self.damping * (x - y) for x, y in spins]
        if self.stiffness:
            angle, s, e = self._angle(q)
            turn = self.stiffness * angle / s
            torque = [x + y for x, y in zip(torque, vector_of(q, own, [turn * x for x in e]), strict=True)]
        return [-self.sign * x for x in torque]

    def potential(self, q: Any) -> Any:
        """Return the potential energy of the spring, for one state or many; zero for its reaction."""
        return 0.5 * self.stiffness * self._angle(q)[0] ** 2 if self.sign > 0.0 else 0.0

    def _angle(self, q: Any) -> Any:
        """Return the angle of the rotation, the sine of half this angle, and this sine times the axis."""
        relative = euler_product(parameters_of(q, self.parent.number, -1.0), parameters_of(q, self.body.number))
        w, *e = euler_product(self.zero, relative)
        s = np.sqrt(sum(x * x for x in e) + SMALL * SMALL)
        return 4.0 * np.arctan(s / (w + 1.0)), s, e


def _drag(body: Body, point: Array, damping: float, t: Any, q: Any, v: Any) -> Any:
    """Return the force of a damper against the velocity of a point of a body."""
    turning = rate_of_vector(q, v, body.number, point)
    return [-damping * (v[body.coordinates[k]] + turning[k]) for k in range(3)]
