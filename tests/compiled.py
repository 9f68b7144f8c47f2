"""The pendulum of 1 kg on 1 m in compiled callbacks: for other forces, masses and files of machine code."""

from math import hypot

from numba import njit

from twoloop import ConstrainedSystem, callback


@callback("mass")
def unit_mass(t, q, p, M):
    for k in range(len(M)):
        M[k, k] = 1.0


@callback("mass")
def heavy(t, q, p, M):
    M[0, 0] = M[1, 1] = p[0]


@callback("force")
def weight(t, q, v, p, Q):
    Q[1] = -9.81


@callback("force")
def weight_of_mass(t, q, v, p, Q):
    Q[1] = -9.81 * p[0]


@callback("force")
def attraction(t, q, v, p, Q):
    Q[1] = -p[0]


@callback("constraint")
def circle(t, q, p, C):
    C[0] = 0.5 * (q[0] * q[0] + q[1] * q[1] - 1.0)


@callback("constraint")
def circle_of_length(t, q, p, C):
    C[0] = 0.5 * (q[0] * q[0] + q[1] * q[1] - p[1] * p[1])


@callback("jacobian")
def radius(t, q, p, Cq):
    Cq[0, 0], Cq[0, 1] = q[0], q[1]


@callback("gamma")
def centripetal(t, q, v, p, Qd):
    Qd[0] = -v[0] * v[0] - v[1] * v[1]


PENDULUM = {"mass": unit_mass, "force": weight, "constraint": circle, "jacobian": radius, "gamma": centripetal}
PENDULUM |= {"n_q": 2, "n_c": 1, "constant_mass": True, "name": "pendulum"}
HEAVY_PENDULUM = {"n_q": 2, "n_c": 1, "mass": heavy, "force": weight_of_mass, "constraint": circle, "jacobian": radius}
SPRUNG_START = [1.0, 0.0, 2.0, 0.0], [0.0, 0.0, 0.0, 0.0]


@njit
def pull(q, v, stiffness, damping, Q):
    """Weights, and a spring of 1 m with a damper between two masses."""
    x, y, u, w = q[2] - q[0], q[3] - q[1], v[2] - v[0], v[3] - v[1]
    length = hypot(x, y)
    tension = stiffness * (length - 1.0 + damping * (x * u + y * w) / length) / length
    Q[0], Q[1] = tension * x, tension * y - 9.81
    Q[2], Q[3] = -tension * x, -tension * y - 9.81


@callback("force")
def sprung(t, q, v, p, Q):
    pull(q, v, p[0], p[1], Q)


def sprung_pair(stiffness, damping=0.0, force=sprung):
    """A mass on a rigid rod, and a second one on a spring from the first; the damping is given over the stiffness."""
    return ConstrainedSystem(**PENDULUM | {"n_q": 4, "force": force}, parameters=[stiffness, damping])


def pendulum_under(gravity):
    """The pendulum under another gravity."""
    return ConstrainedSystem(**PENDULUM | {"force": attraction}, parameters=[gravity])
