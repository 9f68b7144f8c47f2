"""Table 3 of the paper: computation time of both two-loop procedures over their tolerances, beside IDA and Exudyn."""

from dataclasses import replace
from functools import partial
from itertools import product
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator

from studies.bench import figures, four_bar, tables
from studies.bench.cli import StudyError
from studies.bench.collector import Case, Run, collect
from studies.bench.metrics import ASTRAY, LOST
from studies.bench.render import number, power, table
from studies.bench.solvers import CATALOGUE, ERR_IN, ERR_OUT, GIVEN, IDA_C, IRK, NEWMARK, paper_irk_at, paper_newmark_at
from studies.bench.store import Array, Output
from studies.bench.study import Study
from studies.bench.tables import where

Geometry = tuple[tuple[float, float, float], float]  # lengths of the bars and distance of the ground joints, m

TOLERANCES = ERR_OUT  # of err_in, too
FAMILIES = {"Table 3: IRK": IRK, "Table 3: Newmark": NEWMARK}
# Table 3 as printed: [err_in][err_out] in seconds; None is the star, "no reasonable result in long time simulation"
PAPER_IRK = ((1.95, 1.98, 2.00, 2.08), (2.12, 2.23, 2.31, 2.31), (2.64, 2.85, 2.85, 2.99), (3.37, 3.46, 3.55, 3.60))
PAPER_NEWMARK = (
    (None, 2.71, 12.62, 49.73),
    (None, 2.74, 12.36, 49.68),
    (None, 3.10, 12.68, 49.66),
    (None, 3.09, 13.40, 50.93),
)
PRINTED: dict[str, tuple[tuple[float | None, ...], ...]] = dict(zip(FAMILIES, (PAPER_IRK, PAPER_NEWMARK), strict=True))
PRINTED_RATIO = float(PAPER_NEWMARK[3][3] or 0.0) / PAPER_IRK[3][3]  # 50.93 s over 3.60 s
PAPER_END = 100.0  # s, of the paper's runs
REPEATS = 3  # the times of a cell differ by a few per cent; an odd number has a middle one
BESIDE = {  # solver and settings, loose to tight: tolerances, or steps in s of Exudyn, whose run at 1e-4 s takes 10 s
    GIVEN: (1e-4, 1e-6, 1e-8),
    IDA_C: (1e-4, 1e-6, 1e-8, 1e-10),
    "Exudyn, GeneralizedAlpha": (1e-2, 4e-3, 1e-3),
    "Exudyn, TrapezoidalIndex2": (1e-2, 4e-3, 1e-3),
}


def machine(rows: pd.DataFrame, group: str, err_in: float, err_out: float) -> pd.Series | None:
    """Return the run of a cell."""
    found = where(rows, group=group, err_in=err_in, err_out=err_out)
    return None if found.empty else found.iloc[0]


def least(run: pd.Series) -> float:
    """Return the least time of the repetitions of a run, the one that other processes have prolonged least."""
    times = run.get("times")
    return float(min(times) if isinstance(times, tuple) and times else run["call_s"])


def cell_runs(case: Case, repeats: int) -> list[Run]:
    """List the 32 cells."""
    procedures = zip(FAMILIES, (paper_irk_at, paper_newmark_at), strict=True)
    grid = product(procedures, TOLERANCES, TOLERANCES)
    return [Run(case, at(e_in), e_out, group, repeats) for (group, at), e_in, e_out in grid]


def runs(case: Case, quick: bool) -> list[Run]:
    """List the cells and the solvers beside them, of which the default, with the shortest times, is repeated."""
    repeats = 1 if quick else REPEATS
    made = cell_runs(case, repeats)
    for name, values in BESIDE.items():
        each = repeats if name == GIVEN else 1
        made += [Run(case, CATALOGUE[name], value, "beside", each) for value in (values[:1] if quick else values)]
    return made


def make(output: Output, geometry: Geometry | None = None) -> pd.DataFrame:
    """Make all rows, of the assumed geometry or of another."""
    try:
        case = (
            four_bar.cases(output.call.quick)[0] if geometry is None else four_bar.case_of(*geometry, output.call.quick)
        )
        _ = case.reference
    except ValueError as error:
        raise StudyError(f"no run with these lengths: {error}") from None
    # the calls of a cell are long enough to be timed one by one
    with output.kept() as kept:
        rows = collect(output.call.wanted(runs(replace(case, timed=0.0), output.call.quick)), kept)
    return rows.assign(assumed=geometry is None)


def ratios(rows: pd.DataFrame, group: str) -> Array:
    """Return the paper's time over our least, err_in by err_out; NaN where either has no result that is of use."""
    found = np.array(PRINTED[group], dtype=float)
    for (i, e_in), (j, e_out) in product(enumerate(TOLERANCES), repeat=2):
        run = machine(rows, group, e_in, e_out)
        found[i, j] /= np.nan if run is None or run["lost"] else least(run)
    return found


def findings_of(rows: pd.DataFrame) -> dict[str, Any]:
    """Compute what the report says."""
    irk, newmark = (machine(rows, group, ERR_IN, ERR_IN) for group in FAMILIES)
    if irk is None or newmark is None:
        raise StudyError("the rows lack cells of Table 3; make them again by python -m studies.table3")
    found: dict[str, Any] = {"t_end": float(rows["t_end"].iloc[0]), "assumed": bool(rows["assumed"].iloc[0])}
    for name, column in (("time_ratio", "call_s"), ("evaluation_ratio", "n_evaluations")):
        found[name] = newmark[column] / irk[column]
    for name, group in zip(("irk", "newmark"), FAMILIES, strict=True):
        over, cells = ratios(rows, group), rows[rows["group"] == group]
        kept = over[np.isfinite(over)]
        found[f"{name}_over"] = [float(kept.min()), float(kept.max())] if kept.size else []
        for what in ("lost", "astray"):
            which = sorted(cells[cells[what].astype(bool)]["err_out"].unique(), reverse=True)
            found[f"{name}_{what}"] = list(map(power, which))
    found["newmark_only_astray"] = [e for e in found["newmark_astray"] if e not in found["newmark_lost"]]
    found |= {"lost_limit": LOST, "astray_limit": ASTRAY, "failed": int((rows["status"] != "REACHED_END").sum())}
    answer = f"Newmark takes {number(found['time_ratio'])} times as long as Runge–Kutta at the tightest tolerances"
    if found["t_end"] == PAPER_END:
        answer = f"The pattern comes out in part, not the times: {answer}, in the paper {number(PRINTED_RATIO)} times."
    else:
        answer += f"; the paper's {number(PRINTED_RATIO)} is for {number(PAPER_END)} s."
    return found | {"answer": answer}


def grid(rows: pd.DataFrame, group: str, paper: bool) -> str:
    """Make a table of times in s, err_in by err_out: ours, or with `paper` those that are printed."""
    lines = []
    for e_in, own in zip(TOLERANCES, PRINTED[group], strict=True):
        ours = [machine(rows, group, e_in, e_out) for e_out in TOLERANCES]
        times = own if paper else [None if run is None else run["call_s"] for run in ours]
        lines.append([power(e_in), *(number(time, 4 if paper else 2) for time in times)])
    return table(["err_in \\ err_out", *map(power, TOLERANCES)], lines)


def beside(rows: pd.DataFrame) -> str:
    """Make a table of the solvers beside the procedures, with these at their tightest, from the largest error down."""
    own = rows[rows["group"].isin(FAMILIES) & (rows["err_in"] == ERR_IN) & (rows["err_out"] == ERR_IN)]
    chosen = pd.concat([own, rows[rows["group"] == "beside"]])
    lines = []
    for _, run in chosen.sort_values("error_q", ascending=False).iterrows():
        lines.append([run["solver"], tables.setting(run), number(run["call_s"]), number(run["error_q"])])
    return table(["solver", "setting", "CPU time (s)", "largest error (m, rad)"], lines)


def picture(rows: pd.DataFrame, found: dict[str, Any]) -> Figure:
    """Draw the paper's time over ours, of both procedures: one colour, were the machine all the difference."""
    known = {group: ratios(rows, group) for group in FAMILIES}
    every = np.concatenate([np.ravel(each) for each in known.values()])
    norm = LogNorm(np.nanmin(every), max(np.nanmax(every), 1.01 * np.nanmin(every)))
    figure, panels = plt.subplots(1, 2, figsize=(7.4, 3.4), sharey=True, layout="constrained")
    colours, labels = plt.get_cmap("viridis").with_extremes(bad="#e6e6e6"), [power(e) for e in TOLERANCES]
    for axes, (group, name) in zip(panels, FAMILIES.items(), strict=True):
        image = axes.imshow(known[group], norm=norm, cmap=colours)
        for (i, j), value in np.ndenumerate(known[group]):
            text, size = ("no result", 7) if np.isnan(value) else (number(value), None)
            color = "black" if np.isnan(value) or norm(value) >= 0.6 else "white"
            axes.text(j, i, text, ha="center", va="center", color=color, fontsize=size)
        places = range(len(TOLERANCES))
        axes.set(xticks=places, xticklabels=labels, yticks=places, yticklabels=labels, xlabel="err_out")
        axes.set_title(name, fontsize=9)
        axes.grid(False)
    panels[0].set_ylabel("err_in")
    ticks = LogLocator(subs=(1.0, 2.0, 3.0, 4.0, 6.0, 8.0))
    scale = figure.colorbar(image, ax=panels, shrink=0.8, ticks=ticks, format=lambda value, _: number(value))
    scale.set_label("paper's time / that of twoloop")
    least_, most = number(np.nanmin(every)), number(np.nanmax(every))
    figures.message(figure, f"The paper's times are {least_} to {most} times those of twoloop: not one factor")
    return figure


def figures_of(rows: pd.DataFrame, found: dict[str, Any]) -> dict[str, Figure]:
    """Draw the ratios of the times where runs are as long as the paper's."""
    return {"table3_ratios": picture(rows, found)} if found["t_end"] == PAPER_END else {}


def tables_of(rows: pd.DataFrame, found: dict[str, Any]) -> dict[str, str]:
    """Make the tables of the report, and print those of the times."""
    ready = {"beside": beside(rows)}
    for name, group in zip(("irk", "newmark"), FAMILIES, strict=True):
        ready |= {name: grid(rows, group, paper=False), f"{name}_paper": grid(rows, group, paper=True)}
        print(f"\n{group}, CPU time in s over {number(found['t_end'])} s\n{ready[name]}")
        if found["t_end"] == PAPER_END:
            print(f"as printed in the paper\n{ready[f'{name}_paper']}")
    print(f"\nbeside them\n{ready['beside']}")
    return ready


def study_of(geometry: Geometry | None = None) -> Study:
    """Return the study, with the geometry that is assumed or with another."""
    return Study("table3", __doc__, partial(make, geometry=geometry), findings_of, figures_of, tables_of, medians=True)
