"""IFToMM A02, the N-four-bar mechanism: N windows, 2N + 1 uniform bars of 1 m and 1 kg, cranks upright at the start.

C_q loses N ranks whenever the cranks lie on the ground line, where N + 1 branches of motion meet; the synchronous one
goes through. Source of the problem: IFToMM library of benchmarks, A02; `jgerstmayr/EXUDYN`
main/pythonDev/TestModels/fourBarMechanismIftomm.py for its printed values.
"""

from itertools import pairwise

import numpy as np
from scipy.optimize import brentq
from scipy.special import ellipj, ellipk

from tests.general.mechanism import G, Mechanism
from tests.general.quadratic import Rows, distance

# the tip of the first crank at 10 s for N = 2, as Exudyn prints it at h = 2.5e-4 and at half of that: order 2
PRINTED_TIP = np.array([[0.3284552113, 0.9445195467], [0.3284573768, 0.9445187937]])


def crank(n, t):
    """Angle and angular velocity of the cranks at t: a pendulum that turns over, by elliptic functions.

    phi'' = -w^2 cos(phi), w^2 = g 3 (3n + 1) / (2 (4n + 1)), from phi = pi/2 with -1 rad/s.
    """
    w = np.sqrt(G * 3.0 * (3 * n + 1) / (2.0 * (4 * n + 1)))
    k = 2.0 * w / np.sqrt(1.0 + 4.0 * w * w)
    _, _, dn, amplitude = ellipj(ellipk(k * k) - w * np.asarray(t) / k, k * k)
    return 2.0 * amplitude - 0.5 * np.pi, -2.0 * w / k * dn


def first_singular_time(n):
    """When the cranks first lie on the ground line, to rounding."""
    return float(brentq(lambda t: crank(n, t)[0], 0.5, 1.0, xtol=1e-15))


def windows(n, end=10.0):
    """Coordinates: x, y of the tips of the n + 1 cranks; rows: the lengths of cranks and couplers."""
    n_q = 2 * (n + 1)
    rows = Rows(n_q)
    tips = [[{2 * i: 1.0}, {2 * i + 1: 1.0}] for i in range(n + 1)]
    for i, tip in enumerate(tips):
        distance(rows, tip, [{None: float(i)}, {}], 1.0)
    for left, right in pairwise(tips):
        distance(rows, right, left, 1.0)
    mass, weight = np.eye(n_q) / 3.0, np.zeros(n_q)
    weight[1::2] = -0.5 * G
    for i in range(n):  # a uniform bar between points of velocities a, b has the energy m (a^2 + a b + b^2) / 6
        for j in range(2 * i, 2 * i + 2):
            mass[j, j] += 1.0 / 3.0
            mass[j + 2, j + 2] += 1.0 / 3.0
            mass[j, j + 2] = mass[j + 2, j] = 1.0 / 6.0
        weight[[2 * i + 1, 2 * i + 3]] -= 0.5 * G

    def state(t):
        angle, rate = crank(n, t)
        q, v = np.empty(n_q), np.empty(n_q)
        q[0::2], q[1::2] = np.arange(n + 1) + np.cos(angle), np.sin(angle)
        v[0::2], v[1::2] = -rate * np.sin(angle), rate * np.cos(angle)
        return q, v

    return Mechanism(
        name=f"A02, N = {n}",
        sizes={"n_q": n_q, "n_c": rows.n_c},
        functions={"mass": mass, "force": lambda t, q, v: weight.copy(), **rows.functions()},
        end=end,
        state=state,
        rank=rows.n_c,
        energy=lambda q, v: 0.5 * v @ mass @ v - weight @ q,
        compile=True,
    )


def windows_of_bodies(n, end=10.0):
    """The same with x, y and angle of every bar (cranks first, then couplers), and two rows for each joint."""
    n_bars, n_q = 2 * n + 1, 3 * (2 * n + 1)
    # a bar and which of its points, another bar (None: the ground) and which of its points
    pins = [(i, -0.5, None, float(i)) for i in range(n + 1)]
    pins += [(n + 1 + j, -0.5, j, 0.5) for j in range(n)] + [(n + 1 + j, 0.5, j + 1, 0.5) for j in range(n)]
    n_c = 2 * len(pins)
    first = np.array([pin[0] for pin in pins])
    first_end = np.array([pin[1] for pin in pins])
    other = np.array([-1 if pin[2] is None else pin[2] for pin in pins])
    other_end = np.array([pin[3] for pin in pins])  # of a bar, or x of the point of the ground

    def constraint(t, q):
        C = np.zeros(n_c)
        for k in range(first.size):
            i, s = 3 * first[k], first_end[k]
            C[2 * k] = q[i] + s * np.cos(q[i + 2])
            C[2 * k + 1] = q[i + 1] + s * np.sin(q[i + 2])
            j, s = 3 * other[k], other_end[k]
            if j < 0:
                C[2 * k] -= s
            else:
                C[2 * k] -= q[j] + s * np.cos(q[j + 2])
                C[2 * k + 1] -= q[j + 1] + s * np.sin(q[j + 2])
        return C

    def jacobian(t, q):
        Cq = np.zeros((n_c, n_q))
        for k in range(first.size):
            i, s = 3 * first[k], first_end[k]
            Cq[2 * k, i] = Cq[2 * k + 1, i + 1] = 1.0
            Cq[2 * k, i + 2], Cq[2 * k + 1, i + 2] = -s * np.sin(q[i + 2]), s * np.cos(q[i + 2])
            j, s = 3 * other[k], other_end[k]
            if j >= 0:
                Cq[2 * k, j] = Cq[2 * k + 1, j + 1] = -1.0
                Cq[2 * k, j + 2], Cq[2 * k + 1, j + 2] = s * np.sin(q[j + 2]), -s * np.cos(q[j + 2])
        return Cq

    def gamma(t, q, v):
        Qd = np.zeros(n_c)
        for k in range(first.size):
            i, s = 3 * first[k] + 2, first_end[k]
            Qd[2 * k] = s * np.cos(q[i]) * v[i] ** 2
            Qd[2 * k + 1] = s * np.sin(q[i]) * v[i] ** 2
            j, s = 3 * other[k] + 2, other_end[k]
            if j >= 0:
                Qd[2 * k] -= s * np.cos(q[j]) * v[j] ** 2
                Qd[2 * k + 1] -= s * np.sin(q[j]) * v[j] ** 2
        return Qd

    weight = np.zeros(n_q)
    weight[1::3] = -G
    mass = np.diag(np.tile([1.0, 1.0, 1.0 / 12.0], n_bars))

    def state(t):
        angle, rate = crank(n, t)
        z, w = np.exp(1j * angle), 1j * rate * np.exp(1j * angle)
        x = np.concatenate([np.arange(n + 1) + 0.5 * z, np.arange(n) + 0.5 + z])
        u = np.concatenate([np.full(n + 1, 0.5 * w), np.full(n, w)])
        turned = np.arange(n_bars) <= n
        q = np.array([x.real, x.imag, np.where(turned, angle, 0.0)])
        v = np.array([u.real, u.imag, np.where(turned, rate, 0.0)])
        return q.T.ravel(), v.T.ravel()

    return Mechanism(
        name=f"A02 of bodies, N = {n}",
        sizes={"n_q": n_q, "n_c": n_c},
        functions={
            "mass": mass,
            "force": lambda t, q, v: weight.copy(),
            "constraint": constraint,
            "jacobian": jacobian,
            "gamma": gamma,
        },
        end=end,
        state=state,
        rank=n_c,
        energy=lambda q, v: 0.5 * v @ mass @ v - weight @ q,
        compile=True,
    )
