"""The text and the figures of the motion study, from its rows and curves."""

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd

from references import exudyn_four_bar, gear
from studies.report import Array, Call, markdown_table, number
from studies.runs import ASTRAY, LOST
from studies.solvers import CATALOGUE, GEAR_ORDERS, IRK, LINE_UP, NEWMARK
from studies.solvers import gear as gear_name

VISIBLE = 0.01  # m, about the width of a line in a figure of the motion

# what the figures of y3 show: (solver, fixed step or None)
SHORT_PANELS = {
    "Two-loop procedures, settings of the paper": ((IRK, None), (NEWMARK, None)),
    "GSTIFF stand-in, h = 0.02 s": tuple((gear_name(order), 0.02) for order in (1, 2, 3, 5)),
    "GSTIFF stand-in, h = 0.01 s": tuple((gear_name(order), 0.01) for order in (1, 2, 3, 5)),
}
LONG_PANELS = (
    (IRK, None),
    (NEWMARK, None),
    (gear_name(2), 0.01),
    (gear_name(3), 0.01),
    (gear_name(4), 0.01),
    (gear_name(5), 0.01),
)
DRAWN = {*LONG_PANELS, *(entry for panel in SHORT_PANELS.values() for entry in panel)}

COLORS = {1: "tab:gray", 2: "tab:red", 3: "tab:orange", 4: "tab:olive", 5: "tab:blue", 6: "tab:purple"}
LAST = 5.0  # s at the end of the run, drawn large


def key(row: pd.Series, kind: str) -> str:
    """Name of a curve of this row in the saved series."""
    settings = " ".join(f"{name}={row[name]:g}" for name in ("err_out", "tol", "h") if pd.notna(row.get(name)))
    return f"{row['solver']} {settings} {kind}"


def _find(rows: pd.DataFrame, solver: str, step: float | None) -> pd.Series | None:
    """The row of a solver, at a step if it has a fixed one."""
    found = rows[rows["solver"] == solver]
    if step is not None:
        found = found[found["h"] == step]
    return None if found.empty else found.iloc[0]


def _gear(rows: pd.DataFrame, order: int, start: str, step: float) -> pd.Series | None:
    return _find(rows, gear_name(order, start), step)


def needed(rows: pd.DataFrame, solver: str, target: float = VISIBLE) -> float:
    """Largest step for which y3 stays within the target over the run, on the log-log line between two runs."""
    runs = rows[(rows["solver"] == solver) & rows["error_y3"].notna()].drop_duplicates("h").sort_values("h")
    steps, errors = runs["h"].to_numpy(), runs["error_y3"].to_numpy()
    good = np.flatnonzero(errors <= target)
    if good.size == 0:
        return float("nan")
    k = good[-1]
    if k == len(steps) - 1:
        return float(steps[k])
    share = np.log(target / errors[k]) / np.log(errors[k + 1] / errors[k])
    return float(steps[k] * (steps[k + 1] / steps[k]) ** share)


def summary(rows: pd.DataFrame) -> list[str]:
    """The findings, every number from the rows."""
    t_end = rows["t_end"].iloc[0]
    lines = []
    both = [row for row in (_find(rows, IRK, None), _find(rows, NEWMARK, None)) if row is not None]
    texts = [
        f"{row['solver']} is at most {number(1e3 * row['error_y3_short'])} mm off over 2 s and "
        f"{number(1e3 * row['error_y3'])} mm over {t_end:g} s, comes back to within "
        f"{number(-1e3 * row['top_late'])} mm of y = 0 at the end and passes it by {number(1e3 * row['top'])} mm"
        for row in both
    ]
    lines.append(
        f"The paper's two procedures at the paper's settings: {'; '.join(texts)}. The paper: they reach and do not pass "
        "y = 0."
    )
    for step, said in ((0.02, "differs from the two-loop procedures"), (0.01, "coincides well with them")):
        of_orders = [(order, _gear(rows, order, "accurate", step)) for order in GEAR_ORDERS]
        known = [(order, row["error_y3_short"]) for order, row in of_orders if row is not None]
        off = [f"{order}" for order, error in known if error > VISIBLE]
        errors = ", ".join(f"{number(1e3 * error)} mm (order {order})" for order, error in known)
        lines.append(
            f"GSTIFF stand-in, h = {step:g} s, over 2 s: y3 is wrong by {errors}. By more than "
            f"{1e3 * VISIBLE:g} mm, visible in a figure, at the orders {', '.join(off) or '(none)'}. The paper, which "
            f"does not tell the order: Gstiff {said}."
        )
    both_hold = [
        f"{order} (for any limit of what is visible from {number(1e3 * low)} to {number(1e3 * high)} mm)"
        for order in GEAR_ORDERS
        for low, high in _limits(rows, order)
        if low <= VISIBLE < high
    ]
    lines.append(
        f"Both of these statements of the paper hold with the stand-in of order {', '.join(both_hold) or '(none)'}."
    )
    long = [(order, _gear(rows, order, "accurate", 0.01)) for order in GEAR_ORDERS]
    texts = [
        f"{number(row['error_y3'])} m (order {order}, energy {row['energy']:+.2g} J)"
        if row["status"] == "REACHED_END"
        else f"failed (order {order})"
        for order, row in long
        if row is not None
    ]
    wrong = [order for order, row in long if row is not None and not row["error_y3"] <= VISIBLE]
    lines.append(
        f"GSTIFF stand-in, h = 0.01 s, over {t_end:g} s: y3 is wrong by {'; '.join(texts)}; {len(wrong)} of {len(texts)} "
        "orders visibly so. The paper: obviously wrong."
    )
    steps = [(order, needed(rows, gear_name(order))) for order in GEAR_ORDERS]
    tried = [(order, step) for order, step in steps if _find(rows, gear_name(order), None) is not None]
    texts = [f"{number(step)} s (order {order})" for order, step in tried if not np.isnan(step)]
    never = ", ".join(f"{order}" for order, step in tried if np.isnan(step))
    lines.append(
        f"For {1e3 * VISIBLE:g} mm over {t_end:g} s the stand-in needs a step of at most {', '.join(texts)}"
        + (f"; no step tried suffices at order {never}." if never else ".")
    )
    known = rows[(rows["group"] == "line-up") & rows["growth"].notna()]
    growth = ", ".join(f"{row['solver']} {row['growth']:.1f}" for _, row in known.iterrows())
    lines.append(f"Exponent p with which the error in y3 grows as t^p in the last decade of time: {growth}.")
    gained = [f"{order}" for order in GEAR_ORDERS if _sign(rows, order) > 0]
    lost = [f"{order}" for order in GEAR_ORDERS if _sign(rows, order) < 0]
    lines.append(
        f"At steps of 0.005 s and less the stand-in loses energy at the orders {', '.join(lost) or '(none)'} and gains "
        f"it at {', '.join(gained) or '(none)'} (accurate start)."
    )
    fixed = rows[rows["group"].isin(("GSTIFF stand-in", "Exudyn")) | rows["solver"].str.startswith("Exudyn")]
    failed = fixed[fixed["status"] != "REACHED_END"].drop_duplicates(["solver", "h"])
    ended = "; ".join(f"{row['solver']}, h = {row['h']:g} s" for _, row in failed.iterrows())
    lines.append(f"Runs that ended before {t_end:g} s: {ended or 'none'}.")
    return lines


def _limits(rows: pd.DataFrame, order: int) -> list[tuple[float, float]]:
    """Errors within 2 s at h = 0.01 and 0.02 s, m, if known: for a limit between them the stand-in does as Gstiff did."""
    short, long = (_gear(rows, order, "accurate", step) for step in (0.01, 0.02))
    if long is None or short is None:
        return []
    return [(short["error_y3_short"], long["error_y3_short"])]


def _sign(rows: pd.DataFrame, order: int) -> float:
    """Sign of the energy error at small steps; 0 if it is not the same at all of them."""
    found = rows[(rows["solver"] == gear_name(order)) & (rows["h"] <= 0.005)]
    signs = set(np.sign(found["energy"]))
    return float(signs.pop()) if len(signs) == 1 else 0.0


TABLE = (
    "solver", "setting", "y3, 2 s (m)", "y3 (m)", "q (m, rad)", "growth", "good until (s)", "past y = 0 (m)", "top at the end (m)",
    "energy, 2 s (J)", "energy (J)", "steps", "evaluations", "CPU (s)", "ended",
)  # fmt: skip


def table(rows: pd.DataFrame) -> list[list[str]]:
    """One line a run."""
    lines = []
    for _, row in rows.iterrows():
        setting = next(f"{name} {row[name]:.0e}" for name in ("h", "err_out", "tol") if pd.notna(row.get(name)))
        keys = (
            "error_y3_short",
            "error_y3",
            "error_q",
            "growth",
            "good_until",
            "top",
            "top_late",
            "energy_short",
            "energy",
        )
        numbers = [number(row[name]) for name in keys]
        counts = [number(row[name], 3) for name in ("n_steps", "n_evaluations")]
        ended = row["status"].lower().replace("_", " ") + (" ★" if row["lost"] else " †" if row["astray"] else "")
        lines.append([row["solver"], setting, *numbers, *counts, f"{row['cpu_s']:.3f}", ended])
    return lines


def grid(rows: pd.DataFrame, what: str) -> tuple[list[str], list[list[str]]]:
    """The stand-in: order and start by step."""
    steps = sorted(rows[rows["group"] == "GSTIFF stand-in"]["h"].unique(), reverse=True)
    lines = []
    for order in GEAR_ORDERS:
        for start in gear.STARTS:
            found = [_gear(rows, order, start, step) for step in steps]
            if any(row is not None for row in found):
                texts = ["" if row is None else _cell(row, what) for row in found]
                lines.append([f"order {order}, {start} start", *texts])
    return ["largest error in y3 (m) \\ h (s)", *(f"{step:g}" for step in steps)], lines


def _cell(row: pd.Series, what: str) -> str:
    text = number(row[what])
    if pd.isna(row[what]):
        return "failed"
    return f"**{text}**" if row[what] > VISIBLE else text


def report(rows: pd.DataFrame, line: str, call: Call) -> None:
    """Write motion.md."""
    t_end = rows["t_end"].iloc[0]
    line_up = rows[rows["group"] == "line-up"]
    parts = [
        "# The motion of bar 3 (Figs. 2–5 of the paper)",
        f"Generated by {line}. Do not edit; rows in `motion.csv`, curves in `motion_series.npz`.",
        "\n".join(f"- {text}" for text in summary(rows)),
        "## Over 2 s (Fig. 2)",
        "![y3 over 2 s](motion_short.png)",
        "Height of bar 3's centre and, below, its largest error so far. Broad grey line: the true motion. Orders 4 and 6 of the stand-in "
        "are in the tables. “GSTIFF stand-in”: fixed-step BDF on the index-3 equations, not ADAMS.",
        f"The stand-in over 2 s; **more than {1e3 * VISIBLE:g} mm**, visible in a figure:",
        markdown_table(*grid(rows, "error_y3_short")),
        f"## Over {t_end:g} s (Figs. 3–5)",
        "![y3 over the long run](motion_long.png)",
        f"The same over {t_end:g} s, and its last {LAST:g} s with the true motion (dashed): amplitude shows energy lost or gained, "
        "the right side shows phase.",
        f"The stand-in over {t_end:g} s; **more than {1e3 * VISIBLE:g} mm**; “failed”: ended before:",
        markdown_table(*grid(rows, "error_y3")),
        "![Error in y3 against time](motion_error.png)",
        "Largest error in y3 so far against time, both logarithmic; the paper shows no errors. Where the error of the energy stays "
        "bounded, the phase error grows in proportion to time (slope 1); energy lost or gained in proportion to time changes the "
        "period, and the error grows with the square of time (slope 2).",
        "## All solvers, one sensible setting each",
        markdown_table(list(TABLE), table(line_up)),
        "## The stand-in and Exudyn at other steps",
        markdown_table(list(TABLE), table(rows[rows["group"] != "line-up"])),
        "## How to read this",
        _notes(rows),
    ]
    (call.out / "motion.md").write_text("\n\n".join(parts) + "\n")


def _notes(rows: pd.DataFrame) -> str:
    notes = [
        f"**Assumed geometry.** Table 2 of the paper is lost: {rows['problem'].iloc[0]} is assumed. What the paper says "
        "of one mechanism is looked for in another of its kind.",
        "**GSTIFF stand-in**: "
        + gear.LABEL.format(order="1 to 6")
        + ", not ADAMS. ADAMS's GSTIFF changes its order, and the paper "
        "tells neither order nor error setting. Its start: “ramp” is "
        + gear.STARTS["ramp"]
        + "; “accurate” is "
        + gear.STARTS["accurate"]
        + ". Ramp limits the order to 2, whatever the formula, as its rows at small steps show.",
        "**Errors** are largest absolute differences at the stored instants (up to 20000, and all in the first 2 s) from a "
        "one-coordinate formulation integrated apart from everything here (`references/four_bar_minimal.py`). “Good until”: when "
        f"y3 is first more than {1e3 * VISIBLE:g} mm off. “Growth”: p of error ~ t^p, from the largest error up to a tenth of the run to that up to its end. “Past y = 0”: "
        "the largest y3 (0 at the start, and never more in the true motion). “Top at the end”: the largest y3 of the last one and a "
        "half periods, near 0 if the motion still comes back to where it started. Both are looked for between steps too, on the "
        "polynomials through y3, its rate and its acceleration.",
        "**Energy** is the E − E(0) of greatest magnitude.",
        f"★: energy error of more than {LOST:.0%} of the largest kinetic energy, {number(rows['kinetic'].iloc[0])} J, or not at the "
        f"end; †: y3 more than {ASTRAY:.0%} of its range, {number(rows['range_y3'].iloc[0])} m, off.",
        "**CPU times** are of single runs; medians are in `table3.md`. Compare at equal error, not at equal setting.",
        "**Exudyn**: "
        + "; ".join(f"`{name}` is {label}" for name, label in exudyn_four_bar.SOLVERS.items())
        + "; a number after GeneralizedAlpha is the spectral radius. A radius of 1, no damping, is unstable on index 3.",
        "**Settings**: `err_out` with err_in = 1e-9 (and Atol = Rtol = 1e-5 for PaperIRK); `tol` = rtol = atol; `h` is a fixed step.",
    ]
    return "\n".join(f"- {note}" for note in notes)


def figures(rows: pd.DataFrame, series: dict[str, Array], call: Call) -> None:
    """Draw the three figures."""
    _short(rows, series, call)
    _long(rows, series, call)
    _error(rows, series, call)


def _label(row: pd.Series) -> str:
    return f"order {row['order']:.0f}" if pd.notna(row.get("order")) else str(row["solver"])


def _color(row: pd.Series, k: int) -> str:
    return COLORS[int(row["order"])] if pd.notna(row.get("order")) else f"C{(0, 1, 2, 4, 5, 6, 8, 9)[k % 8]}"


def _short(rows: pd.DataFrame, series: dict[str, Array], call: Call) -> None:
    t = series["short"]
    plot, axes = plt.subplots(
        2, 3, figsize=(11, 5.6), sharex=True, sharey="row", layout="constrained", height_ratios=(3, 2)
    )
    for (title, entries), upper, lower in zip(SHORT_PANELS.items(), axes[0], axes[1], strict=True):
        upper.plot(t, series["truth short"], color="black", lw=3, alpha=0.35, label="true motion")
        for k, entry in enumerate(entries):
            row = _find(rows, *entry)
            if row is not None:
                style = "--" if k == 1 and pd.isna(row.get("order")) else "-"
                upper.plot(t, series[key(row, "short")], style, color=_color(row, k), lw=1.2, label=_label(row))
                lower.semilogy(t, series[key(row, "short_error")], style, color=_color(row, k), lw=1.2)
        lower.axhline(VISIBLE, color="black", lw=0.8, ls=":")
        upper.set_title(title, fontsize=9)
        upper.legend(fontsize=7.5, loc="upper center")
        lower.set(xlabel="t (s)", ylim=(1e-9, 1.0))
    axes[0, 0].set_ylabel("y of bar 3's centre (m)")
    axes[1, 0].set_ylabel("largest error so far (m)")
    axes[1, 0].text(0.05, 1.3 * VISIBLE, "1 cm", fontsize=8)
    plot.suptitle("Height of bar 3's centre over 2 s, and its error", fontsize=10)
    plot.savefig(call.out / "motion_short.png")
    plt.close(plot)


def _long(rows: pd.DataFrame, series: dict[str, Array], call: Call) -> None:
    t = series["long"]
    shown = [row for row in (_find(rows, *entry) for entry in LONG_PANELS) if row is not None]
    plot, axes = plt.subplots(
        len(shown), 2, figsize=(11, 1.5 * len(shown) + 0.8), sharex="col", sharey=True, layout="constrained",
        width_ratios=(3, 1), squeeze=False,
    )  # fmt: skip
    end = t >= t[-1] - LAST
    for k, (row, (whole, last)) in enumerate(zip(shown, axes, strict=True)):
        y, color = series[key(row, "long")], _color(row, k)
        whole.plot(t, y, color=color, lw=0.6)
        whole.axhline(0.0, color="black", lw=0.8)
        last.plot(t[end], series["truth long"][end], "--", color="black", lw=1)
        last.plot(t[end], y[end], color=color, lw=1.2)
        last.axhline(0.0, color="black", lw=0.8)
        setting = f"h = {row['h']:g} s" if pd.notna(row.get("h")) else "settings of the paper"
        ended = (
            f"off by up to {number(row['error_y3'])} m" if row["status"] == "REACHED_END" else "ended before the end"
        )
        whole.set_title(f"{row['solver']}, {setting}: {ended}", fontsize=8.5, loc="left")
        whole.set_ylabel("y3 (m)")
    axes[0, 0].set_ylim(-1.15, 0.45)
    axes[-1, 0].set_xlabel("t (s)")
    axes[-1, 1].set_xlabel("t (s)")
    axes[0, 1].set_title(f"last {LAST:g} s; dashed: true motion", fontsize=8.5)
    plot.savefig(call.out / "motion_long.png")
    plt.close(plot)


def _error(rows: pd.DataFrame, series: dict[str, Array], call: Call) -> None:
    t = series["log"]
    plot, axes = plt.subplots(2, 2, figsize=(12, 8), sharex=True, sharey=True, layout="constrained")
    line_up = rows[rows["group"] == "line-up"]
    ours = line_up[[CATALOGUE[name].two_loop for name in line_up["solver"]]]
    others = line_up[line_up["solver"].isin(_OTHERS)]
    stand_in = rows[(rows["group"] == "GSTIFF stand-in") & ~rows["solver"].str.endswith("ramp")]
    panels = (
        ("Two-loop procedures", ours),
        ("Other people's solvers", others),
        ("GSTIFF stand-in, h = 0.01 s", stand_in[stand_in["h"] == 0.01]),
        ("GSTIFF stand-in, order 2 (—) and 5 (– –), by step", stand_in[stand_in["order"].isin((2, 5))]),
    )
    for panel, (title, part) in zip(axes.flat, panels, strict=True):
        by_step = part is panels[3][1]
        shades = sorted(part["h"].unique(), reverse=True) if by_step else []
        for k, (_, row) in enumerate(part.iterrows()):
            color, style = f"C{k % 10}", "-" if k < 10 else "--"
            label = f"{row['solver']}, {_setting(row)}"
            if by_step:
                color, style = f"C{shades.index(row['h'])}", "-" if row["order"] == 2 else "--"
                label = f"h = {row['h']:g} s" if row["order"] == 2 else ""
            elif pd.notna(row.get("order")):
                color, label = COLORS[int(row["order"])], f"order {row['order']:.0f}"
            panel.loglog(t, np.maximum(series[key(row, "log")], 1e-14), style, color=color, lw=1.2, label=label)
        panel.axhline(VISIBLE, color="black", lw=0.8, ls=":")
        panel.set_title(title, fontsize=9)
        panel.legend(fontsize=7, loc="center left", bbox_to_anchor=(1.0, 0.5))
    for panel in axes[1]:
        panel.set_xlabel("t (s)")
    for panel in axes[:, 0]:
        panel.set_ylabel("largest error in y3 so far (m)")
    axes[0, 0].set_ylim(1e-13, 2.0)
    axes[0, 0].text(0.11, 1.4 * VISIBLE, "1 cm", fontsize=8)
    plot.suptitle("How the error of y3 grows with time", fontsize=10)
    plot.savefig(call.out / "motion_error.png")
    plt.close(plot)


_OTHERS = [name for name in LINE_UP if not CATALOGUE[name].two_loop and not name.startswith("GSTIFF")]


def _setting(row: pd.Series) -> str:
    return next(f"{name} {row[name]:.0e}" for name in ("h", "err_out", "tol") if pd.notna(row.get(name)))
