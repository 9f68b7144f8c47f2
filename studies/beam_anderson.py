"""What Anderson's acceleration of the sweeps would save: a trial beside the integrator, which does without it.

D. G. Anderson, J. ACM 12 (1965) 547-560: the next iterate is the combination of the last ones whose residual is the
least in the sense of least squares; depth 0 is the plain sweep.
"""

from collections.abc import Iterator
from typing import Any

import numpy as np
from numba import njit

from studies.report import Array
from twoloop import RungeKutta, solve_dae
from twoloop.kernels import advance, common, inner
from twoloop.mechanisms import Problem, four_bar, very_flexible_beam
from twoloop.tableaux import Tableau, sun_radau_iib

TABLEAU = sun_radau_iib(3)
DEPTHS = (0, 1, 2, 5)
TRIALS = (  # problem, time over which states are taken, steps from them
    (four_bar, 2.0, (0.02, 0.05, 0.08)),
    (very_flexible_beam, 0.5, (2e-4, 5e-4, 1e-3, 1.3e-3)),
)
STATES = 11
TOLERANCE = 1e-9  # of the outer loop
MOST = 100  # sweeps


@njit(error_model="numpy")
def _evaluate(f, w, t, q, v, a):  # type: ignore[no-untyped-def]
    return inner.evaluate(f, w, t, q, v, 1e-8, a, w.lam)


def sweeps(problem: Problem, state: tuple[float, Array, Array], h: float, depth: int, tableau: Tableau) -> float:
    """Sweeps on the stage accelerations until none would change a velocity by more than TOLERANCE; inf: they fail."""
    t, q, v = state
    system, n, s = problem.system, problem.system.n_q, tableau.stages
    A, c = tableau.A, tableau.c
    w = common.make_work(n, system.n_c)
    start = np.concatenate([q, v, np.zeros(n + system.n_c)])
    if advance.start(system.functions, w, t, start) != common.DONE:
        return float("inf")
    free, a0 = w.independent, start[2 * n : 3 * n]
    x = np.tile(a0, (s, 1))
    Q = q + h * c[:, None] * v + 0.5 * (h * c[:, None]) ** 2 * a0
    V = np.zeros((s, n))
    tried: list[Array] = []
    found: list[Array] = []
    for count in range(1, MOST + 1):
        Q[:, free] = (q + h * c[:, None] * v + h * h * (A @ A @ x))[:, free]
        V[:, free] = (v + h * (A @ x))[:, free]
        new = np.empty_like(x)
        for j in range(s):
            if _evaluate(system.functions, w, t + c[j] * h, Q[j], V[j], new[j]) != common.DONE:
                return float("inf")
        tried.append(x[:, free].ravel())
        found.append(new[:, free].ravel())
        change = (h * np.abs(found[-1] - tried[-1]) / np.maximum(np.abs(V[:, free]), 1.0).ravel()).max()
        if change <= TOLERANCE:
            return float(count)
        if not change < 1e6:
            return float("inf")
        x = new
        used = min(depth, count - 1) + 1
        if used > 1:
            g = np.array(found[-used:])
            residuals = g - np.array(tried[-used:])
            weights = np.linalg.lstsq(np.diff(residuals, axis=0).T, residuals[-1], rcond=1e-12)[0]
            x[:, free] = (g[-1] - weights @ np.diff(g, axis=0)).reshape(s, -1)
    return float("inf")


def anderson_rows() -> Iterator[dict[str, Any]]:
    """Median number of sweeps from states along a run, for each step size and depth."""
    for make, t_end, steps in TRIALS:
        problem = make()
        method, times = RungeKutta(TABLEAU, outer="newton"), np.linspace(0.0, t_end, STATES + 1)
        run = solve_dae(problem.system, (0.0, t_end), problem.q0, problem.v0, method, 1e-6, 1e-6, t_eval=times)
        states = [(float(run.t[k]), run.q[:, k].copy(), run.v[:, k].copy()) for k in range(1, STATES + 1)]
        for h in steps:
            for depth in DEPTHS:
                count = float(np.median([sweeps(problem, state, h, depth, TABLEAU) for state in states]))
                yield {"group": "anderson", "case": problem.name, "h": h, "depth": depth, "sweeps": count}
