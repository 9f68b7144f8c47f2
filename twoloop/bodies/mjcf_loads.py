"""Add what acts in an MJCF file to its model: springs, friction, armature, actuators, tendons; loops; the start."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any
from xml.etree.ElementTree import Element

import numpy as np

from twoloop.bodies.file_parts import FileJoint, Part, Pose, body_of, numbers, pose_of, start_point, start_pose, text_of
from twoloop.bodies.parameter_layout import HINGE_ROTOR, SLIDE_ROTOR
from twoloop.bodies.parts import Body, Force, Numbers
from twoloop.bodies.rotation import rotation_matrix
from twoloop.checks.arguments import Array, check_finite, shown

ACTUATORS = (
    *("general", "motor", "position", "velocity", "intvelocity", "damper", "cylinder", "muscle", "adhesion"),
    *("dcmotor", "plugin"),
)
SUPPORTED = ACTUATORS[:6]
AGREES = 1e-6  # tolerance of the pose that a weld prescribes


def actuator_law(tag: str, inherited: Mapping[str, str], own: Mapping[str, str]) -> dict[str, str]:
    """Merge an actuator into its defaults, which all kinds share, and return it as a general one.

    Its force is gain * command + bias_0 + bias_1 * length + bias_2 * velocity, where `gainprm` and `biasprm` count as
    far as `gaintype` and `biastype` say.
    """
    law = {**inherited, **own}
    gain, bias = (_padded(law.get(key, default)) for key, default in (("gainprm", "1"), ("biasprm", "0")))
    types = {"gaintype": "fixed", "biastype": "none", "dyntype": "none"}
    if tag == "general":
        types = {key: law.get(key, default) for key, default in types.items()}
    elif tag == "motor":
        gain, bias = np.array([1.0, 0.0, 0.0]), np.zeros(3)
    elif tag in ("position", "intvelocity"):
        gain[0] = float(own.get("kp", gain[0]))
        bias = np.array([0.0, -gain[0], -float(own["kv"]) if "kv" in own else bias[2]])
        types["biastype"] = "affine"
        if tag == "intvelocity" or float(own.get("timeconst", 0.0)):
            types["dyntype"] = "integrator" if tag == "intvelocity" else "filterexact"
    elif tag == "velocity":
        gain[0] = float(own.get("kv", -bias[2] if bias[2] else 1.0))
        bias, types["biastype"] = np.array([0.0, 0.0, -gain[0]]), "affine"
    elif tag == "damper":
        gain, types["gaintype"] = np.array([0.0, 0.0, -float(own.get("kv", 1.0))]), "affine"
    law |= types | {"gainprm": text_of(gain), "biasprm": text_of(bias)}
    return law


def _padded(text: str) -> Array:
    values = np.array([float(each) for each in text.split()][:3])
    return np.append(values, np.zeros(3 - len(values)))


class Loads:
    """Add to a model what acts on its bodies, by the reader of a file."""

    def __init__(self, reader: Any):
        self.reader, self.model, self.ignored = reader, reader.model, reader.ignored
        self.commands = dict(reader.commands)
        self.inverse: Array | None = None  # of the mass matrix in the reference pose
        names = {each.get("name", "") for group in reader.root.findall("actuator") for each in group}
        if unknown := self.commands.keys() - names:
            raise ValueError(f"commands has {min(unknown)!r}, but the file has no actuator of that name")

    def start(self, key: str | int | None) -> None:
        """Set positions and rates of the joints to those of a keyframe; its ctrl are commands not given otherwise."""
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
            if v is not None and v.any():
                joint.rate = float(v[0]) if joint.kind in ("hinge", "slide") else v
        if "ctrl" in chosen.attrib:
            actuators = [each for group in self.reader.root.findall("actuator") for each in group]
            values = numbers(chosen.attrib["ctrl"], len(actuators), f"ctrl of the keyframe {key!r}")
            for k, (each, value) in enumerate(zip(actuators, values, strict=True)):
                self.commands.setdefault(each.get("name", f"actuator {k}"), float(value))

    def read(self, scale: float) -> None:
        """Add everything; `scale`: factor of all masses."""
        reader = self.reader
        for joint in reader.ordered:
            self._joint(joint)
        for part, lump, factor, _ in reader.gravcomp:
            weight = -scale * factor * lump.mass * self.model.gravity
            if weight.any():
                self.model.force(body_of(self.model, part), start_point(part, lump.centre), weight)
        sections = {tag: [each for group in reader.root.findall(tag) for each in group] for tag in READ}
        for tag, elements in sections.items():
            before = len(self.model.forces)
            for number, each in enumerate(elements):
                getattr(self, f"_{tag}")(each, number)
            if tag == "actuator":
                self.model.actuators = tuple(self.model.forces[before:])

    def _of(self, part: Part | None) -> Body:
        return body_of(self.model, part)

    def _unit(self, joint: FileJoint) -> float:
        return float(np.pi / 180.0) if self.reader.degrees and joint.kind == "hinge" else 1.0

    def _joint(self, joint: FileJoint) -> None:
        """Add armature, spring, damper, friction and limits of a joint."""
        given, name = joint.attributes, joint.name
        single = joint.joint is not None and joint.joint.kind in ("revolute", "prismatic")
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
        self._spring(joint, single)
        if joint.kind != "free" and self.reader.limited(joint):
            self._limits(joint, single)

    def _limits(self, joint: FileJoint, single: bool) -> None:
        if not (self.reader.limits and single):
            self.ignored.append(f"limits of joint {joint.name!r}")
            return
        low, high = self._unit(joint) * numbers(joint.attributes.get("range", ""), 2, f"range of joint {joint.name!r}")
        zero = self._unit(joint) * float(joint.attributes.get("ref", 0.0)) + joint.displacement
        try:
            self.model.limit(joint.joint, lower=float(low - zero), upper=float(high - zero))
        except ValueError:  # e.g. a hinge in space
            self.ignored.append(f"limits of joint {joint.name!r}")

    def _rotors(self, joint: FileJoint, armature: float) -> None:
        """Add the armature of a ball, or of a free joint, whose rates are components along fixed axes."""
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
        """Add the spring and damper of a joint; it is unstressed at springref, and the pose of the file is ref."""
        given = joint.attributes
        stiffness, damping = (given.get(key, "0").split() for key in ("stiffness", "damping"))
        times = [float(x) for x in given.get("springdamper", "0 0").split()]
        if any(times) and not single:
            self.ignored.append(f"springdamper of joint {joint.name!r}")
        elif len(times) == 2 and min(times) > 0.0 and not self.reader.disabled & {"spring", "damper", "passive"}:
            inertia = self._inertia(joint)
            stiffness, damping = [repr(inertia / (times[0] * times[1]) ** 2)], [repr(2.0 * inertia / times[0])]
        if not any(float(x) for x in (*stiffness, *damping)):
            return
        stiff, damped = any(float(x) for x in stiffness[1:]), any(float(x) for x in damping[1:])
        if not single and not any(float(x) for x in stiffness) and not damped:
            self._damp(joint, float(damping[0]))
            return
        if not single or stiff or damped:
            self.ignored.append(f"stiffness and damping of joint {joint.name!r}")
            return
        rest = self._unit(joint) * (float(given.get("springref", 0.0)) - float(given.get("ref", 0.0)))
        self._law(joint, float(stiffness[0]), float(damping[0]), rest - joint.displacement, None)

    def _inertia(self, joint: FileJoint) -> float:
        """Return the inertia that a joint feels in the reference pose while all others are free, as MuJoCo takes it."""
        if self.inverse is None:
            self.inverse = np.asarray(np.linalg.inv(tree_inertia(self.reader.parts, self.reader.ordered)))
        first = sum(DEGREES[each.kind] for each in self.reader.ordered[: self.reader.ordered.index(joint)])
        return 1.0 / float(self.inverse[first, first])

    def _law(self, joint: FileJoint, k: float, c: float, rest: float, name: str | None) -> Force:
        assert joint.joint is not None
        if joint.joint.kind == "revolute":
            return self.model.torsion_spring(joint.joint, stiffness=k, damping=c, angle=rest, name=name)
        return self.model.axial_spring(joint.joint, stiffness=k, damping=c, length=rest, name=name)

    def _damp(self, joint: FileJoint, damping: float) -> None:
        """Add the damper of a ball or a free joint: forces against its rates."""
        part = next(each for each in self.reader.parts if joint in each.freed)
        body, parent = self._of(part), self._of(part.parent)
        turn = _Slowing(body, parent, damping, 1.0)
        self.model.torque(body, turn, name=self.reader.free(None, f"damper of {joint.name}"))
        if parent is not self.model.ground:
            back = _Slowing(body, parent, damping, -1.0)
            self.model.torque(parent, back, name=self.reader.free(None, f"reaction of the damper of {joint.name}"))
        if joint.kind == "free":
            assert part.start is not None
            origin = body.local_point(part.start.x)
            slow = _Dragging(body, origin, damping)
            self.model.force(body, body.point(*origin), slow, name=self.reader.free(None, f"drag of {joint.name}"))

    def _equality(self, element: Element, number: int) -> None:
        given = self.reader.attributes(element, "main")
        if self.reader.disabled & {"constraint", "equality"} or given.get("active", "true") == "false":
            return
        what = f"{element.tag} {element.get('name')!r}" if element.get("name") else element.tag
        if element.tag == "joint" and self._couple(given):
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
        # the pose of body 2 relative to body 1 that the weld prescribes, in the axes of both at the start
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

    def _couple(self, given: dict[str, str]) -> bool:
        """Add a joint equality: joint 1 moves as a polynomial of joint 2; return False if a model has none."""
        ends = [self.reader.joints.get(given[key]) for key in ("joint1", "joint2") if key in given]
        if not all(each is not None and each.joint is not None for each in ends):
            return False
        if any(each.joint.kind not in ("revolute", "prismatic") for each in ends):
            return False
        text = given.get("polycoef", "0 1 0 0 0").split()
        coefficients = numbers(" ".join([*text, *"00000"[len(text) :]]), 5, "polycoef of a joint equality")
        return self.couple(given.get("name"), ends, coefficients)

    def couple(self, name: str | None, ends: list[Any], coefficients: Array) -> bool:
        """Let the first joint move as a polynomial of the second, both from the reference pose of the file."""
        add_coupling = getattr(self.model, "coupling", None)
        if add_coupling is None:
            return False
        row = Polynomial(tuple(coefficients.tolist()), tuple(each.displacement for each in ends))
        own = self.reader.free(name, f"equality of {' and '.join(each.name for each in ends)}")
        add_coupling([each.joint for each in ends], row, name=own)
        return True

    def _tendon(self, element: Element, number: int) -> None:
        given = self.reader.attributes(element, "main")
        called = f"{element.tag} {element.get('name')!r}" if element.get("name") else element.tag
        rest = given.get("springlength", "-1").split()
        stiffness, damping = (given.get(key, "0") for key in ("stiffness", "damping"))
        limited = given.get("limited", "auto") == "true" or (
            given.get("limited", "auto") == "auto" and "range" in given
        )
        acting = [stiffness, damping, given.get("armature", "0"), given.get("frictionloss", "0")]
        if not limited and not any(float(x) for each in acting for x in each.split()):
            return
        plain = element.tag == "spatial" and [each.tag for each in element] == ["site", "site"]
        plain &= len(stiffness.split()) == 1 == len(damping.split())
        if not plain or len(rest) != 1 or limited:
            self.ignored.append(f"tendon: {called}")
            return
        for key in ("armature", "frictionloss"):
            if float(given.get(key, 0.0)):
                self.ignored.append(f"{key} of {called}")
        (part_1, point_1), (part_2, point_2) = (self.reader.site(each.get("site", "")) for each in element)
        length = None if float(rest[0]) < 0.0 else float(rest[0])
        if length is None and float(stiffness) and (moved := _away(part_1) or _away(part_2)):
            raise ValueError(
                f"{called} needs a springlength: MuJoCo takes that which it has where joints are at their "
                f"springref, and that of {moved!r} is not its ref"
            )
        if length is None:
            length = float(np.linalg.norm(point_1 - point_2))
        body_1, body_2 = self._of(part_1), self._of(part_2)
        ends = self._on(body_1, part_1, point_1), self._on(body_2, part_2, point_2)
        name = self.reader.free(given.get("name"), f"spring of {body_1.name} and {body_2.name}")
        values: dict[str, Any] = {"stiffness": float(stiffness), "damping": float(damping), "length": length}
        self.model.spring(body_1, ends[0], body_2, ends[1], name=name, **values)

    def _actuator(self, element: Element, number: int) -> None:
        """Add an actuator of a hinge or slide as a motor and a spring."""
        name = element.get("name", f"actuator {number}")
        called = (
            f"actuator: {element.tag} {element.get('name')!r}" if element.get("name") else f"actuator: {element.tag}"
        )
        command = self.commands.get(name, 0.0)
        if "actuation" in self.reader.disabled:
            return
        given = self.reader.attributes(element, "main")
        gain, bias = (np.array([float(x) for x in given[key].split()]) for key in ("gainprm", "biasprm"))
        if given["biastype"] == "none":
            bias = np.zeros(3)
        joint = self.reader.joints.get(given.get("joint", given.get("jointinparent", "")))
        single = joint is not None and joint.joint is not None and joint.joint.kind in ("revolute", "prismatic")
        fixed = given["gaintype"] == "fixed" or (given["gaintype"] == "affine" and not gain[1:].any())
        if element.tag not in SUPPORTED or not single or not fixed or given["biastype"] not in ("none", "affine"):
            self.ignored.append(called)
            return
        assert joint is not None and joint.joint is not None
        if given["dyntype"] != "none":
            self.ignored.append(f"the command of {called}, whose activation is {given['dyntype']}")
            command = 0.0
        gear = float(given.get("gear", "1").split()[0])
        k, c = -gear * gear * bias[1], -gear * gear * bias[2]
        if min(k, c) < 0.0:
            self.ignored.append(called)
            return
        for key, flag in (("forcerange", "forcelimited"), ("ctrlrange", "ctrllimited")):
            limited = given.get(flag, "auto")
            if limited == "true" or (limited == "auto" and key in given):
                if key == "ctrlrange" and not callable(command):
                    low, high = numbers(given.get(key, ""), 2, f"ctrlrange of {called}")
                    command = float(np.clip(check_finite(f"commands[{name!r}]", command), low, high))
                else:
                    self.ignored.append(f"{key} of {called}")
        zero = self._unit(joint) * float(joint.attributes.get("ref", 0.0)) + joint.displacement  # qpos at the start
        own = self.reader.free(name, f"actuator of {joint.name}")
        servo = k > 0.0 and gain[0] == -bias[1] and not bias[0] and not callable(command)
        if servo:  # the command is where the spring has no force
            self._law(joint, k, c, command / gear - zero, own)
            return
        if k or c:
            self._law(joint, k, c, -zero, self.reader.free(None, f"gains of {own}"))
        self.model.motor(joint.joint, _torque(command, gear * gain[0], gear * bias[0]), name=own)


DEGREES = {"hinge": 1, "slide": 1, "ball": 3, "free": 6}


def tree_inertia(parts: list[Part], joints: list[FileJoint]) -> Array:
    """Return the mass matrix of the joints of a tree in the reference pose, in the order of the joints."""
    first = dict(zip(map(id, joints), np.cumsum([0, *(DEGREES[each.kind] for each in joints)]), strict=False))
    n = sum(DEGREES[each.kind] for each in joints)
    M = np.diag([float(each.attributes.get("armature", 0.0)) for each in joints for _ in range(DEGREES[each.kind])])
    for part in parts:
        for lump in part.lumps:
            linear, angular = np.zeros((3, n)), np.zeros((3, n))
            carrier: Part | None = part
            while carrier is not None:
                for each in carrier.freed:
                    k = first[id(each)]
                    axes = each.axis[None] if each.kind in ("hinge", "slide") else carrier.pose.R.T
                    if each.kind == "free":
                        linear[:, k : k + 3] = np.eye(3)
                        k += 3
                    for axis in axes:
                        if each.kind == "slide":
                            linear[:, k] = axis
                        else:
                            linear[:, k], angular[:, k] = np.cross(axis, lump.centre - each.at), axis
                        k += 1
                carrier = carrier.parent
            M += lump.mass * linear.T @ linear + angular.T @ lump.J @ angular
    return M


READ = ("equality", "tendon", "actuator")  # sections, in order


def _torque(command: float | Callable[[Any], Any], factor: float, constant: float) -> Any:
    """Return the force of an actuator: a number, or a function of t."""
    return _Commanded(command, factor, constant) if callable(command) else factor * command + constant


class _Commanded:
    """Evaluate the force of an actuator with a command that is a function of time."""

    def __init__(self, command: Callable[[Any], Any], factor: float, constant: float):
        self.command, self.factor, self.constant = command, factor, constant

    def __call__(self, t: Any) -> Any:
        return self.factor * self.command(t) + self.constant


class Polynomial:
    """Evaluate x1 - (c0 + c1 x2 + ...), a row that couples two joint coordinates given from the start of a model.

    `offsets`: displacements of both joints at the start, from the reference pose of the file. With one joint, the row
    is x1 - c0.
    """

    def __init__(self, coefficients: tuple[float, ...], offsets: tuple[float, ...]):
        self.coefficients, self.offsets = coefficients, offsets

    def __call__(self, first: Any, *second: Any) -> Any:
        """Return the residual, for numbers or symbols."""
        total: Any = self.coefficients[0]
        for x in second:
            total = 0.0
            for coefficient in self.coefficients[::-1]:
                total = total * (x + self.offsets[1]) + coefficient
        return first + self.offsets[0] - total


def _spin(q: Any, v: Any, body: Body) -> list[Any]:
    """Return the angular velocity of a body in space, for numbers or symbols."""
    if not body.coordinates:
        return [0.0, 0.0, 0.0]
    e, u = ([x[k] for k in body.coordinates[3:]] for x in (q, v))
    both = _cross(e[1:], u[1:])
    return [2.0 * (e[0] * u[i + 1] - u[0] * e[i + 1] + both[i]) for i in range(3)]


class _Slowing:
    """Evaluate the torque of a damper against the angular velocity of a body relative to another."""

    def __init__(self, body: Body, parent: Body, damping: float, sign: float):
        self.body, self.parent, self.factor = body, parent, -sign * damping

    def __call__(self, t: Any, q: Any, v: Any) -> Any:
        spins = zip(_spin(q, v, self.body), _spin(q, v, self.parent), strict=True)
        return [self.factor * (own - other) for own, other in spins]


class _Dragging:
    """Evaluate the force of a damper against the velocity of a point of a body."""

    def __init__(self, body: Body, point: Array, damping: float):
        self.body, self.point, self.damping = body, point, damping

    def __call__(self, t: Any, q: Any, v: Any) -> Any:
        from twoloop.bodies.frames import vector_of

        turning = _cross(_spin(q, v, self.body), vector_of(q, self.body.number, self.point))
        return [-self.damping * (v[self.body.coordinates[k]] + turning[k]) for k in range(3)]


def _cross(a: Any, b: Any) -> list[Any]:
    return [a[i - 2] * b[i - 1] - a[i - 1] * b[i - 2] for i in range(3)]


def _away(part: Part | None) -> str:
    """Return the name of a joint between a part and the ground whose springref differs from its ref, or ""."""
    while part is not None:
        for freed in part.freed:
            spring, given = (float(freed.attributes.get(key, 0.0)) for key in ("springref", "ref"))
            if freed.kind in ("hinge", "slide") and spring != given:
                return freed.name
        part = part.parent
    return ""
