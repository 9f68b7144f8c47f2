"""Evaluate the callbacks of planar models, from their parameters p (see `parameter_layout`).

Coordinates of a body: centre of mass x, y and angle.

Those here read no results of programs, and are given p in their place; `programs` has those of models with motions
or forces that are functions.
"""

import math

from twoloop.bodies import parameter_layout as layout
from twoloop.bodies import read_tables as tables
from twoloop.bodies.planar.frames import add, angle_of, direction, motion, place, turn
from twoloop.bodies.program_results import result
from twoloop.bodies.read_tables import fill_entries, put_entries
from twoloop.bodies.rotors import put_planar_rotors
from twoloop.kernels.compile.caches import helper
from twoloop.kernels.compile.callbacks import callback

WEIGHT = 2  # components of gravity, which precede the numbers of the bodies


@helper
def put_constraint(q, p, results, k, C):
    """Evaluate C of joint row k."""
    kind, row, i, at_i, j, at_j, more, first_result = tables.joint_at(p, k)
    if kind == layout.ROW_FUNCTION:
        C[row] = results[first_result]
        return
    if kind == layout.ANGLE:
        C[row] = angle_of(q, j) - angle_of(q, i) - p[more] - result(results, first_result, 0)
        return
    ax, ay, _, _ = place(q, i, p, at_i)
    bx, by, _, _ = place(q, j, p, at_j)
    x, y = bx - ax, by - ay
    if kind == layout.PIN:
        C[row], C[row + 1] = x, y
    elif kind == layout.DISTANCE:
        C[row] = 0.5 * (x * x + y * y - p[more] * p[more])
    else:
        fx, fy = direction(q, i, p[more], kind == layout.ACROSS)
        C[row] = fx * x + fy * y - result(results, first_result, 0)


@helper
def fill_constraint(q, p, results, C):
    """Evaluate C."""
    for k in tables.joint_places(p):
        if p[k] != layout.RATE_FUNCTION:
            put_constraint(q, p, results, k, C)


@helper
def pin_rows(Cq, row, block_i, block_j, adx, ady, bdx, bdy):
    """Evaluate the two rows of a pin."""
    if block_i >= 0:
        Cq[row, 3 * block_i], Cq[row, 3 * block_i + 2] = -1.0, -adx
        Cq[row + 1, 3 * block_i + 1], Cq[row + 1, 3 * block_i + 2] = -1.0, -ady
    if block_j >= 0:
        Cq[row, 3 * block_j], Cq[row, 3 * block_j + 2] = 1.0, bdx
        Cq[row + 1, 3 * block_j + 1], Cq[row + 1, 3 * block_j + 2] = 1.0, bdy


@helper
def fill_rows(q, p, results, k, Cq, row, block_i, block_j):
    """Evaluate the rows of C_q of joint row k, from `row` on; `block_i` and `block_j` locate its bodies in Cq."""
    kind, _, i, at_i, j, at_j, more, first_result = tables.joint_at(p, k)
    if kind == layout.ROW_FUNCTION:
        fill_entries(p, more, results, first_result + 3, Cq[row])
        return
    if kind == layout.ANGLE:
        turn(Cq[row], block_j, 1.0)
        turn(Cq[row], block_i, -1.0)
        return
    ax, ay, adx, ady = place(q, i, p, at_i)
    bx, by, bdx, bdy = place(q, j, p, at_j)
    x, y = bx - ax, by - ay
    if kind == layout.PIN:
        pin_rows(Cq, row, block_i, block_j, adx, ady, bdx, bdy)
    elif kind == layout.DISTANCE:
        add(Cq[row], block_i, -x, -y, adx, ady)
        add(Cq[row], block_j, x, y, bdx, bdy)
    else:
        fx, fy = direction(q, i, p[more], kind == layout.ACROSS)
        add(Cq[row], block_i, -fx, -fy, adx - y, ady + x)
        add(Cq[row], block_j, fx, fy, bdx, bdy)


@helper
def fill_jacobian(q, p, results, Cq):
    """Evaluate C_q; `results`: those of the program of motions."""
    for k in tables.joint_places(p):
        kind, row, i, _, j, _, _, _ = tables.joint_at(p, k)
        if kind != layout.RATE_FUNCTION:
            fill_rows(q, p, results, k, Cq, row, i, j)


@helper
def fill_rate(q, p, results, Ct):
    """Evaluate C_t, which only drives have."""
    for k in tables.joint_places(p):
        kind, row, _, _, _, _, _, first_result = tables.joint_at(p, k)
        if first_result >= 0 and kind != layout.RATE_FUNCTION:
            Ct[row] = -results[first_result + 1]  # zero for ROW_FUNCTION rows


@helper
def put_gamma(q, v, p, results, k, Qd):
    """Evaluate the right-hand side of C_q a = gamma of joint row k."""
    kind, row, i, at_i, j, at_j, more, first_result = tables.joint_at(p, k)
    if kind == layout.ROW_FUNCTION:
        Qd[row] = results[first_result + 2]
        return
    if kind == layout.ANGLE:
        Qd[row] = result(results, first_result, 2)
        return
    ax, ay, adx, ady = place(q, i, p, at_i)
    bx, by, bdx, bdy = place(q, j, p, at_j)
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
        coriolis = 2.0 * rate * (fx * w - fy * u)
        Qd[row] = result(results, first_result, 2) - fx * a - fy * b - coriolis + rate * rate * (fx * x + fy * y)


@helper
def fill_gamma(q, v, p, results, Qd):
    """Evaluate the right-hand side of C_q a = gamma."""
    for k in tables.joint_places(p):
        if p[k] != layout.RATE_FUNCTION:
            put_gamma(q, v, p, results, k, Qd)


@helper
def fill_force(q, v, p, results, Q):
    """Evaluate Q; `results`: those of the program of forces."""
    for body in range(tables.n_bodies(p)):
        mass = p[WEIGHT + layout.PLANAR_BODY * body]
        Q[3 * body] += mass * p[0]
        Q[3 * body + 1] += mass * p[1]
    for k in tables.force_places(p):
        kind, i, at_i, j, at_j, more, first_result, point_i = tables.force_at(p, k)
        if kind == layout.HINGE_ROTOR:
            continue
        if kind in (layout.TORQUE, layout.TORSION_SPRING, layout.HINGE_FRICTION):
            rate = angle_of(v, j) - angle_of(v, i)
            if kind == layout.TORSION_SPRING:
                torque = -tables.spring_tension(angle_of(q, j) - angle_of(q, i), rate, p, more, results, first_result)
            else:
                torque = tables.joint_force(kind, rate, p, more, results, first_result)
            turn(Q, j, torque)
            turn(Q, i, -torque)
            continue
        bx, by, bdx, bdy = place(q, j, p, at_j)
        if kind == layout.FORCE:
            fx = tables.force_value(p, more, results, first_result, 0)
            add(Q, j, fx, tables.force_value(p, more, results, first_result, 1), bdx, bdy)
            continue
        if kind in (layout.AXIAL_FORCE, layout.AXIAL_SPRING, layout.AXIAL_FRICTION):  # on both at the point of j
            fx, fy = direction(q, i, p[at_i], False)
            u, w, _, _ = motion(v, j, bdx, bdy)
            if i >= 0:
                rate = v[3 * i + 2]
                u, w = u - v[3 * i] + rate * (by - q[3 * i + 1]), w - v[3 * i + 1] - rate * (bx - q[3 * i])
            if kind == layout.AXIAL_SPRING:
                ax, ay, _, _ = place(q, i, p, point_i)
                length = fx * (bx - ax) + fy * (by - ay)
                f = -tables.spring_tension(length, fx * u + fy * w, p, more, results, first_result)
            else:
                f = tables.joint_force(kind, fx * u + fy * w, p, more, results, first_result)
            add(Q, j, f * fx, f * fy, bdx, bdy)
            if i >= 0:
                add(Q, i, -f * fx, -f * fy, q[3 * i + 1] - by, bx - q[3 * i])
            continue
        ax, ay, adx, ady = place(q, i, p, at_i)
        x, y = bx - ax, by - ay
        if kind == layout.ZERO_LENGTH_SPRING:
            x, y = p[more] * x, p[more] * y
        else:
            length = math.sqrt(x * x + y * y)
            x, y = x / length, y / length
            au, av, _, _ = motion(v, i, adx, ady)
            bu, bv, _, _ = motion(v, j, bdx, bdy)
            rate = x * (bu - au) + y * (bv - av)
            tension = tables.spring_tension(length, rate, p, more, results, first_result)
            x, y = tension * x, tension * y
        add(Q, i, x, y, adx, ady)
        add(Q, j, -x, -y, bdx, bdy)


@helper
def fill_kinematics(q, v, p, results, C, Cq, Ct, Qd):
    """Evaluate C, C_q, C_t and gamma together."""
    for k in tables.joint_places(p):
        kind, row, i, at_i, j, at_j, _, _ = tables.joint_at(p, k)
        if kind == layout.PIN:  # most joints are pins: each of their sines is needed once
            ax, ay, adx, ady = place(q, i, p, at_i)
            bx, by, bdx, bdy = place(q, j, p, at_j)
            _, _, aa, ab = motion(v, i, adx, ady)
            _, _, ba, bb = motion(v, j, bdx, bdy)
            C[row], C[row + 1], Qd[row], Qd[row + 1] = bx - ax, by - ay, aa - ba, ab - bb
            pin_rows(Cq, row, i, j, adx, ady, bdx, bdy)
        elif kind != layout.RATE_FUNCTION:
            put_constraint(q, p, results, k, C)
            fill_rows(q, p, results, k, Cq, row, i, j)
            put_gamma(q, v, p, results, k, Qd)
    fill_rate(q, p, results, Ct)


@helper
def fill_values(q, p, results, values):
    """Evaluate the entries of C_q."""
    begin = 0
    for k in tables.joint_places(p):
        kind, _, i, _, j, _, more, first_result = tables.joint_at(p, k)
        if kind == layout.ROW_FUNCTION:
            begin = put_entries(p, more, results, first_result + 3, values, begin)
        elif kind == layout.ANGLE:
            for body, sign in ((i, -1.0), (j, 1.0)):
                if body >= 0:
                    values[begin] = sign
                    begin += 1
        elif kind != layout.RATE_FUNCTION:
            block_i, n_rows = (0 if i >= 0 else -1), (2 if kind == layout.PIN else 1)
            block_j = block_i + 1 if j >= 0 else -1
            end = begin + n_rows * 3 * ((i >= 0) + (j >= 0))
            fill_rows(q, p, results, k, values[begin:end].reshape(n_rows, (end - begin) // n_rows), 0, block_i, block_j)
            begin = end


@callback("mass", allocates=False)
def mass(t, q, p, M):
    for body in range(tables.n_bodies(p)):
        at = WEIGHT + layout.PLANAR_BODY * body
        M[3 * body, 3 * body] = M[3 * body + 1, 3 * body + 1] = p[at]
        M[3 * body + 2, 3 * body + 2] = p[at + 1]
    put_planar_rotors(p, M)


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
