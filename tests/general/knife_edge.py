"""The knife edge of the library, and two variations of it, in closed form.

The plane as a holonomic row of a point in space; and a blade that is pushed sideways at a known speed, so that the
non-holonomic row has a rate b(t, q).
"""

import numpy as np

from tests.general.mechanism import G, Mechanism, known, of_functions, of_problem
from tests.mechanisms.motions import spatial
from tests.problems import functions_of
from twoloop import mechanisms
from twoloop.mechanisms.knife_edge import INERTIA, SLOPE, SPIN
from twoloop.mechanisms.knife_edge import MASS as M

PUSH = 0.6  # amplitude of the sideways speed, m/s
END = 2.0
PROBLEM = mechanisms.knife_edge()
EDGE = PROBLEM.system
FUNCTIONS = {"n_q": 3, "n_c": 0, "n_a": 1, "name": "knife edge", **functions_of(EDGE)}
state = PROBLEM.motion


def knife_edge():
    """No holonomic row at all."""
    return of_problem(PROBLEM, known(spatial.knife_edge(), END), END)


def knife_edge_in_space():
    """X, Y, Z, phi: Y and the plane's slope along X; the plane is a holonomic row."""
    tangent, cosine = np.tan(SLOPE), np.cos(SLOPE)

    def lifted(t):
        q, v = state(t)
        lift = np.array([[cosine, 0.0, 0.0], [0.0, 1.0, 0.0], [-np.sin(SLOPE), 0.0, 0.0], [0.0, 0.0, 1.0]])
        return lift @ q, lift @ v

    return Mechanism(
        name="knife edge in space",
        system=of_functions(
            n_q=4,
            n_c=1,
            n_a=1,
            mass=np.diag([M, M, M, INERTIA]),
            force=lambda t, q, v: np.array([0.0, 0.0, -M * G, 0.0]),
            constraint=lambda t, q: np.array([q[2] + tangent * q[0]]),
            jacobian=lambda t, q: np.array([[tangent, 0.0, 1.0, 0.0]]),
            gamma=lambda t, q, v: np.zeros(1),
            nonholonomic=lambda t, q: np.array([[np.sin(q[3]) / cosine, -np.cos(q[3]), 0.0, 0.0]]),
            nonholonomic_gamma=lambda t, q, v: np.array([-v[3] * (v[0] * np.cos(q[3]) / cosine + v[1] * np.sin(q[3]))]),
        ),
        end=END,
        state=lifted,
        rank=2,
        energy=lambda q, v: 0.5 * v @ (np.array([M, M, M, INERTIA]) * v) + M * G * q[2],
    )


def pushed_knife_edge():
    """The blade slides to its right at PUSH sin(2 SPIN t): A v + b = 0 with b = -PUSH sin(2 SPIN t).

    Along the blade u' = PULL cos(phi) - SPIN w, across it w is given; both integrate in closed form.
    """

    def pushed(t):
        s, c = np.sin(SPIN * t), np.cos(SPIN * t)
        q, v = state(t)
        along, across = -PUSH * s * s, 2.0 * PUSH * s * c
        q = q + PUSH / SPIN * np.array([s**3 / 3.0, c + c**3 / 3.0 - 4.0 / 3.0, 0.0])
        return q, v + np.array([along * c + across * s, along * s - across * c, 0.0])

    return Mechanism(
        name="pushed knife edge",
        system=of_functions(
            **FUNCTIONS
            | {
                "nonholonomic_rate": lambda t, q: np.array([-PUSH * np.sin(2.0 * SPIN * t)]),
                "nonholonomic_gamma": lambda t, q, v: (
                    EDGE.nonholonomic_gamma(t, q, v) + 2.0 * PUSH * SPIN * np.cos(2.0 * SPIN * t)
                ),
            }
        ),
        end=END,
        state=pushed,
        rank=1,
    )
