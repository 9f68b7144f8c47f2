"""Mechanisms with redundant and non-holonomic rows, singular masses, lost rank; systems that contradict themselves."""

import numpy as np

from tests.general.mechanism import G, Mechanism, known, of_functions
from tests.mechanisms.motions import spatial
from tests.problems import functions_of, pendulum, unconstrained
from twoloop import mechanisms
from twoloop.mechanisms.knife_edge import SPIN
from twoloop.mechanisms.quadratic import QuadraticSystem
from twoloop.mechanisms.rolling_disc import RADIUS
from twoloop.mechanisms.rolling_disc import energy as energy_of_disc

END = 2.0


def crossing_lines():
    """A bead on x^2 = y^2, thrown up along x = y through the crossing, where C_q = 0. Closed form."""
    rows = QuadraticSystem(np.eye(2), np.array([0.0, -G]))
    rows.row((0.5, {0: 1.0}, {0: 1.0}), (-0.5, {1: 1.0}, {1: 1.0}))
    system = rows.system("crossing lines")

    def state(t):
        s, speed = -1.0 + 4.0 * t - 0.25 * G * t * t, 4.0 - 0.5 * G * t
        return np.array([s, s]), np.array([speed, speed])

    energy = lambda q, v: 0.5 * v @ v + G * q[1]  # noqa: E731
    return Mechanism("crossing lines", lambda: system, 1.0, state, rank=1, energy=energy)


CUSP_TIME = (13.0**1.5 - 8.0) / 27.0  # length of y^2 = x^3 from (1, 1) to the origin, at unit speed


def cusp():
    """A free bead of unit speed on y^2 = x^3, from (1, 1) towards the cusp, where the curve turns back: it cannot pass.

    `state` holds up to `CUSP_TIME`.
    """

    def state(t):
        # at u = x^(1/2) the length still to go is ((4 + 9 u^2)^1.5 - 8) / 27
        u = np.sqrt(max(0.0, (27.0 * (CUSP_TIME - t) + 8.0) ** (2.0 / 3.0) - 4.0)) / 3.0
        return np.array([u**2, u**3]), -np.array([2.0, 3.0 * u]) / np.hypot(2.0, 3.0 * u)

    system = unconstrained(
        lambda t, q, v: np.zeros(2),
        2,
        n_c=1,
        constraint=lambda t, q: np.array([0.5 * (q[1] ** 2 - q[0] ** 3)]),
        jacobian=lambda t, q: np.array([[-1.5 * q[0] ** 2, q[1]]]),
        gamma=lambda t, q, v: np.array([3.0 * q[0] * v[0] ** 2 - v[1] ** 2]),
        name="cusp",
    )
    return Mechanism("cusp", lambda: system, END, state, rank=1)


# --- the rolling disc: a holonomic row and non-holonomic ones; x, y, z of the centre, yaw, lean from the vertical, spin
DISC = mechanisms.rolling_disc().system


def wobbling_disc(redundant=False):
    """The contact point is at rest: three rows, the vertical one of which follows from the holonomic row."""

    def nonholonomic(t, q):  # the contact point does not move along z either
        return np.vstack([DISC.nonholonomic(t, q), [0.0, 0.0, 1.0, 0.0, RADIUS * np.sin(q[4]), 0.0]])

    def nonholonomic_gamma(t, q, v):
        return np.append(DISC.nonholonomic_gamma(t, q, v), -RADIUS * np.cos(q[4]) * v[4] ** 2)

    more = {"n_q": 6, "n_c": 1, "n_a": 3, "nonholonomic": nonholonomic, "nonholonomic_gamma": nonholonomic_gamma}
    system = of_functions(**functions_of(DISC) | more) if redundant else lambda: DISC
    state, energy = known(spatial.rolling_disc(), END), lambda q, v: energy_of_disc(0.0, q, v)
    return Mechanism(f"wobbling disc{', redundant' if redundant else ''}", system, END, state, rank=3, energy=energy)


KNIFE_EDGE = mechanisms.knife_edge()
EDGE = KNIFE_EDGE.system
EDGE_FUNCTIONS = {"n_q": 3, "n_c": 0, "n_a": 1, "name": "knife edge", **functions_of(EDGE)}
PUSH = 0.6  # amplitude of the sideways speed, m/s


def pushed_knife_edge():
    """The blade slides to its right at PUSH sin(2 SPIN t): A v + b = 0 with b = -PUSH sin(2 SPIN t).

    Along the blade u' = PULL cos(phi) - SPIN w, across it w is given; both integrate in closed form.
    """

    def pushed(t):
        s, c = np.sin(SPIN * t), np.cos(SPIN * t)
        q, v = KNIFE_EDGE.motion(t)
        along, across = -PUSH * s * s, 2.0 * PUSH * s * c
        q = q + PUSH / SPIN * np.array([s**3 / 3.0, c + c**3 / 3.0 - 4.0 / 3.0, 0.0])
        return q, v + np.array([along * c + across * s, along * s - across * c, 0.0])

    rate = lambda t, q: np.array([-PUSH * np.sin(2.0 * SPIN * t)])  # noqa: E731
    gamma = lambda t, q, v: EDGE.nonholonomic_gamma(t, q, v) + 2.0 * PUSH * SPIN * np.cos(2.0 * SPIN * t)  # noqa: E731
    system = of_functions(**EDGE_FUNCTIONS | {"nonholonomic_rate": rate, "nonholonomic_gamma": gamma})
    return Mechanism("pushed knife edge", system, END, pushed, rank=1)


SPRING = 20.0


def massless_coordinate():
    """A pendulum, q = x, y, s: the massless s follows x by a row, and a spring pulls at s."""

    def state(t, y):  # by the angle from below
        s, c = np.sin(y[0]), np.cos(y[0])
        return np.array([s, -c, s]), y[1] * np.array([c, s, c])

    functions = {
        "force": lambda t, q, v: np.array([0.0, -G, -SPRING * q[2]]),
        "constraint": lambda t, q: np.array([0.5 * (q[0] * q[0] + q[1] * q[1] - 1.0), q[2] - q[0]]),
        "jacobian": lambda t, q: np.array([[q[0], q[1], 0.0], [-1.0, 0.0, 1.0]]),
        "gamma": lambda t, q, v: np.array([-v[0] * v[0] - v[1] * v[1], 0.0]),
    }
    system = of_functions(name="massless coordinate", n_q=3, n_c=2, mass=np.diag([1.0, 1.0, 0.0]), **functions)
    state = known((lambda t, y: [y[1], -(G + SPRING * np.cos(y[0])) * np.sin(y[0])], (1.2, 0.5), state), END)
    energy = lambda q, v: 0.5 * (v[0] ** 2 + v[1] ** 2) + G * q[1] + 0.5 * SPRING * q[2] ** 2  # noqa: E731
    return Mechanism("massless coordinate", system, END, state, rank=2, energy=energy)


def without_inertia(mass=(1.0, 1.0, 0.0)):
    """A pendulum x, y and a third coordinate that no row holds; by default it has no mass."""
    more = {"mass": np.diag(mass), "jacobian": lambda t, q: np.array([[q[0], q[1], 0.0]]), "name": "drifter"}
    return pendulum(n_q=3, force=lambda t, q, v: np.array([0.0, -G, 0.0]), **more)


def parted_drives(power):
    """Two coordinates; row 1 drives q0 by sin(t), and row 2 by sin(t) + t^power: they part after the start.

    At t = 0 both agree in position and in velocity; with power = 3 in acceleration, too.
    """
    zero = power == 2
    return pendulum(
        n_c=3,
        constant_mass=True,
        constraint=lambda t, q: np.array([q[1] - q[0], q[0] - np.sin(t), q[0] - np.sin(t) - t**power]),
        jacobian=lambda t, q: np.array([[-1.0, 1.0], [1.0, 0.0], [1.0, 0.0]]),
        constraint_rate=lambda t, q: np.array([0.0, -np.cos(t), -np.cos(t) - power * t ** (power - 1)]),
        gamma=lambda t, q, v: np.array([0.0, -np.sin(t), -np.sin(t) + (2.0 if zero else 6.0 * t)]),
        name="two drives",
    )


def parted_velocities():
    """Two non-holonomic rows of the same direction at t = 0 that ask for different speeds: none satisfies both."""
    rows = {
        "nonholonomic": lambda t, q: np.array([[1.0, 0.0], [2.0, 0.0]]),
        "nonholonomic_rate": lambda t, q: np.array([-1.0, -3.0]),
    }
    return unconstrained(lambda t, q, v: np.zeros(2), 2, n_a=2, **rows, name="two speeds")
