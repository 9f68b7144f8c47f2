"""Spatial mechanisms by few coordinates: heavy top, spatial four-bar and slider-crank, governor, Bricard, disc, blade.

A motion is a triple: rate(t, y), the start y0, and state(t, y) -> q, v in the coordinates of the ready mechanism.
"""

import numpy as np

from tests.mechanisms.motions.jets import Jet, acceleration, asin, cos, cross, sin, sqrt, state
from tests.mechanisms.motions.planar import PI, G

f = np.longdouble


def turned(e, w):
    """e' at the angular velocity w along the axes of space: half the product of quaternions w e."""
    return [
        -(w[0] * e[1] + w[1] * e[2] + w[2] * e[3]) / 2,
        (w[0] * e[0] + w[1] * e[3] - w[2] * e[2]) / 2,
        (w[1] * e[0] + w[2] * e[1] - w[0] * e[3]) / 2,
        (w[2] * e[0] + w[0] * e[2] - w[1] * e[1]) / 2,
    ]


def product(a, b):
    """The product of two quaternions."""
    return np.concatenate([[a[0] * b[0] - a[1:] @ b[1:]], (a[0] * b[1:] + b[0] * a[1:] + np.cross(a[1:], b[1:]))])


def carried(e, a):
    """The vector a turned by e: the product e a e*."""
    whole = product(product(e, np.concatenate([[0 * e[0]], a])), e * np.array([1, -1, -1, -1]))
    return whole[1:]


def parameters(d):
    """Euler parameters of the frame with columns d, of positive e0 (values, not jets)."""
    e0 = np.sqrt(1 + d[0][0] + d[1][1] + d[2][2]) / 2
    return np.array([e0, *(x / (4 * e0) for x in (d[1][2] - d[2][1], d[2][0] - d[0][2], d[0][1] - d[1][0]))])


def values(vector):
    return np.array([jet.x for jet in vector])


def rates(vector, speed):
    return np.array([jet.u * speed for jet in vector])


# --- heavy top, by Euler's equations about the fixed point
def heavy_top():
    m, across, axial = f(15), f("0.234375") + 15, f("0.46875")

    def rate(t, y):
        e, (a, s, b) = y[:4], y[4:]
        up = carried(e * np.array([1, -1, -1, -1]), np.array([0, 0, 1], dtype=y.dtype))
        w = carried(e, y[4:])
        gain = (across - axial) * s
        return np.array([*turned(e, w), (-m * G * up[2] - gain * b) / across, 0, (m * G * up[0] + gain * a) / across])

    def known(t, y):
        e, w = y[:4], carried(y[:4], y[4:])
        r = carried(e, np.array([0, 1, 0], dtype=y.dtype))
        return np.concatenate([r, e]), np.concatenate([np.cross(w, r), turned(e, w)])

    return rate, (1, 0, 0, 0, 0, 150, f("-4.61538")), known


# --- rolling disc, by the balance of momentum about the contact point in a frame that does not spin
def rolling_disc():
    m, r = f(2), f("0.4")
    across, axial = m * r**2 / 4, m * r**2 / 2

    def centre(yaw, lean, ahead, turn):
        s, c = np.sin(yaw), np.cos(yaw)
        return r * (ahead * np.cos(lean) * s - turn * c), r * (-ahead * np.cos(lean) * c - turn * s)

    def rate(t, y):
        yaw, lean, _, ahead, upright, turn = y[:6]
        frame = -upright * np.tan(lean)  # turn of the frame about the axis of the disc
        yaw_rate = upright / np.cos(lean)
        fall = m * G * r * np.sin(lean) - (axial + m * r**2) * upright * turn + across * frame * upright
        angles = [yaw_rate, ahead, turn + yaw_rate * np.sin(lean), fall / (across + m * r**2)]
        speeds = [(axial * ahead * turn - across * frame * ahead) / across]
        speeds += [m * r**2 * ahead * upright / (axial + m * r**2)]
        return np.array([*angles, *speeds, *centre(yaw, lean, ahead, turn)])

    def known(t, y):
        yaw, lean, spin, ahead, upright, turn, x, z = y
        yaw_rate = upright / np.cos(lean)
        q = np.array([x, z, r * np.cos(lean), yaw, lean, spin])
        more = [-r * np.sin(lean) * ahead, yaw_rate, ahead, turn + yaw_rate * np.sin(lean)]
        return q, np.array([*centre(yaw, lean, ahead, turn), *more])

    return rate, (f("0.1"), f("0.3"), 0, f("0.6"), f("1.5"), -9, 0, 0), known


# --- knife edge, by the speed along the blade
def knife_edge():
    slope, spin = f("0.4"), f("1.7")

    def rate(t, y):
        s, c = np.sin(spin * t), np.cos(spin * t)
        return np.array([G * np.sin(slope) * c, y[0] * c, y[0] * s])

    def known(t, y):
        s, c = np.sin(spin * t), np.cos(spin * t)
        return np.array([y[1], y[2], spin * t]), np.array([y[0] * c, y[0] * s, spin])

    return rate, (0, 0, 0), known


# --- Bricard, by a parameter of the curve on which the angles of neighbouring bars lie: with 2 A and 2 B between them
# (0: in line), (1 + cos 2 A)(1 + cos 2 B) = 1, that is, sin^2((A + B) / 2) + sin^2((A - B) / 2) = 1 / 2


def bricard():
    corners = np.array([[0, 0, 0], [1, 0, 0], [1, -1, 0], [1, -1, 1], [0, -1, 1], [0, 0, 1]])
    axes = np.eye(3, dtype=int)[[1, 2, 0, 1, 2]]
    moments = [f(1) / 12, f("0.01") / 12, f("0.01") / 12]

    def about(axis, frame, turn):
        """The columns of a frame, turned about an axis of space."""
        s, c = sin(turn), cos(turn)
        i = int(np.argmax(axis))
        j, k = (i + 1) % 3, (i + 2) % 3
        result = []
        for column in frame:
            new = list(column)
            new[j], new[k] = c * column[j] - s * column[k], s * column[j] + c * column[k]
            result.append(new)
        return result

    def places(s):
        """Centre and columns of each bar, from the last to the first: hinges turn all bars behind them."""
        root = np.sqrt(f(2))
        plus, minus = 2 * asin(cos(s) / root), 2 * asin(sin(s) / root)
        turns = [plus + minus + PI / 2, plus - minus + PI / 2]
        bars = []
        for k in range(5):
            bar = corners[k + 1] - corners[k]
            frame = [[Jet(int(x)) for x in column] for column in (bar, axes[k], np.cross(bar, axes[k]))]
            for hinge in range(k, -1, -1):
                frame = about(axes[hinge], frame, turns[hinge % 2])
            bars.append(frame)
        start, result = [Jet(0)] * 3, []
        for frame in bars:
            result += [x + d * f(0.5) for x, d in zip(start, frame[0], strict=True)]
            result += [x for column in frame for x in column]
            start = [x + d for x, d in zip(start, frame[0], strict=True)]
        return result

    weights = np.tile(np.repeat([f(1), *moments], 3), 5)

    def rate(t, y):
        q = places(Jet(y[0], 1))
        fall = G * sum((q[12 * k + 1] for k in range(5)), Jet(0))
        return np.array([y[1], acceleration(list(zip(weights, q, strict=True)), fall, y[1])])

    return rate, (PI, 0), lambda t, y: state(places(Jet(y[0], 1)), y[1])


# --- spatial slider-crank, by the crank angle; the Euler parameters of the rod follow its spin
def spatial_slider_crank():
    crank, rod = f("0.08"), f("0.3")
    moments = (f("3.8e-3"), f("2e-4"), f("2e-4"))  # of mass along the rod's axes: (J2 + J3 - J1) / 2 and so on

    def places(s):
        B = [Jet(0), f("0.1") - crank * sin(s), f("0.12") + crank * cos(s)]
        across = sqrt(B[1] * B[1] + B[2] * B[2])
        x = sqrt(Jet(rod * rod) - across * across)
        zero = Jet(0)
        frame = [[x / rod, -B[1] / rod, -B[2] / rod], [zero, -B[2] / across, B[1] / across]]
        frame.append(cross(*frame))
        middle = [x * f(0.5), B[1] * f(0.5), B[2] * f(0.5)]
        return [zero, B[1] + crank / 2 * sin(s), B[2] - crank / 2 * cos(s)], middle, x, frame

    def rate(t, y):
        s = Jet(y[0], 1)
        centre, middle, x, frame = places(s)
        kinetic = [(f("0.12"), z) for z in centre] + [(f("0.5"), z) for z in middle] + [(f(2), x), (f("1e-4"), s)]
        kinetic += [(w, z) for w, column in zip(moments, frame, strict=True) for z in column]
        fall = G * (f("0.12") * centre[2] + f("0.5") * middle[2])
        spin = sum(np.cross(values(d), rates(d, y[1])) for d in frame) / 2
        return np.array([y[1], acceleration(kinetic, fall, y[1]), *turned(y[2:], spin)])

    def known(t, y):
        s, zero, speed = Jet(y[0], 1), Jet(0), y[1]
        centre, middle, x, frame = places(s)
        spin = sum(np.cross(values(d), rates(d, speed)) for d in frame) / 2
        bar_q, bar_v = state(middle, speed)
        first = state([*centre, cos(s / 2), sin(s / 2), zero, zero], speed)
        last = state([x, zero, zero, Jet(1), zero, zero, zero], speed)
        return (
            np.concatenate([first[0], bar_q, y[2:], last[0]]),
            np.concatenate([first[1], bar_v, turned(y[2:], spin), last[1]]),
        )

    return rate, (0, 6, *parameters([values(d) for d in places(Jet(f(0), 1))[3]])), known


# --- spatial four-bar, by the crank angle; the coupler does not turn about its own axis, in which it moves
def spatial_four_bar():
    crank, rocker, D = f("0.3"), f("0.7"), [f("0.9"), f(0), f("0.3")]
    length = np.sqrt(f("1.36"))
    masses, radius = (f("0.6"), f(1), f("0.8")), f("0.02")

    def across(m, L):
        return m * (L**2 / 12 + radius**2 / 4)

    def places(s):
        P = [crank * cos(s), crank * sin(s), Jet(0)]
        x, z = D[0] - P[0], D[2] - P[2]
        reach = sqrt(x * x + z * z)
        opposite = (length**2 - rocker**2 - (x * x + P[1] * P[1] + z * z)) / (2 * rocker * reach)
        # phi = angle of (x, z) + arccos(opposite)
        sine = sqrt(Jet(1) - opposite * opposite)
        c, d = (x * opposite - z * sine) / reach, (z * opposite + x * sine) / reach
        return P, [D[0] + rocker * c, Jet(0), D[2] + rocker * d], c, d

    def bar(P, S):
        return [(b - a) / length for a, b in zip(P, S, strict=True)]

    def rate(t, y):
        s = Jet(y[0], 1)
        P, S, c, d = places(s)
        u = bar(P, S)
        m = masses
        kinetic = [(m[0] / 4, z) for z in P] + [(across(m[0], crank), s)]
        kinetic += [(m[1] / 4, a + b) for a, b in zip(P, S, strict=True)] + [(across(m[1], length), z) for z in u]
        kinetic += [(m[2] * rocker**2 / 4 + across(m[2], rocker), z) for z in (c, d)]
        fall = G * (m[1] * (P[2] + S[2]) / 2 + m[2] * rocker * d / 2)
        spin = np.cross(values(u), rates(u, y[1]))
        return np.array([y[1], acceleration(kinetic, fall, y[1]), *turned(y[2:6], spin), *_rocker(d, c, y)])

    def _rocker(d, c, y):
        """e' of the rocker, which turns about y by minus its angle."""
        return turned(y[6:], np.array([0, -(c.x * d.u - d.x * c.u) * y[1], 0]))

    def known(t, y):
        s, zero, speed = Jet(y[0], 1), Jet(0), y[1]
        P, S, c, d = places(s)
        u = bar(P, S)
        spin = np.cross(values(u), rates(u, speed))
        first = state([z * f(0.5) for z in P] + [cos(s / 2), zero, zero, sin(s / 2)], speed)
        middle = state([(a + b) * f(0.5) for a, b in zip(P, S, strict=True)], speed)
        end = state([D[0] + rocker / 2 * c, zero, D[2] + rocker / 2 * d], speed)
        return (
            np.concatenate([first[0], middle[0], y[2:6], end[0], y[6:]]),
            np.concatenate([first[1], middle[1], turned(y[2:6], spin), end[1], _rocker(d, c, y)]),
        )

    P, S, _, _ = places(Jet(f(0), 1))
    along = values(bar(P, S))
    side = np.array([along[2], 0, -along[0]]) / np.sqrt(along[0] ** 2 + along[2] ** 2)  # y x along
    start = parameters([along, side, np.cross(along, side)])
    upright = (f(0.5), -f(0.5), -f(0.5), -f(0.5))  # its axes are z, x and y of space: a turn by 120 degrees
    return rate, (0, 5, *start, *upright), known


# --- governor, by the angle of the rods and the height of the slider; the whole turns as its momentum says
def governor():
    g, rod, ball, cube = G, f("0.3"), f(5), f(3)
    m = rod + ball
    c = (rod / 2 + ball) / m
    axial, own = rod * f("2e-4") / 12, rod * (1 + f("1e-4")) / 12
    across = own + rod * (c - f(0.5)) ** 2 + ball * (1 - c) ** 2
    still = rod * f("2e-4") / 12 + cube * f("0.02") / 12

    def turning(b):
        s, k = np.sin(b), np.cos(b)
        arm = f("0.05") + c * k
        slope = -2 * m * arm * c * s + 2 * (axial - across) * s * k
        return still + 2 * (m * arm**2 + axial * s * s + across * k * k), 2 * slope

    momentum = turning(PI / 6)[0] * 2 * PI

    def rate(t, y):
        _, b, z, b1, z1 = y
        s, k = np.sin(b), np.cos(b)
        whole, slope = turning(b)
        turn = momentum / whole
        gap = 1 - s / 2 - z
        length = np.sqrt(k * k / 4 + gap * gap)
        by_b, by_z = -(k * s / 4 + k * gap / 2) / length, -gap / length
        pull = 2 * (f(8e5) * (length - f(0.5)) + f(4e4) * (by_b * b1 + by_z * z1))
        b2 = (slope * turn**2 / 2 + 2 * m * g * c * k - pull * by_b) / (2 * (m * c * c + across))
        return np.array([turn, b1, z1, b2, -g - pull * by_z / cube])

    def known(t, y):
        psi, b, z, b1, z1 = y
        turn = rate(t, y)[0]
        s, k = np.sin(b), np.cos(b)
        up = np.array([0, 0, 1 + 0 * z])
        half = np.array([np.cos(psi / 2), 0, 0, np.sin(psi / 2)])
        spin = turn * up
        q, v = [up / 2, half, z * up, half], [0 * up, turned(half, spin), z1 * up, turned(half, spin)]
        for more in (0, PI):
            out = np.array([np.cos(psi + more), np.sin(psi + more), 0])
            hinge = np.cross(up, out)
            e = product(
                np.array([np.cos((psi + more) / 2), 0, 0, np.sin((psi + more) / 2)]),
                np.array([np.cos(b / 2), 0, np.sin(b / 2), 0]),
            )
            q += [(f("0.05") + c * k) * out + (1 - c * s) * up, e]
            v += [(f("0.05") + c * k) * turn * hinge - c * b1 * (s * out + k * up), turned(e, spin + b1 * hinge)]
        return np.concatenate(q), np.concatenate(v)

    return rate, (0, PI / 6, f(0.5), 0, 0), known
