"""One style for all figures: a colour and a marker for each solver, and the work-precision figure."""

import tomllib
import zlib
from collections.abc import Iterable, Mapping, Sequence
from functools import cache
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
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter

from studies.bench.names import label, looks_like
from studies.bench.solvers import CATALOGUE, COMPILED, DEFAULT, GEAR_ORDERS, GIVEN, HEYOKA, IRK, IRK_LINE, gear
from studies.bench.store import Output
from studies.bench.tables import astray, setting_of, time_for, used
from twoloop.rows.equal_error import DECADE

MOST_LINES = 9
FIRST = (DEFAULT, *(name for name, method in COMPILED.items() if method == DEFAULT), IRK_LINE, IRK)  # always drawn
# family, how names begin
MAIN_RIVALS = (("heyoka", HEYOKA), ("CyRK", ""), ("SUNDIALS", "CVODE"), ("SUNDIALS", "IDA from C"), ("SciPy", ""))
ERROR = "largest position error over the run (m, rad)"
GAPS = "gap: failed run, or more than a decade of error; left out: error below that of the reference"
LEGEND = "solid: twoloop\nfilled: keeps constraints\ngap: failed run, or more\nthan a decade of error"

plt.style.use(Path(__file__).with_name("bench.mplstyle"))

# Okabe and Ito's colours, told apart by colour-blind readers; a marker besides, and dashes for other families
BLACK, ORANGE, SKY, GREEN = "#000000", "#E69F00", "#56B4E9", "#009E73"
YELLOW, BLUE, RED, PINK, GREY, BROWN = "#B39B00", "#0072B2", "#D55E00", "#CC79A7", "#7F7F7F", "#7A4A12"
VIOLET, MAGENTA, SLATE = "#6A3D9A", "#D4006A", "#2F4F6F"  # more, as ours and others' share none
OLIVE, CRIMSON, LIME, TAN, ROSE, LAVENDER = "#556B2F", "#8B0000", "#8CC63E", "#C49C6B", "#FF9D9A", "#A99BD8"
TEAL = "#00A6A6"

LOOKS = tomllib.loads(Path(__file__).with_name("looks.toml").read_text(encoding="utf-8"))
OURS, THEIRS = ({globals()[color]: own for color, own in LOOKS[whose].items()} for whose in ("ours", "theirs"))
STEELS = ("#9AD0D2", "#6FB7B9", "#4A9A9D", "#327D81", "#1E6064", "#0B4447")  # of the stand-in, by its order
STYLES = {name: (color, marker) for color, own in (OURS | THEIRS).items() for name, marker in own.items()}
STYLES |= {gear(order): look for order, look in zip(GEAR_ORDERS, zip(STEELS, "1234+x", strict=True), strict=True)}
SAME: dict[str, str] = LOOKS["same"]
MARKERS = "o^sDvP>d<pX*Hh8"  # those that can be open


@cache
def looks() -> dict[str, tuple[str, str]]:
    """Colour and marker of all solvers that are known: of those without an entry above, the next that are free."""
    found = dict(STYLES)
    for colors, ours in ((OURS, True), (THEIRS, False)):
        unlisted = (name for name in CATALOGUE if name not in STYLES | SAME)
        names = (name for name in unlisted if (CATALOGUE[name].family == "two-loop") == ours)
        found |= dict(zip(names, _free(colors, STYLES), strict=False))
    return found


def _free(colors: Iterable[str], known: Mapping[str, tuple[str, str]]) -> list[tuple[str, str]]:
    return [(color, marker) for marker, color in product(MARKERS, colors) if (color, marker) not in known.values()]


def _look_of(solver: str) -> tuple[str, str]:
    """That of a solver; of an unknown one, by its name, one that no other solver has."""
    known = looks()
    if (name := SAME.get(solver, solver)) in known:
        return known[name]
    free = _free(THEIRS, known)
    return free[zlib.crc32(name.encode()) % len(free)]


def style(solver: str, family: str = "two-loop", keeps_constraints: bool = True) -> dict[str, object]:
    """Colour, marker and line of a solver, the same in all figures; an open marker where the constraints drift."""
    color, marker = _look_of(solver)
    line: dict[str, object] = {"linestyle": "-", "linewidth": 1.7} if family == "two-loop" else {"linestyle": "--"}
    made = line | {"color": color, "marker": marker}
    return made if keeps_constraints else made | {"markerfacecolor": "white"}


def look(row: pd.Series, coded: bool | None = None) -> dict[str, Any]:
    """Colour, marker and line of the row's solver, labelled with its name; `coded`: as `names.label` has it."""
    made = style(looks_like(row["solver"], coded), row["family"], bool(row["keeps_constraints"]))
    return made | {"label": label(row["solver"], coded)}


def shades(n: int) -> list[Any]:
    """Colours of what is no solver, from dark to light; a legend of them has a title that says what they are."""
    return list(plt.get_cmap("viridis")(np.linspace(0.0, 0.85, n)))


def legend(figure: Figure, axes: Iterable[Axes], title: str | None = None, below: int = 0) -> None:
    """One legend for all panels, each label once; right of them, or in so many columns below."""
    entries: dict[str, Any] = {}
    for panel in axes:
        for handle, words in zip(*panel.get_legend_handles_labels(), strict=True):
            entries.setdefault(words, handle)
    place: dict[str, Any] = {"loc": "outside lower center", "ncols": below, "fontsize": 8} if below else {}
    figure.legend(entries.values(), entries.keys(), **{"loc": "outside right upper", "title": title} | place)


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
    """At most so many solvers of a case, those with the best places at the targets; in the order of the rows."""
    places: dict[str, list[int]] = {}
    for target in targets:
        times = {solver: time_for(runs, target) for solver, runs in rows.groupby("solver", sort=False)}
        ranked = sorted((time, str(solver)) for solver, time in times.items() if time == time)
        for place, (_, solver) in enumerate(ranked):
            places.setdefault(solver, []).append(place)
    missing = len(rows["solver"].unique())
    score = {solver: sum(got) + missing * (len(targets) - len(got)) for solver, got in places.items()}
    best = sorted(score, key=score.__getitem__)[:most]
    return [solver for solver in dict.fromkeys(rows["solver"]) if solver in best]


def lines_of(rows: pd.DataFrame, targets: Sequence[float]) -> list[str]:
    """The solvers that a figure of a case shows, of those with errors that can be told.

    The default, compiled too, and the paper's procedure; the cheapest of the main rivals that got anywhere, and of all
    at each target; of ours the cheapest others, those at a target first, as many as there is room for.
    """
    seen = rows[_told(rows)]
    first = [name for name in FIRST if (seen["solver"] == name).any()]
    rivals: list[str] = []
    for family, begins in MAIN_RIVALS:
        own = seen[(seen["family"] == family) & seen["solver"].str.startswith(begins)]
        if not own.empty:
            best = own.loc[own["error_q"].astype(float).idxmin(), "solver"]
            rivals += cheapest_lines(rows[rows["solver"].isin(own["solver"])], targets, 1) or [best]
    of_us = seen["family"] == "two-loop"
    rivals += [
        name for name in _winners(rows[rows["solver"].isin(seen[~of_us]["solver"])], targets) if name not in rivals
    ]
    ours = rows[rows["solver"].isin(seen[of_us & ~seen["solver"].isin(first)]["solver"])]
    room = max(0, MOST_LINES - len(first) - len(rivals))
    chosen = list(dict.fromkeys([*_winners(ours, targets), *cheapest_lines(ours, targets, room)]))[:room]
    return [*first, *(name for name in dict.fromkeys(ours["solver"]) if name in chosen), *rivals]


def default_first(solvers: Iterable[str], coded: bool | None) -> list[str]:
    """The solvers in the order of a legend, each once; `coded`: as `names.label` has it."""
    return sorted(dict.fromkeys(solvers), key=lambda name: label(name, coded) != GIVEN)


def _winners(rows: pd.DataFrame, targets: Sequence[float]) -> list[str]:
    """The cheapest solver at each of the targets that any reaches."""
    best = (cheapest_lines(rows, (target,), 1) for target in targets)
    return list(dict.fromkeys(name for names in best for name in names))


def _told(rows: pd.DataFrame) -> pd.Series:
    """Whether the reference resolves the error of a run, and the run has not lost the motion."""
    return (rows["error_q"].astype(float) > rows["floor"].astype(float)) & ~astray(rows)


def with_gaps(runs: pd.DataFrame) -> pd.DataFrame:
    """The runs of one solver from its loosest setting on, with an empty row wherever no line is to be drawn.

    As in `tables`, nothing is told between runs of errors more than a decade apart or of different methods, nor across
    a run that failed. Runs whose errors cannot be told are left out.
    """
    runs = runs.assign(error_q=runs["error_q"].astype(float).where(_told(runs)))
    runs = runs.iloc[np.lexsort((-runs["error_q"], -setting_of(runs)))].reset_index(drop=True)
    size = np.log(runs["error_q"])
    methods = pd.Series([used(run) for _, run in runs.iterrows()])
    apart = (size.diff().abs() > np.log(DECADE)) | (methods != methods.shift(fill_value=methods.get(0)))
    return runs.reindex(sorted([*runs.index, *(runs.index[apart] - 0.5)]))


def work_precision(
    rows: pd.DataFrame, solvers: Sequence[str], title: str, error: str = ERROR, coded: bool | None = None
) -> Figure:
    """CPU time and evaluations over the largest error of a position, a line a solver; `rows` of one case, medians.

    `error` says what the column error_q is; `coded`: as `names.label` has it. Lines have the gaps of `with_gaps`.
    Raises ValueError if there are more than nine lines.
    """
    if len(solvers) > MOST_LINES:
        raise ValueError(f"a work-precision figure has at most {MOST_LINES} lines; given {len(solvers)}")
    figure, (left, right) = plt.subplots(1, 2, figsize=(9.2, 3.8), sharex=True, layout="constrained")
    for solver in default_first(solvers, coded):
        runs = with_gaps(rows[rows["solver"] == solver])
        known = runs[runs["error_q"].notna()]
        if known.empty:
            continue
        called = " [P]" if known["called_from"].iloc[0] == "Python" else ""
        one = look(known.iloc[0], coded)
        one["label"] += called
        errors, times = runs["error_q"].astype(float), runs["call_s"].astype(float)
        spread = [times - runs["call_q1"].astype(float), runs["call_q3"].astype(float) - times]
        left.errorbar(errors, times, yerr=spread, elinewidth=0.8, **one)
        if known["n_evaluations"].notna().any():
            right.plot(errors, runs["n_evaluations"].astype(float), **one)
    for axes, what in ((left, "CPU time of the call (s)"), (right, "evaluations")):
        axes.set(xscale="log", yscale="log", xlabel=error, ylabel=what)
    bars = bool((rows["call_q3"] > rows["call_q1"]).any())
    from_python = any(words.endswith(" [P]") for words in left.get_legend_handles_labels()[1])
    told = bars * "\nvertical bars: quartiles" + from_python * "\n[P]: called from Python"
    legend(figure, [left], f"{LEGEND}\nleft out: motion lost{told}")
    figure.suptitle(title, fontsize=10)
    return figure
