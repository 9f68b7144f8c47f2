"""Evaluate the callbacks of spatial models with motions or forces that are functions, whose programs stand in p."""

import math

import numpy as np

from twoloop.bodies.parameter_layout import AXIAL_SPRING, FORCE_PROGRAM, MOTION_PROGRAM, TORSION_SPRING
from twoloop.bodies.read_tables import (
    evaluate_program,
    fill_nonholonomic,
    fill_nonholonomic_gamma,
    force_at,
    n_spring_functions,
    put_spring_lengths,
)
from twoloop.bodies.spatial.callbacks import (
    fill_constraint,
    fill_gamma,
    fill_jacobian,
    fill_rate,
    fill_values,
)
from twoloop.bodies.spatial.forces import dot, fill_force, minus, numbers, place, slip, spin, torsion, vector, velocity
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
    rows = np.zeros((3, q.size), dtype=q.dtype)
    fill_values(q, p, evaluate_program(MOTION_PROGRAM, t, q, q, p), rows, values)


@callback("constraint_rate")
def constraint_rate(t, q, p, Ct):
    fill_rate(q, p, evaluate_program(MOTION_PROGRAM, t, q, q, p), Ct)


@callback("gamma")
def gamma(t, q, v, p, Qd):
    fill_gamma(q, v, p, evaluate_program(MOTION_PROGRAM, t, q, v, p), Qd)


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
        axis = vector(q, i, numbers(p, at_i))
        rate = dot(axis, minus(spin(q, v, j), spin(q, v, i)))
        return torsion(q, i, j, p, at_i, at_j, 1.0, p[more]), rate
    d = minus(place(q, j, p, at_j), place(q, i, p, point_i if kind == AXIAL_SPRING else at_i))
    if kind == AXIAL_SPRING:
        axis = vector(q, i, numbers(p, at_i))
        _, u = slip(q, v, i, j, p, at_j)
        return dot(axis, d), dot(axis, u)
    length = math.sqrt(dot(d, d))
    return length, dot(d, minus(velocity(q, v, j, p, at_j), velocity(q, v, i, p, at_i))) / length


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
