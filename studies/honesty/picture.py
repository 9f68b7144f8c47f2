"""The figure of `studies.honesty`: what came of the runs of each solver."""

from collections.abc import Mapping, Sequence
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

from studies.bench import figures

COLORS = (figures.BLUE, figures.SKY, figures.RED)  # of right, said so, silent
NUMBERED = 2  # from this part on the bars carry the number of runs


def picture(totals: Sequence[Mapping[str, Any]], parts: Mapping[str, Sequence[str]]) -> Figure:
    """A bar for each solver, ours first, then others: the share of its runs with the outcomes of each part."""
    names = [f"{line['solver'].replace(' (two-loop)', '')} ({line['n']})" for line in totals]
    figure, axes = plt.subplots(figsize=(7.6, 0.17 * len(totals) + 0.9), layout="constrained")
    left = np.zeros(len(totals))
    for k, ((what, outcomes), color) in enumerate(zip(parts.items(), COLORS, strict=True)):
        counts = [sum(line[each] for each in outcomes) for line in totals]
        shares = np.array([100.0 * count / line["n"] for count, line in zip(counts, totals, strict=True)])
        bars = axes.barh(names, shares, left=left, color=color, label=what)
        if k >= NUMBERED:
            axes.bar_label(bars, [str(count) if count else "" for count in counts], label_type="center", fontsize=7)
        left += shares
    n_own = sum(line["solver"].endswith("(two-loop)") for line in totals)
    axes.axhline(n_own - 0.5, color="black", linewidth=0.8)
    for text, place in (("ours", 0.5 * n_own), ("others", 0.5 * (n_own + len(totals)))):
        axes.text(101.0, place - 0.5, text, rotation=90.0, va="center")
    axes.set(xlabel="share of runs (%)", xlim=(0.0, 100.0), ylim=(len(totals) - 0.4, -0.6), ylabel="solver (its runs)")
    axes.tick_params(axis="y", labelsize=8, length=0.0)
    axes.grid(False)
    figures.legend(figure, [axes], "numbers: runs")
    return figure
