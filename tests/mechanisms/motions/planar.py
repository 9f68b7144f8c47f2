"""Planar mechanisms by angles: pendulums, A02, chains, slider-cranks, the driven crank and Andrews' mechanism.

A motion is a triple: rate(t, y), the start y0, and state(t, y) -> q, v in the coordinates of the ready mechanism.
"""

import numpy as np

from tests.mechanisms.motions.integrate import solve
from tests.mechanisms.motions.jets import Jet, acceleration, angle, asin, cos, meet, sin, sqrt, state

G = np.longdouble("9.81")
PI = 4 * np.arctan(np.longdouble(1))


def pendulum(gravity, side):
    """By the angle from the downward vertical."""

    def rate(t, y):
        return [y[1], -gravity * np.sin(y[0])]

    def known(t, y):
        s, c = np.sin(y[0]), np.cos(y[0])
        return np.array([s, -c]), y[1] * np.array([c, s])

    return rate, (side * PI / 2, 0), known


def a01():
    return pendulum(G, -1)


def projection_pendulum():
    return pendulum(np.longdouble("13.7503716360407456549801915596211144"), 1)


def a02(n, bodies=False):
    """By the angle of the cranks: uniform cranks turn about their ends, couplers move like the tips."""

    def rate(t, y):
        inertia, pull = (n + 1) / np.longdouble(3) + n, G * ((n + 1) / np.longdouble(2) + n)
        return [y[1], -pull * np.cos(y[0]) / inertia]

    def known(t, y):
        z, w = np.array([np.cos(y[0]), np.sin(y[0])]), y[1] * np.array([-np.sin(y[0]), np.cos(y[0])])
        if not bodies:
            return np.array([[i + z[0], z[1]] for i in range(n + 1)]).ravel(), np.tile(w, n + 1)
        q = [[i + z[0] / 2, z[1] / 2, y[0]] for i in range(n + 1)] + [[i + 0.5 + z[0], z[1], 0] for i in range(n)]
        v = [[*w / 2, y[1]]] * (n + 1) + [[*w, 0]] * n
        return np.array(q).ravel(), np.array(v).ravel()

    return rate, (PI / 2, -1), known


def chain(angles, length, closed):
    """Equal masses at the joints of massless links, by the angles of these from the x axis; the mass drops out.

    Open: a mass at each end of a link. Closed: the last link ends in a pin, which its multipliers hold.
    """
    links = len(angles)
    masses = links - closed
    below = np.maximum(masses - np.arange(links), 0)  # masses that a link carries along
    common = np.minimum.outer(below, below)

    def rate(t, y):
        L, g, th, w = y.dtype.type(length), y.dtype.type(G), y[:links], y[links:]
        shared = common * L**2
        s, c = np.sin(th), np.cos(th)
        M = shared * (np.outer(c, c) + np.outer(s, s))
        turned = np.outer(s, c) - np.outer(c, s)  # sin(th_i - th_j)
        Q = -(shared * turned) @ w**2 - g * L * below * c
        if not closed:
            return np.concatenate([w, solve(M, Q)])
        rows = np.array([-L * s, L * c])
        held = np.array([L * (c * w**2).sum(), L * (s * w**2).sum()])
        matrix = np.vstack([np.hstack([M, rows.T]), np.hstack([rows, np.zeros((2, 2))])])
        return np.concatenate([w, solve(matrix, np.concatenate([Q, held]))[:links]])

    def known(t, y):
        th, w = y[:links], y[links:]
        steps, rates = length * np.array([np.cos(th), np.sin(th)]), length * w * np.array([-np.sin(th), np.cos(th)])
        q, v = np.cumsum(steps, axis=1)[:, :masses], np.cumsum(rates, axis=1)[:, :masses]
        return q.T.ravel(), v.T.ravel()

    return rate, np.concatenate([angles, np.zeros(links, dtype=np.longdouble)]), known


def double_pendulum():
    return chain(np.zeros(2, dtype=np.longdouble), np.longdouble(1), 0)


def closed_chain(n):
    """From a regular polygon whose chords span 0.8, the first two exchanged."""
    links = n + 1
    low, high = np.longdouble(1e-6), PI / links
    for _ in range(80):
        a = (low + high) / 2
        low, high = (a, high) if np.sin(links * a) > 0.8 * np.longdouble(1) * links * np.sin(a) else (low, a)
    angles = (2 * np.arange(links) - n) * low
    angles[:2] = angles[1::-1]
    return chain(angles, 1 / np.longdouble(links), 1)


CRANK, ROD = np.longdouble("0.5"), np.longdouble("1.2")
MASSES = np.array(["1.0", "1.5", "0.8"], dtype=np.longdouble)


def slider_crank():
    """By the angle of the crank."""

    def places(s):
        c, y = CRANK * cos(s), CRANK * sin(s)
        tilt = asin(-y / ROD)
        x = ROD * cos(tilt)
        zero = Jet(0)
        return [c * 0.5, y * 0.5, s, c + x * 0.5, y * 0.5, tilt, c + x, zero, zero]

    inertias = [MASSES[0] * CRANK**2 / 12, MASSES[1] * ROD**2 / 12, 0]

    def rate(t, y):
        q = places(Jet(y[0], 1))
        kinetic = [(w, q[3 * k + i]) for k in range(3) for i, w in enumerate((MASSES[k], MASSES[k], inertias[k]))]
        return [y[1], acceleration(kinetic, G * (MASSES[0] * q[1] + MASSES[1] * q[4]), y[1])]

    return rate, (np.longdouble("0.5"), 8), lambda t, y: state(places(Jet(y[0], 1)), y[1])


def driven_crank():
    """By the angle of the pendulum from the x axis, about a pin whose acceleration is known."""
    r, half, arm = np.longdouble("0.3"), np.longdouble("0.5"), np.longdouble("0.2")

    def pin(t):
        return Jet(np.longdouble("2.5") * t + arm * np.sin(t), np.longdouble("2.5") + arm * np.cos(t), -arm * np.sin(t))

    def rate(t, y):
        a = pin(t)
        x, z = r * cos(a), r * sin(a)
        moment = -half * ((G + z.w) * np.cos(y[0]) - x.w * np.sin(y[0]))
        return [y[1], 3 * moment]  # over m L^2 / 3 about the end of a uniform rod of 1 m

    def known(t, y):
        a = pin(t)
        x, z = r * cos(a), r * sin(a)
        b = Jet(y[0], y[1])
        return state([x * 0.5, z * 0.5, a, x + half * cos(b), z + half * sin(b), b], 1)

    return rate, (np.longdouble("0.4") - PI / 2, -1), known


def sundials_slider_crank():
    """By the crank angle, half of the crank being a = 1/2 of the rod."""
    a, half = np.longdouble("0.5"), np.longdouble("0.5")

    def places(s):
        tilt = asin(-a * sin(s))
        return s, cos(tilt) + a * cos(s), tilt

    def rate(t, y):
        crank, x, tilt = places(Jet(y[0], 1))
        # the middle of the crank, and that of the rod, which reaches from the slider 1 back
        dx, dy = x - half * cos(tilt) - half * a * cos(crank), -half * sin(tilt) - half * a * sin(crank)
        length = sqrt(dx * dx + dy * dy)
        potential = half * (length - 1) * (length - 1) - (x + cos(tilt))
        return [y[1], acceleration([(1, crank), (1, x), (2, tilt)], potential, y[1], length.u**2)]

    return rate, (PI / 2, 0), lambda t, y: state(places(Jet(y[0], 1)), y[1])


def andrews():
    """By beta: each loop is a triangle on the joint that all share."""
    f = np.longdouble
    m = [f(x) for x in ("0.04325", "0.00365", "0.02373", "0.00706", "0.07050", "0.00706", "0.05498")]
    inertia = [f(x) for x in ("2.194e-6", "4.410e-7", "5.255e-6", "5.667e-7", "1.169e-5", "5.667e-7", "1.912e-5")]
    A, B = (f("-0.06934"), f("-0.00227")), (f("-0.03635"), f("0.03273"))
    spring = (f("0.014"), f("0.072"))
    rr, d, ss, zt, e, u, zf = (f(x) for x in ("0.007", "0.028", "0.035", "0.04", "0.02", "0.04", "0.02"))
    ra, da, ee, ff = f("0.00092"), f("0.0115"), f("0.02") - f("0.01421"), f("0.02") - f("0.01421")
    body3, body5, body7 = f("0.01874") ** 2 + f("0.01043") ** 2, f("0.02308") ** 2 + f("0.00916") ** 2, (
        f("0.01228") ** 2 + f("0.00449") ** 2
    )  # fmt: skip

    def places(s):
        """Angles of the bodies in space, and the centres of those that do not turn about a fixed point."""
        O = (rr * cos(s), rr * sin(s))
        shared = meet(O, d, (Jet(B[0]), Jet(B[1])), ss, 1)
        two = angle(O[0] - shared[0], O[1] - shared[1])  # beta + Theta, from the joint to the pin
        three = angle(B[1] - shared[1], shared[0] - B[0])  # shared - B = ss (sin gamma, -cos gamma)
        lower = meet((Jet(A[0]), Jet(A[1])), zt, shared, e, 1)
        five = angle(lower[0] - A[0], lower[1] - A[1])
        four = angle(lower[1] - shared[1], shared[0] - lower[0])  # shared - lower = e (sin, -cos)(Phi + delta)
        upper = meet((Jet(A[0]), Jet(A[1])), u, shared, zf, -1)
        seven = angle(A[1] - upper[1], upper[0] - A[0])  # upper - A = u (sin epsilon, -cos epsilon)
        six = angle(shared[0] - upper[0], shared[1] - upper[1])
        centres = [
            (m[1], [O[i] + (da / d) * (shared[i] - O[i]) for i in range(2)]),
            (m[3], [lower[i] + (ee / e) * (shared[i] - lower[i]) for i in range(2)]),
            (m[5], [upper[i] + (ff / zf) * (shared[i] - upper[i]) for i in range(2)]),
        ]
        return s, two, three, four, five, six, seven, centres

    def rate(t, y):
        *turns, centres = places(Jet(y[0], 1))
        about = [m[0] * ra**2, 0, m[2] * body3, 0, m[4] * body5, 0, m[6] * body7]
        kinetic = [(inertia[k] + about[k], turns[k]) for k in range(7)]
        kinetic += [(mass, x) for mass, centre in centres for x in centre]
        s3, c3 = sin(turns[2]), cos(turns[2])
        dx = f("0.02") * c3 + f("0.018") * s3 + B[0] - spring[0]
        dy = f("0.02") * s3 - f("0.018") * c3 + B[1] - spring[1]
        stretch = sqrt(dx * dx + dy * dy) - f("0.07785")
        return [y[1], acceleration(kinetic, f("2265") * stretch * stretch - f("0.033") * turns[0], y[1])]

    def known(t, y):
        one, two, three, four, five, six, seven, _ = places(Jet(y[0], 1))
        q, v = state([one, two - one, three, four - five, five, six - seven, seven], y[1])
        q[1] += 2 * PI * np.round((-q[0] + 0.054 - q[1]) / (2 * PI))  # Theta turns back as beta turns on
        return q, v

    return rate, (f("-0.0617138900142764496358948458001"), 0), known
