"""The beam on its moving base without constraints: the base's two coordinates put in, the others by SciPy.

It shares the force and the mass of the beam with `twoloop`, and nothing else: no constraints, no multipliers, no
partition, and integrators of other people.
"""

import math
from functools import partial

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray
from scipy.integrate import solve_ivp

from twoloop.checks import check_positive, check_times
from twoloop.mechanisms import Problem

Array = NDArray[np.float64]

SOLVERS = ("DOP853", "RK45", "LSODA")


def reduced_motion(problem: Problem, t_eval: ArrayLike, tol: float, solver: str = "DOP853") -> tuple[Array, Array]:
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

    Returns
    -------
    q, v : ndarray (n_q, n_t)

    Raises
    ------
    TypeError, ValueError
        If an argument is wrong.
    RuntimeError
        If SciPy's solver fails.
    """
    if "angular_frequency" not in problem.parameters:
        raise ValueError(f"problem must be a beam of ancf_beam, on a moving base; given {problem.name!r}")
    check_positive("tol", tol)
    if solver not in SOLVERS:
        raise ValueError(f"solver must be one of {', '.join(SOLVERS)}; given {solver!r}")
    times = np.asarray(t_eval, dtype=float)
    if times.ndim != 1 or times.size == 0:
        raise ValueError(f"t_eval must be a list of times; given {t_eval!r}")
    check_times(times, 0.0, float(times[-1]), None)
    amplitude, frequency = (float(problem.parameters[name]) for name in ("amplitude", "angular_frequency"))
    system, n = problem.system, problem.system.n_q
    y0 = np.concatenate([problem.q0[2:], problem.v0[2:]])
    M = system.mass(0.0, problem.q0)
    fixed = (np.linalg.inv(M[2:, 2:]), M[2:, 0].copy(), amplitude, frequency)
    rate = partial(_rate, force=system.functions.force, p=system.functions.p, fixed=fixed)
    solution = solve_ivp(rate, (0.0, times[-1]), y0, solver, times, rtol=tol, atol=tol)
    if not solution.success:
        raise RuntimeError(f"{solver} with rtol = atol = {tol:g} failed on {problem.name}: {solution.message}")
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
