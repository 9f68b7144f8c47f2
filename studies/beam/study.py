"""The beam study from its runs to its report."""

import itertools
from typing import Any

import pandas as pd
from matplotlib.figure import Figure

import studies.beam as package
from studies.beam.findings import findings_of
from studies.beam.limits import along_rows, limit_rows
from studies.beam.runs import DIFFERENCES, EXUDYN, NEWTON, PAPER, TARGETS, by_tip, cases, collected, runs
from studies.beam.sensitivity import sensitivity_rows
from studies.bench import figures, tables
from studies.bench.render import number, table
from studies.bench.solvers import IDA_C, IDA_C_ORDER_2, NEWMARK, OWN_EXPLICIT, QUARTER
from studies.bench.store import Output
from studies.bench.study import Study

ERROR = "largest error of the tip's height over the run (m)"
LISTED = (  # the CSV has all
    *(PAPER, NEWMARK, QUARTER, NEWTON, DIFFERENCES, OWN_EXPLICIT, IDA_C, IDA_C_ORDER_2),
)


def make(output: Output) -> pd.DataFrame:
    """Make all rows."""
    quick = output.call.quick
    known = cases(quick)
    with output.kept() as kept:
        rows = collected(runs(known, quick), kept, quick)
        more = [*limit_rows(), *along_rows(known, quick), *sensitivity_rows(known)]
    return pd.concat([rows, pd.DataFrame(more)], ignore_index=True)


def drawn(runs_: pd.DataFrame) -> list[str]:
    """The lines of the figure: not Exudyn's, whose cable is another, nor those by differences."""
    return figures.lines_of(runs_[~runs_["solver"].isin((EXUDYN, DIFFERENCES))], TARGETS)


def tables_of(rows: pd.DataFrame, found: dict[str, Any]) -> dict[str, str]:
    """CPU time of each solver for each target, the beams side by side."""
    runs_, names = by_tip(rows), [case["name"] for case in found["cases"]]
    costs = [
        {line[0]: line[1:] for line in tables.work_precision(runs_[runs_["case"] == name], TARGETS, LISTED)}
        for name in names
    ]
    shown = [solver for solver in LISTED if any(solver in cost for cost in costs)]
    nothing = ["", *["–"] * len(TARGETS)]
    lines = [[solver, *(cell for cost in costs for cell in cost.get(solver, nothing)[1:])] for solver in shown]
    errors = [f"{beam}, {1e3 * target:g} mm" for beam in ("flexible", "stiff") for target in TARGETS]
    return {"cost": table(["solver", *errors], lines)}


def figures_of(rows: pd.DataFrame, found: dict[str, Any]) -> dict[str, Figure]:
    """Cost over error, a figure a beam."""
    made, runs_ = {}, by_tip(rows)
    for case in found["cases"]:
        own = runs_[runs_["case"] == case["name"]]
        title = f"{case['name']} beam, {number(case['t_end'])} s"
        plot = figures.work_precision(own, drawn(own), title, ERROR)
        for axes, target in itertools.product(plot.axes, TARGETS):
            axes.axvline(target, color="0.6", linestyle=":", linewidth=1.0, zorder=0)
        made[case["figure"].removesuffix(".png")] = plot
    return made


STUDY = Study("beam", package.__doc__, make, findings_of, figures_of, tables_of, medians=True)
main = STUDY.main
