"""Evaluate points, vectors and generalised forces of bodies, in the plane and in space: helpers of compiled callbacks.

Vectors are tuples of three numbers; in the plane the third one is zero, or one for an axis. `w` is the number
of coordinates of a body: 3 in the plane (x, y of the centre of mass and the angle), 7 in space (x, y, z and the Euler
parameters, see `rotation`). A vector of a body is given twice: in the axes of the body (rates and gradients of bodies
in space need it), and in space (rates and gradients in the plane need it). Gradients are added to a row from column `c`
on, where the coordinates of the body begin; c is -w for the ground.
"""

import math

from numba import njit

from twoloop.bodies import parameter_layout as layout
from twoloop.bodies.rotation import half_spin, pulled, rotated, rotated_rate, turned
from twoloop.kernels.compile.linking import HelperCompiler
from twoloop.kernels.data.common import OPTIONS

# LLVM inlines these functions: a call with several arrays takes longer than most of them, and where LLVM knows the
# number of coordinates of a body, it drops the branches of the other dimension. Floating-point operations keep their
# order, so that the callbacks that share these functions give equal numbers.
_KEPT = {"fastmath": False, "forceinline": True, "no_cpython_wrapper": True, "no_cfunc_wrapper": True}
merged = njit(**{**OPTIONS, **_KEPT, "pipeline_class": HelperCompiler})

PLANAR = 3  # coordinates of a body in the plane


@merged
def coordinates_of(p):
    """Return the number of coordinates of a body."""
    return int(p[p.size - layout.HEAD + layout.COORDINATES])


@merged
def numbers(p, w, at):
    """Return the vector stored at index `at` of p."""
    if w == PLANAR:
        return p[at], p[at + 1], 0.0
    return p[at], p[at + 1], p[at + 2]


@merged
def dot(a, b):
    """Return the scalar product of two vectors."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@merged
def times(factor, a):
    """Return a multiple of a vector."""
    return factor * a[0], factor * a[1], factor * a[2]


@merged
def plus(a, b):
    """Return the sum of two vectors."""
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


@merged
def minus(a, b):
    """Return the difference of two vectors."""
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


@merged
def cross(a, b):
    """Return the vector product of two vectors."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@merged
def vector(q, w, body, a):
    """Return a body-fixed vector in space."""
    if body < 0:
        return a
    k = w * body
    if w == PLANAR:
        s, c = math.sin(q[k + 2]), math.cos(q[k + 2])
        return c * a[0] - s * a[1], s * a[0] + c * a[1], a[2]
    return rotated(q[k + 3], q[k + 4], q[k + 5], q[k + 6], a[0], a[1], a[2])


@merged
def rate_of(q, v, w, body, a, arm):
    """Return the time derivative of a body-fixed vector."""
    if body < 0:
        return 0.0, 0.0, 0.0
    if w == PLANAR:
        spin = v[3 * body + 2]
        return -spin * arm[1], spin * arm[0], 0.0
    k = 7 * body + 3
    return rotated_rate(q[k], q[k + 1], q[k + 2], q[k + 3], v[k], v[k + 1], v[k + 2], v[k + 3], a[0], a[1], a[2])


@merged
def bias_of(v, w, body, a, arm):
    """Return the part of the second time derivative of a body-fixed vector that does not depend on v'."""
    if body < 0:
        return 0.0, 0.0, 0.0
    if w == PLANAR:
        spin = v[3 * body + 2]
        return -spin * spin * arm[0], -spin * spin * arm[1], 0.0
    k = 7 * body + 3
    return times(2.0, rotated(v[k], v[k + 1], v[k + 2], v[k + 3], a[0], a[1], a[2]))


@merged
def centre(q, w, body):
    """Return the centre of mass; with v in place of q, its velocity."""
    if body < 0:
        return 0.0, 0.0, 0.0
    k = w * body
    return q[k], q[k + 1], (0.0 if w == PLANAR else q[k + 2])


@merged
def angle_of(q, body):
    """Return the angle of a body in the plane; with v in place of q, its rate."""
    if body < 0:
        return 0.0
    return q[3 * body + 2]


@merged
def axis(q, w, body, p, at):
    """Return a direction of a body in its axes and in space; in the plane p contains its angle from the x axis.

    For a hinge in the plane, p contains no direction: its axis is perpendicular to the plane.
    """
    if w == PLANAR:
        if at < 0:
            return (0.0, 0.0, 1.0), (0.0, 0.0, 1.0)
        total = p[at] + angle_of(q, body)
        return (0.0, 0.0, 0.0), (math.cos(total), math.sin(total), 0.0)
    a = p[at], p[at + 1], p[at + 2]
    return a, vector(q, w, body, a)


@merged
def move_row(row, w, c, f):
    """Add to a row the gradient of f . (centre of a body)."""
    if c > -w:
        row[c] += f[0]
        row[c + 1] += f[1]
        if w != PLANAR:
            row[c + 2] += f[2]


@merged
def turn_row(q, row, w, body, c, a, arm, f):
    """Add to a row the gradient of f . (vector of a body) in its angle or Euler parameters."""
    if body < 0:
        return
    if w == PLANAR:
        row[c + 2] += f[1] * arm[0] - f[0] * arm[1]
        return
    k = 7 * body + 3
    d0, d1, d2, d3 = pulled(q[k], q[k + 1], q[k + 2], q[k + 3], a[0], a[1], a[2], f[0], f[1], f[2])
    row[c + 3] += d0
    row[c + 4] += d1
    row[c + 5] += d2
    row[c + 6] += d3


@merged
def push_row(q, row, w, body, c, a, arm, f):
    """Add to a row the gradient of f . (point of a body), i.e. the generalised force of f at this point."""
    move_row(row, w, c, f)
    turn_row(q, row, w, body, c, a, arm, f)


@merged
def put_point_rows(q, rows, first, w, body, c, a, arm, sign):
    """Store the derivatives of a point of a body, times `sign`, in two or three rows."""
    if body < 0:
        return
    if w == PLANAR:
        rows[first, c] = rows[first + 1, c + 1] = sign
        rows[first, c + 2], rows[first + 1, c + 2] = -sign * arm[1], sign * arm[0]
        return
    k = 7 * body + 3
    s, wx, wy, wz = turned(q[k], q[k + 1], q[k + 2], q[k + 3], sign * a[0], sign * a[1], sign * a[2])
    k = c + 3
    rows[first, c] = rows[first + 1, c + 1] = rows[first + 2, c + 2] = sign
    rows[first, k], rows[first, k + 1], rows[first, k + 2], rows[first, k + 3] = wx, s, wz, -wy
    rows[first + 1, k], rows[first + 1, k + 1], rows[first + 1, k + 2], rows[first + 1, k + 3] = wy, -wz, s, wx
    rows[first + 2, k], rows[first + 2, k + 1], rows[first + 2, k + 2], rows[first + 2, k + 3] = wz, wy, -wx, s


@merged
def add_turning(row, k, e0, e1, e2, e3, a):
    """Add G(e)^T a to four entries of a row from k on."""
    x, y, z = a
    row[k] += -e1 * x - e2 * y - e3 * z
    row[k + 1] += e0 * x - e3 * y + e2 * z
    row[k + 2] += e3 * x + e0 * y - e1 * z
    row[k + 3] += -e2 * x + e1 * y + e0 * z


@merged
def twist_row(q, row, w, body, torque):
    """Add to a row the generalised force of a torque in space: 2 G^T R^T torque for Euler parameters."""
    if body < 0:
        return
    if w == PLANAR:
        row[3 * body + 2] += torque[2]
        return
    k = 7 * body + 3
    e0, e1, e2, e3 = q[k], q[k + 1], q[k + 2], q[k + 3]
    x, y, z = times(2.0, torque)
    add_turning(row, k, e0, e1, e2, e3, rotated(e0, -e1, -e2, -e3, x, y, z))


@merged
def spin(q, v, w, body):
    """Return the angular velocity in space."""
    if body < 0:
        return 0.0, 0.0, 0.0
    if w == PLANAR:
        return 0.0, 0.0, v[3 * body + 2]
    k = 7 * body + 3
    x, y, z = half_spin(q[k], q[k + 1], q[k + 2], q[k + 3], v[k], v[k + 1], v[k + 2], v[k + 3])
    return rotated(q[k], q[k + 1], q[k + 2], q[k + 3], 2.0 * x, 2.0 * y, 2.0 * z)


@merged
def parameters_of(q, body):
    """Return the Euler parameters."""
    if body < 0:
        return 1.0, 0.0, 0.0, 0.0
    k = 7 * body + 3
    return q[k], q[k + 1], q[k + 2], q[k + 3]


@merged
def product(a0, a1, a2, a3, b0, b1, b2, b3):
    """Return the Euler parameters of the composition of two rotations, the second one applied first."""
    return (
        a0 * b0 - a1 * b1 - a2 * b2 - a3 * b3,
        a0 * b1 + a1 * b0 + a2 * b3 - a3 * b2,
        a0 * b2 - a1 * b3 + a2 * b0 + a3 * b1,
        a0 * b3 + a1 * b2 - a2 * b1 + a3 * b0,
    )
