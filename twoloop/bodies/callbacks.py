"""Evaluate the callbacks of models, in the plane and in space alike, from their parameters (see `parameter_layout`).

In space the first rows are e.e = 1 for each body, followed by those of the joints, and the mass matrix has rank 6 of 7
for each body, because 4 G^T J G has rank 3.
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
    push_row,
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
    """Return the direction of body i of a row that has one, in its axes and in space."""
    if kind == layout.ANGLE_DRIVE:
        a, _, _ = driven_direction(p, at, results, first_result)
        return a, vector(q, w, i, a)
    a, n = axis(q, w, i, p, at)
    if kind == layout.ACROSS:
        n = -n[1], n[0], n[2]
    return a, n


@merged
def bend(w, spin, n, n_rate, n_bias, b, b_rate, b_bias):
    """Return the second derivative of n . b without the accelerations, for a vector n of a body."""
    if w == PLANAR:
        return dot(n, b_bias) + 2.0 * spin * (n[0] * b_rate[1] - n[1] * b_rate[0]) - spin * spin * dot(n, b)
    return dot(n_bias, b) + 2.0 * dot(n_rate, b_rate) + dot(n, b_bias)


@merged
def put_constraint(q, p, w, results, k, C):
    """Evaluate C of joint row k."""
    kind, row, i, at_i, j, at_j, more, first_result = joint_at(p, k)
    if kind == layout.ROW_FUNCTION:
        C[row] = results[first_result]
    elif kind == layout.ANGLE:
        C[row] = angle_of(q, j) - angle_of(q, i) - p[more] - result(results, first_result, 0)
    elif kind in (layout.PERPENDICULAR, layout.ANGLE_DRIVE):
        _, n = direction(q, p, w, kind, i, at_i, results, first_result)
        C[row] = dot(n, vector(q, w, j, numbers(p, w, at_j)))
    elif kind != layout.RATE_FUNCTION:
        end_i = plus(centre(q, w, i), vector(q, w, i, numbers(p, w, at_i)))
        d = minus(plus(centre(q, w, j), vector(q, w, j, numbers(p, w, at_j))), end_i)
        if kind == layout.POINT:
            C[row], C[row + 1] = d[0], d[1]
            if w != PLANAR:
                C[row + 2] = d[2]
        elif kind == layout.LENGTH:
            C[row] = 0.5 * (dot(d, d) - p[more] * p[more])
        else:
            _, n = direction(q, p, w, kind, i, more, results, first_result)
            C[row] = dot(n, d) - result(results, first_result, 0)


@merged
def put_rows(q, p, w, results, k, Cq, row, c_i, c_j):
    """Evaluate the rows of C_q of joint row k, from `row` on; c_i and c_j: columns where its bodies begin."""
    kind, _, i, at_i, j, at_j, more, first_result = joint_at(p, k)
    if kind == layout.ROW_FUNCTION:
        fill_entries(p, more, results, first_result + 3, Cq[row])
    elif kind == layout.ANGLE:
        if i >= 0:
            Cq[row, c_i + 2] = -1.0
        if j >= 0:
            Cq[row, c_j + 2] = 1.0
    elif kind in (layout.PERPENDICULAR, layout.ANGLE_DRIVE):
        a, n = direction(q, p, w, kind, i, at_i, results, first_result)
        b = numbers(p, w, at_j)
        arm = vector(q, w, j, b)
        turn_row(q, Cq[row], w, j, c_j, b, arm, n)
        turn_row(q, Cq[row], w, i, c_i, a, n, arm)
    elif kind != layout.RATE_FUNCTION:
        a, b = numbers(p, w, at_i), numbers(p, w, at_j)
        arm_i, arm_j = vector(q, w, i, a), vector(q, w, j, b)
        if kind == layout.POINT:
            put_point_rows(q, Cq, row, w, i, c_i, a, arm_i, -1.0)
            put_point_rows(q, Cq, row, w, j, c_j, b, arm_j, 1.0)
            return
        d = minus(plus(centre(q, w, j), arm_j), plus(centre(q, w, i), arm_i))
        if kind == layout.LENGTH:
            push_row(q, Cq[row], w, i, c_i, a, arm_i, times(-1.0, d))
            push_row(q, Cq[row], w, j, c_j, b, arm_j, d)
            return
        local, n = direction(q, p, w, kind, i, more, results, first_result)
        push_row(q, Cq[row], w, j, c_j, b, arm_j, n)
        move_row(Cq[row], w, c_i, times(-1.0, n))
        if w == PLANAR:  # the point and the direction turn by the same angle
            turn_row(q, Cq[row], w, i, c_i, local, n, plus(arm_i, d))
        else:
            turn_row(q, Cq[row], w, i, c_i, a, arm_i, times(-1.0, n))
            turn_row(q, Cq[row], w, i, c_i, local, n, d)


@merged
def put_rate(q, p, w, results, k, Ct):
    """Evaluate C_t of joint row k, which only drives have."""
    kind, row, i, at_i, j, at_j, _, first_result = joint_at(p, k)
    if first_result >= 0 and kind == layout.ANGLE_DRIVE:
        _, rate, _ = driven_direction(p, at_i, results, first_result)
        Ct[row] = dot(vector(q, w, i, rate), vector(q, w, j, numbers(p, w, at_j)))
    elif first_result >= 0 and kind != layout.RATE_FUNCTION:
        Ct[row] = -results[first_result + 1]  # zero for ROW_FUNCTION rows


@merged
def put_gamma(q, v, p, w, results, k, Qd):
    """Evaluate the right-hand side of C_q a = gamma of joint row k."""
    kind, row, i, at_i, j, at_j, more, first_result = joint_at(p, k)
    spin = angle_of(v, i) if w == PLANAR else 0.0
    if kind == layout.ROW_FUNCTION:
        Qd[row] = results[first_result + 2]
    elif kind == layout.ANGLE:
        Qd[row] = result(results, first_result, 2)
    elif kind in (layout.PERPENDICULAR, layout.ANGLE_DRIVE):
        a, n = direction(q, p, w, kind, i, at_i, results, first_result)
        b = numbers(p, w, at_j)
        arm = vector(q, w, j, b)
        n_rate, n_bias = rate_of(q, v, w, i, a, n), bias_of(v, w, i, a, n)
        if kind == layout.ANGLE_DRIVE:  # the direction also moves relative to body i
            _, rate, faster = driven_direction(p, at_i, results, first_result)
            moving = vector(q, w, i, rate)
            n_bias = plus(n_bias, times(2.0, rate_of(q, v, w, i, rate, moving)))
            n_rate, n_bias = plus(n_rate, moving), plus(n_bias, vector(q, w, i, faster))
        Qd[row] = -bend(w, spin, n, n_rate, n_bias, arm, rate_of(q, v, w, j, b, arm), bias_of(v, w, j, b, arm))
    elif kind != layout.RATE_FUNCTION:
        a, b = numbers(p, w, at_i), numbers(p, w, at_j)
        arm_i, arm_j = vector(q, w, i, a), vector(q, w, j, b)
        bias = minus(bias_of(v, w, j, b, arm_j), bias_of(v, w, i, a, arm_i))
        if kind == layout.POINT:
            Qd[row], Qd[row + 1] = -bias[0], -bias[1]
            if w != PLANAR:
                Qd[row + 2] = -bias[2]
            return
        d = minus(plus(centre(q, w, j), arm_j), plus(centre(q, w, i), arm_i))
        end_rate = plus(centre(v, w, i), rate_of(q, v, w, i, a, arm_i))
        rate = minus(plus(centre(v, w, j), rate_of(q, v, w, j, b, arm_j)), end_rate)
        if kind == layout.LENGTH:
            Qd[row] = -(dot(rate, rate) + dot(d, bias))
            return
        local, n = direction(q, p, w, kind, i, more, results, first_result)
        n_rate, n_bias = rate_of(q, v, w, i, local, n), bias_of(v, w, i, local, n)
        Qd[row] = result(results, first_result, 2) - bend(w, spin, n, n_rate, n_bias, d, rate, bias)


@helper
def fill_constraint(q, p, results, C):
    """Evaluate C."""
    w = coordinates_of(p)
    if w != PLANAR:
        for body in range(n_bodies(p)):
            k = 7 * body + 3
            C[body] = 0.5 * (q[k] * q[k] + q[k + 1] * q[k + 1] + q[k + 2] * q[k + 2] + q[k + 3] * q[k + 3] - 1.0)
    for k in joint_places(p):
        put_constraint(q, p, w, results, k, C)


@helper
def fill_jacobian(q, p, results, Cq):
    """Evaluate C_q; `results`: those of the program of motions."""
    w = coordinates_of(p)
    if w != PLANAR:
        for body in range(n_bodies(p)):
            for k in range(7 * body + 3, 7 * body + 7):
                Cq[body, k] = q[k]
    for k in joint_places(p):
        _, row, i, _, j, _, _, _ = joint_at(p, k)
        put_rows(q, p, w, results, k, Cq, row, w * i, w * j)


@helper
def fill_rate(q, p, results, Ct):
    """Evaluate C_t."""
    for k in joint_places(p):
        put_rate(q, p, coordinates_of(p), results, k, Ct)


@helper
def fill_gamma(q, v, p, results, Qd):
    """Evaluate the right-hand side of C_q a = gamma."""
    w = coordinates_of(p)
    if w != PLANAR:
        for body in range(n_bodies(p)):
            k = 7 * body + 3
            Qd[body] = -(v[k] * v[k] + v[k + 1] * v[k + 1] + v[k + 2] * v[k + 2] + v[k + 3] * v[k + 3])
    for k in joint_places(p):
        put_gamma(q, v, p, w, results, k, Qd)


@helper
def fill_kinematics(q, v, p, results, C, Cq, Ct, Qd):
    """Evaluate C, C_q, C_t and gamma of a model in the plane together."""
    for k in joint_places(p):
        kind, row, i, at_i, j, at_j, _, _ = joint_at(p, k)
        if kind == layout.POINT:  # most joints are pins: each of their sines is needed once
            a, b = numbers(p, PLANAR, at_i), numbers(p, PLANAR, at_j)
            arm_i, arm_j = vector(q, PLANAR, i, a), vector(q, PLANAR, j, b)
            d = minus(plus(centre(q, PLANAR, j), arm_j), plus(centre(q, PLANAR, i), arm_i))
            bias = minus(bias_of(v, PLANAR, j, b, arm_j), bias_of(v, PLANAR, i, a, arm_i))
            C[row], C[row + 1], Qd[row], Qd[row + 1] = d[0], d[1], -bias[0], -bias[1]
            put_point_rows(q, Cq, row, PLANAR, i, 3 * i, a, arm_i, -1.0)
            put_point_rows(q, Cq, row, PLANAR, j, 3 * j, b, arm_j, 1.0)
        else:
            put_constraint(q, p, PLANAR, results, k, C)
            put_rows(q, p, PLANAR, results, k, Cq, row, 3 * i, 3 * j)
            put_rate(q, p, PLANAR, results, k, Ct)
            put_gamma(q, v, p, PLANAR, results, k, Qd)


@helper
def put_mass(q, p, body, M, first):
    """Evaluate the diagonal block of M of a body in space, from row and column `first` on."""
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
            if kind in (layout.ANGLE, layout.PERPENDICULAR, layout.ANGLE_DRIVE):  # these depend on rotations only
                skipped = w - (1 if w == PLANAR else 4)
            elif kind == layout.POINT:
                n_rows = 2 if w == PLANAR else 3
            n_i, n_j = (w - skipped if i >= 0 else 0), (w - skipped if j >= 0 else 0)
            end = begin + n_rows * (n_i + n_j)
            rows = values[begin:end].reshape(n_rows, n_i + n_j)
            put_rows(q, p, w, results, k, rows, 0, -skipped if i >= 0 else -w, n_i - skipped if j >= 0 else -w)
            begin = end


@inlined
def motion_results(t, q, v, p):
    """Return the results of drives and of rows that are functions; p in their place if there are none."""
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
    fill_constraint(q, p, p, C)


@callback("jacobian", allocates=False)
def jacobian(t, q, p, Cq):
    fill_jacobian(q, p, p, Cq)


@callback("jacobian_values", allocates=False)
def jacobian_values(t, q, p, values):
    fill_values(q, p, p, values)


@callback("gamma", allocates=False)
def gamma(t, q, v, p, Qd):
    fill_gamma(q, v, p, p, Qd)


@callback("kinematics", allocates=False)
def kinematics(t, q, v, p, C, Cq, Ct, Qd):
    fill_kinematics(q, v, p, p, C, Cq, Ct, Qd)
