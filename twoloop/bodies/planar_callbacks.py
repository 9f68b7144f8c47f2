"""The callbacks of all planar models: bodies by x, y of the centre of mass and an angle; p: see `parameter_layout`."""

import math

import numpy as np

from twoloop.bodies.function_rows import fill_entries, fill_nonholonomic, fill_nonholonomic_gamma, take_entries
from twoloop.bodies.parameter_layout import (
    ACROSS,
    ANGLE,
    BODIES,
    BRAKE,
    DISTANCE,
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
    MORE,
    MOTION,
    MOTION_PROGRAM,
    N_FORCES,
    N_JOINTS,
    PIN,
    PLANAR_BODY,
    PULL,
    RAIL,
    RATE,
    ROW,
    RUB,
    SECOND,
    SECOND_AT,
    SLIDE,
    TORQUE,
    TORSION,
    WRITTEN,
)
from twoloop.bodies.program_results import result, results
from twoloop.kernels.compile.caches import helper
from twoloop.kernels.compile.callbacks import callback
from twoloop.mechanisms.planar import motion
from twoloop.mechanisms.planar import place as place_on

WEIGHT = 2  # numbers of gravity, before those of the bodies


@helper
def angle_of(q, body):
    """The angle of a body; also its rate, of v."""
    if body < 0:
        return 0.0
    return q[3 * body + 2]


@helper
def place(q, body, p, at):
    """The point of a body whose two numbers stand in p, and its derivative by the angle: x, y, dx, dy."""
    return place_on(q, body, p[at], p[at + 1])


@helper
def direction(q, body, angle, across):
    """The unit vector at an angle from the x axis of a body, or the one across it."""
    total = angle + angle_of(q, body)
    s, c = math.sin(total), math.cos(total)
    if across:
        return -s, c
    return c, s


@helper
def add(row, body, fx, fy, dx, dy):
    """Add to a row (n_q,) the derivative of fx x + fy y of a point: the generalised force of (fx, fy) there."""
    if body >= 0:
        row[3 * body] += fx
        row[3 * body + 1] += fy
        row[3 * body + 2] += fx * dx + fy * dy


@helper
def turn(row, body, factor):
    """Add to a row the derivative of a multiple of the angle: the generalised force of a torque."""
    if body >= 0:
        row[3 * body + 2] += factor


@helper
def fill_constraint(q, p, made, C):
    """C."""
    first, n = int(p[p.size - HEAD + JOINTS]), int(p[p.size - HEAD + N_JOINTS])
    for k in range(first, first + JOINT_WIDTH * n, JOINT_WIDTH):
        kind, row, i, j = int(p[k + KIND]), int(p[k + ROW]), int(p[k + FIRST]), int(p[k + SECOND])
        more, moved = int(p[k + MORE]), result(made, int(p[k + MOTION]), 0)
        if kind == RATE:
            continue
        if kind == WRITTEN:
            C[row] = made[int(p[k + MOTION])]
            continue
        if kind == ANGLE:
            C[row] = angle_of(q, j) - angle_of(q, i) - p[more] - moved
            continue
        ax, ay, _, _ = place(q, i, p, int(p[k + FIRST_AT]))
        bx, by, _, _ = place(q, j, p, int(p[k + SECOND_AT]))
        x, y = bx - ax, by - ay
        if kind == PIN:
            C[row], C[row + 1] = x, y
        elif kind == DISTANCE:
            C[row] = 0.5 * (x * x + y * y - p[more] * p[more])
        else:
            fx, fy = direction(q, i, p[more], kind == ACROSS)
            C[row] = fx * x + fy * y - moved


@helper
def fill_rows(q, p, made, k, Cq, row):
    """The rows of C_q of the part of a joint that stands at place k, from a row on."""
    kind, i, j = int(p[k + KIND]), int(p[k + FIRST]), int(p[k + SECOND])
    if kind == WRITTEN:
        fill_entries(p, k, made, int(p[k + MOTION]) + 3, Cq[row])
        return
    if kind == ANGLE:
        turn(Cq[row], j, 1.0)
        turn(Cq[row], i, -1.0)
        return
    ax, ay, adx, ady = place(q, i, p, int(p[k + FIRST_AT]))
    bx, by, bdx, bdy = place(q, j, p, int(p[k + SECOND_AT]))
    x, y = bx - ax, by - ay
    if kind == PIN:
        add(Cq[row], i, -1.0, 0.0, adx, ady)
        add(Cq[row], j, 1.0, 0.0, bdx, bdy)
        add(Cq[row + 1], i, 0.0, -1.0, adx, ady)
        add(Cq[row + 1], j, 0.0, 1.0, bdx, bdy)
    elif kind == DISTANCE:
        add(Cq[row], i, -x, -y, adx, ady)
        add(Cq[row], j, x, y, bdx, bdy)
    else:
        fx, fy = direction(q, i, p[int(p[k + MORE])], kind == ACROSS)
        add(Cq[row], i, -fx, -fy, adx - y, ady + x)
        add(Cq[row], j, fx, fy, bdx, bdy)


@helper
def fill_jacobian(q, p, made, Cq):
    """C_q; `made`: results of the program of motions."""
    first, n = int(p[p.size - HEAD + JOINTS]), int(p[p.size - HEAD + N_JOINTS])
    for k in range(first, first + JOINT_WIDTH * n, JOINT_WIDTH):
        if int(p[k + KIND]) != RATE:
            fill_rows(q, p, made, k, Cq, int(p[k + ROW]))


@helper
def fill_rate(q, p, made, Ct):
    """C_t, of drives alone."""
    first, n = int(p[p.size - HEAD + JOINTS]), int(p[p.size - HEAD + N_JOINTS])
    for k in range(first, first + JOINT_WIDTH * n, JOINT_WIDTH):
        if int(p[k + MOTION]) >= 0 and int(p[k + KIND]) != RATE:
            Ct[int(p[k + ROW])] = -result(made, int(p[k + MOTION]), 1)  # zero of WRITTEN rows


@helper
def fill_gamma(q, v, p, made, Qd):
    """The right-hand side of C_q a = gamma."""
    first, n = int(p[p.size - HEAD + JOINTS]), int(p[p.size - HEAD + N_JOINTS])
    for k in range(first, first + JOINT_WIDTH * n, JOINT_WIDTH):
        kind, row, i, j = int(p[k + KIND]), int(p[k + ROW]), int(p[k + FIRST]), int(p[k + SECOND])
        more, moved = int(p[k + MORE]), result(made, int(p[k + MOTION]), 2)
        if kind == RATE:
            continue
        if kind == WRITTEN:
            Qd[row] = made[int(p[k + MOTION]) + 2]
            continue
        if kind == ANGLE:
            Qd[row] = moved
            continue
        ax, ay, adx, ady = place(q, i, p, int(p[k + FIRST_AT]))
        bx, by, bdx, bdy = place(q, j, p, int(p[k + SECOND_AT]))
        au, av, aa, ab = motion(v, i, adx, ady)
        bu, bv, ba, bb = motion(v, j, bdx, bdy)
        x, y, u, w, a, b = bx - ax, by - ay, bu - au, bv - av, ba - aa, bb - ab
        if kind == PIN:
            Qd[row], Qd[row + 1] = -a, -b
        elif kind == DISTANCE:
            Qd[row] = -u * u - w * w - x * a - y * b
        else:
            fx, fy = direction(q, i, p[more], kind == ACROSS)
            rate = angle_of(v, i)
            Qd[row] = moved - fx * a - fy * b - 2.0 * rate * (fx * w - fy * u) + rate * rate * (fx * x + fy * y)


@helper
def fill_force(q, v, p, made, Q):
    """Q; `made`: results of the program of forces."""
    for body in range(int(p[p.size - HEAD + BODIES])):
        mass = p[WEIGHT + PLANAR_BODY * body]
        Q[3 * body] += mass * p[0]
        Q[3 * body + 1] += mass * p[1]
    first, n = int(p[p.size - HEAD + FORCES]), int(p[p.size - HEAD + N_FORCES])
    for k in range(first, first + FORCE_WIDTH * n, FORCE_WIDTH):
        kind, i, j, more = int(p[k + F_KIND]), int(p[k + F_FIRST]), int(p[k + F_SECOND]), int(p[k + F_MORE])
        given = int(p[k + F_RESULT])
        if kind in (TORQUE, TORSION, BRAKE):
            rate = angle_of(v, j) - angle_of(v, i)
            if kind == TORSION:
                torque = -p[more] * (angle_of(q, j) - angle_of(q, i) - p[more + 2]) - p[more + 1] * rate
            elif kind == BRAKE:
                torque = -p[more] * math.tanh(rate / p[more + 1])
            elif given >= 0:
                torque = made[given]
            else:
                torque = p[more]
            turn(Q, j, torque)
            turn(Q, i, -torque)
            continue
        bx, by, bdx, bdy = place(q, j, p, int(p[k + F_SECOND_AT]))
        if kind == FORCE:
            if given >= 0:
                add(Q, j, made[given], made[given + 1], bdx, bdy)
            else:
                add(Q, j, p[more], p[more + 1], bdx, bdy)
            continue
        at = int(p[k + F_FIRST_AT])
        if kind in (SLIDE, RAIL, RUB):  # at the point of j, also on i
            fx, fy = direction(q, i, p[at], False)
            u, w, _, _ = motion(v, j, bdx, bdy)
            if i >= 0:
                rate = v[3 * i + 2]
                u, w = u - v[3 * i] + rate * (by - q[3 * i + 1]), w - v[3 * i + 1] - rate * (bx - q[3 * i])
            if kind == RAIL:
                ax, ay, _, _ = place(q, i, p, int(p[k + F_ON_FIRST]))
                push = -p[more] * (fx * (bx - ax) + fy * (by - ay) - p[more + 2]) - p[more + 1] * (fx * u + fy * w)
            elif kind == RUB:
                push = -p[more] * math.tanh((fx * u + fy * w) / p[more + 1])
            elif given >= 0:
                push = made[given]
            else:
                push = p[more]
            add(Q, j, push * fx, push * fy, bdx, bdy)
            if i >= 0:
                add(Q, i, -push * fx, -push * fy, q[3 * i + 1] - by, bx - q[3 * i])
            continue
        ax, ay, adx, ady = place(q, i, p, at)
        x, y = bx - ax, by - ay
        if kind == PULL:
            x, y = p[more] * x, p[more] * y
        else:
            length = math.sqrt(x * x + y * y)
            x, y = x / length, y / length
            au, av, _, _ = motion(v, i, adx, ady)
            bu, bv, _, _ = motion(v, j, bdx, bdy)
            pull = p[more] * (length - p[more + 2]) + p[more + 1] * (x * (bu - au) + y * (bv - av))
            x, y = pull * x, pull * y
        add(Q, i, x, y, adx, ady)
        add(Q, j, -x, -y, bdx, bdy)


@callback("mass")
def mass(t, q, p, M):
    for body in range(int(p[p.size - HEAD + BODIES])):
        at = WEIGHT + PLANAR_BODY * body
        M[3 * body, 3 * body] = M[3 * body + 1, 3 * body + 1] = p[at]
        M[3 * body + 2, 3 * body + 2] = p[at + 1]


@callback("force")
def force(t, q, v, p, Q):
    fill_force(q, v, p, results(int(p[p.size - HEAD + FORCE_PROGRAM]), t, q, v, p), Q)


@callback("constraint")
def constraint(t, q, p, C):
    fill_constraint(q, p, results(int(p[p.size - HEAD + MOTION_PROGRAM]), t, q, q, p), C)


@callback("jacobian")
def jacobian(t, q, p, Cq):
    fill_jacobian(q, p, results(int(p[p.size - HEAD + MOTION_PROGRAM]), t, q, q, p), Cq)


@callback("mass_values")
def mass_values(t, q, p, values):
    for body in range(int(p[p.size - HEAD + BODIES])):
        at = WEIGHT + PLANAR_BODY * body
        values[3 * body] = values[3 * body + 1] = p[at]
        values[3 * body + 2] = p[at + 1]


@callback("jacobian_values")
def jacobian_values(t, q, p, values):
    made = results(int(p[p.size - HEAD + MOTION_PROGRAM]), t, q, q, p)
    rows, at = np.zeros((2, q.size), dtype=q.dtype), 0
    first, n = int(p[p.size - HEAD + JOINTS]), int(p[p.size - HEAD + N_JOINTS])
    for k in range(first, first + JOINT_WIDTH * n, JOINT_WIDTH):
        if int(p[k + KIND]) != RATE:
            fill_rows(q, p, made, k, rows, 0)
            for row in range(2 if int(p[k + KIND]) == PIN else 1):
                at = take_entries(p, k, 3, 2 * (int(p[k + KIND]) == ANGLE), rows[row], values, at)


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
