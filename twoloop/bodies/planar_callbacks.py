"""Callbacks of planar models; coordinates: centre of mass x, y and angle; for p see `parameter_layout`.

Those here read no results of programs, and are given p in their place; `planar_programs` has those of models with
motions or forces that are functions.
"""

import math

from twoloop.bodies import parameter_layout as layout
from twoloop.bodies import read_tables as tables
from twoloop.bodies.function_rows import fill_entries, put_entries
from twoloop.bodies.planar_places import motion, place_on
from twoloop.bodies.program_results import result
from twoloop.kernels.compile.caches import helper
from twoloop.kernels.compile.callbacks import callback

WEIGHT = 2  # components of gravity, which precede the numbers of the bodies


@helper
def angle_of(q, body):
    """Return the angle of a body, or its rate from v."""
    if body < 0:
        return 0.0
    return q[3 * body + 2]


@helper
def place(q, body, p, at):
    """Return the point of a body stored at index `at` of p and its derivative by the angle: x, y, dx, dy."""
    return place_on(q, body, p[at], p[at + 1])


@helper
def direction(q, body, angle, across):
    """Return the unit vector at an angle from the x axis of a body, or the one perpendicular to it."""
    total = angle + angle_of(q, body)
    s, c = math.sin(total), math.cos(total)
    if across:
        return -s, c
    return c, s


@helper
def add(row, body, fx, fy, dx, dy):
    """Add to a row (n_q,) the derivative of fx x + fy y of a point, i.e. the generalised force of (fx, fy) there."""
    if body >= 0:
        row[3 * body] += fx
        row[3 * body + 1] += fy
        row[3 * body + 2] += fx * dx + fy * dy


@helper
def turn(row, body, factor):
    """Add to a row the derivative of a multiple of the angle, i.e. the generalised force of a torque."""
    if body >= 0:
        row[3 * body + 2] += factor


@helper
def put_constraint(q, p, made, k, C):
    """Evaluate C of joint row k."""
    kind, row, i, at, j, there, more, moved = tables.joint_at(p, k)
    if kind == layout.WRITTEN:
        C[row] = made[moved]
        return
    if kind == layout.ANGLE:
        C[row] = angle_of(q, j) - angle_of(q, i) - p[more] - result(made, moved, 0)
        return
    ax, ay, _, _ = place(q, i, p, at)
    bx, by, _, _ = place(q, j, p, there)
    x, y = bx - ax, by - ay
    if kind == layout.PIN:
        C[row], C[row + 1] = x, y
    elif kind == layout.DISTANCE:
        C[row] = 0.5 * (x * x + y * y - p[more] * p[more])
    else:
        fx, fy = direction(q, i, p[more], kind == layout.ACROSS)
        C[row] = fx * x + fy * y - result(made, moved, 0)


@helper
def fill_constraint(q, p, made, C):
    """Evaluate C."""
    for k in tables.joint_places(p):
        if p[k] != layout.RATE:
            put_constraint(q, p, made, k, C)


@helper
def pin_rows(Cq, row, one, other, adx, ady, bdx, bdy):
    """Evaluate the two rows of a pin."""
    if one >= 0:
        Cq[row, 3 * one], Cq[row, 3 * one + 2] = -1.0, -adx
        Cq[row + 1, 3 * one + 1], Cq[row + 1, 3 * one + 2] = -1.0, -ady
    if other >= 0:
        Cq[row, 3 * other], Cq[row, 3 * other + 2] = 1.0, bdx
        Cq[row + 1, 3 * other + 1], Cq[row + 1, 3 * other + 2] = 1.0, bdy


@helper
def fill_rows(q, p, made, k, Cq, row, one, other):
    """Evaluate the rows of C_q of joint row k, from `row` on; `one` and `other` locate its bodies in Cq."""
    kind, _, i, at, j, there, more, moved = tables.joint_at(p, k)
    if kind == layout.WRITTEN:
        fill_entries(p, more, made, moved + 3, Cq[row])
        return
    if kind == layout.ANGLE:
        turn(Cq[row], other, 1.0)
        turn(Cq[row], one, -1.0)
        return
    ax, ay, adx, ady = place(q, i, p, at)
    bx, by, bdx, bdy = place(q, j, p, there)
    x, y = bx - ax, by - ay
    if kind == layout.PIN:
        pin_rows(Cq, row, one, other, adx, ady, bdx, bdy)
    elif kind == layout.DISTANCE:
        add(Cq[row], one, -x, -y, adx, ady)
        add(Cq[row], other, x, y, bdx, bdy)
    else:
        fx, fy = direction(q, i, p[more], kind == layout.ACROSS)
        add(Cq[row], one, -fx, -fy, adx - y, ady + x)
        add(Cq[row], other, fx, fy, bdx, bdy)


@helper
def fill_jacobian(q, p, made, Cq):
    """Evaluate C_q; `made`: results of the program of motions."""
    for k in tables.joint_places(p):
        kind, row, i, _, j, _, _, _ = tables.joint_at(p, k)
        if kind != layout.RATE:
            fill_rows(q, p, made, k, Cq, row, i, j)


@helper
def fill_rate(q, p, made, Ct):
    """Evaluate C_t, which only drives have."""
    for k in tables.joint_places(p):
        kind, row, _, _, _, _, _, moved = tables.joint_at(p, k)
        if moved >= 0 and kind != layout.RATE:
            Ct[row] = -made[moved + 1]  # zero for WRITTEN rows


@helper
def put_gamma(q, v, p, made, k, Qd):
    """Evaluate the right-hand side of C_q a = gamma of joint row k."""
    kind, row, i, at, j, there, more, moved = tables.joint_at(p, k)
    if kind == layout.WRITTEN:
        Qd[row] = made[moved + 2]
        return
    if kind == layout.ANGLE:
        Qd[row] = result(made, moved, 2)
        return
    ax, ay, adx, ady = place(q, i, p, at)
    bx, by, bdx, bdy = place(q, j, p, there)
    au, av, aa, ab = motion(v, i, adx, ady)
    bu, bv, ba, bb = motion(v, j, bdx, bdy)
    x, y, u, w, a, b = bx - ax, by - ay, bu - au, bv - av, ba - aa, bb - ab
    if kind == layout.PIN:
        Qd[row], Qd[row + 1] = -a, -b
    elif kind == layout.DISTANCE:
        Qd[row] = -u * u - w * w - x * a - y * b
    else:
        fx, fy = direction(q, i, p[more], kind == layout.ACROSS)
        rate = angle_of(v, i)
        turned = 2.0 * rate * (fx * w - fy * u)
        Qd[row] = result(made, moved, 2) - fx * a - fy * b - turned + rate * rate * (fx * x + fy * y)


@helper
def fill_gamma(q, v, p, made, Qd):
    """Evaluate the right-hand side of C_q a = gamma."""
    for k in tables.joint_places(p):
        if p[k] != layout.RATE:
            put_gamma(q, v, p, made, k, Qd)


@helper
def fill_force(q, v, p, made, Q):
    """Evaluate Q; `made`: results of the program of forces."""
    for body in range(tables.n_bodies(p)):
        mass = p[WEIGHT + layout.PLANAR_BODY * body]
        Q[3 * body] += mass * p[0]
        Q[3 * body + 1] += mass * p[1]
    for k in tables.force_places(p):
        kind, i, at, j, there, more, given, on_first = tables.force_at(p, k)
        if kind in (layout.TORQUE, layout.TORSION, layout.BRAKE):
            rate = angle_of(v, j) - angle_of(v, i)
            if kind == layout.TORSION and given >= 0:
                torque = -made[given]
            elif kind == layout.TORSION:
                torque = -p[more] * (angle_of(q, j) - angle_of(q, i) - p[more + 2]) - p[more + 1] * rate
            elif kind == layout.BRAKE:
                torque = -p[more] * math.tanh(rate / p[more + 1])
            else:
                torque = made[given] if given >= 0 else p[more]
            turn(Q, j, torque)
            turn(Q, i, -torque)
            continue
        bx, by, bdx, bdy = place(q, j, p, there)
        if kind == layout.FORCE:
            if given >= 0:
                add(Q, j, made[given], made[given + 1], bdx, bdy)
            else:
                add(Q, j, p[more], p[more + 1], bdx, bdy)
            continue
        if kind in (layout.SLIDE, layout.RAIL, layout.RUB):  # applied at the point of j on both bodies
            fx, fy = direction(q, i, p[at], False)
            u, w, _, _ = motion(v, j, bdx, bdy)
            if i >= 0:
                rate = v[3 * i + 2]
                u, w = u - v[3 * i] + rate * (by - q[3 * i + 1]), w - v[3 * i + 1] - rate * (bx - q[3 * i])
            if kind == layout.RAIL and given >= 0:
                f = -made[given]
            elif kind == layout.RAIL:
                ax, ay, _, _ = place(q, i, p, on_first)
                f = -p[more] * (fx * (bx - ax) + fy * (by - ay) - p[more + 2]) - p[more + 1] * (fx * u + fy * w)
            elif kind == layout.RUB:
                f = -p[more] * math.tanh((fx * u + fy * w) / p[more + 1])
            else:
                f = made[given] if given >= 0 else p[more]
            add(Q, j, f * fx, f * fy, bdx, bdy)
            if i >= 0:
                add(Q, i, -f * fx, -f * fy, q[3 * i + 1] - by, bx - q[3 * i])
            continue
        ax, ay, adx, ady = place(q, i, p, at)
        x, y = bx - ax, by - ay
        if kind == layout.PULL:
            x, y = p[more] * x, p[more] * y
        elif given >= 0:
            pull = made[given] / math.sqrt(x * x + y * y)
            x, y = pull * x, pull * y
        else:
            length = math.sqrt(x * x + y * y)
            x, y = x / length, y / length
            au, av, _, _ = motion(v, i, adx, ady)
            bu, bv, _, _ = motion(v, j, bdx, bdy)
            pull = p[more] * (length - p[more + 2]) + p[more + 1] * (x * (bu - au) + y * (bv - av))
            x, y = pull * x, pull * y
        add(Q, i, x, y, adx, ady)
        add(Q, j, -x, -y, bdx, bdy)


@helper
def fill_kinematics(q, v, p, made, C, Cq, Ct, Qd):
    """Evaluate C, C_q, C_t and gamma together."""
    for k in tables.joint_places(p):
        kind, row, i, at, j, there, _, _ = tables.joint_at(p, k)
        if kind == layout.PIN:  # most joints are pins: each of their sines is needed once
            ax, ay, adx, ady = place(q, i, p, at)
            bx, by, bdx, bdy = place(q, j, p, there)
            _, _, aa, ab = motion(v, i, adx, ady)
            _, _, ba, bb = motion(v, j, bdx, bdy)
            C[row], C[row + 1], Qd[row], Qd[row + 1] = bx - ax, by - ay, aa - ba, ab - bb
            pin_rows(Cq, row, i, j, adx, ady, bdx, bdy)
        elif kind != layout.RATE:
            put_constraint(q, p, made, k, C)
            fill_rows(q, p, made, k, Cq, row, i, j)
            put_gamma(q, v, p, made, k, Qd)
    fill_rate(q, p, made, Ct)


@helper
def fill_values(q, p, made, values):
    """Evaluate the entries of C_q."""
    begin = 0
    for k in tables.joint_places(p):
        kind, _, i, _, j, _, more, moved = tables.joint_at(p, k)
        if kind == layout.WRITTEN:
            begin = put_entries(p, more, made, moved + 3, values, begin)
        elif kind == layout.ANGLE:
            for body, sign in ((i, -1.0), (j, 1.0)):
                if body >= 0:
                    values[begin] = sign
                    begin += 1
        elif kind != layout.RATE:
            one, n_rows = (0 if i >= 0 else -1), (2 if kind == layout.PIN else 1)
            other = one + 1 if j >= 0 else -1
            end = begin + n_rows * 3 * ((i >= 0) + (j >= 0))
            fill_rows(q, p, made, k, values[begin:end].reshape(n_rows, (end - begin) // n_rows), 0, one, other)
            begin = end


@callback("mass", allocates=False)
def mass(t, q, p, M):
    for body in range(tables.n_bodies(p)):
        at = WEIGHT + layout.PLANAR_BODY * body
        M[3 * body, 3 * body] = M[3 * body + 1, 3 * body + 1] = p[at]
        M[3 * body + 2, 3 * body + 2] = p[at + 1]


@callback("mass_values", allocates=False)
def mass_values(t, q, p, values):
    for body in range(tables.n_bodies(p)):
        at = WEIGHT + layout.PLANAR_BODY * body
        values[3 * body] = values[3 * body + 1] = p[at]
        values[3 * body + 2] = p[at + 1]


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
