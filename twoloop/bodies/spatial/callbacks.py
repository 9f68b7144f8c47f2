"""Evaluate the callbacks of spatial models, from their parameters p (see `parameter_layout`).

Coordinates of a body: centre of mass x, y, z and Euler parameters.

Those here read no results of programs, and are given p in their place; `programs` has those of models with motions
or forces that are functions.

The first rows are e.e = 1 for each body, followed by those of the joints. The mass matrix has rank 6 of 7 for each
body, because 4 G^T J G has rank 3.
"""

import math

import numpy as np

from twoloop.bodies import parameter_layout as layout
from twoloop.bodies.program_results import result
from twoloop.bodies.read_tables import fill_entries, joint_at, joint_places, n_bodies, put_entries
from twoloop.bodies.rotors import put_spatial_rotors
from twoloop.bodies.spatial.forces import (
    WEIGHT,
    dot,
    fill_force,
    inertia,
    minus,
    motion,
    numbers,
    place,
    plus,
    push_row,
    put_point_rows,
    times,
    turn_row,
    vector,
    vector_rate,
)
from twoloop.kernels.compile.caches import helper
from twoloop.kernels.compile.callbacks import callback
from twoloop.kernels.data.common import inlined


@helper
def driven_direction(p, at, results, first_result):
    """Return the direction of i perpendicular to b of j at a prescribed angle, and its first two derivatives."""
    s, c = math.sin(result(results, first_result, 0)), math.cos(result(results, first_result, 0))
    rate, bend = result(results, first_result, 1), result(results, first_result, 2)
    first, second = numbers(p, at), numbers(p, at + 3)
    along, across = minus(times(c, second), times(s, first)), plus(times(c, first), times(s, second))
    return along, times(-rate, across), minus(times(-bend, across), times(rate * rate, along))


@helper
def direction(p, kind, at, results, first_result):
    """Return the direction of body i of a row that depends on one."""
    if kind == layout.ANGLE_DRIVE:
        return driven_direction(p, at, results, first_result)[0]
    return numbers(p, at)


@inlined
def bend(a, au, aa, b, bu, ba):
    """Return the second derivative of a . b without the accelerations; au and aa: first and second derivative of a."""
    return dot(aa, b) + 2.0 * dot(au, bu) + dot(a, ba)


@helper
def fill_constraint(q, p, results, C):
    """Evaluate C."""
    for body in range(n_bodies(p)):
        k = 7 * body + 3
        C[body] = 0.5 * (q[k] * q[k] + q[k + 1] * q[k + 1] + q[k + 2] * q[k + 2] + q[k + 3] * q[k + 3] - 1.0)
    for k in joint_places(p):
        kind, row, i, at_i, j, at_j, more, first_result = joint_at(p, k)
        if kind == layout.ROW_FUNCTION:
            C[row] = results[first_result]
        elif kind in (layout.PERPENDICULAR, layout.ANGLE_DRIVE):
            a = direction(p, kind, at_i, results, first_result)
            C[row] = dot(vector(q, i, a), vector(q, j, numbers(p, at_j)))
        elif kind == layout.PLANE:
            d = minus(place(q, j, p, at_j), place(q, i, p, more))
            C[row] = dot(vector(q, i, numbers(p, at_i)), d) - result(results, first_result, 0)
        elif kind != layout.RATE_FUNCTION:
            d = minus(place(q, j, p, at_j), place(q, i, p, at_i))
            if kind == layout.POINT:
                C[row], C[row + 1], C[row + 2] = d
            else:
                C[row] = 0.5 * (dot(d, d) - p[more] * p[more])


@inlined
def fill_rows(q, p, results, k, Cq, row):
    """Evaluate the rows of C_q of joint row k, from `row` on."""
    kind, _, i, at_i, j, at_j, more, first_result = joint_at(p, k)
    if kind == layout.ROW_FUNCTION:
        fill_entries(p, more, results, first_result + 3, Cq[row])
        return
    if kind == layout.POINT:
        put_point_rows(q, Cq, row, i, numbers(p, at_i), -1.0)
        put_point_rows(q, Cq, row, j, numbers(p, at_j), 1.0)
        return
    if kind == layout.LENGTH:
        d = minus(place(q, j, p, at_j), place(q, i, p, at_i))
        push_row(q, Cq[row], i, p, at_i, times(-1.0, d))
        push_row(q, Cq[row], j, p, at_j, d)
        return
    a, b = direction(p, kind, at_i, results, first_result), numbers(p, at_j)
    n = vector(q, i, a)
    if kind == layout.PLANE:
        push_row(q, Cq[row], j, p, at_j, n)
        push_row(q, Cq[row], i, p, more, times(-1.0, n))
        turn_row(q, Cq[row], i, a, minus(place(q, j, p, at_j), place(q, i, p, more)))
    else:
        turn_row(q, Cq[row], j, b, n)
        turn_row(q, Cq[row], i, a, vector(q, j, b))


@helper
def fill_jacobian(q, p, results, Cq):
    """Evaluate C_q; `results`: those of the program of motions."""
    for body in range(n_bodies(p)):
        for k in range(7 * body + 3, 7 * body + 7):
            Cq[body, k] = q[k]
    for k in joint_places(p):
        kind, row, _, _, _, _, _, _ = joint_at(p, k)
        if kind != layout.RATE_FUNCTION:
            fill_rows(q, p, results, k, Cq, row)


@helper
def fill_rate(q, p, results, Ct):
    """Evaluate C_t, which only drives have."""
    for k in joint_places(p):
        kind, row, i, at_i, j, at_j, _, first_result = joint_at(p, k)
        if first_result >= 0 and kind == layout.ANGLE_DRIVE:
            _, rate, _ = driven_direction(p, at_i, results, first_result)
            Ct[row] = dot(vector(q, i, rate), vector(q, j, numbers(p, at_j)))
        elif first_result >= 0 and kind != layout.RATE_FUNCTION:
            Ct[row] = -results[first_result + 1]


@helper
def fill_gamma(q, v, p, results, Qd):
    """Evaluate the right-hand side of C_q a = gamma."""
    for body in range(n_bodies(p)):
        k = 7 * body + 3
        Qd[body] = -(v[k] * v[k] + v[k + 1] * v[k + 1] + v[k + 2] * v[k + 2] + v[k + 3] * v[k + 3])
    for k in joint_places(p):
        kind, row, i, at_i, j, at_j, more, first_result = joint_at(p, k)
        if kind == layout.RATE_FUNCTION:
            continue
        if kind == layout.ROW_FUNCTION:
            Qd[row] = results[first_result + 2]
            continue
        if kind in (layout.PERPENDICULAR, layout.ANGLE_DRIVE):
            a, b = direction(p, kind, at_i, results, first_result), numbers(p, at_j)
            au, aa = vector_rate(q, v, i, a)
            bu, ba = vector_rate(q, v, j, b)
            if kind == layout.ANGLE_DRIVE:  # the direction also moves relative to body i
                _, rate, faster = driven_direction(p, at_i, results, first_result)
                ru, _ = vector_rate(q, v, i, rate)
                au = plus(au, vector(q, i, rate))
                aa = plus(plus(aa, times(2.0, ru)), vector(q, i, faster))
            Qd[row] = -bend(vector(q, i, a), au, aa, vector(q, j, b), bu, ba)
            continue
        point_i = more if kind == layout.PLANE else at_i
        bu, ba = motion(q, v, j, p, at_j)
        su, sa = motion(q, v, i, p, point_i)
        if kind == layout.POINT:
            Qd[row], Qd[row + 1], Qd[row + 2] = minus(sa, ba)
            continue
        d = minus(place(q, j, p, at_j), place(q, i, p, point_i))
        du, da = minus(bu, su), minus(ba, sa)
        if kind == layout.PLANE:
            nu, na = vector_rate(q, v, i, numbers(p, at_i))
            n = vector(q, i, numbers(p, at_i))
            Qd[row] = result(results, first_result, 2) - bend(n, nu, na, d, du, da)
        else:
            Qd[row] = -(dot(du, du) + dot(d, da))


@helper
def fill_mass(q, p, body, M, first):
    """Evaluate the diagonal block of M of a body, from row and column `first` on."""
    m, k = WEIGHT + layout.SPATIAL_BODY * body, 7 * body + 3
    e0, e1, e2, e3 = q[k], q[k + 1], q[k + 2], q[k + 3]
    columns = ((-e1, -e2, -e3), (e0, -e3, e2), (e3, e0, -e1), (-e2, e1, e0))  # columns of G
    for i in range(3):
        M[first + i, first + i] = p[m]
    for j in range(4):
        a = inertia(p, m, times(4.0, columns[j]))
        for i in range(4):
            M[first + 3 + i, first + 3 + j] = dot(columns[i], a)


@callback("mass", allocates=False)
def mass(t, q, p, M):
    for body in range(n_bodies(p)):
        fill_mass(q, p, body, M, 7 * body)
    put_spatial_rotors(q, p, M)


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
def fill_values(q, p, results, rows, values):
    """Evaluate the entries of C_q; `rows` (3, n_q): zeros, which they are again afterwards."""
    at = 4 * n_bodies(p)
    for k in range(at):
        values[k] = q[7 * (k // 4) + 3 + k % 4]
    for k in joint_places(p):
        kind, _, i, _, j, _, columns, first_result = joint_at(p, k)
        if kind == layout.ROW_FUNCTION:
            at = put_entries(p, columns, results, first_result + 3, values, at)
        elif kind != layout.RATE_FUNCTION:
            fill_rows(q, p, results, k, rows, 0)
            skipped = 3 * (kind in (layout.PERPENDICULAR, layout.ANGLE_DRIVE))  # rows that depend on the rotation only
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
