"""Evaluate the callbacks of models, in the plane and in space alike, from their parameters (see `parameter_layout`).

In space the rows e.e = 1 of the bodies come before the rows of the joints, and the block of each body in the mass
matrix, 7 by 7, has rank 6, because 4 G^T J G has rank 3.
"""

import math

import numpy as np

from twoloop.bodies import parameter_layout as layout
from twoloop.bodies.forces import fill_force, inertia, inertia_at
from twoloop.bodies.geometry import (
    PLANAR,
    angle_of,
    axis,
    bias_of,
    centre,
    coordinates_of,
    dot,
    merged,
    minus,
    move_row,
    numbers,
    plus,
    put_point_rows,
    rate_of,
    times,
    turn_row,
    vector,
)
from twoloop.bodies.read_tables import (
    fill_entries,
    joint_at,
    joint_places,
    n_bodies,
    put_entries,
    result,
    results_within,
)
from twoloop.bodies.rotors import put_rotors
from twoloop.kernels.compile.caches import helper
from twoloop.kernels.compile.callbacks import callback
from twoloop.kernels.data.common import inlined


@merged
def driven_direction(p, at, results, first_result):
    """Return the direction of i perpendicular to b of j at a prescribed angle, and its first two derivatives."""
    s, c = math.sin(result(results, first_result, 0)), math.cos(result(results, first_result, 0))
    rate, bend = result(results, first_result, 1), result(results, first_result, 2)
    first, second = (p[at], p[at + 1], p[at + 2]), (p[at + 3], p[at + 4], p[at + 5])
    along, across = minus(times(c, second), times(s, first)), plus(times(c, first), times(s, second))
    return along, times(-rate, across), minus(times(-bend, across), times(rate * rate, along))


@merged
def direction(q, p, w, kind, i, at, results, first_result):
    """Return the direction of body i in a row that has one, in the axes of the body and in space."""
    if kind == layout.ANGLE_DRIVE:
        a, _, _ = driven_direction(p, at, results, first_result)
        return a, vector(q, w, i, a)
    a, n = axis(q, w, i, p, at)
    if kind == layout.ACROSS:
        n = -n[1], n[0], n[2]
    return a, n


@merged
def put_row(q, v, p, w, results, k, C, Cq, Qd, first, c_i, c_j):
    """Evaluate row k of the table of joints: its entries of C, C_q and gamma, except arrays that are None.

    Most rows are n . d = m: n is a direction of body i; d a vector from a point of i to a point of j, or a direction of
    j; m the motion. `first`: the row in C_q; c_i and c_j: the columns where the coordinates of the bodies begin.
    """
    kind, row, i, at_i, j, at_j, more, motion = joint_at(p, k)
    if kind == layout.RATE_FUNCTION:
        return
    if kind == layout.ROW_FUNCTION:
        if C is not None:
            C[row] = results[motion]
        if Cq is not None:
            fill_entries(p, more, results, motion + 3, Cq[first])
        if Qd is not None:
            Qd[row] = results[motion + 2]
        return
    if kind == layout.ANGLE:
        if C is not None:
            C[row] = angle_of(q, j) - angle_of(q, i) - p[more] - result(results, motion, 0)
        if Cq is not None:
            if i >= 0:
                Cq[first, c_i + 2] = -1.0
            if j >= 0:
                Cq[first, c_j + 2] = 1.0
        if Qd is not None:
            Qd[row] = result(results, motion, 2)
        return
    joins_points = kind not in (layout.PERPENDICULAR, layout.ANGLE_DRIVE)
    a, b = (0.0, 0.0, 0.0), numbers(p, w, at_j)
    arm_i, arm_j = a, vector(q, w, j, b)
    d = arm_j
    if joins_points:
        a = numbers(p, w, at_i)
        arm_i = vector(q, w, i, a)
        d = minus(plus(centre(q, w, j), arm_j), plus(centre(q, w, i), arm_i))
    if kind == layout.POINT:
        if C is not None:
            for x in range(2 if w == PLANAR else 3):
                C[row + x] = d[x]
        if Cq is not None:
            put_point_rows(q, Cq, first, w, i, c_i, a, arm_i, -1.0)
            put_point_rows(q, Cq, first, w, j, c_j, b, arm_j, 1.0)
        if Qd is not None:
            bias = minus(bias_of(v, w, j, b, arm_j), bias_of(v, w, i, a, arm_i))
            for x in range(2 if w == PLANAR else 3):
                Qd[row + x] = -bias[x]
        return
    if kind == layout.LENGTH:
        local, n = a, d
    else:
        local, n = direction(q, p, w, kind, i, more if joins_points else at_i, results, motion)
    if C is not None:
        if kind == layout.LENGTH:
            C[row] = 0.5 * (dot(d, d) - p[more] * p[more])
        elif kind == layout.ANGLE_DRIVE:
            C[row] = dot(n, d)
        else:
            C[row] = dot(n, d) - result(results, motion, 0)
    if Cq is not None:
        turn_row(q, Cq[first], w, j, c_j, b, arm_j, n)
        if joins_points:
            move_row(Cq[first], w, c_j, n)
            move_row(Cq[first], w, c_i, times(-1.0, n))
        if w == PLANAR and kind != layout.LENGTH:  # the point and the direction turn by the same angle
            turn_row(q, Cq[first], w, i, c_i, local, n, plus(arm_i, d))
        else:
            if joins_points:
                turn_row(q, Cq[first], w, i, c_i, a, arm_i, times(-1.0, n))
            if kind != layout.LENGTH:
                turn_row(q, Cq[first], w, i, c_i, local, n, d)
    if Qd is not None:
        rate, bias = rate_of(q, v, w, j, b, arm_j), bias_of(v, w, j, b, arm_j)
        if joins_points:
            rate = minus(plus(centre(v, w, j), rate), plus(centre(v, w, i), rate_of(q, v, w, i, a, arm_i)))
            bias = minus(bias, bias_of(v, w, i, a, arm_i))
        if kind == layout.LENGTH:
            Qd[row] = -(dot(rate, rate) + dot(d, bias))
            return
        n_rate, n_bias = rate_of(q, v, w, i, local, n), bias_of(v, w, i, local, n)
        bend = result(results, motion, 2)
        if kind == layout.ANGLE_DRIVE:  # the direction also moves relative to body i
            _, moving, faster = driven_direction(p, at_i, results, motion)
            slope = vector(q, w, i, moving)
            n_bias = plus(n_bias, times(2.0, rate_of(q, v, w, i, moving, slope)))
            n_rate, n_bias, bend = plus(n_rate, slope), plus(n_bias, vector(q, w, i, faster)), 0.0
        if w == PLANAR:
            turn = angle_of(v, i)
            total = dot(n, bias) + 2.0 * turn * (n[0] * rate[1] - n[1] * rate[0]) - turn * turn * dot(n, d)
        else:
            total = dot(n_bias, d) + 2.0 * dot(n_rate, rate) + dot(n, bias)
        Qd[row] = bend - total


@helper
def fill_rows(q, v, p, results, C, Cq, Ct, Qd):
    """Evaluate C, C_q, C_t and gamma, except arrays that are None; `results`: results of the program of motions."""
    w = coordinates_of(p)
    if w != PLANAR:
        for body in range(n_bodies(p)):
            length = speed = 0.0
            for k in range(7 * body + 3, 7 * body + 7):
                length, speed = length + q[k] * q[k], speed + v[k] * v[k]
                if Cq is not None:
                    Cq[body, k] = q[k]
            if C is not None:
                C[body] = 0.5 * (length - 1.0)
            if Qd is not None:
                Qd[body] = -speed
    for k in joint_places(p):
        kind, row, i, at_i, j, at_j, _, first_result = joint_at(p, k)
        put_row(q, v, p, w, results, k, C, Cq, Qd, row, w * i, w * j)
        if Ct is not None:  # nonzero only for drives
            if first_result >= 0 and kind == layout.ANGLE_DRIVE:
                _, rate, _ = driven_direction(p, at_i, results, first_result)
                Ct[row] = dot(vector(q, w, i, rate), vector(q, w, j, numbers(p, w, at_j)))
            elif first_result >= 0 and kind != layout.RATE_FUNCTION:
                Ct[row] = -results[first_result + 1]  # zero for ROW_FUNCTION rows


@helper
def put_mass(q, p, body, M, first):
    """Evaluate the diagonal block of M for a body in space; the block begins at row and column `first`."""
    m, k = inertia_at(p, 7, body), 7 * body + 3
    e0, e1, e2, e3 = q[k], q[k + 1], q[k + 2], q[k + 3]
    columns = ((-e1, -e2, -e3), (e0, -e3, e2), (e3, e0, -e1), (-e2, e1, e0))  # columns of G
    for i in range(3):
        M[first + i, first + i] = p[m]
    for j in range(4):
        a = inertia(p, m, times(4.0, columns[j]))
        for i in range(4):
            M[first + 3 + i, first + 3 + j] = dot(columns[i], a)


@helper
def fill_values(q, p, results, values):
    """Evaluate the entries of C_q."""
    w = coordinates_of(p)
    begin = 0 if w == PLANAR else 4 * n_bodies(p)
    for k in range(begin):
        values[k] = q[7 * (k // 4) + 3 + k % 4]
    for k in joint_places(p):
        kind, _, i, _, j, _, columns, first_result = joint_at(p, k)
        if kind == layout.ROW_FUNCTION:
            begin = put_entries(p, columns, results, first_result + 3, values, begin)
        elif kind != layout.RATE_FUNCTION:
            skipped, n_rows = 0, 1
            if kind in (layout.ANGLE, layout.PERPENDICULAR, layout.ANGLE_DRIVE):  # rows that depend on rotations only
                skipped = w - (1 if w == PLANAR else 4)
            elif kind == layout.POINT:
                n_rows = 2 if w == PLANAR else 3
            n_i, n_j = (w - skipped if i >= 0 else 0), (w - skipped if j >= 0 else 0)
            end = begin + n_rows * (n_i + n_j)
            rows = values[begin:end].reshape(n_rows, n_i + n_j)
            c_i, c_j = (-skipped if i >= 0 else -w), (n_i - skipped if j >= 0 else -w)
            put_row(q, q, p, w, results, k, None, rows, None, 0, c_i, c_j)
            begin = end


@inlined
def motion_results(t, q, v, p):
    """Return the results of the program of motions (drives, and rows that are functions); p if there is no program."""
    place = int(p[p.size - layout.HEAD + layout.MOTION_PROGRAM])
    if place < 0:
        return p
    return results_within(place, t, q, v, p)


@callback("mass", allocates=False)
def mass(t, q, p, M):
    w = coordinates_of(p)
    for body in range(n_bodies(p)):
        if w == PLANAR:
            at = inertia_at(p, w, body)
            M[3 * body, 3 * body] = M[3 * body + 1, 3 * body + 1] = p[at]
            M[3 * body + 2, 3 * body + 2] = p[at + 1]
        else:
            put_mass(q, p, body, M, 7 * body)
    put_rotors(q, w, p, M)


@callback("mass_values")
def mass_values(t, q, p, values):
    w = coordinates_of(p)
    block = np.zeros((7, 7), dtype=q.dtype)
    for body in range(n_bodies(p)):
        if w == PLANAR:
            at = inertia_at(p, w, body)
            values[3 * body] = values[3 * body + 1] = p[at]
            values[3 * body + 2] = p[at + 1]
        else:
            put_mass(q, p, body, block, 0)
            for i in range(3):
                values[19 * body + i] = block[i, i]
            for i in range(16):
                values[19 * body + 3 + i] = block[3 + i // 4, 3 + i % 4]


@callback("force", allocates=False)
def force(t, q, v, p, Q):
    fill_force(q, v, p, p, Q)


@callback("constraint", allocates=False)
def constraint(t, q, p, C):
    fill_rows(q, q, p, p, C, None, None, None)


@callback("jacobian", allocates=False)
def jacobian(t, q, p, Cq):
    fill_rows(q, q, p, p, None, Cq, None, None)


@callback("jacobian_values", allocates=False)
def jacobian_values(t, q, p, values):
    fill_values(q, p, p, values)


@callback("gamma", allocates=False)
def gamma(t, q, v, p, Qd):
    fill_rows(q, v, p, p, None, None, None, Qd)


@callback("kinematics", allocates=False)
def kinematics(t, q, v, p, C, Cq, Ct, Qd):
    fill_rows(q, v, p, p, C, Cq, Ct, Qd)
