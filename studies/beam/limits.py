"""The step limits of fixed-point iterations on the beam: in theory, in the linearised beam, and along the motion.

All steps are whole steps h, times the largest frequency w_max of the straight beam.
"""

from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import numpy as np
from scipy.linalg import eigh

from studies.beam.runs import PAPER_TOL, Array
from studies.bench import Case
from studies.solvers import ERR_IN
from twoloop import Newmark, RungeKutta, paper_irk, solve_dae
from twoloop.mechanisms import Problem, ancf_beam
from twoloop.mechanisms.ancf_beam import elastic_tangent
from twoloop.plan import Method
from twoloop.tableaux import Tableau, gauss, sun_radau_iib

Row = dict[str, Any]

TINY = 1e-3  # m/s, velocity of the base of the linearised beam: nothing else moves it
REDUCED = 1e-2  # of TINY: iterations whose changes have come down to this have converged
FREE_ITERATIONS = 400
LIMIT_STEPS = 10  # that must converge
HALVINGS = 14
GAUSS_SEIDEL = "Sun Radau IIB 3, latest stages (Gauss–Seidel, the paper's)"
JACOBI = "Sun Radau IIB 3, all old stages (Jacobi)"
STATES, STATES_QUICK = 40, 6  # along the motion, from which single steps are tried
TRIED = np.geomspace(0.01, 5.0, 80)  # h w_max of these steps
STOPPED_AT = (1e-1, REDUCED, 1e-4, 1e-6, 1e-8)  # of TINY: changes at which (32) ends the iteration
PAPER_ERR_OUT = 1e-9


def frequencies(problem: Problem, q: Array | None = None) -> Array:
    """Angular frequencies, rad/s, in increasing order, of the beam in position q (None: straight), base at rest."""
    q = problem.q0 if q is None else q
    n = q.size
    K = np.zeros((n, n))
    elastic_tangent(0.0, q, np.zeros(n), problem.system.parameters, K)
    M = problem.system.mass(0.0, q)
    return np.sqrt(np.maximum(eigh(-K[2:, 2:], M[2:, 2:], eigvals_only=True), 0.0))


def jacobi_rate(tableau: Tableau, x: float) -> float:
    """Factor by which an iteration on accelerations from all old stages changes them at h w_max = x: (x rho(A))^2."""
    return float(x * np.abs(np.linalg.eigvals(tableau.A)).max()) ** 2


def gauss_seidel_rate(tableau: Tableau, x: float) -> float:
    """The same of the paper's iteration on [v, q], which uses the latest stages.

    With K_j = B (K_j's sum over A), B = x [[0, -1], [1, 0]] and L the part of A below its diagonal, one iteration is
    K_new = B (L K_new + (A - L) K_old).
    """
    lower = np.tril(tableau.A, -1)
    B = x * np.array([[0.0, -1.0], [1.0, 0.0]])
    identity = np.eye(2 * tableau.stages)
    iteration = np.linalg.solve(identity - np.kron(lower, B), np.kron(tableau.A - lower, B))
    return float(np.abs(np.linalg.eigvals(iteration)).max())


def newmark_rate(beta: float, x: float) -> float:
    """The same of Newmark's method."""
    return beta * x * x


def _loops() -> dict[str, tuple[Callable[[float], Method], Callable[[float], float]]]:
    """By name: the method for a tolerance of its outer loop, and the rate in theory at h w_max = x."""
    sun = sun_radau_iib(3)
    return {
        GAUSS_SEIDEL: (partial(paper_irk, ERR_IN), partial(gauss_seidel_rate, sun)),
        JACOBI: (partial(_fixed_point, sun), partial(jacobi_rate, sun)),
        "Gauss 3, all old stages": (partial(_fixed_point, gauss(3)), partial(jacobi_rate, gauss(3))),
        "Newmark, beta = 0.25": (partial(_newmark, 0.25), partial(newmark_rate, 0.25)),
        "Newmark, beta = 0.5": (partial(_newmark, 0.5), partial(newmark_rate, 0.5)),
    }


def _fixed_point(tableau: Tableau, tol: float) -> Method:
    return RungeKutta(tableau, outer_tol=tol)


def _newmark(beta: float, tol: float) -> Method:
    return Newmark(beta, outer_tol=tol)


def free_limit(problem: Problem, tableau: Tableau, latest: bool) -> float:
    """h w_max where iterations on [v, q] of the linearised beam cease to shrink if no test ends them, by bisection.

    `latest`: each stage uses the latest of the others, as in the paper, not all those of the iteration before.
    """
    n = problem.q0.size
    K = np.zeros((n, n))
    elastic_tangent(0.0, problem.q0, problem.v0, problem.system.parameters, K)
    W = np.linalg.solve(problem.system.mass(0.0, problem.q0)[2:, 2:], K[2:, 2:]) / frequencies(problem)[-1] ** 2

    def shrinks(x: float) -> bool:
        a, v = np.random.default_rng(1).standard_normal((2, tableau.stages, n - 2))
        norms = []
        for _ in range(FREE_ITERATIONS):
            old_a, old_v = (a, v) if latest else (a.copy(), v.copy())
            for j in range(tableau.stages):
                a[j], v[j] = W @ (x * tableau.A[j] @ old_v), x * tableau.A[j] @ old_a
            norms.append(np.sqrt((a * a).sum() + (v * v).sum()))
            a /= norms[-1]
            v /= norms[-1]
        return float(np.log(norms[FREE_ITERATIONS // 2 :]).mean()) < 0.0

    return bisect(shrinks, 0.1, 20.0, HALVINGS)


def bisect(holds: Callable[[float], bool], low: float, high: float, halvings: int) -> float:
    """The largest x at which `holds`, which is true at `low` and not at `high`."""
    for _ in range(halvings):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if holds(middle) else (low, middle)
    return low


def limit_rows() -> Iterator[Row]:
    """Fixed steps on the linearised very flexible beam: where iterations cease to converge, and where in theory."""
    problem = ancf_beam(youngs_modulus=2e6, amplitude=TINY, angular_frequency=1.0, gravity=0.0)
    w_max = float(frequencies(problem)[-1])
    for name, (make, rate) in _loops().items():

        def shrinks(x: float, rate: Callable[[float], float] = rate) -> bool:
            return rate(x) < 1.0

        def converges(x: float, make: Callable[[float], Method] = make) -> bool:
            h = x / w_max
            span = (0.0, LIMIT_STEPS * h)
            return solve_dae(
                problem.system, span, problem.q0, problem.v0, method=make(REDUCED * TINY), step_size=h
            ).success

        yield {
            "group": "limit",
            "solver": name,
            "w_max": w_max,
            "theory": bisect(shrinks, 0.1, 20.0, 50),
            "measured": bisect(converges, 0.1, 20.0, HALVINGS),
            "free": free_limit(problem, sun_radau_iib(3), True) if name == GAUSS_SEIDEL else np.nan,
        }


def growth_test_rows() -> Iterator[Row]:
    """The paper's procedure on the linearised beam: up to which step (33) lets it pass, by the tolerance of (32)."""
    problem = ancf_beam(youngs_modulus=2e6, amplitude=TINY, angular_frequency=1.0, gravity=0.0)
    w_max = float(frequencies(problem)[-1])
    start = problem.q0, problem.v0
    for share in STOPPED_AT:
        method = paper_irk(ERR_IN, share * TINY)
        row: Row = {"group": "growth test", "solver": GAUSS_SEIDEL, "tol": share, "w_max": w_max}
        yield row | {"measured": _longest(problem, (0.0, *start), w_max, method, LIMIT_STEPS)}


def along_rows(known: dict[str, Case], quick: bool) -> Iterator[Row]:
    """The paper's procedure from states along its own run: the longest step before the first that does not converge.

    A row a state, the first at the start of the motion. `w_max` is that of the beam as it then is.
    """
    for case in known.values():
        problem, method = case.problem, paper_irk(ERR_IN, PAPER_ERR_OUT)
        tols = {"rtol": PAPER_TOL, "atol": PAPER_TOL}
        run = solve_dae(problem.system, (0.0, case.t_end), problem.q0, problem.v0, method=method, **tols)
        straight = float(frequencies(problem)[-1])
        n_states = STATES_QUICK if quick else STATES
        for k in np.linspace(0, run.t.size - 2, n_states).astype(int):
            q = run.q[:, k].copy()
            yield {
                "group": "along",
                "case": case.name,
                "solver": GAUSS_SEIDEL,
                "t_end": float(run.t[k]),
                "w_max": float(frequencies(problem, q)[-1]),
                "measured": _longest(problem, (float(run.t[k]), q, run.v[:, k].copy()), straight, method, 1),
                "straight": straight,
            }


def _longest(problem: Problem, state: tuple[float, Array, Array], w_max: float, method: Method, n_steps: int) -> float:
    """h w_max of the longest step tried from a state below the shortest that does not converge; 0: none does."""
    t, q, v = state
    longest = 0.0
    for x in TRIED:
        end = t + n_steps * float(x) / w_max
        if not solve_dae(problem.system, (t, end), q, v, method=method, step_size=(end - t) / n_steps).success:
            return longest
        longest = float(x)
    return longest
