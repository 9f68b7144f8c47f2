"""Read models from MJCF, the format of MuJoCo: bodies, joints, masses; loops and loads are read by `mjcf_loads`."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element

import numpy as np

from twoloop.bodies.file_parts import (
    FileJoint,
    Lump,
    Part,
    Pose,
    add_part,
    check_slides,
    combined,
    counterpart,
    geom_lump,
    name_of,
    numbers,
    pose_of,
    principal_axes,
    record_ignored,
    tensor_of,
    text_of,
)
from twoloop.bodies.fluid import Medium
from twoloop.bodies.meshes import fitted, mesh_lump, mesh_triangles
from twoloop.bodies.mjcf_actuators import ACTUATORS, actuator_law
from twoloop.bodies.mjcf_expand import MODEL, Compiler, expanded
from twoloop.bodies.mjcf_loads import Loads
from twoloop.bodies.spatial.model import SpatialModel
from twoloop.checks.arguments import Array, check_flag

SEEN_ONLY = {"asset", "visual", "statistic", "size", "custom", "camera", "light"}  # without effect on the motion
KNOWN = {"compiler", "option", "default", "worldbody", "equality", "tendon", "actuator", "keyframe"}
DEFAULT_OF = {"spatial": "tendon", "fixed": "tendon"}
TURNS = {"quat", "axisangle", "xyaxes", "zaxis", "euler"}  # alternative orientations of an element
INERT = ("armature", "damping", "stiffness", "frictionloss", "springdamper")  # attributes that need a coordinate
FITTED = ("sphere", "capsule", "cylinder", "box", "ellipsoid")
UNWEIGHED = ("plane", "hfield", "sdf")


def from_mjcf(
    path: str | os.PathLike[str],
    *,
    key: str | int | None = None,
    commands: Mapping[str, Any] | None = None,
    limits: bool = False,
) -> SpatialModel:
    """Read a model from an MJCF file, in the reference pose of the file (qpos0) or in a keyframe.

    The reader supports

    - included files, attached models, frames, replicates, default classes and the settings of the compiler;
    - bodies with inertials, or with masses of their geoms and of meshes in STL, OBJ and MSH files;
    - hinge, slide, ball and free joints, any number to a body: where a model has no joint with the same freedoms,
      massless bodies carry one joint each;
    - armature, stiffness, damping, springref; frictionloss, for `solve_with_friction`;
    - the equalities connect and weld, which are exact here and soft in MuJoCo, and those of joints and tendons;
    - tendons that do not wind about geoms, gravcomp, gravity, and the forces of a medium;
    - position, velocity, intvelocity, damper, motor, cylinder and general actuators of hinges, slides and tendons,
      where an activation is that of a constant command from t = 0 on; motors of balls, free joints and sites.

    Bodies without joints are merged with their parents.

    Parameters
    ----------
    path : path-like
    key : str or int, optional
        Keyframe, by its name or its number from 0, whose qpos, qvel and ctrl are the start.
    commands : mapping, optional
        Commands (ctrl) of actuators, by their names: numbers, or functions of t. Default: those of the keyframe, or
        zero. In the parameters of the problem, the command of a position servo is its "angle of NAME (rad)" or
        "length of NAME (m)"; that of another actuator is "value of NAME", which includes its gain.
    limits : bool
        If True, limits of slides, and of hinges if the model supports these, become stops, for `solve_with_stops`.

    Returns
    -------
    SpatialModel
        `model.ignored` lists what was ignored, by its effect on the motion: masses, equalities, ..., contacts.

    Warns
    -----
    IgnoredWarning
        If anything was ignored.

    Raises
    ------
    TypeError, ValueError
        If the file is not MJCF, has joints or welds that a model does not support, or an argument is invalid.

    Notes
    -----
    The format is described in MuJoCo's XML reference.

    Examples
    --------
    >>> import tempfile
    >>> from pathlib import Path
    >>> TEXT = '''
    ... <mujoco>
    ...   <worldbody>
    ...     <body name="rod">
    ...       <joint type="hinge" axis="0 1 0"/>
    ...       <geom type="capsule" fromto="0 0 0 1 0 0" size="0.02" mass="1"/>
    ...     </body>
    ...   </worldbody>
    ... </mujoco>
    ... '''
    >>> from twoloop.bodies import from_mjcf
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = Path(folder) / "pendulum.xml"
    ...     _ = path.write_text(TEXT)
    ...     model = from_mjcf(path)
    >>> model.problem((0.0, 1.0)).freedom.degrees
    1
    """
    check_flag("limits", limits)
    reader = _Reader(path, key, dict(commands or {}), limits)
    reader.read()
    record_ignored(path, reader.model, reader.ignored)
    return reader.model


class _Reader:
    def __init__(self, path: str | os.PathLike[str], key: Any, commands: dict[str, Any], limits: bool):
        (self.root, self.compilers), self.ignored = expanded(path), list[str]()
        root = self.root
        settings = [each.attrib for each in root.findall("compiler")]
        self.total_mass = [float(each["settotalmass"]) for each in settings if "settotalmass" in each][-1:]
        self.fused = [each["fusestatic"] for each in settings if "fusestatic" in each][-1:] == ["true"]
        self.defaults: dict[str, dict[str, dict[str, str]]] = {"main": {}}
        for each in root.findall("default"):
            self._default(each, each.attrib["class"], self.defaults.get(each.attrib["class"], {}))
        disabled_groups = ""
        gravity, medium = np.array([0.0, 0.0, -9.81]), dict[str, str]()
        for each in root.findall("option"):
            gravity = numbers(each.get("gravity", "0 0 -9.81"), 3, "gravity") if each.get("gravity") else gravity
            disabled_groups = each.get("actuatorgroupdisable", disabled_groups)
            medium |= {name: each.attrib[name] for name in ("density", "viscosity", "wind") if name in each.attrib}
        flags = {
            name: value for flag in root.findall("option/flag") for name, value in flag.attrib.items()
        }  # if a file repeats an attribute, the last value counts
        self.disabled = {name for name, value in flags.items() if value == "disable"}
        gravity = np.zeros(3) if "gravity" in self.disabled else gravity
        self.without = {"stiffness"} if "spring" in self.disabled else set()
        self.without |= {"damping"} if "damper" in self.disabled else set()
        self.without |= {"stiffness", "damping"} if "passive" in self.disabled else set()  # one flag, before 3.4
        self.without |= {"frictionloss"} if self.disabled & {"frictionloss", "constraint"} else set()
        numbers_of = {key: numbers(medium.get(key, "0"), 1, key)[0] for key in ("density", "viscosity")}
        self.medium = Medium(**numbers_of, wind=tuple(numbers(medium.get("wind", "0 0 0"), 3, "wind").tolist()))
        self.groups_without_force = disabled_groups.split()
        self.model = SpatialModel(gravity, name=root.get("model", "MuJoCo Model"))
        self.frames: dict[str, tuple[Part | None, Pose]] = {"world": (None, Pose(np.zeros(3), np.eye(3)))}
        self.sites: dict[str, tuple[Part | None, Array]] = {}
        self.joints: dict[str, FileJoint] = {}  # by their names in the file
        self.ordered: list[FileJoint] = []  # as in qpos
        self.parts: list[Part] = []
        self.gravcomp: list[tuple[Part, Lump, float]] = []
        self.wetted: list[tuple[Part, Lump]] = []  # parts and masses on which the medium acts
        self.meshes: dict[str, Element] = {}
        for asset in root.findall("asset"):
            for mesh in asset.findall("mesh"):
                self.meshes[mesh.get("name", Path(mesh.get("file", "")).stem)] = mesh
        self.triangles: dict[str, Array | None] = {}
        self.n_geoms, self.n_bodies, self.total, self.static = 0, 0, 0.0, False
        self.taken = {"ground", *(each.get("name", "") for each in root.iter("body"))}
        acting = [each for tag in ("equality", "actuator", "tendon") for group in root.findall(tag) for each in group]
        self.referred = [
            value for each in acting for part in each.iter() for name, value in part.attrib.items() if "joint" in name
        ]
        self.key, self.commands, self.limits = key, commands, limits and "limit" not in self.disabled

    def read(self) -> None:
        """Read the whole file."""
        for each in self.root:
            if each.tag not in SEEN_ONLY | KNOWN:
                self.ignored += [f"{each.tag}: {name_of(part)}" for part in each] or [each.tag]
        for each in self.root.findall("worldbody"):
            self._within(each, None, Pose(np.zeros(3), np.eye(3)), "main")
        total = max(self.total_mass, default=-1.0)
        if total > 0.0 and self.fused and self.static:  # MuJoCo does not count masses that it fuses with the world
            self.ignored.append("fusestatic of the compiler, for the mass that settotalmass scales")
        scale = total / self.total if total > 0.0 and self.total > 0.0 else 1.0
        loads = Loads(self)
        loads.start(self.key)
        carrying = {id(part.parent) for part in self.parts}
        for part in self.parts:
            part.lumps = [Lump(scale * each.mass, each.centre, scale * each.J) for each in part.lumps]
            mass = combined(part.lumps).mass
            part.massless |= id(part) in carrying and not mass and len(part.freed) == 1
            if unread := [
                each for each in self.ignored if each.startswith("the mass of") and not (mass or part.massless)
            ]:
                raise ValueError(f"the body {part.name!r} has joints but no known mass; not read: {unread[0]}")
            add_part(self.model, part)
        loads.read(scale)
        if self.n_geoms > 1 and not self.disabled & {"contact", "constraint"}:
            self.ignored.append("contacts between geoms")

    def _default(self, element: Element, name: str, inherited: dict[str, dict[str, str]]) -> None:
        name = element.get("class", name)
        merged = {tag: dict(values) for tag, values in inherited.items()}
        for each in element:
            if each.tag in ACTUATORS:
                merged["actuator"] = actuator_law(each.tag, merged.get("actuator", {}), each.attrib)
            elif each.tag != "default":
                merged[each.tag] = _merged(merged.get(each.tag, {}), each.attrib)
        self.defaults[name] = merged
        for each in element.findall("default"):
            self._default(each, name, merged)

    def attributes(self, element: Element, childclass: str, kind: str | None = None) -> dict[str, str]:
        """Merge the attributes of an element into its default class; `kind`: kind of the default, if not its tag."""
        name = element.get("class", childclass)
        if name not in self.defaults:
            raise ValueError(f"{name_of(element)} is of the class {name!r}, which no default has")
        if element.tag in ACTUATORS:
            return actuator_law(element.tag, self.defaults[name].get("actuator", {}), element.attrib)
        kind = kind or DEFAULT_OF.get(element.tag, element.tag)
        given = _merged(self.defaults[name].get(kind, {}), element.attrib)
        return {key: value for key, value in given.items() if key not in self.without}

    def pose(self, attributes: Mapping[str, str], what: str) -> Pose:
        """Return the pose of an element in the frame of the element that contains it."""
        compiler = self.compiler(attributes)
        return pose_of(attributes, what, compiler.degrees, compiler.sequence)

    def compiler(self, attributes: Mapping[str, str]) -> Compiler:
        """Return the settings of the compiler for an element, by its attributes."""
        return self.compilers[attributes.get(MODEL, "")]

    def _within(self, element: Element, part: Part | None, pose: Pose, childclass: str) -> None:
        """Read the children of a body, or of the world."""
        contents = self._contents(element, childclass)
        from_geoms = self.compiler(element.attrib).from_geoms
        inertial = next((each for each, _, _ in contents if each.tag == "inertial"), None)
        weigh = element.tag == "body" and (from_geoms == "true" or (from_geoms == "auto" and inertial is None))
        lumps, stated = list[Lump](), list[Lump]()
        for each, frame, name in contents:
            given = self.attributes(each, name)
            if each.tag == "body":
                self._body(each, part, pose.then(frame), each.get("childclass", name))
            elif each.tag == "geom":
                what = (
                    name_of(each)
                    if each.get("name")
                    else f"a geom of body {element.get('name', part.name if part else '?')!r}"
                )
                lump = self._geom(given, what, weigh)
                lumps += [] if lump is None or not weigh else [lump.transformed(frame)]
            elif each.tag == "site":
                if "fromto" in given:
                    ends = numbers(given["fromto"], 6, f"fromto of {name_of(each)}")
                    given["pos"] = text_of(0.5 * (ends[:3] + ends[3:]))
                place = pose.then(frame).then(self.pose(given, name_of(each)))
                self.sites[each.get("name", f"site {len(self.sites)}")] = part, place.x
                self.frames[f"site {each.get('name', len(self.sites))}"] = part, place
            elif each is inertial:
                stated = [self._inertial(each, element.get("name", "?")).transformed(frame)]
            elif each.tag in ("composite", "flexcomp"):
                raise ValueError(
                    f"<{each.tag}> is not read: load the file in MuJoCo and save it, where bodies are written out "
                    "(mujoco.mj_saveLastXML), and remove what is deformable"
                )
            elif each.tag not in SEEN_ONLY | {"inertial", "joint", "freejoint"}:
                self.ignored.append(name_of(each))
        if element.tag == "body":
            lump = self._bounded(combined(lumps or stated), self.compiler(element.attrib))
            if lump.mass and not (lumps or stated) and numbers(element.get("pos", "0 0 0"), 3, "pos").any():
                self.ignored.append(f"where boundmass puts the mass of {name_of(element)}")  # in MuJoCo at its pos
            if self.fused and lump.J.any() and not lump.mass:  # MuJoCo drops this inertia when it fuses the body
                self.ignored.append(f"fusestatic of the compiler, for the mass of {name_of(element)}")
            self.total += lump.mass
            self.static |= part is None and lump.mass > 0.0
            gravcomp = float(element.get("gravcomp", 0.0))
            if part is not None:
                lump = lump if lump.axes is not None else replace(lump, axes=principal_axes(lump.J))
                part.lumps.append(lump.transformed(pose))
                if gravcomp and lump.mass:
                    self.gravcomp.append((part, part.lumps[-1], gravcomp))
                geoms = [self.attributes(each, name) for each, _, name in contents if each.tag == "geom"]
                shaped = any(each.get("fluidshape") == "ellipsoid" for each in geoms)
                if shaped and (self.medium.density or self.medium.viscosity):
                    self.ignored.append(f"forces of the medium on the ellipsoids of {name_of(element)}")
                elif lump.mass:
                    self.wetted.append((part, part.lumps[-1]))

    def _contents(self, element: Element, childclass: str) -> list[tuple[Element, Pose, str]]:
        """Return the children of a body and of its frames, each with the pose of its frame and its class."""
        contents: list[tuple[Element, Pose, str]] = []
        for each in element:
            if each.tag != "frame":
                contents.append((each, Pose(np.zeros(3), np.eye(3)), childclass))
                continue
            outer = self.pose(each.attrib, name_of(each))
            within = self._contents(each, each.get("childclass", childclass))
            contents += [(child, outer.then(inner), name) for child, inner, name in within]
        return contents

    def _bounded(self, lump: Lump, compiler: Compiler) -> Lump:
        """Apply the compiler's lower bounds of masses and moments to a mass."""
        least, least_moment, balance = compiler.least_mass, compiler.least_moment, compiler.balance
        if not (least or least_moment or balance):
            return lump
        axes = principal_axes(lump.J) if lump.axes is None else lump.axes
        moments = np.maximum(np.diag(axes.T @ lump.J @ axes), least_moment)
        if balance and moments.sum() < 2.0 * moments.max():
            moments = np.full(3, moments.mean())
        return Lump(max(lump.mass, least), lump.centre, axes @ np.diag(moments) @ axes.T, axes)

    def _body(self, element: Element, parent: Part | None, outer: Pose, childclass: str) -> None:
        self.n_bodies += 1
        name = element.get("name", f"body {self.n_bodies}")
        name = "ground of the file" if name == "ground" else name  # "ground" is reserved
        pose, part = outer.then(self.pose(element.attrib, f"body {name!r}")), parent
        if element.get("mocap", "false") != "false":
            self.ignored.append(f"mocap of body {name!r}")
        moved: list[FileJoint] = []
        for each, frame, class_name in self._contents(element, childclass):
            if each.tag in ("joint", "freejoint"):
                moved.append(self._joint(each, pose.then(frame), class_name, name, len(moved)))
        if moved:
            if moved[0].kind == "free" and not any(
                each.tag == "body" for each, _, _ in self._contents(element, childclass)
            ):
                self._align(moved[0], element)
            part = self._chain(name, parent, pose, moved)
        self.frames[element.get("name", name)] = part, pose
        self._within(element, part, pose, childclass)

    def _align(self, joint: FileJoint, body: Element) -> None:
        """Record a free joint that MuJoCo aligns with the principal axes of its body, if this has an effect."""
        aligned = joint.attributes.get("align", "auto")
        aligns = aligned == "true" or (aligned == "auto" and self.compiler(body.attrib).align)
        acts = any(float(joint.attributes.get(key, "0").split()[0]) for key in INERT[:3])
        if aligns and (self.key is not None or acts) and next(body.iterfind(".//body"), None) is None:
            self.ignored.append(f"align of joint {joint.name!r}, which is along the axes of its body")

    def _chain(self, name: str, parent: Part | None, pose: Pose, moved: list[FileJoint]) -> Part:
        """Return the part of a body; if no joint has all freedoms, massless parts carry the first joints."""
        check_slides(name, moved)
        plain = not any(self._has_coordinate(each) for each in moved)
        kind = counterpart(moved)
        if len(moved) > 1 and (not kind or not (plain or kind == "free")):
            if any(each.kind == "free" for each in moved):
                raise ValueError(f"the body {name!r} must have no other joint beside its free one")
            for each in moved[:-1]:
                own = self.free(None, f"{name} after {each.name}")
                parent = Part(own, parent, pose, [each], massless=True)
                self.parts.append(parent)
            moved = moved[-1:]
        part = Part(name, parent, pose, moved)
        self.parts.append(part)
        return part

    def _has_coordinate(self, joint: FileJoint) -> bool:
        """Return True if something acts on a joint's coordinate, so that the model needs a separate joint for it."""
        acting = any(any(float(x) for x in joint.attributes.get(key, "0").split()) for key in INERT)
        acting |= self.limits and self.limited(joint.attributes)
        return acting or joint.attributes.get("name") in self.referred

    def limited(self, given: Mapping[str, str], flag: str = "limited", span: str = "range") -> bool:
        """Return True if an element has limits."""
        limited = given.get(flag, "auto")
        return limited == "true" or (limited == "auto" and self.compiler(given).automatic and span in given)

    def _joint(self, element: Element, pose: Pose, childclass: str, body: str, number: int) -> FileJoint:
        given = dict(element.attrib) if element.tag == "freejoint" else self.attributes(element, childclass)
        name = self.free(element.get("name"), f"joint of {body}" if number == 0 else f"joint {number + 1} of {body}")
        kind = "free" if element.tag == "freejoint" else given.get("type", "hinge")
        if kind not in ("hinge", "slide", "ball", "free"):
            raise ValueError(f"type of joint {name!r} must be hinge, slide, ball or free; given {kind!r}")
        axis = numbers(given.get("axis", "0 0 1"), 3, f"axis of joint {name!r}")
        if not axis.any():
            raise ValueError(f"axis of joint {name!r} must have a direction; given {given['axis']!r}")
        where = "0 0 0" if kind == "free" else given.get("pos", "0 0 0")
        place = numbers(where, 3, f"pos of joint {name!r}")
        joint = FileJoint(name, kind, pose.point(place), pose.R @ axis / np.linalg.norm(axis), given)
        self.ordered.append(joint)
        if element.get("name"):
            self.joints[element.attrib["name"]] = joint
        return joint

    def free(self, name: str | None, default: str) -> str:
        """Return an unused name; in MJCF a body, a joint and a tendon may have the same name."""
        name = default if name is None else name
        while name in self.taken:
            name = f"{default.split()[0]} {name}"
        self.taken.add(name)
        return name

    def _geom(self, given: dict[str, str], what: str, weighs: bool) -> Lump | None:
        """Return the mass of a geom in the frame of its body; None: the geom has no mass, or its kind is unknown."""
        if float(given.get("contype", 1)) or float(given.get("conaffinity", 1)):
            self.n_geoms += 1
        weighs = weighs and float(given.get("mass", given.get("density", 1.0))) > 0.0
        kind, compiler = given.get("type", "sphere"), self.compiler(given)
        if not weighs or int(float(given.get("group", 0))) not in compiler.groups or kind in UNWEIGHED:
            return None
        if kind != "mesh" and "mesh" not in given:
            return geom_lump(given, what, compiler.degrees, compiler.sequence)
        triangles, inertia = self._mesh(given.get("mesh", ""))
        if triangles is None:
            asset = self.meshes.get(given.get("mesh", ""), given)
            file = f"file {asset.get('file')!r} is missing or" if asset.get("file") else "is"
            self.ignored.append(f"the mass of {what}, whose mesh {file} not of a kind that is read (STL, OBJ, MSH)")
            return None
        pose, lump = self.pose(given, what), mesh_lump(triangles, inertia)
        if kind in FITTED:
            size, inner = fitted(triangles, inertia, kind, compiler.by_box)
            own = {name: given[name] for name in ("mass", "density", "shellinertia") if name in given}
            size *= float(given.get("fitscale", 1.0))
            at_origin = geom_lump(own | {"type": kind, "size": text_of(size)}, what, True, "xyz")
            return None if at_origin is None else at_origin.transformed(pose.then(inner))
        mass = float(given["mass"]) if "mass" in given else float(given.get("density", 1000.0)) * lump.mass
        return replace(lump, mass=mass, J=mass / lump.mass * lump.J).transformed(pose) if lump.mass else None

    def _mesh(self, name: str) -> tuple[Array | None, str]:
        """Return the triangles of a mesh, and how its mass is computed from them."""
        if name not in self.meshes:
            return None, "legacy"
        given = self.attributes(self.meshes[name], "main")
        compiler, inertia = self.compiler(given), given.get("inertia", "legacy")
        if compiler.strip and "file" in given:
            given["file"] = Path(given["file"]).name
        if name not in self.triangles:
            self.triangles[name] = mesh_triangles(given, compiler.folder, f"mesh {name!r}")
            if inertia == "convex" and int(given.get("maxhullvert", -1)) > 0:
                self.ignored.append(f"maxhullvert of mesh {name!r}, for the mass of its geoms")
        return self.triangles[name], inertia

    def _inertial(self, element: Element, body: str) -> Lump:
        what = f"inertial of body {body!r}"
        given = dict(element.attrib)
        if "mass" not in given:
            raise ValueError(f"{what} needs a mass")
        if "fullinertia" in given:
            J = tensor_of(*numbers(given["fullinertia"], 6, f"fullinertia of {what}"))
        else:
            J = np.diag(numbers(given.get("diaginertia", ""), 3, f"diaginertia of {what}"))
        return Lump(float(given["mass"]), np.zeros(3), J, principal_axes(J)).transformed(self.pose(given, what))

    def site(self, name: str) -> tuple[Part | None, Array]:
        """Return the part and the position of a site."""
        if name not in self.sites:
            raise ValueError(f"the site {name!r} is not in the file")
        return self.sites[name]

    def frame(self, name: str) -> tuple[Part | None, Pose]:
        """Return the part and the frame of a body."""
        if name not in self.frames:
            raise ValueError(f"the body {name!r} is not in the file")
        return self.frames[name]


def _merged(inherited: Mapping[str, str], own: Mapping[str, str]) -> dict[str, str]:
    """Merge attributes of an element into its defaults; keep one orientation, and defaults of sizes not given."""
    kept = {key: value for key, value in inherited.items() if key not in TURNS or not own.keys() & TURNS}
    sizes = own.get("size", "").split()
    sizes += inherited.get("size", "").split()[len(sizes) :]
    return {**kept, **own, **({"size": " ".join(sizes)} if sizes else {})}
