"""Read the tables of a model from its parameters (see `parameter_layout`), and evaluate rows that are functions."""

import math

from twoloop.bodies import parameter_layout as layout
from twoloop.bodies.parameter_layout import RATE_FUNCTION
from twoloop.bodies.program_results import results_within
from twoloop.kernels.compile.caches import helper
from twoloop.kernels.data.common import exact, inlined


@exact
def n_bodies(p):
    """Return the number of bodies."""
    return int(p[p.size - layout.HEAD + layout.BODIES])


@exact
def joint_places(p):
    """Return the index at which the table of joints begins."""
    first, n = int(p[p.size - layout.HEAD + layout.JOINTS]), int(p[p.size - layout.HEAD + layout.N_JOINTS])
    return range(first, first + layout.JOINT_WIDTH * n, layout.JOINT_WIDTH)


@exact
def joint_at(p, k):
    """Return a row of the table: kind, row of C, bodies i and j with their numbers, further numbers, motion."""
    i, at_i, j, at_j = int(p[k + 2]), int(p[k + 3]), int(p[k + 4]), int(p[k + 5])
    return int(p[k]), int(p[k + 1]), i, at_i, j, at_j, int(p[k + 6]), int(p[k + 7])


@exact
def force_places(p):
    """Return the index at which the table of forces begins."""
    first, n = int(p[p.size - layout.HEAD + layout.FORCES]), int(p[p.size - layout.HEAD + layout.N_FORCES])
    return range(first, first + layout.FORCE_WIDTH * n, layout.FORCE_WIDTH)


@exact
def force_at(p, k):
    """Return a row of the table: kind, bodies i and j with indices of numbers, further numbers, result, point of i."""
    i, at_i, j, at_j = int(p[k + 1]), int(p[k + 2]), int(p[k + 3]), int(p[k + 4])
    return int(p[k]), i, at_i, j, at_j, int(p[k + 5]), int(p[k + 6]), int(p[k + 7])


@exact
def has_spring_function(p, k):
    """Return True for a spring whose force is a function of its length and rate."""
    return int(p[k + layout.F_RESULT]) >= 0 and int(p[k]) in (layout.SPRING, layout.TORSION_SPRING, layout.AXIAL_SPRING)


@exact
def n_spring_functions(p):
    """Return the number of such springs."""
    n = 0
    for k in force_places(p):
        if has_spring_function(p, k):
            n += 1
    return n


@inlined
def put_spring_lengths(spring_length, q, v, p, extended_q, extended_v):
    """Write q and v, and the lengths and rates of the springs whose forces are functions of these."""
    for k in range(q.size):
        extended_q[k], extended_v[k] = q[k], v[k]
    index = q.size
    for k in force_places(p):
        if has_spring_function(p, k):
            extended_q[index], extended_v[index] = spring_length(q, v, p, k)
            index += 1


@inlined
def evaluate_program(program, t, q, v, p):
    """Return the results of a program of the model."""
    return results_within(int(p[p.size - layout.HEAD + program]), t, q, v, p)


@exact
def force_value(p, more, results, first_result, i):
    """Return a number of a force, or its function value if it is a function."""
    if first_result >= 0:
        return results[first_result + i]
    return p[more + i]


@exact
def spring_tension(length, rate, p, more, results, first_result):
    """Return the force of a spring and damper, or its function value if it is a function."""
    if first_result >= 0:
        return results[first_result]
    return p[more] * (length - p[more + 2]) + p[more + 1] * rate


@exact
def joint_force(kind, rate, p, more, results, first_result):
    """Return the force of friction or of a motor in a joint with the given rate."""
    if kind in (layout.HINGE_FRICTION, layout.AXIAL_FRICTION):
        return -p[more] * math.tanh(rate / p[more + 1])
    return force_value(p, more, results, first_result, 0)


@helper
def fill_entries(p, columns, results, first_result, entries):
    """Add the derivatives with respect to the coordinates listed from `columns` on to entries (n_q,)."""
    for m in range(int(p[columns])):
        entries[int(p[columns + 1 + m])] = results[first_result + m]


@helper
def put_entries(p, columns, results, first_result, values, begin):
    """Store the derivatives in values from `begin` on; return the position after the last."""
    for m in range(int(p[columns])):
        values[begin + m] = results[first_result + m]
    return begin + int(p[columns])


@helper
def fill_nonholonomic(p, results, A):
    """Evaluate A."""
    for k in joint_places(p):
        kind, row, _, _, _, _, columns, result = joint_at(p, k)
        if kind == RATE_FUNCTION:
            fill_entries(p, columns, results, result + 1, A[row])


@helper
def fill_nonholonomic_gamma(p, results, Qa):
    """Evaluate the right-hand side of A a = Q_a."""
    for k in joint_places(p):
        kind, row, _, _, _, _, _, result = joint_at(p, k)
        if kind == RATE_FUNCTION:
            Qa[row] = results[result]
