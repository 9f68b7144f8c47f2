"""Callbacks of spatial models; coordinates: centre of mass and Euler parameters; for p see `parameter_layout`.

Those here read no results of programs, and are given p in their place; `spatial_programs` has those of models with
motions or forces that are functions.

The first rows are e.e = 1 for each body, followed by those of the joints. The mass matrix has rank 6 of 7 for each
body, because 4 G^T J G has rank 3.
"""

import math

import numpy as np

from twoloop.bodies import parameter_layout as layout
from twoloop.bodies.function_rows import fill_entries, put_entries
from twoloop.bodies.program_results import result
from twoloop.bodies.read_tables import joint_at, joint_places, n_bodies
from twoloop.bodies.spatial_forces import WEIGHT, fill_force, inertia
from twoloop.bodies.spatial_places import motion, place, push_row, put_point_rows, turn_row, vector, vector_rate
from twoloop.kernels.compile.caches import helper
from twoloop.kernels.compile.callbacks import callback
from twoloop.kernels.data.common import inlined


@helper
def followed(p, at, made, moved):
    """Return the direction of i perpendicular to b of j at a prescribed angle, and its first two derivatives."""
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
    """Evaluate C."""
    for body in range(n_bodies(p)):
        k = 7 * body + 3
        C[body] = 0.5 * (q[k] * q[k] + q[k + 1] * q[k + 1] + q[k + 2] * q[k + 2] + q[k + 3] * q[k + 3] - 1.0)
    for k in joint_places(p):
        kind, row, i, at, j, there, more, moved = joint_at(p, k)
        if kind == layout.RATE:
            continue
        if kind == layout.WRITTEN:
            C[row] = made[moved]
            continue
        if kind in (layout.PERPENDICULAR, layout.TURN):
            if kind == layout.TURN:
                (x, y, z), _, _ = followed(p, at, made, moved)
            else:
                x, y, z = p[at], p[at + 1], p[at + 2]
            ax, ay, az = vector(q, i, x, y, z)
            bx, by, bz = vector(q, j, p[there], p[there + 1], p[there + 2])
            C[row] = ax * bx + ay * by + az * bz
            continue
        bx, by, bz = place(q, j, p, there)
        if kind == layout.PLANE:
            ax, ay, az = vector(q, i, p[at], p[at + 1], p[at + 2])
            sx, sy, sz = place(q, i, p, more)
            C[row] = ax * (bx - sx) + ay * (by - sy) + az * (bz - sz) - result(made, moved, 0)
            continue
        ax, ay, az = place(q, i, p, at)
        x, y, z = bx - ax, by - ay, bz - az
        if kind == layout.POINT:
            C[row], C[row + 1], C[row + 2] = x, y, z
        else:
            C[row] = 0.5 * (x * x + y * y + z * z - p[more] * p[more])


@inlined
def fill_rows(q, p, made, k, Cq, row):
    """Evaluate the rows of C_q of joint row k, from `row` on."""
    kind, _, i, at, j, there, more, moved = joint_at(p, k)
    if kind == layout.WRITTEN:
        fill_entries(p, more, made, moved + 3, Cq[row])
        return
    if kind == layout.POINT:
        put_point_rows(q, Cq, row, i, p[at], p[at + 1], p[at + 2], -1.0)
        put_point_rows(q, Cq, row, j, p[there], p[there + 1], p[there + 2], 1.0)
        return
    if kind == layout.LENGTH:
        ax, ay, az = place(q, i, p, at)
        bx, by, bz = place(q, j, p, there)
        push_row(q, Cq[row], i, p, at, ax - bx, ay - by, az - bz)
        push_row(q, Cq[row], j, p, there, bx - ax, by - ay, bz - az)
        return
    x, y, z = p[at], p[at + 1], p[at + 2]
    if kind == layout.TURN:
        (x, y, z), _, _ = followed(p, at, made, moved)
    ax, ay, az = vector(q, i, x, y, z)
    if kind == layout.PLANE:
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
def fill_jacobian(q, p, made, Cq):
    """Evaluate C_q; `made`: results of the program of motions."""
    for body in range(n_bodies(p)):
        for k in range(7 * body + 3, 7 * body + 7):
            Cq[body, k] = q[k]
    for k in joint_places(p):
        kind, row, _, _, _, _, _, _ = joint_at(p, k)
        if kind != layout.RATE:
            fill_rows(q, p, made, k, Cq, row)


@helper
def fill_rate(q, p, made, Ct):
    """Evaluate C_t, which only drives have."""
    for k in joint_places(p):
        kind, row, i, at, j, there, _, moved = joint_at(p, k)
        if moved >= 0 and kind == layout.TURN:
            _, (x, y, z), _ = followed(p, at, made, moved)
            ax, ay, az = vector(q, i, x, y, z)
            bx, by, bz = vector(q, j, p[there], p[there + 1], p[there + 2])
            Ct[row] = ax * bx + ay * by + az * bz
        elif moved >= 0 and kind != layout.RATE:
            Ct[row] = -made[moved + 1]


@helper
def fill_gamma(q, v, p, made, Qd):
    """Evaluate the right-hand side of C_q a = gamma."""
    for body in range(n_bodies(p)):
        k = 7 * body + 3
        Qd[body] = -(v[k] * v[k] + v[k + 1] * v[k + 1] + v[k + 2] * v[k + 2] + v[k + 3] * v[k + 3])
    for k in joint_places(p):
        kind, row, i, at, j, there, more, moved = joint_at(p, k)
        if kind == layout.RATE:
            continue
        if kind == layout.WRITTEN:
            Qd[row] = made[moved + 2]
            continue
        if kind in (layout.PERPENDICULAR, layout.TURN):
            bx, by, bz = vector(q, j, p[there], p[there + 1], p[there + 2])
            bux, buy, buz, bax, bay, baz = vector_rate(q, v, j, p[there], p[there + 1], p[there + 2])
            x, y, z = p[at], p[at + 1], p[at + 2]
            dx, dy, dz = 0.0, 0.0, 0.0
            ex, ey, ez = 0.0, 0.0, 0.0
            if kind == layout.TURN:
                (x, y, z), (dx, dy, dz), (ex, ey, ez) = followed(p, at, made, moved)
            ax, ay, az = vector(q, i, x, y, z)
            aux, auy, auz, aax, aay, aaz = vector_rate(q, v, i, x, y, z)
            if kind == layout.TURN:  # the direction also moves relative to body i
                fx, fy, fz = vector(q, i, dx, dy, dz)
                gx, gy, gz, _, _, _ = vector_rate(q, v, i, dx, dy, dz)
                hx, hy, hz = vector(q, i, ex, ey, ez)
                aux, auy, auz = aux + fx, auy + fy, auz + fz
                aax, aay, aaz = aax + 2.0 * gx + hx, aay + 2.0 * gy + hy, aaz + 2.0 * gz + hz
            Qd[row] = -(aax * bx + aay * by + aaz * bz) - (ax * bax + ay * bay + az * baz)
            Qd[row] -= 2.0 * (aux * bux + auy * buy + auz * buz)
            continue
        bux, buy, buz, bax, bay, baz = motion(q, v, j, p, there)
        if kind == layout.PLANE:
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
        if kind == layout.POINT:
            Qd[row], Qd[row + 1], Qd[row + 2] = aax - bax, aay - bay, aaz - baz
        else:
            ax, ay, az = place(q, i, p, at)
            bx, by, bz = place(q, j, p, there)
            x, y, z = bux - aux, buy - auy, buz - auz
            Qd[row] = -(x * x + y * y + z * z)
            Qd[row] -= (bx - ax) * (bax - aax) + (by - ay) * (bay - aay) + (bz - az) * (baz - aaz)


@helper
def fill_mass(q, p, body, M, first):
    """Evaluate the diagonal block of M of a body, from row and column `first` on."""
    m, k = WEIGHT + layout.SPATIAL_BODY * body, 7 * body + 3
    e0, e1, e2, e3 = q[k], q[k + 1], q[k + 2], q[k + 3]
    columns = ((-e1, -e2, -e3), (e0, -e3, e2), (e3, e0, -e1), (-e2, e1, e0))  # columns of G
    for i in range(3):
        M[first + i, first + i] = p[m]
    for j in range(4):
        x, y, z = columns[j]
        x, y, z = inertia(p, m, 4.0 * x, 4.0 * y, 4.0 * z)
        for i in range(4):
            M[first + 3 + i, first + 3 + j] = columns[i][0] * x + columns[i][1] * y + columns[i][2] * z


@callback("mass", allocates=False)
def mass(t, q, p, M):
    for body in range(n_bodies(p)):
        fill_mass(q, p, body, M, 7 * body)


@callback("mass_values")
def mass_values(t, q, p, values):
    block = np.zeros((7, 7), dtype=q.dtype)
    for body in range(n_bodies(p)):
        fill_mass(q, p, body, block, 0)
        for i in range(3):
            values[19 * body + i] = block[i, i]
        for i in range(16):
            values[19 * body + 3 + i] = block[3 + i // 4, 3 + i % 4]


@helper
def take_entries(body, skipped, row, values, at):
    """Move the entries of a row for a body from C_q to values, without the first `skipped`, and clear them."""
    if body >= 0:
        for j in range(7 * body + skipped, 7 * (body + 1)):
            values[at], row[j] = row[j], 0.0
            at += 1
    return at


@helper
def fill_values(q, p, made, rows, values):
    """Evaluate the entries of C_q; `rows` (3, n_q): zeros, which they are again afterwards."""
    at = 4 * n_bodies(p)
    for k in range(at):
        values[k] = q[7 * (k // 4) + 3 + k % 4]
    for k in joint_places(p):
        kind, _, i, _, j, _, columns, moved = joint_at(p, k)
        if kind == layout.WRITTEN:
            at = put_entries(p, columns, made, moved + 3, values, at)
        elif kind != layout.RATE:
            fill_rows(q, p, made, k, rows, 0)
            skipped = 3 * (kind in (layout.PERPENDICULAR, layout.TURN))  # rows that depend on the rotation only
            for row in range(3 if kind == layout.POINT else 1):
                at = take_entries(i, skipped, rows[row], values, at)
                at = take_entries(j, skipped, rows[row], values, at)


@callback("force", allocates=False)
def force(t, q, v, p, Q):
    fill_force(q, v, p, p, Q)


@callback("constraint", allocates=False)
def constraint(t, q, p, C):
    fill_constraint(q, p, p, C)


@callback("jacobian", allocates=False)
def jacobian(t, q, p, Cq):
    fill_jacobian(q, p, p, Cq)


@callback("jacobian_values")
def jacobian_values(t, q, p, values):
    fill_values(q, p, p, np.zeros((3, q.size), dtype=q.dtype), values)


@callback("gamma", allocates=False)
def gamma(t, q, v, p, Qd):
    fill_gamma(q, v, p, p, Qd)
