"""A planar slider-crank in absolute coordinates, with a redundant row; free, and driven at a prescribed crank angle.

Bodies x, y, angle of crank, rod and slider. The redundant row says once more, and not linearly, that the crank pin is
as far from the slider as the rod is long.
"""

import numpy as np

from tests.general.mechanism import Mechanism, known, of_functions, of_problem
from tests.mechanisms.motions import planar
from tests.problems import functions_of
from twoloop import mechanisms

CRANK, ROD = 0.5, 1.2

# --- the motion, from the triangle


def kinematics(angle):
    """All coordinates and their first two derivatives by the crank angle."""
    pin = CRANK * np.exp(1j * angle)
    tilt = -np.arcsin(pin.imag / ROD)
    slope = -pin.real / (ROD * np.cos(tilt))
    bend = (pin.imag / ROD + np.sin(tilt) * slope**2) / np.cos(tilt)
    half = 0.5 * ROD * np.exp(1j * tilt)
    half_u, half_w = 1j * slope * half, (1j * bend - slope**2) * half

    def body(z, turn):
        return [z.real, z.imag, turn]

    q = body(0.5 * pin, angle) + body(pin + half, tilt) + body(pin + 2.0 * half, 0.0)
    u = body(0.5j * pin, 1.0) + body(1j * pin + half_u, slope) + body(1j * pin + 2.0 * half_u, 0.0)
    w = body(-0.5 * pin, 0.0) + body(-pin + half_w, bend) + body(-pin + 2.0 * half_w, 0.0)
    return np.array(q), np.array(u), np.array(w)


def redundant_slider_crank():
    """The ready mechanism."""
    return of_problem(mechanisms.redundant_slider_crank(), known(planar.slider_crank(), 2.0), 2.0, rank=8)


def drive(t):
    """Angle of the driven crank and its first two derivatives."""
    return 0.5 + 4.0 * t + 0.3 * np.sin(3.0 * t), 4.0 + 0.9 * np.cos(3.0 * t), -2.7 * np.sin(3.0 * t)


def driven_slider_crank(redundant):
    """No freedom is left: the motion is the drive's. With redundant=True there are ten rows for nine coordinates."""

    def state(t):
        angle, rate, _ = drive(t)
        q, u, _ = kinematics(angle)
        return q, u * rate

    if not redundant:
        return of_problem(mechanisms.driven_slider_crank(), state, 2.0)
    free = mechanisms.redundant_slider_crank().system
    rows = {
        "constraint": lambda t, q: np.append(free.constraint(t, q), q[2] - drive(t)[0]),
        "jacobian": lambda t, q: np.vstack([free.jacobian(t, q), np.eye(9)[2]]),
        "constraint_rate": lambda t, q: np.append(np.zeros(9), -drive(t)[1]),
        "gamma": lambda t, q, v: np.append(free.gamma(t, q, v), drive(t)[2]),
    }
    return Mechanism(
        name="driven slider-crank, redundant",
        system=of_functions(n_q=9, n_c=10, **functions_of(free) | rows),
        end=2.0,
        state=state,
        rank=9,
    )
