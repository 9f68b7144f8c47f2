"""Generalised forces of all spatial models: gravity, springs, motors, friction; for p see `parameter_layout`."""

import math

from twoloop.bodies import parameter_layout as layout
from twoloop.bodies.read_tables import force_at, force_places, n_bodies, push, value
from twoloop.bodies.rotation import half_spin
from twoloop.bodies.spatial_places import centre, move_row, place, push_row, spin, torsion, twist_row, vector, velocity
from twoloop.kernels.compile.caches import helper

WEIGHT = 3  # components of gravity, which precede the numbers of the bodies


@helper
def inertia(p, at, x, y, z):
    """Return J times a vector, in body axes."""
    return (
        p[at + 1] * x + p[at + 4] * y + p[at + 5] * z,
        p[at + 4] * x + p[at + 2] * y + p[at + 6] * z,
        p[at + 5] * x + p[at + 6] * y + p[at + 3] * z,
    )


@helper
def put_forces(q, v, p, made, Q):
    """Add springs, motors, friction, given forces and torques."""
    for k in force_places(p):
        kind, i, at, j, there, more, given, on_first = force_at(p, k)
        if kind in (layout.TORQUE, layout.FORCE):
            x, y = value(p, more, made, given, 0), value(p, more, made, given, 1)
            z = value(p, more, made, given, 2)
            if kind == layout.TORQUE:
                twist_row(q, Q, j, x, y, z)
            else:
                push_row(q, Q, j, p, there, x, y, z)
            continue
        if kind in (layout.AXIAL, layout.TORSION, layout.BRAKE):  # about an axis of body i
            x, y, z = vector(q, i, p[at], p[at + 1], p[at + 2])
            ux, uy, uz = spin(q, v, i)
            wx, wy, wz = spin(q, v, j)
            rate = x * (wx - ux) + y * (wy - uy) + z * (wz - uz)
            if kind == layout.TORSION and given >= 0:
                f = -made[given]
            elif kind == layout.TORSION:
                f = -torsion(q, i, j, p, at, there, p[more], p[more + 2]) - p[more + 1] * rate
            else:
                f = push(kind, rate, p, more, made, given)
            x, y, z = f * x, f * y, f * z
            twist_row(q, Q, j, x, y, z)
            twist_row(q, Q, i, -x, -y, -z)
            continue
        if kind in (layout.SLIDE, layout.RAIL, layout.RUB):  # along an axis of body i, at the point of j
            x, y, z = vector(q, i, p[at], p[at + 1], p[at + 2])
            bx, by, bz = place(q, j, p, there)
            cx, cy, cz = centre(q, i)
            cx, cy, cz = bx - cx, by - cy, bz - cz
            wx, wy, wz = velocity(q, v, j, p, there)
            ux, uy, uz = centre(v, i)
            ox, oy, oz = spin(q, v, i)
            wx, wy, wz = wx - ux - oy * cz + oz * cy, wy - uy - oz * cx + ox * cz, wz - uz - ox * cy + oy * cx
            rate = x * wx + y * wy + z * wz
            if kind == layout.RAIL and given >= 0:
                f = -made[given]
            elif kind == layout.RAIL:
                ax, ay, az = place(q, i, p, on_first)
                f = -p[more] * (x * (bx - ax) + y * (by - ay) + z * (bz - az) - p[more + 2]) - p[more + 1] * rate
            else:
                f = push(kind, rate, p, more, made, given)
            x, y, z = f * x, f * y, f * z
            push_row(q, Q, j, p, there, x, y, z)
            move_row(Q, i, -x, -y, -z)
            twist_row(q, Q, i, cz * y - cy * z, cx * z - cz * x, cy * x - cx * y)
            continue
        ax, ay, az = place(q, i, p, at)
        bx, by, bz = place(q, j, p, there)
        x, y, z = bx - ax, by - ay, bz - az
        if kind == layout.PULL:
            x, y, z = p[more] * x, p[more] * y, p[more] * z
        elif given >= 0:
            pull = made[given] / math.sqrt(x * x + y * y + z * z)
            x, y, z = pull * x, pull * y, pull * z
        else:
            length = math.sqrt(x * x + y * y + z * z)
            x, y, z = x / length, y / length, z / length
            ux, uy, uz = velocity(q, v, i, p, at)
            wx, wy, wz = velocity(q, v, j, p, there)
            pull = p[more] * (length - p[more + 2])
            pull += p[more + 1] * (x * (wx - ux) + y * (wy - uy) + z * (wz - uz))
            x, y, z = pull * x, pull * y, pull * z
        push_row(q, Q, i, p, at, x, y, z)
        push_row(q, Q, j, p, there, -x, -y, -z)


@helper
def fill_force(q, v, p, made, Q):
    """Evaluate Q; `made`: results of the program of forces."""
    for body in range(n_bodies(p)):
        m, k = WEIGHT + layout.SPATIAL_BODY * body, 7 * body + 3
        move_row(Q, body, p[m] * p[0], p[m] * p[1], p[m] * p[2])
        # quadratic velocity terms of the kinetic energy: -8 G(e')^T J G(e) e'
        u0, u1, u2, u3 = v[k], v[k + 1], v[k + 2], v[k + 3]
        wx, wy, wz = half_spin(q[k], q[k + 1], q[k + 2], q[k + 3], u0, u1, u2, u3)
        x, y, z = inertia(p, m, -8.0 * wx, -8.0 * wy, -8.0 * wz)
        Q[k] += -u1 * x - u2 * y - u3 * z
        Q[k + 1] += u0 * x - u3 * y + u2 * z
        Q[k + 2] += u3 * x + u0 * y - u1 * z
        Q[k + 3] += -u2 * x + u1 * y + u0 * z
    if p[p.size - layout.HEAD + layout.N_FORCES] > 0:
        put_forces(q, v, p, made, Q)
