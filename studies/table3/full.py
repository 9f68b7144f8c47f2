"""Table 3 at length: both two-loop procedures and other solvers at equal error, and why the times differ."""

from functools import partial
from itertools import chain
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from studies.bench import adaptive, figures, solvers, tables
from studies.bench.cases import four_bar
from studies.bench.cli import StudyError
from studies.bench.collector import REPEATS, Case, Run, Solver, Warm, collect, row_of
from studies.bench.headline import OWN_CODE
from studies.bench.render import number, power, table
from studies.bench.solvers import CATALOGUE, ERR_IN, IRK_LINE, NEWMARK, OWN_EXPLICIT, QUARTER
from studies.bench.store import Output, Row
from studies.bench.study import Study
from studies.table3.causes import UNEQUAL, causes, reading_runs
from studies.table3.cells import FAMILIES, cell_runs
from twoloop import Result, RungeKutta, solve_dae
from twoloop.methods.tableaux import gauss

TARGETS = (1e-2, 1e-4, 1e-6)
PAPER = (NEWMARK, QUARTER, IRK_LINE)
LOOPS = (1e-5, 1e-6, 1e-7, 1e-8, 1e-9, 1e-10)  # err_out of Newmark
EXPLICIT = (OWN_EXPLICIT, solvers.TAYLOR, solvers.ADAMS)  # all coordinates, projected: not the paper's procedure
# for seconds: no quick runs
COMPILED = (
    *(OWN_CODE, solvers.HEYOKA, solvers.CYRK, solvers.CVODE_C, solvers.IDA_INDEX_1, "IDA, stabilised"),
    *("LSODA, index 1", "DOP853, index 1", "DOP853, projected"),
)
OTHERS = (
    *(solvers.DEFAULT, "SunRadau5", "Gauss6", "Gauss12", "BDF", *EXPLICIT, solvers.IDA_C, *COMPILED),
    *("Exudyn, GeneralizedAlpha", "Exudyn, TrapezoidalIndex2"),
)
DRAWN = (OWN_CODE, NEWMARK, IRK_LINE, solvers.HEYOKA, solvers.CYRK, solvers.IDA_C)
STEP = 0.01  # s, of the runs that tell what a partition costs


def _fixed(partition: str, case: Case, step: float, repeat: int) -> Result:
    return solve_dae(*case.start, method=RungeKutta(gauss(1), partition=partition), step_size=step)  # type: ignore[arg-type]


def runs(first: Case, second: Case, quick: bool) -> list[Run]:
    """List the cells of the table, what a partition costs, both readings of (32), and the other solvers.

    On the second geometry only the paper's procedures: `studies.work_precision` has the others there.
    """
    made, repeats = reading_runs(first), 1 if quick else REPEATS
    made += cell_runs(first, repeats) + [run for run in cell_runs(second, 1) if run.solver.fixed["err_in"] == run.value]
    for partition in ("lasting", "symmetric"):
        solver = Solver(f"fixed step, {partition}", "two-loop", "compiled", True, "h", partial(_fixed, partition))
        made.append(Run(first, solver, STEP, "partition", 3 if quick else 9))  # they differ by little
    for case, names in ((first, (*PAPER, *OTHERS)), (second, () if quick else PAPER)):
        for solver in (CATALOGUE[name] for name in names if not (quick and name in COMPILED)):
            values = LOOPS if solver.name in (NEWMARK, QUARTER) else solver.grid(case)
            made += [Run(case, solver, x, "comparison", repeats) for x in (values[1:3] if quick else values)]
    return made


def make(output: Output) -> pd.DataFrame:
    """Make all rows, with the height of bar 3's centre, by which the paper judges energy."""

    def highest(run: Run, result: Result) -> dict[str, float]:
        return {"y3_max": float(result.q[four_bar.Y3].max()) if result.t.size else float("nan")}

    def row(run: Run, repeat: int, built: Warm) -> Row:
        return row_of(run, repeat, highest, built)

    quick = output.call.quick
    first, second = four_bar.cases(quick)
    todo, errors = output.call.wanted(runs(first, second, quick)), () if quick else TARGETS
    compared = [run for run in todo if run.group == "comparison"]
    with output.kept() as kept:
        rows = collect([run for run in todo if run.group != "comparison"], kept, highest)
        more = adaptive.collect(compared, kept, row, lambda run: True, errors, adaptive.is_ours)
    return pd.concat([rows, more], ignore_index=True)


def first_of(rows: pd.DataFrame) -> pd.DataFrame:
    """Select the rows of the first geometry."""
    return rows[rows["problem"] == rows["problem"].iloc[0]]


def findings_of(rows: pd.DataFrame) -> dict[str, Any]:
    """Compute what the report says, of the first geometry."""
    first = first_of(rows)
    same = tables.where(first, solver=NEWMARK, err_in=ERR_IN, err_out=ERR_IN)
    times = [time for own in same["times"] for time in own]  # of all its repetitions, in whatever group
    if not times:
        raise StudyError("the rows lack cells of Table 3; make them again by python -m studies.table3 --full")
    found: dict[str, Any] = {"t_end": float(first["t_end"].iloc[0]), "newmark_times": [min(times), max(times)]}
    found["times_unequal"] = max(times) > UNEQUAL * min(times)
    ratios = _newmark_over_irk(first)
    over = list(chain(*ratios.values()))
    found |= {"newmark_over_irk": [min(over), max(over)] if over else [], "newmark_errors": list(ratios)}
    found["cheapest"] = [line for error in TARGETS if (line := _cheapest(_compared(first), error)) is not None]
    dearer = [irk for each in found["cheapest"] if (irk := each["paper_times"])]
    found |= {"paper_times": [min(dearer), max(dearer)] if dearer else [], "explicit": _explicit(first)}
    failed = rows[rows["status"] != "REACHED_END"]
    found |= {"failed": len(failed), "failed_two_loop": int((failed["family"] == "two-loop").sum())}
    answer = "No error is reached by both the paper's Runge–Kutta procedure and another solver."
    if dearer:
        answer = "At equal error, the paper's Runge–Kutta procedure takes "
        answer += " to ".join(map(number, found["paper_times"])) + " times as long as the cheapest solver."
    return found | causes(first) | {"answer": answer}


def _cheapest(first: pd.DataFrame, error: float) -> dict[str, Any] | None:
    """Find the cheapest solver at an error, and how many times as long the paper's procedure takes."""
    ranked = tables.ranking(first, error)
    if ranked.empty:
        return None
    times = dict(zip(ranked["solver"], ranked["call_s"] / ranked["call_s"].iloc[0], strict=True))
    return {"error": error, "paper_times": times.get(IRK_LINE)} | (tables.best(ranked) or {})


def _newmark_over_irk(first: pd.DataFrame) -> dict[str, list[float]]:
    """CPU time of Newmark, with either beta, over that of Runge-Kutta, at errors that both reach or pass."""
    fine = _compared(first)
    found: dict[str, list[float]] = {}
    for target in (0.1, 0.03, 0.01, 0.003):  # a solution worse than these is of no use
        half, quarter, irk = (
            tables.time_for(runs_, target) if target <= runs_["error_q"].max() else np.nan
            for runs_ in (fine[fine["solver"] == solver] for solver in PAPER)
        )
        ratios = [float(newmark / irk) for newmark in (half, quarter) if not np.isnan(newmark / irk)]
        found |= {number(target): ratios} if ratios else {}
    return found


def _explicit(first: pd.DataFrame) -> list[float]:
    """Divide the time of the paper's Runge-Kutta procedure by that of the cheapest explicit method of `EXPLICIT`."""
    fine, over = _compared(first), []
    for error in TARGETS:
        paper, *explicit = (tables.time_for(fine[fine["solver"] == name], error) for name in (IRK_LINE, *EXPLICIT))
        over.append(float(paper / np.fmin.reduce(explicit)))  # of those that get there
    return [ratio for ratio in over if not np.isnan(ratio)]


def _compared(first: pd.DataFrame) -> pd.DataFrame:
    """The runs that are compared at equal error: of the cells of the table those with the finest inner loop."""
    fine = first["err_in"].isna() | (first["err_in"] == ERR_IN)
    return first[first["group"].isin(("comparison", *FAMILIES)) & fine]


def figures_of(rows: pd.DataFrame, found: dict[str, Any]) -> dict[str, Figure]:
    """Draw CPU time over error."""
    most = f"{' to '.join(map(number, found['paper_times']))} times" if found["paper_times"] else "more"
    title = f"The paper's Runge–Kutta procedure takes {most} the least time"
    return {"table3_full": figures.work_precision(_compared(first_of(rows)), DRAWN, title, coded=True)}


def tables_of(rows: pd.DataFrame, found: dict[str, Any]) -> dict[str, str]:
    """Make the table of the report."""
    lines = tables.work_precision(_compared(first_of(rows)), TARGETS, DRAWN, coded=True)
    return {"work": table(["solver", *map(power, TARGETS)], [[solver, *times] for solver, _, *times in lines])}


STUDY = Study("table3_full", __doc__, make, findings_of, figures_of, tables_of, medians=True)
