"""The three figures of the motion study: over 2 s, at the end of the run, and the error over time."""

from collections.abc import Iterable
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from studies import figures
from studies.solvers import CANONICAL, GEAR_ORDERS, IDA_C, IRK, NEWMARK, OWN_EXPLICIT, gear
from studies.store import Output

Array = NDArray[np.floating]
Entry = tuple[str, float | None]  # solver, fixed step

SHORT, LAST = 2.0, 5.0  # s: Fig. 2 of the paper, and what is drawn of the end of the run
GRID_SHORT, GRID_LAST = np.linspace(0.0, SHORT, 201), np.linspace(-LAST, 0.0, 501)
SHORT_PANELS: dict[float, tuple[Entry, ...]] = {
    step: ((IRK, None), *((gear(order), step) for order in (1, 2, 3, 5))) for step in (0.02, 0.01)
}
AT_END: tuple[Entry, ...] = ((IRK, None), (NEWMARK, None), *((gear(order), 0.01) for order in (2, 3, 4, 5)))
DRAWN = {*AT_END, *(entry for panel in SHORT_PANELS.values() for entry in panel)}
GROWN = (IRK, NEWMARK, "SunRadau5", OWN_EXPLICIT, CANONICAL, IDA_C, "DOP853, projected")
SMALLEST = 1e-11  # m, of the reference


def key(row: pd.Series, curve: str) -> str:
    """Name of a curve of this row in the saved series."""
    settings = " ".join(f"{name}={row[name]:g}" for name in ("err_out", "tol", "h") if pd.notna(row.get(name)))
    return f"{row['solver']} {settings} {curve}"


def draw(output: Output, rows: pd.DataFrame, series: dict[str, Array], visible: float) -> None:
    """Draw all three."""
    figures.save(_short(rows, series, visible), output, "motion_short")
    figures.save(_last(rows, series, visible), output, "motion_long")
    figures.save(_error(rows, series, visible), output, "motion_error")


def _found(rows: pd.DataFrame, entries: Iterable[Entry], series: dict[str, Array], curve: str) -> list[pd.Series]:
    """The rows of these entries of which a curve is kept."""
    rows = rows[rows["group"].isin(("line-up", "GSTIFF stand-in"))]
    found = []
    for solver, step in entries:
        part = rows[rows["solver"] == solver]
        part = part if step is None else part[part["h"] == step]
        found += [row for _, row in part.head(1).iterrows() if key(row, curve) in series]
    return found


def _line(row: pd.Series) -> dict[str, Any]:
    """Colour and dashes of the row's solver, without the marker, which would hide a curve of many points."""
    return figures.style(row["solver"], row["family"]) | {"marker": "", "label": row["solver"]}


def _legend(figure: Figure, axes: Iterable[Axes]) -> None:
    """One legend for all panels, each solver once."""
    entries: dict[str, Any] = {}
    for panel in axes:
        for handle, label in zip(*panel.get_legend_handles_labels(), strict=True):
            entries.setdefault(label, handle)
    figure.legend(list(entries.values()), list(entries), loc="outside right upper")


def _short(rows: pd.DataFrame, series: dict[str, Array], visible: float) -> Figure:
    figure, axes = plt.subplots(
        2, 2, figsize=(9.2, 5.0), sharex=True, sharey="row", layout="constrained", height_ratios=(3, 2)
    )
    for (step, entries), upper, lower in zip(SHORT_PANELS.items(), axes[0], axes[1], strict=True):
        upper.plot(GRID_SHORT, series["truth short"], color="black", lw=3.0, alpha=0.3, label="true motion")
        for row in _found(rows, entries, series, "short"):
            if row["error_y3_short"] > visible:
                upper.plot(GRID_SHORT, series[key(row, "short")], **_line(row))
            lower.plot(GRID_SHORT[1:], np.maximum(series[key(row, "short_error")][1:], SMALLEST), **_line(row))
        lower.axhline(visible, color="black", lw=0.8, ls=":")
        upper.set_title(f"GSTIFF stand-in with h = {step:g} s", fontsize=9)
        lower.set(xlabel="t (s)", yscale="log")
    axes[0, 0].set_ylabel("y3 (m)")
    axes[1, 0].set_ylabel("largest error of y3 so far (m)")
    _limit(axes[1, 1], visible)
    _legend(figure, (*axes[1], *axes[0]))
    return figure


def _last(rows: pd.DataFrame, series: dict[str, Array], visible: float) -> Figure:
    figure, panel = plt.subplots(figsize=(9.2, 3.2), layout="constrained")
    t = float(rows["t_end"].iloc[0]) + GRID_LAST
    panel.plot(t, series["truth last"], color="black", lw=3.0, alpha=0.3, label="true motion")
    for row in _found(rows, AT_END, series, "last"):
        if not row["error_y3"] <= visible:
            panel.plot(t, series[key(row, "last")], **_line(row))
    panel.set(xlabel="t (s)", ylabel="y3 (m)")
    _legend(figure, [panel])
    return figure


def _limit(panel: Axes, visible: float) -> None:
    """Write the limit of what is visible beside its line, right of the panel."""
    place = panel.get_yaxis_transform()
    panel.text(1.01, visible, f"{visible:g} m", transform=place, va="center", fontsize=8)


def _error(rows: pd.DataFrame, series: dict[str, Array], visible: float) -> Figure:
    figure, axes = plt.subplots(1, 2, figsize=(9.2, 4.4), sharex=True, sharey=True, layout="constrained")
    panels: tuple[tuple[str, list[Entry]], ...] = (
        ("one setting each, see the table", [(name, None) for name in GROWN]),
        ("GSTIFF stand-in, h = 0.01 s", [(gear(order), 0.01) for order in GEAR_ORDERS]),
    )
    t = series["log"]
    for panel, (title, entries) in zip(axes, panels, strict=True):
        for k, row in enumerate(_found(rows, entries, series, "log")):
            look = figures.style(row["solver"], row["family"], bool(row["keeps_constraints"]))
            error = np.maximum(series[key(row, "log")], SMALLEST)
            panel.plot(t, error, label=row["solver"], markevery=(3 * k % 10, 10), **look)
        panel.axhline(visible, color="black", lw=0.8, ls=":")
        panel.set(xscale="log", yscale="log", xlabel="t (s)")
        panel.set_title(title, fontsize=9)
        panel.legend(loc="upper center", bbox_to_anchor=(0.5, -0.15), ncols=2)
    _limit(axes[1], visible)
    axes[0].set_ylabel("largest error of y3 so far (m)")
    return figure
