"""Writes a model as MJCF: a tree of bodies and joints, equalities that close loops, springs and tendons."""

from __future__ import annotations

import os
import warnings
import xml.etree.ElementTree as ElementTree
from typing import Any
from xml.etree.ElementTree import Element, SubElement

import numpy as np
from numpy.typing import ArrayLike

from twoloop.bodies.mjcf_geometry import IgnoredWarning
from twoloop.bodies.parameter_layout import PULL, RAIL, SPRING, TORSION
from twoloop.bodies.parts import Body, Force, ModelJoint
from twoloop.bodies.rotation import euler_parameters
from twoloop.bodies.spanning_tree import spanning_tree
from twoloop.checks.arguments import check_path

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
        self.left_out = [f"the start velocity of {each.name!r}" for each in model.bodies if _moves(each)]
        self.left_out += [each.name for each in model.joints if each.kind == "drive"]
        self.left_out += [each.name for each in model.stops]
        self.springs: dict[str, Force] = {}
        self.tendons: list[Force] = []
        for force in model.forces:
            if force.function is not None:
                self.left_out.append(force.name)
            elif force.kind in (TORSION, RAIL):
                assert force.joint is not None
                if force.joint.name in self.springs:
                    raise ValueError(
                        f"MJCF has one spring in a joint; {force.name!r} is the second of {force.joint.name!r}"
                    )
                self.springs[force.joint.name] = force
            elif force.kind in (SPRING, PULL):
                self.tendons.append(force)
            else:
                self.left_out.append(force.name)
        self.parents, self.loops = spanning_tree(model)

    def root(self) -> Element:
        """Return the root element of the whole file."""
        root = Element("mujoco", model=self.model.name)
        _add(root, "compiler", angle="radian", autolimits="true")
        _add(root, "option", gravity=_text(self.model.gravity))
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
        pose = {"pos": _text(parent.local_point(body.position)), "quat": _text(euler_parameters(R))}
        made = _add(inside, "body", name=body.name, **pose)
        mass, xx, yy, zz, xy, xz, yz = body.inertia.tolist()
        moments = {"fullinertia": _text([xx, yy, zz, xy, xz, yz])}
        _add(made, "inertial", pos="0 0 0", mass=repr(mass), **moments)
        if joint is None:
            _add(made, "freejoint")
        else:
            self._joint(made, body, joint)
        return made

    def _joint(self, made: Element, body: Body, joint: ModelJoint) -> None:
        forward = joint.b is body
        own = np.array((joint.point_b if forward else joint.point_a).values)
        known = {"name": joint.name, "pos": _text(own)}
        if joint.kind == "spherical":
            _add(made, "joint", type="ball", **known)
            return
        if joint.kind == "fixed":
            return
        if joint.kind == "universal":
            axes = [
                body.local_direction(end.rotation @ axis)
                for end, axis in zip((joint.a, joint.b), joint.axes, strict=True)
            ]
            first, second = axes if forward else axes[::-1]
            _add(made, "joint", type="hinge", axis=_text(first), **known)
            _add(made, "joint", type="hinge", axis=_text(second), **{**known, "name": f"{joint.name} 2"})
            return
        axis = joint.axes[1 if forward else 0] * (1.0 if forward else -1.0)
        if joint.kind in ("prismatic", "cylindrical"):
            spring = self._stiffness(joint)
            _add(made, "joint", type="slide", axis=_text(axis), **known, **spring)
            known["name"] = f"{joint.name} 2"
        if joint.kind == "planar":
            for number, across in enumerate(np.linalg.svd(axis[None])[2][1:]):
                name = joint.name if number == 0 else f"{joint.name} 2"
                _add(made, "joint", type="slide", axis=_text(across), **{**known, "name": name})
            known["name"] = f"{joint.name} 3"
        if joint.kind != "prismatic":
            _add(made, "joint", type="hinge", axis=_text(axis), **known, **self._stiffness(joint))

    def _stiffness(self, joint: ModelJoint) -> dict[str, str]:
        force = self.springs.get(joint.name)
        if force is None or force.more is None:
            return {}
        stiffness, damping, rest = map(repr, force.more.values)
        return {"stiffness": stiffness, "damping": damping, "springref": rest}

    def _loop(self, equality: Element, joint: ModelJoint) -> None:
        if joint.name in self.springs:
            raise ValueError(
                f"the spring {self.springs[joint.name].name!r} is in a joint that closes a loop: MJCF has none there"
            )
        one, other = (joint.b, joint.a) if joint.a is self.model.ground else (joint.a, joint.b)
        ends = {"body1": one.name, **({} if other is self.model.ground else {"body2": other.name})}
        place = np.array((joint.point_a if one is joint.a else joint.point_b).values)
        if joint.kind == "fixed":
            _add(equality, "weld", name=joint.name, **ends)
            return
        if joint.kind == "spherical":
            _add(equality, "connect", name=joint.name, anchor=_text(place), **ends)
            return
        axis = joint.axes[0 if one is joint.a else 1]
        for number, side in enumerate((-HALF, HALF)):
            name = joint.name if number == 0 else f"{joint.name} 2"
            _add(equality, "connect", name=name, anchor=_text(place + side * axis), **ends)

    def _tendons(self, root: Element, elements: dict[int, Element]) -> None:
        if not self.tendons:
            return
        tendons = _add(root, "tendon")
        for force in self.tendons:
            assert force.on_first is not None and force.on_second is not None and force.more is not None
            ends = {force.first: force.on_first, force.second: force.on_second}
            for body, point in ends.items():
                _add(elements[body.number], "site", name=f"{force.name} on {body.name}", pos=_text(point.values))
            stiffness, damping, length = force.more.values if force.kind == SPRING else (*force.more.values, 0.0, 0.0)
            values = {"stiffness": repr(stiffness), "damping": repr(damping), "springlength": repr(length)}
            spatial = _add(tendons, "spatial", name=force.name, **values)
            for body in ends:
                _add(spatial, "site", site=f"{force.name} on {body.name}")


def _moves(body: Body) -> bool:
    return any(each is not None and each.any() for each in (body.velocity, body.angular_velocity))


def _text(values: ArrayLike) -> str:
    return " ".join(map(repr, np.asarray(values, dtype=float).tolist()))


def _add(inside: Element, tag: str, **attributes: str) -> Element:
    return SubElement(inside, tag, attributes)
