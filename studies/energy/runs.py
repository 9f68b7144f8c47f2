"""The runs of the energy study: two geometries of the four-bar linkage, methods with and without step-size control."""

import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cache, partial
from typing import Any

import numpy as np

from references.casadi.integrators import solve_sundials
from references.diffrax.dopri8 import solve_diffrax
from references.paper.four_bar_minimal import MinimalFourBar
from references.scipy.index1 import solve_index1
from studies.bench import solvers
from studies.bench.collector import REPEATS, Case, Run, Solver
from studies.bench.headline import OWN_CODE
from studies.bench.reference_motion import ReferenceMotion
from studies.bench.store import Array
from studies.energy.drift import drift, windows
from twoloop import BDF, Newmark, Result, RungeKutta, paper_irk, solve_dae
from twoloop.mechanisms import Problem, four_bar
from twoloop.methods.plan import Method
from twoloop.methods.tableaux import gauss, radau_iia, sun_radau_iib

ONE, SWITCHING = "one partition", "switching"
GEOMETRIES: dict[str, dict[str, Any]] = {
    ONE: {"lengths": (1.0, 1.2, 0.5), "ground": 1.0, "theta3": math.pi, "branch": 1},
    SWITCHING: {},
}
LONG, QUICK = 10_000.0, 75.0  # s
FLOOR = 1e-9  # m, rad; the one-coordinate solution after 10,000 s, some thousand periods
TIME_LIMIT = 300.0  # CPU s
MOST_STEPS = 30_000_000  # of solvers that count them and do not look at the clock
NOT_QUICK = (solvers.DIFFRAX, solvers.CVODES, solvers.CVODE_C_PROJECTED, solvers.CYRK)  # compile for seconds
GOLDEN = (3.0 - math.sqrt(5.0)) / 2.0  # of a period: far from every fraction of few parts, so no phase is left out

SUN, GAUSS, RADAU, MIDPOINT = "Sun Radau IIB(3)", "Gauss(3)", "Radau IIA(3)", "implicit midpoint"
NEWMARK = "Newmark, β = 1/2"
TABLEAUX = {SUN: sun_radau_iib(3), GAUSS: gauss(3), RADAU: radau_iia(3), MIDPOINT: gauss(1)}
METHODS: dict[str, Method] = {name: RungeKutta(tableau) for name, tableau in TABLEAUX.items()}
METHODS |= {NEWMARK: Newmark(0.5), solvers.IRK: paper_irk(), solvers.OWN_BDF: BDF()}
LASTING, EVEN = "lasting", "symmetric"  # choices of the partition
H, H_SMALL = 0.02, 0.01  # s; H_SMALL for methods of order 2
FIXED: dict[str, dict[str, tuple[str, ...]]] = {
    ONE: dict.fromkeys((SUN, GAUSS, RADAU, MIDPOINT, NEWMARK), (LASTING,)),
    SWITCHING: dict.fromkeys((SUN, GAUSS, MIDPOINT), (LASTING, EVEN)) | {NEWMARK: (LASTING,)},
}
COARSER = {GAUSS: (0.04, 0.03), MIDPOINT: (0.02,)}  # s, further steps of what is free of drift on SWITCHING, EVEN
CONTROLLED = {
    ONE: {solvers.IRK: LASTING, GAUSS: LASTING},
    SWITCHING: {solvers.IRK: LASTING, SUN: LASTING, GAUSS: EVEN, solvers.OWN_BDF: LASTING},
}
TOL = 1e-5  # Rtol = Atol
# of those on SWITCHING which may set a price: all others take three times as long for no smaller an energy error
REPEATED = (
    *(solvers.DEFAULT, OWN_CODE, solvers.OWN_EXPLICIT, "Gauss12", GAUSS, MIDPOINT, "Exudyn, TrapezoidalIndex2"),
    *(solvers.CVODE_C, solvers.CYRK, solvers.HEYOKA),
)
LSODA, PROJECTED = "LSODA, index 1", "DOP853, projected"
ALPHA, TRAPEZOIDAL = "Exudyn, GeneralizedAlpha", "Exudyn, TrapezoidalIndex2"


@cache
def linkage(geometry: str) -> tuple[Problem, MinimalFourBar]:
    """A linkage released from rest, and its true motion."""
    problem = four_bar(**GEOMETRIES[geometry])
    return problem, MinimalFourBar.from_parameters(problem.parameters)


@cache
def case_of(geometry: str, t_end: float) -> Case:
    """A linkage released from rest for so long, sampled at times spread over the phases of its period."""
    problem, motion = linkage(geometry)
    known = ReferenceMotion(motion.states, FLOOR, "one-coordinate formulation of its own")
    n = math.ceil(t_end / (0.25 * GOLDEN * motion.period))
    return Case(geometry, problem, t_end, lambda: known, n, time_limit=TIME_LIMIT, timed=0.0, tags=("long",))


def instants(case: Case, h: float) -> Array | None:
    """Multiples of a fixed step h near the case's instants, and its end: landing on them changes no step.

    None for short motions: at every step.
    """
    if case.t_end <= QUICK:
        return None
    interval = h * max(1, round(case.t_end / case.n_instants / h))
    n = int(case.t_end / interval * (1.0 - 1e-12))
    return np.append(interval * np.arange(n + 1, dtype=np.float64), case.t_end)


def _solve(method: str | Method, case: Case, **options: Any) -> Result:
    return solve_dae(*case.start, method=method, **options)


def _fixed(method: Method, case: Case, h: float, repeat: int) -> Result:
    return _solve(method, case, step_size=h, t_eval=instants(case, h))


def _controlled(method: str | Method, case: Case, tol: float, repeat: int, compiled: bool = False) -> Result:
    """Every step is stored, except where steps are much shorter than the intervals of the sampling instants."""
    short = (method == "DOP853" and tol < 1e-9) or isinstance(method, BDF)
    return _solve(method, case, rtol=tol, atol=tol, t_eval=case.instants if short else None, compiled=compiled)


def _index1(method: str, stabilisation: str, case: Case, tol: float, repeat: int) -> Result:
    options: dict[str, Any] = {"stabilisation": stabilisation, "t_eval": np.append(0.0, case.instants)}
    return solve_index1(*case.start, method, tol, tol, **options)


def _long(solve: Callable[..., Result], case: Case, tol: float, repeat: int) -> Result:
    return solvers.at_instants(solve, case, rtol=tol, atol=tol, most_steps=MOST_STEPS)


def _exudyn(solver: str, case: Case, h: float, repeat: int) -> Result:
    from references.exudyn.mechanisms import solve_exudyn

    n_steps = round(case.t_end / h)
    every = next(k for k in range(max(1, int(case.t_end / case.n_instants / h)), 0, -1) if n_steps % k == 0)
    return solve_exudyn(case.problem, case.t_end, n_steps, solver, store_every=every)


FINE = (1e-6, 1e-8, 1e-10, 1e-12)
FINER = (1e-6, 3e-7, 1e-7, 3e-8, 1e-8, 3e-9, 1e-9, 3e-10, 1e-10, 3e-11, 1e-11, 1e-12)  # of those that set the price
# on SWITCHING: settings, loose to tight (quick: the first), and how each stores states at the case's instants
OTHERS: dict[str, tuple[tuple[float, ...], Callable[[Case, float, int], Result]]] = {
    solvers.DEFAULT: (FINER, partial(_controlled, "auto")),
    OWN_CODE: (FINER, partial(_controlled, "auto", compiled=True)),
    solvers.OWN_EXPLICIT: (FINE, partial(_controlled, "DOP853")),
    "Gauss12": ((1e-5, 1e-7), partial(_controlled, "Gauss12")),
    solvers.IDA_C: (FINE, solvers.CATALOGUE[solvers.IDA_C].run),
    solvers.CVODE_C: (FINER, solvers.CATALOGUE[solvers.CVODE_C].run),
    solvers.CYRK: (FINER, solvers.CATALOGUE[solvers.CYRK].run),
    solvers.CVODE_C_PROJECTED: (FINE, solvers.CATALOGUE[solvers.CVODE_C_PROJECTED].run),
    solvers.DIFFRAX: (FINE, partial(_long, solve_diffrax)),
    solvers.CVODES: (FINE, partial(_long, partial(solve_sundials, method="BDF"))),
    solvers.HEYOKA: ((*FINER, 1e-14), solvers.CATALOGUE[solvers.HEYOKA].run),
    LSODA: ((1e-8, 1e-10, 1e-12), partial(_index1, "LSODA", "none")),
    PROJECTED: ((1e-7, 1e-9, 1e-11), partial(_index1, "DOP853", "projection")),
    ALPHA: ((0.01,), partial(_exudyn, "GeneralizedAlpha")),
    TRAPEZOIDAL: ((0.02, 0.01, 0.005), partial(_exudyn, "TrapezoidalIndex2")),
}


def _two_loop(name: str, setting: str, partition: str) -> Solver:
    method = METHODS[name]
    if isinstance(method, RungeKutta) and partition == EVEN:
        method = replace(method, partition="symmetric")
    run = partial(_fixed if setting == "h" else _controlled, method)
    return Solver(name, "two-loop", "compiled", True, setting, run, fixed={"partition": partition})


def runs(quick: bool) -> Iterator[Run]:
    """All runs; those whose times are compared are repeated."""
    for run in _once(quick):
        compared = run.case.name == SWITCHING and run.solver.name in REPEATED and not quick
        yield replace(run, repeats=REPEATS) if compared else run


def _once(quick: bool) -> Iterator[Run]:
    cases = {name: case_of(name, QUICK if quick else LONG) for name in GEOMETRIES}
    for name, (values, run) in OTHERS.items():
        for value in () if quick and name in NOT_QUICK else reversed(values[:1] if quick else values):
            yield Run(cases[SWITCHING], replace(solvers.CATALOGUE[name], run=run), value, "other", 1)
    for geometry, controlled in CONTROLLED.items():
        for name, partition in controlled.items():
            yield Run(cases[geometry], _two_loop(name, "tol", partition), TOL, "controlled", 1)
    for geometry, methods in FIXED.items():
        for name, partitions in methods.items():
            h = H_SMALL if name in (MIDPOINT, NEWMARK) else H
            for partition in partitions:
                yield Run(cases[geometry], _two_loop(name, "h", partition), h, "fixed", 1)
    for name, steps in COARSER.items():
        for h in () if quick else steps:
            yield Run(cases[SWITCHING], _two_loop(name, "h", EVEN), h, "coarser", 1)


def measure(run: Run, result: Result) -> dict[str, Any]:
    """What the energy of a run does: slope and swing, and the windows that a figure shows."""
    case, problem = run.case, run.case.problem
    reached = float(result.t[-1]) if result.t.size else 0.0  # a run that fails at once has no output
    row: dict[str, Any] = {"t_reached": reached, "kinetic": case.scale.kinetic, "series": {}}
    row |= dict.fromkeys(("slope", "slope_error", "swing"))
    if not result.success:
        return row
    error = problem.energy(result.t, result.q, result.v) - problem.energy(0.0, problem.q0, problem.v0)
    seen = windows(result.t, error, linkage(case.name)[1].period, case.t_end)
    row["slope"], row["slope_error"] = drift(seen["t"], seen["mean"])
    row["swing"] = float(np.median(seen["range"]))
    return row | {"series": {"t": seen["t"], "mean": seen["mean"]}}
