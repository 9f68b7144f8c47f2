"""Evaluate rates of rotation of bodies: for numbers, for columns of numbers, or for symbols."""

from __future__ import annotations

from typing import Any

import numpy as np

Components = list[Any]


def cross(a: Any, b: Any) -> Components:
    """Return the cross product of two vectors in space."""
    return [a[i - 2] * b[i - 1] - a[i - 1] * b[i - 2] for i in range(3)]


def parameters_of(q: Any, body: int, sign: float = 1.0) -> Components:
    """Return the Euler parameters of a body, or with sign -1 the Euler parameters of the inverse rotation."""
    if body < 0:
        return [1.0, 0.0, 0.0, 0.0]
    w, *e = (q[7 * body + k] for k in range(3, 7))
    return [w, *(sign * x for x in e)]


def euler_product(one: Any, other: Any) -> Components:
    """Return the Euler parameters of the composition of two rotations; `other` is applied first."""
    (w, *e), (u, *f) = one, other
    across = cross(e, f)
    return [w * u - sum(x * y for x, y in zip(e, f, strict=True)), *(w * f[i] + u * e[i] + across[i] for i in range(3))]


def rotated_by(parameters: Any, vector: Any) -> Components:
    """Return a vector rotated by Euler parameters."""
    w, *e = parameters
    across = [x + w * y for x, y in zip(cross(e, vector), vector, strict=True)]
    return [x + 2.0 * y for x, y in zip(vector, cross(e, across), strict=True)]


def in_body_axes(q: Any, body: int, point: Any) -> Components:
    """Transform a point from space to the axes of a body, relative to its centre of mass."""
    if body < 0:
        return list(point)
    if len(point) == 2:
        x, y = (each - q[3 * body + k] for k, each in enumerate(point))
        s, c = np.sin(q[3 * body + 2]), np.cos(q[3 * body + 2])
        return [c * x + s * y, c * y - s * x]
    return rotated_by(parameters_of(q, body, -1.0), [x - q[7 * body + k] for k, x in enumerate(point)])


def spin_of(q: Any, v: Any, body: int) -> Components:
    """Return the angular velocity of a body in space."""
    if body < 0:
        return [0.0, 0.0, 0.0]
    (w, *e), (u, *f) = parameters_of(q, body), parameters_of(v, body)
    across = cross(e, f)
    return [2.0 * (w * f[i] - u * e[i] + across[i]) for i in range(3)]


def rate_of_vector(q: Any, v: Any, body: int, vector: Any) -> Components:
    """Return the time derivative of a body-fixed vector, along the axes of space."""
    if body < 0:
        return [0.0] * len(vector)
    if len(vector) == 2:
        s, c, turn = np.sin(q[3 * body + 2]), np.cos(q[3 * body + 2]), v[3 * body + 2]
        return [-turn * (s * vector[0] + c * vector[1]), turn * (c * vector[0] - s * vector[1])]
    (w, *e), (u, *f) = parameters_of(q, body), parameters_of(v, body)
    turned = [x + w * vector[i] for i, x in enumerate(cross(e, vector))]  # of a + 2 e x (e x a + w a)
    turning = [x + u * vector[i] for i, x in enumerate(cross(f, vector))]
    return [2.0 * (x + y) for x, y in zip(cross(f, turned), cross(e, turning), strict=True)]
