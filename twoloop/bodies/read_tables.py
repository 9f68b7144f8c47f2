"""How callbacks read the tables of a model in its parameters, see `parameter_layout`, and results of its programs."""

import math

from twoloop.bodies import parameter_layout as layout
from twoloop.bodies.program_results import results
from twoloop.kernels.compile.caches import helper


@helper
def n_bodies(p):
    """Number of bodies."""
    return int(p[p.size - layout.HEAD + layout.BODIES])


@helper
def joint_places(p):
    """Where the rows of the table of joints begin."""
    first, n = int(p[p.size - layout.HEAD + layout.JOINTS]), int(p[p.size - layout.HEAD + layout.N_JOINTS])
    return range(first, first + layout.JOINT_WIDTH * n, layout.JOINT_WIDTH)


@helper
def joint_at(p, k):
    """A row of it: kind, row of C, bodies i and j each with the place of its numbers, further numbers, motion."""
    i, at, j, there = int(p[k + 2]), int(p[k + 3]), int(p[k + 4]), int(p[k + 5])
    return int(p[k]), int(p[k + 1]), i, at, j, there, int(p[k + 6]), int(p[k + 7])


@helper
def force_places(p):
    """Where the rows of the table of forces begin."""
    first, n = int(p[p.size - layout.HEAD + layout.FORCES]), int(p[p.size - layout.HEAD + layout.N_FORCES])
    return range(first, first + layout.FORCE_WIDTH * n, layout.FORCE_WIDTH)


@helper
def force_at(p, k):
    """A row of it: kind, bodies i and j each with the place of its numbers, further numbers, result, point of i."""
    i, at, j, there = int(p[k + 1]), int(p[k + 2]), int(p[k + 3]), int(p[k + 4])
    return int(p[k]), i, at, j, there, int(p[k + 5]), int(p[k + 6]), int(p[k + 7])


@helper
def motions(t, q, v, p):
    """Results of the program of motions."""
    return results(int(p[p.size - layout.HEAD + layout.MOTION_PROGRAM]), t, q, v, p)


@helper
def value(p, more, made, given, i):
    """A number of a force: of its function, if it is one."""
    if given >= 0:
        return made[given + i]
    return p[more + i]


@helper
def push(kind, rate, p, more, made, given):
    """What friction or a motor does in a joint that moves at a rate."""
    if kind in (layout.BRAKE, layout.RUB):
        return -p[more] * math.tanh(rate / p[more + 1])
    return value(p, more, made, given, 0)
