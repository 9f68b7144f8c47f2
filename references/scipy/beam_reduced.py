"""The beam on its moving base without constraints: the motion of the base is substituted, the rest solved by DOP853.

Only the forces and the mass of the beam are shared with `twoloop`; the integrator is a different one.
"""

import math
from collections.abc import Callable
from functools import lru_cache

import numpy as np
from numba.core.dispatcher import Dispatcher
from numpy.typing import ArrayLike
from scipy.integrate import solve_ivp

from references.equations.accelerations import cached
from twoloop.checks.arguments import check_times
from twoloop.mechanisms import Problem
from twoloop.problem.problem import Array


def reduced_motion(problem: Problem, t_eval: ArrayLike, tol: float) -> tuple[Array, Array]:
    """Return coordinates and velocities (n_q, n_t) of an `ancf_beam`, integrated without its constraints.

    `t_eval` are increasing times from 0, s, with output by interpolation; `tol` is rtol = atol. Raises RuntimeError if
    DOP853 fails or cannot start.
    """
    times = check_times(t_eval, 0.0, float(np.max(t_eval, initial=0.0)), None)
    amplitude, frequency = (float(problem.parameters[name]) for name in ("amplitude", "angular_frequency"))
    system, n = problem.system, problem.system.n_q
    compiled_rate, p, M = _rate_of(system.functions.force), system.functions.p, system.mass(0.0, problem.q0)
    fixed = np.linalg.inv(M[2:, 2:]), M[2:, 0].copy(), amplitude, frequency

    def rate(t: float, y: Array) -> Array:
        return compiled_rate(t, y, p, fixed)

    y0, run = np.concatenate([problem.q0[2:], problem.v0[2:]]), f"DOP853 with rtol = atol = {tol:g} on {problem.name}"
    if not np.isfinite(rate(0.0, y0)).all():  # SciPy would try a first step of NaN forever
        raise RuntimeError(f"{run} cannot start: the accelerations are not finite")
    solution = solve_ivp(rate, (0.0, times[-1]), y0, "DOP853", times, rtol=tol, atol=tol)
    if not solution.success:
        raise RuntimeError(f"{run} failed: {solution.message}")
    phase, zero = frequency * times, np.zeros_like(times)
    q = np.vstack([amplitude * np.sin(phase), zero, solution.y[: n - 2]])
    return q, np.vstack([amplitude * frequency * np.cos(phase), zero, solution.y[n - 2 :]])


@lru_cache(maxsize=8)
def _rate_of(force: Dispatcher) -> Callable[..., Array]:
    """Return (t, y, p, fixed) -> y' of y = [q, v] without the coordinates of the base."""

    @cached
    def rate(t, y, p, fixed):  # type: ignore[no-untyped-def]
        inverse, coupling, amplitude, frequency = fixed
        n = coupling.size + 2
        q, v, Q = np.zeros(n), np.zeros(n), np.zeros(n)
        q[0] = amplitude * math.sin(frequency * t)
        for k in range(2, n):
            q[k] = y[k - 2]
        force(t, q, v, p, Q)
        a = inverse @ (Q[2:] + coupling * amplitude * frequency**2 * math.sin(frequency * t))
        out = np.empty_like(y)
        for k in range(n - 2):  # numba compiles `out[: n - 2] = ...` two seconds longer
            out[k], out[n - 2 + k] = y[n - 2 + k], a[k]
        return out

    return rate  # type: ignore[no-any-return]
