"""Expand MJCF files: included files and attached models are inserted, and replicates written out as frames."""

from __future__ import annotations

import copy
import os
from dataclasses import dataclass
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np

from twoloop.bodies.file_parts import numbers, parsed, pose_of, root_of, text_of
from twoloop.bodies.rotation import euler_parameters

DEEPEST = 30  # deeper levels of files within files count as a cycle
MODEL = "model attached"  # attribute of elements of attached models; no file has one with a space
REFERENCES = {  # attributes by which elements refer to others
    **dict.fromkeys(("joint", "joint1", "joint2", "jointinparent"), "joint"),
    **dict.fromkeys(("body", "body1", "body2"), "body"),
    **dict.fromkeys(("site", "site1", "site2", "sidesite", "refsite", "cranksite", "slidersite"), "site"),
    **dict.fromkeys(("geom", "geom1", "geom2"), "geom"),
    **dict.fromkeys(("tendon", "tendon1", "tendon2"), "tendon"),
    **dict.fromkeys(("class", "childclass"), "class"),
    "mesh": "mesh",
}
OF_MODEL = ("class", "mesh")  # kinds of elements that all attached parts of a model share
KINDS = {"freejoint": "joint", "spatial": "tendon", "fixed": "tendon"}
UNATTACHED = {"compiler", "option", "size", "visual", "statistic", "custom", "keyframe", "worldbody", "extension"}


@dataclass(frozen=True)
class Compiler:
    """Settings of MuJoCo's compiler for the elements of a model; they also hold where it is attached."""

    degrees: bool
    sequence: str
    from_geoms: str
    groups: range
    folder: Path  # folder of the meshes
    strip: bool
    automatic: bool  # whether a range implies limits
    by_box: bool
    least_mass: float
    least_moment: float
    balance: bool
    align: bool  # whether frames of free bodies without children are aligned with the principal axes


def compiler_of(root: Element, folder: Path) -> Compiler:
    """Return the settings of the compiler; if a file repeats a setting, the last one holds."""
    given = {key: value for each in root.findall("compiler") for key, value in each.attrib.items()}
    if given.get("coordinate", "local") != "local":
        raise ValueError("coordinates of an MJCF file must be local; global ones were dropped by MuJoCo in 2.3.4")
    first, last = given.get("inertiagrouprange", "0 5").split()
    return Compiler(
        given.get("angle", "degree") == "degree",
        given.get("eulerseq", "xyz"),
        given.get("inertiafromgeom", "auto"),
        range(int(first), int(last) + 1),
        folder / given.get("meshdir", given.get("assetdir", "")),
        given.get("strippath", "false") == "true",
        given.get("autolimits", "true") == "true",
        given.get("fitaabb", "false") == "true",
        float(given.get("boundmass", 0.0)),
        float(given.get("boundinertia", 0.0)),
        given.get("balanceinertia", "false") == "true",
        given.get("alignfree", "false") == "true",
    )


def expanded(path: str | os.PathLike[str], depth: int = 0) -> tuple[Element, dict[str, Compiler]]:
    """Return the root element of an MJCF file with everything written out, and compilers by prefixes of models.

    Included files and attached models are inserted, and replicates are written out.
    """
    if depth > DEEPEST:
        raise ValueError(f"files must not attach each other: {os.fspath(path)!r} is attached within {DEEPEST} others")
    root, folder = root_of(path, "mujoco"), Path(path).parent
    _include(root, folder, 0)
    for each in root.findall("default"):
        if each.get("class", "main") != "main":
            raise ValueError(f"the outermost default class must be 'main'; given {each.get('class')!r}")
        each.set("class", "main")
    compilers = {"": compiler_of(root, folder)}
    for world in root.findall("worldbody"):
        _attach(root, world, folder, compilers, depth)
        _replicate(root, world, compilers[""].degrees, compilers[""].sequence)
    return root, compilers


def _attach(root: Element, element: Element, folder: Path, compilers: dict[str, Compiler], depth: int) -> None:
    """Replace the models attached below an element by frames, and copy the elements that act on them."""
    children: list[Element] = []
    for child in element:
        if child.tag != "attach":
            _attach(root, child, folder, compilers, depth)
            children.append(child)
            continue
        name, prefix = child.get("model"), child.get("prefix", "")
        source, inner = root, dict[str, Compiler]()
        if name is not None:
            source, inner = expanded(_file_of(root, name, folder), depth + 1)
            merging = [each.get("conflict", "warning") for each in root.findall("compiler")] or ["warning"]
            if merging[-1] != "warning" and source.find("option") is not None:
                raise ValueError(f"options of the attached model {name!r} are not merged: conflict={merging[-1]!r}")
        compilers |= {prefix + key: compiler for key, compiler in inner.items()}
        part = _part(source, child)
        acting = [copy.deepcopy(each) for each in source if each.tag not in UNATTACHED]
        acting = [each for each in acting if name is not None or each.tag not in ("asset", "default")]
        for each in [part, *acting]:
            _prefix(each, prefix, name is not None)
        trees = [*root.findall("worldbody"), *root.findall("tendon"), part]
        known = {(KINDS.get(each.tag, each.tag), each.get("name")) for tree in trees for each in tree.iter()}
        for section in sorted(acting, key=lambda each: each.tag != "tendon"):  # which others refer to
            if section.tag not in ("asset", "default"):
                section[:] = [each for each in section if _resolves(each, known)]
            known |= {("tendon", each.get("name")) for each in section if section.tag == "tendon"}
        root.extend(acting)
        children.append(part)
    element[:] = children


def _file_of(root: Element, name: str, folder: Path) -> Path:
    """Return the path of the file of an attached model."""
    for each in root.findall("asset/model"):
        path = folder / each.get("file", "")
        if name == each.get("name") or ("name" not in each.attrib and name == root_of(path, "mujoco").get("model")):
            return path
    raise ValueError(f"the attached model {name!r} is not among the assets")


def _part(source: Element, attach: Element) -> Element:
    """Return a frame that contains a copy of the attached body or frame, or of all bodies, and has its class."""
    for kind in ("body", "frame"):
        if kind in attach.attrib:
            found = [_found(world, kind, attach.attrib[kind], "main") for world in source.findall("worldbody")]
            part, name = next((each for each in found if each), (None, ""))
            if part is None:
                raise ValueError(f"the attached {kind} {attach.attrib[kind]!r} is not in its model")
            frame = Element("frame", childclass=name)
            frame.append(copy.deepcopy(part))
            return frame
    frame = Element("frame", childclass="main")
    for world in source.findall("worldbody"):
        frame.extend(copy.deepcopy(list(world)))
    return frame


def _found(element: Element, tag: str, name: str, childclass: str) -> tuple[Element, str] | None:
    """Find an element below another element; return it and the class that it inherits, or None."""
    for each in element:
        if each.tag == tag and each.get("name") == name:
            return each, childclass
        inner = _found(each, tag, name, each.get("childclass", childclass))
        if inner is not None:
            return inner
    return None


def _prefix(element: Element, prefix: str, other: bool) -> None:
    """Prefix the names in an element; names that belong to a model, only if this is another model (`other`)."""
    if element.tag in ("tendon", "equality", "actuator", "asset") and other:
        for each in element:
            each.set("class", each.get("class", "main"))
            if each.tag == "mesh" and "name" not in each.attrib:
                each.set("name", Path(each.get("file", "")).stem)
    for each in element.iter():
        if other:
            each.set(MODEL, prefix + each.get(MODEL, ""))
        for key, value in each.attrib.items():
            kind = REFERENCES.get(key)
            if key == "name" or (kind is not None and value != "world" and (other or kind not in OF_MODEL)):
                each.set(key, prefix + value)


def _resolves(element: Element, known: set[tuple[str, str | None]]) -> bool:
    """Return True if all elements to which an element refers are in a model (`known`)."""
    given = [each for part in element.iter() for each in part.attrib.items()]
    ends = [(REFERENCES[key], value) for key, value in given if key in REFERENCES and value != "world"]
    return all(kind in OF_MODEL or (kind, value) in known for kind, value in ends)


def _include(element: Element, folder: Path, depth: int) -> None:
    """Insert the files that the children of an element include; they are relative to the folder of the main file."""
    children: list[Element] = []
    for child in element:
        if child.tag != "include":
            _include(child, folder, depth)
            children.append(child)
            continue
        file = child.get("file")
        if not file:
            raise ValueError("an <include> must name its file: it has no attribute file")
        if depth > DEEPEST:
            raise ValueError(f"files must not include each other: {file!r} is included within {DEEPEST} others")
        path = folder / file
        if not path.is_file():
            raise FileNotFoundError(f"the file includes {file!r}, and there is no file {str(path)!r}")
        included = parsed(path)
        _include(included, folder, depth + 1)
        children += list(included)
    element[:] = children


def _replicate(root: Element, element: Element, degrees: bool, sequence: str) -> None:
    """Replace the replicates below an element by frames, innermost first; each begins where the one before it ends."""
    children: list[Element] = []
    for child in element:
        _replicate(root, child, degrees, sequence)
        if child.tag != "replicate":
            children.append(child)
            continue
        count = child.get("count", "")
        if not count.isdigit() or int(count) < 1:
            raise ValueError(f"count of a <replicate> must be a positive whole number; given {count!r}")
        offset = numbers(child.get("offset", "0 0 0"), 3, "offset of a <replicate>")
        turn, place = numbers(child.get("euler", "0 0 0"), 3, "euler of a <replicate>"), np.zeros(3)
        named = {each.get("name", "") for part in child for each in part.iter()} - {""}
        digits, separator = len(str(int(count) - 1)), child.get("sep", "")
        suffixes = [f"{separator}{number:0{digits}d}" for number in range(int(count))]
        for number, suffix in enumerate(suffixes):
            # the angles are multiplied, as in MuJoCo; with more than one axis, this differs from repeating the turn
            R = pose_of({"euler": text_of(number * turn)}, "a <replicate>", degrees, sequence).R
            frame = Element("frame", pos=text_of(place), quat=text_of(euler_parameters(R)))
            frame.extend(copy.deepcopy(list(child)))
            for each in frame.iter():
                if each.get("name"):
                    each.set("name", each.attrib["name"] + suffix)
            children.append(frame)
            place = place + R @ offset
        sections = [each for each in root if each.tag not in ("worldbody", "default", "asset", "compiler", "option")]
        for section in sorted(sections, key=lambda each: each.tag != "tendon"):  # which others refer to
            referring = [each for each in section if _refers(each, named)]
            named |= {each.get("name", "") for each in referring if section.tag == "tendon"} - {""}
            others = [each for each in section if each not in referring]
            section[:] = others + [_renamed(each, named, suffix) for suffix in suffixes for each in referring]
    element[:] = children


def _refers(element: Element, named: set[str]) -> bool:
    """Return True if an element refers to replicated elements."""
    parts = element.iter()
    return any(value in named for part in parts for key, value in part.attrib.items() if key not in ("name", "class"))


def _renamed(element: Element, named: set[str], suffix: str) -> Element:
    """Return a copy of an element, with a suffix added to its name and to the replicated names in it."""
    copied = copy.deepcopy(element)
    for part in copied.iter():
        for key, value in part.attrib.items():
            if (key == "name" and part is copied) or (key not in ("name", "class") and value in named):
                part.set(key, value + suffix)
    return copied
