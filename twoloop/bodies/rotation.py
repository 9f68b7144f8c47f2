"""Rotate by Euler parameters e = (e0, e1, e2, e3): compiled helpers, then functions that also take symbols.

R(e) a = (e0^2 - f.f) a + 2 f (f.a) + 2 e0 f x a with f = (e1, e2, e3) is quadratic in e. So the acceleration of
a body-fixed vector for e'' = 0 is twice R(e') a. See Nikravesh, Computer-Aided Analysis of Mechanical
Systems (1988), Sect. 6.
"""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from twoloop.kernels.compile.caches import helper
from twoloop.problem.problem import Array

Components = list[Any]  # of a vector: numbers, columns of numbers, or symbols


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
