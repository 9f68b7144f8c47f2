"""Parse poses, masses and joints of MJCF and URDF files, and warn about what is ignored.

See MuJoCo's XML reference, mujoco.readthedocs.io/en/stable/XMLreference.html.
"""

from __future__ import annotations

import os
import warnings
import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any
from xml.etree.ElementTree import Element

import numpy as np

from twoloop.bodies.parts import Body, ModelJoint
from twoloop.bodies.rotation import rotation_matrix
from twoloop.checks.arguments import Array, check_path

DENSITY = 1000.0  # kg/m^3, default of MuJoCo for geoms with neither mass nor density


class IgnoredWarning(UserWarning):
    """Warns that parts of a file have no counterpart in a model, or parts of a model none in a file.

    Examples
    --------
    >>> import warnings
    >>> from twoloop.bodies import IgnoredWarning
    >>> warnings.simplefilter("error", IgnoredWarning)  # parts of a file that are left out raise
    >>> warnings.resetwarnings()
    """


@dataclass(frozen=True)
class Pose:
    """Position (3,) of the origin and rotation matrix (3, 3) of a frame, relative to another."""

    x: Array
    R: Array

    def then(self, inner: Pose) -> Pose:
        """Return the pose, in the outer frame, of a frame given relative to this one."""
        return Pose(self.x + self.R @ inner.x, self.R @ inner.R)

    def point(self, place: Array) -> Array:
        """Return a point of this frame in the outer one."""
        return np.asarray(self.x + self.R @ place)


@dataclass(frozen=True)
class Lump:
    """A mass with its centre (3,) and its inertia about that centre (3, 3), in one frame."""

    mass: float
    centre: Array
    J: Array

    def transformed(self, pose: Pose) -> Lump:
        """Return the same mass in the frame in which `pose` is given."""
        return Lump(self.mass, pose.point(self.centre), pose.R @ self.J @ pose.R.T)


def combined(lumps: list[Lump]) -> Lump:
    """Return the combination of several masses; without mass at the origin."""
    mass = sum(lump.mass for lump in lumps)
    if not mass > 0.0:
        return Lump(0.0, np.zeros(3), np.zeros((3, 3)))
    centre = sum((lump.mass * lump.centre for lump in lumps), np.zeros(3)) / mass
    J = np.zeros((3, 3))
    for lump in lumps:
        d = lump.centre - centre
        J += lump.J + lump.mass * (d @ d * np.eye(3) - np.outer(d, d))
    return Lump(mass, centre, J)


def root_of(path: str | os.PathLike[str], tag: str) -> Element:
    """Return the root element of an XML file, which must have this tag."""
    try:
        root = ElementTree.parse(check_path(path)).getroot()
    except ElementTree.ParseError as error:
        raise ValueError(f"{os.fspath(path)!r} is not XML: {error}") from None
    if root.tag != tag:
        raise ValueError(f"{os.fspath(path)!r} must begin with <{tag}>; it begins with <{root.tag}>")
    return root


def record_ignored(path: str | os.PathLike[str], model: Any, ignored: list[str]) -> None:
    """Record in the model what was ignored in its file, and warn the caller of the caller."""
    model.ignored = tuple(ignored)
    if ignored:
        warnings.warn(f"{os.fspath(path)!r}: ignored are {'; '.join(ignored)}", IgnoredWarning, stacklevel=3)


def numbers(text: str, n: int, what: str) -> Array:
    """Parse the n numbers of an attribute."""
    try:
        values = np.array([float(each) for each in text.split()])
    except ValueError:
        values = np.zeros(0)
    if len(values) != n or not np.isfinite(values).all():
        raise ValueError(f"{what} must be {n} finite numbers; given {text!r}")
    return values


def text_of(values: Any) -> str:
    """Format numbers so that they are read back exactly."""
    return " ".join(map(repr, np.asarray(values, dtype=float).tolist()))


def tensor_of(xx: float, yy: float, zz: float, xy: float, xz: float, yz: float) -> Array:
    """Return an inertia tensor (3, 3) from its entries."""
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


def pose_of(attributes: Mapping[str, str], what: str, degrees: bool, sequence: str) -> Pose:
    """Return the pose given by pos and one of quat, axisangle, xyaxes, zaxis and euler."""
    x = numbers(attributes.get("pos", "0 0 0"), 3, f"pos of {what}")
    return Pose(x, _rotation(attributes, what, np.pi / 180.0 if degrees else 1.0, sequence))


def _rotation(given: Mapping[str, str], what: str, unit: float, sequence: str) -> Array:
    if "quat" in given:
        return _of_quaternion(numbers(given["quat"], 4, f"quat of {what}"))
    if "axisangle" in given:
        *axis, angle = numbers(given["axisangle"], 4, f"axisangle of {what}")
        return _about(np.array(axis), unit * angle)
    if "xyaxes" in given:
        first, second = numbers(given["xyaxes"], 6, f"xyaxes of {what}").reshape(2, 3)
        x = first / np.linalg.norm(first)
        y = second - (second @ x) * x
        y /= np.linalg.norm(y)
        return np.column_stack([x, y, np.cross(x, y)])
    if "zaxis" in given:
        z = numbers(given["zaxis"], 3, f"zaxis of {what}")
        across, cosine = np.cross((0.0, 0.0, 1.0), z), z[2] / np.linalg.norm(z)
        if np.linalg.norm(across) < 1e-12 * np.linalg.norm(z):
            return np.eye(3) if cosine > 0.0 else np.diag([1.0, -1.0, -1.0])
        return _about(across, float(np.arccos(np.clip(cosine, -1.0, 1.0))))
    if "euler" in given:
        R = np.eye(3)
        for letter, turn in zip(sequence, numbers(given["euler"], 3, f"euler of {what}"), strict=True):
            part = _about(np.eye(3)["xyz".index(letter.lower())], unit * turn)
            R = R @ part if letter.islower() else part @ R  # lower case: intrinsic rotation
        return R
    return np.eye(3)


def _of_quaternion(quaternion: Array) -> Array:
    return rotation_matrix(quaternion / np.linalg.norm(quaternion))


def _about(axis: Array, angle: float) -> Array:
    direction = axis / np.linalg.norm(axis)
    return _of_quaternion(np.append(np.cos(0.5 * angle), np.sin(0.5 * angle) * direction))


def geom_lump(given: Mapping[str, str], what: str, degrees: bool, sequence: str) -> Lump | None:
    """Return the mass of a geom in the frame of its body; None: its volume is unknown here."""
    kind = given.get("type", "sphere")
    if kind not in _VOLUMES:
        return None
    pose = pose_of(given, what, degrees, sequence)
    size = np.array([float(each) for each in given.get("size", "").split()])
    if "fromto" in given:
        ends = numbers(given["fromto"], 6, f"fromto of {what}").reshape(2, 3)
        along = ends[0] - ends[1]
        pose = Pose(0.5 * ends.sum(axis=0), _rotation({"zaxis": text_of(along)}, what, 1.0, "xyz"))
        half = 0.5 * float(np.linalg.norm(along))
        size = np.append(size[:1], half) if kind in ("capsule", "cylinder") else np.array([size[0], size[0], half])
    needed = {"sphere": 1, "capsule": 2, "cylinder": 2, "box": 3, "ellipsoid": 3}[kind]
    if len(size) < needed or not (size[:needed] > 0.0).all():
        raise ValueError(
            f"size of {what} must be {needed} positive numbers for a {kind}; given {given.get('size', '')!r}"
        )
    volume, moments = _VOLUMES[kind](size)
    mass = float(given["mass"]) if "mass" in given else float(given.get("density", DENSITY)) * volume
    return Lump(mass, np.zeros(3), mass * np.diag(moments)).transformed(pose)


# volume, and moments of inertia about the axes per unit mass


def _ellipsoid(size: Array) -> tuple[float, Array]:
    squares = (size[:3] if len(size) > 2 else np.full(3, size[0])) ** 2
    return 4.0 / 3.0 * np.pi * float(np.sqrt(squares.prod())), (squares.sum() - squares) / 5.0


def _sphere(size: Array) -> tuple[float, Array]:
    return _ellipsoid(np.full(3, size[0]))


def _box(size: Array) -> tuple[float, Array]:
    squares = size[:3] ** 2
    return 8.0 * float(size[:3].prod()), (squares.sum() - squares) / 3.0


def _cylinder(size: Array) -> tuple[float, Array]:
    r, h = size[:2]
    across = r * r / 4.0 + h * h / 3.0
    return 2.0 * np.pi * r * r * h, np.array([across, across, 0.5 * r * r])


def _capsule(size: Array) -> tuple[float, Array]:
    """Return those of a cylinder and two half balls, whose centres of mass are 3/8 of the radius from its ends."""
    r, h = size[:2]
    whole, (across, _, along) = _cylinder(size)
    ball = 4.0 / 3.0 * np.pi * r**3
    caps = 0.4 * r * r + h * h + 0.75 * h * r
    total = whole + ball
    moments = np.array([whole * across + ball * caps] * 2 + [whole * along + ball * 0.4 * r * r]) / total
    return total, moments


_VOLUMES = {"sphere": _sphere, "capsule": _capsule, "cylinder": _cylinder, "box": _box, "ellipsoid": _ellipsoid}


SAME = 1e-9  # tolerance of directions, and of positions in m


@dataclass(frozen=True)
class FileJoint:
    """A joint of MJCF: kind (hinge, slide, ball), position and axis in space, and other attributes."""

    name: str
    kind: str
    at: Array
    axis: Array
    attributes: dict[str, str]


@dataclass
class Part:
    """A moving body with everything fixed to it: parent, frame, joints and masses, all in space."""

    name: str
    parent: Part | None
    pose: Pose
    freed: list[FileJoint] = field(default_factory=list)
    lumps: list[Lump] = field(default_factory=list)
    body: Body | None = None


def body_of(model: Any, part: Part | None) -> Body:
    """Return the body of a part of a SpatialModel; the ground for None."""
    body = model.ground if part is None else part.body
    assert body is not None
    return body


def add_part(model: Any, part: Part) -> ModelJoint | None:
    """Add the body of a part and its joint to a model; return the joint, or None if the body is free."""
    lump = combined(part.lumps)
    if not lump.mass > 0.0:
        raise ValueError(f"the body {part.name!r} has joints but no mass: give it an <inertial>, or a geom with volume")
    R = part.pose.R
    part.body = model.body(part.name, mass=lump.mass, inertia=R.T @ lump.J @ R, position=lump.centre, rotation=R)
    return add_joints(model, body_of(model, part.parent), part.body, part.freed)


def add_joints(model: Any, parent: Body, child: Body, freed: list[FileJoint]) -> ModelJoint | None:
    """Add the joint equivalent to several MJCF joints; return it, or None if the body is free."""
    kinds = sorted(each.kind for each in freed)
    slid = np.array([each.axis for each in freed if each.kind == "slide"])
    if len(slid) > 1 and np.linalg.svd(slid, compute_uv=False)[-1] < SAME:
        raise ValueError(f"the slides of the body {child.name!r} must have axes that do not follow from one another")
    if kinds in (["free"], ["ball", "slide", "slide", "slide"]):
        return None
    hinges, slides = ([each for each in freed if each.kind == kind] for kind in ("hinge", "slide"))
    name, first = freed[0].name, freed[0]
    if kinds == ["ball"]:
        return model.spherical(parent, child, at=first.at, name=name)
    if kinds == ["hinge"]:
        return model.revolute(parent, child, at=first.at, axis=first.axis, name=name)
    if kinds == ["slide"]:
        return model.prismatic(parent, child, at=first.at, axis=first.axis, name=name)
    if kinds == ["hinge", "slide"] and _parallel(hinges[0], slides[0]):
        return model.cylindrical(parent, child, at=hinges[0].at, axis=hinges[0].axis, name=name)
    if kinds == ["hinge", "hinge"] and _across(*hinges) and np.abs(hinges[0].at - hinges[1].at).max() < SAME:
        return model.universal(parent, child, at=first.at, axes=[each.axis for each in hinges], name=name)
    if kinds == ["hinge", "slide", "slide"] and all(_across(hinges[0], slide) for slide in slides):
        return model.planar(parent, child, at=hinges[0].at, axis=hinges[0].axis, name=name)
    raise ValueError(
        f"the joints of the body {child.name!r} ({', '.join(each.kind for each in freed)}) have no counterpart in a "
        "model: one hinge, slide or ball; a slide and a hinge along one axis; two hinges that cross at right angles; "
        "two slides and a hinge across both; all six. Put a body with mass between them"
    )


def _parallel(a: FileJoint, b: FileJoint) -> bool:
    return float(np.abs(np.cross(a.axis, b.axis)).max()) < SAME


def _across(a: FileJoint, b: FileJoint) -> bool:
    return abs(float(a.axis @ b.axis)) < SAME
