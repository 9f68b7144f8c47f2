"""Figs. 9-14 of the paper: the flexible beam on a moving base, very flexible and moderately stiff.

The paper does not give the start. Assumed: straight along x, gravity across it, only the base node moving.
"""

from collections.abc import Iterator, Mapping
from dataclasses import replace
from functools import partial
from itertools import product
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from scipy.linalg import eigh
from scipy.optimize import brentq

from references.scipy.beam_reduced import reduced_motion
from studies.bench import adaptive, figures, solvers, tables
from studies.bench.cli import StudyError
from studies.bench.collector import REPEATS, Case, Run, Solver, Warm, row_of
from studies.bench.metrics import ASTRAY, deviation
from studies.bench.reference_motion import Quintic, ReferenceMotion
from studies.bench.render import number
from studies.bench.store import Array, Output, Row
from twoloop import Result, solve_dae
from twoloop.mechanisms import Problem, ancf_beam, moderately_stiff_beam, very_flexible_beam
from twoloop.mechanisms.ancf_beam import elastic_tangent, tip_height
from twoloop.methods.tableaux import Tableau, sun_radau_iib

SOFT, STIFF = "very flexible", "moderately stiff"
MAKE = {SOFT: very_flexible_beam, STIFF: moderately_stiff_beam}
T_END, T_END_QUICK = 2.0, 0.1  # s; the paper does not say how long its runs are
TIGHT = 1e-10  # tolerance of the reference
CHECK = 1e-9  # of the two runs that it is compared with
TOLERANCES = tuple(float(f"1e-{k}") for k in range(1, 9))  # from looser ones on: these step over vibrations
TIME_LIMIT = 30.0  # s, of a call; the paper's procedure takes a third of it on the processors seen so far


def _known(problem: Problem, t_end: float) -> ReferenceMotion:
    """Return the motion by DOP853 of twoloop, its steps joined by quintics, with its distance from two others as floor.

    Gauss12 shares the equations but not the method. SciPy's DOP853 on the equations without constraints shares the
    forces and the tableau, and nothing of the two-loop procedure.
    """
    span, start = (0.0, t_end), (problem.q0, problem.v0)
    first = solve_dae(problem.system, span, *start, method="DOP853", rtol=TIGHT, atol=TIGHT)
    other = solve_dae(problem.system, span, *start, method="Gauss12", rtol=CHECK, atol=CHECK)
    for result in (first, other):
        if not result.success:
            raise StudyError(f"no reference for {problem.name}: {result.message}")
    motion = Quintic(first.t, first.q, first.v, first.a)
    differ = np.abs(motion(other.t)[0] - other.q).max()
    times = np.linspace(0.0, t_end, 101)[1:]
    apart = np.abs(motion(times)[0] - reduced_motion(problem, times, CHECK)[0]).max()
    source = (
        f"DOP853 (twoloop) at {TIGHT:.0e}, from which Gauss12 differs by {differ:.1e} and SciPy's DOP853 on the "
        f"equations without constraints by {apart:.1e}"
    )
    return ReferenceMotion(motion, float(max(differ, apart, motion.uncertainty(), 1e-13)), source)


def case_of(kind: str, name: str, quick: bool, t_end: float | None = None) -> Case:
    """One of the beams, SOFT or STIFF, over 2 s; quick: 0.1 s; or over `t_end`."""
    problem, t_end = MAKE[kind](), t_end or (T_END_QUICK if quick else T_END)
    # the base does work on the beam: its energy is no invariant
    about: dict[str, Any] = {"conserved": False, "watched": (problem.q0.size - 5,)}  # the tip's height
    about |= {"tolerances": TOLERANCES, "time_limit": TIME_LIMIT, "timed": 0.004 if quick else 0.1}
    return Case(name, problem, t_end, partial(_known, problem, t_end), **about)


GAUSS_SEIDEL = "Sun Radau IIB 3, latest stages (Gauss–Seidel, the paper's)"
# RadauIIA5 at these tolerances is far more accurate than the changes are large
METHOD, TOL = "RadauIIA5", {SOFT: 1e-4, STIFF: 1e-3}
PARTING = 1.2  # s, until which the paper's very flexible results agree with those that it compares with
PARAMETERS, MESH = ("E + 0.1 %", "g + 0.1 %"), "8 elements"


def frequencies(problem: Problem) -> Array:
    """Return the angular frequencies, rad/s, in increasing order, of the straight beam with its base at rest."""
    q, n = problem.q0, problem.q0.size
    K = np.zeros((n, n))
    elastic_tangent(0.0, q, np.zeros(n), problem.system.functions.p, K)
    return np.sqrt(np.maximum(eigh(-K[2:, 2:], problem.system.mass(0.0, q)[2:, 2:], eigvals_only=True), 0.0))


def gauss_seidel_limit(tableau: Tableau) -> float:
    """Return the largest h w_max at which the paper's iteration on [v, q] converges, which uses the latest stages.

    With K_j = B (K_j's sum over A), B = x [[0, -1], [1, 0]] and L the part of A below its diagonal, one iteration is
    K_new = B (L K_new + (A - L) K_old).
    """
    lower = np.tril(tableau.A, -1)

    def rate(x: float) -> float:
        B = x * np.array([[0.0, -1.0], [1.0, 0.0]])
        iteration = np.linalg.solve(np.eye(2 * tableau.stages) - np.kron(lower, B), np.kron(tableau.A - lower, B))
        return float(np.abs(np.linalg.eigvals(iteration)).max())

    return float(brentq(lambda x: rate(x) - 1.0, 0.1, 20.0))


def sensitivity_rows(known: Mapping[str, Case]) -> Iterator[Row]:
    """Find the largest change of the tip's height, until 1.2 s and over the run, of beams that differ a little."""
    for name, case in known.items():
        times, given = np.append(0.0, case.instants), dict(case.problem.parameters)
        changes: dict[str, dict[str, Any]] = {MESH: {"n_elements": 8}}
        for what, key in zip(PARAMETERS, ("youngs_modulus", "gravity"), strict=True):
            changes[what] = {key: 1.001 * given[key]}
        tip = _tip(given, TOL[name], times)
        for what, change in changes.items():
            off = np.abs(_tip({**given, **change}, TOL[name], times) - tip)
            row: Row = {"group": "sensitivity", "case": name, "solver": what, "t_end": case.t_end}
            yield row | {"before": float(off[times <= PARTING].max()), "largest": float(off.max())}


def _tip(parameters: dict[str, Any], tol: float, times: Array) -> Array:
    problem = ancf_beam(**parameters)
    start = problem.system, (0.0, float(times[-1])), problem.q0, problem.v0
    result = solve_dae(*start, method=METHOD, rtol=tol, atol=tol, t_eval=times)
    if not result.success:
        raise RuntimeError(f"a changed beam, {parameters}: {result.message}")
    return np.asarray(tip_height(result.q))


PAPER_SECONDS = {SOFT: 56.27, STIFF: 6278.54}  # the computation times that the paper gives
PAPER_STEPS = {SOFT: 1e-3, STIFF: 1e-5}  # s, its step sizes by order of magnitude
OURS = ("auto", "auto, compiled", "TRBDF2", "ESDIRK4", "SunRadau5", "Gauss6", "BDF", "Adams", solvers.OWN_EXPLICIT)
# without Exudyn, whose beam is another model
OTHERS = (*(name for name in solvers.OTHER_SOLVERS if not name.startswith("Exudyn")), solvers.IDA_C_BANDED)
HALF_A_DECADE = 0.5  # of the printed step sizes, within which ours count as the same
TARGETS, TOLD = (1e-2, 1e-3, 1e-4), 1e-3  # m, errors of the tip's height; the report tells of the latter
LOOSE: tuple[float, ...] = (1e-1, 1e-2, 1e-3, 1e-4, 1e-5)  # tolerances, between and beyond which `adaptive` asks
OWN_VALUES = {  # of those that do not take these
    solvers.IRK: (1e-1, solvers.PAPER_TOL),  # its error is that of rounding from the loosest on
    **dict.fromkeys((solvers.NEWMARK, solvers.QUARTER), (1e-3, 1e-4, 1e-5, 1e-6, 1e-7, 1e-8, 1e-9)),
}
LIMIT = 3.0  # s of CPU of a run of others, as in `work_precision`
# IDA takes seconds to compile, Gauss6 tens of thousands of steps
QUICK = (solvers.IRK, *solvers.RADAU[:2], "BDF", solvers.OWN_EXPLICIT)
QUICK_TOLERANCES = (1e-1, 1e-3)
DRAWN = (solvers.DEFAULT, solvers.NEWMARK, "TRBDF2", solvers.IDA_C_ORDER_2, solvers.CYRK)  # beside PaperIRK


def line_up() -> dict[str, Solver]:
    """Return the solvers by name."""
    names = (solvers.NEWMARK, solvers.QUARTER, *solvers.RADAU, *OURS, *OTHERS)
    irk = replace(solvers.CATALOGUE[solvers.IRK_LINE], name=solvers.IRK)
    return {irk.name: irk} | {name: solvers.CATALOGUE[name] for name in names}


def runs(known: dict[str, Case], quick: bool) -> Iterator[Run]:
    """List the solvers at their settings on both beams."""
    for case, (name, solver) in product(known.values(), line_up().items()):
        values = OWN_VALUES.get(name, case.steps() if solver.setting == "h" else LOOSE)
        if quick:
            values = () if name not in QUICK else (solvers.PAPER_TOL,) if name == solvers.IRK else QUICK_TOLERANCES
        at = case if solver.family == "two-loop" else replace(case, time_limit=LIMIT)
        yield from (Run(at, solver, value, "run", 1 if quick else REPEATS) for value in values)


def make(output: Output) -> pd.DataFrame:
    """Make the rows of these runs, and of those between them; twoloop's methods are run however slow."""
    quick = output.call.quick
    known = {name: case_of(name, name, quick) for name in (SOFT, STIFF)}

    def row(run: Run, repeat: int, built: Warm) -> Row:
        measured = row_of(run, repeat, measure, built)
        return measured | {"error_q": measured.get("error_tip")}

    with output.kept() as kept:
        listed, errors = list(runs(known, quick)), () if quick else TARGETS
        rows = adaptive.collect(listed, kept, row, adaptive.is_ours, errors, adaptive.is_ours)
    # the limit in theory, and the largest frequency w_max of the very flexible beam
    limit: Row = {"group": "limit", "solver": GAUSS_SEIDEL, "w_max": float(frequencies(very_flexible_beam())[-1])}
    limit["theory"] = gauss_seidel_limit(sun_radau_iib(3))
    return pd.concat([rows, pd.DataFrame([limit, *sensitivity_rows(known)])], ignore_index=True)


def measure(run: Run, result: Result) -> dict[str, Any]:
    """Measure the error of the tip's height, by which solvers are compared, and the steps."""
    case, error = run.case, None
    if result.success:
        error = float(np.abs(tip_height(deviation(result, case.reference, case.instants)[0])).max())
    span = float(np.ptp(tip_height(case.reference.states(case.instants)[0])))
    row = {"error_tip": error, "astray": error is None or error > ASTRAY * span}
    return row | {"h_median": float(np.median(result.h)) if result.h.size else None}


def _case(rows: pd.DataFrame, name: str) -> dict[str, Any]:
    own = tables.where(rows, case=name, group="run")
    irk = tables.where(own, solver=solvers.IRK)
    paper, changed = tables.where(irk, tol=solvers.PAPER_TOL), tables.where(rows, case=name, solver=MESH)
    if paper.empty or changed.empty:
        raise StudyError("the rows lack PaperIRK or changed beams; run python -m studies.reproduction beam")
    found: dict[str, Any] = {key: float(paper[key].iloc[0]) for key in ("call_s", "h_median", "floor")}
    found |= {"name": name, "printed_s": PAPER_SECONDS[name], "printed_h": PAPER_STEPS[name]}
    found["steps_as_printed"] = bool(abs(np.log10(found["h_median"] / found["printed_h"])) < HALF_A_DECADE)
    sides = tables.of_both(tables.ranking(own, TOLD))
    found["at"] = {"error": TOLD, **sides, "paper_s": tables.as_good(irk, TOLD)}
    fastest = min((side["call_s"] for side in sides.values() if side), default=np.nan)
    found |= {"mesh": float(changed["largest"].iloc[0]), "paper_over_fastest": found["at"]["paper_s"] / fastest}
    return found


def findings_of(rows: pd.DataFrame) -> dict[str, Any]:
    cases = soft, stiff = [_case(rows, name) for name in (SOFT, STIFF)]
    return {"cases": cases} | {f"growth_{key}": stiff[key] / soft[key] for key in ("call_s", "printed_s")}


def figure_of(rows: pd.DataFrame, found: dict[str, Any]) -> Figure:
    """Draw CPU time over the error of the tip's height, a panel a beam."""
    figure, panels = plt.subplots(1, 2, figsize=(9.2, 3.8), sharey=True, layout="constrained")
    for panel, name in zip(panels, (SOFT, STIFF), strict=True):
        own = tables.where(rows, case=name, group="run")
        for solver in DRAWN:
            along = figures.line_of(tables.where(own, solver=solver))
            if len(along):
                panel.plot(along["error_q"], along["call_s"], **figures.look(along.iloc[0], coded=False))
        paper = tables.where(own, solver=solvers.IRK)  # its errors are below that of the reference
        label = f"{solvers.IRK} (smaller errors)"
        panel.axhline(paper["call_s"].min(), color=figures.style(solvers.IRK)["color"], label=label)
        panel.set(xscale="log", yscale="log", xlabel="largest error of the tip's height (m)")
        panel.set_title(f"{name} beam", fontsize=9)
    panels[0].set_ylabel("CPU time (s)")
    least, most = sorted(case["paper_over_fastest"] for case in found["cases"])
    over = f"{number(least)} and {number(most)}"
    figures.message(figure, f"PaperIRK takes {over} times as long as the fastest solver within 1 mm", panels)
    return figure
