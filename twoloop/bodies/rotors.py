"""Rotor inertias of joints: the inertia of a motor's rotor behind a gear, which adds I/2 rate^2 to the kinetic energy.

The rate of a joint is w(q) . v. Its rotor adds I w w^T to the mass matrix and -I w (dw/dt . v) to the forces: these are
Lagrange's equations of I/2 (w . v)^2, because w is the gradient of the joint coordinate for motions that joints allow.
The rotor itself has no mass, and its gyroscopic torque is neglected, as in the armature of MuJoCo.
"""

from twoloop.bodies import parameter_layout as layout
from twoloop.bodies.geometry import PLANAR, axis, centre, cross, dot, merged, minus, numbers, plus, spin, times, vector
from twoloop.bodies.read_tables import force_at, force_places
from twoloop.bodies.rotation import rotated
from twoloop.kernels.compile.caches import helper


@merged
def _arm(q, w, i, j, p, at_j):
    """Return the vectors to the point of body j from the centre of body i, and from the centre of body j."""
    b = vector(q, w, j, numbers(p, w, at_j))
    return minus(plus(centre(q, w, j), b), centre(q, w, i)), b


@merged
def _block(q, w, body, f, torque):
    """Return 7 coefficients (planar: 3, zeros) of v in f . (centre's velocity) + torque . (angular velocity)."""
    if w == PLANAR:
        return f[0], f[1], torque[2], 0.0, 0.0, 0.0, 0.0
    k = 7 * body + 3
    e0, e1, e2, e3 = q[k], q[k + 1], q[k + 2], q[k + 3]
    x, y, z = rotated(e0, -e1, -e2, -e3, 2.0 * torque[0], 2.0 * torque[1], 2.0 * torque[2])
    w0, w1 = -e1 * x - e2 * y - e3 * z, e0 * x - e3 * y + e2 * z
    return f[0], f[1], f[2], w0, w1, e3 * x + e0 * y - e1 * z, -e2 * x + e1 * y + e0 * z


@helper
def _blocks(q, w, p, k):
    """Return the coefficients of the velocities of bodies i and j in the rate of the joint of rotor k."""
    kind, i, at_i, j, at_j, _, _, _ = force_at(p, k)
    _, n = axis(q, w, i, p, at_i)
    back = times(-1.0, n)
    if kind == layout.HINGE_ROTOR:
        zero = (0.0, 0.0, 0.0)
        return _block(q, w, max(i, 0), zero, back), _block(q, w, max(j, 0), zero, n)
    arm, b = _arm(q, w, i, j, p, at_j)
    return _block(q, w, max(i, 0), back, cross(n, arm)), _block(q, w, max(j, 0), n, cross(b, n))


@helper
def _bias(q, v, w, p, k):
    """Return the part of the acceleration of rotor k's joint that does not depend on v'."""
    kind, i, at_i, j, at_j, _, _, _ = force_at(p, k)
    _, n = axis(q, w, i, p, at_i)
    spin_i, spin_j = spin(q, v, w, i), spin(q, v, w, j)
    turned = cross(spin_i, n)
    if kind == layout.HINGE_ROTOR:
        return dot(turned, minus(spin_j, spin_i))
    arm, b = _arm(q, w, i, j, p, at_j)
    swing = cross(spin_j, b)
    speed = minus(plus(centre(v, w, j), swing), centre(v, w, i))
    slip = minus(speed, cross(spin_i, arm))
    return dot(turned, slip) + dot(n, minus(cross(spin_j, swing), cross(spin_i, speed)))


@helper
def put_rotors(q, w, p, M):
    """Add the rotors to the mass matrix."""
    for k in force_places(p):
        if p[k] == layout.HINGE_ROTOR or p[k] == layout.SLIDE_ROTOR:
            _, i, _, j, _, more, _, _ = force_at(p, k)
            blocks = _blocks(q, w, p, k)
            for one in range(2):
                for other in range(2):
                    row, column = (i, j)[one], (i, j)[other]
                    if row >= 0 and column >= 0:
                        for a in range(w):
                            for b in range(w):
                                M[w * row + a, w * column + b] += p[more] * blocks[one][a] * blocks[other][b]


@helper
def put_rotor_force(q, v, w, p, k, Q):
    """Add the velocity-dependent force of rotor k to the generalised forces."""
    _, i, _, j, _, more, _, _ = force_at(p, k)
    blocks, factor = _blocks(q, w, p, k), -p[more] * _bias(q, v, w, p, k)
    for end in range(2):
        body = (i, j)[end]
        if body >= 0:
            for a in range(w):
                Q[w * body + a] += factor * blocks[end][a]
