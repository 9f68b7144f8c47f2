"""Evaluate the callbacks of planar models with motions or forces that are functions, whose programs stand in p."""

import math

import numpy as np

from twoloop.bodies.parameter_layout import AXIAL_SPRING, FORCE_PROGRAM, MOTION_PROGRAM, TORSION_SPRING
from twoloop.bodies.planar.callbacks import (
    fill_constraint,
    fill_force,
    fill_gamma,
    fill_jacobian,
    fill_kinematics,
    fill_rate,
    fill_values,
)
from twoloop.bodies.planar.frames import angle_of, direction, motion, place
from twoloop.bodies.read_tables import (
    evaluate_program,
    fill_nonholonomic,
    fill_nonholonomic_gamma,
    force_at,
    n_spring_functions,
    put_spring_lengths,
)
from twoloop.kernels.compile.caches import helper
from twoloop.kernels.compile.callbacks import callback


@callback("force")
def force(t, q, v, p, Q):
    fill_force(q, v, p, evaluate_program(FORCE_PROGRAM, t, q, v, p), Q)


@callback("constraint")
def constraint(t, q, p, C):
    fill_constraint(q, p, evaluate_program(MOTION_PROGRAM, t, q, q, p), C)


@callback("jacobian")
def jacobian(t, q, p, Cq):
    fill_jacobian(q, p, evaluate_program(MOTION_PROGRAM, t, q, q, p), Cq)


@callback("jacobian_values")
def jacobian_values(t, q, p, values):
    fill_values(q, p, evaluate_program(MOTION_PROGRAM, t, q, q, p), values)


@callback("constraint_rate")
def constraint_rate(t, q, p, Ct):
    fill_rate(q, p, evaluate_program(MOTION_PROGRAM, t, q, q, p), Ct)


@callback("gamma")
def gamma(t, q, v, p, Qd):
    fill_gamma(q, v, p, evaluate_program(MOTION_PROGRAM, t, q, v, p), Qd)


@callback("kinematics")
def kinematics(t, q, v, p, C, Cq, Ct, Qd):
    fill_kinematics(q, v, p, evaluate_program(MOTION_PROGRAM, t, q, v, p), C, Cq, Ct, Qd)


@callback("nonholonomic")
def nonholonomic(t, q, p, A):
    fill_nonholonomic(p, evaluate_program(MOTION_PROGRAM, t, q, q, p), A)


@callback("nonholonomic_gamma")
def nonholonomic_gamma(t, q, v, p, Qa):
    fill_nonholonomic_gamma(p, evaluate_program(MOTION_PROGRAM, t, q, v, p), Qa)


@helper
def spring_length(q, v, p, k):
    """Return the length, angle or displacement of a spring and its rate."""
    kind, i, at_i, j, at_j, more, _, point_i = force_at(p, k)
    if kind == TORSION_SPRING:
        return angle_of(q, j) - angle_of(q, i) - p[more], angle_of(v, j) - angle_of(v, i)
    ax, ay, adx, ady = place(q, i, p, point_i if kind == AXIAL_SPRING else at_i)
    bx, by, bdx, bdy = place(q, j, p, at_j)
    au, aw, _, _ = motion(v, i, adx, ady)
    bu, bw, _, _ = motion(v, j, bdx, bdy)
    x, y, u, w = bx - ax, by - ay, bu - au, bw - aw
    if kind == AXIAL_SPRING:
        fx, fy = direction(q, i, p[at_i], False)
        return fx * x + fy * y, fx * u + fy * w + angle_of(v, i) * (fx * y - fy * x)
    length = math.sqrt(x * x + y * y)
    return length, (x * u + y * w) / length


@helper
def fill_spring_lengths(q, v, p, extended_q, extended_v):
    """Write q and v, and what `spring_length` returns for each spring whose force is a function."""
    put_spring_lengths(spring_length, q, v, p, extended_q, extended_v)


@callback("force")
def force_with_spring_functions(t, q, v, p, Q):
    n = q.size + n_spring_functions(p)
    extended_q, extended_v = np.zeros(n), np.zeros(n)
    fill_spring_lengths(q, v, p, extended_q, extended_v)
    fill_force(q, v, p, evaluate_program(FORCE_PROGRAM, t, extended_q, extended_v, p), Q)
