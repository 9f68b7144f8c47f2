"""Transform vectors and points from body axes to space: for numbers, for columns of numbers, or for symbols."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from twoloop.checks.arguments import Array

GROUND = -1  # number of the ground, whose axes are those of space


def vector_of(q: Any, body: int, vector: Any) -> list[Any]:
    """Transform a vector of a body to space; q (n_q,) of numbers or symbols, or (n_q, n_t)."""
    if body == GROUND:
        return list(vector)
    if len(vector) == 2:
        s, c = np.sin(q[3 * body + 2]), np.cos(q[3 * body + 2])
        return [c * vector[0] - s * vector[1], s * vector[0] + c * vector[1]]
    w, *e = (q[7 * body + k] for k in range(3, 7))
    across = [e[i - 2] * vector[i - 1] - e[i - 1] * vector[i - 2] + w * vector[i] for i in range(3)]  # e x a + w a
    return [vector[i] + 2.0 * (e[i - 2] * across[i - 1] - e[i - 1] * across[i - 2]) for i in range(3)]


def point_of(q: Any, body: int, point: Any) -> list[Any]:
    """Transform a point of a body, relative to its centre of mass, to space."""
    arm, first = vector_of(q, body, point), (3 if len(point) == 2 else 7) * body
    return arm if body == GROUND else [q[first + i] + x for i, x in enumerate(arm)]


def angle_of(q: Any, body: int) -> Any:
    """Return the angle of a planar body; zero for the ground."""
    return 0.0 if body == GROUND else q[3 * body + 2]


def linear_points(matrix: Array, constant: Array, q: Array) -> Any:
    """Return points that are linear in the coordinates, at q (n_q,) or (n_q, n_t).

    Parameters
    ----------
    matrix : ndarray (n_points, 2 or 3, n_q)
    constant : ndarray (n_points, 2 or 3)
    """
    return np.tensordot(matrix, q, 1) + constant.reshape(*constant.shape, *(1,) * (q.ndim - 1))


def body_points(bodies: Sequence[int], points: Array, q: Array) -> Any:
    """Return points of bodies with coordinates x, y and an angle, or x, y, z and four Euler parameters.

    Parameters
    ----------
    bodies : sequence of int
        The body of each point; -1 is the ground.
    points : ndarray (n_points, 2 or 3)
        In body axes, relative to the centre of mass.
    q : ndarray (n_q,) or (n_q, n_t)
    """
    positions = [point_of(q, *each) for each in zip(bodies, points, strict=True)]
    return np.array([[np.broadcast_to(x, q.shape[1:]) for x in position] for position in positions])
