"""Write a model as MJCF: a tree of bodies and joints, equalities that close loops, springs and tendons."""

from __future__ import annotations

import os
import warnings
import xml.etree.ElementTree as ElementTree
from typing import Any
from xml.etree.ElementTree import Element, SubElement

import numpy as np

from twoloop.bodies.file_parts import IgnoredWarning, text_of
from twoloop.bodies.parameter_layout import AXIAL_SPRING, SPRING, TORSION_SPRING, ZERO_LENGTH_SPRING
from twoloop.bodies.parts import Body, Force, ModelJoint
from twoloop.bodies.rotation import euler_parameters
from twoloop.checks.arguments import check_path

# kinds of joints in the order in which they enter the tree: first the kinds that cannot close a loop
TREE = ("prismatic", "cylindrical", "universal", "planar", "revolute", "fixed", "spherical")
LOOP = ("spherical", "revolute", "fixed")


def spanning_tree(model: Any) -> tuple[dict[int, tuple[Body, ModelJoint]], list[ModelJoint]]:
    """Return the parent and joint of each body, by its number, and the joints that close loops."""
    joints = [each for each in model.joints if each.kind != "drive"]
    unsupported = [each for each in joints if each.kind not in TREE]
    if unsupported:
        raise ValueError(f"MJCF has no counterpart of {unsupported[0].name!r}, which is {unsupported[0].kind}")
    linked = {each.number: {each.number} for each in (model.ground, *model.bodies)}
    edges: list[ModelJoint] = []
    loops: list[ModelJoint] = []
    # within each kind, joints to the ground come first: loops are then cut between moving bodies, and branches shorter
    for joint in sorted(joints, key=lambda each: (TREE.index(each.kind), model.ground not in (each.a, each.b))):
        group_a, group_b = linked[joint.a.number], linked[joint.b.number]
        if group_a is group_b:
            loops.append(joint)
            continue
        edges.append(joint)
        group_a |= group_b
        linked |= dict.fromkeys(group_b, group_a)
    unsupported = [each for each in loops if each.kind not in LOOP]
    if unsupported:
        raise ValueError(
            f"{unsupported[0].name!r} closes a loop, which in MJCF {' and '.join(LOOP)} joints can; it is "
            f"{unsupported[0].kind}"
        )
    parents: dict[int, tuple[Body, ModelJoint]] = {}
    roots: list[Body] = [model.ground, *model.bodies]
    reached: set[int] = set()
    for root in roots:
        stack = [] if root.number in reached else [root]
        while stack:
            body = stack.pop()
            reached.add(body.number)
            for joint in edges:
                child = joint.b if joint.a is body else joint.a if joint.b is body else None
                if child is not None and child.number not in reached:
                    parents[child.number] = body, joint
                    stack.append(child)
    return parents, loops


HALF = 0.5  # m: distance of the two connect points that represent a hinge closing a loop


def write(model: Any, path: str | os.PathLike[str]) -> None:
    """Write a SpatialModel; see its `to_mjcf`."""
    path = check_path(path)
    writer = _Writer(model)
    root = writer.root()
    ElementTree.indent(root)
    ElementTree.ElementTree(root).write(path, encoding="utf-8", xml_declaration=False)
    if writer.left_out:
        warnings.warn(f"{os.fspath(path)!r} is without {'; '.join(writer.left_out)}", IgnoredWarning, stacklevel=3)


class _Writer:
    def __init__(self, model: Any):
        self.model = model
        rates = {body.name: (body.velocity, body.angular_velocity) for body in model.bodies}
        moving = [name for name, given in rates.items() if any(rate is not None and rate.any() for rate in given)]
        self.left_out = [f"the start velocity of {name!r}" for name in moving]
        self.left_out += [each.name for each in model.joints if each.kind == "drive"]
        self.left_out += [each.name for each in model.stops]
        if massless := [body.name for body in model.bodies if not body.inertia.any()]:
            raise ValueError(f"MJCF has no massless body with joints, such as {massless[0]!r}: give it a small mass")
        self.springs: dict[tuple[str, str], Force] = {}  # by joint, and "hinge" or "slide"
        self.tendons: list[Force] = []
        for force in model.forces:
            if force.function is not None:
                self.left_out.append(force.name)
            elif force.kind in (TORSION_SPRING, AXIAL_SPRING):
                assert force.joint is not None
                key = force.joint.name, "hinge" if force.kind == TORSION_SPRING else "slide"
                if key in self.springs:
                    raise ValueError(
                        f"MJCF has one spring in a joint; {force.name!r} is the second of {force.joint.name!r}"
                    )
                self.springs[key] = force
            elif force.kind in (SPRING, ZERO_LENGTH_SPRING):
                self.tendons.append(force)
            else:
                self.left_out.append(force.name)
        self.parents, self.loops = spanning_tree(model)

    def root(self) -> Element:
        """Return the root element of the whole file."""
        root = Element("mujoco", model=self.model.name)
        _add(root, "compiler", angle="radian", autolimits="true")
        _add(root, "option", gravity=text_of(self.model.gravity))
        world = _add(root, "worldbody")
        elements: dict[int, Element] = {self.model.ground.number: world}
        waiting = list(self.model.bodies)
        while waiting:
            body = waiting.pop(0)
            parent, joint = self.parents.get(body.number, (self.model.ground, None))
            if parent.number not in elements:
                waiting.append(body)
                continue
            elements[body.number] = self._body(elements[parent.number], parent, body, joint)
        self._tendons(root, elements)
        if self.loops:
            equality = _add(root, "equality")
            for joint in self.loops:
                self._loop(equality, joint)
        return root

    def _body(self, inside: Element, parent: Body, body: Body, joint: ModelJoint | None) -> Element:
        R = parent.rotation.T @ body.rotation
        pose = {"pos": text_of(parent.local_point(body.position)), "quat": text_of(euler_parameters(R))}
        element = _add(inside, "body", name=body.name, **pose)
        mass, xx, yy, zz, xy, xz, yz = body.inertia.tolist()
        moments = {"fullinertia": text_of([xx, yy, zz, xy, xz, yz])}
        _add(element, "inertial", pos="0 0 0", mass=repr(mass), **moments)
        if joint is None:
            _add(element, "freejoint")
        else:
            self._joint(element, body, joint)
        return element

    def _joint(self, element: Element, body: Body, joint: ModelJoint) -> None:
        forward = joint.b is body
        pos = text_of((joint.point_b if forward else joint.point_a).values)
        if joint.kind == "spherical":
            _add(element, "joint", type="ball", name=joint.name, pos=pos)
            return
        moves: list[tuple[str, Any]] = []
        if joint.kind == "universal":
            ends = zip((joint.a, joint.b), joint.axes, strict=True)
            axes = [body.local_direction(end.rotation @ axis) for end, axis in ends]
            moves = [("hinge", axis) for axis in (axes if forward else axes[::-1])]
        elif joint.kind != "fixed":
            axis = joint.axes[1 if forward else 0] * (1.0 if forward else -1.0)
            moves += [("slide", axis)] if joint.kind in ("prismatic", "cylindrical") else []
            moves += [("slide", across) for across in np.linalg.svd(axis[None])[2][1:] if joint.kind == "planar"]
            moves += [("hinge", axis)] if joint.kind != "prismatic" else []
        for number, (kind, axis) in enumerate(moves, 1):
            name = joint.name if number == 1 else f"{joint.name} {number}"
            _add(element, "joint", type=kind, axis=text_of(axis), name=name, pos=pos, **self._stiffness(joint, kind))

    def _stiffness(self, joint: ModelJoint, kind: str) -> dict[str, str]:
        force = self.springs.get((joint.name, kind))
        if force is None or force.more is None:
            return {}
        stiffness, damping, rest = map(repr, force.more.values)
        return {"stiffness": stiffness, "damping": damping, "springref": rest}

    def _loop(self, equality: Element, joint: ModelJoint) -> None:
        springs = [force.name for (name, _), force in self.springs.items() if name == joint.name]
        if springs:
            raise ValueError(f"the spring {springs[0]!r} is in a joint that closes a loop: MJCF has none there")
        body_1, body_2 = (joint.b, joint.a) if joint.a is self.model.ground else (joint.a, joint.b)
        ends = {"body1": body_1.name, **({} if body_2 is self.model.ground else {"body2": body_2.name})}
        point = np.array((joint.point_a if body_1 is joint.a else joint.point_b).values)
        if joint.kind == "fixed":
            _add(equality, "weld", name=joint.name, **ends)
            return
        if joint.kind == "spherical":
            _add(equality, "connect", name=joint.name, anchor=text_of(point), **ends)
            return
        axis = joint.axes[0 if body_1 is joint.a else 1]
        for number, side in enumerate((-HALF, HALF)):
            name = joint.name if number == 0 else f"{joint.name} 2"
            _add(equality, "connect", name=name, anchor=text_of(point + side * axis), **ends)

    def _tendons(self, root: Element, elements: dict[int, Element]) -> None:
        if not self.tendons:
            return
        tendons = _add(root, "tendon")
        for force in self.tendons:
            assert force.on_first is not None and force.on_second is not None and force.more is not None
            ends = {force.first: force.on_first, force.second: force.on_second}
            for body, point in ends.items():
                _add(elements[body.number], "site", name=f"{force.name} on {body.name}", pos=text_of(point.values))
            stiffness, damping, length = force.more.values if force.kind == SPRING else (*force.more.values, 0.0, 0.0)
            values = {"stiffness": repr(stiffness), "damping": repr(damping), "springlength": repr(length)}
            spatial = _add(tendons, "spatial", name=force.name, **values)
            for body in ends:
                _add(spatial, "site", site=f"{force.name} on {body.name}")


def _add(inside: Element, tag: str, **attributes: str) -> Element:
    return SubElement(inside, tag, attributes)
