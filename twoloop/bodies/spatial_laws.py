"""Forces of spatial models with springs whose forces are functions of their length and rate."""

import math

import numpy as np

from twoloop.bodies.parameter_layout import FORCE_PROGRAM, RAIL, TORSION
from twoloop.bodies.read_tables import force_at, made_by, n_laws, put_stretches
from twoloop.bodies.spatial_forces import fill_force
from twoloop.bodies.spatial_places import centre, place, spin, torsion, vector, velocity
from twoloop.kernels.compile.caches import helper
from twoloop.kernels.compile.callbacks import callback


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
    """Write q and v, and what `stretch` returns for each spring whose force is a function."""
    put_stretches(stretch, q, v, p, one, other)


@callback("force")
def force_of_laws(t, q, v, p, Q):
    n = q.size + n_laws(p)
    one, other = np.zeros(n), np.zeros(n)
    fill_stretches(q, v, p, one, other)
    fill_force(q, v, p, made_by(FORCE_PROGRAM, t, one, other, p), Q)
