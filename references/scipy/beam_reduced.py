"""The beam on its moving base without constraints: the base's two coordinates put in, the others by SciPy's DOP853.

It shares the force and the mass of the beam with `twoloop`, and nothing else: no constraints, no multipliers, no
partition, and another integrator.
"""

import math

import numpy as np
from numba import njit
from numpy.typing import ArrayLike
from scipy.integrate import solve_ivp

from references.driver import check_problem
from twoloop.checks.arguments import check_positive, check_times
from twoloop.mechanisms import Problem
from twoloop.problem.problem import Array


def reduced_motion(problem: Problem, t_eval: ArrayLike, tol: float) -> tuple[Array, Array]:
    """Coordinates and velocities of an `ancf_beam`, integrated without its constraints.

    Parameters
    ----------
    problem : Problem
        From `twoloop.mechanisms.ancf_beam`.
    t_eval : array_like (n_t,)
        Increasing times, s, from 0 on; steps are not shortened to land on them.
    tol : float
        rtol = atol, for coordinates and velocities.

    Returns
    -------
    q, v : ndarray (n_q, n_t)

    Raises TypeError or ValueError if an argument is wrong. Raises RuntimeError if DOP853 fails or cannot start: an
    incomplete reference is of no use.
    """
    check_problem(problem, "angular_frequency", "a beam of ancf_beam, on a moving base")
    check_positive("tol", tol)
    times = check_times(t_eval, 0.0, float(np.max(t_eval, initial=0.0)), None)
    amplitude, frequency = (float(problem.parameters[name]) for name in ("amplitude", "angular_frequency"))
    system, n = problem.system, problem.system.n_q
    force, p, M = system.functions.force, system.functions.p, system.mass(0.0, problem.q0)
    fixed = np.linalg.inv(M[2:, 2:]), M[2:, 0].copy(), amplitude, frequency

    def rate(t: float, y: Array) -> Array:
        return _rate(t, y, force, p, fixed)  # type: ignore[no-any-return]

    y0, run = np.concatenate([problem.q0[2:], problem.v0[2:]]), f"DOP853 with rtol = atol = {tol:g} on {problem.name}"
    if not np.isfinite(rate(0.0, y0)).all():  # SciPy's first step would be NaN, and tried without end
        raise RuntimeError(f"{run} cannot start: the accelerations are not finite")
    solution = solve_ivp(rate, (0.0, times[-1]), y0, "DOP853", times, rtol=tol, atol=tol)
    if not solution.success:
        raise RuntimeError(f"{run} failed: {solution.message}")
    phase, zero = frequency * times, np.zeros_like(times)
    q = np.vstack([amplitude * np.sin(phase), zero, solution.y[: n - 2]])
    return q, np.vstack([amplitude * frequency * np.cos(phase), zero, solution.y[n - 2 :]])


@njit
def _rate(t, y, force, p, fixed):  # type: ignore[no-untyped-def]
    """y' of y = [q, v] without the base's coordinates."""
    inverse, coupling, amplitude, frequency = fixed
    n = coupling.size + 2
    q, v, Q = np.zeros(n), np.zeros(n), np.zeros(n)
    q[0], q[2:] = amplitude * math.sin(frequency * t), y[: n - 2]
    force(t, q, v, p, Q)
    out = np.empty_like(y)
    out[: n - 2] = y[n - 2 :]
    out[n - 2 :] = inverse @ (Q[2:] + coupling * amplitude * frequency**2 * math.sin(frequency * t))
    return out
