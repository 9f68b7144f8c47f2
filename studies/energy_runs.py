"""The runs of the energy study: three motions of the four-bar linkage, methods with and without step-size control."""

import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cache, partial
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import null_space
from scipy.optimize import brentq

from references.four_bar_minimal import MinimalFourBar
from references.index1 import solve_index1
from studies.bench import Case, Run, Solver
from studies.energy_drift import (
    BDF_LOOP,
    CRANK,
    GAUSS,
    GAUSS_12,
    LOBATTO,
    MIDPOINT,
    MOMENTA_LASTING,
    MOMENTA_SYMMETRIC,
    NEWMARK_HALF,
    NEWMARK_QUARTER,
    ONE,
    PAPER_IRK,
    PAPER_NEWMARK_HALF,
    RADAU,
    SUN,
    SWITCHING,
    VELOCITIES_LASTING,
    VELOCITIES_SYMMETRIC,
    Variant,
    drift,
    windows,
)
from studies.reference_motion import ReferenceMotion, make_reference
from studies.solvers import CATALOGUE, IDA_C, OWN_EXPLICIT
from studies.store import Row
from twoloop import BDF, Newmark, Result, RungeKutta, paper_irk, paper_newmark, solve_dae
from twoloop.mechanisms import Problem, four_bar
from twoloop.plan import Method
from twoloop.tableaux import gauss, lobatto_iiie, radau_iia, sun_radau_iib

Array = NDArray[np.float64]

GEOMETRIES: dict[str, dict[str, Any]] = {
    ONE: {"lengths": (1.0, 1.2, 0.5), "ground": 1.0, "theta3": math.pi, "branch": 1},
    SWITCHING: {},
}
SPEED = 12.0  # rad/s of bar 3 of the first geometry, enough for full turns
LONG, TURNING, SHORT = 10_000.0, 1000.0, 100.0  # s
QUICK = {LONG: 75.0, TURNING: 20.0, SHORT: 50.0}
FLOOR = 1e-9  # m, rad; the one-coordinate solution after 10,000 s, some thousand periods
TIME_LIMIT = 300.0  # CPU s
GOLDEN = (3.0 - math.sqrt(5.0)) / 2.0  # of a period: far from every fraction of few parts, so no phase is left out
EARLY = 100.0  # s, the time over which the error of a long run is taken: later most are out of phase

METHODS: dict[str, Method] = {
    SUN: RungeKutta(sun_radau_iib(3)),
    GAUSS: RungeKutta(gauss(3)),
    LOBATTO: RungeKutta(lobatto_iiie(4)),
    RADAU: RungeKutta(radau_iia(3)),
    GAUSS_12: RungeKutta(gauss(6)),
    MIDPOINT: RungeKutta(gauss(1)),
    NEWMARK_QUARTER: Newmark(0.25),
    NEWMARK_HALF: Newmark(0.5),
    PAPER_IRK: paper_irk(),
    BDF_LOOP: BDF(),
}
BASIC, EVEN = VELOCITIES_LASTING, VELOCITIES_SYMMETRIC
SMALL = (MIDPOINT, NEWMARK_QUARTER, NEWMARK_HALF, BDF_LOOP)  # of order 2; BDF does not converge with H
H, H_SMALL, H_CRANK = 0.02, 0.01, 0.0045  # s
FIXED: dict[str, dict[str, list[Variant]]] = {
    ONE: {
        SUN: [BASIC, MOMENTA_LASTING],
        GAUSS: [BASIC, MOMENTA_LASTING],
        LOBATTO: [BASIC],
        RADAU: [BASIC],
        MIDPOINT: [BASIC],
        NEWMARK_QUARTER: [BASIC],
        NEWMARK_HALF: [BASIC],
        BDF_LOOP: [BASIC],
    },
    SWITCHING: {
        SUN: [BASIC, EVEN, MOMENTA_LASTING, MOMENTA_SYMMETRIC],
        GAUSS: [BASIC, EVEN, MOMENTA_LASTING, MOMENTA_SYMMETRIC],
        LOBATTO: [BASIC, EVEN],
        RADAU: [BASIC],
        GAUSS_12: [EVEN],
        MIDPOINT: [BASIC, EVEN],
        NEWMARK_QUARTER: [BASIC],
        NEWMARK_HALF: [BASIC],
        BDF_LOOP: [BASIC],
    },
    CRANK: {SUN: [MOMENTA_LASTING], GAUSS: [BASIC, MOMENTA_LASTING, MOMENTA_SYMMETRIC]},
}
COARSER = {GAUSS: (0.04, 0.03), MIDPOINT: (0.02,)}  # s, further steps of what is free of drift on SWITCHING, EVEN
CONTROLLED: dict[str, dict[str, list[Variant]]] = {
    ONE: {PAPER_IRK: [BASIC], SUN: [BASIC, MOMENTA_LASTING], GAUSS: [BASIC], RADAU: [BASIC]},
    SWITCHING: {PAPER_IRK: [BASIC], SUN: [BASIC], GAUSS: [BASIC, EVEN], RADAU: [BASIC], BDF_LOOP: [BASIC]},
}
TOL, ERR_OUT = 1e-5, 1e-7  # Rtol = Atol; err_out of PaperNewmark
LSODA, PROJECTED = "LSODA, index 1", "DOP853, projected"
ALPHA, TRAPEZOIDAL = "Exudyn, GeneralizedAlpha", "Exudyn, TrapezoidalIndex2"
OTHERS: dict[str, dict[str, tuple[float, ...]]] = {  # values of the setting; quick: the first
    SWITCHING: {
        OWN_EXPLICIT: (1e-6, 1e-8, 1e-10, 1e-12),
        "Gauss12": (1e-5, 1e-7),
        IDA_C: (1e-6, 1e-8, 1e-10),
        LSODA: (1e-8, 1e-10),
        PROJECTED: (1e-7, 1e-9),
        ALPHA: (0.01,),
        TRAPEZOIDAL: (0.02, 0.01),
    },
    ONE: {OWN_EXPLICIT: (1e-8,), IDA_C: (1e-8,), LSODA: (1e-8,)},
    CRANK: {OWN_EXPLICIT: (1e-8, 1e-10), IDA_C: (1e-8,), LSODA: (1e-8,)},
}
LADDER = (0.02, 0.015, 0.01)  # s, steps that tell the order of a drift
LADDERED: list[tuple[str, str, Variant]] = [
    (ONE, SUN, BASIC),
    (ONE, RADAU, BASIC),
    (SWITCHING, SUN, EVEN),
    (SWITCHING, SUN, MOMENTA_SYMMETRIC),
]


@cache
def crank() -> tuple[Problem, float, ReferenceMotion]:
    """The first geometry with a crank that turns round and round: problem, period, motion over more than one turn."""
    resting = four_bar(**GEOMETRIES[ONE])
    direction = null_space(resting.system.jacobian(0.0, resting.q0))[:, 0]
    problem = replace(resting, name=f"{resting.name}, turning", v0=direction / direction[8] * SPEED, reference=None)
    once = make_reference(problem, 1.5)

    def turn(t: float) -> float:
        return float(once.states(np.array([t]))[0][8, 0] - problem.q0[8] - 2.0 * math.pi)

    return problem, brentq(turn, 0.1, 1.5, xtol=1e-15), once


def _turning(motion: str, t_end: float) -> ReferenceMotion:
    """The motion of the turning crank for any time, from one turn."""
    problem, period, once = crank()
    end = once.states(np.array([period]))[0][:, 0]
    turned = np.zeros(end.size)
    turned[2::3] = 2.0 * math.pi * np.round((end - problem.q0)[2::3] / (2.0 * math.pi))

    def states(t: Array) -> tuple[Array, Array]:
        turns = np.floor(np.asarray(t) / period)
        q, v = once.states(t - turns * period)
        return q + turned[:, None] * turns, v

    floor = 10.0 * t_end / period * once.floor  # the error of the period adds up
    return ReferenceMotion(states, floor, f"one turn, repeated; {once.source}")


@cache
def linkage(geometry: str) -> tuple[Problem, MinimalFourBar]:
    """A linkage released from rest, and its true motion."""
    problem = four_bar(**GEOMETRIES[geometry])
    return problem, MinimalFourBar.from_parameters(problem.parameters)


def _swinging(motion: str, t_end: float) -> ReferenceMotion:
    """The motion of a linkage released from rest."""
    return ReferenceMotion(linkage(motion)[1].states, FLOOR, "one-coordinate formulation of its own")


def period_of(motion: str) -> float:
    """Period of one of the three motions, s."""
    return crank()[1] if motion == CRANK else linkage(motion)[1].period


@cache
def case_of(motion: str, t_end: float) -> Case:
    """One of the three motions for so long, sampled at times spread over the phases of its period."""
    problem = crank()[0] if motion == CRANK else linkage(motion)[0]
    known = partial(_turning if motion == CRANK else _swinging, motion, t_end)
    n = math.ceil(t_end / (0.25 * GOLDEN * period_of(motion)))
    options: dict[str, Any] = {"time_limit": TIME_LIMIT, "timed": 0.0, "tags": ("long",)}
    return Case(motion, problem, t_end, known, n, **options)


def instants(case: Case, h: float) -> Array | None:
    """Multiples of a fixed step h near the case's instants, and its end: landing on them changes no step.

    None for short motions: at every step.
    """
    if case.t_end <= SHORT:
        return None
    interval = h * max(1, round(case.t_end / case.n_instants / h))
    n = int(case.t_end / interval * (1.0 - 1e-12))
    return np.append(interval * np.arange(n + 1, dtype=np.float64), case.t_end)


def _solve(method: str | Method, case: Case, options: dict[str, Any]) -> Result:
    problem = case.problem
    return solve_dae(problem.system, (0.0, case.t_end), problem.q0, problem.v0, method=method, **options)


def _fixed(method: Method, case: Case, h: float, repeat: int) -> Result:
    return _solve(method, case, {"step_size": h, "t_eval": instants(case, h)})


def _controlled(method: str | Method, case: Case, tol: float, repeat: int) -> Result:
    """Every step is stored, except where steps are much shorter than the intervals of the sampling instants."""
    short = (method == "DOP853" and tol < 1e-9) or isinstance(method, BDF)
    return _solve(method, case, {"rtol": tol, "atol": tol, "t_eval": case.instants if short else None})


def _newmark(case: Case, err_out: float, repeat: int) -> Result:
    return _solve(paper_newmark(1e-9, err_out), case, {"t_eval": case.instants})


def _index1(method: str, stabilisation: str, case: Case, tol: float, repeat: int) -> Result:
    p, span = case.problem, (0.0, case.t_end)
    options: dict[str, Any] = {"stabilisation": stabilisation, "t_eval": np.append(0.0, case.instants)}
    return solve_index1(p.system, span, p.q0, p.v0, method, tol, tol, **options)


def _exudyn(solver: str, case: Case, h: float, repeat: int) -> Result:
    from references.exudyn_four_bar import solve_exudyn

    n_steps = round(case.t_end / h)
    most = max(1, int(case.t_end / case.n_instants / h))
    every = next(k for k in range(most, 0, -1) if n_steps % k == 0)
    return solve_exudyn(case.problem, case.t_end, n_steps, solver, store_every=every)


def _two_loop(name: str, setting: str, variant: Variant) -> Solver:
    method = METHODS[name]
    if isinstance(method, RungeKutta) and method.outer != "paper":
        method = replace(method, variables=variant[0], partition=variant[1])
    run: Callable[[Case, float, int], Result] = partial(_fixed if setting == "h" else _controlled, method)
    fixed = {"variables": variant[0], "partition": variant[1]}
    return Solver(name, "two-loop", "compiled", True, setting, run, fixed=fixed)


def _other(name: str) -> Solver:
    """An entry of the catalogue, storing its states at the case's instants."""
    adapters: dict[str, Callable[[Case, float, int], Result]] = {
        OWN_EXPLICIT: partial(_controlled, "DOP853"),
        "Gauss12": partial(_controlled, "Gauss12"),
        LSODA: partial(_index1, "LSODA", "none"),
        PROJECTED: partial(_index1, "DOP853", "projection"),
        ALPHA: partial(_exudyn, "GeneralizedAlpha"),
        TRAPEZOIDAL: partial(_exudyn, "TrapezoidalIndex2"),
    }
    entry = CATALOGUE[name]
    return replace(entry, run=adapters.get(name, entry.run))


def runs(quick: bool) -> Iterator[Run]:
    """All runs, the longest first so that no core waits at the end."""
    ends = QUICK if quick else {t: t for t in QUICK}
    cases = {name: case_of(name, ends[TURNING if name == CRANK else LONG]) for name in (SWITCHING, ONE, CRANK)}
    fixed = {"variables": BASIC[0], "partition": BASIC[1]}
    paper = Solver(PAPER_NEWMARK_HALF, "two-loop", "compiled", True, "tol", _newmark, fixed=fixed)
    yield Run(cases[SWITCHING], paper, ERR_OUT, "controlled", 1)
    for name, solvers in OTHERS.items():
        for solver, values in solvers.items():
            for value in reversed(values[:1] if quick else values):
                yield Run(cases[name], _other(solver), value, "other", 1)
    for name, methods in CONTROLLED.items():
        for method, variants in methods.items():
            for variant in variants:
                yield Run(cases[name], _two_loop(method, "tol", variant), TOL, "controlled", 1)
    for name, methods in FIXED.items():
        for method, variants in methods.items():
            for variant in variants:
                h = H_CRANK if name == CRANK else H_SMALL if method in SMALL else H
                yield Run(cases[name], _two_loop(method, "h", variant), h, "fixed", 1)
    for method, steps in COARSER.items():
        for h in () if quick else steps:
            yield Run(cases[SWITCHING], _two_loop(method, "h", EVEN), h, "coarser", 1)
    for name, method, variant in LADDERED:
        for h in LADDER:
            yield Run(case_of(name, ends[SHORT]), _two_loop(method, "h", variant), h, "order", 1)


def measure(run: Run, result: Result) -> Row:
    """What the energy of a run does: slope and swing, and the windows that a figure shows."""
    case, problem = run.case, run.case.problem
    row: Row = {"t_reached": float(result.t[-1]), "kinetic": case.scale.kinetic}
    row |= dict.fromkeys(("slope", "slope_error", "swing", "error_early", "window_t", "window_mean"))
    if not result.success:
        return row
    error = problem.energy(result.t, result.q, result.v) - problem.energy(0.0, problem.q0, problem.v0)
    seen = windows(result.t, error, period_of(case.name), case.t_end)
    row["slope"], row["slope_error"] = drift(seen["t"], seen["mean"])
    row["swing"] = float(np.median(seen["range"]))
    early = result.t <= EARLY
    row["error_early"] = float(np.abs(result.q[:, early] - case.reference.states(result.t[early])[0]).max())
    return row | {"window_t": seen["t"].tolist(), "window_mean": seen["mean"].tolist()}
