"""What is timed beside the calls of solvers, so that their times on several machines can be laid side by side.

It is a fixed number of steps of the classical Runge-Kutta method on a pendulum with its multiplier, in numpy: the small
arrays and calls from Python of which most of the time of a solver in Python goes, which any environment can do, always
the same operations, of no version of a solver. Machine code scales otherwise from processor to processor, and Python's
versions differ in speed: rows name both.
"""

import time

import numpy as np
from numpy.typing import NDArray

CALIBRATION = "rk4-pendulum-1"  # another name whenever a line below changes
STEPS = 200
REPEATS = 3  # of which the fastest counts


def _rate(state: NDArray[np.float64]) -> NDArray[np.float64]:
    q, v = state[:2], state[2:]
    matrix = np.array([[1.0, 0.0, q[0]], [0.0, 1.0, q[1]], [q[0], q[1], 0.0]])
    return np.concatenate([v, np.linalg.solve(matrix, np.array([0.0, -9.81, -(v @ v)]))[:2]])


def calibration_s() -> float:
    """CPU time of the calibration, s: of three in a row the least."""
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
