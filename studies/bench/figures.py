"""Draw all figures in one style: a message as title, at most six labelled lines, errors that grow to the right."""

import textwrap
import tomllib
import zlib
from collections.abc import Iterable, Sequence
from io import BytesIO
from itertools import product
from pathlib import Path
from typing import Any

import matplotlib as mpl

mpl.use("Agg")

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter

from studies.bench.names import label, looks_like
from studies.bench.solvers import COMPILED, DEFAULT, GEAR_ORDERS, GIVEN, HEYOKA, IRK, IRK_LINE, gear
from studies.bench.store import Output
from studies.bench.tables import astray, setting_of, time_for
from twoloop.problem.problem import Array

MOST_LINES = 6
# a solver of each of these is drawn if there is room, in this order: family, how its name begins
MAIN_SOLVERS = (("SUNDIALS", "IDA from C"), ("heyoka", HEYOKA), ("CyRK", ""), ("SUNDIALS", "CVODE"), ("SciPy", ""))
ERROR = "largest position error over the run (m, rad)"
TIME = "CPU time of the call (s)"
THICK = 3.0  # width of the default's line, in points
LABEL_HEIGHT = 1.25  # distance between the labels of lines, in heights of their letters

plt.style.use(Path(__file__).with_name("bench.mplstyle"))

# Okabe and Ito's colours, which colour-blind readers can tell apart, and more
BLACK, ORANGE, SKY, GREEN = "#000000", "#E69F00", "#56B4E9", "#009E73"
YELLOW, BLUE, RED, PINK, GREY, BROWN = "#B39B00", "#0072B2", "#D55E00", "#CC79A7", "#7F7F7F", "#7A4A12"
VIOLET, MAGENTA, SLATE = "#6A3D9A", "#D4006A", "#2F4F6F"
OLIVE, CRIMSON, LIME, TAN, ROSE, LAVENDER = "#556B2F", "#8B0000", "#7AB52E", "#A87B3F", "#FF9D9A", "#A99BD8"
TEAL, NAVY = "#00A6A6", "#283593"
STEELS = ("#9AD0D2", "#6FB7B9", "#4A9A9D", "#327D81", "#1E6064", "#0B4447")  # of the stand-in, by its order
MARKERS = "o^sDvP>d<pX*Hh8"

LOOKS = tomllib.loads(Path(__file__).with_name("looks.toml").read_text(encoding="utf-8"))
OURS, THEIRS = ({globals()[color]: own for color, own in LOOKS[whose].items()} for whose in ("ours", "theirs"))
STYLES = {name: (color, marker) for color, own in (OURS | THEIRS).items() for name, marker in own.items()}
STYLES |= {gear(order): look for order, look in zip(GEAR_ORDERS, zip(STEELS, "1234+x", strict=True), strict=True)}
SAME: dict[str, str] = LOOKS["same"]


def style(solver: str) -> dict[str, Any]:
    """Return colour, marker and line of a solver, the same in all figures; the default's line is thick."""
    name = SAME.get(solver, solver)
    if name not in STYLES:  # the same pair every time, and that of no listed solver
        free = [pair for pair in product(THEIRS, MARKERS) if pair not in STYLES.values()]
        color, marker = free[zlib.crc32(name.encode()) % len(free)]
    else:
        color, marker = STYLES[name]
    return {"color": color, "marker": marker} | ({"linewidth": THICK, "zorder": 3} if name == DEFAULT else {})


def look(row: pd.Series, coded: bool | None = None) -> dict[str, Any]:
    """Return the style of the row's solver, with its name as label; `coded`: as `names.label` has it."""
    text = label(row["solver"], coded)
    if text == GIVEN:
        return style(DEFAULT) | {"label": f"twoloop, {GIVEN}"}
    return style(looks_like(row["solver"], coded)) | {"label": text}


def shades(n: int) -> list[Any]:
    """Return colours from dark to light, for curves that are not of solvers."""
    return list(plt.get_cmap("viridis")(np.linspace(0.0, 0.85, n)))


def message(figure: Figure, text: str, panels: Axes | Iterable[Axes] = ()) -> None:
    """Write what the figure shows above it, as one sentence, and label the lines of its panels."""
    width = int(11.0 * figure.get_figwidth())  # letters that fit on a line
    figure.suptitle(textwrap.fill(text, width), x=0.01, ha="left", fontsize=11, fontweight="bold")
    label_lines(panels)


def label_lines(panels: Axes | Iterable[Axes]) -> None:
    """Write each label once, right of the panel where its line ends last; call this last, before `save`."""
    last: dict[str, tuple[Axes, Any]] = {}
    for axes in [panels] if isinstance(panels, Axes) else panels:
        for line, text in zip(*axes.get_legend_handles_labels(), strict=True):
            if np.isfinite(_points(line)).all(axis=1).any():
                last[text] = axes, line
    for axes in dict.fromkeys(axes for axes, _ in last.values()):
        _label_ends(axes, {text: line for text, (own, line) in last.items() if own is axes})


def _points(line: Any) -> Array:
    """Return the points of a line or of a filled band, a row each, in its own coordinates."""
    if isinstance(line, PolyCollection):
        return np.asarray(line.get_paths()[0].vertices, dtype=float)
    return np.array(line.get_xydata(), dtype=float)


def _label_ends(axes: Axes, lines: dict[str, Any]) -> None:
    figure = axes.get_figure(root=True)
    assert figure is not None
    label_decades(figure)
    figure.draw_without_rendering()  # so that the axes have their size
    ends = []
    for text, line in lines.items():
        points = _points(line)
        points = points[np.isfinite(points).all(axis=1)]
        shown = axes.transAxes.inverted().transform(line.get_transform().transform(points))
        end = np.clip(shown[shown[:, 0] >= shown[:, 0].max() - 1e-9].mean(axis=0), 0.0, 1.0)
        ends.append((end, text, line))
    ends.sort(key=lambda each: each[0][1])
    size = float(mpl.rcParams["legend.fontsize"])
    gap = LABEL_HEIGHT * size / 72.0 * figure.dpi / axes.get_window_extent().height
    room = gap * np.arange(len(ends))
    free = np.array([end[1] for end, *_ in ends]) - room
    # labels that would overlap are pushed up and down alike: the mean of pushing up alone and down alone
    heights = 0.5 * (np.maximum.accumulate(free) + np.minimum.accumulate(free[::-1])[::-1]) + room
    heights -= max(0.0, heights[-1] - 1.0)
    heights += max(0.0, -heights[0])
    for height, (end, text, line) in zip(heights, ends, strict=True):
        band = isinstance(line, PolyCollection)
        color = to_hex(line.get_facecolor()[0] if band else line.get_color())
        thick = not band and line.get_linewidth() >= THICK
        arrow = {"arrowstyle": "-", "color": color, "linewidth": 0.6, "alpha": 0.6, "shrinkA": 1, "shrinkB": 3}
        arrow["relpos"] = (0.0, 0.5)  # from the left end of the text
        axes.annotate(
            text,
            xy=end,
            xycoords="axes fraction",
            xytext=(1.04, height),
            color=color,
            fontsize=size,
            fontweight="bold" if thick else "normal",
            va="center",
            annotation_clip=False,
            arrowprops=arrow,
        )


def label_decades(figure: Figure) -> None:
    """Label logarithmic axes at decades alone, of which at least two are brought into view."""
    for axes in figure.axes:
        if axes.get_label() == "<colorbar>":  # which ends where its colours do
            continue
        for axis in (axis for axis in (axes.xaxis, axes.yaxis) if axis.get_scale() == "log"):
            low, high = np.log10(axis.get_view_interval())
            while np.floor(high) - np.ceil(low) < 1.0:  # on to the nearest one beyond an end
                below, above = np.ceil(low) - 1.0, np.floor(high) + 1.0
                low, high = (below, high) if low - below <= above - high else (low, above)
                axes.set(**{f"{axis.axis_name}lim": (10.0**low, 10.0**high)})
            axis.set_minor_formatter(NullFormatter())


def save(figure: Figure, output: Output, name: str) -> None:
    """Write NAME.png and NAME.svg, a quick one marked as such, and close the figure."""
    label_decades(figure)
    if output.call.quick:
        figure.text(0.005, 0.005, "quick run: shorter and coarser than the report", fontsize=7, color=RED, va="top")
    for suffix, metadata in (("png", {"Software": None}), ("svg", {"Date": None})):
        stream = BytesIO()
        figure.savefig(stream, format=suffix, metadata=metadata)
        output.write(f"{name}.{suffix}", stream.getvalue())
    plt.close(figure)


def cheapest_lines(rows: pd.DataFrame, targets: Sequence[float], most: int = MOST_LINES) -> list[str]:
    """Return at most so many solvers of a case, those with the best places at the targets, in the order of the rows."""
    score = {str(solver): 0 for solver in rows["solver"].unique()}
    for target in targets:
        times = {name: time_for(rows[rows["solver"] == name], target) for name in score}
        ranked = sorted((name for name in score if times[name] == times[name]), key=times.__getitem__)
        for name in score:
            score[name] += ranked.index(name) if name in ranked else len(score)
    best = sorted((name for name in score if score[name] < len(targets) * len(score)), key=score.__getitem__)[:most]
    return [name for name in score if name in best]


def lines_of(rows: pd.DataFrame, targets: Sequence[float], coded: bool | None = None) -> list[str]:
    """Choose at most six solvers of a case whose errors exceed the error of the reference.

    In this order: the default, the paper's procedure, the fastest of the other solvers at each target, the fastest of
    each of `MAIN_SOLVERS`, and the fastest further methods of twoloop. Other projects have one line each. `coded`: see
    `names.label`.
    """
    seen = rows[_told(rows)]
    names = list(dict.fromkeys(seen["solver"]))
    defaults = [name for name in (*COMPILED, GIVEN, DEFAULT) if COMPILED.get(name, DEFAULT) == DEFAULT]
    ranked = sorted((name for name in defaults if name in names), key=lambda name: label(name, coded) != GIVEN)
    chosen = [*ranked[:1], *[name for name in (IRK_LINE, IRK) if name in names][:1]]
    of_us = seen["family"] == "two-loop"
    others = rows[rows["solver"].isin(seen[~of_us]["solver"])]
    found = [name for target in targets for name in cheapest_lines(others, (target,), 1)]
    for family, begins in MAIN_SOLVERS:
        own = seen[(seen["family"] == family) & seen["solver"].str.startswith(begins)]
        if not own.empty:
            best = str(own.loc[own["error_q"].astype(float).idxmin(), "solver"])
            found += cheapest_lines(rows[rows["solver"].isin(own["solver"])], targets, 1) or [best]
    firsts: dict[str, str] = {}  # of each project, by the first word of its label
    for name in found:
        firsts.setdefault(label(name).split()[0].rstrip(","), name)
    chosen += firsts.values()
    further = rows[rows["solver"].isin(seen[of_us]["solver"]) & ~rows["solver"].isin([*ranked, IRK_LINE, IRK])]
    return list(dict.fromkeys([*chosen, *cheapest_lines(further, targets)]))[:MOST_LINES]


def _told(rows: pd.DataFrame) -> pd.Series:
    """Return whether the reference resolves the error of a run, and the run has not lost the motion."""
    return (rows["error_q"].astype(float) > rows["floor"].astype(float)) & ~astray(rows)


def line_of(runs: pd.DataFrame) -> pd.DataFrame:
    """Return the runs of one solver for a line, loosest first, without failures and errors below the reference's."""
    runs = runs[_told(runs)]
    return runs.iloc[np.lexsort((-runs["error_q"].astype(float), -setting_of(runs)))].reset_index(drop=True)


def work_precision(
    rows: pd.DataFrame, solvers: Sequence[str], title: str, error: str = ERROR, coded: bool | None = None
) -> Figure:
    """Draw CPU time over the largest error of a position; `error`: meaning of error_q, `coded`: see `names.label`."""
    if len(solvers) > MOST_LINES:
        raise ValueError(f"a work-precision figure has at most {MOST_LINES} lines; given {len(solvers)}")
    figure, axes = plt.subplots(figsize=(7.6, 4.0), layout="constrained")
    for solver in sorted(dict.fromkeys(solvers), key=lambda name: label(name, coded) != GIVEN):  # the default first
        runs = line_of(rows[rows["solver"] == solver])
        if len(runs):
            axes.plot(runs["error_q"].astype(float), runs["call_s"].astype(float), **look(runs.iloc[0], coded))
    axes.set(xscale="log", yscale="log", xlabel=error, ylabel=TIME)
    message(figure, title, axes)
    return figure
