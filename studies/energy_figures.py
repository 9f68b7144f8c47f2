"""The figures of the energy study: cost over energy error, and energy error over time."""

from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from studies import figures
from studies.energy_drift import (
    BDF_LOOP,
    CALM,
    GAUSS,
    MOMENTA_LASTING,
    NEWMARK_QUARTER,
    ONE,
    PAPER_IRK,
    RADAU,
    SUN,
    SWITCHING,
    VELOCITIES_LASTING,
    VELOCITIES_SYMMETRIC,
    Variant,
    name_of,
)
from studies.energy_runs import LSODA, PROJECTED, TRAPEZOIDAL
from studies.render import number
from studies.solvers import IDA_C, OWN_EXPLICIT

Series = dict[str, NDArray[Any]]  # windows of the runs, "t" and "mean" with the place of the row

PRESETS = {SUN: "SunRadau5", GAUSS: "Gauss6", RADAU: "RadauIIA5", NEWMARK_QUARTER: "Newmark"}  # for their colours
DRAWN = (OWN_EXPLICIT, "Gauss12", IDA_C, LSODA, PROJECTED, TRAPEZOIDAL)


def _look(row: pd.Series) -> dict[str, Any]:
    name = PRESETS.get(row["solver"], row["solver"])
    return figures.style(name, row["family"], bool(row["keeps_constraints"]))


def time_figure(rows: pd.DataFrame, series: Series) -> Figure:
    """Mean energy error over time with fixed steps, on both geometries."""
    chosen: list[tuple[str, Variant, str]] = [
        (SUN, VELOCITIES_LASTING, "-"),
        (SUN, MOMENTA_LASTING, ":"),
        (GAUSS, VELOCITIES_LASTING, "-"),
        (GAUSS, MOMENTA_LASTING, ":"),
        (GAUSS, VELOCITIES_SYMMETRIC, "--"),
        (RADAU, VELOCITIES_LASTING, "-"),
        (NEWMARK_QUARTER, VELOCITIES_LASTING, "-"),
        (BDF_LOOP, VELOCITIES_LASTING, "-"),
    ]
    figure, panels = plt.subplots(1, 2, figsize=(10.5, 3.8), sharey=True, layout="constrained")
    entries = {}
    for axes, geometry in zip(panels, (ONE, SWITCHING), strict=True):
        fixed = rows[(rows["group"] == "fixed") & (rows["case"] == geometry)]
        for solver, variant, dash in chosen:
            run = fixed[(fixed["solver"] == solver) & (fixed["variables"] == variant[0])]
            run = run[run["partition"] == variant[1]]
            if run.empty or f"t{run.index[0]}" not in series:
                continue
            row, key = run.iloc[0], run.index[0]
            label = f"{name_of(row)}, h = {row['h']:g} s"
            look = _look(row) | {"linestyle": dash, "marker": ""}
            (entries[label],) = axes.plot(series[f"t{key}"], np.abs(series[f"mean{key}"]), **look)
        axes.set(xscale="log", yscale="log", xlabel="time (s)")
        axes.set_title(f"{geometry}: {rows[rows['case'] == geometry]['problem'].iloc[0]}", fontsize=9)
    panels[0].set_ylabel("|mean energy error of a window| (J)")
    figure.legend(entries.values(), entries.keys(), loc="outside right upper")
    return figure


def cost_figure(rows: pd.DataFrame) -> Figure:
    """Cost of the long run over its largest energy error, on the geometry whose partition changes."""
    long = rows[(rows["case"] == SWITCHING) & (rows["group"] != "order") & (rows["status"] == "REACHED_END")]
    long = long[~long["lost"].astype(bool)]
    figure, (left, right) = plt.subplots(1, 2, figsize=(9.2, 3.8), sharex=True, layout="constrained")
    lines: list[tuple[str, pd.DataFrame]] = [(name, long[long["solver"] == name]) for name in DRAWN]
    even = long[(long["solver"] == GAUSS) & (long["partition"] == "symmetric") & long["h"].notna()]
    lines.append(("Gauss(3), symmetric partition, fixed steps", even[even["variables"] == "velocities"]))
    lines.append((PAPER_IRK, long[long["solver"] == PAPER_IRK]))
    for label, points in lines:
        if points.empty:
            continue
        points = points.assign(energy=points["energy"].abs()).sort_values("energy")
        called = "P" if points["called_from"].iloc[0] == "Python" else "c"
        _points(left, points, "cpu_s", f"{label} [{called}]")
        counted = points[points["n_evaluations"].notna()]
        if len(counted):
            _points(right, counted, "n_evaluations", "")
    for axes, what in ((left, f"CPU time for {number(long['t_end'].iloc[0])} s (s)"), (right, "evaluations")):
        axes.set(xscale="log", yscale="log", xlabel="largest energy error over the run (J)", ylabel=what)
    title = "ringed: no drift; open: constraints drift\n[c] compiled, [P] Python"
    figure.legend(*left.get_legend_handles_labels(), loc="outside right upper", title=title)
    return figure


def _points(axes: Axes, points: pd.DataFrame, what: str, label: str) -> None:
    x, y = points["energy"].astype(float), points[what].astype(float)
    axes.plot(x, y, label=label or None, **_look(points.iloc[0]))
    calm = points["verdict"].isin(CALM)
    axes.plot(x[calm], y[calm], "o", color="black", markerfacecolor="none", markersize=11, markeredgewidth=0.8)
