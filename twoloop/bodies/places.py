"""Vectors and points of bodies in space, for numbers or symbols."""

from __future__ import annotations

from typing import Any

import numpy as np

from twoloop.bodies.parts import Body
from twoloop.checks.arguments import Array


def turned(q: Any, body: Body, vector: Any) -> list[Any]:
    """Transform a vector from body axes to space, for numbers or symbols."""
    if body.number < 0:
        return list(vector)
    if len(vector) == 2:
        s, c = np.sin(q[body.coordinates[2]]), np.cos(q[body.coordinates[2]])
        return [c * vector[0] - s * vector[1], s * vector[0] + c * vector[1]]
    w, *e = (q[j] for j in body.coordinates[3:])
    across = [e[i - 2] * vector[i - 1] - e[i - 1] * vector[i - 2] + w * vector[i] for i in range(3)]  # e x a + w a
    return [vector[i] + 2.0 * (e[i - 2] * across[i - 1] - e[i - 1] * across[i - 2]) for i in range(3)]


def placed(q: Any, body: Body, place: Array) -> list[Any]:
    """Transform a point from body axes to space."""
    moved = turned(q, body, place)
    return moved if body.number < 0 else [q[j] + x for j, x in zip(body.coordinates, moved, strict=False)]
