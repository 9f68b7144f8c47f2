"""The runs of the beam study: solvers, settings, and the tip's error by which they are judged."""

from collections.abc import Iterator
from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np
import pandas as pd

from studies.bench import adaptive
from studies.bench.cases import beam
from studies.bench.cases.beam import SOFT, STIFF
from studies.bench.collector import REPEATS, Array, Case, Run, Solver, Warm, row_of
from studies.bench.metrics import ASTRAY, deviation
from studies.bench.solvers import (
    CATALOGUE,
    IDA_C_BANDED,
    IRK,
    IRK_LINE,
    NEWMARK,
    OWN_EXPLICIT,
    PAPER_TOL,
    QUARTER,
    RADAU,
    OTHER_SOLVERS,
)
from studies.bench.store import KeptRows, Row
from twoloop import ConstrainedSystem, Result, solve_dae
from twoloop.mechanisms import Problem
from twoloop.mechanisms.ancf_beam import tip_height

PAPER = IRK
NEWTON, DIFFERENCES = "RadauIIA5", "RadauIIA5, by differences"
EXUDYN = "Exudyn, GeneralizedAlpha, its own cable"
OURS = ("auto", "auto, compiled", "TRBDF2", "ESDIRK4", "SunRadau5", "Gauss6", "BDF", "Adams", OWN_EXPLICIT)
OTHERS = (*(name for name in OTHER_SOLVERS if not name.startswith("Exudyn")), IDA_C_BANDED)  # Exudyn's cable is another

TARGETS = (1e-2, 1e-3, 1e-4)  # m, of the tip's height
LOOSE = (1e-1, 1e-2, 1e-3, 1e-4, 1e-5)  # tolerances, between and beyond which `adaptive` asks
OWN_VALUES = {  # of those that do not take these
    PAPER: (1e-1, PAPER_TOL),  # its error is that of rounding from the loosest on
    **dict.fromkeys((NEWMARK, QUARTER), (1e-3, 1e-4, 1e-5, 1e-6, 1e-7, 1e-8, 1e-9)),
}
LIMIT = 3.0  # s of CPU of a run of others, as in `work_precision`
EXUDYN_STEPS = (1000, 2000, 5000, 10_000, 20_000, 50_000)
EXUDYN_FINE = (100_000, 200_000)  # of the motion against which Exudyn is judged: its own
INSTANTS = 1000
QUICK = (PAPER, *RADAU[:2], "BDF", OWN_EXPLICIT)  # IDA takes seconds to compile, Gauss6 tens of thousands of steps
QUICK_TOLERANCES = (1e-1, 1e-3)


def without_tangent(problem: Problem) -> ConstrainedSystem:
    """The same system without the tangent of its force and the bandwidth of its matrices."""
    system = problem.system
    tangents = {"force_by_q", "force_by_v", "reaction_by_q"}
    f = {kind: function for kind, function in system.given.items() if kind not in tangents}
    sizes = {"n_q": system.n_q, "n_c": system.n_c, "parameters": system.parameters}
    return ConstrainedSystem(**sizes, **f, constant_mass=True, name=problem.name)  # type: ignore[arg-type]


def _exudyn(case: Case, step: float, repeat: int) -> Result:
    from references.exudyn.beam import solve_exudyn_beam

    n_steps = round(case.t_end / step)
    return solve_exudyn_beam(case.problem, case.t_end, n_steps, store_every=max(1, n_steps // INSTANTS))


def solvers() -> dict[str, Solver]:
    """The line-up by name: the catalogue's, and those that only this study has."""

    def differenced(case: Case, tol: float, repeat: int) -> Result:
        return solve_dae(without_tangent(case.problem), *case.start[1:], NEWTON, tol, tol)

    made: list[Solver] = [replace(CATALOGUE[IRK_LINE], name=PAPER)]
    made += [CATALOGUE[name] for name in (NEWMARK, QUARTER, *RADAU)]
    made.append(Solver(DIFFERENCES, "two-loop", "compiled", True, "tol", differenced))
    made += [CATALOGUE[name] for name in (*OURS, *OTHERS)]
    made.append(Solver(EXUDYN, "Exudyn", "compiled, base in Python", True, "h", _exudyn))
    return {solver.name: solver for solver in made}


def cases(quick: bool) -> dict[str, Case]:
    """Both beams by their names in this study."""
    return {name: beam.case(name, name, quick) for name in (SOFT, STIFF)}


def runs(known: dict[str, Case], quick: bool) -> Iterator[Run]:
    """The cells: a solver at one setting on one beam."""
    for case in known.values():
        steps = tuple(case.t_end / n for n in EXUDYN_STEPS)
        for name, solver in solvers().items():
            if quick and name not in QUICK:
                continue
            values = steps if name == EXUDYN else case.steps() if solver.setting == "h" else LOOSE
            values = OWN_VALUES.get(name, values)
            if quick:
                values = (PAPER_TOL,) if name == PAPER else QUICK_TOLERANCES
            repeats = 1 if quick or name == EXUDYN else REPEATS
            at = case if solver.family in ("two-loop", "Exudyn") else replace(case, time_limit=LIMIT)
            yield from (Run(at, solver, value, "run", repeats) for value in values)


def collected(todo: Iterator[Run], kept: KeptRows, quick: bool) -> pd.DataFrame:
    """Rows of these runs and of those that leave no decade of the tip's error out; ours are asked however slow."""

    def make(run: Run, repeat: int, built: Warm) -> Row:
        row = row_of(run, repeat, measure, built)
        return row | {"error_all": row.get("error_q"), "error_q": row.get("error_tip")}

    chosen, errors = list(todo), () if quick else TARGETS
    own, asked = ([run for run in chosen if (run.solver.name == EXUDYN) is which] for which in (True, False))
    rows = adaptive.collect(asked, kept, make, adaptive.is_ours, errors, adaptive.is_ours)
    return pd.concat([rows, adaptive.collect(own, kept, make, lambda run: True)], ignore_index=True)


@lru_cache
def _exudyn_motion(kind: str, t_end: float) -> tuple[Array, float]:
    """Exudyn's own tip at the common instants in fine steps, and how far it is from that in half as many."""
    from references.exudyn.beam import solve_exudyn_beam

    coarse, fine = (
        tip_height(solve_exudyn_beam(beam.MAKE[kind](), t_end, n, store_every=n // INSTANTS).q) for n in EXUDYN_FINE
    )
    return np.asarray(fine), float(np.abs(fine - coarse).max())


def measure(run: Run, result: Result) -> dict[str, Any]:
    """Columns of this study: the error of the tip's height, by which all is ranked, and the steps taken."""
    case, h = run.case, result.h
    row: dict[str, Any] = {"n_rejected_convergence": result.stats.n_rejected_convergence, "error_tip": None}
    row["h_median"] = float(np.median(h)) if h.size else None
    if run.solver.name == EXUDYN:
        tip, row["floor"] = _exudyn_motion(case.name, case.t_end)
    if result.success:
        own = run.solver.name == EXUDYN
        off = tip_height(result.q) - tip if own else tip_height(deviation(result, case.reference, case.instants)[0])
        row["error_tip"] = float(np.abs(off).max())
    span = float(np.ptp(tip_height(case.reference.states(case.instants)[0])))
    row["astray"] = row["error_tip"] is None or row["error_tip"] > ASTRAY * span
    return row


def by_tip(rows: pd.DataFrame) -> pd.DataFrame:
    """The runs among the rows, whose error is that of the tip."""
    return rows[rows["group"] == "run"]
