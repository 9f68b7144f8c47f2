"""Rotor inertias of joints: the inertia of a motor's rotor behind a gear, which adds I/2 rate^2 to the kinetic energy.

The rate of a joint is w(q) . v. Its rotor adds I w w^T to the mass matrix and -I w (dw/dt . v) to the forces, because
on the motions that the joint allows w is the gradient of the joint coordinate (Lagrange's equations of I/2 (w . v)^2).
The rotor itself has no mass, and its gyroscopic torque is neglected, as in the armature of MuJoCo.
"""

from twoloop.bodies import parameter_layout as layout
from twoloop.bodies.read_tables import force_at, force_places
from twoloop.bodies.rotation import half_spin, rotated
from twoloop.kernels.compile.caches import helper
from twoloop.kernels.data.common import exact


@exact
def _dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@exact
def _cross(a, b):
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@exact
def _minus(a, b):
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


@exact
def _vector(q, body, p, at):
    """Return the vector of a body stored at index `at` of p, in space."""
    if body < 0:
        return p[at], p[at + 1], p[at + 2]
    k = 7 * body + 3
    return rotated(q[k], q[k + 1], q[k + 2], q[k + 3], p[at], p[at + 1], p[at + 2])


@exact
def _centre(q, body):
    if body < 0:
        return 0.0, 0.0, 0.0
    return q[7 * body], q[7 * body + 1], q[7 * body + 2]


@exact
def _spin(q, v, body):
    if body < 0:
        return 0.0, 0.0, 0.0
    k = 7 * body + 3
    e0, e1, e2, e3 = q[k], q[k + 1], q[k + 2], q[k + 3]
    x, y, z = half_spin(e0, e1, e2, e3, v[k], v[k + 1], v[k + 2], v[k + 3])
    return rotated(e0, e1, e2, e3, 2.0 * x, 2.0 * y, 2.0 * z)


@exact
def _arm(q, i, j, p, at_j):
    """Return the point of j from the centre of i, and from the centre of j."""
    b = _vector(q, j, p, at_j)
    x, y = _centre(q, j), _centre(q, i)
    return (x[0] + b[0] - y[0], x[1] + b[1] - y[1], x[2] + b[2] - y[2]), b


@exact
def _block(q, body, f, torque):
    """Return the seven coefficients of v in f . (velocity of the centre) + torque . (angular velocity)."""
    k = 7 * body + 3
    e0, e1, e2, e3 = q[k], q[k + 1], q[k + 2], q[k + 3]
    x, y, z = rotated(e0, -e1, -e2, -e3, 2.0 * torque[0], 2.0 * torque[1], 2.0 * torque[2])
    w0, w1 = -e1 * x - e2 * y - e3 * z, e0 * x - e3 * y + e2 * z
    return f[0], f[1], f[2], w0, w1, e3 * x + e0 * y - e1 * z, -e2 * x + e1 * y + e0 * z


@exact
def _spatial_blocks(q, p, k):
    """Return the coefficients of the velocities of bodies i and j in the rate of the joint of rotor k."""
    kind, i, at_i, j, at_j, _, _, _ = force_at(p, k)
    axis = _vector(q, i, p, at_i)
    zero = (0.0, 0.0, 0.0)
    back = _minus(zero, axis)
    if kind == layout.HINGE_ROTOR:
        return _block(q, max(i, 0), zero, back), _block(q, max(j, 0), zero, axis)
    arm, b = _arm(q, i, j, p, at_j)
    return _block(q, max(i, 0), back, _cross(axis, arm)), _block(q, max(j, 0), axis, _cross(b, axis))


@exact
def _spatial_bias(q, v, p, k):
    """Return the acceleration of the joint of rotor k without the accelerations of the coordinates."""
    kind, i, at_i, j, at_j, _, _, _ = force_at(p, k)
    axis, spin_i, spin_j = _vector(q, i, p, at_i), _spin(q, v, i), _spin(q, v, j)
    turned = _cross(spin_i, axis)
    if kind == layout.HINGE_ROTOR:
        return _dot(turned, _minus(spin_j, spin_i))
    arm, b = _arm(q, i, j, p, at_j)
    swing, x, y = _cross(spin_j, b), _centre(v, j), _centre(v, i)
    speed = x[0] + swing[0] - y[0], x[1] + swing[1] - y[1], x[2] + swing[2] - y[2]
    slip = _minus(speed, _cross(spin_i, arm))
    return _dot(turned, slip) + _dot(axis, _minus(_cross(spin_j, swing), _cross(spin_i, speed)))


@helper
def put_spatial_rotors(q, p, M):
    """Add the rotors to the mass matrix of bodies in space."""
    for k in force_places(p):
        if p[k] == layout.HINGE_ROTOR or p[k] == layout.SLIDE_ROTOR:
            _, i, _, j, _, more, _, _ = force_at(p, k)
            blocks = _spatial_blocks(q, p, k)
            for one in range(2):
                for other in range(2):
                    row, column = (i, j)[one], (i, j)[other]
                    if row >= 0 and column >= 0:
                        for a in range(7):
                            for b in range(7):
                                M[7 * row + a, 7 * column + b] += p[more] * blocks[one][a] * blocks[other][b]


@helper
def put_spatial_rotor_force(q, v, p, k, Q):
    """Add the velocity-dependent force of rotor k to the generalised forces of bodies in space."""
    _, i, _, j, _, more, _, _ = force_at(p, k)
    blocks, factor = _spatial_blocks(q, p, k), -p[more] * _spatial_bias(q, v, p, k)
    for end in range(2):
        body = (i, j)[end]
        if body >= 0:
            for a in range(7):
                Q[7 * body + a] += factor * blocks[end][a]


@helper
def put_planar_rotors(p, M):
    """Add the rotors of revolute joints to the constant mass matrix of bodies in the plane."""
    for k in force_places(p):
        if p[k] == layout.HINGE_ROTOR:
            _, i, _, j, _, more, _, _ = force_at(p, k)
            for one in range(2):
                for other in range(2):
                    row, column = (i, j)[one], (i, j)[other]
                    if row >= 0 and column >= 0:
                        M[3 * row + 2, 3 * column + 2] += p[more] if one == other else -p[more]
