"""Evaluate gravity, springs, motors, friction, given forces and torques, in the plane and in space alike."""

import math

import numpy as np

from twoloop.bodies import parameter_layout as layout
from twoloop.bodies.geometry import (
    PLANAR,
    add_turning,
    angle_of,
    axis,
    centre,
    coordinates_of,
    cross,
    dot,
    merged,
    minus,
    move_row,
    numbers,
    parameters_of,
    plus,
    product,
    push_row,
    rate_of,
    spin,
    times,
    twist_row,
    vector,
)
from twoloop.bodies.read_tables import force_at, force_places, n_bodies, results_within
from twoloop.bodies.rotation import half_spin
from twoloop.bodies.rotors import put_rotor_force
from twoloop.kernels.compile.caches import helper
from twoloop.kernels.data.common import inlined

FARTHEST = -math.cos(0.95 * math.pi)  # 0.95 of a turn


@merged
def value(p, more, results, first_result, i):
    """Return number i of a force, from p or, if the force is a function, from `results`."""
    if first_result >= 0:
        return results[first_result + i]
    return p[more + i]


@merged
def tension_of(length, rate, p, more, results, first_result):
    """Return the force of a spring and damper, from p or, if the force is a function, from `results`."""
    if first_result >= 0:
        return results[first_result]
    return p[more] * (length - p[more + 2]) + p[more + 1] * rate


@merged
def joint_force(kind, rate, p, more, results, first_result):
    """Return the force of friction or of a motor in a joint with the given rate."""
    if kind in (layout.HINGE_FRICTION, layout.AXIAL_FRICTION):
        return -p[more] * math.tanh(rate / p[more + 1])
    return value(p, more, results, first_result, 0)


@merged
def torsion(q, w, i, j, p, at_i, zero, stiffness, angle):
    """Return the torque of a spring on the rotation of body j about an axis (3 numbers in p) of body i, minus an angle.

    In space the rotation is measured from the relative Euler parameters stored at `zero` in p. They determine the angle
    only within one turn to either side, where it would jump; shortly before a whole turn, the torque becomes NaN.
    """
    if w == PLANAR:
        return stiffness * (angle_of(q, j) - angle_of(q, i) - angle)
    e0, e1, e2, e3 = parameters_of(q, i)
    b0, b1, b2, b3 = parameters_of(q, j)
    r0, r1, r2, r3 = product(e0, -e1, -e2, -e3, b0, b1, b2, b3)
    c, x, y, z = product(r0, r1, r2, r3, p[zero], -p[zero + 1], -p[zero + 2], -p[zero + 3])
    s = x * p[at_i] + y * p[at_i + 1] + z * p[at_i + 2]
    r = math.sqrt(c * c + s * s)
    left = c + FARTHEST * r
    root = math.sqrt(stiffness * left)  # a damper without stiffness has no such limit
    return root * root / left * (4.0 * math.atan(s / (c + r)) - angle)


@merged
def slip(q, v, w, i, j, b, arm):
    """Return the vector from the centre of body i to a point of body j, and this point's velocity seen from body i."""
    d = minus(plus(centre(q, w, j), arm), centre(q, w, i))
    velocity = plus(centre(v, w, j), rate_of(q, v, w, j, b, arm))
    return d, minus(velocity, plus(centre(v, w, i), cross(spin(q, v, w, i), d)))


@merged
def hinge_rate(q, v, w, i, j, n):
    """Return the rate of rotation of body j on body i about an axis in space."""
    return dot(n, minus(spin(q, v, w, j), spin(q, v, w, i)))


@merged
def ends(q, w, i, at_i, j, at_j, p):
    """Return the ends of a spring in the axes of their bodies, their arms in space, and the vector between them."""
    a, b = numbers(p, w, at_i), numbers(p, w, at_j)
    arm_i, arm_j = vector(q, w, i, a), vector(q, w, j, b)
    return a, arm_i, b, arm_j, minus(plus(centre(q, w, j), arm_j), plus(centre(q, w, i), arm_i))


@merged
def stretch_rate(q, v, w, i, a, arm_i, j, b, arm_j, d):
    """Return d times the velocity of the point of body j relative to the point of body i."""
    u_i = plus(centre(v, w, i), rate_of(q, v, w, i, a, arm_i))
    u_j = plus(centre(v, w, j), rate_of(q, v, w, j, b, arm_j))
    return dot(d, minus(u_j, u_i))


@merged
def spring_length(q, v, p, k):
    """Return the length, angle or displacement of a spring, and its rate."""
    kind, i, at_i, j, at_j, more, _, point_i = force_at(p, k)
    w = coordinates_of(p)
    if kind == layout.TORSION_SPRING:
        _, n = axis(q, w, i, p, at_i)
        return torsion(q, w, i, j, p, at_i, at_j, 1.0, p[more]), hinge_rate(q, v, w, i, j, n)
    a, arm_i, b, arm_j, d = ends(q, w, i, point_i if kind == layout.AXIAL_SPRING else at_i, j, at_j, p)
    if kind == layout.AXIAL_SPRING:
        _, n = axis(q, w, i, p, at_i)
        _, u = slip(q, v, w, i, j, b, arm_j)
        return dot(n, d), dot(n, u)
    length = math.sqrt(dot(d, d))
    return length, stretch_rate(q, v, w, i, a, arm_i, j, b, arm_j, d) / length


@merged
def has_spring_function(p, k):
    """Return True for a spring whose force is a function of its length and rate."""
    return int(p[k + layout.F_RESULT]) >= 0 and int(p[k]) in (layout.SPRING, layout.TORSION_SPRING, layout.AXIAL_SPRING)


@merged
def n_spring_functions(p):
    """Return the number of springs whose force is a function of their length and rate."""
    n = 0
    for k in force_places(p):
        if has_spring_function(p, k):
            n += 1
    return n


@helper
def fill_spring_lengths(q, v, p, extended_q, extended_v):
    """Write q and v, and what `spring_length` returns for each spring whose force is a function."""
    for k in range(q.size):
        extended_q[k], extended_v[k] = q[k], v[k]
    index = q.size
    for k in force_places(p):
        if has_spring_function(p, k):
            extended_q[index], extended_v[index] = spring_length(q, v, p, k)
            index += 1


@inlined
def force_results(t, q, v, p):
    """Return the results of the functions that give forces; p if there are no such functions."""
    place = int(p[p.size - layout.HEAD + layout.FORCE_PROGRAM])
    if place < 0:
        return p
    n = n_spring_functions(p)
    if n == 0:
        return results_within(place, t, q, v, p)
    extended_q, extended_v = np.zeros(q.size + n), np.zeros(q.size + n)
    fill_spring_lengths(q, v, p, extended_q, extended_v)
    return results_within(place, t, extended_q, extended_v, p)


@merged
def inertia(p, at, a):
    """Return J times a vector, in body axes."""
    x, y, z = a
    return (
        p[at + 1] * x + p[at + 4] * y + p[at + 5] * z,
        p[at + 4] * x + p[at + 2] * y + p[at + 6] * z,
        p[at + 5] * x + p[at + 6] * y + p[at + 3] * z,
    )


@merged
def inertia_at(p, w, body):
    """Return the index in p of the mass and moments of a body; the masses follow the components of gravity."""
    if w == PLANAR:
        return 2 + layout.PLANAR_BODY * body
    return 3 + layout.SPATIAL_BODY * body


@helper
def put_forces(q, v, p, results, Q):
    """Add springs, motors, friction, given forces and torques."""
    w = coordinates_of(p)
    for k in force_places(p):
        kind, i, at_i, j, at_j, more, first_result, point_i = force_at(p, k)
        if kind in (layout.HINGE_ROTOR, layout.SLIDE_ROTOR):
            put_rotor_force(q, v, w, p, k, Q)
        elif kind == layout.TORQUE:
            x = value(p, more, results, first_result, 0)
            if w == PLANAR:
                torque = 0.0, 0.0, x
            else:
                torque = x, value(p, more, results, first_result, 1), value(p, more, results, first_result, 2)
            twist_row(q, Q, w, j, torque)
            twist_row(q, Q, w, i, times(-1.0, torque))  # a motor in a hinge of the plane
        elif kind == layout.FORCE:
            x, y = value(p, more, results, first_result, 0), value(p, more, results, first_result, 1)
            f = x, y, (0.0 if w == PLANAR else value(p, more, results, first_result, 2))
            b = numbers(p, w, at_j)
            push_row(q, Q, w, j, w * j, b, vector(q, w, j, b), f)
        elif kind in (layout.AXIAL_TORQUE, layout.TORSION_SPRING, layout.HINGE_FRICTION):  # about an axis of body i
            _, n = axis(q, w, i, p, at_i)
            rate = hinge_rate(q, v, w, i, j, n)
            if kind == layout.TORSION_SPRING and first_result >= 0:
                size = -results[first_result]
            elif kind == layout.TORSION_SPRING:
                size = -torsion(q, w, i, j, p, at_i, at_j, p[more], p[more + 2]) - p[more + 1] * rate
            else:
                size = joint_force(kind, rate, p, more, results, first_result)
            twist_row(q, Q, w, j, times(size, n))
            twist_row(q, Q, w, i, times(-size, n))
        elif kind in (layout.AXIAL_FORCE, layout.AXIAL_SPRING, layout.AXIAL_FRICTION):  # on both bodies, at j's point
            _, n = axis(q, w, i, p, at_i)
            b = numbers(p, w, at_j)
            arm_j = vector(q, w, j, b)
            d, u = slip(q, v, w, i, j, b, arm_j)
            rate = dot(n, u)
            if kind == layout.AXIAL_SPRING:
                a = numbers(p, w, point_i)
                length = dot(n, minus(d, vector(q, w, i, a)))
                push = times(-tension_of(length, rate, p, more, results, first_result), n)
            else:
                push = times(joint_force(kind, rate, p, more, results, first_result), n)
            push_row(q, Q, w, j, w * j, b, arm_j, push)
            move_row(Q, w, w * i, times(-1.0, push))
            twist_row(q, Q, w, i, cross(push, d))
        else:
            a, arm_i, b, arm_j, d = ends(q, w, i, at_i, j, at_j, p)
            factor = p[more]
            if kind == layout.SPRING:
                length = math.sqrt(dot(d, d))
                d = d[0] / length, d[1] / length, d[2] / length
                rate = stretch_rate(q, v, w, i, a, arm_i, j, b, arm_j, d)
                factor = tension_of(length, rate, p, more, results, first_result)
            push_row(q, Q, w, i, w * i, a, arm_i, times(factor, d))
            push_row(q, Q, w, j, w * j, b, arm_j, times(-factor, d))


@helper
def fill_force(q, v, p, results, Q):
    """Evaluate Q; `results`: results of the program of forces."""
    w = coordinates_of(p)
    for body in range(n_bodies(p)):
        m = inertia_at(p, w, body)
        move_row(Q, w, w * body, times(p[m], numbers(p, w, 0)))
        if w != PLANAR:  # quadratic velocity terms of the kinetic energy: -8 G(e')^T J G(e) e'
            k = 7 * body + 3
            u0, u1, u2, u3 = v[k], v[k + 1], v[k + 2], v[k + 3]
            half = half_spin(q[k], q[k + 1], q[k + 2], q[k + 3], u0, u1, u2, u3)
            add_turning(Q, k, u0, u1, u2, u3, inertia(p, m, times(-8.0, half)))
    if p[p.size - layout.HEAD + layout.N_FORCES] > 0:
        put_forces(q, v, p, results, Q)
