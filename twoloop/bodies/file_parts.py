"""Parse poses, masses and joints of MJCF and URDF files, and warn about what is ignored.

See MuJoCo's XML reference, mujoco.readthedocs.io/en/stable/XMLreference.html.
"""

from __future__ import annotations

import os
import re
import warnings
import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
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
        """Return the pose, in the outer frame, of a frame whose pose in this frame is `inner`."""
        return Pose(self.x + self.R @ inner.x, self.R @ inner.R)

    def point(self, place: Array) -> Array:
        """Transform a point from this frame to the outer frame."""
        return np.asarray(self.x + self.R @ place)

    def inverse(self) -> Pose:
        """Return the pose of the outer frame in this frame."""
        return Pose(-self.R.T @ self.x, self.R.T)


@dataclass(frozen=True)
class Lump:
    """A mass with centre (3,), inertia about the centre (3, 3) and principal axes (3, 3), if known, in one frame."""

    mass: float
    centre: Array
    J: Array
    axes: Array | None = None

    def transformed(self, pose: Pose) -> Lump:
        """Transform the mass from the frame with the pose `pose` to the outer frame."""
        axes = None if self.axes is None else pose.R @ self.axes
        return Lump(self.mass, pose.point(self.centre), pose.R @ self.J @ pose.R.T, axes)


def combined(lumps: list[Lump]) -> Lump:
    """Return the combination of several masses; if the total mass is zero, its centre is the origin."""
    mass = sum(lump.mass for lump in lumps)
    if not mass > 0.0:
        return Lump(0.0, np.zeros(3), np.zeros((3, 3)))
    if len(lumps) == 1:
        return lumps[0]
    centre = sum((lump.mass * lump.centre for lump in lumps), np.zeros(3)) / mass
    J = np.zeros((3, 3))
    for lump in lumps:
        d = lump.centre - centre
        J += lump.J + lump.mass * (d @ d * np.eye(3) - np.outer(d, d))
    return Lump(mass, centre, J)


def principal_axes(J: Array, tolerance: float = 1e-15) -> Array:
    """Return the principal axes (3, 3) of a tensor, as columns, by Jacobi's rotations, each of the largest product.

    Products within a tolerance, relative to the largest entry, are left. Where moments are equal, axes are ambiguous,
    but forces of a medium depend on them: as in MuJoCo, the iteration begins with the axes of the body.
    """
    axes, pairs, least = np.eye(3), ((1, 2), (0, 2), (0, 1)), tolerance * float(np.abs(J).max())
    for _ in range(100):
        D = axes.T @ J @ axes
        i, j = pairs[int(np.argmax([abs(D[pair]) for pair in pairs]))]
        if abs(D[i, j]) <= least:
            break
        tau = (D[j, j] - D[i, i]) / (2.0 * D[i, j])
        tangent = (1.0 if tau >= 0.0 else -1.0) / (abs(tau) + np.sqrt(1.0 + tau * tau))
        c = 1.0 / np.sqrt(1.0 + tangent * tangent)
        turn = np.eye(3)
        turn[i, i] = turn[j, j] = c
        turn[i, j], turn[j, i] = tangent * c, -tangent * c
        axes = axes @ turn
    return axes


def root_of(path: str | os.PathLike[str], tag: str) -> Element:
    """Return the root element of an XML file, which must have this tag."""
    root = parsed(check_path(path))
    if root.tag != tag:
        raise ValueError(f"{os.fspath(path)!r} must begin with <{tag}>; it begins with <{root.tag}>")
    return root


def parsed(path: Path) -> Element:
    """Return the root element of an XML file without namespaces, which some exporters declare.

    Many files are XML for the parsers of simulators only: with -- within comments, lines before the declaration,
    prefixes that nothing declares, bare &, or characters of another encoding.
    """
    try:
        root = ElementTree.parse(path).getroot()
    except (ElementTree.ParseError, ValueError, LookupError) as error:  # wrong encodings raise the last two
        text = path.read_bytes().decode(errors="replace").strip("\ufeff")
        text = re.sub(r"<!--.*?-->|<\?.*?\?>", "", text, flags=re.DOTALL).strip()
        text = re.sub(r"&(?!#?\w+;)", "&amp;", text)
        text = re.sub(r"(?<=[<\s/])[A-Za-z_][\w.-]*:(?=[A-Za-z_][\w.-]*[\s=/>])", "", text)
        try:
            root = ElementTree.fromstring(text)
        except ElementTree.ParseError:
            raise ValueError(f"{os.fspath(path)!r} is not XML: {error}") from None
    for each in root.iter():
        if isinstance(each.tag, str):
            each.tag = each.tag.rpartition("}")[2]
    return root


# ignored parts, in the order of their effect on the motion: words that the name of a part contains
EFFECTS = (
    ("the mass of", "for the mass", "armature of", "align of"),
    ("equality", "joints of", "mimic of", "loop_joint", "constraint"),
    ("tendon", "springdamper of", "stiffness", "damping of", "dynamics of", "gravcomp of", "medium"),
    ("actuator", "command", "damping ratio", "deformable", "mocap of"),
    ("frictionloss of", "friction of"),
    ("limits of", "safety_controller of"),
    ("contact",),
)


def by_effect(ignored: list[str]) -> list[str]:
    """Sort names of ignored parts by the effect on the motion; parts with an unknown effect come last."""

    def effect(what: str) -> int:
        known = (k for k, words in enumerate(EFFECTS) if any(word in what for word in words))
        return next(known, len(EFFECTS))

    return sorted(dict.fromkeys(ignored), key=effect)


def record_ignored(path: str | os.PathLike[str], model: Any, ignored: list[str]) -> None:
    """Record in the model which parts of its file were ignored, and warn the user, who called the reader."""
    model.ignored = tuple(by_effect(ignored))
    if ignored:
        warnings.warn(f"{os.fspath(path)!r}: ignored are {'; '.join(model.ignored)}", IgnoredWarning, stacklevel=3)


def name_of(element: Element) -> str:
    """Return the name of an element for messages."""
    return f"{element.tag} {element.get('name')!r}" if element.get("name") else element.tag


def numbers(text: str, n: int, what: str) -> Array:
    """Parse the n numbers of an attribute."""
    try:
        values = np.array([float(each) for each in text.split()])
    except ValueError:
        values = np.zeros(0)
    if len(values) != n or not np.isfinite(values).all():
        raise ValueError(f"{what} must be {f'{n} finite numbers' if n > 1 else 'a finite number'}; given {text!r}")
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
        return about(np.array(axis), unit * angle)
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
        return about(across, float(np.arccos(np.clip(cosine, -1.0, 1.0))))
    if "euler" in given:
        R = np.eye(3)
        for letter, turn in zip(sequence, numbers(given["euler"], 3, f"euler of {what}"), strict=True):
            part = about(np.eye(3)["xyz".index(letter.lower())], unit * turn)
            R = R @ part if letter.islower() else part @ R  # lower case: intrinsic rotation
        return R
    return np.eye(3)


def _of_quaternion(quaternion: Array) -> Array:
    return rotation_matrix(quaternion / np.linalg.norm(quaternion))


def about(axis: Array, angle: float) -> Array:
    """Return the rotation matrix of a turn about an axis."""
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
    shell = given.get("shellinertia", "false") == "true" and kind in _SURFACES
    volume, moments = (_SURFACES if shell else _VOLUMES)[kind](size)  # of a shell, the area: density is mass per area
    mass = float(given["mass"]) if "mass" in given else float(given.get("density", DENSITY)) * volume
    return Lump(mass, np.zeros(3), mass * np.diag(moments), np.eye(3)).transformed(pose)


# volume, and moments of inertia about the axes per unit mass


def _ellipsoid(size: Array) -> tuple[float, Array]:
    squares = (size[:3] if len(size) > 2 else np.full(3, size[0])) ** 2
    return 4.0 / 3.0 * np.pi * float(np.sqrt(squares.prod())), (squares.sum() - squares) / 5.0


def _box(size: Array) -> tuple[float, Array]:
    squares = size[:3] ** 2
    return 8.0 * float(size[:3].prod()), (squares.sum() - squares) / 3.0


def _cylinder(size: Array) -> tuple[float, Array]:
    r, h = size[:2]
    across = r * r / 4.0 + h * h / 3.0
    return 2.0 * np.pi * r * r * h, np.array([across, across, 0.5 * r * r])


def _capsule(size: Array) -> tuple[float, Array]:
    """Return volume and moments of a cylinder and two half balls, with centres 3/8 of the radius from its ends."""
    r, h = size[:2]
    whole, (across, _, along) = _cylinder(size)
    ball = 4.0 / 3.0 * np.pi * r**3
    caps = 0.4 * r * r + h * h + 0.75 * h * r
    total = whole + ball
    moments = np.array([whole * across + ball * caps] * 2 + [whole * along + ball * 0.4 * r * r]) / total
    return total, moments


def _surface(*parts: tuple[float, tuple[float, float, float]]) -> tuple[float, Array]:
    """Return the area of parts of a surface, given with their mean squares of x, y and z, and their moments."""
    areas, squares = np.array([area for area, _ in parts]), np.array([means for _, means in parts])
    mean = areas @ squares / areas.sum()
    return float(areas.sum()), mean.sum() - mean


def _box_surface(size: Array) -> tuple[float, Array]:
    squares = size[:3] ** 2
    means = (squares * np.where(np.eye(3, dtype=bool), 1.0, 1.0 / 3.0)).tolist()
    return _surface(*((8.0 * float(size[i - 2] * size[i - 1]), tuple(means[i])) for i in range(3)))


def _cylinder_surface(size: Array) -> tuple[float, Array]:
    r, h = (float(x) for x in size[:2])
    ends = 2.0 * np.pi * r * r, (0.25 * r * r, 0.25 * r * r, h * h)
    return _surface((4.0 * np.pi * r * h, (0.5 * r * r, 0.5 * r * r, h * h / 3.0)), ends)


def _capsule_surface(size: Array) -> tuple[float, Array]:
    """Return area and moments of a tube and two half spheres, with centres half of the radius from its ends."""
    r, h = (float(x) for x in size[:2])
    ends = 4.0 * np.pi * r * r, (r * r / 3.0, r * r / 3.0, r * r / 3.0 + h * h + h * r)
    return _surface((4.0 * np.pi * r * h, (0.5 * r * r, 0.5 * r * r, h * h / 3.0)), ends)


def _ellipsoid_surface(size: Array) -> tuple[float, Array]:
    """Return area and moments as in MuJoCo: Thomsen's area (error up to 1.1 %), and the moments of a layer of 1 um."""
    inner, outer = (_ellipsoid(size[:3] + layer) for layer in (0.0, 1e-6))
    moments = (outer[0] * outer[1] - inner[0] * inner[1]) / (outer[0] - inner[0])
    powers = (size[:3].prod() / size[:3]) ** 1.6075
    return 4.0 * np.pi * float(powers.mean()) ** (1.0 / 1.6075), moments


_SURFACES = {
    "ellipsoid": _ellipsoid_surface,
    "sphere": lambda size: _capsule_surface(np.array([size[0], 0.0])),
    "capsule": _capsule_surface,
    "cylinder": _cylinder_surface,
    "box": _box_surface,
}
_VOLUMES = {
    "sphere": lambda size: _ellipsoid(size[:1]),
    "capsule": _capsule,
    "cylinder": _cylinder,
    "box": _box,
    "ellipsoid": _ellipsoid,
}


SAME = 1e-9  # tolerance of directions, and of positions in m


@dataclass
class FileJoint:
    """A joint of MJCF or URDF: kind (hinge, slide, ball, free), position and axis in space, and other attributes.

    `position` (from the reference pose of the file) and `rate`, at the start: numbers for a hinge or slide; a rotation
    matrix and an angular velocity in body axes for a ball; a pose and both velocities for a free joint.
    """

    name: str
    kind: str
    at: Array
    axis: Array
    attributes: dict[str, str]
    position: Any = None
    rate: Any = None
    start_at: Array = field(default_factory=lambda: np.zeros(3))  # position and axis at the start
    start_axis: Array = field(default_factory=lambda: np.zeros(3))
    joint: ModelJoint | None = None  # the joint in the model; None: the body is free

    @property
    def displacement(self) -> float:
        """Return the angle or displacement from the reference pose to the start."""
        return 0.0 if self.position is None else float(self.position)


@dataclass
class Part:
    """A moving body with everything fixed to it: parent, frame, joints and masses, all in the reference pose in space.

    `start`, `velocity` and `spin` are the pose and the velocities at the start. A massless part carries one of several
    joints of a body.
    """

    name: str
    parent: Part | None
    pose: Pose
    freed: list[FileJoint] = field(default_factory=list)
    lumps: list[Lump] = field(default_factory=list)
    massless: bool = False
    start: Pose | None = None
    velocity: Array = field(default_factory=lambda: np.zeros(3))
    spin: Array = field(default_factory=lambda: np.zeros(3))
    moves: bool = False  # a rate of this part or of a parent is given
    body: Body | None = None


def body_of(model: Any, part: Part | None) -> Body:
    """Return the body of a part of a SpatialModel; the ground for None."""
    body = model.ground if part is None else part.body
    assert body is not None
    return body


def start_point(part: Part | None, point: Array) -> Array:
    """Return the position at the start of a point of a part; `point`: its position in the reference pose."""
    if part is None:
        return point
    assert part.start is not None
    return part.start.point(part.pose.inverse().point(point))


def start_pose(part: Part | None, pose: Pose) -> Pose:
    """Return the pose at the start of a frame of a part; `pose`: its pose in the reference pose of the file."""
    if part is None:
        return pose
    assert part.start is not None
    return part.start.then(part.pose.inverse().then(pose))


def place(part: Part) -> None:
    """Compute the pose and the velocities of a part at the start from the pose and the velocities of its parent."""
    still = Pose(np.zeros(3), np.eye(3))
    outer, moving = (still, still) if part.parent is None else (part.parent.pose, part.parent.start)
    assert moving is not None
    inner, back = outer.inverse().then(part.pose), part.pose.inverse()
    start = moving.then(inner)
    spin, turned, slid = np.zeros(3), [], np.zeros(3)
    if part.parent is not None:
        spin, part.moves = part.parent.spin.copy(), part.parent.moves
    for freed in part.freed:
        local, axis = back.point(freed.at), back.R @ freed.axis
        freed.start_at, freed.start_axis = start.point(local), start.R @ axis
        if freed.rate is not None:
            part.moves = True
        if freed.kind == "free":
            start = start if freed.position is None else freed.position
            if freed.rate is not None:
                slid, spin = np.array(freed.rate[:3]), start.R @ np.array(freed.rate[3:])
        elif freed.kind == "slide":
            start = Pose(start.x + freed.displacement * freed.start_axis, start.R)
            slid = slid + (0.0 if freed.rate is None else float(freed.rate)) * freed.start_axis
        else:
            turn = about(axis, freed.displacement) if freed.kind == "hinge" else freed.position
            R = start.R if turn is None else start.R @ turn
            start = Pose(freed.start_at - R @ local, R)
            if freed.rate is not None:
                rate = R @ np.array(freed.rate) if freed.kind == "ball" else float(freed.rate) * freed.start_axis
                spin = spin + rate
                turned.append((rate, freed.start_at))
    part.start, part.spin = start, spin
    part.velocity = slid + sum((np.cross(rate, start.x - at) for rate, at in turned), np.zeros(3))
    if part.parent is not None and part.parent.start is not None:
        part.velocity += part.parent.velocity + np.cross(part.parent.spin, start.x - part.parent.start.x)


def add_part(model: Any, part: Part) -> None:
    """Add to a model the body of a part and the joint that is equivalent to its joints; a free body has none."""
    place(part)
    assert part.start is not None
    lump, R = combined(part.lumps), part.start.R
    if not (part.massless or lump.mass > 0.0):
        raise ValueError(f"the body {part.name!r} has joints but no mass: give it an <inertial>, or a geom with volume")
    centre = part.freed[0].start_at if part.massless else start_point(part, lump.centre)
    motion: dict[str, Any] = {}
    if part.moves:
        motion = {"velocity": part.velocity + np.cross(part.spin, centre - part.start.x), "angular_velocity": part.spin}
    if part.massless:
        part.body = Body(part.name, len(model.bodies), centre, R, np.zeros(7), **motion)
        model.bodies.append(part.body)
    else:
        J = part.pose.R.T @ lump.J @ part.pose.R
        part.body = model.body(part.name, mass=lump.mass, inertia=J, position=centre, rotation=R, **motion)
    joint = _add_joint(model, body_of(model, part.parent), part.body, part.freed)
    for freed in part.freed:
        freed.joint = joint


def _add_joint(model: Any, parent: Body, child: Body, freed: list[FileJoint]) -> ModelJoint | None:
    """Add the joint equivalent to several joints of a file; return it, or None if the body is free."""
    kind, name, first = counterpart(freed), freed[0].name, freed[0]
    if kind == "free":
        return None
    at, axis = first.start_at, first.start_axis
    if kind == "spherical":
        return model.spherical(parent, child, at=at, name=name)
    if kind == "universal":
        return model.universal(parent, child, at=at, axes=[each.start_axis for each in freed], name=name)
    if kind in ("cylindrical", "planar"):
        hinge = next(each for each in freed if each.kind == "hinge")
        at, axis = hinge.start_at, hinge.start_axis
    return getattr(model, kind)(parent, child, at=at, axis=axis, name=name)


def counterpart(freed: list[FileJoint]) -> str:
    """Return the kind of joint of a model that has the freedoms of several joints of a file, or "" if there is none."""
    kinds = sorted(each.kind for each in freed)
    single = {"free": "free", "ball": "spherical", "hinge": "revolute", "slide": "prismatic"}
    if len(kinds) == 1:
        return single.get(kinds[0], "")
    if kinds == ["ball", "slide", "slide", "slide"]:
        return "free"
    hinges, slides = ([each for each in freed if each.kind == kind] for kind in ("hinge", "slide"))
    if kinds == ["hinge", "slide"] and np.abs(np.cross(hinges[0].axis, slides[0].axis)).max() < SAME:
        return "cylindrical"
    if kinds == ["hinge", "hinge"] and _across(*hinges) and np.abs(hinges[0].at - hinges[1].at).max() < SAME:
        return "universal"
    if kinds == ["hinge", "slide", "slide"] and all(_across(hinges[0], slide) for slide in slides):
        return "planar"
    return ""


def check_slides(body: str, freed: list[FileJoint]) -> None:
    """Raise if the axes of slides of one body are linearly dependent."""
    slid = np.array([each.axis for each in freed if each.kind == "slide"])
    if len(slid) > 1 and (len(slid) > 3 or np.linalg.svd(slid, compute_uv=False)[-1] < SAME):
        raise ValueError(f"the slides of the body {body!r} must have axes that do not follow from one another")


def _across(a: FileJoint, b: FileJoint) -> bool:
    return abs(float(a.axis @ b.axis)) < SAME
