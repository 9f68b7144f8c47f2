"""The pendulum of 1 kg on 1 m in compiled callbacks: for other forces, masses and files of machine code."""

from twoloop import ConstrainedSystem, callback


@callback("mass")
def unit_mass(t, q, p, M):
    M[0, 0] = M[1, 1] = 1.0


@callback("force")
def weight(t, q, v, p, Q):
    Q[1] = -9.81


@callback("force")
def attraction(t, q, v, p, Q):
    Q[1] = -p[0]


@callback("constraint")
def circle(t, q, p, C):
    C[0] = 0.5 * (q[0] * q[0] + q[1] * q[1] - 1.0)


@callback("jacobian")
def radius(t, q, p, Cq):
    Cq[0, 0], Cq[0, 1] = q[0], q[1]


@callback("gamma")
def centripetal(t, q, v, p, Qd):
    Qd[0] = -v[0] * v[0] - v[1] * v[1]


PENDULUM = {"mass": unit_mass, "force": weight, "constraint": circle, "jacobian": radius, "gamma": centripetal}
PENDULUM |= {"n_q": 2, "n_c": 1, "constant_mass": True, "name": "pendulum"}


def pendulum_under(gravity):
    """The pendulum under another gravity."""
    return ConstrainedSystem(**PENDULUM | {"force": attraction}, parameters=[gravity])
