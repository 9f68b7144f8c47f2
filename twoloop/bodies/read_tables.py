"""Access to the tables of a model in its parameters, see `parameter_layout`, and to the results of its programs."""

import math

from twoloop.bodies import parameter_layout as layout
from twoloop.bodies.program_results import results_within
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
    i, at, j, there = int(p[k + 2]), int(p[k + 3]), int(p[k + 4]), int(p[k + 5])
    return int(p[k]), int(p[k + 1]), i, at, j, there, int(p[k + 6]), int(p[k + 7])


@exact
def force_places(p):
    """Return the index at which the table of forces begins."""
    first, n = int(p[p.size - layout.HEAD + layout.FORCES]), int(p[p.size - layout.HEAD + layout.N_FORCES])
    return range(first, first + layout.FORCE_WIDTH * n, layout.FORCE_WIDTH)


@exact
def force_at(p, k):
    """Return a row of the table: kind, bodies i and j with indices of numbers, further numbers, result, point of i."""
    i, at, j, there = int(p[k + 1]), int(p[k + 2]), int(p[k + 3]), int(p[k + 4])
    return int(p[k]), i, at, j, there, int(p[k + 5]), int(p[k + 6]), int(p[k + 7])


@exact
def is_law(p, k):
    """Return True for a spring whose force is a function of its length and rate."""
    return int(p[k + layout.F_RESULT]) >= 0 and int(p[k]) in (layout.SPRING, layout.TORSION, layout.RAIL)


@exact
def n_laws(p):
    """Return the number of such springs."""
    n = 0
    for k in force_places(p):
        if is_law(p, k):
            n += 1
    return n


@inlined
def put_stretches(stretch, q, v, p, one, other):
    """Write q and v, and the lengths and rates of the springs whose forces are functions of these."""
    for k in range(q.size):
        one[k], other[k] = q[k], v[k]
    made = q.size
    for k in force_places(p):
        if is_law(p, k):
            one[made], other[made] = stretch(q, v, p, k)
            made += 1


@inlined
def made_by(program, t, q, v, p):
    """Return the results of a program of the model."""
    return results_within(int(p[p.size - layout.HEAD + program]), t, q, v, p)


@exact
def value(p, more, made, given, i):
    """Return a number of a force, or its function value if it is a function."""
    if given >= 0:
        return made[given + i]
    return p[more + i]


@exact
def push(kind, rate, p, more, made, given):
    """Return the force of friction or of a motor in a joint with the given rate."""
    if kind in (layout.BRAKE, layout.RUB):
        return -p[more] * math.tanh(rate / p[more + 1])
    return value(p, more, made, given, 0)
