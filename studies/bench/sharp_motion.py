"""Integrate a mechanism of `sharp_mechanisms` by SciPy in independent coordinates.

It goes from one instant at which the force is known to break to the next, in steps that cannot pass over it. A second,
unlike method says how good the motion is; disturbed starts say how much errors grow.
"""

import warnings
from dataclasses import dataclass

import numpy as np
from scipy.integrate import solve_ivp

from studies.bench.sharp_forces import DRIVE_A, T_END
from studies.bench.sharp_mechanisms import Mechanism
from studies.bench.store import Array

TIMES = np.linspace(0.0, T_END, 13)  # s, at which positions are compared
RTOL, CHECK, DISTURBED = 1e-13, 1e-12, 1e-9  # of the motion, of the one to compare it with, and of disturbed ones
LONGEST, LONGEST_IN_X = 0.02, 2e-3  # s, steps; where the force is sharp in x
PARTS = 40  # steps of a window, at least
NUDGE = 1e-6  # of a state, to see how errors grow
FROM = (0, 4, 8)  # places in TIMES at which it is disturbed


@dataclass(frozen=True)
class Motion:
    """Positions at TIMES, how far two methods are apart there, and how much errors grow."""

    q: Array  # (n_times, n_q)
    apart: float
    growth: float  # at least 1: of a disturbance of any independent coordinate or rate, until the end


def march(mechanism: Mechanism, method: str, tolerance: float, y: Array, begin: float = 0.0) -> dict[float, Array]:
    """States at those of TIMES from `begin` on. Raises RuntimeError, ValueError if SciPy's method fails."""
    sharp, at = mechanism.sharp, begin
    states: dict[float, Array] = {}
    edges = {*sharp.breaks, *(edge for window in sharp.windows for edge in window)}
    for end in [*sorted(edge for edge in edges if begin < edge < T_END), T_END]:
        longest = LONGEST_IN_X if sharp.follows_x else LONGEST
        for low, high in sharp.windows:
            if low <= at + 1e-12 and end <= high + 1e-12:
                longest = min(longest, (high - low) / PARTS)
        inside = (at + 1e-13, end - 1e-13)  # the side of a break that is meant

        def rate(t: float, y: Array, inside: tuple[float, float] = inside) -> Array:
            return mechanism.rate(min(max(t, inside[0]), inside[1]), y)

        times = sorted({end, *(t for t in TIMES.tolist() if at <= t <= end)})
        part = solve_ivp(rate, (at, end), y, method, times, rtol=tolerance, atol=tolerance, max_step=longest)
        if not part.success:
            raise RuntimeError(part.message)
        states |= dict(zip(part.t.tolist(), part.y.T, strict=True))
        y, at = part.y[:, -1].copy(), end
        if sharp.driven and end in sharp.breaks:
            y = mechanism.kicked(y, float(sharp.parameters[DRIVE_A]))
    return states


def positions(mechanism: Mechanism, states: dict[float, Array]) -> Array:
    """q at those of TIMES that are known."""
    return np.array([mechanism.positions(t, states[t]) for t in TIMES.tolist() if t in states])


def off(q: Array, known: Array) -> float:
    """The largest difference of coordinates, of those that are known."""
    return float(np.nanmax(np.abs(q - known)))


def motion(mechanism: Mechanism) -> Motion:
    """The motion, how well it is known, and how much errors grow."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        states = march(mechanism, "DOP853", RTOL, mechanism.y0)
        q, growth = positions(mechanism, states), 1.0
        try:
            other = march(mechanism, "LSODA", CHECK, mechanism.y0)
        except (ValueError, RuntimeError):  # it cannot start from rest without any force
            other = march(mechanism, "RK45", 10.0 * CHECK, mechanism.y0)
        apart = off(positions(mechanism, other), q)
        directions = np.random.default_rng(0).standard_normal((len(FROM), mechanism.y0.size))
        for k, direction in zip(FROM, directions, strict=True):
            step = NUDGE * direction / np.abs(direction).max()
            base = mechanism.y0 if k == 0 else states[TIMES[k]]
            moved = positions(mechanism, march(mechanism, "DOP853", DISTURBED, base + step, TIMES[k]))
            growth = max(growth, off(moved, q[k:]) / NUDGE)
    return Motion(q, apart, growth)
