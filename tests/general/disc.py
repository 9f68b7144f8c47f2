"""A disc that rolls on a horizontal plane without slipping: a holonomic row and non-holonomic ones.

Coordinates: x, y, z of the centre, yaw, lean from the vertical, spin. The contact point is at rest, which is three
rows, of which the vertical one is the derivative of the holonomic row: redundant, and left out where `redundant` is
False.
"""

import numpy as np

from tests.general.mechanism import G, Mechanism, integrate

M, R = 2.0, 0.4
ACROSS, AXIAL = 0.25 * M * R**2, 0.5 * M * R**2  # moments of inertia about a diameter and about the axis

# --- the model: Euler angles, Lagrange's equations


def mass(t, q):
    s, c = np.sin(q[4]), np.cos(q[4])
    matrix = np.diag(np.array([M, M, M, ACROSS * c * c + AXIAL * s * s, ACROSS, AXIAL]))
    matrix[3, 5] = matrix[5, 3] = -AXIAL * s
    return matrix


def force(t, q, v):
    s, c = np.sin(q[4]), np.cos(q[4])
    yaw, lean, spin = v[3], v[4], v[5]
    more = 2.0 * s * c * (AXIAL - ACROSS)
    return np.array(
        [
            0.0,
            0.0,
            -M * G,
            -more * lean * yaw + AXIAL * c * lean * spin,
            0.5 * more * yaw * yaw - AXIAL * c * yaw * spin,
            AXIAL * c * lean * yaw,
        ]
    )


def constraint(t, q):
    return np.array([q[2] - R * np.cos(q[4])])


def jacobian(t, q):
    Cq = np.zeros((1, 6))
    Cq[0, 2], Cq[0, 4] = 1.0, R * np.sin(q[4])
    return Cq


def gamma(t, q, v):
    return np.array([-R * np.cos(q[4]) * v[4] ** 2])


def nonholonomic(t, q):
    sy, cy, s, c = np.sin(q[3]), np.cos(q[3]), np.sin(q[4]), np.cos(q[4])
    A = np.zeros((3, 6))
    A[0, 0] = A[1, 1] = A[2, 2] = 1.0
    A[0, 3], A[0, 4], A[0, 5] = -R * cy * s, -R * c * sy, R * cy
    A[1, 3], A[1, 4], A[1, 5] = -R * sy * s, R * c * cy, R * sy
    A[2, 4] = R * s
    return A


def nonholonomic_gamma(t, q, v):
    sy, cy, s, c = np.sin(q[3]), np.cos(q[3]), np.sin(q[4]), np.cos(q[4])
    yaw, lean, spin = v[3], v[4], v[5]
    return np.array(
        [
            R * (yaw * (-sy * s * yaw + cy * c * lean) + lean * (-s * sy * lean + c * cy * yaw) + spin * sy * yaw),
            R * (yaw * (cy * s * yaw + sy * c * lean) + lean * (s * cy * lean + c * sy * yaw) - spin * cy * yaw),
            -R * c * lean * lean,
        ]
    )


def energy(q, v):
    return 0.5 * v @ mass(0.0, q) @ v + M * G * q[2]


def _disc(name, end, state, redundant):
    rows = {"nonholonomic": nonholonomic, "nonholonomic_gamma": nonholonomic_gamma}
    if not redundant:
        rows = {
            "nonholonomic": lambda t, q: nonholonomic(t, q)[:2],
            "nonholonomic_gamma": lambda t, q, v: nonholonomic_gamma(t, q, v)[:2],
        }
    return Mechanism(
        name=f"{name}{', redundant' if redundant else ''}",
        sizes={"n_q": 6, "n_c": 1, "n_a": 3 if redundant else 2},
        functions={
            "mass": mass,
            "force": force,
            "constraint": constraint,
            "jacobian": jacobian,
            "gamma": gamma,
            **rows,
        },
        end=end,
        state=state,
        rank=3,
        energy=energy,
    )


# --- steady rolling in a circle, closed form

LEAN, YAW_RATE = -0.35, 1.1  # the centre of the circle is on the side to which the disc leans


def steady_disc(redundant=False):
    """The moment of the weight about the contact turns the angular momentum: this gives the speed of the spin."""
    s, c = np.sin(LEAN), np.cos(LEAN)
    upright = YAW_RATE * c  # angular velocity along the diameter through the contact
    axial = (M * G * R * s - ACROSS * upright**2 * s / c) / ((AXIAL + M * R**2) * upright)
    spin, speed = axial + YAW_RATE * s, R * axial

    def state(t):
        yaw = YAW_RATE * t
        radius = speed / YAW_RATE
        q = np.array([-radius * np.sin(yaw), radius * np.cos(yaw), R * c, yaw, LEAN, spin * t])
        return q, np.array([-speed * np.cos(yaw), -speed * np.sin(yaw), 0.0, YAW_RATE, 0.0, spin])

    return _disc("steady disc", 4.0, state, redundant)


# --- general motion, by momentum balance about the contact point in a frame that does not spin

START = (0.1, 0.3, 0.0, 0.6, 1.5, -9.0)  # yaw, lean, spin, and the angular velocity: ahead, upright, axial
END = 2.0


def wobbling_disc(redundant=False):
    heavy_across, heavy_axial = ACROSS + M * R**2, AXIAL + M * R**2

    def rate(t, y):
        yaw, lean, _, ahead, upright, axial = y[:6]
        turn = -upright * np.tan(lean)  # of the frame about the axis of the disc
        yaw_rate = upright / np.cos(lean)
        return [
            yaw_rate,
            ahead,
            axial + yaw_rate * np.sin(lean),
            (M * G * R * np.sin(lean) - heavy_axial * upright * axial + ACROSS * turn * upright) / heavy_across,
            (AXIAL * ahead * axial - ACROSS * turn * ahead) / ACROSS,
            M * R**2 * ahead * upright / heavy_axial,
            *_centre_velocity(yaw, lean, ahead, axial),
        ]

    solution = integrate(rate, (*START, 0.0, 0.0), END)

    def state(t):
        y = solution(t)
        yaw, lean, spin, ahead, upright, axial, x, z = y
        turn = upright / np.cos(lean)
        q = np.array([x, z, R * np.cos(lean), yaw, lean, spin])
        rates = [-R * np.sin(lean) * ahead, turn, ahead, axial + turn * np.sin(lean)]
        return q, np.array([*_centre_velocity(yaw, lean, ahead, axial), *rates])

    return _disc("wobbling disc", END, state, redundant)


def _centre_velocity(yaw, lean, ahead, axial):
    s, c = np.sin(yaw), np.cos(yaw)
    return R * (ahead * np.cos(lean) * s - axial * c), R * (-ahead * np.cos(lean) * c - axial * s)
