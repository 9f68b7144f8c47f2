"""SymPy's equations of point masses on rods, integrated by SciPy's solve_ivp."""

from collections.abc import Callable

import numpy as np

from references.as_shown import NoModel, start_of
from references.driver import imported
from twoloop.testing.problem import Array, KnownProblem

NAME, PACKAGE, DRIFTS = "LagrangesMethod, SymPy", "sympy", True


def simulate(problem: KnownProblem, times: Array, tolerance: float) -> tuple[Array, ...]:
    """Integrate SymPy's LagrangesMethod for point masses on rods, its mass matrix and forcing, by SciPy's solve_ivp."""
    from scipy.integrate import solve_ivp

    equations = _lagrange(problem)
    n = problem.n_q

    def rate(t: float, y: Array) -> Array:
        matrix, forcing = equations(*y)
        rates = np.linalg.solve(matrix, np.ravel(forcing))  # rates of q and v, then multipliers
        return np.asarray(rates[: 2 * n], np.float64)

    options = {"method": "DOP853", "t_eval": times, "rtol": tolerance, "atol": tolerance}
    solution = solve_ivp(rate, (times[0], times[-1]), start_of(problem), **options)
    if not solution.success:
        raise RuntimeError(solution.message)
    return tuple(part.T for part in np.split(solution.y, 2))


def _lagrange(problem: KnownProblem) -> Callable[..., tuple[Array, Array]]:
    """Return SymPy's equations of a chain of points from the origin, as a function of q and v.

    Raises NoModel for other problems.
    """
    sympy, mechanics = imported("sympy", extra="symbolic"), imported("sympy.physics.mechanics", extra="symbolic")
    upright = np.allclose(problem.force(0.0, problem.q0, problem.v0)[::2], 0.0)
    if problem.name not in ("pendulum", "double_pendulum") or not upright:
        raise NoModel("its model is of points on rods from the origin, y upwards")
    masses = np.diag(problem.mass(0.0, problem.q0))[::2]
    t, g = mechanics.dynamicsymbols._t, -problem.force(0.0, problem.q0, problem.v0)[1] / masses[0]
    q = mechanics.dynamicsymbols(f"q:{problem.n_q}")
    points, positions = list(zip(q[::2], q[1::2], strict=True)), np.reshape(problem.q0, (-1, 2))
    kinetic = sum(m * (x.diff(t) ** 2 + y.diff(t) ** 2) / 2 for m, (x, y) in zip(masses, points, strict=True))
    potential = sum(m * g * y for m, (_, y) in zip(masses, points, strict=True))
    previous = [(0, 0), *points[:-1]]
    squares = (np.diff(positions, axis=0, prepend=0.0) ** 2).sum(axis=1)
    rods = [(x - a) ** 2 + (y - b) ** 2 - s for (x, y), (a, b), s in zip(points, previous, squares, strict=True)]
    method = mechanics.LagrangesMethod(kinetic - potential, q, hol_coneqs=rods)
    method.form_lagranges_equations()
    plain = sympy.symbols(f"p:{2 * problem.n_q}")
    names = dict(zip([*q, *(x.diff(t) for x in q)], plain, strict=True))
    parts = [part.subs(names) for part in (method.mass_matrix_full, method.forcing_full)]
    return sympy.lambdify(plain, parts)  # type: ignore[no-any-return]
