"""A pendulum under forces that are sharp in time or in velocity, and its motion by an independent route."""

from collections.abc import Callable
from functools import cache

import numpy as np
from scipy.integrate import solve_ivp

from tests import problems
from twoloop import ConstrainedSystem

T_END = 3.0
START = (0.9, 0.4)  # angle from below, rad, and its rate
AT_REST = (0.0, 0.0)


def gust(width, at=1.5, size=20.0):
    def force(t, q, v):
        return np.array([size * np.exp(-(((t - at) / width) ** 2)), -9.81])

    return force


def drag(t, q, v):
    speed = np.sqrt(v[0] * v[0] + v[1] * v[1])
    return np.array([-0.6 * speed * v[0], -9.81 - 0.6 * speed * v[1]])


def brake(width):
    def force(t, q, v):
        along = -3.0 * np.tanh((q[0] * v[1] - q[1] * v[0]) / width)
        return np.array([-along * q[1], -9.81 + along * q[0]])

    return force


def stop(t, q, v):
    depth = 1000.0 * (q[0] - 0.5)  # softplus, of a stop at x = 0.5
    return np.array([-8.0 * np.log(1.0 + np.exp(depth)) / 10.0, -9.81])


def switching(t, q, v):
    return np.array([4.0 * np.tanh(50.0 * np.sin(20.0 * t)), -9.81])


def pendulum(force: Callable) -> ConstrainedSystem:
    return problems.pendulum(compile=True, constant_mass=True, force=force)


def position(angle: float) -> np.ndarray:
    return np.array([np.sin(angle), -np.cos(angle)])


def start_of(state: tuple[float, float]) -> tuple[np.ndarray, np.ndarray]:
    angle, rate = state
    return position(angle), rate * np.array([np.cos(angle), np.sin(angle)])


@cache
def reference(force: Callable, state: tuple[float, float], t_end: float = T_END) -> np.ndarray:
    """The end position from the equation of the angle alone, by SciPy with steps too short to pass over anything."""

    def rates(t, y):
        q, along = position(y[0]), np.array([np.cos(y[0]), np.sin(y[0])])
        return [y[1], along @ force(t, q, y[1] * along)]

    run = solve_ivp(rates, (0.0, t_end), state, method="DOP853", rtol=1e-12, atol=1e-12, max_step=t_end / 600.0)
    return position(run.y[0, -1])
