"""Add tendons and actuators of an MJCF file to its model."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any
from xml.etree.ElementTree import Element

import numpy as np

from twoloop.bodies.file_parts import (
    FileJoint,
    Part,
    body_of,
    name_of,
    numbers,
    place,
    start_point,
    start_pose,
    text_of,
)
from twoloop.bodies.frames import vector_of
from twoloop.bodies.parts import Body, Force
from twoloop.bodies.tendons import SitePath, SpringTension, Tendon, Tension, bounded
from twoloop.checks.arguments import Array, check_finite

ACTUATORS = (
    *("general", "motor", "position", "velocity", "intvelocity", "damper", "cylinder", "muscle", "adhesion"),
    *("dcmotor", "plugin"),
)
SUPPORTED = ACTUATORS[:7]
FILTERS = ("filter", "filterexact", "integrator")  # activations that have a closed form for a constant command
IMMEDIATE = 1e-15  # s, least time constant of MuJoCo: an activation without delay


def actuator_law(tag: str, inherited: Mapping[str, str], own: Mapping[str, str]) -> dict[str, str]:
    """Merge an actuator into its defaults, which all kinds share, and return it as a "general" actuator.

    The force is gain * command + bias_0 + bias_1 * length + bias_2 * velocity; `gaintype` and `biastype` tell which
    numbers of `gainprm` and `biasprm` count. A positive bias_2 is a damping ratio.
    """
    law = {**inherited, **own}
    gain, bias = (_padded(key, inherited, own, default) for key, default in (("gainprm", "1"), ("biasprm", "0")))
    types = {"gaintype": "fixed", "biastype": "none", "dyntype": "none"}
    stored = law.get(tag, "1 1 0 0 0" if tag == "cylinder" else "1 0 0")  # the parameters of this kind in the defaults
    first, last, constant, *more = (float(x) for x in stored.split())
    if tag == "general":
        types = {key: law.get(key, default) for key, default in types.items()}
        if types["gaintype"] == "fixed":
            law |= dict.fromkeys(("position", "intvelocity", "velocity"), text_of((gain[0], bias[2], 0.0)))
            law["cylinder"] = text_of((gain[0], law.get("dynprm", "1").split()[0], *bias))
        else:
            law["damper"] = text_of((0.0, -gain[2], 0.0))
    elif tag == "motor":
        gain, bias = np.array([1.0, 0.0, 0.0]), np.zeros(3)
    elif tag in ("position", "intvelocity"):
        first, constant = float(own.get("kp", first)), float(own.get("timeconst", constant))
        last = -float(own["kv"]) if "kv" in own else float(own.get("dampratio", last))
        gain, bias, types["biastype"] = np.array([first, 0.0, 0.0]), np.array([0.0, -first, last]), "affine"
        if tag == "intvelocity" or constant:
            types["dyntype"], law["dynprm"] = "integrator" if tag == "intvelocity" else "filterexact", str(constant)
    elif tag == "cylinder":
        first, last = float(own.get("area", first)), float(own.get("timeconst", last))
        first = 0.25 * np.pi * float(own["diameter"]) ** 2 if "diameter" in own else first
        constant, *more = (float(x) for x in own["bias"].split()) if "bias" in own else (constant, *more)
        gain, bias = np.array([first, 0.0, 0.0]), np.array([constant, *more])
        types |= {"biastype": "affine", "dyntype": "filter"}
        law["dynprm"] = str(last)
    elif tag == "velocity":
        first = float(own.get("kv", first))
        gain, bias, types["biastype"] = np.array([first, 0.0, 0.0]), np.array([0.0, 0.0, -first]), "affine"
    elif tag == "damper":
        last = float(own.get("kv", last))
        gain, types["gaintype"] = np.array([0.0, 0.0, -last]), "affine"
        law["ctrllimited"] = "true"
    law |= types | {"gainprm": text_of(gain), "biasprm": text_of(bias)}
    return law if tag in ("general", "motor") else law | {tag: text_of((first, last, constant, *more))}


def _padded(key: str, inherited: Mapping[str, str], own: Mapping[str, str], default: str) -> Array:
    """Return three parameters of an element; it inherits the parameters that it does not give."""
    values, rest = ([float(x) for x in each.split()] for each in (own.get(key, ""), inherited.get(key, default)))
    return np.array([*values, *rest[len(values) :], 0.0, 0.0, 0.0][:3])


class TendonsAndActuators:
    """Add to a model the tendons and actuators of a file; `reader`: the reader of the file."""

    def __init__(self, reader: Any):
        self.reader, self.model, self.ignored = reader, reader.model, reader.ignored
        self.commands: dict[str, Any] = dict(reader.commands)
        self.activations: dict[str, float] = {}  # activations at the start that are not zero
        self.inertia: Array | None = None  # mass matrix of the tree in the reference pose
        self.tendons: dict[str, tuple[Any, float]] = {}  # tendons, and their lengths in the reference pose
        self.ranges: dict[str, str] = {}  # ranges of the lengths of tendons
        self.carriers: dict[str, list[tuple[Part | None, Array]]] = {}  # points of a path, in the reference pose

    def _of(self, part: Part | None) -> Body:
        return body_of(self.model, part)

    def _unit(self, joint: FileJoint) -> float:
        return float(np.pi / 180.0) if self.reader.compiler(joint.attributes).degrees and joint.kind == "hinge" else 1.0

    def _inertia(self, joints: list[FileJoint], factors: list[float]) -> float:
        """Return the effective inertia for a combination of joints, in the reference pose, with all joints free."""
        if self.inertia is None:
            self.inertia = tree_inertia(self.reader.parts, self.reader.ordered)
            for element in (each for group in self.reader.root.findall("actuator") for each in group):
                given = self.reader.attributes(element, "main")
                if (moved := self._joint_of(given)) and is_single(moved):
                    self.inertia[(self._place(moved),) * 2] += float(given.get("armature", 0.0)) * _gear(given) ** 2
        w = np.zeros(len(self.inertia))
        for joint, factor in zip(joints, factors, strict=True):
            w[self._place(joint)] = factor
        try:
            return 1.0 / float(w @ np.linalg.solve(self.inertia, w))
        except np.linalg.LinAlgError:
            raise ValueError(
                f"springdamper or dampratio at joint {joints[0].name!r} needs inertia behind all joints: give the "
                "bodies masses, or stiffness and damping in the place of it"
            ) from None

    def _place(self, joint: FileJoint) -> int:
        """Return the number of the first coordinate of a joint in the order of the joints."""
        return sum(DEGREES[each.kind] for each in self.reader.ordered[: self.reader.ordered.index(joint)])

    def _law(self, joint: FileJoint, k: float, c: float, rest: float, name: str | None) -> Force:
        assert joint.joint is not None
        if joint.joint.kind == "revolute":
            return self.model.torsion_spring(joint.joint, stiffness=k, damping=c, angle=rest, name=name)
        return self.model.axial_spring(joint.joint, stiffness=k, damping=c, length=rest, name=name)

    def _tendon(self, element: Element, number: int) -> None:
        given = self.reader.attributes(element, "main")
        called = name_of(element)
        tendon: Tendon | SitePath | None
        if element.tag == "spatial":
            tendon, reference = self._path(element)
        else:
            pairs = [(self.reader.joints.get(each.get("joint", "")), float(each.get("coef", 1.0))) for each in element]
            tendon, reference = self._combination(element.get("name"), pairs)
        stiffness, damping = (trimmed(given.get(key, "0")) for key in ("stiffness", "damping"))
        limited, acting = self.reader.limited(given), bool(any(stiffness) or any(damping))
        if tendon is None:
            if acting or limited or any(float(given.get(key, 0.0)) for key in ("armature", "frictionloss")):
                self.ignored.append(f"tendon: {called}")
            return
        self.tendons[given.get("name", "")] = tendon, reference
        self.ranges |= {given.get("name", ""): given["range"]} if "range" in given else {}
        self.ignored += [f"{key} of {called}" for key in ("armature", "frictionloss") if float(given.get(key, 0.0))]
        self.ignored += [f"{key} of {called}" for key in ("springyield", "actuatorfrcrange") if key in given]
        if limited and self.reader.limits:
            low, high = numbers(given.get("range", ""), 2, f"range of {called}").tolist()
            self.model.bound(tendon, low, high)
        elif limited:
            self.ignored.append(f"limits of {called}")
        if not acting:
            return
        rest = [float(x) for x in given.get("springlength", "-1").split()]
        if rest == [-1.0] or rest == [-1.0, -1.0]:
            rest = [self._unstressed(tendon)]
        plain = len(stiffness) == len(damping) == len(rest) == 1
        if isinstance(tendon, SitePath) and tendon.weights == (1.0,) and plain and rest[0] >= 0.0:
            (a, at_a), (b, at_b) = tendon.points
            ends = a, a.point(*at_a), b, b.point(*at_b)
            if a is not b:
                name = tendon.joint
                self.model.spring(*ends, stiffness=stiffness[0], damping=damping[0], length=rest[0], name=name)
            return
        tendon.pull(self.model, SpringTension(stiffness, damping, rest[0], rest[-1]), tendon.joint)

    def _combination(self, name: str | None, pairs: list[Any]) -> tuple[Tendon | None, float]:
        """Return a tendon of kind "fixed", and its reference length; None if one of its joints has no coordinate."""
        if not pairs or not all(joint is not None and is_single(joint) for joint, _ in pairs):
            return None, 0.0
        parts = tuple((self.model.joint_coordinate(joint.joint), factor) for joint, factor in pairs)
        reference = sum(factor * self._reference(joint) for joint, factor in pairs)
        constant = sum(factor * (self._reference(joint) + joint.displacement) for joint, factor in pairs)
        kind = "angle" if all(each.which == "angle" for each, _ in parts) else "displacement"
        head = self.reader.free(name, f"tendon of {pairs[0][0].name}"), kind, parts[0][0].a, parts[0][0].b
        return Tendon(*head, parts, tuple(joint.joint for joint, _ in pairs), constant), reference

    def _path(self, element: Element) -> tuple[SitePath | None, float]:
        """Return a tendon of kind "spatial", and its length in the reference pose; None if it winds about geoms."""
        if any(each.tag not in ("site", "pulley") for each in element):
            return None, 0.0
        points: list[tuple[Body, Array]] = []
        places: list[tuple[Part | None, Array]] = []
        weights: list[float] = []
        weight = 1.0
        for each in element:
            if each.tag == "pulley":
                weight, weights[-1:] = 1.0 / float(each.get("divisor", 1.0)), [0.0]
                continue
            part, at = self.reader.site(each.get("site", ""))
            body = self._of(part)
            points.append((body, body.local_point(start_point(part, at))))
            places.append((part, at))
            weights.append(weight)
        weights = weights[:-1]
        name = self.reader.free(element.get("name"), f"spring of {points[0][0].name} and {points[-1][0].name}")
        self.carriers[name], reference = places, _length(weights, [at for _, at in places])
        ends = points[0][0].number, points[-1][0].number
        return SitePath(name, "displacement", *ends, tuple(points), tuple(weights)), reference

    def _unstressed(self, tendon: Tendon | SitePath) -> float:
        """Return the length that a tendon has when each of its joints is at its springref."""
        if isinstance(tendon, Tendon):
            rests = [self._unit(each) * float(each.attributes.get("springref", 0.0)) for each in self._joints(tendon)]
            return float(sum(factor * rest for (_, factor), rest in zip(tendon.parts, rests, strict=True)))
        joints, parts = self.reader.ordered, self.reader.parts
        starts = [(each.position, each.rate) for each in joints]
        for each in joints:
            rest = self._unit(each) * float(each.attributes.get("springref", 0.0)) - self._reference(each)
            each.position, each.rate = rest if each.kind in ("hinge", "slide") else None, None
        for part in parts:
            place(part)
        points = [start_point(*each) for each in self.carriers[tendon.joint]]
        for each, (position, rate) in zip(joints, starts, strict=True):
            each.position, each.rate = position, rate
        for part in parts:
            place(part)
        return _length(tendon.weights, points)

    def _joints(self, tendon: Tendon) -> list[FileJoint]:
        own = {id(each.joint): each for each in self.reader.ordered}
        return [own[id(each)] for each in tendon.joints]

    def _reference(self, joint: FileJoint) -> float:
        """Return qpos of a hinge or slide in the reference pose."""
        return self._unit(joint) * float(joint.attributes.get("ref", 0.0))

    def _passive(self, element: Element) -> None:
        """Add the armature and damping of an actuator, which also act without commands."""
        given = self.reader.attributes(element, "main")
        inertia, damping = float(given.get("armature", 0.0)), trimmed(given.get("damping", "0"))
        if not inertia and not any(damping):
            return
        gear, joint = _gear(given), self._joint_of(given)
        target, called = self._target(given, 1.0), f"actuator: {name_of(element)}"
        if inertia and joint is not None and is_single(joint):
            name = self.reader.free(None, f"armature at {joint.name}")
            self.model.rotor(joint.joint, inertia * gear * gear, name=name)
        elif inertia:
            self.ignored.append(f"armature of {called}")
        if any(damping) and "damping" not in self.reader.without:
            if target is None:
                self.ignored.append(f"damping of {called}")
            else:
                name = self.reader.free(None, f"damper of {target.joint}")
                target.pull(self.model, SpringTension((), [gear * gear * x for x in damping], 0.0, 0.0), name)

    def _actuator(self, element: Element, number: int) -> None:
        """Add an actuator as a motor and a spring in a joint, a tension, or a force at a site."""
        name = element.get("name", f"actuator {number}")
        called = f"actuator: {name_of(element)}"
        command = self.commands.get(name, 0.0)
        given = self.reader.attributes(element, "main")
        if "actuation" in self.reader.disabled or given.get("group", "0") in self.reader.groups_without_force:
            return
        if element.tag not in SUPPORTED:
            self.ignored.append(called)
            return
        gain, bias = (np.array([float(x) for x in given[key].split()]) for key in ("gainprm", "biasprm"))
        bias *= given["biastype"] == "affine"
        gain[1:] *= given["gaintype"] == "affine"
        gear = np.append([float(x) for x in given.get("gear", "1").split()], np.zeros(6))[:6]
        target = self._target(given, float(gear[0]))
        supported = given["gaintype"] in ("fixed", "affine") and given["biastype"] in ("none", "affine")
        joint = self._joint_of(given)
        vector = joint is not None and joint.kind in ("ball", "free")  # gear has several components
        vector |= "site" in given and "refsite" not in given
        if not supported or not (target or (vector and not gain[1:].any() and not bias[1:].any())):
            self.ignored.append(called)
            return
        self.ignored += [f"{key} of {called}" for key in ("delay", "ffrange", "velrange", "actearly") if key in given]
        filtered = given["dyntype"] != "none"
        if filtered and (callable(command) or given["dyntype"] not in FILTERS):
            self.ignored.append(f"the command of {called}, whose activation is {given['dyntype']}")
            command, filtered = self.activations.get(name, 0.0), False
        elif not callable(command):
            command = check_finite(f"commands[{name!r}]", command)
        if bias[2] > 0.0 and gain[0] == -bias[1]:  # a damping ratio
            mass = 0.0
            if isinstance(target, Tendon) and gear[0]:
                mass = self._inertia(self._joints(target), [factor for _, factor in target.parts])
            else:
                self.ignored.append(f"the damping ratio of {called}")
            bias[2] *= -2.0 * np.sqrt(max(gain[0], 0.0) * mass)
        if (span := self._range(given, "ctrl", joint)) and "clampctrl" not in self.reader.disabled:
            command = partial(_limited, command, *span) if callable(command) else float(np.clip(command, *span))
        if filtered:
            constant = None if given["dyntype"] == "integrator" else float(given.get("dynprm", "1").split()[0])
            command = activated(command, self.activations.get(name, 0.0), constant, self._range(given, "act", joint))
        limits = self._range(given, "force", None)
        if joint is None:
            bounded_joints = [each for each in self.reader.ordered if self._has_limited_force(each)]
            moved = [each.name for each in bounded_joints if self._may_act_on(each, given)]
            self.ignored += [f"actuatorfrcrange of joint {each!r}" for each in moved]
        if joint is not None and (own := self._limits_of_force(joint, float(gear[0]))):
            limits = own if limits is None else (max(own[0], limits[0]), min(own[1], limits[1]))
        own_name = self.reader.free(name, f"actuator {number} of the file")
        law = partial(_tension, command, tuple(gain), tuple(bias), limits)
        if target is None:
            self._push(given, joint, gear, law, own_name)
            return
        k, c = -gear[0] * gear[0] * bias[1:]
        if joint is None or limits is not None or gain[1:].any() or min(k, c) < 0.0:
            target.pull(self.model, law, own_name)
            return
        zero = self._reference(joint) + joint.displacement  # qpos at the start
        servo = k > 0.0 and gain[0] == -bias[1] and not bias[0] and not callable(command)
        if servo:  # the command is the position at which the spring has no force
            self._law(joint, k, c, command / gear[0] - zero, own_name)
            return
        if k or c:
            self._law(joint, k, c, -zero, self.reader.free(None, f"gains of {own_name}"))
        factor, constant = gear[0] * gain[0], gear[0] * bias[0]
        torque = partial(_commanded, command, factor, constant) if callable(command) else factor * command + constant
        self.model.motor(joint.joint, torque, name=own_name)

    def _target(self, given: dict[str, str], gear: float) -> Tendon | SitePath | None:
        """Return the joint or tendon on which an actuator acts, as a tendon with the actuator's length and rate."""
        if "tendon" in given:
            tendon, _ = self.tendons.get(given["tendon"], (None, 0.0))
            if isinstance(tendon, SitePath):
                return replace(tendon, weights=tuple(gear * x for x in tendon.weights))
        else:
            tendon, _ = self._combination(None, [(self._joint_of(given), 1.0)])
        if tendon is None:
            return None
        parts = tuple((each, gear * x) for each, x in tendon.parts)
        return replace(tendon, parts=parts, constant=gear * tendon.constant)

    def _joint_of(self, given: dict[str, str]) -> FileJoint | None:
        return self.reader.joints.get(given.get("joint", given.get("jointinparent", "")))

    def _range(self, given: dict[str, str], what: str, joint: FileJoint | None) -> tuple[float, float] | None:
        """Return the limits of the force, the command (ctrl) or the activation (act) of an actuator, or None."""
        inherited, first = float(given.get("inheritrange", 0.0)), given["gainprm"].split()[0]
        servo = given["gaintype"] == "fixed" and given["biastype"] == "affine"
        servo &= float(first) == -float(given["biasprm"].split()[1])
        if servo and inherited and what == ("act" if given["dyntype"] == "integrator" else "ctrl"):
            unit = 1.0 if joint is None else self._unit(joint)
            span = self.ranges.get(given.get("tendon", "")) if joint is None else joint.attributes.get("range")
            if span is not None:
                low, high = unit * numbers(span, 2, "range that an actuator inherits")
                return 0.5 * (low + high - inherited * (high - low)), 0.5 * (low + high + inherited * (high - low))
        if not self.reader.limited(given, f"{what}limited", f"{what}range"):
            return None
        low, high = numbers(given.get(f"{what}range", ""), 2, f"{what}range of an actuator")
        return float(low), float(high)

    def _limits_of_force(self, joint: FileJoint, gear: float) -> tuple[float, float] | None:
        """Return the limits that a joint sets for the force of its only actuator, or None."""
        if not gear or not self._has_limited_force(joint):
            return None
        elements = [each for group in self.reader.root.findall("actuator") for each in group]
        if sum(self._may_act_on(joint, self.reader.attributes(each, "main")) for each in elements) > 1:  # of a sum
            self.ignored.append(f"actuatorfrcrange of joint {joint.name!r}")
            return None
        ends = numbers(joint.attributes["actuatorfrcrange"], 2, f"actuatorfrcrange of joint {joint.name!r}") / gear
        return float(ends.min()), float(ends.max())

    def _has_limited_force(self, joint: FileJoint) -> bool:
        return bool(self.reader.limited(joint.attributes, "actuatorfrclimited", "actuatorfrcrange"))

    def _may_act_on(self, joint: FileJoint, given: dict[str, str]) -> bool:
        """Return True if an actuator acts on a joint, directly, by a tendon, or at a site somewhere."""
        if "tendon" in given:
            tendon, _ = self.tendons.get(given["tendon"], (None, 0.0))
            return joint.joint in getattr(tendon, "joints", (joint.joint,))
        return self._joint_of(given) in (joint, None)

    def _push(self, given: dict[str, str], joint: FileJoint | None, gear: Array, law: Tension, name: str) -> None:
        """Add an actuator whose force and torque have fixed components: at a site, at a ball, or at a free joint.

        Components refer to the axes of the site; of the body or its parent for torques of joints; of space for forces.
        """
        ends: list[tuple[Part, float]] = []
        if joint is None:
            part, pose = self.reader.frame(f"site {given['site']}")
            force_axes = torque_axes = part, start_pose(part, pose).R
            at = start_pose(part, pose).x
        else:
            part = next(each for each in self.reader.parts if joint in each.freed)
            force_axes = torque_axes = None, np.eye(3)
            at = start_pose(part, part.pose).x
            if "jointinparent" not in given:
                torque_axes = part, start_pose(part, part.pose).R
            elif joint.kind == "ball":
                torque_axes = part.parent, start_pose(part.parent, part.pose).R
            if joint.kind == "ball":
                gear = np.append(np.zeros(3), gear[:3])
                ends += [] if part.parent is None else [(part.parent, -1.0)]
        ends += [] if part is None else [(part, 1.0)]
        axes_of = (force_axes, gear[:3]), (torque_axes, gear[3:])
        for which, ((carrier, R), components) in enumerate(axes_of):
            axes, own = self._of(carrier), name if which == 0 else f"torque of {name}"
            for end, sign in ends if components.any() else ():
                body, along = self._of(end), tuple(axes.local_direction(sign * R @ components).tolist())
                push, places = (
                    (self.model.torque, ()) if which else (self.model.force, (body.point(*body.local_point(at)),))
                )
                called = own if which == 0 else self.reader.free(None, own if sign > 0.0 else f"reaction to {name}")
                push(body, *places, partial(_site_force, axes, along, law), name=called)


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


# the arguments t, q and v of the functions below may be numbers or symbols


def _commanded(command: Callable[[Any], Any], factor: float, constant: float, t: Any) -> Any:
    """Return the force of an actuator with a command that is a function of time."""
    return factor * command(t) + constant


def _limited(command: Callable[[Any], Any], low: float, high: float, t: Any) -> Any:
    """Return a command that is a function of time, within its range."""
    return bounded(command(t), low, high)


def activated(command: float, start: float, constant: float | None, span: tuple[float, float] | None) -> Any:
    """Return the activation x of a constant command u from t = 0: T x' = u - x, or x' = u without a time constant T.

    If x is constant, return a number.
    """
    if command == (0.0 if constant is None else start):
        return start
    if constant is not None and constant <= IMMEDIATE:
        return command
    activation = partial(_activation, command, start, constant)
    return activation if span is None else partial(_limited, activation, *span)


def _activation(command: float, start: float, constant: float | None, t: Any) -> Any:
    """Return an activation that is a function of time."""
    if constant is None:
        return start + command * t
    return command + (start - command) * np.exp(-t / constant)


def _tension(
    command: Any, gain: Sequence[float], bias: Sequence[float], limits: Any, t: Any, length: Any, rate: Any
) -> Any:
    """Return the negative force of an actuator whose gain and bias are linear in its length and rate."""
    factor, constant = (c[0] + c[1] * length + c[2] * rate for c in (gain, bias))
    force = factor * (command(t) if callable(command) else command) + constant
    return -force if limits is None else -bounded(force, *limits)


def _site_force(body: Body, components: tuple[float, ...], law: Tension, t: Any, q: Any, v: Any) -> Any:
    """Return, in space, the force of an actuator without a length, which has constant components in a body's axes."""
    size = -law(t, 0.0, 0.0)
    return [size * x for x in vector_of(q, body.number, components)]


def is_single(joint: FileJoint) -> bool:
    """Return True if a hinge or slide of the file is a separate joint in the model."""
    return joint.joint is not None and joint.joint.kind in ("revolute", "prismatic")


def activation_of(element: Element, law: Mapping[str, str]) -> str:
    """Return the kind of activation of an actuator, or "other" if it may have several activations."""
    if element.tag not in (*SUPPORTED, "adhesion"):
        return "muscle" if element.tag == "muscle" else "other"
    return law["dyntype"]


def _gear(given: Mapping[str, str]) -> float:
    """Return the gear ratio of an actuator that acts on a joint or tendon."""
    return float(given.get("gear", "1").split()[0])


def trimmed(text: str) -> list[float]:
    """Return the coefficients of a polynomial without zeros at the end; the first coefficient always remains."""
    values = [float(x) for x in text.split()] or [0.0]
    while len(values) > 1 and not values[-1]:
        values.pop()
    return values


def _length(weights: Any, points: list[Array]) -> float:
    """Return the length of a path through points of space."""
    parts = zip(weights, points, points[1:], strict=False)
    return sum(weight * float(np.linalg.norm(x - y)) for weight, x, y in parts)
