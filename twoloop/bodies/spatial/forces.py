"""Evaluate points, vectors and generalised forces of spatial bodies: helpers of compiled callbacks.

Vectors are tuples of three numbers. Coordinates of a body: x, y, z of the centre of mass and Euler parameters; see
`rotation`.
"""

import math

from twoloop.bodies import parameter_layout as layout
from twoloop.bodies.read_tables import force_at, force_places, force_value, joint_force, n_bodies, spring_tension
from twoloop.bodies.rotation import half_spin, pulled, rotated, rotated_rate, turned
from twoloop.bodies.rotors import put_spatial_rotor_force
from twoloop.kernels.compile.caches import helper
from twoloop.kernels.data.common import exact, inlined

FARTHEST = -math.cos(0.95 * math.pi)  # 0.95 of a turn
WEIGHT = 3  # components of gravity, which precede the numbers of the bodies


@exact
def numbers(p, at):
    """Return the vector stored at index `at` of p."""
    return p[at], p[at + 1], p[at + 2]


@exact
def dot(a, b):
    """Return the scalar product of two vectors."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@exact
def times(factor, a):
    """Return a multiple of a vector."""
    return factor * a[0], factor * a[1], factor * a[2]


@exact
def plus(a, b):
    """Return the sum of two vectors."""
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


@exact
def minus(a, b):
    """Return the difference of two vectors."""
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


@exact
def cross(a, b):
    """Return the vector product of two vectors."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@exact
def vector(q, body, a):
    """Return a body-fixed vector in space."""
    if body < 0:
        return a
    k = 7 * body + 3
    return rotated(q[k], q[k + 1], q[k + 2], q[k + 3], a[0], a[1], a[2])


@inlined
def vector_rate(q, v, body, a):
    """Return its time derivative, and 2 R(e') a, its second derivative for e'' = 0."""
    if body < 0:
        return (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
    k = 7 * body + 3
    u = rotated_rate(q[k], q[k + 1], q[k + 2], q[k + 3], v[k], v[k + 1], v[k + 2], v[k + 3], a[0], a[1], a[2])
    return u, times(2.0, rotated(v[k], v[k + 1], v[k + 2], v[k + 3], a[0], a[1], a[2]))


@exact
def centre(q, body):
    """Return the centre of mass, or its velocity from v."""
    if body < 0:
        return 0.0, 0.0, 0.0
    return q[7 * body], q[7 * body + 1], q[7 * body + 2]


@exact
def turn_row(q, row, body, a, f):
    """Add to a row (n_q,) the gradient of f . (vector a of a body) in its Euler parameters."""
    if body >= 0:
        k = 7 * body + 3
        d0, d1, d2, d3 = pulled(q[k], q[k + 1], q[k + 2], q[k + 3], a[0], a[1], a[2], f[0], f[1], f[2])
        row[k] += d0
        row[k + 1] += d1
        row[k + 2] += d2
        row[k + 3] += d3


@exact
def put_point_rows(q, rows, first, body, a, sign):
    """Store three rows (n_q,), the derivatives of a point of a body, or minus these."""
    if body >= 0:
        k = 7 * body + 3
        s, wx, wy, wz = turned(q[k], q[k + 1], q[k + 2], q[k + 3], sign * a[0], sign * a[1], sign * a[2])
        rows[first, k - 3] = rows[first + 1, k - 2] = rows[first + 2, k - 1] = sign
        rows[first, k], rows[first, k + 1], rows[first, k + 2], rows[first, k + 3] = wx, s, wz, -wy
        rows[first + 1, k], rows[first + 1, k + 1], rows[first + 1, k + 2], rows[first + 1, k + 3] = wy, -wz, s, wx
        rows[first + 2, k], rows[first + 2, k + 1], rows[first + 2, k + 2], rows[first + 2, k + 3] = wz, wy, -wx, s


@exact
def move_row(row, body, f):
    """Add to a row the gradient of f . (centre of a body)."""
    if body >= 0:
        row[7 * body] += f[0]
        row[7 * body + 1] += f[1]
        row[7 * body + 2] += f[2]


@exact
def place(q, body, p, at):
    """Return the point of a body stored at index `at` of p."""
    return plus(centre(q, body), vector(q, body, numbers(p, at)))


@inlined
def motion(q, v, body, p, at):
    """Return the velocity of that point and the part of its acceleration that does not depend on v'."""
    u, bias = vector_rate(q, v, body, numbers(p, at))
    return plus(centre(v, body), u), bias


@exact
def velocity(q, v, body, p, at):
    """Return the velocity of that point."""
    if body < 0:
        return 0.0, 0.0, 0.0
    k = 7 * body + 3
    x, y, z = numbers(p, at)
    u = rotated_rate(q[k], q[k + 1], q[k + 2], q[k + 3], v[k], v[k + 1], v[k + 2], v[k + 3], x, y, z)
    return plus(centre(v, body), u)


@exact
def slip(q, v, i, j, p, at):
    """Return a point of body j from the centre of body i, and its velocity as seen from body i."""
    arm = minus(place(q, j, p, at), centre(q, i))
    return arm, minus(velocity(q, v, j, p, at), plus(centre(v, i), cross(spin(q, v, i), arm)))


@exact
def push_row(q, row, body, p, at, f):
    """Add to a row the derivative of f . (point of a body), i.e. the generalised force of f there."""
    move_row(row, body, f)
    turn_row(q, row, body, numbers(p, at), f)


@exact
def add_turning(row, k, e0, e1, e2, e3, a):
    """Add G(e)^T a to four entries of a row from k on."""
    x, y, z = a
    row[k] += -e1 * x - e2 * y - e3 * z
    row[k + 1] += e0 * x - e3 * y + e2 * z
    row[k + 2] += e3 * x + e0 * y - e1 * z
    row[k + 3] += -e2 * x + e1 * y + e0 * z


@exact
def twist_row(q, row, body, torque):
    """Add to a row the generalised force of a torque in space, 2 G^T R^T torque."""
    if body >= 0:
        k = 7 * body + 3
        e0, e1, e2, e3 = q[k], q[k + 1], q[k + 2], q[k + 3]
        x, y, z = times(2.0, torque)
        add_turning(row, k, e0, e1, e2, e3, rotated(e0, -e1, -e2, -e3, x, y, z))


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


@helper
def inertia(p, at, a):
    """Return J times a vector, in body axes."""
    x, y, z = a
    return (
        p[at + 1] * x + p[at + 4] * y + p[at + 5] * z,
        p[at + 4] * x + p[at + 2] * y + p[at + 6] * z,
        p[at + 5] * x + p[at + 6] * y + p[at + 3] * z,
    )


@helper
def put_forces(q, v, p, results, Q):
    """Add springs, motors, friction, given forces and torques."""
    for k in force_places(p):
        kind, i, at_i, j, at_j, more, first_result, point_i = force_at(p, k)
        if kind in (layout.HINGE_ROTOR, layout.SLIDE_ROTOR):
            put_spatial_rotor_force(q, v, p, k, Q)
            continue
        if kind in (layout.TORQUE, layout.FORCE):
            x, y = force_value(p, more, results, first_result, 0), force_value(p, more, results, first_result, 1)
            f = x, y, force_value(p, more, results, first_result, 2)
            if kind == layout.TORQUE:
                twist_row(q, Q, j, f)
            else:
                push_row(q, Q, j, p, at_j, f)
            continue
        if kind in (layout.AXIAL_TORQUE, layout.TORSION_SPRING, layout.HINGE_FRICTION):  # about an axis of body i
            axis = vector(q, i, numbers(p, at_i))
            rate = dot(axis, minus(spin(q, v, j), spin(q, v, i)))
            if kind == layout.TORSION_SPRING and first_result >= 0:
                torque = -results[first_result]
            elif kind == layout.TORSION_SPRING:
                torque = -torsion(q, i, j, p, at_i, at_j, p[more], p[more + 2]) - p[more + 1] * rate
            else:
                torque = joint_force(kind, rate, p, more, results, first_result)
            twist_row(q, Q, j, times(torque, axis))
            twist_row(q, Q, i, times(-torque, axis))
            continue
        if kind in (layout.AXIAL_FORCE, layout.AXIAL_SPRING, layout.AXIAL_FRICTION):  # on both at the point of j
            axis = vector(q, i, numbers(p, at_i))
            arm, u = slip(q, v, i, j, p, at_j)
            rate = dot(axis, u)
            if kind == layout.AXIAL_SPRING:
                length = dot(axis, minus(place(q, j, p, at_j), place(q, i, p, point_i)))
                push = times(-spring_tension(length, rate, p, more, results, first_result), axis)
            else:
                push = times(joint_force(kind, rate, p, more, results, first_result), axis)
            push_row(q, Q, j, p, at_j, push)
            move_row(Q, i, times(-1.0, push))
            twist_row(q, Q, i, cross(push, arm))
            continue
        d = minus(place(q, j, p, at_j), place(q, i, p, at_i))
        factor = p[more]
        if kind == layout.SPRING:
            length = math.sqrt(dot(d, d))
            rate = dot(d, minus(velocity(q, v, j, p, at_j), velocity(q, v, i, p, at_i))) / length
            factor = spring_tension(length, rate, p, more, results, first_result) / length
        push_row(q, Q, i, p, at_i, times(factor, d))
        push_row(q, Q, j, p, at_j, times(-factor, d))


@helper
def fill_force(q, v, p, results, Q):
    """Evaluate Q; `results`: those of the program of forces."""
    for body in range(n_bodies(p)):
        m, k = WEIGHT + layout.SPATIAL_BODY * body, 7 * body + 3
        move_row(Q, body, times(p[m], numbers(p, 0)))
        # quadratic velocity terms of the kinetic energy: -8 G(e')^T J G(e) e'
        u0, u1, u2, u3 = v[k], v[k + 1], v[k + 2], v[k + 3]
        w = half_spin(q[k], q[k + 1], q[k + 2], q[k + 3], u0, u1, u2, u3)
        add_turning(Q, k, u0, u1, u2, u3, inertia(p, m, times(-8.0, w)))
    if p[p.size - layout.HEAD + layout.N_FORCES] > 0:
        put_forces(q, v, p, results, Q)
