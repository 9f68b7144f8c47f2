"""Figs. 9-14 of the paper: the flexible beam on a moving base, very flexible and moderately stiff."""

from collections.abc import Iterator
from dataclasses import replace
from itertools import product
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from studies.bench import adaptive, figures, solvers, tables
from studies.bench.cases import beam
from studies.bench.cases.beam import SOFT, STIFF
from studies.bench.cli import StudyError
from studies.bench.collector import REPEATS, Case, Run, Solver, Warm, row_of
from studies.bench.metrics import ASTRAY, deviation
from studies.bench.render import number
from studies.bench.store import Output, Row
from studies.reproduction.beam_limits import MESH, limit_rows, sensitivity_rows
from twoloop import Result
from twoloop.mechanisms.ancf_beam import tip_height

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


def cases(quick: bool) -> dict[str, Case]:
    """Return both beams by name."""
    return {name: beam.case(name, name, quick) for name in (SOFT, STIFF)}


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
    known = cases(quick)

    def row(run: Run, repeat: int, built: Warm) -> Row:
        measured = row_of(run, repeat, measure, built)
        return measured | {"error_q": measured.get("error_tip")}

    with output.kept() as kept:
        listed, errors = list(runs(known, quick)), () if quick else TARGETS
        rows = adaptive.collect(listed, kept, row, adaptive.is_ours, errors, adaptive.is_ours)
    return pd.concat([rows, pd.DataFrame([*limit_rows(), *sensitivity_rows(known)])], ignore_index=True)


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
    figures.message(figure, f"PaperIRK takes {over} times as long as the fastest solver within 1 mm")
    figures.label_lines(panels)
    return figure
