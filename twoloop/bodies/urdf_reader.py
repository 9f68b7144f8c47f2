"""Read models from URDF, the robot description format: a tree of links and joints; loops are given separately."""

from __future__ import annotations

import ast
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import permutations
from typing import Any
from xml.etree.ElementTree import Element

import numpy as np
from numpy.typing import ArrayLike

from twoloop.bodies.file_parts import (
    FileJoint,
    Lump,
    Part,
    Pose,
    add_part,
    body_of,
    combined,
    numbers,
    pose_of,
    record_ignored,
    root_of,
    start_pose,
    tensor_of,
    text_of,
)
from twoloop.bodies.loads import function_rows
from twoloop.bodies.mjcf_loads import couple
from twoloop.bodies.parameter_layout import POINT
from twoloop.bodies.parts import Body, JointRow, ModelJoint, Numbers
from twoloop.bodies.rotation import euler_parameters, euler_product, parameters_of, perpendiculars
from twoloop.bodies.spatial.model import SpatialModel
from twoloop.checks.arguments import Array, check_choice, check_finite, check_flag, check_path, check_vector

KINDS = {"revolute": "hinge", "continuous": "hinge", "prismatic": "slide", "floating": "free", "fixed": ""}
CROSSES = {f"universal_{'xyz'[i]}{'xyz'[j]}": (i, j) for i, j in permutations(range(3), 2)}  # axes of the joint's frame
MORE = ("spherical", "planar", *CROSSES)  # types of joints besides KINDS
SIDE_TYPES = {"SPHERICAL": "spherical", "FIXED": "fixed"} | {f"UJOINT_{each[-2:].upper()}": each for each in CROSSES}
TURNING, SLIDING = ("revolute", "continuous"), ("prismatic",)
CLOSING = ("spherical", "revolute", "universal", "cylindrical", "prismatic", "planar", "fixed")
WITHOUT_EFFECT = {"link", "joint", "material"}  # supported elements, and colours


@dataclass(frozen=True)
class Loop:
    """A joint that closes a loop, which a URDF file cannot contain.

    Attributes
    ----------
    kind : str
        "spherical", "revolute", "universal", "cylindrical", "prismatic", "planar" or "fixed".
    a, b : str
        Names of links; "ground".
    at : array_like (3,)
        The joint in the frame of link a, m.
    at_b : array_like (3,), optional
        The joint in the frame of link b, m. None: the point that coincides with `at` in the position read.
    axis, axis_b : array_like (3,), optional
        Directions in the frames of a and b. None for b: that of a in the position read.
    name : str, optional

    Examples
    --------
    >>> from twoloop.bodies import Loop
    >>> loop = Loop("revolute", "coupler", "rocker", at=(0.4, 0.0, 0.0), axis=(0.0, 1.0, 0.0))
    >>> loop.kind, loop.a, loop.b
    ('revolute', 'coupler', 'rocker')
    """

    kind: str
    a: str
    b: str
    at: ArrayLike = (0.0, 0.0, 0.0)
    at_b: ArrayLike | None = None
    axis: ArrayLike | None = None
    axis_b: ArrayLike | None = None
    name: str | None = None


def from_urdf(
    path: str | os.PathLike[str],
    *,
    loops: Sequence[Loop] = (),
    positions: Mapping[str, float] | None = None,
    types: Mapping[str, str] | None = None,
    side_file: str | os.PathLike[str] | None = None,
    limits: bool = False,
    free_base: bool = False,
    gravity: ArrayLike = (0.0, 0.0, -9.81),
) -> SpatialModel:
    """Read a model from a URDF file.

    The reader supports links with inertials, joints of the types revolute, continuous, prismatic, planar, spherical,
    floating and fixed, and their damping; friction, for `solve_with_friction`; and mimic joints. Links fixed to others
    are merged with them. A massless link moves with its joints if there is mass beyond it; otherwise it is fixed.

    Parameters
    ----------
    path : path-like
    loops : sequence of Loop
        Joints that close loops, which a URDF file cannot contain.
    positions : mapping, optional
        Angles or displacements by names of joints, rad or m, that define the position of the bodies. Default: zero.
    types : mapping, optional
        Types of joints by their names, where the file has others: many exporters write a ball as a fixed joint.
    side_file : path-like, optional
        YAML file with loops and types of joints, as of example-parallel-robots (github.com/Gepetto): lists
        `closed_loop` of pairs of links whose frames coincide, `type` ("3d": in their origins only; "6d"), `joint_name`
        and `joint_type` (SPHERICAL, FIXED, UJOINT_XY, ...).
    limits : bool
        If True, limits of joints that a model supports become stops, for `solve_with_stops`.
    free_base : bool
        If True, the root link moves freely; otherwise it is fixed to the ground.
    gravity : array_like (3,)
        m/s^2; a URDF file does not contain it.

    Returns
    -------
    SpatialModel
        Its bodies have the names of the links and the axes of their frames. `model.ignored` lists what was ignored:
        limits, collisions, transmissions, ..., in the order of the effect on the motion.

    Warns
    -----
    IgnoredWarning
        If anything was ignored.

    Raises
    ------
    TypeError, ValueError
        If the file is not URDF or not a tree, or an argument is invalid.

    Notes
    -----
    The format is described at wiki.ros.org/urdf/XML.

    Examples
    --------
    >>> import tempfile
    >>> from pathlib import Path
    >>> TEXT = '''
    ... <robot name="arm">
    ...   <link name="base"/>
    ...   <link name="rod">
    ...     <inertial>
    ...       <origin xyz="0.5 0 0"/>
    ...       <mass value="1"/>
    ...       <inertia ixx="0.01" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/>
    ...     </inertial>
    ...   </link>
    ...   <joint name="hinge" type="continuous">
    ...     <parent link="base"/>
    ...     <child link="rod"/>
    ...     <axis xyz="0 1 0"/>
    ...   </joint>
    ... </robot>
    ... '''
    >>> from twoloop.bodies import from_urdf
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = Path(folder) / "arm.urdf"
    ...     _ = path.write_text(TEXT)
    ...     model = from_urdf(path, positions={"hinge": 0.3})
    >>> model.problem((0.0, 1.0)).freedom.degrees
    1
    """
    root = root_of(path, "robot")
    if any(each.tag in ("macro", "include", "property") for each in root):
        raise ValueError(f"{os.fspath(path)!r} is written in xacro: expand it first, by `xacro FILE -o robot.urdf`")
    check_flag("free_base", free_base)
    check_flag("limits", limits)
    model = SpatialModel(gravity, name=root.get("name", "robot"))
    welds, balls, more_types = ([], [], {}) if side_file is None else _side_file(side_file)
    names = {each.get("name") for each in root.findall("joint")}
    of_joints = {name: each for name, each in more_types.items() if name in names}
    reader = _Reader(root, dict(positions or {}), model, of_joints | dict(types or {}), limits)
    reader.ignored += [f"type of joint {name!r}, which the file has not" for name in more_types if name not in names]
    pairs = [*welds, *((loop.a, loop.b) for loop in (*loops, *balls))]
    reader.closed = {reader.link_of(name) for pair in pairs for name in pair}
    reader.read(free_base)
    for loop in (*loops, *balls):
        reader.close(loop)
    for pair in welds:
        reader.weld(*pair)
    record_ignored(path, reader.model, reader.ignored)
    return reader.model


class _Reader:
    def __init__(
        self, root: Element, positions: dict[str, Any], model: SpatialModel, types: dict[str, str], limits: bool
    ):
        self.model, self.ignored, self.types, self.limits = model, list[str](), types, limits
        self.closed: set[str] = set()  # links at the ends of loops
        self.moved: dict[str, FileJoint] = {}
        self.parts: list[Part] = []
        self.links = {_name(each): each for each in root.findall("link")}
        if len(self.links) < len(root.findall("link")):
            names = [_name(each) for each in root.findall("link")]
            twice = next(name for name in names if names.count(name) > 1)
            raise ValueError(f"links must have different names; {twice!r} occurs twice")
        self.joints = root.findall("joint")
        self.ignored += [
            f"{each.tag} {each.get('name') or each.get('reference') or ''!s}".rstrip()
            for each in root
            if each.tag not in WITHOUT_EFFECT
        ]
        self.positions = {name: check_finite(f"positions[{name!r}]", value) for name, value in positions.items()}
        unknown = self.positions.keys() - {_name(each) for each in self.joints}
        if unknown:
            raise ValueError(f"positions has {min(unknown)!r}, but the file has no joint of that name")
        if unknown := types.keys() - {_name(each) for each in self.joints}:
            raise ValueError(f"types has {min(unknown)!r}, but the file has no joint of that name")
        self.frames: dict[str, tuple[Part | None, Pose]] = {}
        self.collisions = 0

    def read(self, free_base: bool) -> None:
        """Read all links, starting at the root."""
        children: dict[str, list[Element]] = {name: [] for name in self.links}
        parents: dict[str, str] = {}
        for joint in self.joints:
            parent, child = (self._end(joint, which) for which in ("parent", "child"))
            if child in parents:
                raise ValueError(f"the link {child!r} has two parents, {parents[child]!r} and {parent!r}: give loops=")
            children[parent].append(joint)
            parents[child] = parent
        roots = [name for name in self.links if name not in parents]
        if len(roots) != 1:
            raise ValueError(f"a URDF file must be one tree of links; roots of this one are {roots}")
        origin = Pose(np.zeros(3), np.eye(3))
        base = None
        if free_base:
            base = Part(roots[0], None, origin, [FileJoint("base", "free", np.zeros(3), np.array([0.0, 0.0, 1.0]), {})])
        self.parts += [] if base is None else [base]
        self.children = children
        self._link(roots[0], base, origin)
        waiting = [roots[0]]
        while waiting:
            name = waiting.pop(0)
            for joint in children[name]:
                self._joint(joint, *self.frames[name])
                waiting.append(self._end(joint, "child"))
        for part in self.parts:
            part.massless = part.massless or not combined(part.lumps).mass > 0.0
            add_part(self.model, part)
        for joint in self.joints:
            if _name(joint) in self.moved:
                self._acting(joint, self.moved[_name(joint)])
        if self.collisions > 1:
            self.ignored.append("contacts between links")

    def close(self, loop: Loop) -> None:
        """Add a joint that closes a loop."""
        kind = check_choice("kind of a loop", loop.kind, CLOSING) or loop.kind
        (part_a, frame_a), (part_b, frame_b) = (self._frame(name) for name in (loop.a, loop.b))
        frame_a, frame_b = start_pose(part_a, frame_a), start_pose(part_b, frame_b)
        body_a, body_b = body_of(self.model, part_a), body_of(self.model, part_b)
        at: Any = frame_a.point(check_vector("at of a loop", loop.at, 3))
        if loop.at_b is not None:
            at_b = frame_b.point(check_vector("at_b of a loop", loop.at_b, 3))
            at = body_a.point(*body_a.local_point(at)), body_b.point(*body_b.local_point(at_b))
        more: dict[str, Any] = {}
        if kind not in ("spherical", "fixed"):
            if loop.axis is None:
                raise ValueError(f"a {kind} loop needs an axis; that of {loop.a!r} and {loop.b!r} has none")
            axis = frame_a.R @ check_vector("axis of a loop", loop.axis, 3)
            axis_b = axis if loop.axis_b is None else frame_b.R @ check_vector("axis_b of a loop", loop.axis_b, 3)
            pair = _direction(body_a, axis), _direction(body_b, axis_b)
            more = {"axes" if kind == "universal" else "axis": pair}
        getattr(self.model, kind)(body_a, body_b, at=at, name=loop.name, **more)

    def weld(self, a: str, b: str) -> None:
        """Add a joint that makes the frames of two links coincide."""
        ends = [(body_of(self.model, part), start_pose(part, frame)) for part, frame in map(self._frame, (a, b))]
        (body_a, _), (body_b, _) = ends
        on_a, on_b = (Numbers(tuple(body.local_point(frame.x).tolist())) for body, frame in ends)
        zero_a, zero_b = (euler_parameters(body.rotation.T @ frame.R) for body, frame in ends)
        back = [zero_a[0], *-zero_a[1:]]

        def turn(q: Any, k: int) -> Any:
            """Return a vector component of the relative Euler parameters, all zero only where the frames coincide."""
            frame = euler_product(parameters_of(q, body_b.number), zero_b)
            return euler_product(back, euler_product(parameters_of(q, body_a.number, -1.0), frame))[k]

        name, carrying = f"{a} on {b}", (body_a, body_b, on_a, on_b)
        turns = function_rows(name, [partial(turn, k=k) for k in (1, 2, 3)], (body_a, body_b), carrying)
        rows = JointRow(POINT, 3, *carrying), *turns
        self.model.joints.append(ModelJoint(name, "weld", body_a, body_b, rows, on_a, on_b))

    def link_of(self, name: str) -> str:
        """Return the name of a link at the end of a loop; `name`: the link, or the joint that carries this link."""
        carried = (self._end(each, "child") for each in self.joints if each.get("name") == name)
        return name if name in self.links else next(carried, name)

    def _frame(self, name: str) -> tuple[Part | None, Pose]:
        name = self.link_of(name)
        if name == "ground":
            return None, Pose(np.zeros(3), np.eye(3))
        if name not in self.frames:
            raise ValueError(f"a loop must be between links of the file or the ground; given {name!r}")
        return self.frames[name]

    def _end(self, joint: Element, which: str) -> str:
        end = joint.find(which)
        name = "" if end is None else end.get("link", "")
        if name not in self.links:
            raise ValueError(f"{which} of joint {_name(joint)!r} must be a link of the file; given {name!r}")
        return name

    def _acting(self, element: Element, freed: FileJoint) -> None:
        """Add damping, friction, limits and coupling of a joint."""
        name, joint = _name(element), freed.joint
        single = joint is not None and joint.kind in ("revolute", "prismatic")
        damping, friction = (
            numbers(freed.attributes.get(key, "0"), 1, f"{key} of joint {name!r}")[0] for key in ("damping", "friction")
        )
        if joint is not None and single:
            if damping:
                turns = joint.kind == "revolute"
                add_spring = self.model.torsion_spring if turns else self.model.axial_spring
                add_spring(joint, stiffness=0.0, damping=float(damping))
            if friction:
                self.model.dry_friction(joint, float(friction))
                self.ignored.append(f"friction of joint {name!r} by solve_dae (solve_with_friction has it)")
        else:
            self.ignored += [f"damping of joint {name!r}"] if damping else []
            self.ignored += [f"friction of joint {name!r}"] if friction else []
        more = freed.attributes.keys() - {"damping", "friction"}  # such as the springs of other readers
        self.ignored += [f"{key} of the dynamics of joint {name!r}" for key in sorted(more)]
        limit = element.find("limit")
        if limit is not None and self._type(element) in ("revolute", "prismatic") and not self._limit(limit, freed):
            self.ignored.append(f"limits of joint {name!r}")
        if element.find("safety_controller") is not None:
            self.ignored.append(f"safety_controller of joint {name!r}")
        mimic = element.find("mimic")
        if mimic is not None and not (single and self._mimic(mimic, freed)):
            self.ignored.append(f"mimic of joint {name!r}")

    def _limit(self, limit: Element, freed: FileJoint) -> bool:
        """Add the stops of a joint; return False if stops are not requested, or a model cannot have them there."""
        if not self.limits or freed.joint is None:
            return False
        bounds = [numbers(limit.get(key, "0"), 1, f"{key} of joint {freed.name!r}")[0] for key in ("lower", "upper")]
        low, high = (float(each - freed.displacement) for each in bounds)
        try:
            self.model.limit(freed.joint, lower=low, upper=high)
        except ValueError:  # e.g. a hinge in space
            return False
        return True

    def _mimic(self, mimic: Element, freed: FileJoint) -> bool:
        """Couple a joint to the joint that it mimics; return False if a model does not support this."""
        leader = self.moved.get(mimic.get("joint", ""))
        if not hasattr(self.model, "coupling") or leader is None or leader.joint is None:
            return False
        factor, offset = self._mimic_numbers(mimic, freed.name)
        joints, offsets = [freed.joint, leader.joint], [freed.displacement, leader.displacement]
        couple(self.model, joints, offsets, (offset, factor), f"mimic of {freed.name}")
        return True

    def _mimic_numbers(self, mimic: Element, name: str) -> tuple[float, float]:
        """Return multiplier and offset of the mimic of a joint."""
        factor, offset = (
            float(numbers(mimic.get(key, default), 1, f"{key} of the mimic of joint {name!r}")[0])
            for key, default in (("multiplier", "1"), ("offset", "0"))
        )
        return factor, offset

    def _position(self, joint: Element, seen: tuple[str, ...] = ()) -> float:
        """Return the given position of a joint; else the one that follows from a joint coupled by a mimic, or zero."""
        name, mimic = _name(joint), joint.find("mimic")
        if name in self.positions or name in seen:
            return self.positions.get(name, 0.0)
        for each in self.joints:  # the joint mimics `each`, or is mimicked by it
            if mimic is not None and _name(each) == mimic.get("joint"):
                factor, offset = self._mimic_numbers(mimic, name)
                return factor * self._position(each, (*seen, name)) + offset
            follows = each.find("mimic")
            if follows is not None and follows.get("joint") == name and _name(each) in self.positions:
                factor, offset = self._mimic_numbers(follows, _name(each))
                return (self.positions[_name(each)] - offset) / factor if factor else 0.0
        return 0.0

    def _type(self, joint: Element) -> str:
        name = _name(joint)
        kind = self.types.get(name, joint.get("type", ""))
        if kind not in (*KINDS, *MORE):
            raise ValueError(f"type of joint {name!r} must be one of {', '.join((*KINDS, *MORE))}; given {kind!r}")
        return kind

    def _matters(self, link: str) -> bool:
        """Return True if a link, or a link that it carries, has mass or is an end of a loop."""
        mass = self.links[link].find("inertial/mass")
        heavy = mass is not None and numbers(mass.get("value", ""), 1, f"mass of link {link!r}")[0] > 0.0
        return (
            heavy or link in self.closed or any(self._matters(self._end(each, "child")) for each in self.children[link])
        )

    def _joint(self, joint: Element, parent: Part | None, outer: Pose) -> None:
        """Read the child link of a joint."""
        name, kind, child = _name(joint), self._type(joint), self._end(joint, "child")
        pose = outer.then(_origin(joint, f"origin of joint {name!r}"))
        value = self._position(joint) if kind in (*TURNING, *SLIDING) else self.positions.get(name, 0.0)
        if value and kind not in (*TURNING, *SLIDING):
            raise ValueError(f"positions has {name!r}, a {kind} joint, which has no angle or displacement")
        if kind == "fixed" or not self._matters(child):
            if kind != "fixed":
                self.ignored.append(f"joint {name!r}, beyond which there is no mass")
            self._link(child, parent, pose)
            return
        axis = np.array([1.0, 0.0, 0.0])
        if kind in (*TURNING, *SLIDING, "planar"):
            given = joint.find("axis")
            axis = numbers("1 0 0" if given is None else given.get("xyz", "1 0 0"), 3, f"axis of joint {name!r}")
            if not axis.any():
                raise ValueError(f"axis of joint {name!r} must have a direction; given {axis.tolist()}")
            axis = axis / np.linalg.norm(axis)
        dynamics = joint.find("dynamics")
        attributes = {} if dynamics is None else dict(dynamics.attrib)
        turned: list[Array] = []
        if kind in CROSSES:
            turned = [pose.R[:, k] for k in CROSSES[kind]]
        own = f"joint {name}" if name in self.links else name  # in URDF a link and a joint may share a name
        normal = pose.R @ axis
        if kind == "planar":
            freed = [FileJoint(own, "slide", pose.x, each, attributes) for each in perpendiculars(normal)]
            freed.append(FileJoint(own, "hinge", pose.x, normal, attributes))
        elif turned:
            freed = [FileJoint(own, "hinge", pose.x, each, attributes) for each in turned]
        else:
            moved = "ball" if kind == "spherical" else KINDS[kind]
            freed = [FileJoint(own, moved, pose.x, normal, attributes, position=value if value else None)]
        part = Part(child, parent, pose, freed)
        self.parts.append(part)
        self.moved[name] = freed[-1]
        self._link(child, part, pose)

    def _link(self, name: str, part: Part | None, pose: Pose) -> None:
        """Record the frame and the mass of a link."""
        self.frames[name] = part, pose
        element = self.links[name]
        self.collisions += element.find("collision") is not None
        inertial = element.find("inertial")
        if inertial is None or part is None:
            return
        what = f"inertial of link {name!r}"
        mass, inertia = inertial.find("mass"), inertial.find("inertia")
        if mass is None or inertia is None:
            raise ValueError(f"{what} needs <mass> and <inertia>")
        entries = " ".join(inertia.get(key, "0") for key in ("ixx", "iyy", "izz", "ixy", "ixz", "iyz"))
        J = tensor_of(*numbers(entries, 6, f"inertia of link {name!r}"))
        (value,) = numbers(mass.get("value", ""), 1, f"mass of link {name!r}")
        if not value and J.any():
            self.ignored.append(f"the mass of link {name!r}, whose inertia has none")
        part.lumps.append(Lump(float(value), np.zeros(3), J).transformed(pose.then(_origin(inertial, what))))


def _side_file(path: str | os.PathLike[str]) -> tuple[list[tuple[str, str]], list[Loop], dict[str, str]]:
    """Read pairs of links that are welded, balls between links, and types of joints."""
    lists: dict[str, Any] = {}
    for key, text in re.findall(
        r"(?m)^(\w+):\s*(\[(?:.|\n)*?\])\s*(?=^\w|\Z)", re.sub("#.*", "", check_path(path).read_text())
    ):
        try:
            lists[key] = ast.literal_eval(text)
        except (SyntaxError, ValueError):
            raise ValueError(
                f"{key} of {os.fspath(path)!r} must be a list such as ['a', 'b']; given {text!r}"
            ) from None
    pairs, kinds = lists.get("closed_loop", []), lists.get("type", [])
    kinds += ["6d"] * (len(pairs) - len(kinds))
    names, types = lists.get("joint_name", []), lists.get("joint_type", [])
    if not all(isinstance(each, (list, tuple)) and len(each) == 2 for each in pairs) or len(names) != len(types):
        raise ValueError(
            f"{os.fspath(path)!r} must have pairs of links in closed_loop, and a joint_type per joint_name"
        )
    if unknown := set(types) - SIDE_TYPES.keys():
        raise ValueError(f"joint_type must be one of {', '.join(SIDE_TYPES)}; given {min(unknown)!r}")
    sorts: dict[str, list[Any]] = {"3d": [], "6d": []}
    for pair, kind in zip(pairs, kinds, strict=True):
        sorts.setdefault(str(kind).lower(), []).append(tuple(pair))
    if unknown := sorts.keys() - {"3d", "6d"}:
        raise ValueError(f"type of a closed_loop must be 3d or 6d; given {min(unknown)!r}")
    balls = [Loop("spherical", a, b, at_b=(0.0, 0.0, 0.0), name=f"{a} on {b}") for a, b in sorts["3d"]]
    return sorts["6d"], balls, {name: SIDE_TYPES[each] for name, each in zip(names, types, strict=True)}


def _name(element: Element) -> str:
    name = element.get("name")
    if not name:
        raise ValueError(f"each <{element.tag}> of a URDF file must have a name")
    return name


def _origin(element: Element, what: str) -> Pose:
    """Return the pose of a frame in its parent: translation xyz, then roll, pitch and yaw about fixed axes."""
    origin = element.find("origin")
    given = {} if origin is None else origin.attrib
    place = {"pos": given.get("xyz") or "0 0 0"}
    if "quat_xyzw" in given:
        *vector, scalar = numbers(given["quat_xyzw"], 4, f"quat_xyzw of {what}").tolist()
        return pose_of(place | {"quat": text_of([scalar, *vector])}, what, False, "XYZ")
    turns = text_of(numbers(given.get("rpy") or "0 0 0", 3, f"rpy of {what}"))
    return pose_of(place | {"euler": turns}, what, False, "XYZ")


def _direction(body: Body, direction: Array) -> Any:
    return body.direction(*body.local_direction(direction))
