"""Where the bodies of a model are: poses from coordinates, and how far joints gape."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from twoloop.mechanisms.rotation import rotation_matrix

Array = NDArray[np.float64]

POINTS_STAY = ("revolute", "spherical", "universal", "fixed")  # kinds of joints that keep two points together


def poses(model: Any, q: Array) -> tuple[Array, Array]:
    """Centres of mass (n_t, n, d) and axes (n_t, n, d, d), as columns, of coordinates (n_t, n_q) in d dimensions."""
    d = model.dimension
    parts = q.reshape(len(q), len(model.bodies), 3 if d == 2 else 7)
    R = np.empty((*parts.shape[:2], d, d))
    if d == 2:
        s, c = np.sin(parts[..., 2]), np.cos(parts[..., 2])
        R[..., 0, 0], R[..., 0, 1], R[..., 1, 0], R[..., 1, 1] = c, -s, s, c
    else:
        for place in np.ndindex(parts.shape[:2]):
            e = parts[place][3:]
            R[place] = rotation_matrix(e / np.linalg.norm(e))
    return parts[..., :d], R


def gaps(model: Any, x: Array, R: Array) -> Array:
    """Largest distance between points that joints put together, m, at each instant (n_t,); of slides, across them."""
    found = np.zeros(len(x))
    for joint in model.joints:
        slides = joint.kind in ("prismatic", "cylindrical") and len(joint.axes) > 0
        if joint.kind not in POINTS_STAY and not slides:
            continue
        apart = _place(joint.b, joint.point_b, x, R) - _place(joint.a, joint.point_a, x, R)
        if slides:
            along = joint.axes[0] if joint.a.number < 0 else R[:, joint.a.number] @ joint.axes[0]
            apart = apart - np.sum(apart * along, axis=1)[:, None] * along
        found = np.maximum(found, np.linalg.norm(apart, axis=1))
    return found


def _place(body: Any, point: Any, x: Array, R: Array) -> Array:
    own = np.array(point.values)
    return np.broadcast_to(own, x[:, 0].shape) if body.number < 0 else x[:, body.number] + R[:, body.number] @ own
