"""Every mechanism with every solver: what an accuracy costs, and whether twoloop or another solver is faster."""

from collections.abc import Sequence
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure

from studies.bench import adaptive, figures, headline, study, tables
from studies.bench.render import number, power, render
from studies.bench.row_files import versions
from studies.bench.store import Output
from studies.bench.study import short
from studies.work_precision import first_calls, mechanisms, processors
from studies.work_precision.mechanisms import HEADLINE, REPEATS, RESOLVED
from twoloop.rows.row_format import CALIBRATION, calibration_s

MARKS = {"alone": "ours", "missed": "others", "none": "–"}  # cells of the picture without a ratio


def make(output: Output) -> pd.DataFrame:
    call = output.call
    with output.kept() as kept:
        parts = [mechanisms.collect(call.wanted(mechanisms.runs(call.quick)), kept), first_calls.collect(kept, call)]
        minimal, errors = call.wanted(mechanisms.minimal_runs(call.quick)), () if call.quick else RESOLVED
        parts += [adaptive.collect(minimal, kept, mechanisms.row_at_end, lambda run: True, errors)]
    # the time of a fixed calculation, by which times of several processors can be compared
    return pd.concat(parts, ignore_index=True).assign(calibration=CALIBRATION, calibration_s=calibration_s())


def part(rows: pd.DataFrame, group: str) -> pd.DataFrame:
    """Select the rows of one group, without columns that it has not."""
    return rows[rows["group"] == group].dropna(axis="columns", how="all").reset_index(drop=True)


def with_one_name(rows: pd.DataFrame) -> pd.DataFrame:
    """Name processors without their family where older rows lack it."""
    bare = rows["processor"].str.partition(" (family ")[0]
    return rows.assign(processor=bare.where(bare.isin(rows["processor"]), rows["processor"]))


def on_the_same_processor(rows: pd.DataFrame, others: pd.DataFrame) -> pd.DataFrame:
    """Select the rows of mechanisms that were measured on the processor on which the others were."""
    if "processor" not in rows or "processor" not in others:
        return rows
    return rows[rows["processor"] == rows["case"].map(others.groupby("case")["processor"].first())]


def report(output: Output, rows: pd.DataFrame, line: str) -> dict[str, Any]:
    """Write findings, figures and report."""
    rows = with_one_name(rows) if "processor" in rows else rows
    everywhere = tables.medians(part(rows, mechanisms.GROUP))
    in_angles = on_the_same_processor(part(rows, mechanisms.MINIMAL_GROUP), part(rows, mechanisms.GROUP))
    standings, firsts = mechanisms.standings_of(everywhere), part(rows, first_calls.GROUP)
    found = mechanisms.findings_of(standings, everywhere)
    found["minimal"] = mechanisms.minimal_findings(
        tables.medians(in_angles) if len(in_angles) else in_angles, everywhere
    )
    found |= {"calls": headline.calls(everywhere, firsts, HEADLINE), "first_calls": first_calls.findings_of(firsts)}
    found["favourable"] = favourable(found)
    found["processors"] = [] if output.call.quick else processors.kept(output, rows, line, standings)
    found |= {"measured": measured_on(rows), "versions": versions_of(output), "least": tables.LEAST}
    found |= {"repeats": REPEATS, "answer": answer(found)}
    output.save_findings(found)
    figures.save(heat_map(found), output, "work_precision_ratios")
    figures.save(picture(everywhere, found), output, "work_precision")
    output.write("work_precision.md", render("work_precision", found, {}, stamp=line, quick=output.call.quick))
    return found


def versions_of(output: Output) -> dict[str, str]:
    """Tell the versions of the packages with which the rows were measured; of those that are kept, as told then."""
    old = (output.call.redraw or output.call.only) and output.file("work_precision.json").is_file()
    return (output.load_findings()["versions"] if old else {}) | ({} if old and output.call.redraw else versions())


def measured_on(rows: pd.DataFrame) -> dict[str, Any]:
    """Count commits and processors of the rows, and sessions in which a mechanism was measured, at most.

    `speeds`: largest ratio of the times of the calibration between the sessions of a mechanism.
    """
    made = rows.reindex(columns=["processor", "commit"]).dropna().astype(str)
    told: dict[str, Any] = {"commits": made["commit"].nunique(), "sessions": 1, "speeds": None}
    told["processors"] = sorted(map(short, made["processor"].unique()))
    known = rows[rows["group"] == mechanisms.GROUP].reindex(columns=["case", "commit", "calibration_s"])
    times = known.dropna().groupby(["case", "commit"])["calibration_s"].median().groupby("case")
    if len(times):
        told |= {"sessions": int(times.size().max()), "speeds": float((times.max() / times.min()).max())}
    return told


def answer(found: dict[str, Any]) -> str:
    """Say in one sentence which part of the default's time the fastest other solver takes."""
    at = found["typical"]
    if not at:
        return "No error was reached by both sides."
    least, most = (f(at, key=lambda line: line["median"]) for f in (min, max))
    times = f"{number(least['median'])} to {number(most['median'])} times the default's time"
    without = "" if found["keeping"] else ", without keeping the joints closed"
    return f"On smooth motion, the fastest other solver takes {times} in the median{without}."


def favourable(found: dict[str, Any]) -> bool:
    """Return whether the default does at least as well on the mechanism of the single calls as in the median."""
    cells = [each["ratio"] for each in found["cells"] if each["case"] == HEADLINE]
    at = [(cells[0][RESOLVED.index(line["error"])], line["median"]) for line in found["typical"]] if cells else []
    return bool(at) and all(ratio is not None and ratio >= median for ratio, median in at)


def picture(rows: pd.DataFrame, found: dict[str, Any]) -> Figure:
    """Draw what a call takes over its error on the four-bar: the default, and the fastest other solvers."""
    own, coded = rows[rows["case"] == HEADLINE], mechanisms.given_on(HEADLINE) == headline.OWN_CODE
    lines = figures.lines_of(own, RESOLVED[1::3], coded)
    at = {line["name"]: line["at"][-1]["call_s"] for line in found["calls"]["lines"]} if found["calls"] else {}
    ours, other = (at.get(name) for name in (headline.OWN_CODE if coded else headline.DEFAULT, "CyRK"))
    title = "Four-bar linkage, 10 s: what an accuracy costs"
    if ours and other:
        error, times = power(found["calls"]["errors"][-1]), [number(1e3 * seconds) for seconds in (ours, other)]
        title = f"For an error of {error} on the four-bar, the default takes {times[0]} ms and CyRK {times[1]} ms"
    return figures.work_precision(own, lines, title, "error after 10 s, over max(1, max |q|)", coded)


def heat_map(found: dict[str, Any]) -> Figure:
    """Draw the time of the fastest other solver over that of the default, by mechanism and error."""
    cells, count = found["cells"], found["default"]
    names = [f"{each['case']}{' *' if each['singular'] else ''}" for each in cells]
    figure, axes = plt.subplots(figsize=(7.6, 0.3 * len(names) + 1.5), layout="constrained")
    shown = np.array([[ratio or np.nan for ratio in each["ratio"][::-1]] for each in cells], dtype=float)
    colours = plt.get_cmap("RdBu").with_extremes(bad="#e6e6e6")
    image = axes.imshow(shown, norm=LogNorm(0.04, 25.0), cmap=colours, aspect="auto")
    for (i, j), ratio in np.ndenumerate(shown):
        verdict = cells[i]["verdict"][::-1][j]
        text = MARKS.get(verdict) or number(float(ratio))
        color = "white" if abs(np.log10(ratio)) > 0.8 else "black"  # black on the grey of those without a ratio
        shape = f"({text})" if verdict == "undecided" else text
        axes.text(j, i, shape, ha="center", va="center", fontsize=8, color=color)
    axes.set_xticks(range(len(RESOLVED)), [power(error) for error in RESOLVED[::-1]])
    axes.set_yticks(range(len(names)), names)
    axes.grid(False)
    marks = "* singular positions   ( ) not distinguishable   ours, others: only they reach the error"
    axes.set_xlabel(f"error at the end, over max(1, max |q|)\n{marks}")
    told = f"{count['slower']} of {count['n']} cells"
    figures.message(figure, f"Another solver is faster than the default in {told} (without *)")
    figure.colorbar(image, ax=axes, label="time of the fastest other solver over the default's", extend="both")
    return figure


def main(words: Sequence[str] | None = None) -> None:
    study.run_rows("work_precision", __doc__, words, make, report, parts=True)
