"""The motion of a mechanism of `sharp_mechanisms` by SciPy, and runs judged by it.

It is integrated from one instant at which the force is known to break to the next, in steps that cannot pass over it; a
second, unlike method says how good it is, disturbed starts how much errors grow.
"""

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.integrate import solve_ivp

from studies.bench.apart import heard
from studies.bench.sharp_forces import DRIVE_A, T_END, families
from studies.bench.sharp_mechanisms import Mechanism, drawn
from studies.bench.store import Array, Row
from twoloop import Result, solve_dae

TIMES = np.linspace(0.0, T_END, 13)  # s, at which positions are compared
RTOL, CHECK, DISTURBED = 1e-13, 1e-12, 1e-9  # of the motion, of the one to compare it with, and of disturbed ones
LONGEST, LONGEST_IN_X = 0.02, 2e-3  # s, steps; where the force is sharp in x
PARTS = 40  # steps of a window, at least
NUDGE = 1e-6  # of a state, to see how errors grow
FROM = (0, 4, 8)  # places in TIMES at which it is disturbed
LOOSENESS = 1e3  # an answer is right within so many tolerances, times the growth of errors ...
JUMPS = 10  # ... and once more for as many jumps ...
LEAST = 3e-12  # ... a tolerance below which no more is asked
CHAOTIC = 1e3  # growth beyond which a motion is not used
RIGHT, SAID, SILENT = "right", "reported failure", "silently wrong"


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
        y, at = part.y[:, -1], end
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


def drawn_from(family: str, g: np.random.Generator, n_drawn: int = 1) -> Mechanism:
    """A random mechanism under a random force of a family, the last of so many draws."""
    for _ in range(n_drawn):
        mechanism = drawn(families()[family](g), g)
    return mechanism


def case(family: str, seed: list[int]) -> tuple[Mechanism, Motion, int]:
    """The same with its motion, and how often it was drawn until that was known well enough."""
    g, n_drawn = np.random.default_rng(seed), 0
    while True:
        mechanism, n_drawn = drawn_from(family, g), n_drawn + 1
        known = motion(mechanism)
        if known.growth <= CHAOTIC and known.apart <= 0.1 * allowed(known, 0.0):
            return mechanism, known, n_drawn


def allowed(known: Motion, tolerance: float, n_jumps: int = 0) -> float:
    """Error up to which an answer is right."""
    return LOOSENESS * (1.0 + n_jumps / JUMPS) * max(tolerance, LEAST) * known.growth


def judged(mechanism: Mechanism, known: Motion, method: str, tolerance: float, time_limit: float, **more: Any) -> Row:
    """A run and its outcome."""
    limit = allowed(known, tolerance, len(mechanism.sharp.breaks))
    options: dict[str, Any] = {"rtol": tolerance, "atol": tolerance, "time_limit": time_limit, "t_eval": TIMES, **more}
    start = mechanism.system, (0.0, T_END), mechanism.q0, mechanism.v0
    return graded(lambda: solve_dae(*start, method, **options), lambda result: off(result.q.T, known.q), limit)


def graded(call: Callable[[], Result], error: Callable[[Result], float], allowed: float) -> Row:
    """A call and its outcome, by the error of its result and that which is allowed."""
    result, row = heard(call)
    row |= {"error": None, "allowed": allowed, "n_evaluations": None}
    if result is None or not result.success:
        return row | {"outcome": SAID}
    row |= {"error": error(result), "n_evaluations": result.stats.n_evaluations}
    return row | {"outcome": RIGHT if row["error"] <= allowed else SAID if row["warned"] else SILENT}
