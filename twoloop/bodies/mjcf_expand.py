"""Expand MJCF files: included files are inserted, and replicated elements written out as frames."""

from __future__ import annotations

import copy
import os
import xml.etree.ElementTree as ElementTree
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np

from twoloop.bodies.file_parts import Pose, numbers, pose_of, root_of, text_of
from twoloop.bodies.rotation import euler_parameters

DEEPEST = 30  # files within files: more are taken for a cycle


def expanded(path: str | os.PathLike[str]) -> Element:
    """Return the root element of an MJCF file with all files included and all replicates written out."""
    root = root_of(path, "mujoco")
    _include(root, Path(path).parent, 0)
    compiler = compiler_of(root)
    degrees, sequence = compiler.get("angle", "degree") == "degree", compiler.get("eulerseq", "xyz")
    for world in root.findall("worldbody"):
        _replicate(root, world, degrees, sequence)
    return root


def compiler_of(root: Element) -> dict[str, str]:
    """Return the settings of the compiler, of which the last ones hold."""
    return {key: value for each in root.findall("compiler") for key, value in each.attrib.items()}


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
        try:
            included = ElementTree.parse(path).getroot()
        except ElementTree.ParseError as error:
            raise ValueError(f"the included file {str(path)!r} is not XML: {error}") from None
        _include(included, folder, depth + 1)
        children += list(included)
    element[:] = children


def _replicate(root: Element, element: Element, degrees: bool, sequence: str) -> None:
    """Replace the replicates below an element by frames, innermost first; each is relative to the one before it."""
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
        turn = pose_of({"euler": child.get("euler", "0 0 0")}, "a <replicate>", degrees, sequence)
        step, pose = Pose(offset, turn.R), Pose(np.zeros(3), np.eye(3))
        named = {each.get("name", "") for part in child for each in part.iter()} - {""}
        digits, separator = len(str(int(count) - 1)), child.get("sep", "")
        suffixes = [f"{separator}{number:0{digits}d}" for number in range(int(count))]
        for suffix in suffixes:
            frame = Element("frame", pos=text_of(pose.x), quat=text_of(euler_parameters(pose.R)))
            frame.extend(copy.deepcopy(list(child)))
            for each in frame.iter():
                if each.get("name"):
                    each.set("name", each.attrib["name"] + suffix)
            children.append(frame)
            pose = pose.then(step)
        sections = [each for each in root if each.tag not in ("worldbody", "default", "asset", "compiler", "option")]
        for section in sorted(sections, key=lambda each: each.tag != "tendon"):  # which others refer to
            referring = [each for each in section if _refers(each, named)]
            named |= {each.get("name", "") for each in referring if section.tag == "tendon"} - {""}
            others = [each for each in section if each not in referring]
            section[:] = others + [_renamed(each, named, suffix) for suffix in suffixes for each in referring]
    element[:] = children


def _refers(element: Element, named: set[str]) -> bool:
    """Return True if an element refers to replicated ones."""
    parts = element.iter()
    return any(value in named for part in parts for key, value in part.attrib.items() if key not in ("name", "class"))


def _renamed(element: Element, named: set[str], suffix: str) -> Element:
    """Return a copy of an element that refers to replicated ones, with a suffix to its name and theirs."""
    copied = copy.deepcopy(element)
    for part in copied.iter():
        for key, value in part.attrib.items():
            if (key == "name" and part is copied) or (key not in ("name", "class") and value in named):
                part.set(key, value + suffix)
    return copied
