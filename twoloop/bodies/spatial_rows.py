"""Constraint rows of spatial joints, from unit vectors in the axes of bodies."""

from __future__ import annotations

import numpy as np

from twoloop.bodies.parameter_layout import PERPENDICULAR, PLANE
from twoloop.bodies.parts import Body, JointRow, Numbers
from twoloop.bodies.rotation import perpendiculars
from twoloop.checks.arguments import Array


def across(a: Body, one: Array, b: Body, other: Array) -> JointRow:
    """Keep a direction of a perpendicular to one of b."""
    return JointRow(PERPENDICULAR, 1, a, b, Numbers(tuple(one)), Numbers(tuple(other)))


def parallel(a: Body, one: Array, b: Body, other: Array) -> tuple[JointRow, ...]:
    """Keep a direction of a parallel to one of b."""
    return tuple(across(a, each, b, other) for each in perpendiculars(one))


def on_line(a: Body, one: Array, b: Body, on_a: Numbers, on_b: Numbers) -> tuple[JointRow, ...]:
    """Keep a point of b on a line of a."""
    return tuple(JointRow(PLANE, 1, a, b, Numbers(tuple(each)), on_b, on_a) for each in perpendiculars(one))


def relative(a: Body, one: Array, b: Body, other: Array) -> Array:
    """Return the rotation of b relative to a that aligns their axes and is nearest to the one given."""
    given: Array = a.rotation.T @ b.rotation
    there = given @ other
    turn, c = np.cross(there, one), float(there @ one)
    if c < 0.0 and np.linalg.norm(turn) < 1e-6:  # opposite axes: half a turn about any perpendicular direction
        half = perpendiculars(one)[0]
        return np.asarray((2.0 * np.outer(half, half) - np.eye(3)) @ given)
    cross = np.array([[0.0, -turn[2], turn[1]], [turn[2], 0.0, -turn[0]], [-turn[1], turn[0], 0.0]])
    return np.asarray((np.eye(3) + cross + cross @ cross / (1.0 + c)) @ given)
