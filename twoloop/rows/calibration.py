"""A calibration timed along with solver calls, which makes times on different machines comparable.

It is a fixed number of steps of the classical Runge-Kutta method on a pendulum with its multiplier, in numpy. Like a
solver in Python, it spends its time in calls and small arrays; it runs in any environment and does not depend on the
version of a solver. Machine code scales differently between processors, and versions of Python differ in speed: rows
contain both.
"""

import time

import numpy as np
from numpy.typing import NDArray

CALIBRATION = "rk4-pendulum-1"  # rename whenever the code below changes
STEPS = 200
REPEATS = 3  # the fastest counts


def _rate(state: NDArray[np.float64]) -> NDArray[np.float64]:
    q, v = state[:2], state[2:]
    matrix = np.array([[1.0, 0.0, q[0]], [0.0, 1.0, q[1]], [q[0], q[1], 0.0]])
    return np.concatenate([v, np.linalg.solve(matrix, np.array([0.0, -9.81, -(v @ v)]))[:2]])


def calibration_s() -> float:
    """Return the CPU time of the calibration, s: the minimum of three repetitions."""
    times = []
    for _ in range(REPEATS):
        state, h, began = np.array([1.0, 0.0, 0.0, 0.0]), 0.01, time.process_time()
        for _ in range(STEPS):
            first = _rate(state)
            second = _rate(state + 0.5 * h * first)
            third = _rate(state + 0.5 * h * second)
            state = state + h / 6.0 * (first + 2.0 * (second + third) + _rate(state + h * third))
        times.append(time.process_time() - began)
    return min(times)
