"""Rotate by Euler parameters e = (e0, e1, e2, e3): helpers of compiled callbacks and of initial states.

R(e) a = (e0^2 - f.f) a + 2 f (f.a) + 2 e0 f x a with f = (e1, e2, e3) is quadratic in e. So the acceleration of
a body-fixed vector for e'' = 0 is twice R(e') a. See Nikravesh, Computer-Aided Analysis of Mechanical
Systems (1988), Sect. 6.
"""

import numpy as np
from numpy.typing import ArrayLike

from twoloop.kernels.compile.caches import helper
from twoloop.problem.problem import Array


@helper
def rotated(e0, e1, e2, e3, x, y, z):
    """Return R(e) (x, y, z), homogeneous of degree two in e."""
    d = e0 * e0 - e1 * e1 - e2 * e2 - e3 * e3
    s = 2.0 * (e1 * x + e2 * y + e3 * z)
    return (
        d * x + s * e1 + 2.0 * e0 * (e2 * z - e3 * y),
        d * y + s * e2 + 2.0 * e0 * (e3 * x - e1 * z),
        d * z + s * e3 + 2.0 * e0 * (e1 * y - e2 * x),
    )


@helper
def rotated_rate(e0, e1, e2, e3, u0, u1, u2, u3, x, y, z):
    """Return the time derivative of R(e) (x, y, z) for e' = u."""
    d = 2.0 * (e0 * u0 - e1 * u1 - e2 * u2 - e3 * u3)
    s = 2.0 * (e1 * x + e2 * y + e3 * z)
    r = 2.0 * (u1 * x + u2 * y + u3 * z)
    return (
        d * x + r * e1 + s * u1 + 2.0 * (e0 * (u2 * z - u3 * y) + u0 * (e2 * z - e3 * y)),
        d * y + r * e2 + s * u2 + 2.0 * (e0 * (u3 * x - u1 * z) + u0 * (e3 * x - e1 * z)),
        d * z + r * e3 + s * u3 + 2.0 * (e0 * (u1 * y - u2 * x) + u0 * (e1 * y - e2 * x)),
    )


@helper
def turned(e0, e1, e2, e3, x, y, z):
    """Return s, w = 2 (f.a, e0 a + f x a) with f = (e1, e2, e3), which yield the derivatives of R(e) a by e.

    The derivative by e0 is w; the derivative of component i by f_j is s if i = j, else the third component of w, +/-.
    """
    x, y, z = 2.0 * x, 2.0 * y, 2.0 * z
    return e1 * x + e2 * y + e3 * z, e0 * x + e2 * z - e3 * y, e0 * y + e3 * x - e1 * z, e0 * z + e1 * y - e2 * x


@helper
def pulled(e0, e1, e2, e3, x, y, z, fx, fy, fz):
    """Return the gradient by e of f . R(e) (x, y, z), i.e. the generalised force of f at the point (x, y, z)."""
    s, wx, wy, wz = turned(e0, e1, e2, e3, x, y, z)
    return (
        wx * fx + wy * fy + wz * fz,
        s * fx + wy * fz - wz * fy,
        s * fy + wz * fx - wx * fz,
        s * fz + wx * fy - wy * fx,
    )


@helper
def half_spin(e0, e1, e2, e3, u0, u1, u2, u3):
    """Return G(e) u, half the angular velocity in body axes for e' = u."""
    return (
        -e1 * u0 + e0 * u1 + e3 * u2 - e2 * u3,
        -e2 * u0 - e3 * u1 + e0 * u2 + e1 * u3,
        -e3 * u0 + e2 * u1 - e1 * u2 + e0 * u3,
    )


def G(e: ArrayLike) -> Array:
    """Return the matrix G (3, 4) of e: the angular velocity in body axes is 2 G e'."""
    e0, e1, e2, e3 = np.asarray(e, dtype=float)
    return np.array([[-e1, e0, e3, -e2], [-e2, -e3, e0, e1], [-e3, e2, -e1, e0]])


def rotation_matrix(e: ArrayLike) -> Array:
    """Return R (3, 3) for unit Euler parameters; its columns are the body axes."""
    e = np.asarray(e, dtype=float)
    f = e[1:]
    cross = np.array([[0.0, -f[2], f[1]], [f[2], 0.0, -f[0]], [-f[1], f[0], 0.0]])
    return (e[0] ** 2 - f @ f) * np.eye(3) + 2.0 * np.outer(f, f) + 2.0 * e[0] * cross


def euler_parameters(R: ArrayLike) -> Array:
    """Return unit Euler parameters (4,) of a rotation matrix, with e0 > 0, or the largest positive if e0 is zero.

    Raises
    ------
    ValueError
        If `R` is not a rotation matrix.
    """
    R = np.asarray(R, dtype=float)
    if R.shape != (3, 3) or not np.abs(R.T @ R - np.eye(3)).max() <= 1e-9 or np.linalg.det(R) < 0.0:
        raise ValueError(f"R must be a rotation matrix (3, 3), orthonormal and right-handed; given {R!r}")
    # take the column of 4 e e^T with the largest diagonal entry: it is free of cancellation
    d = R[0, 0] + R[1, 1] + R[2, 2]
    E = np.empty((4, 4))
    E[0, 0] = 1.0 + d
    for i in range(3):
        E[i + 1, i + 1] = 1.0 + 2.0 * R[i, i] - d
        j, k = (i + 1) % 3, (i + 2) % 3
        E[0, i + 1] = E[i + 1, 0] = R[k, j] - R[j, k]
        E[j + 1, k + 1] = E[k + 1, j + 1] = R[j, k] + R[k, j]
    column = E[:, int(np.argmax(np.diag(E)))]
    e = column / np.linalg.norm(column)
    return -e if e[0] < -1e-8 else e


def euler_rates(e: ArrayLike, spin: ArrayLike) -> Array:
    """Return e' (4,) for an angular velocity (3,) in space."""
    return 0.5 * G(e).T @ (rotation_matrix(e).T @ np.asarray(spin, dtype=float))


def perpendiculars(axis: Array) -> tuple[Array, Array]:
    """Return two unit vectors perpendicular to a unit axis and to each other, right-handed with it."""
    first = np.cross(axis, np.eye(3)[int(np.argmin(np.abs(axis)))])
    first /= np.linalg.norm(first)
    return first, np.cross(axis, first)
