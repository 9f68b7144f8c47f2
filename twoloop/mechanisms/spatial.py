"""Common callbacks of spatial mechanisms: Euler parameters, joints, spring-dampers, gravity.

Coordinates of a body: x, y, z of the centre of mass and e0, e1, e2, e3 (see `rotation`); its axes are the principal
ones. The callbacks are compiled once for all mechanisms; the parameters hold what
`spatial_bodies.SpatialBodies` collects::

    p = [bodies, joints, springs, gravity (3,), (m, J1, J2, J3)...,
         (kind, row, i, a (3,), j, b (3,), s (3,))...,  (i, a (3,), j, b (3,), k, c, length)...]

The first rows are e.e = 1 of each body, then those of the joints. Vectors are in the axes of their body; the ground is
body -1. The mass matrix has rank 6 of 7 for each body, because 4 G^T J G has rank 3.
"""

from collections.abc import Sequence

import numpy as np

from twoloop.bodies.rotation import half_spin, pulled
from twoloop.bodies.spatial_places import centre, vector, vector_rate
from twoloop.kernels.compile.caches import helper
from twoloop.kernels.compile.callbacks import callback

POINT = 0.0  # point a of body i is point b of body j: three rows
DIRECTION = 1.0  # the directions a of i and b of j are perpendicular: one row
PLANE = 2.0  # the point b of j lies in the plane across the direction a of i, through its point s: one row
JOINT, SPRING = 13, 11  # numbers of each
HEAD = 6
GROUND = -1
MOVED, TURNED = (0, 1, 2), (3, 4, 5, 6)  # coordinates of a body


@helper
def put_turned(q, values, place, body, x, y, z, fx, fy, fz):
    """Store the gradient of f . (vector of a body) in the Euler parameters as four values; return the next index."""
    if body < 0:
        return place
    k = 7 * body + 3
    d0, d1, d2, d3 = pulled(q[k], q[k + 1], q[k + 2], q[k + 3], x, y, z, fx, fy, fz)
    values[place] += d0
    values[place + 1] += d1
    values[place + 2] += d2
    values[place + 3] += d3
    return place + 4


@helper
def turn_row(q, row, body, x, y, z, fx, fy, fz):
    """Add to a row (n_q,) the gradient of f . (vector of a body) in its Euler parameters."""
    if body >= 0:
        k = 7 * body + 3
        d0, d1, d2, d3 = pulled(q[k], q[k + 1], q[k + 2], q[k + 3], x, y, z, fx, fy, fz)
        row[k] += d0
        row[k + 1] += d1
        row[k + 2] += d2
        row[k + 3] += d3


@helper
def move_row(row, body, fx, fy, fz):
    """Add to a row the gradient of f . (centre of a body)."""
    if body >= 0:
        row[7 * body] += fx
        row[7 * body + 1] += fy
        row[7 * body + 2] += fz


@callback("mass")
def mass(t, q, p, M):
    for body in range(int(p[0])):
        m, first = HEAD + 4 * body, 7 * body
        e0, e1, e2, e3 = q[first + 3], q[first + 4], q[first + 5], q[first + 6]
        G = ((-e1, e0, e3, -e2), (-e2, -e3, e0, e1), (-e3, e2, -e1, e0))
        for i in range(3):
            M[first + i, first + i] = p[m]
        for k in range(3):
            for i in range(4):
                for j in range(4):
                    M[first + 3 + i, first + 3 + j] += 4.0 * p[m + 1 + k] * G[k][i] * G[k][j]


@callback("force")
def force(t, q, v, p, Q):
    n = int(p[0])
    for body in range(n):
        m, k = HEAD + 4 * body, 7 * body + 3
        move_row(Q, body, p[m] * p[3], p[m] * p[4], p[m] * p[5])
        # quadratic velocity terms of the kinetic energy: -8 G(e')^T J G(e) e'
        wx, wy, wz = half_spin(q[k], q[k + 1], q[k + 2], q[k + 3], v[k], v[k + 1], v[k + 2], v[k + 3])
        x, y, z = -8.0 * p[m + 1] * wx, -8.0 * p[m + 2] * wy, -8.0 * p[m + 3] * wz
        u0, u1, u2, u3 = v[k], v[k + 1], v[k + 2], v[k + 3]
        Q[k] += -u1 * x - u2 * y - u3 * z
        Q[k + 1] += u0 * x - u3 * y + u2 * z
        Q[k + 2] += u3 * x + u0 * y - u1 * z
        Q[k + 3] += -u2 * x + u1 * y + u0 * z
    first = HEAD + 4 * n + JOINT * int(p[1])
    for k in range(first, first + SPRING * int(p[2]), SPRING):
        i, j = int(p[k]), int(p[k + 4])
        a0, a1, a2, b0, b1, b2 = p[k + 1], p[k + 2], p[k + 3], p[k + 5], p[k + 6], p[k + 7]
        ax, ay, az = vector(q, i, a0, a1, a2)
        bx, by, bz = vector(q, j, b0, b1, b2)
        cx, cy, cz = centre(q, i)
        dx, dy, dz = centre(q, j)
        x, y, z = bx + dx - ax - cx, by + dy - ay - cy, bz + dz - az - cz
        length = np.sqrt(x * x + y * y + z * z)
        x, y, z = x / length, y / length, z / length
        ax, ay, az, _, _, _ = vector_rate(q, v, i, a0, a1, a2)
        bx, by, bz, _, _, _ = vector_rate(q, v, j, b0, b1, b2)
        cx, cy, cz = centre(v, i)
        dx, dy, dz = centre(v, j)
        rate = x * (bx + dx - ax - cx) + y * (by + dy - ay - cy) + z * (bz + dz - az - cz)
        pull = p[k + 8] * (length - p[k + 10]) + p[k + 9] * rate
        x, y, z = pull * x, pull * y, pull * z
        move_row(Q, i, x, y, z)
        turn_row(q, Q, i, a0, a1, a2, x, y, z)
        move_row(Q, j, -x, -y, -z)
        turn_row(q, Q, j, b0, b1, b2, -x, -y, -z)


@callback("constraint")
def constraint(t, q, p, C):
    n = int(p[0])
    for body in range(n):
        k = 7 * body + 3
        C[body] = 0.5 * (q[k] * q[k] + q[k + 1] * q[k + 1] + q[k + 2] * q[k + 2] + q[k + 3] * q[k + 3] - 1.0)
    first = HEAD + 4 * n
    for k in range(first, first + JOINT * int(p[1]), JOINT):
        row, i, j = int(p[k + 1]), int(p[k + 2]), int(p[k + 6])
        ax, ay, az = vector(q, i, p[k + 3], p[k + 4], p[k + 5])
        bx, by, bz = vector(q, j, p[k + 7], p[k + 8], p[k + 9])
        if p[k] == DIRECTION:
            C[row] = ax * bx + ay * by + az * bz
            continue
        cx, cy, cz = centre(q, i)
        dx, dy, dz = centre(q, j)
        if p[k] == POINT:
            C[row], C[row + 1], C[row + 2] = cx + ax - dx - bx, cy + ay - dy - by, cz + az - dz - bz
        else:
            sx, sy, sz = vector(q, i, p[k + 10], p[k + 11], p[k + 12])
            C[row] = ax * (dx + bx - cx - sx) + ay * (dy + by - cy - sy) + az * (dz + bz - cz - sz)


@callback("jacobian")
def jacobian(t, q, p, Cq):
    n = int(p[0])
    for body in range(n):
        for k in range(7 * body + 3, 7 * body + 7):
            Cq[body, k] = q[k]
    first = HEAD + 4 * n
    for k in range(first, first + JOINT * int(p[1]), JOINT):
        row, i, j = int(p[k + 1]), int(p[k + 2]), int(p[k + 6])
        a0, a1, a2, b0, b1, b2 = p[k + 3], p[k + 4], p[k + 5], p[k + 7], p[k + 8], p[k + 9]
        if p[k] == POINT:
            for axis in range(3):
                fx, fy, fz = 1.0 * (axis == 0), 1.0 * (axis == 1), 1.0 * (axis == 2)
                move_row(Cq[row + axis], i, fx, fy, fz)
                turn_row(q, Cq[row + axis], i, a0, a1, a2, fx, fy, fz)
                move_row(Cq[row + axis], j, -fx, -fy, -fz)
                turn_row(q, Cq[row + axis], j, b0, b1, b2, -fx, -fy, -fz)
            continue
        ax, ay, az = vector(q, i, a0, a1, a2)
        bx, by, bz = vector(q, j, b0, b1, b2)
        turn_row(q, Cq[row], j, b0, b1, b2, ax, ay, az)
        if p[k] == DIRECTION:
            turn_row(q, Cq[row], i, a0, a1, a2, bx, by, bz)
            continue
        cx, cy, cz = centre(q, i)
        dx, dy, dz = centre(q, j)
        sx, sy, sz = vector(q, i, p[k + 10], p[k + 11], p[k + 12])
        turn_row(q, Cq[row], i, a0, a1, a2, dx + bx - cx - sx, dy + by - cy - sy, dz + bz - cz - sz)
        turn_row(q, Cq[row], i, p[k + 10], p[k + 11], p[k + 12], -ax, -ay, -az)
        move_row(Cq[row], i, -ax, -ay, -az)
        move_row(Cq[row], j, ax, ay, az)


@callback("gamma")
def gamma(t, q, v, p, Qd):
    n = int(p[0])
    for body in range(n):
        k = 7 * body + 3
        Qd[body] = -(v[k] * v[k] + v[k + 1] * v[k + 1] + v[k + 2] * v[k + 2] + v[k + 3] * v[k + 3])
    first = HEAD + 4 * n
    for k in range(first, first + JOINT * int(p[1]), JOINT):
        row, i, j = int(p[k + 1]), int(p[k + 2]), int(p[k + 6])
        a0, a1, a2, b0, b1, b2 = p[k + 3], p[k + 4], p[k + 5], p[k + 7], p[k + 8], p[k + 9]
        aux, auy, auz, aax, aay, aaz = vector_rate(q, v, i, a0, a1, a2)
        bux, buy, buz, bax, bay, baz = vector_rate(q, v, j, b0, b1, b2)
        if p[k] == POINT:
            Qd[row], Qd[row + 1], Qd[row + 2] = bax - aax, bay - aay, baz - aaz
            continue
        ax, ay, az = vector(q, i, a0, a1, a2)
        bx, by, bz = vector(q, j, b0, b1, b2)
        if p[k] == DIRECTION:
            Qd[row] = -(aax * bx + aay * by + aaz * bz) - (ax * bax + ay * bay + az * baz)
            Qd[row] -= 2.0 * (aux * bux + auy * buy + auz * buz)
            continue
        cx, cy, cz = centre(q, i)
        dx, dy, dz = centre(q, j)
        sx, sy, sz = vector(q, i, p[k + 10], p[k + 11], p[k + 12])
        sux, suy, suz, sax, say, saz = vector_rate(q, v, i, p[k + 10], p[k + 11], p[k + 12])
        Qd[row] = -aax * (dx + bx - cx - sx) - aay * (dy + by - cy - sy) - aaz * (dz + bz - cz - sz)
        cx, cy, cz = centre(v, i)
        dx, dy, dz = centre(v, j)
        Qd[row] -= 2.0 * (aux * (dx + bux - cx - sux) + auy * (dy + buy - cy - suy) + auz * (dz + buz - cz - suz))
        Qd[row] -= ax * (bax - sax) + ay * (bay - say) + az * (baz - saz)


@callback("mass_values")
def mass_values(t, q, p, values):
    for body in range(int(p[0])):
        m, k, place = HEAD + 4 * body, 7 * body + 3, 19 * body
        e0, e1, e2, e3 = q[k], q[k + 1], q[k + 2], q[k + 3]
        G = ((-e1, e0, e3, -e2), (-e2, -e3, e0, e1), (-e3, e2, -e1, e0))
        values[place] = values[place + 1] = values[place + 2] = p[m]
        for i in range(4):
            for j in range(4):
                for axis in range(3):
                    values[place + 3 + 4 * i + j] += 4.0 * p[m + 1 + axis] * G[axis][i] * G[axis][j]


@callback("jacobian_values")
def jacobian_values(t, q, p, values):
    n = int(p[0])
    for body in range(n):
        for i in range(4):
            values[4 * body + i] = q[7 * body + 3 + i]
    first, at = HEAD + 4 * n, 4 * n
    for k in range(first, first + JOINT * int(p[1]), JOINT):
        i, j = int(p[k + 2]), int(p[k + 6])
        a0, a1, a2, b0, b1, b2 = p[k + 3], p[k + 4], p[k + 5], p[k + 7], p[k + 8], p[k + 9]
        if p[k] == POINT:
            for axis in range(3):
                fx, fy, fz = 1.0 * (axis == 0), 1.0 * (axis == 1), 1.0 * (axis == 2)
                if i >= 0:
                    values[at] = 1.0
                    at = put_turned(q, values, at + 1, i, a0, a1, a2, fx, fy, fz)
                if j >= 0:
                    values[at] = -1.0
                    at = put_turned(q, values, at + 1, j, b0, b1, b2, -fx, -fy, -fz)
            continue
        ax, ay, az = vector(q, i, a0, a1, a2)
        bx, by, bz = vector(q, j, b0, b1, b2)
        at = put_turned(q, values, at, j, b0, b1, b2, ax, ay, az)
        if p[k] == DIRECTION:
            at = put_turned(q, values, at, i, a0, a1, a2, bx, by, bz)
            continue
        cx, cy, cz = centre(q, i)
        dx, dy, dz = centre(q, j)
        sx, sy, sz = vector(q, i, p[k + 10], p[k + 11], p[k + 12])
        put_turned(q, values, at, i, a0, a1, a2, dx + bx - cx - sx, dy + by - cy - sy, dz + bz - cz - sz)
        at = put_turned(q, values, at, i, p[k + 10], p[k + 11], p[k + 12], -ax, -ay, -az)
        for body, sign in ((i, -1.0), (j, 1.0)):
            if body >= 0:
                values[at], values[at + 1], values[at + 2] = sign * ax, sign * ay, sign * az
                at += 3


def mass_entries(n: int) -> tuple[list[int], list[int]]:
    """Return rows and columns of the entries of `mass_values` for n bodies, in order."""
    rows, columns = [], []
    for first in range(0, 7 * n, 7):
        turned = range(first + 3, first + 7)
        rows += [*range(first, first + 3), *(i for i in turned for _ in turned)]
        columns += [*range(first, first + 3), *(j for _ in turned for j in turned)]
    return rows, columns


def jacobian_entries(n: int, joints: Sequence[Sequence[float]]) -> tuple[list[int], list[int]]:
    """Return rows and columns of the entries of `jacobian_values` for n bodies, in order."""
    rows = [body for body in range(n) for _ in TURNED]
    columns = [7 * body + k for body in range(n) for k in TURNED]

    def add(row: int, body: int, of_body: Sequence[int]) -> None:
        if body != GROUND:
            rows.extend([row] * len(of_body))
            columns.extend(7 * body + k for k in of_body)

    for kind, first, *numbers in joints:
        row, i, j = int(first), int(numbers[0]), int(numbers[4])
        if kind == POINT:
            for axis in range(3):
                add(row + axis, i, (axis, *TURNED))
                add(row + axis, j, (axis, *TURNED))
            continue
        add(row, j, TURNED)
        add(row, i, TURNED)
        if kind == PLANE:
            add(row, i, MOVED)
            add(row, j, MOVED)
    return rows, columns
