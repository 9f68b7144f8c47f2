"""Forces of planar models with springs whose forces are functions of their length and rate."""

import math

import numpy as np

from twoloop.bodies.parameter_layout import FORCE_PROGRAM, RAIL, TORSION
from twoloop.bodies.planar_callbacks import angle_of, direction, fill_force, place
from twoloop.bodies.planar_places import motion
from twoloop.bodies.read_tables import force_at, made_by, n_laws, put_stretches
from twoloop.kernels.compile.caches import helper
from twoloop.kernels.compile.callbacks import callback


@helper
def stretch(q, v, p, k):
    """Return the length, angle or displacement of a spring and its rate."""
    kind, i, at, j, there, more, _, on_first = force_at(p, k)
    if kind == TORSION:
        return angle_of(q, j) - angle_of(q, i) - p[more], angle_of(v, j) - angle_of(v, i)
    ax, ay, adx, ady = place(q, i, p, on_first if kind == RAIL else at)
    bx, by, bdx, bdy = place(q, j, p, there)
    au, aw, _, _ = motion(v, i, adx, ady)
    bu, bw, _, _ = motion(v, j, bdx, bdy)
    x, y, u, w = bx - ax, by - ay, bu - au, bw - aw
    if kind == RAIL:
        fx, fy = direction(q, i, p[at], False)
        return fx * x + fy * y, fx * u + fy * w + angle_of(v, i) * (fx * y - fy * x)
    length = math.sqrt(x * x + y * y)
    return length, (x * u + y * w) / length


@helper
def fill_stretches(q, v, p, one, other):
    """Write q and v, and what `stretch` returns for each spring whose force is a function."""
    put_stretches(stretch, q, v, p, one, other)


@callback("force")
def force_of_laws(t, q, v, p, Q):
    n = q.size + n_laws(p)
    one, other = np.zeros(n), np.zeros(n)
    fill_stretches(q, v, p, one, other)
    fill_force(q, v, p, made_by(FORCE_PROGRAM, t, one, other, p), Q)
