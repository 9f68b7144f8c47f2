"""The callbacks of all spatial models: bodies by centre of mass and Euler parameters; p: see `parameter_layout`.

The first rows are e.e = 1 of each body, then those of the joints. The mass matrix has the rank 6 of 7 for each body,
4 G^T J G being of rank 3.
"""

import math

from twoloop.bodies.function_rows import fill_entries, fill_nonholonomic, fill_nonholonomic_gamma
from twoloop.bodies.parameter_layout import (
    AXIAL,
    BODIES,
    BRAKE,
    F_FIRST,
    F_FIRST_AT,
    F_KIND,
    F_MORE,
    F_ON_FIRST,
    F_RESULT,
    F_SECOND,
    F_SECOND_AT,
    FIRST,
    FIRST_AT,
    FORCE,
    FORCE_PROGRAM,
    FORCE_WIDTH,
    FORCES,
    HEAD,
    JOINT_WIDTH,
    JOINTS,
    KIND,
    LENGTH,
    MORE,
    MOTION,
    MOTION_PROGRAM,
    N_FORCES,
    N_JOINTS,
    PERPENDICULAR,
    PLANE,
    POINT,
    PULL,
    RAIL,
    RATE,
    ROW,
    RUB,
    SECOND,
    SECOND_AT,
    SLIDE,
    SPATIAL_BODY,
    TORQUE,
    TORSION,
    TURN,
    WRITTEN,
)
from twoloop.bodies.program_results import result, results
from twoloop.bodies.spatial_places import (
    centre,
    motion,
    move_row,
    place,
    push_row,
    spin,
    torsion,
    turn_row,
    twist_row,
    vector,
    vector_rate,
)
from twoloop.kernels.compile.caches import helper
from twoloop.kernels.compile.callbacks import callback
from twoloop.mechanisms.rotation import half_spin

WEIGHT = 3  # numbers of gravity, before those of the bodies


@helper
def inertia(p, at, x, y, z):
    """J times a vector, in the axes of a body."""
    return (
        p[at + 1] * x + p[at + 4] * y + p[at + 5] * z,
        p[at + 4] * x + p[at + 2] * y + p[at + 6] * z,
        p[at + 5] * x + p[at + 6] * y + p[at + 3] * z,
    )


@helper
def followed(p, at, made, moved):
    """The direction of i that b of j must stay across, when the angle between them is given, and two derivatives."""
    angle, rate, faster = result(made, moved, 0), result(made, moved, 1), result(made, moved, 2)
    s, c = math.sin(angle), math.cos(angle)
    wx, zx = c * p[at + 3] - s * p[at], c * p[at] + s * p[at + 3]
    wy, zy = c * p[at + 4] - s * p[at + 1], c * p[at + 1] + s * p[at + 4]
    wz, zz = c * p[at + 5] - s * p[at + 2], c * p[at + 2] + s * p[at + 5]
    return (
        (wx, wy, wz),
        (-rate * zx, -rate * zy, -rate * zz),
        (-faster * zx - rate * rate * wx, -faster * zy - rate * rate * wy, -faster * zz - rate * rate * wz),
    )


@helper
def fill_constraint(q, p, made, C):
    """C."""
    for body in range(int(p[p.size - HEAD + BODIES])):
        k = 7 * body + 3
        C[body] = 0.5 * (q[k] * q[k] + q[k + 1] * q[k + 1] + q[k + 2] * q[k + 2] + q[k + 3] * q[k + 3] - 1.0)
    first, n = int(p[p.size - HEAD + JOINTS]), int(p[p.size - HEAD + N_JOINTS])
    for k in range(first, first + JOINT_WIDTH * n, JOINT_WIDTH):
        kind, row, i, j = int(p[k + KIND]), int(p[k + ROW]), int(p[k + FIRST]), int(p[k + SECOND])
        at, there, more, moved = int(p[k + FIRST_AT]), int(p[k + SECOND_AT]), int(p[k + MORE]), int(p[k + MOTION])
        if kind == RATE:
            continue
        if kind == WRITTEN:
            C[row] = made[int(p[k + MOTION])]
            continue
        if kind in (PERPENDICULAR, TURN):
            if kind == TURN:
                (x, y, z), _, _ = followed(p, at, made, moved)
            else:
                x, y, z = p[at], p[at + 1], p[at + 2]
            ax, ay, az = vector(q, i, x, y, z)
            bx, by, bz = vector(q, j, p[there], p[there + 1], p[there + 2])
            C[row] = ax * bx + ay * by + az * bz
            continue
        bx, by, bz = place(q, j, p, there)
        if kind == PLANE:
            ax, ay, az = vector(q, i, p[at], p[at + 1], p[at + 2])
            sx, sy, sz = place(q, i, p, more)
            C[row] = ax * (bx - sx) + ay * (by - sy) + az * (bz - sz) - result(made, moved, 0)
            continue
        ax, ay, az = place(q, i, p, at)
        x, y, z = bx - ax, by - ay, bz - az
        if kind == POINT:
            C[row], C[row + 1], C[row + 2] = x, y, z
        else:
            C[row] = 0.5 * (x * x + y * y + z * z - p[more] * p[more])


@helper
def fill_jacobian(q, p, made, Cq):
    """C_q; `made`: results of the program of motions."""
    n = int(p[p.size - HEAD + BODIES])
    for body in range(n):
        for k in range(7 * body + 3, 7 * body + 7):
            Cq[body, k] = q[k]
    first, n = int(p[p.size - HEAD + JOINTS]), int(p[p.size - HEAD + N_JOINTS])
    for k in range(first, first + JOINT_WIDTH * n, JOINT_WIDTH):
        kind, row, i, j = int(p[k + KIND]), int(p[k + ROW]), int(p[k + FIRST]), int(p[k + SECOND])
        at, there, more = int(p[k + FIRST_AT]), int(p[k + SECOND_AT]), int(p[k + MORE])
        if kind == RATE:
            continue
        if kind == WRITTEN:
            fill_entries(p, k, made, int(p[k + MOTION]) + 3, Cq[row])
            continue
        if kind == POINT:
            for axis in range(3):
                fx, fy, fz = 1.0 * (axis == 0), 1.0 * (axis == 1), 1.0 * (axis == 2)
                push_row(q, Cq[row + axis], i, p, at, -fx, -fy, -fz)
                push_row(q, Cq[row + axis], j, p, there, fx, fy, fz)
            continue
        if kind == LENGTH:
            ax, ay, az = place(q, i, p, at)
            bx, by, bz = place(q, j, p, there)
            push_row(q, Cq[row], i, p, at, ax - bx, ay - by, az - bz)
            push_row(q, Cq[row], j, p, there, bx - ax, by - ay, bz - az)
            continue
        x, y, z = p[at], p[at + 1], p[at + 2]
        if kind == TURN:
            (x, y, z), _, _ = followed(p, at, made, int(p[k + MOTION]))
        ax, ay, az = vector(q, i, x, y, z)
        if kind == PLANE:
            bx, by, bz = place(q, j, p, there)
            sx, sy, sz = place(q, i, p, more)
            push_row(q, Cq[row], j, p, there, ax, ay, az)
            push_row(q, Cq[row], i, p, more, -ax, -ay, -az)
            turn_row(q, Cq[row], i, x, y, z, bx - sx, by - sy, bz - sz)
        else:
            bx, by, bz = vector(q, j, p[there], p[there + 1], p[there + 2])
            turn_row(q, Cq[row], j, p[there], p[there + 1], p[there + 2], ax, ay, az)
            turn_row(q, Cq[row], i, x, y, z, bx, by, bz)


@helper
def fill_rate(q, p, made, Ct):
    """C_t, of drives alone."""
    first, n = int(p[p.size - HEAD + JOINTS]), int(p[p.size - HEAD + N_JOINTS])
    for k in range(first, first + JOINT_WIDTH * n, JOINT_WIDTH):
        moved = int(p[k + MOTION])
        if moved >= 0 and int(p[k + KIND]) != RATE:
            if int(p[k + KIND]) == TURN:
                there = int(p[k + SECOND_AT])
                _, (x, y, z), _ = followed(p, int(p[k + FIRST_AT]), made, moved)
                ax, ay, az = vector(q, int(p[k + FIRST]), x, y, z)
                bx, by, bz = vector(q, int(p[k + SECOND]), p[there], p[there + 1], p[there + 2])
                Ct[int(p[k + ROW])] = ax * bx + ay * by + az * bz
            else:
                Ct[int(p[k + ROW])] = -result(made, moved, 1)


@helper
def fill_gamma(q, v, p, made, Qd):
    """The right-hand side of C_q a = gamma."""
    for body in range(int(p[p.size - HEAD + BODIES])):
        k = 7 * body + 3
        Qd[body] = -(v[k] * v[k] + v[k + 1] * v[k + 1] + v[k + 2] * v[k + 2] + v[k + 3] * v[k + 3])
    first, n = int(p[p.size - HEAD + JOINTS]), int(p[p.size - HEAD + N_JOINTS])
    for k in range(first, first + JOINT_WIDTH * n, JOINT_WIDTH):
        kind, row, i, j = int(p[k + KIND]), int(p[k + ROW]), int(p[k + FIRST]), int(p[k + SECOND])
        at, there, more, moved = int(p[k + FIRST_AT]), int(p[k + SECOND_AT]), int(p[k + MORE]), int(p[k + MOTION])
        if kind == RATE:
            continue
        if kind == WRITTEN:
            Qd[row] = made[int(p[k + MOTION]) + 2]
            continue
        if kind in (PERPENDICULAR, TURN):
            bx, by, bz = vector(q, j, p[there], p[there + 1], p[there + 2])
            bux, buy, buz, bax, bay, baz = vector_rate(q, v, j, p[there], p[there + 1], p[there + 2])
            x, y, z = p[at], p[at + 1], p[at + 2]
            dx, dy, dz = 0.0, 0.0, 0.0
            ex, ey, ez = 0.0, 0.0, 0.0
            if kind == TURN:
                (x, y, z), (dx, dy, dz), (ex, ey, ez) = followed(p, at, made, moved)
            ax, ay, az = vector(q, i, x, y, z)
            aux, auy, auz, aax, aay, aaz = vector_rate(q, v, i, x, y, z)
            if kind == TURN:  # the direction changes on body i, too
                fx, fy, fz = vector(q, i, dx, dy, dz)
                gx, gy, gz, _, _, _ = vector_rate(q, v, i, dx, dy, dz)
                hx, hy, hz = vector(q, i, ex, ey, ez)
                aux, auy, auz = aux + fx, auy + fy, auz + fz
                aax, aay, aaz = aax + 2.0 * gx + hx, aay + 2.0 * gy + hy, aaz + 2.0 * gz + hz
            Qd[row] = -(aax * bx + aay * by + aaz * bz) - (ax * bax + ay * bay + az * baz)
            Qd[row] -= 2.0 * (aux * bux + auy * buy + auz * buz)
            continue
        bux, buy, buz, bax, bay, baz = motion(q, v, j, p, there)
        if kind == PLANE:
            ax, ay, az = vector(q, i, p[at], p[at + 1], p[at + 2])
            aux, auy, auz, aax, aay, aaz = vector_rate(q, v, i, p[at], p[at + 1], p[at + 2])
            bx, by, bz = place(q, j, p, there)
            sx, sy, sz = place(q, i, p, more)
            sux, suy, suz, sax, say, saz = motion(q, v, i, p, more)
            Qd[row] = result(made, moved, 2) - aax * (bx - sx) - aay * (by - sy) - aaz * (bz - sz)
            Qd[row] -= 2.0 * (aux * (bux - sux) + auy * (buy - suy) + auz * (buz - suz))
            Qd[row] -= ax * (bax - sax) + ay * (bay - say) + az * (baz - saz)
            continue
        aux, auy, auz, aax, aay, aaz = motion(q, v, i, p, at)
        if kind == POINT:
            Qd[row], Qd[row + 1], Qd[row + 2] = aax - bax, aay - bay, aaz - baz
        else:
            ax, ay, az = place(q, i, p, at)
            bx, by, bz = place(q, j, p, there)
            x, y, z = bux - aux, buy - auy, buz - auz
            Qd[row] = -(x * x + y * y + z * z)
            Qd[row] -= (bx - ax) * (bax - aax) + (by - ay) * (bay - aay) + (bz - az) * (baz - aaz)


@helper
def fill_force(q, v, p, made, Q):
    """Q; `made`: results of the program of forces."""
    for body in range(int(p[p.size - HEAD + BODIES])):
        m, k = WEIGHT + SPATIAL_BODY * body, 7 * body + 3
        move_row(Q, body, p[m] * p[0], p[m] * p[1], p[m] * p[2])
        # -8 G(e')^T J G(e) e': what the kinetic energy leaves when e'' = 0
        u0, u1, u2, u3 = v[k], v[k + 1], v[k + 2], v[k + 3]
        wx, wy, wz = half_spin(q[k], q[k + 1], q[k + 2], q[k + 3], u0, u1, u2, u3)
        x, y, z = inertia(p, m, -8.0 * wx, -8.0 * wy, -8.0 * wz)
        Q[k] += -u1 * x - u2 * y - u3 * z
        Q[k + 1] += u0 * x - u3 * y + u2 * z
        Q[k + 2] += u3 * x + u0 * y - u1 * z
        Q[k + 3] += -u2 * x + u1 * y + u0 * z
    first, n = int(p[p.size - HEAD + FORCES]), int(p[p.size - HEAD + N_FORCES])
    for k in range(first, first + FORCE_WIDTH * n, FORCE_WIDTH):
        kind, i, j, more = int(p[k + F_KIND]), int(p[k + F_FIRST]), int(p[k + F_SECOND]), int(p[k + F_MORE])
        at, there, given = int(p[k + F_FIRST_AT]), int(p[k + F_SECOND_AT]), int(p[k + F_RESULT])
        if kind == TORQUE:
            if given >= 0:
                twist_row(q, Q, j, made[given], made[given + 1], made[given + 2])
            else:
                twist_row(q, Q, j, p[more], p[more + 1], p[more + 2])
            continue
        if kind == FORCE:
            if given >= 0:
                push_row(q, Q, j, p, there, made[given], made[given + 1], made[given + 2])
            else:
                push_row(q, Q, j, p, there, p[more], p[more + 1], p[more + 2])
            continue
        if kind in (AXIAL, TORSION, BRAKE):  # about an axis of body i
            x, y, z = vector(q, i, p[at], p[at + 1], p[at + 2])
            ux, uy, uz = spin(q, v, i)
            wx, wy, wz = spin(q, v, j)
            rate = x * (wx - ux) + y * (wy - uy) + z * (wz - uz)
            if kind == TORSION:
                push = -torsion(q, i, j, p, at, there, p[more], p[more + 2]) - p[more + 1] * rate
            elif kind == BRAKE:
                push = -p[more] * math.tanh(rate / p[more + 1])
            elif given >= 0:
                push = made[given]
            else:
                push = p[more]
            x, y, z = push * x, push * y, push * z
            twist_row(q, Q, j, x, y, z)
            twist_row(q, Q, i, -x, -y, -z)
            continue
        if kind in (SLIDE, RAIL, RUB):  # along an axis of body i, at the point of j, also on i
            x, y, z = vector(q, i, p[at], p[at + 1], p[at + 2])
            bx, by, bz = place(q, j, p, there)
            cx, cy, cz = centre(q, i)
            cx, cy, cz = bx - cx, by - cy, bz - cz
            wx, wy, wz, _, _, _ = motion(q, v, j, p, there)
            ux, uy, uz = centre(v, i)
            ox, oy, oz = spin(q, v, i)
            wx, wy, wz = wx - ux - oy * cz + oz * cy, wy - uy - oz * cx + ox * cz, wz - uz - ox * cy + oy * cx
            rate = x * wx + y * wy + z * wz
            if kind == RAIL:
                ax, ay, az = place(q, i, p, int(p[k + F_ON_FIRST]))
                push = -p[more] * (x * (bx - ax) + y * (by - ay) + z * (bz - az) - p[more + 2]) - p[more + 1] * rate
            elif kind == RUB:
                push = -p[more] * math.tanh(rate / p[more + 1])
            elif given >= 0:
                push = made[given]
            else:
                push = p[more]
            x, y, z = push * x, push * y, push * z
            push_row(q, Q, j, p, there, x, y, z)
            move_row(Q, i, -x, -y, -z)
            twist_row(q, Q, i, cz * y - cy * z, cx * z - cz * x, cy * x - cx * y)
            continue
        ax, ay, az = place(q, i, p, at)
        bx, by, bz = place(q, j, p, there)
        x, y, z = bx - ax, by - ay, bz - az
        if kind == PULL:
            x, y, z = p[more] * x, p[more] * y, p[more] * z
        else:
            length = math.sqrt(x * x + y * y + z * z)
            x, y, z = x / length, y / length, z / length
            ux, uy, uz, _, _, _ = motion(q, v, i, p, at)
            wx, wy, wz, _, _, _ = motion(q, v, j, p, there)
            pull = p[more] * (length - p[more + 2])
            pull += p[more + 1] * (x * (wx - ux) + y * (wy - uy) + z * (wz - uz))
            x, y, z = pull * x, pull * y, pull * z
        push_row(q, Q, i, p, at, x, y, z)
        push_row(q, Q, j, p, there, -x, -y, -z)


@callback("mass")
def mass(t, q, p, M):
    for body in range(int(p[p.size - HEAD + BODIES])):
        m, first = WEIGHT + SPATIAL_BODY * body, 7 * body
        e0, e1, e2, e3 = q[first + 3], q[first + 4], q[first + 5], q[first + 6]
        columns = ((-e1, -e2, -e3), (e0, -e3, e2), (e3, e0, -e1), (-e2, e1, e0))  # of G
        for i in range(3):
            M[first + i, first + i] = p[m]
        for j in range(4):
            x, y, z = columns[j]
            x, y, z = inertia(p, m, 4.0 * x, 4.0 * y, 4.0 * z)
            for i in range(4):
                M[first + 3 + i, first + 3 + j] = columns[i][0] * x + columns[i][1] * y + columns[i][2] * z


@callback("force")
def force(t, q, v, p, Q):
    fill_force(q, v, p, results(int(p[p.size - HEAD + FORCE_PROGRAM]), t, q, v, p), Q)


@callback("constraint")
def constraint(t, q, p, C):
    fill_constraint(q, p, results(int(p[p.size - HEAD + MOTION_PROGRAM]), t, q, q, p), C)


@callback("jacobian")
def jacobian(t, q, p, Cq):
    fill_jacobian(q, p, results(int(p[p.size - HEAD + MOTION_PROGRAM]), t, q, q, p), Cq)


@callback("constraint_rate")
def constraint_rate(t, q, p, Ct):
    fill_rate(q, p, results(int(p[p.size - HEAD + MOTION_PROGRAM]), t, q, q, p), Ct)


@callback("gamma")
def gamma(t, q, v, p, Qd):
    fill_gamma(q, v, p, results(int(p[p.size - HEAD + MOTION_PROGRAM]), t, q, v, p), Qd)


@callback("nonholonomic")
def nonholonomic(t, q, p, A):
    fill_nonholonomic(p, results(int(p[p.size - HEAD + MOTION_PROGRAM]), t, q, q, p), A)


@callback("nonholonomic_gamma")
def nonholonomic_gamma(t, q, v, p, Qa):
    fill_nonholonomic_gamma(p, results(int(p[p.size - HEAD + MOTION_PROGRAM]), t, q, v, p), Qa)
