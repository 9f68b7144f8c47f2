"""The beam on its moving base without constraints: the base's two coordinates put in, the others by SciPy.

It shares the force and the mass of the beam with `twoloop`, and nothing else: no constraints, no multipliers, no
partition, and other integrators.
"""

import math
from functools import partial

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray
from scipy.integrate import solve_ivp

from references.driver import OutOfTimeError, TimeLimit, check_choice, check_problem, check_time_limit
from twoloop.checks.arguments import check_positive, check_real, check_times
from twoloop.mechanisms import Problem

Array = NDArray[np.float64]

SOLVERS = ("DOP853", "RK45", "LSODA")


def reduced_motion(
    problem: Problem, t_eval: ArrayLike, tol: float, solver: str = "DOP853", *, time_limit: float | None = None
) -> tuple[Array, Array]:
    """Coordinates and velocities of an `ancf_beam`, integrated without its constraints.

    Parameters
    ----------
    problem : Problem
        From `twoloop.mechanisms.ancf_beam`.
    t_eval : array_like (n_t,)
        Increasing times, s, from 0 on; steps are not shortened to land on them.
    tol : float
        rtol = atol of SciPy's solver, for coordinates and velocities.
    solver : {"DOP853", "RK45", "LSODA"}
        One of `scipy.integrate.solve_ivp`.
    time_limit : float, optional
        Wall-clock time that the integration may take, s. None: no limit.

    Returns
    -------
    q, v : ndarray (n_q, n_t)

    Raises
    ------
    TypeError, ValueError
        If an argument is wrong.
    RuntimeError
        If SciPy's solver fails, cannot start, or is past the time limit: an incomplete reference is of no use.
    """
    check_problem(problem, "angular_frequency", "a beam of ancf_beam, on a moving base")
    check_positive("tol", tol)
    check_choice("solver", solver, SOLVERS)
    check_time_limit(time_limit)
    times = check_real("t_eval", t_eval)
    if times.ndim != 1 or times.size == 0:
        raise ValueError(f"t_eval must be a list of times; given {t_eval!r}")
    check_times(times, 0.0, float(times[-1]), None)
    amplitude, frequency = (float(problem.parameters[name]) for name in ("amplitude", "angular_frequency"))
    system, n = problem.system, problem.system.n_q
    y0 = np.concatenate([problem.q0[2:], problem.v0[2:]])
    M = system.mass(0.0, problem.q0)
    fixed = (np.linalg.inv(M[2:, 2:]), M[2:, 0].copy(), amplitude, frequency)
    compiled = partial(_rate, force=system.functions.force, p=system.functions.p, fixed=fixed)
    run = f"{solver} with rtol = atol = {tol:g} on {problem.name}"
    if not np.isfinite(compiled(0.0, y0)).all():  # SciPy's first step would be NaN, and tried without end
        raise RuntimeError(f"{run} cannot start: the accelerations are not finite")
    limit, reached = TimeLimit(time_limit), 0.0

    def rate(t: float, y: Array) -> Array:
        nonlocal reached
        limit.check()
        reached = t
        return compiled(t, y)  # type: ignore[no-any-return]

    try:
        solution = solve_ivp(rate, (0.0, times[-1]), y0, solver, times, rtol=tol, atol=tol)
    except OutOfTimeError:
        raise RuntimeError(limit.message(run, reached, "take a larger tol")) from None
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
