"""Drawings of models: bodies as lines between their joints, springs as lines."""

from __future__ import annotations

import numpy as np

from twoloop.bodies.parameter_layout import PULL, SPRING
from twoloop.bodies.parts import Body
from twoloop.bodies.points import Sketch
from twoloop.bodies.tables import Tables
from twoloop.checks.arguments import Array
from twoloop.problem.description import Drawing


def drawing_of(tables: Tables) -> Drawing:
    """Return bodies as lines between joints; with one joint from the centre of mass to it, without joints as a box."""
    sketch = Sketch()
    ends: dict[str, list[Array]] = {body.name: [] for body in tables.bodies}
    for joint in tables.joints:
        for body, numbers in ((joint.a, joint.point_a), (joint.b, joint.point_b)):
            place = tables.of(numbers).copy()
            if body.name not in ends:
                sketch.point(body.number, place)
            elif not any(np.abs(place - other).max() < 1e-12 for other in ends[body.name]):
                ends[body.name].append(place)
    for body in tables.bodies:
        sketch.add_body(body.number, ends[body.name], 0.0, _size(body))
    for joint in tables.joints:
        if joint.kind == "revolute" and joint.a.number >= 0 and joint.b.number >= 0:
            sketch.trace(joint.a.number, tables.of(joint.point_a).copy())
    for force in tables.forces:
        if force.kind in (SPRING, PULL):
            assert force.on_first is not None and force.on_second is not None
            one, other = tables.of(force.on_first), tables.of(force.on_second)
            sketch.line((force.first.number, one.copy()), (force.second.number, other.copy()))
    return sketch.drawing


def _size(body: Body) -> Array:
    """Return the edges of the box or square with the mass and moments of inertia of a body."""
    mass, moments = body.inertia[0], body.inertia[1:4]
    if len(moments) == 1:
        return np.full(2, np.sqrt(6.0 * moments[0] / mass))
    return np.asarray(np.sqrt(np.maximum(6.0 * (moments.sum() - 2.0 * moments) / mass, 0.0)))
