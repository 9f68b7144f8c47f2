"""A disc that rolls on a horizontal plane without slipping: a holonomic row and non-holonomic ones.

Coordinates: x, y, z of the centre, yaw, lean from the vertical, spin. The contact point is at rest, which is three
rows, of which the vertical one is the derivative of the holonomic row: redundant, and left out where `redundant` is
False.
"""

import numpy as np

from tests.general.mechanism import G, Mechanism, known, of_functions
from tests.mechanisms.motions import spatial
from tests.problems import functions_of
from twoloop.mechanisms.rolling_disc import ACROSS, AXIAL, energy, rolling_disc
from twoloop.mechanisms.rolling_disc import MASS as M
from twoloop.mechanisms.rolling_disc import RADIUS as R

SYSTEM = rolling_disc().system


def _disc(name, end, state, redundant):
    def nonholonomic(t, q):  # the contact point does not move along z either
        return np.vstack([SYSTEM.nonholonomic(t, q), [0.0, 0.0, 1.0, 0.0, R * np.sin(q[4]), 0.0]])

    def nonholonomic_gamma(t, q, v):
        return np.append(SYSTEM.nonholonomic_gamma(t, q, v), -R * np.cos(q[4]) * v[4] ** 2)

    more = {"n_q": 6, "n_c": 1, "n_a": 3, "nonholonomic": nonholonomic, "nonholonomic_gamma": nonholonomic_gamma}
    return Mechanism(
        name=f"{name}{', redundant' if redundant else ''}",
        system=of_functions(**functions_of(SYSTEM) | more) if redundant else lambda: SYSTEM,
        end=end,
        state=state,
        rank=3,
        energy=lambda q, v: energy(0.0, q, v),
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


# --- general motion
END = 2.0


def wobbling_disc(redundant=False):
    return _disc("wobbling disc", END, known(spatial.rolling_disc(), END), redundant)
