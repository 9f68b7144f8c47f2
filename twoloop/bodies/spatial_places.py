"""Vectors and points of spatial bodies, their rates, and generalised forces: helpers of the callbacks.

Coordinates of a body: x, y, z of the centre of mass and Euler parameters; see `rotation`.
"""

import math

from twoloop.bodies.rotation import half_spin, pulled, rotated, rotated_rate, turned
from twoloop.kernels.data.common import exact, inlined

FARTHEST = -math.cos(0.95 * math.pi)  # 0.95 of a turn


@exact
def vector(q, body, x, y, z):
    """Return a body-fixed vector in space."""
    if body < 0:
        return x, y, z
    k = 7 * body + 3
    return rotated(q[k], q[k + 1], q[k + 2], q[k + 3], x, y, z)


@inlined
def vector_rate(q, v, body, x, y, z):
    """Return its time derivative, and 2 R(e') a, its second derivative for e'' = 0."""
    if body < 0:
        return 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    k = 7 * body + 3
    ux, uy, uz = rotated_rate(q[k], q[k + 1], q[k + 2], q[k + 3], v[k], v[k + 1], v[k + 2], v[k + 3], x, y, z)
    ax, ay, az = rotated(v[k], v[k + 1], v[k + 2], v[k + 3], x, y, z)
    return ux, uy, uz, 2.0 * ax, 2.0 * ay, 2.0 * az


@exact
def centre(q, body):
    """Return the centre of mass, or its velocity from v."""
    if body < 0:
        return 0.0, 0.0, 0.0
    return q[7 * body], q[7 * body + 1], q[7 * body + 2]


@exact
def turn_row(q, row, body, x, y, z, fx, fy, fz):
    """Add to a row (n_q,) the gradient of f . (vector of a body) in its Euler parameters."""
    if body >= 0:
        k = 7 * body + 3
        d0, d1, d2, d3 = pulled(q[k], q[k + 1], q[k + 2], q[k + 3], x, y, z, fx, fy, fz)
        row[k] += d0
        row[k + 1] += d1
        row[k + 2] += d2
        row[k + 3] += d3


@exact
def put_point_rows(q, rows, first, body, x, y, z, sign):
    """Store three rows (n_q,), the derivatives of a point of a body, or minus these."""
    if body >= 0:
        k = 7 * body + 3
        s, wx, wy, wz = turned(q[k], q[k + 1], q[k + 2], q[k + 3], sign * x, sign * y, sign * z)
        rows[first, k - 3] = rows[first + 1, k - 2] = rows[first + 2, k - 1] = sign
        rows[first, k], rows[first, k + 1], rows[first, k + 2], rows[first, k + 3] = wx, s, wz, -wy
        rows[first + 1, k], rows[first + 1, k + 1], rows[first + 1, k + 2], rows[first + 1, k + 3] = wy, -wz, s, wx
        rows[first + 2, k], rows[first + 2, k + 1], rows[first + 2, k + 2], rows[first + 2, k + 3] = wz, wy, -wx, s


@exact
def move_row(row, body, fx, fy, fz):
    """Add to a row the gradient of f . (centre of a body)."""
    if body >= 0:
        row[7 * body] += fx
        row[7 * body + 1] += fy
        row[7 * body + 2] += fz


@exact
def place(q, body, p, at):
    """Return the point of a body stored at index `at` of p."""
    x, y, z = vector(q, body, p[at], p[at + 1], p[at + 2])
    cx, cy, cz = centre(q, body)
    return cx + x, cy + y, cz + z


@inlined
def motion(q, v, body, p, at):
    """Return the velocity of that point and the part of its acceleration that does not depend on v'."""
    ux, uy, uz, ax, ay, az = vector_rate(q, v, body, p[at], p[at + 1], p[at + 2])
    cx, cy, cz = centre(v, body)
    return cx + ux, cy + uy, cz + uz, ax, ay, az


@exact
def velocity(q, v, body, p, at):
    """Return the velocity of that point."""
    if body < 0:
        return 0.0, 0.0, 0.0
    k = 7 * body + 3
    x, y, z = p[at], p[at + 1], p[at + 2]
    ux, uy, uz = rotated_rate(q[k], q[k + 1], q[k + 2], q[k + 3], v[k], v[k + 1], v[k + 2], v[k + 3], x, y, z)
    return v[k - 3] + ux, v[k - 2] + uy, v[k - 1] + uz


@exact
def push_row(q, row, body, p, at, fx, fy, fz):
    """Add to a row the derivative of f . (point of a body), i.e. the generalised force of f there."""
    move_row(row, body, fx, fy, fz)
    turn_row(q, row, body, p[at], p[at + 1], p[at + 2], fx, fy, fz)


@exact
def twist_row(q, row, body, x, y, z):
    """Add to a row the generalised force of a torque in space, 2 G^T R^T torque."""
    if body >= 0:
        k = 7 * body + 3
        e0, e1, e2, e3 = q[k], q[k + 1], q[k + 2], q[k + 3]
        x, y, z = rotated(e0, -e1, -e2, -e3, 2.0 * x, 2.0 * y, 2.0 * z)
        row[k] += -e1 * x - e2 * y - e3 * z
        row[k + 1] += e0 * x - e3 * y + e2 * z
        row[k + 2] += e3 * x + e0 * y - e1 * z
        row[k + 3] += -e2 * x + e1 * y + e0 * z


@exact
def spin(q, v, body):
    """Return the angular velocity in space."""
    if body < 0:
        return 0.0, 0.0, 0.0
    k = 7 * body + 3
    x, y, z = half_spin(q[k], q[k + 1], q[k + 2], q[k + 3], v[k], v[k + 1], v[k + 2], v[k + 3])
    return rotated(q[k], q[k + 1], q[k + 2], q[k + 3], 2.0 * x, 2.0 * y, 2.0 * z)


@exact
def parameters_of(q, body):
    """Return the Euler parameters."""
    if body < 0:
        return 1.0, 0.0, 0.0, 0.0
    k = 7 * body + 3
    return q[k], q[k + 1], q[k + 2], q[k + 3]


@exact
def product(a0, a1, a2, a3, b0, b1, b2, b3):
    """Return the Euler parameters of the composition of two rotations, the second one applied first."""
    return (
        a0 * b0 - a1 * b1 - a2 * b2 - a3 * b3,
        a0 * b1 + a1 * b0 + a2 * b3 - a3 * b2,
        a0 * b2 - a1 * b3 + a2 * b0 + a3 * b1,
        a0 * b3 + a1 * b2 - a2 * b1 + a3 * b0,
    )


@exact
def torsion(q, i, j, p, axis, zero, stiffness, angle):
    """Return the torque of a spring on the rotation of body j about an axis (3 numbers in p) of body i, minus an angle.

    The rotation is measured from the relative Euler parameters stored at `zero` in p. These are unique only within one
    turn to either side, where the angle would jump; the torque is NaN shortly before.
    """
    e0, e1, e2, e3 = parameters_of(q, i)
    b0, b1, b2, b3 = parameters_of(q, j)
    r0, r1, r2, r3 = product(e0, -e1, -e2, -e3, b0, b1, b2, b3)
    c, x, y, z = product(r0, r1, r2, r3, p[zero], -p[zero + 1], -p[zero + 2], -p[zero + 3])
    s = x * p[axis] + y * p[axis + 1] + z * p[axis + 2]
    r = math.sqrt(c * c + s * s)
    left = c + FARTHEST * r
    root = math.sqrt(stiffness * left)  # a damper without stiffness has no such limit
    return root * root / left * (4.0 * math.atan(s / (c + r)) - angle)
