"""Poses of the bodies of a model from its coordinates, and gaps of its joints."""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from twoloop.bodies.rotation import euler_parameters, rotation_matrix
from twoloop.checks.arguments import Array

POINTS_STAY = ("revolute", "spherical", "universal", "fixed")  # kinds of joints that keep two points coincident


def poses(model: Any, q: Array) -> tuple[Array, Array]:
    """Return centres of mass (n_t, n, d) and axes as columns (n_t, n, d, d), for d-dimensional q (n_t, n_q)."""
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


def coordinates(x: ArrayLike, R: ArrayLike) -> Array:
    """Return the coordinates of the problem of a `SpatialModel` for poses computed by another program.

    Parameters
    ----------
    x : array_like (n_t, n_bodies, 3)
        Centres of mass in the order of `model.bodies`, m.
    R : array_like (n_t, n_bodies, 3, 3)
        Rotation matrices; their columns are the axes of the bodies.

    Returns
    -------
    ndarray (n_t, 7 n_bodies)

    Raises
    ------
    ValueError
        If the shapes are inconsistent, or an R is not a rotation matrix.

    Examples
    --------
    >>> import numpy as np
    >>> from twoloop.audit import coordinates
    >>> x, R = np.array([[[0.0, 0.0, 1.0]]]), np.eye(3)[None, None]  # one time, one body
    >>> coordinates(x, R)
    array([[0., 0., 1., 1., 0., 0., 0.]])
    """
    x, R = np.asarray(x, dtype=float), np.asarray(R, dtype=float)
    if x.ndim != 3 or x.shape[2] != 3 or R.shape != (*x.shape, 3):
        raise ValueError(f"x must be (n_t, n_bodies, 3) and R (n_t, n_bodies, 3, 3); given {x.shape} and {R.shape}")
    e = [[euler_parameters(each) for each in row] for row in R]
    return np.concatenate([x, np.array(e)], axis=2).reshape(len(x), -1)


def gaps(model: Any, x: Array, R: Array) -> Array:
    """Return the largest distance (n_t,) of points that joints keep coincident, m; for slides, across the axis."""
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
