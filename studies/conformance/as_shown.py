"""Solvers of other projects, called as their own documentation shows, on equations in plain numpy."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from references.driver import imported
from twoloop.testing.known_problem import Array, KnownProblem

States = tuple[Array, ...]


class NoModel(Exception):
    """Raised where a solver has no model of a problem: nothing is said of it."""


def _rate(problem: KnownProblem, t: float, y: Array) -> Array:
    """y' of the equations at index 1."""
    q, v = np.split(y, 2)
    return np.concatenate([v, problem.acceleration(t, q, v)[0]])


def _start(problem: KnownProblem) -> Array:
    return np.concatenate([problem.q0, problem.v0])


def _residual(problem: KnownProblem, t: float, y: Array, yp: Array) -> Array:
    """F(t, y, y') of the stabilised equations of index 2, y = [q, v, integrals of mu and of lam].

    C. W. Gear, B. Leimkuhler, G. K. Gupta, J. Comput. Appl. Math. 12-13 (1985) 77-90.
    """
    n, m = problem.n_q, problem.n_c
    q, v, J = y[:n], y[n : 2 * n], problem.jacobian(t, y[:n])
    qp, vp, mu, lam = np.split(yp, [n, 2 * n, 2 * n + m])
    moves = problem.mass(t, q) @ vp - problem.force(t, q, v) + J.T @ lam
    return np.concatenate([qp - v + J.T @ mu, moves, problem.constraint(t, q), J @ v + problem.constraint_rate(t, q)])


def _consistent(problem: KnownProblem) -> tuple[Array, Array]:
    """y and y' at the start."""
    a, lam = problem.acceleration(problem.t_span[0], problem.q0, problem.v0)
    none = np.zeros(problem.n_c)
    return np.concatenate([problem.q0, problem.v0, none, none]), np.concatenate([problem.v0, a, none, lam])


def extensisq_pr9(problem: KnownProblem, times: Array, tolerance: float) -> States:
    """Pr9 of extensisq in SciPy's solve_ivp, at index 1."""
    from scipy.integrate import solve_ivp

    method = imported("extensisq").Pr9
    options = {"method": method, "t_eval": times, "rtol": tolerance, "atol": tolerance}
    found = solve_ivp(lambda t, y: _rate(problem, t, y), (times[0], times[-1]), _start(problem), **options)
    if not found.success:
        raise RuntimeError(found.message)
    return tuple(part.T for part in np.split(found.y, 2))


def solve_dae_radau(problem: KnownProblem, times: Array, tolerance: float) -> States:
    """Radau of solve_dae on the stabilised equations."""
    solve, (y0, yp0) = imported("solve_dae.integrate").solve_dae, _consistent(problem)
    options = {"method": "Radau", "t_eval": times, "rtol": tolerance, "atol": tolerance}
    found = solve(lambda t, y, yp: _residual(problem, t, y, yp), (times[0], times[-1]), y0, yp0, **options)
    if not found.success:
        raise RuntimeError(found.message)
    n, m = problem.n_q, problem.n_c
    return found.y[:n].T, found.y[n : 2 * n].T, found.yp[2 * n + m :].T


def sundae_ida(problem: KnownProblem, times: Array, tolerance: float) -> States:
    """IDA of scikit-sundae at index 1, with the multipliers as its algebraic variables."""
    n, m = problem.n_q, problem.n_c
    a, lam = problem.acceleration(times[0], problem.q0, problem.v0)
    y0, yp0 = np.concatenate([_start(problem), lam]), np.concatenate([problem.v0, a, np.zeros(m)])

    def residual(t: float, y: Array, yp: Array, found: NDArray[np.float64]) -> None:
        q, v, J = y[:n], y[n : 2 * n], problem.jacobian(t, y[:n])
        found[:n] = yp[:n] - v
        found[n : 2 * n] = problem.mass(t, q) @ yp[n : 2 * n] + J.T @ y[2 * n :] - problem.force(t, q, v)
        found[2 * n :] = J @ yp[n : 2 * n] - problem.gamma(t, q, v)

    options = {"algebraic_idx": list(range(2 * n, 2 * n + m)), "max_num_steps": 100_000}
    found = imported("sksundae.ida").IDA(residual, rtol=tolerance, atol=tolerance, **options).solve(times, y0, yp0)
    if not found.success:
        raise RuntimeError(found.message)
    return tuple(np.split(found.y, [n, 2 * n], axis=1))


def sundae_cvode(problem: KnownProblem, times: Array, tolerance: float) -> States:
    """CVODE, Adams, of scikit-sundae at index 1."""

    def rate(t: float, y: Array, yp: NDArray[np.float64]) -> None:
        yp[:] = _rate(problem, t, y)

    options = {"method": "Adams", "rtol": tolerance, "atol": tolerance, "max_num_steps": 100_000}
    found = imported("sksundae.cvode").CVODE(rate, **options).solve(times, _start(problem))
    if not found.success:
        raise RuntimeError(found.message)
    return tuple(np.split(found.y, 2, axis=1))


def sympy_lagrange(problem: KnownProblem, times: Array, tolerance: float) -> States:
    """Point masses on rods by SymPy's LagrangesMethod, its mass matrix and forcing in SciPy's solve_ivp."""
    from scipy.integrate import solve_ivp

    full = _lagrange(problem)
    n = problem.n_q

    def rate(t: float, y: Array) -> Array:
        matrix, forcing = full(*y)
        return np.asarray(np.linalg.solve(matrix, np.ravel(forcing)), np.float64)[
            : 2 * n
        ]  # rates of q and v, then multipliers

    options = {"method": "DOP853", "t_eval": times, "rtol": tolerance, "atol": tolerance}
    found = solve_ivp(rate, (times[0], times[-1]), _start(problem), **options)
    if not found.success:
        raise RuntimeError(found.message)
    return tuple(part.T for part in np.split(found.y, 2))


def _lagrange(problem: KnownProblem) -> Callable[..., tuple[Array, Array]]:
    """SymPy's equations of a chain of points from the origin, as a function of q and v.

    Raises
    ------
    NoModel
        If the problem is another.
    """
    sympy, mechanics = imported("sympy", extra="symbolic"), imported("sympy.physics.mechanics", extra="symbolic")
    upright = np.allclose(problem.force(0.0, problem.q0, problem.v0)[::2], 0.0)
    if problem.name not in ("pendulum", "double_pendulum") or not upright:
        raise NoModel("its model is of points on rods from the origin, y upwards")
    masses = np.diag(problem.mass(0.0, problem.q0))[::2]
    t, g = mechanics.dynamicsymbols._t, -problem.force(0.0, problem.q0, problem.v0)[1] / masses[0]
    q = mechanics.dynamicsymbols(f"q:{problem.n_q}")
    points, placed = list(zip(q[::2], q[1::2], strict=True)), np.reshape(problem.q0, (-1, 2))
    kinetic = sum(m * (x.diff(t) ** 2 + y.diff(t) ** 2) / 2 for m, (x, y) in zip(masses, points, strict=True))
    potential = sum(m * g * y for m, (_, y) in zip(masses, points, strict=True))
    before = [(0, 0), *points[:-1]]
    squares = (np.diff(placed, axis=0, prepend=0.0) ** 2).sum(axis=1)
    rods = [(x - a) ** 2 + (y - b) ** 2 - s for (x, y), (a, b), s in zip(points, before, squares, strict=True)]
    method = mechanics.LagrangesMethod(kinetic - potential, q, hol_coneqs=rods)
    method.form_lagranges_equations()
    plain = sympy.symbols(f"p:{2 * problem.n_q}")
    names = dict(zip([*(each.diff(t) for each in q), *q], [*plain[problem.n_q :], *plain[: problem.n_q]], strict=True))
    return sympy.lambdify(
        plain,
        [  # type: ignore[no-any-return]
            part.subs(names) for part in (method.mass_matrix_full, method.forcing_full)
        ],
    )


AS_SHOWN = {  # name: solver, package
    "Pr9, extensisq": (extensisq_pr9, "extensisq"),
    "Radau, solve_dae, stabilised": (solve_dae_radau, "solve-dae"),
    "IDA, scikit-sundae": (sundae_ida, "scikit-sundae"),
    "CVODE, scikit-sundae": (sundae_cvode, "scikit-sundae"),
    "LagrangesMethod, SymPy": (sympy_lagrange, "sympy"),
}
