"""Translation of the joints of an MJCF body, which may have several, to one joint of a model."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from twoloop.bodies.mjcf_geometry import Lump, Pose, combined
from twoloop.bodies.parts import Body, ModelJoint
from twoloop.bodies.spatial_model import SpatialModel
from twoloop.checks.arguments import Array

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


def body_of(model: SpatialModel, part: Part | None) -> Body:
    """Return the body of a part; the ground for None."""
    body = model.ground if part is None else part.body
    assert body is not None
    return body


def add_part(model: SpatialModel, part: Part) -> ModelJoint | None:
    """Add the body of a part and its joint to a model; return the joint, or None if the body is free."""
    lump = combined(part.lumps)
    if not lump.mass > 0.0:
        raise ValueError(f"the body {part.name!r} has joints but no mass: give it an <inertial>, or a geom with volume")
    R = part.pose.R
    part.body = model.body(part.name, mass=lump.mass, inertia=R.T @ lump.J @ R, position=lump.centre, rotation=R)
    return add_joints(model, body_of(model, part.parent), part.body, part.freed)


def add_joints(model: SpatialModel, parent: Body, child: Body, freed: list[FileJoint]) -> ModelJoint | None:
    """Add the joint equivalent to several MJCF joints; return it, or None if the body is free.

    Raises
    ------
    ValueError
        If a model has no such joint.
    """
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


def _parallel(one: FileJoint, other: FileJoint) -> bool:
    return float(np.abs(np.cross(one.axis, other.axis)).max()) < SAME


def _across(one: FileJoint, other: FileJoint) -> bool:
    return abs(float(one.axis @ other.axis)) < SAME
