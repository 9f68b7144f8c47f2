"""Forces of spatial models with springs whose forces are functions of their length and rate."""

import math

import numpy as np

from twoloop.bodies.parameter_layout import FORCE_PROGRAM, RAIL, TORSION
from twoloop.bodies.read_tables import force_at, force_places, is_law, made_by, n_laws
from twoloop.bodies.spatial_forces import fill_force
from twoloop.bodies.spatial_places import centre, place, spin, torsion, vector, velocity
from twoloop.kernels.compile.caches import helper
from twoloop.kernels.compile.callbacks import callback
from twoloop.kernels.data.common import inlined


@helper
def stretch(q, v, p, k):
    """Return the length, angle or displacement of a spring and its rate."""
    kind, i, at, j, there, more, _, on_first = force_at(p, k)
    if kind == TORSION:
        x, y, z = vector(q, i, p[at], p[at + 1], p[at + 2])
        ux, uy, uz = spin(q, v, i)
        wx, wy, wz = spin(q, v, j)
        return torsion(q, i, j, p, at, there, 1.0, p[more]), x * (wx - ux) + y * (wy - uy) + z * (wz - uz)
    ax, ay, az = place(q, i, p, on_first if kind == RAIL else at)
    bx, by, bz = place(q, j, p, there)
    x, y, z = bx - ax, by - ay, bz - az
    wx, wy, wz = velocity(q, v, j, p, there)
    if kind == RAIL:
        fx, fy, fz = vector(q, i, p[at], p[at + 1], p[at + 2])
        cx, cy, cz = centre(q, i)
        cx, cy, cz = bx - cx, by - cy, bz - cz
        ux, uy, uz = centre(v, i)
        ox, oy, oz = spin(q, v, i)
        wx, wy, wz = wx - ux - oy * cz + oz * cy, wy - uy - oz * cx + ox * cz, wz - uz - ox * cy + oy * cx
        return fx * x + fy * y + fz * z, fx * wx + fy * wy + fz * wz
    ux, uy, uz = velocity(q, v, i, p, at)
    length = math.sqrt(x * x + y * y + z * z)
    return length, (x * (wx - ux) + y * (wy - uy) + z * (wz - uz)) / length


@helper
def fill_stretches(q, v, p, one, other):
    """Write q and v, and the lengths and rates of the springs whose forces are functions of these."""
    for k in range(q.size):
        one[k], other[k] = q[k], v[k]
    made = q.size
    for k in force_places(p):
        if is_law(p, k):
            one[made], other[made] = stretch(q, v, p, k)
            made += 1


@inlined
def with_stretches(q, v, p):
    """Return q and v, followed by these lengths and rates."""
    n = q.size + n_laws(p)
    one, other = np.zeros(n), np.zeros(n)
    fill_stretches(q, v, p, one, other)
    return one, other


@callback("force")
def force_of_laws(t, q, v, p, Q):
    one, other = with_stretches(q, v, p)
    fill_force(q, v, p, made_by(FORCE_PROGRAM, t, one, other, p), Q)
