"""IFToMM A04, Bricard's mechanism, with all 60 rows: five bars of 1 m and 1 kg on the edges of a cube, six hinges.

Each bar has the coordinates of its centre and the three columns of its rotation matrix, hence a constant mass matrix;
six rows keep these orthonormal, five make a hinge. The sixth bar is the ground. Geometry and inertia as in the Exudyn
model (`jgerstmayr/EXUDYN` main/pythonDev/TestModels/bricardMechanism.py): bars of 1 x 0.1 x 0.1 m, 100 kg/m^3, gravity
along -y.

The reference has one coordinate. The linkage keeps its threefold symmetry: hinges 0, 2, 4 turn alike, and 1, 3, 5. The
angles 2A and 2B between neighbouring bars (0: in line) satisfy (1 + cos 2A)(1 + cos 2B) = 1, that is,
sin^2((A + B)/2) + sin^2((A - B)/2) = 1/2, which a single angle s parametrises: (A + B)/2 = arcsin(cos(s)/sqrt 2), and
so on.
"""

from functools import cache

import numpy as np

from tests.general.mechanism import G, Mechanism, integrate
from tests.general.quadratic import ONE, Rows, difference

CORNERS = np.array([[0, 0, 0], [1, 0, 0], [1, -1, 0], [1, -1, 1], [0, -1, 1], [0, 0, 1]], dtype=float)
AXES = np.eye(3)[[1, 2, 0, 1, 2, 0]]
BARS = np.roll(CORNERS, -1, axis=0) - CORNERS
# columns: along the bar, along the hinge at its start, and across both
FRAMES = np.array([np.array([bar, axis, np.cross(bar, axis)]).T for bar, axis in zip(BARS, AXES, strict=True)])[:5]
MASS = np.tile(np.repeat([1.0, 1.0 / 12.0, 0.01 / 12.0, 0.01 / 12.0], 3), 5)  # bodies of 1 kg; width^2/12
WEIGHT = np.tile([0.0, -G, *[0.0] * 10], 5)
END = 2.0

# --- the model


def _vector(body, k):
    """The centre (k = 0) or column k of the rotation matrix of a bar, as three scalars."""
    return [{12 * body + 3 * k + i: 1.0} for i in range(3)]


def _fixed(vector):
    return [{None: float(x)} for x in vector]


def _point(body, s):
    """The point at s, from -0.5 to 0.5, of a bar."""
    return [{12 * body + i: 1.0, 12 * body + 3 + i: s} for i in range(3)]


def _dot(a, b):
    return [(1.0, x, y) for x, y in zip(a, b, strict=True)]


def _columns(body):
    return [_vector(body, 1), _vector(body, 2), _vector(body, 3)]


def _in_frame(body, vector):
    """A vector of the start configuration, carried along by a bar."""
    parts = FRAMES[body].T @ vector
    return [{12 * body + 3 * k + i: float(parts[k - 1]) for k in (1, 2, 3)} for i in range(3)]


@cache
def _rows():
    rows = Rows(60)
    for body in range(5):
        d = _columns(body)
        for k in range(3):
            rows.add(*[(0.5, x, x) for x in d[k]], (-0.5, ONE, ONE))
        for j, k in ((0, 1), (1, 2), (2, 0)):
            rows.add(*_dot(d[j], d[k]))
    for hinge, axis in enumerate(AXES):
        start = _point(hinge, -0.5) if hinge < 5 else _fixed(CORNERS[5])
        end = _point(hinge - 1, 0.5) if hinge > 0 else _fixed(CORNERS[0])
        for a, b in zip(start, end, strict=True):
            rows.add((1.0, difference(a, b), ONE))
        of_one = _in_frame(hinge - 1, axis) if hinge > 0 else _fixed(axis)
        for across in np.roll(np.eye(3), 1, axis=0):
            if across @ axis == 0.0:
                of_other = _in_frame(hinge, across) if hinge < 5 else _fixed(across)
                rows.add(*_dot(of_one, of_other))
    return rows


# --- the motion, by one coordinate


def _turn(axis, angle):
    """Rotation about a coordinate axis; the angle may be complex."""
    K = np.array([[0.0, -axis[2], axis[1]], [axis[2], 0.0, -axis[0]], [-axis[1], axis[0], 0.0]])
    return np.eye(3) + np.sin(angle) * K + (1.0 - np.cos(angle)) * K @ K


def kinematics(s):
    """All 60 coordinates and their derivatives by s; analytic, so that s may be complex."""
    root = np.sqrt(2.0)
    plus, minus = 2.0 * np.arcsin(np.cos(s) / root), 2.0 * np.arcsin(np.sin(s) / root)
    plus_u = -2.0 * np.sin(s) / np.sqrt(2.0 - np.cos(s) ** 2)
    minus_u = 2.0 * np.cos(s) / np.sqrt(2.0 - np.sin(s) ** 2)
    turns = (plus + minus + 0.5 * np.pi, plus - minus + 0.5 * np.pi)  # from the start, where both are -pi/2
    rates = (plus_u + minus_u, plus_u - minus_u)
    R, corner = np.eye(3), CORNERS[0]
    spin, velocity = np.zeros(3), np.zeros(3)
    q, u = [], []
    for body in range(5):
        spin = spin + R @ AXES[body] * rates[body % 2]
        R = R @ _turn(AXES[body], turns[body % 2])
        frame = R @ FRAMES[body]
        half = 0.5 * frame[:, 0]
        half_u = np.cross(spin, half)
        q += [corner + half, *frame.T]
        u += [velocity + half_u, *np.cross(spin, frame.T)]
        corner, velocity = corner + 2.0 * half, velocity + 2.0 * half_u
    return np.concatenate(q), np.concatenate(u)


def bricard():
    def rate(t, y):
        e = 1e-30  # the imaginary part of f(s + i e) / e is f'(s), without cancellation
        _, u = kinematics(y[0] + 1j * e)
        inertia = (u * u) @ MASS
        return [y[1], (WEIGHT @ u.real - 0.5 * inertia.imag / e * y[1] ** 2) / inertia.real]

    solution = integrate(rate, (np.pi, 0.0), END)

    def state(t):
        s, speed = solution(t)
        q, u = kinematics(s)
        return q, u * speed

    weight = WEIGHT
    return Mechanism(
        name="Bricard",
        sizes={"n_q": 60, "n_c": _rows().n_c},
        functions={"mass": np.diag(MASS), "force": lambda t, q, v: weight.copy(), **_rows().functions()},
        end=END,
        state=state,
        rank=59,
        energy=lambda q, v: 0.5 * v @ (MASS * v) - WEIGHT @ q,
        compile=True,
    )
