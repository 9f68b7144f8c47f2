"""Read models from MJCF, the format of MuJoCo: bodies, hinges, slides, balls; loops closed by connect and weld."""

from __future__ import annotations

import os
from typing import Any
from xml.etree.ElementTree import Element

import numpy as np

from twoloop.bodies.file_parts import (
    FileJoint,
    Lump,
    Part,
    Pose,
    add_part,
    body_of,
    geom_lump,
    numbers,
    pose_of,
    record_ignored,
    root_of,
    tensor_of,
    text_of,
)
from twoloop.bodies.parts import Body, ModelJoint
from twoloop.bodies.spatial.model import SpatialModel
from twoloop.checks.arguments import Array

SEEN_ONLY = {"asset", "visual", "statistic", "size", "custom", "camera", "light"}  # without effect on the motion
KNOWN = {"compiler", "option", "default", "worldbody", "equality", "tendon"}
SOFT = ("armature", "frictionloss")
DEFAULT_OF = {"spatial": "tendon", "fixed": "tendon", "connect": "equality", "weld": "equality"}  # elements of defaults
TURNS = {"quat", "axisangle", "xyaxes", "zaxis", "euler"}  # alternative orientations of an element
AGREES = 1e-6  # tolerance of the pose that a weld prescribes


def from_mjcf(path: str | os.PathLike[str]) -> SpatialModel:
    """Read a model from an MJCF file, in the reference pose of the file (qpos0).

    The reader supports bodies with inertials or with masses from their geoms; hinge, slide, ball and free joints, and
    the combinations for which `SpatialModel` has a joint; stiffness, damping, ref and springref of hinges and slides;
    the equalities connect and weld, which are exact here and soft in MuJoCo; tendons between two sites as springs; and
    gravity. Bodies without joints are merged with their parents.

    Parameters
    ----------
    path : path-like

    Returns
    -------
    SpatialModel
        `model.ignored` lists what was ignored: contacts, limits, actuators, armatures, ...

    Warns
    -----
    IgnoredWarning
        If anything was ignored.

    Raises
    ------
    ValueError
        If the file is not MJCF, includes other files, or has joints or welds that a model does not support.

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
    root = root_of(path, "mujoco")
    reader = _Reader(root)
    reader.read()
    record_ignored(path, reader.model, reader.ignored)
    return reader.model


class _Reader:
    def __init__(self, root: Element):
        self.root, self.ignored = root, list[str]()
        compiler = {key: value for each in root.findall("compiler") for key, value in each.attrib.items()}
        self.degrees, self.sequence = compiler.get("angle", "degree") == "degree", compiler.get("eulerseq", "xyz")
        self.from_geoms = compiler.get("inertiafromgeom", "auto")
        for key in ("settotalmass", "balanceinertia", "boundmass", "boundinertia", "alignfree"):
            if compiler.get(key, "0") not in ("0", "-1", "false"):
                self.ignored.append(f"{key} of the compiler")
        if compiler.get("inertiagrouprange", "0 5").split() != ["0", "5"]:
            self.ignored.append("inertiagrouprange of the compiler")
        if compiler.get("coordinate", "local") != "local":
            raise ValueError("coordinates of an MJCF file must be local; global ones were dropped by MuJoCo in 2.3.4")
        self.defaults: dict[str, dict[str, dict[str, str]]] = {"main": {}}
        for each in root.findall("default"):
            self._default(each, "main", self.defaults["main"])
        gravity = np.array([0.0, 0.0, -9.81])
        for each in root.findall("option"):
            gravity = numbers(each.get("gravity", "0 0 -9.81"), 3, "gravity") if each.get("gravity") else gravity
            for key in ("density", "viscosity", "wind"):
                if any(float(x) for x in each.get(key, "0").split()):
                    self.ignored.append(f"{key} of the surrounding medium")
        flags = {
            key: value for flag in root.findall("option/flag") for key, value in flag.attrib.items()
        }  # the last one counts
        disabled = {key for key, value in flags.items() if value == "disable"}
        gravity = np.zeros(3) if "gravity" in disabled else gravity
        self.without_loops = bool(disabled & {"constraint", "equality"})
        self.without = {"stiffness"} if "spring" in disabled else set()
        self.without |= {"damping"} if "damper" in disabled else set()
        self.without |= {"stiffness", "damping"} if "passive" in disabled else set()  # one flag, before MuJoCo 3.4
        self.model = SpatialModel(gravity, name=root.get("model", "MuJoCo Model"))
        self.frames: dict[str, tuple[Part | None, Pose]] = {"world": (None, Pose(np.zeros(3), np.eye(3)))}
        self.sites: dict[str, tuple[Part | None, Array]] = {}
        self.parts: list[Part] = []
        self.n_geoms = 0
        self.taken = {"ground", *(each.get("name", "") for each in root.iter("body"))}

    def read(self) -> None:
        """Read the whole file."""
        for each in self.root:
            if each.tag == "include":
                raise ValueError(
                    f"the file includes {each.get('file')!r}; write all into one file (MuJoCo saves such a one)"
                )
            if each.tag not in SEEN_ONLY | KNOWN:
                self.ignored += [f"{each.tag}: {_called(part)}" for part in each] or [each.tag]
        for each in self.root.findall("worldbody"):
            self._within(each, None, Pose(np.zeros(3), np.eye(3)), "main")
        for part in self.parts:
            self._add(part)
        for each in self.root.findall("equality"):
            for equality in each:
                self._equality(equality)
        for each in self.root.findall("tendon"):
            for tendon in each:
                self._tendon(tendon)
        if self.n_geoms > 1:
            self.ignored.append("contacts between geoms")

    def _default(self, element: Element, name: str, inherited: dict[str, dict[str, str]]) -> None:
        name = element.get("class", name)
        merged = {tag: dict(values) for tag, values in inherited.items()}
        for each in element:
            if each.tag != "default":
                merged[each.tag] = _merged(merged.get(each.tag, {}), each.attrib)
        self.defaults[name] = merged
        for each in element.findall("default"):
            self._default(each, name, merged)

    def _attributes(self, element: Element, childclass: str) -> dict[str, str]:
        name = element.get("class", childclass)
        if name not in self.defaults:
            raise ValueError(f"{_called(element)} is of the class {name!r}, which no default has")
        given = _merged(self.defaults[name].get(DEFAULT_OF.get(element.tag, element.tag), {}), element.attrib)
        return {key: value for key, value in given.items() if key not in self.without}

    def _pose(self, attributes: dict[str, str], what: str) -> Pose:
        return pose_of(attributes, what, self.degrees, self.sequence)

    def _within(self, element: Element, part: Part | None, pose: Pose, childclass: str) -> None:
        """Read the children of a body, or of the world."""
        lumps: list[Lump] = []
        inertial = element.find("inertial") if self.from_geoms != "true" else None
        weigh = part is not None and inertial is None and self.from_geoms != "false"  # mass from the geoms
        for each in element:
            given = self._attributes(each, childclass)
            if each.tag == "body":
                self._body(each, part, pose, each.get("childclass", childclass))
            elif each.tag == "geom":
                lump = self._geom(given, _called(each), weigh)
                lumps += [] if lump is None else [lump]
            elif each.tag == "site":
                if "fromto" in given:
                    ends = numbers(given["fromto"], 6, f"fromto of {_called(each)}")
                    given["pos"] = text_of(0.5 * (ends[:3] + ends[3:]))
                place = pose.point(self._pose(given, _called(each)).x)
                self.sites[each.get("name", f"site {len(self.sites)}")] = part, place
            elif each.tag in ("frame", "replicate", "attach", "composite", "flexcomp"):
                raise ValueError(f"<{each.tag}> is not read; MuJoCo saves a file in which it is written out")
            elif each.tag not in SEEN_ONLY | {"inertial", "joint", "freejoint"}:
                self.ignored.append(_called(each))
        if not weigh:
            lumps = [] if inertial is None else [self._inertial(inertial, element.get("name", "?"))]
        if part is not None:
            part.lumps += [lump.transformed(pose) for lump in lumps]

    def _body(self, element: Element, parent: Part | None, outer: Pose, childclass: str) -> None:
        name = element.get("name", f"body {len(self.frames)}")
        name = "ground of the file" if name == "ground" else name  # "ground" is reserved
        pose, part = outer.then(self._pose(dict(element.attrib), f"body {name!r}")), parent
        for key in ("mocap", "gravcomp"):
            if element.get(key, "0") not in ("0", "false"):
                self.ignored.append(f"{key} of body {name!r}")
        joints = [each for each in element if each.tag in ("joint", "freejoint")]
        if joints:
            part = Part(name, parent, pose)
            self.parts.append(part)
            for each in joints:
                part.freed.append(self._joint(each, pose, childclass, name, len(part.freed)))
        self.frames[element.get("name", name)] = part, pose
        self._within(element, part, pose, childclass)

    def _joint(self, element: Element, pose: Pose, childclass: str, body: str, number: int) -> FileJoint:
        given = self._attributes(element, childclass)
        name = self._free(element.get("name"), f"joint of {body}" if number == 0 else f"joint {number + 1} of {body}")
        kind = "free" if element.tag == "freejoint" else given.get("type", "hinge")
        limited = given.get("limited", "auto")
        if kind != "free" and (limited == "true" or (limited == "auto" and "range" in given)):
            self.ignored.append(f"limits of joint {name!r}")
        self._soft(given, f"joint {name!r}")
        if "springdamper" in given and any(float(x) for x in given["springdamper"].split()):
            self.ignored.append(f"springdamper of joint {name!r}")
        axis = numbers(given.get("axis", "0 0 1"), 3, f"axis of joint {name!r}")
        if not axis.any():
            raise ValueError(f"axis of joint {name!r} must have a direction; given {given['axis']!r}")
        place = numbers(given.get("pos", "0 0 0"), 3, f"pos of joint {name!r}")
        return FileJoint(name, kind, pose.point(place), pose.R @ axis / np.linalg.norm(axis), given)

    def _soft(self, given: dict[str, str], what: str) -> None:
        for key in SOFT:
            if any(float(x) for x in given.get(key, "0").split()):
                self.ignored.append(f"{key} of {what}")

    def _free(self, name: str | None, default: str) -> str:
        """Return an unused name; in MJCF a body, a joint and a tendon may share one."""
        name = default if name is None else name
        while name in self.taken:
            name = f"{default.split()[0]} {name}"
        self.taken.add(name)
        return name

    def _geom(self, given: dict[str, str], what: str, weighs: bool) -> Lump | None:
        if float(given.get("contype", 1)) or float(given.get("conaffinity", 1)):
            self.n_geoms += 1
        if given.get("shellinertia", "false") == "true" and weighs:
            self.ignored.append(f"shellinertia of {what}")
        kind = "mesh" if "mesh" in given else given.get("type", "sphere")  # else fitted to the mesh
        lump = geom_lump(given, what, self.degrees, self.sequence) if kind != "mesh" else None
        weighs = weighs and float(given.get("mass", given.get("density", 1.0))) > 0.0
        if lump is None and weighs and kind not in ("plane", "hfield"):
            self.ignored.append(f"the mass of {what}, which is a {kind}")
        return lump

    def _inertial(self, element: Element, body: str) -> Lump:
        what = f"inertial of body {body!r}"
        given = dict(element.attrib)
        if "mass" not in given:
            raise ValueError(f"{what} needs a mass")
        if "fullinertia" in given:
            J = tensor_of(*numbers(given["fullinertia"], 6, f"fullinertia of {what}"))
        else:
            J = np.diag(numbers(given.get("diaginertia", ""), 3, f"diaginertia of {what}"))
        return Lump(float(given["mass"]), np.zeros(3), J).transformed(self._pose(given, what))

    def _add(self, part: Part) -> None:
        """Add the body and the joint of a part."""
        joint = add_part(self.model, part)
        for freed in part.freed:
            self._springs(freed, joint)

    def _of(self, part: Part | None) -> Body:
        return body_of(self.model, part)

    def _springs(self, freed: FileJoint, joint: ModelJoint | None) -> None:
        """Add the spring and damper of a joint; it is unstressed at springref, and the pose of the file is ref."""
        stiffness, damping = (freed.attributes.get(key, "0").split() for key in ("stiffness", "damping"))
        if not any(float(x) for x in (*stiffness, *damping)):
            return
        if joint is None or joint.kind not in ("revolute", "prismatic") or len(stiffness) > 1 or len(damping) > 1:
            self.ignored.append(f"stiffness and damping of joint {freed.name!r}")
            return
        unit = np.pi / 180.0 if self.degrees and freed.kind == "hinge" else 1.0
        rest = unit * (float(freed.attributes.get("springref", 0.0)) - float(freed.attributes.get("ref", 0.0)))
        k, c = float(stiffness[0]), float(damping[0])
        if joint.kind == "revolute":
            self.model.torsion_spring(joint, stiffness=k, damping=c, angle=rest)
        else:
            self.model.axial_spring(joint, stiffness=k, damping=c, length=rest)

    def _equality(self, element: Element) -> None:
        given = self._attributes(element, "main")
        if self.without_loops or given.get("active", "true") == "false":
            return
        if element.tag not in ("connect", "weld"):
            self.ignored.append(f"equality: {_called(element)}")
            return
        if "site1" in given and element.tag == "weld":
            raise ValueError(f"{_called(element)} between sites is not read; give bodies")
        if "site1" in given:
            (part_1, point_1), (part_2, point_2) = (self._site(given[key]) for key in ("site1", "site2"))
            body_1, body_2 = self._of(part_1), self._of(part_2)
            at: Any = body_1.point(*body_1.local_point(point_1)), body_2.point(*body_2.local_point(point_2))
        else:
            frames = [self._frame(given[key]) if key in given else self.frames["world"] for key in ("body1", "body2")]
            body_1, body_2 = (self._of(part_1) for part_1, _ in frames)
            if element.tag == "connect":
                at = frames[0][1].point(numbers(given.get("anchor", ""), 3, f"anchor of {_called(element)}"))
        if element.tag == "connect":
            self.model.spherical(body_1, body_2, at=at, name=self._name_of(element, given, body_1, body_2))
            return
        if float(given.get("torquescale", 1.0)) == 0.0:
            raise ValueError(
                f"torquescale of {_called(element)} must not be zero: give a connect where bodies may turn"
            )
        wanted = numbers(given.get("relpose", "0 1 0 0 0 0 0"), 7, f"relpose of {_called(element)}")
        if wanted[3:].any():
            pose = pose_of({"pos": text_of(wanted[:3]), "quat": text_of(wanted[3:])}, _called(element), True, "xyz")
            asked = frames[0][1].then(pose)
            off = max(np.abs(asked.x - frames[1][1].x).max(), np.abs(asked.R - frames[1][1].R).max())
            if off > AGREES:
                raise ValueError(
                    f"relpose of {_called(element)} must be the one that the bodies have; it is off by {off:.3g}"
                )
        self.model.fixed(body_1, body_2, name=self._name_of(element, given, body_1, body_2))

    def _name_of(self, element: Element, given: dict[str, str], body_1: Body, body_2: Body) -> str:
        return self._free(given.get("name"), f"{element.tag} of {body_1.name} and {body_2.name}")

    def _tendon(self, element: Element) -> None:
        given = self._attributes(element, "main")
        rest = given.get("springlength", "-1").split()
        stiffness, damping = (given.get(key, "0") for key in ("stiffness", "damping"))
        plain = element.tag == "spatial" and [each.tag for each in element] == ["site", "site"]
        plain &= len(stiffness.split()) == 1 == len(damping.split())
        if not plain or len(rest) != 1 or given.get("limited", "false") == "true" or "range" in given:
            self.ignored.append(f"tendon: {_called(element)}")
            return
        self._soft(given, _called(element))
        (part_1, point_1), (part_2, point_2) = (self._site(each.get("site", "")) for each in element)
        length = None if float(rest[0]) < 0.0 else float(rest[0])
        if length is None and float(stiffness) and (moved := self._away(part_1) or self._away(part_2)):
            raise ValueError(
                f"{_called(element)} needs a springlength: MuJoCo takes that which it has where joints are at their "
                f"springref, and that of {moved!r} is not its ref"
            )
        body_1, body_2 = self._of(part_1), self._of(part_2)
        name = self._free(given.get("name"), f"spring of {body_1.name} and {body_2.name}")
        values: dict[str, Any] = {"stiffness": float(stiffness), "damping": float(damping), "length": length}
        self.model.spring(body_1, point_1, body_2, point_2, name=name, **values)

    def _away(self, part: Part | None) -> str:
        """Return the name of a joint between a part and the ground whose springref differs from its ref, or ""."""
        while part is not None:
            for freed in part.freed:
                spring, given = (float(freed.attributes.get(key, 0.0)) for key in ("springref", "ref"))
                if freed.kind in ("hinge", "slide") and spring != given:
                    return freed.name
            part = part.parent
        return ""

    def _site(self, name: str) -> tuple[Part | None, Array]:
        if name not in self.sites:
            raise ValueError(f"the site {name!r} is not in the file")
        return self.sites[name]

    def _frame(self, name: str) -> tuple[Part | None, Pose]:
        if name not in self.frames:
            raise ValueError(f"the body {name!r} is not in the file")
        return self.frames[name]


def _merged(inherited: dict[str, str], own: dict[str, str]) -> dict[str, str]:
    """Merge attributes of an element into its defaults; they have one orientation, and the last sizes stay."""
    kept = {key: value for key, value in inherited.items() if key not in TURNS or not own.keys() & TURNS}
    sizes = own.get("size", "").split()
    sizes += inherited.get("size", "").split()[len(sizes) :]
    return {**kept, **own, **({"size": " ".join(sizes)} if sizes else {})}


def _called(element: Element) -> str:
    return f"{element.tag} {element.get('name')!r}" if element.get("name") else element.tag
