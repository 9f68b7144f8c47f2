"""Unconstrained motion, and a hanging chain of n pendulums: equal masses at the joints of massless links, 1 m, 1 kg."""

from itertools import pairwise

import numpy as np

from tests.general.mechanism import G, Mechanism, integrate, plain
from twoloop import ConstrainedSystem, callback
from twoloop.mechanisms.quadratic import QuadraticSystem, fixed, point


def chain(n, end=1.0):
    """q = x, y of each mass, from rest on a bent line; n rows. The motion is known by the angles of the links."""
    length, m = 1.0 / n, 1.0 / n
    weight = np.zeros(2 * n)
    weight[1::2] = -m * G
    rows = QuadraticSystem(m * np.eye(2 * n), weight)
    for upper, lower in pairwise([fixed(0.0, 0.0), *[point(2 * i) for i in range(n)]]):
        rows.distance(lower, upper, length)
    system = rows.system(f"chain of {n}")
    below = n - np.arange(n)  # masses below a joint, that joint's own among them
    shared = np.minimum.outer(below, below) * m * length**2

    def rate(t, y):
        angles, rates = y[:n], y[n:]
        turned = angles[:, None] - angles
        pull = shared * np.sin(turned) @ rates**2 + m * G * length * below * np.sin(angles)
        return np.concatenate([rates, np.linalg.solve(shared * np.cos(turned), -pull)])

    solution = integrate(rate, np.concatenate([_start(n), np.zeros(n)]), end)
    return Mechanism(
        name=f"chain of {n}",
        sizes={"n_q": 2 * n, "n_c": n},
        functions=plain(system),
        end=end,
        state=lambda t: _points(*np.split(solution(t), 2)),
        rank=n,
        energy=lambda q, v: 0.5 * m * v @ v - weight @ q,
        ready=system,
    )


def _start(n):
    """Angles to the downward vertical."""
    return 0.4 + 0.5 * np.linspace(0.0, 1.0, n)


def _points(angles, rates):
    length, n = 1.0 / angles.size, angles.size
    q, v = np.empty(2 * n), np.empty(2 * n)
    q[0::2], q[1::2] = length * np.cumsum(np.sin(angles)), -length * np.cumsum(np.cos(angles))
    v[0::2], v[1::2] = length * np.cumsum(np.cos(angles) * rates), length * np.cumsum(np.sin(angles) * rates)
    return q, v


# --- the same chain of any length, without a known motion: one set of compiled callbacks, p = (length, mass) of a link


@callback("mass")
def _mass(t, q, p, M):
    for i in range(q.size):
        M[i, i] = p[1]


@callback("force")
def _force(t, q, v, p, Q):
    Q[1::2] = -9.81 * p[1]


@callback("constraint")
def _constraint(t, q, p, C):
    C[0] = 0.5 * (q[0] * q[0] + q[1] * q[1] - p[0] * p[0])
    for i in range(1, C.size):
        x, y = q[2 * i] - q[2 * i - 2], q[2 * i + 1] - q[2 * i - 1]
        C[i] = 0.5 * (x * x + y * y - p[0] * p[0])


@callback("jacobian")
def _jacobian(t, q, p, Cq):
    Cq[0, 0], Cq[0, 1] = q[0], q[1]
    for i in range(1, Cq.shape[0]):
        j = 2 * i
        x, y = q[j] - q[j - 2], q[j + 1] - q[j - 1]
        Cq[i, j], Cq[i, j + 1], Cq[i, j - 2], Cq[i, j - 1] = x, y, -x, -y


@callback("gamma")
def _gamma(t, q, v, p, Qd):
    Qd[0] = -v[0] * v[0] - v[1] * v[1]
    for i in range(1, Qd.size):
        u, w = v[2 * i] - v[2 * i - 2], v[2 * i + 1] - v[2 * i - 1]
        Qd[i] = -u * u - w * w


def slack_chain(n):
    """System and start, q and v."""
    system = ConstrainedSystem(
        n_q=2 * n,
        n_c=n,
        parameters=[1.0 / n, 1.0 / n],
        mass=_mass,
        force=_force,
        constraint=_constraint,
        jacobian=_jacobian,
        gamma=_gamma,
        constant_mass=True,
        bandwidth=2,
        name=f"chain of {n}",
    )
    return system, *_points(_start(n), np.zeros(n))


def kepler(eccentricity=0.2):
    """A planet: no row at all, so that the motion is an ordinary second-order equation. Closed form."""

    def state(t):
        E = t
        for _ in range(50):  # Kepler's equation, by Newton
            E -= (E - eccentricity * np.sin(E) - t) / (1.0 - eccentricity * np.cos(E))
        b, rate = np.sqrt(1.0 - eccentricity**2), 1.0 / (1.0 - eccentricity * np.cos(E))
        q = np.array([np.cos(E) - eccentricity, b * np.sin(E)])
        return q, rate * np.array([-np.sin(E), b * np.cos(E)])

    return Mechanism(
        name="planet",
        sizes={"n_q": 2, "n_c": 0},
        functions={
            "mass": np.eye(2),
            "force": lambda t, q, v: -q / (q[0] * q[0] + q[1] * q[1]) ** 1.5,
            "constraint": None,
            "jacobian": None,
        },
        end=3.0,
        state=state,
        rank=0,
        energy=lambda q, v: 0.5 * v @ v - 1.0 / np.hypot(q[0], q[1]),
    )
