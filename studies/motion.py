"""Figs. 2-5 of the paper: the height of bar 3's centre by every solver, over 2 s and 100 s, with its error."""

from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from references.four_bar_minimal import MinimalFourBar
from references.gear import STARTS
from studies import motion_figures, study, tables
from studies.bench import Case, Run, collect
from studies.cases import four_bar
from studies.cases.four_bar import Y3
from studies.cli import StudyError
from studies.metrics import ASTRAY, LOST, deviation
from studies.motion_figures import DRAWN, GRID_LAST, GRID_SHORT, SHORT
from studies.render import number, power, render, table
from studies.solvers import CANONICAL, CATALOGUE, EXUDYN, GEAR_ORDERS, IRK, LINE_UP, NEWMARK, gear
from studies.store import Output
from twoloop import Result

Array = NDArray[np.floating]

VISIBLE = 0.01  # m, about the width of a line in a figure of the motion
PASSES = 1e-3  # m above 0 from which y3 passes the line, and below it to which it reaches it
STEPS = (0.02, 0.01, 0.005, 0.002, 0.001)
SMALL = 0.005  # s; at steps no longer the sign of the energy error is looked at
FINE = 0.002  # s, at which y3 and its error are looked at, between the steps as well
GRID_LOG = 80  # points of a curve over the logarithm of time


def runs(case: Case, quick: bool) -> list[Run]:
    """Every solver at one sensible setting; then the solvers of fixed step at several steps."""
    line_up = [CATALOGUE[name] for name in LINE_UP]
    if quick:
        line_up = [solver for solver in line_up if solver.family in ("two-loop", "Exudyn")]
    made = [Run(case, solver, LINE_UP[solver.name], "line-up", 1) for solver in line_up]
    for order in (2, 5) if quick else GEAR_ORDERS:
        for start in STARTS if order > 1 else ("accurate",):  # of order 1 there is nothing to start
            steps = (*STEPS, 5e-4) if order <= 3 and start == "accurate" else STEPS
            solver = CATALOGUE[gear(order, start)]
            made += [Run(case, solver, step, "GSTIFF stand-in", 1) for step in (STEPS[:3] if quick else steps)]
    for name in EXUDYN:
        solver = CATALOGUE[f"Exudyn, {name}"]
        made += [Run(case, solver, step, "Exudyn", 1) for step in (STEPS[1:2] if quick else STEPS[:-1])]
    return made


def measure(period: float, run: Run, result: Result) -> dict[str, Any]:
    """Columns of this study, and the curves of the figures in the entry "series"; the period of the motion is in s."""
    row: dict[str, Any] = dict.fromkeys(("error_y3", "error_y3_short", "error_q_short", "energy_short"))
    row |= {"top": None, "top_late": None, "growth": None, "good_until": 0.0, "series": {}}
    row |= {"kinetic": run.case.scale.kinetic, "range_y3": run.case.scale.ranges[Y3]}
    if result.t.size < 2:
        return row
    problem, motion = run.case.problem, run.case.reference
    t = np.arange(1, round(run.case.t_end / FINE) + 1) * FINE
    t = t[t <= result.t[-1] * (1.0 + 1e-9)]
    if t.size == 0:
        return row
    off = deviation(result, motion, t)[0]
    # the true height and the interpolated deviation: no height is invented by interpolating the motion itself
    y3 = motion.states(t)[0][Y3] + off[Y3]
    worst = np.maximum.accumulate(np.abs(off[Y3]))
    early, stored = t <= SHORT * (1.0 + 1e-9), result.t <= SHORT * (1.0 + 1e-9)
    states = (result.t[stored], result.q[:, stored], result.v[:, stored])
    drift = problem.energy(*states) - problem.energy(0.0, problem.q0, problem.v0)
    row["error_y3_short"], row["error_q_short"] = worst[early][-1], np.abs(off[:, early]).max()
    row["energy_short"] = drift[np.abs(drift).argmax()]
    row["good_until"] = t[-1] if worst[-1] <= VISIBLE else t[np.argmax(worst > VISIBLE)]
    if result.success:
        row["error_y3"] = worst[-1]
        row["growth"] = np.log10(worst[-1] / worst[np.searchsorted(t, 0.1 * t[-1])])
        row["top"] = max(y3.max(), problem.q0[Y3])
        row["top_late"] = y3[t >= t[-1] - 1.5 * period].max()
    row["series"]["log"] = _at(t, worst, np.geomspace(0.1, run.case.t_end, GRID_LOG))
    if (run.solver.name, run.value if run.solver.setting == "h" else None) in DRAWN:
        row["series"] |= {"short": _at(t, y3, GRID_SHORT), "short_error": _at(t, worst, GRID_SHORT)}
        row["series"]["last"] = _at(t, y3, run.case.t_end + GRID_LAST)
    return row


def _at(t: Array, values: Array, times: Array) -> Array:
    """Values at times, linearly; NaN after the end of the run."""
    return np.where(times <= t[-1] * (1.0 + 1e-9), np.interp(times, t, values), np.nan)


def make(output: Output) -> tuple[pd.DataFrame, dict[str, Array]]:
    """Make all rows, and the curves of the figures."""
    quick = output.call.quick
    told = four_bar.cases(quick)[0]
    case = four_bar.case(told.problem, told.name, told.t_end, timed=0.0)  # times are not compared here
    period = MinimalFourBar.from_parameters(case.problem.parameters).period
    with output.kept() as kept:
        rows = collect(runs(case, quick), kept, partial(measure, period))
    series: dict[str, Array] = {}
    for _, row in rows.iterrows():
        curves = row["series"] if isinstance(row["series"], dict) else {}
        series |= {motion_figures.key(row, name): np.array(y, dtype=float) for name, y in curves.items()}
    series["log"] = np.geomspace(0.1, case.t_end, GRID_LOG)
    series["truth short"] = case.reference.states(GRID_SHORT)[0][Y3]
    series["truth last"] = case.reference.states(case.t_end + GRID_LAST)[0][Y3]
    return rows.drop(columns="series"), series


def find(rows: pd.DataFrame, group: str, solver: str, step: float | None = None) -> pd.Series | None:
    """The row of a solver, at a step if it has a fixed one."""
    found = rows[(rows["group"] == group) & (rows["solver"] == solver)]
    found = found if step is None else found[found["h"] == step]
    return None if found.empty else found.iloc[0]


def needed(rows: pd.DataFrame, solver: str, target: float = VISIBLE) -> float | None:
    """Largest step for which y3 stays within the target over the run, on the log-log line between two runs."""
    known = rows[(rows["solver"] == solver) & rows["error_y3"].notna()].drop_duplicates("h").sort_values("h")
    steps, errors = known["h"].to_numpy(float), known["error_y3"].to_numpy(float)
    good = np.flatnonzero(errors <= target)
    if good.size == 0:
        return None
    k = good[-1]
    if k == len(steps) - 1:
        return float(steps[k])
    share = np.log(target / errors[k]) / np.log(errors[k + 1] / errors[k])
    return float(steps[k] * (steps[k + 1] / steps[k]) ** share)


def _stand_in(rows: pd.DataFrame) -> dict[str, Any]:
    """What is said of the stand-in for ADAMS GSTIFF, by order."""
    of: dict[float, dict[int, pd.Series]] = {}
    for step in (0.02, 0.01):
        found = {order: find(rows, "GSTIFF stand-in", gear(order), step) for order in GEAR_ORDERS}
        of[step] = {order: row for order, row in found.items() if row is not None}

    def off(step: float, what: str) -> list[str]:
        return [f"{order}" for order, row in of[step].items() if not row[what] <= VISIBLE]

    signs = {}
    for order in GEAR_ORDERS:
        small = rows[(rows["solver"] == gear(order)) & (rows["h"] <= SMALL) & rows["energy"].notna()]
        signs[order] = set(np.sign(small["energy"].astype(float)))
    both = [
        {"order": order, "from": of[0.01][order]["error_y3_short"], "to": of[0.02][order]["error_y3_short"]}
        for order in of[0.01].keys() & of[0.02].keys()
        if of[0.01][order]["error_y3_short"] <= VISIBLE < of[0.02][order]["error_y3_short"]
    ]
    return {
        "n": len(of[0.02]),
        "off_long_step": off(0.02, "error_y3_short"),
        "off_short_step": off(0.01, "error_y3_short"),
        "both": sorted(both, key=lambda one: one["order"]),
        "wrong": off(0.01, "error_y3"),
        "n_long": len(of[0.01]),
        "losing": [f"{order}" for order, sign in signs.items() if sign == {-1.0}],
        "gaining": [f"{order}" for order, sign in signs.items() if sign == {1.0}],
        "tried": [f"{order}" for order, sign in signs.items() if sign],
    }


def findings_of(rows: pd.DataFrame) -> dict[str, Any]:
    """What the report says, from the medians."""
    line_up = rows[rows["group"] == "line-up"]
    both = [find(rows, "line-up", name) for name in (IRK, NEWMARK)]
    procedures = []
    for run in both:
        if run is None or pd.isna(run["error_y3"]):
            raise StudyError(
                "the rows lack runs of the paper's procedures; make them again by python -m studies.motion"
            )
        keys = ("error_y3_short", "error_y3", "top", "top_late", "growth")
        found = {"solver": run["solver"], **{key: float(run[key]) for key in keys}}
        found["holds"] = bool(run["top"] < PASSES and run["top_late"] > -PASSES)
        procedures.append(found)
    grown = line_up[line_up["growth"].notna() & (line_up["family"] == "two-loop")]
    canonical = grown[grown["solver"] == CANONICAL]["growth"]
    others = grown[grown["solver"] != CANONICAL]["growth"]
    late = rows[rows["status"] != "REACHED_END"]
    return {
        "t_end": float(rows["t_end"].iloc[0]),
        "problem": rows["problem"].iloc[0],
        "visible": VISIBLE,
        "passes": PASSES,
        "fine": FINE,
        "lost_limit": LOST,
        "astray_limit": ASTRAY,
        "kinetic": float(rows["kinetic"].max()),
        "range": float(rows["range_y3"].max()),
        "procedures": procedures,
        "procedures_hold": all(one["holds"] for one in procedures),
        "agree": all(one["error_y3_short"] <= VISIBLE for one in procedures),
        "agree_long": all(one["error_y3"] <= VISIBLE for one in procedures),
        "gear": _stand_in(rows),
        "canonical_growth": None if canonical.empty else float(canonical.iloc[0]),
        "growth": [float(others.min()), float(others.max())] if len(others) else [],
        "small_step": SMALL,
        "n_failed": len(late),
    }


def line_up_table(rows: pd.DataFrame) -> str:
    """One line a solver at its setting of the line-up."""
    header = ["solver", "called from", "setting", "y3, 2 s (m)", "y3 (m)", "growth", "good until (s)"]
    header += ["top (m)", "top at the end (m)", "energy (J)", "evaluations"]
    keys = ("error_y3_short", "error_y3", "growth", "good_until", "top", "top_late", "energy", "n_evaluations")
    lines = []
    for _, row in rows[rows["group"] == "line-up"].iterrows():
        setting = next(f"{name} {power(row[name])}" for name in ("h", "err_out", "tol") if pd.notna(row.get(name)))
        mark = " ★" if row["lost"] else " †" if row["astray"] else ""
        lines.append([row["solver"] + mark, row["called_from"], setting, *(number(row[key]) for key in keys)])
    return table(header, lines)


def grid(rows: pd.DataFrame, group: str, names: Sequence[str], what: str) -> str:
    """Solvers of fixed step by step, what is visible in bold; the last column: the largest step that is good enough."""
    part = rows[rows["group"] == group]
    steps = sorted(part["h"].dropna().unique(), reverse=True)
    long = what == "error_y3"
    lines = []
    for name in names:
        found = [find(rows, group, name, step) for step in steps]
        if any(row is not None for row in found):
            largest = needed(part, name)
            last = [number(largest) if largest is not None else "none tried"] if long else []
            lines.append([name, *("not run" if row is None else _cell(row, what) for row in found), *last])
    header = ["largest error of y3 (m); h (s)", *(f"{step:g}" for step in steps)]
    return table(header + ([f"largest h for {VISIBLE:g} m (s)"] if long else []), lines)


def _cell(row: pd.Series, what: str) -> str:
    if pd.isna(row[what]):
        return str(row["status"]).lower().replace("_", " ")
    return f"**{number(row[what])}**" if row[what] > VISIBLE else number(row[what])


def report(output: Output, rows: pd.DataFrame, series: dict[str, Array], line: str) -> dict[str, Any]:
    """Write findings, figures and report; the findings."""
    rows = tables.medians(rows)
    found = findings_of(rows)
    output.save_findings(found)
    motion_figures.draw(output, rows, series, VISIBLE)
    stand_ins = [gear(order, start) for order in GEAR_ORDERS for start in STARTS]
    exudyn = [f"Exudyn, {name}" for name in EXUDYN]
    ready = {
        "short": grid(rows, "GSTIFF stand-in", stand_ins, "error_y3_short"),
        "long": grid(rows, "GSTIFF stand-in", stand_ins, "error_y3"),
        "exudyn": grid(rows, "Exudyn", exudyn, "error_y3"),
        "line_up": line_up_table(rows),
        "failed": table(["solver", "setting", "status", "message"], tables.failures(rows)),
    }
    output.write("motion.md", render("motion", found, ready, stamp=line, quick=output.call.quick))
    return found


def main(words: Sequence[str] | None = None) -> None:
    """Run the study and write its report."""
    study.run("motion", __doc__, words, make, report)


if __name__ == "__main__":
    main()
