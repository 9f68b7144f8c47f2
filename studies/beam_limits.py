"""What the beam study measures besides runs: step limits, growth with mesh and stiffness, sensitivity of the motion."""

from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import eigh

from studies.beam_runs import (
    CASES,
    DRAWN_PER_SECOND,
    NEWTON,
    PAPER,
    SOFT,
    STIFF,
    SWEEPS,
    T_END,
    instants,
    with_less_known,
)
from studies.solvers import ERR_IN
from twoloop import Newmark, Result, RungeKutta, paper_irk, solve_dae
from twoloop.mechanisms import Problem, ancf_beam, very_flexible_beam
from twoloop.mechanisms.ancf_beam import elastic_tangent, tip_height
from twoloop.plan import Method
from twoloop.tableaux import Tableau, gauss, radau_iia, sun_radau_iib

Array = NDArray[np.float64]
Row = dict[str, Any]

TINY = 1e-3  # m/s, velocity of the base of the linearised beam: nothing else moves it
REDUCED = 1e-2  # of TINY: sweeps whose changes have come down to this have converged
RATE_BETWEEN = 1e-4, 1e-7  # of TINY: the rate of the sweeps is that between these changes
FREE_SWEEPS = 400
LIMIT_STEPS = 10  # that must converge
RATE_AT = 0.8  # of the step at which the sweeps cease to converge
HALVINGS = 14
PAPER_SWEEPS = "Sun Radau IIB 3, latest stages (the paper's)"
ELEMENTS, ELEMENTS_QUICK = (4, 8, 16, 32, 64), (4, 8)
FIXED_STEP, FIXED_STEPS, FIXED_STEPS_QUICK = 2e-4, 50, 5  # s and number, of the runs with many elements
FIXED_REPEATS = 5  # of which the median counts
MODULI, MODULI_QUICK = (2e6, 2e7, 2e8, 2e9, 2e10), (2e8, 2e9)
MODULUS_SWEEPS_END = 0.02  # s; sweeps are run for so long only
MODULUS_TOLS = (1e-1, 1e-2, 1e-3)
FINE_STAGES, FINE_TOL = 5, 1e-4  # of Radau IIA with Newton's method, the reference there
SENSITIVE_TOL = {SOFT: 1e-4, STIFF: 1e-3}  # of RadauIIA5, whose error then is far below all differences
LOOSER_TOL = 1e-2
PARTING = 1.2  # s, until which the paper's very flexible results agree with those that it compares with
VISIBLE = 0.01  # m
PERTURBED = "E + 0.1 %", "g + 0.1 %", "8 elements", "start of the whole beam", "rtol = atol = 1e-2"


def frequencies(problem: Problem) -> Array:
    """Angular frequencies of the straight beam on a base at rest, rad/s, in increasing order."""
    n = problem.q0.size
    K = np.zeros((n, n))
    elastic_tangent(0.0, problem.q0, problem.v0, problem.system.parameters, K)
    M = problem.system.mass(0.0, problem.q0)
    return np.sqrt(np.maximum(eigh(-K[2:, 2:], M[2:, 2:], eigvals_only=True), 0.0))


def jacobi_rate(tableau: Tableau, x: float) -> float:
    """Factor by which a sweep on accelerations that uses all old stages changes them at h w_max = x: (x rho(A))^2."""
    return float(x * np.abs(np.linalg.eigvals(tableau.A)).max()) ** 2


def gauss_seidel_rate(tableau: Tableau, x: float) -> float:
    """The same of the paper's sweep on [v, q], which uses the latest stages.

    With K_j = B (K_j's sum over A), B = x [[0, -1], [1, 0]] and L the part of A below its diagonal, the sweep is
    K_new = B (L K_new + (A - L) K_old).
    """
    lower = np.tril(tableau.A, -1)
    B = x * np.array([[0.0, -1.0], [1.0, 0.0]])
    identity = np.eye(2 * tableau.stages)
    sweep = np.linalg.solve(identity - np.kron(lower, B), np.kron(tableau.A - lower, B))
    return float(np.abs(np.linalg.eigvals(sweep)).max())


Make = Callable[[float], Method]
Rate = Callable[[float], float]
Loop = tuple[Make, Rate]


def _loops() -> dict[str, Loop]:
    """Sweeps by name: the method for a tolerance of its outer loop, and the rate in theory at h w_max = x."""
    sun = sun_radau_iib(3)
    loops: dict[str, Loop] = {
        PAPER_SWEEPS: (
            lambda tol: RungeKutta(sun, "paper", "richardson-paper", ERR_IN, tol),
            partial(gauss_seidel_rate, sun),
        )
    }
    for name, tableau in (
        ("Sun Radau IIB 3", sun),
        ("Gauss 3", gauss(3)),
        ("Gauss 6", gauss(6)),
        ("Radau IIA 3", radau_iia(3)),
    ):
        make = partial(_sweeps, tableau)
        loops[f"{name}, all old stages"] = (make, partial(jacobi_rate, tableau))
    for beta in (0.25, 0.5):
        loops[f"Newmark, beta = {beta:g}"] = (partial(_newmark, beta), partial(_newmark_rate, beta))
    return loops


def _sweeps(tableau: Tableau, tol: float) -> Method:
    return RungeKutta(tableau, outer_tol=tol)


def _newmark(beta: float, tol: float) -> Method:
    return Newmark(beta, outer_tol=tol)


def _newmark_rate(beta: float, x: float) -> float:
    return beta * x * x


def free_limit(problem: Problem, tableau: Tableau, latest: bool) -> float:
    """h w_max where sweeps on [v, q] of the linearised beam cease to shrink if no test ends them, by bisection.

    `latest`: each stage uses the latest of the others, as in the paper, not all those of the sweep before.
    """
    n = problem.q0.size
    K = np.zeros((n, n))
    elastic_tangent(0.0, problem.q0, problem.v0, problem.system.parameters, K)
    W = np.linalg.solve(problem.system.mass(0.0, problem.q0)[2:, 2:], K[2:, 2:]) / frequencies(problem)[-1] ** 2

    def shrinks(x: float) -> bool:
        a, v = np.random.default_rng(1).standard_normal((2, tableau.stages, n - 2))
        norms = []
        for _ in range(FREE_SWEEPS):
            old_a, old_v = (a, v) if latest else (a.copy(), v.copy())
            for j in range(tableau.stages):
                a[j], v[j] = W @ (x * tableau.A[j] @ old_v), x * tableau.A[j] @ old_a
            norms.append(np.sqrt((a * a).sum() + (v * v).sum()))
            a /= norms[-1]
            v /= norms[-1]
        return float(np.log(norms[FREE_SWEEPS // 2 :]).mean()) < 0.0

    return bisect(shrinks, 0.1, 20.0, HALVINGS)


def limit_rows() -> Iterator[Row]:
    """Sweeps at fixed steps on the linearised very flexible beam: where they cease to converge, and how fast before."""
    problem = ancf_beam(youngs_modulus=2e6, amplitude=TINY, angular_frequency=1.0, gravity=0.0)
    w_max = float(frequencies(problem)[-1])

    def run(method: Method, x: float) -> Result:
        h = x / w_max
        return solve_dae(problem.system, (0.0, LIMIT_STEPS * h), problem.q0, problem.v0, method, step_size=h)

    for name, (make, rate) in _loops().items():

        def shrinks(x: float, rate: Rate = rate) -> bool:
            return rate(x) < 1.0

        def converges(x: float, make: Make = make) -> bool:
            return run(make(REDUCED * TINY), x).success

        measured = bisect(converges, 0.1, 20.0, HALVINGS)
        at = RATE_AT * measured
        both = [run(make(share * TINY), at) for share in RATE_BETWEEN]
        while not all(result.success for result in both):  # a tighter run is given up more often, by (33)
            at *= RATE_AT
            both = [run(make(share * TINY), at) for share in RATE_BETWEEN]
        loose, tight = (result.stats.n_outer or 0 for result in both)
        more = (tight - loose) / LIMIT_STEPS  # sweeps a step
        yield {
            "group": "limit",
            "solver": name,
            "w_max": w_max,
            "theory": bisect(shrinks, 0.1, 20.0, 50),
            "measured": measured,
            "rate_at": at,
            "rate": (RATE_BETWEEN[1] / RATE_BETWEEN[0]) ** (1.0 / more),
            "rate_theory": rate(at),
            "free": free_limit(problem, sun_radau_iib(3), True) if name == PAPER_SWEEPS else np.nan,
        }


def bisect(holds: Callable[[float], bool], low: float, high: float, halvings: int) -> float:
    """The largest x at which `holds`, which is true at `low` and not at `high`."""
    for _ in range(halvings):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if holds(middle) else (low, middle)
    return low


def element_rows(quick: bool) -> Iterator[Row]:
    """Cost of a step of fixed size with Newton's method, with the band of the matrices known and unknown."""
    steps = FIXED_STEPS_QUICK if quick else FIXED_STEPS
    end = steps * FIXED_STEP
    for n_elements in ELEMENTS_QUICK if quick else ELEMENTS:
        problem = very_flexible_beam(n_elements)
        kinds = {"dense": with_less_known(problem, tangent=True), "banded": problem.system}
        for kind, system in kinds.items():
            method = RungeKutta(radau_iia(3), "newton")
            runs = [
                solve_dae(system, (0.0, end), problem.q0, problem.v0, method, step_size=FIXED_STEP)
                for _ in range(FIXED_REPEATS)
            ]
            result, stats = runs[0], runs[0].stats
            yield {
                "group": "elements",
                "solver": kind,
                "n_elements": n_elements,
                "status": result.status.name,
                "t_end": end,
                "n_steps": stats.n_accepted,
                "n_evaluations": stats.n_evaluations,
                "n_jacobians": stats.n_jacobians,
                "n_factorizations": stats.n_factorizations,
                "cpu_s": float(np.median([run.stats.cpu_time for run in runs])),
                "w_max": float(frequencies(problem)[-1]),
            }


def modulus_rows(quick: bool) -> Iterator[Row]:
    """Cost of sweeps and of Newton's method against Young's modulus; the base moves as the moderately stiff beam's."""
    base = CASES[STIFF]().parameters
    motion = {name: base[name] for name in ("amplitude", "angular_frequency")}
    for modulus in MODULI_QUICK if quick else MODULI:
        problem = ancf_beam(youngs_modulus=modulus, **motion)
        w_max = float(frequencies(problem)[-1])
        end = 0.1 if quick else T_END
        times = instants(end)
        fine = _run(problem, RungeKutta(radau_iia(FINE_STAGES), "newton"), FINE_TOL, times)
        runs: list[tuple[str, Method, float, Array]] = [
            (NEWTON, RungeKutta(radau_iia(3), "newton"), tol, times) for tol in MODULUS_TOLS
        ]
        short = np.array([0.0, MODULUS_SWEEPS_END / 10 if quick else MODULUS_SWEEPS_END])
        runs += [(SWEEPS, RungeKutta(gauss(3)), 1e-2, short), (PAPER, paper_irk(), 1e-5, short)]
        for solver, method, tol, at in runs:
            result = _run(problem, method, tol, at)
            known = result.success and at is times and fine.success
            yield {
                "group": "modulus",
                "solver": solver,
                "modulus": modulus,
                "tol": tol,
                "status": result.status.name,
                "t_end": float(at[-1]),
                "n_steps": result.stats.n_accepted,
                "n_evaluations": result.stats.n_evaluations,
                "n_jacobians": result.stats.n_jacobians,
                "n_factorizations": result.stats.n_factorizations,
                "cpu_s": result.stats.cpu_time,
                "w_max": w_max,
                "error_tip": float(np.abs(tip_height(result.q) - tip_height(fine.q)).max()) if known else np.nan,
            }


def _run(problem: Problem, method: str | Method, tol: float, times: Array) -> Result:
    return solve_dae(problem.system, (0.0, float(times[-1])), problem.q0, problem.v0, method, tol, tol, t_eval=times)


def sensitivity(quick: bool) -> dict[str, Array]:
    """Distance of the tip of a beam that differs a little from that of the case, against time."""
    t_end = 0.2 if quick else T_END
    times = instants(t_end, DRAWN_PER_SECOND)
    curves: dict[str, Array] = {"t": times}
    for case, make in CASES.items():
        problem = make()
        given = dict(problem.parameters)
        tips = {}
        changes: dict[str, dict[str, Any]] = {
            "": {},
            PERTURBED[0]: {"youngs_modulus": 1.001 * given["youngs_modulus"]},
            PERTURBED[1]: {"gravity": 1.001 * given["gravity"]},
            PERTURBED[2]: {"n_elements": 8},
            PERTURBED[3]: {"start": "beam"},
        }
        for name, change in changes.items():
            result = _run(ancf_beam(**{**given, **change}), "RadauIIA5", SENSITIVE_TOL[case], times)
            if not result.success:
                raise RuntimeError(f"{case}, {name}: {result.message}")
            tips[name] = tip_height(result.q)
        tips[PERTURBED[4]] = tip_height(_run(problem, "RadauIIA5", LOOSER_TOL, times).q)
        curves |= {f"{case}, {name}": tips[name] - tips[""] for name in PERTURBED}
    return curves


def sensitivity_rows(curves: dict[str, Array]) -> Iterator[Row]:
    """Largest of these distances until the paper's 1.2 s and over the run, and when they first reach a centimetre."""
    t = curves["t"]
    for case in CASES:
        for name in PERTURBED:
            off = np.abs(curves[f"{case}, {name}"])
            seen = t[off > VISIBLE]
            yield {
                "group": "sensitivity",
                "case": case,
                "solver": name,
                "t_end": float(t[-1]),
                "before": float(off[t <= PARTING].max()),
                "largest": float(off.max()),
                "t_visible": float(seen[0]) if seen.size else np.nan,
            }
