"""The text and the figures of the energy study, from its rows."""

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd

from studies.energy_drift import (
    BDF_LOOP,
    CREEPS,
    DRIFTS,
    GAUSS,
    GAUSS_12,
    IS_LOST,
    LOBATTO,
    MIDPOINT,
    MOMENTA_LASTING,
    MOMENTA_SYMMETRIC,
    NEWMARK_HALF,
    NEWMARK_QUARTER,
    NO_DRIFT,
    ONE,
    PAPER_IRK,
    PAPER_NEWMARK_HALF,
    PAPER_NEWMARK_QUARTER,
    RADAU,
    RESOLVED,
    ROUNDS,
    SUN,
    SWITCHING,
    VELOCITIES_LASTING,
    VELOCITIES_SYMMETRIC,
    WANDERS,
    WANTED,
    bound,
    error_of,
    pick,
    times_less,
)
from studies.energy_why import ORDERS, WHY
from studies.report import Call, markdown_table, number
from studies.runs import LOST


def _factor(value: float) -> str:
    """A ratio of drifts, which two digits describe well enough."""
    return number(float(f"{value:.2g}"))


def headline(rows: pd.DataFrame) -> str:
    """One line for the index of reports."""
    sun, gauss = (pick(rows, ONE, solver, VELOCITIES_LASTING) for solver in (SUN, GAUSS))
    return (
        f"Fixed h = {sun['h']:g} s over {sun['t_end']:g} s: Sun's method on (q_i, v_i) {_told(sun)}; Gauss(3) at the same "
        f"step {_told(gauss)}, at least {_factor(times_less(rows, gauss))} times less."
    )


def _told(row: pd.Series) -> str:
    """A run in words: its drift where there is one, else how small it must be."""
    change = number(row["slope"] * row["t_end"])
    return {
        DRIFTS: f"drifts by {change} J",
        CREEPS: f"creeps by {change} J",
        ROUNDS: f"drifts by {change} J, within rounding",
        WANDERS: f"wanders, by {change} J",
        NO_DRIFT: f"shows no drift (at most {number(bound(row) * row['t_end'])} J)",
        IS_LOST: f"is lost (energy error {number(row['largest'])} J)",
    }.get(row["verdict"], row["verdict"])


def _name(row: pd.Series) -> str:
    """Method with what is not the default."""
    extra = [row["variables"]] * (row["variables"] != "velocities")
    extra += ["symmetric partition"] * (row["partition"] != "lasting")
    return ", ".join([row["solver"], *extra])


FIXED_HEADER = (
    "method",
    "variables",
    "partition",
    "h (s)",
    "drift (J per 1000 s)",
    "± standard error",
    "drift over the run (J)",
    "swing in a window (J)",
    "largest error (J)",
    "Sun's drift is … times larger",
    "evaluations",
    "partitions",
    "verdict",
)


def fixed_table(rows: pd.DataFrame, geometry: str) -> str:
    """The long runs with fixed steps on one geometry."""
    chosen = rows[(rows["geometry"] == geometry) & (rows["t_end"] == rows["t_end"].max()) & rows["h"].notna()]
    table = []
    for _, row in chosen.iterrows():
        ratio = times_less(rows, row)
        unresolved = row["verdict"] in (NO_DRIFT, WANDERS)
        least = "≥ " if unresolved and not np.isnan(ratio) else ""
        if not unresolved and not np.isnan(ratio):
            ratio *= bound(row) / abs(row["slope"])
        line = [row["solver"], row["variables"], row["partition"], f"{row['h']:g}", *_drift(row)]
        line += [least + _factor(ratio), *(number(row[key], 3) for key in ("n_evaluations", "n_partitions"))]
        table.append([*line, row["verdict"]])
    return markdown_table(list(FIXED_HEADER), table)


def _drift(row: pd.Series) -> list[str]:
    values = (1000.0 * row["slope"], 1000.0 * row["slope_error"], row["slope"] * row["t_end"])
    return [number(value) for value in (*values, row["swing"], row["largest"])]


def variable_table(rows: pd.DataFrame, geometry: str) -> str:
    """The long runs with step-size control on one geometry, each with its error over the short run."""
    chosen = rows[(rows["geometry"] == geometry) & (rows["t_end"] == rows["t_end"].max()) & rows["tol"].notna()]
    header = ["method", "variables", "partition", "tolerance", "median h (s)", *FIXED_HEADER[4:9]]
    header += [f"error q over {rows['t_end'].min():g} s", "evaluations", "partitions", "verdict"]
    table = []
    for _, row in chosen.iterrows():
        line = [row["solver"], row["variables"], row["partition"], f"{row['tol']:.0e}", number(row["h_median"])]
        line += [*_drift(row), number(error_of(rows, row))]
        line += [number(row[key], 3) for key in ("n_evaluations", "n_partitions")]
        table.append([*line, row["verdict"]])
    return markdown_table(header, table)


def orders(rows: pd.DataFrame) -> list[list[str]]:
    """How the drift of the short runs falls with h, where one method was run with several."""
    table = []
    short = rows[(rows["t_end"] == rows["t_end"].min()) & rows["h"].notna()]
    for _, group in short.groupby(["geometry", "solver", "variables", "partition"], sort=False):
        if len(group) == 1:
            continue
        first = group.iloc[0]
        order = np.polyfit(np.log(group["h"]), np.log(group["slope"].abs()), 1)[0]
        slopes = ", ".join(
            f"{number(1000.0 * slope)} at {h:g} s" for h, slope in zip(group["h"], group["slope"], strict=True)
        )
        table.append([_name(first), first["geometry"], slopes, f"{order:.2f}"])
    return table


def _coarsest(rows: pd.DataFrame) -> pd.Series:
    """Which rows are not of the smaller steps that tell the order of a drift."""
    return rows["h"].isna() | (rows["h"] == rows.groupby("solver")["h"].transform("max"))


def short_table(rows: pd.DataFrame, geometry: str) -> str:
    """The short runs on one geometry, with their errors."""
    chosen = rows[(rows["geometry"] == geometry) & (rows["t_end"] == rows["t_end"].min()) & _coarsest(rows)]
    table = []
    for _, row in chosen.iterrows():
        setting = f"h = {row['h']:g} s" if pd.notna(row["h"]) else f"tol = {row['tol']:.0e}"
        numbers = [number(row[key]) for key in ("largest", "swing", "error_q")]
        slope = f"{number(1000.0 * row['slope'])} ± {number(1000.0 * row['slope_error'])}"
        table.append([_name(row), setting, slope, *numbers, number(row["n_evaluations"], 3), row["verdict"]])
    header = ["method", "setting", "drift (J per 1000 s)", "largest error (J)", "swing in a period (J)"]
    return markdown_table([*header, "error q (m, rad)", "evaluations", "verdict"], table)


def report(rows: pd.DataFrame, line: str, call: Call) -> None:
    """Write energy.md."""
    t_long, t_short = rows["t_end"].max(), rows["t_end"].min()
    names = {geometry: rows[rows["geometry"] == geometry]["problem"].iloc[0] for geometry in (ONE, SWITCHING)}
    parts = [
        "# Energy over long times: which methods let it drift, and why",
        f"Generated by {line}. Do not edit; rows in `energy.csv`, the windows of the figures in `energy_windows.csv`.",
        _findings(rows),
        f"## Fixed steps over {t_long:g} s",
        "![energy error over the long run, fixed steps](energy_long.png)",
        "Mean energy error in windows of whole periods, its magnitude. A bounded error stays level; a drift rises with "
        "slope 1. Both axes are logarithmic; a dip is a change of sign.",
        f"On **{ONE}**, {names[ONE]}:",
        fixed_table(rows, ONE),
        f"On **{SWITCHING}**, {names[SWITCHING]} (the default):",
        fixed_table(rows, SWITCHING),
        WHY,
        f"**Orders.** Drift in J per 1000 s against h, over {t_short:g} s, and the exponent of h that fits it:",
        markdown_table(["method", "geometry", "drift", "order"], orders(rows)),
        ORDERS,
        f"## Variable steps over {t_long:g} s",
        "![energy error over the long run, variable steps](energy_variable.png)",
        f"On **{ONE}**, {names[ONE]}:",
        variable_table(rows, ONE),
        f"On **{SWITCHING}**, {names[SWITCHING]}:",
        variable_table(rows, SWITCHING),
        f"## {t_short:g} s, every step",
        "![largest energy error in each period, short run](energy_short.png)",
        "Largest energy error in each period, with fixed steps (solid) and variable ones (dashed). Over so short a time most drifts are smaller than the swing within a "
        "period: a run of this length cannot tell whether a method drifts, unless the swing is averaged away.",
        f"On **{ONE}**:",
        short_table(rows, ONE),
        f"On **{SWITCHING}**:",
        short_table(rows, SWITCHING),
        "## How to read this",
        _notes(rows),
    ]
    (call.out / "energy.md").write_text("\n\n".join(parts) + "\n")


def _findings(rows: pd.DataFrame) -> str:
    sun, gauss, lobatto, radau = (pick(rows, ONE, name, VELOCITIES_LASTING) for name in (SUN, GAUSS, LOBATTO, RADAU))
    canonical = pick(rows, ONE, SUN, MOMENTA_LASTING)
    needless = pick(rows, ONE, SUN, MOMENTA_SYMMETRIC)
    fixed = rows[(rows["t_end"] == rows["t_end"].max()) & (rows["h"] == sun["h"])]
    enough = np.array([times_less(rows, row) >= WANTED for _, row in fixed.iterrows()])
    met = fixed[(fixed["verdict"] == NO_DRIFT) & enough]
    switching = [pick(rows, SWITCHING, SUN, variant) for variant in (VELOCITIES_LASTING, MOMENTA_LASTING)]
    switching += [pick(rows, SWITCHING, SUN, variant) for variant in (VELOCITIES_SYMMETRIC, MOMENTA_SYMMETRIC)]
    even = [
        pick(rows, SWITCHING, name, variant)
        for name, variant in (
            (GAUSS, VELOCITIES_SYMMETRIC),
            (GAUSS, MOMENTA_SYMMETRIC),
            (LOBATTO, VELOCITIES_SYMMETRIC),
            (LOBATTO, MOMENTA_SYMMETRIC),
        )
    ]
    waiting = [pick(rows, SWITCHING, GAUSS, variant) for variant in (VELOCITIES_LASTING, MOMENTA_LASTING)]
    lasting = rows[(rows["t_end"] == rows["t_end"].max()) & (rows["geometry"] == SWITCHING) & rows["h"].notna()]
    lasting = lasting[lasting["partition"] == "lasting"]
    n_gone = int((~lasting["verdict"].isin([NO_DRIFT, WANDERS, ROUNDS])).sum())
    newmark = [
        pick(rows, geometry, name, VELOCITIES_LASTING)
        for geometry in (ONE, SWITCHING)
        for name in (NEWMARK_QUARTER, NEWMARK_HALF)
    ]
    paper = [pick(rows, geometry, PAPER_IRK, VELOCITIES_LASTING, fixed=False) for geometry in (ONE, SWITCHING)]
    controlled = [
        pick(rows, ONE, name, variant, fixed=False)
        for name, variant in ((SUN, VELOCITIES_LASTING), (SUN, MOMENTA_LASTING), (RADAU, VELOCITIES_LASTING))
    ]
    control = [pick(rows, ONE, GAUSS_12, VELOCITIES_LASTING), pick(rows, SWITCHING, GAUSS_12, VELOCITIES_SYMMETRIC)]
    variable = rows[(rows["t_end"] == rows["t_end"].max()) & rows["tol"].notna()]
    counts = ", ".join(f"{n} {what}" for what, n in variable["verdict"].value_counts().items())
    span = f"{sun['t_end']:g} s at h = {sun['h']:g} s"
    findings = [
        f"**Sun's method, as published on (q_i, v_i), {_told(sun)}** over {span}, on a geometry whose partition never "
        f"changes. At the same step Gauss(3) {_told(gauss)}: at least {_factor(times_less(rows, gauss))} times less than "
        f"Sun's, for {gauss['n_evaluations'] / sun['n_evaluations']:.2f} times the evaluations (position errors over "
        f"{rows['t_end'].min():g} s: {number(error_of(rows, gauss))} and {number(error_of(rows, sun))}). Lobatto IIIE(4) "
        f"{_told(lobatto)}; Radau IIA(3), neither symplectic nor symmetric, {_told(radau)}.",
        f"**The same tableau in canonical variables (q_i, p_i) {_told(canonical)}**: at least "
        f"{_factor(times_less(rows, canonical))} times less, at a position error of {number(error_of(rows, canonical))}."
        + _blame(sun, canonical),
        f"No drift where Sun's method on (q_i, v_i) drifts at least {WANTED:g} times more: "
        + ("; ".join(f"{_name(row)} ({row['geometry']})" for _, row in met.iterrows()) or "no run")
        + ".",
        f"**Where the partition changes** (default geometry, {int(switching[0]['n_partitions'])} partitions in the run) and "
        f"lasts until it is worn, {n_gone} of {len(lasting)} runs drift, are lost or fail: "
        + "; ".join(f"{_name(row)} {_told(row)}" for row in (switching[0], switching[1], *waiting))
        + ".",
        "With a partition chosen symmetrically in time the symmetric tableaux: "
        + "; ".join(f"{_name(row)} {_told(row)}" for row in even)
        + ". Sun's tableau, which is not symmetric, there: "
        + "; ".join(f"{_name(row)} {_told(row)}" for row in switching[2:])
        + f". On the first geometry, where one partition would do, the symmetric choice changes it "
        f"{int(needless['n_partitions'])} times, and Sun's method on momenta then {_told(needless)}.",
        f"**Variable steps**: of {len(variable)} long runs with step-size control {counts}. The paper's procedure "
        f"(PaperIRK, Atol = Rtol = {paper[0]['tol']:g}) {_told(paper[0])} on one partition and {_told(paper[1])} on the "
        f"default geometry, {paper[0]['largest'] / paper[0]['kinetic']:.2%} and "
        f"{paper[1]['largest'] / paper[1]['kinetic']:.2%} of the largest kinetic energy. "
        + _credit(paper)
        + f"At one tolerance ({controlled[0]['tol']:.0e}, one partition; position errors "
        + ", ".join(number(error_of(rows, row)) for row in controlled)
        + f") Sun's tableau {_told(controlled[0])}, in canonical variables it "
        f"{_told(controlled[1])}, and Radau IIA(3), which is not symplectic, {_told(controlled[2])}: at equal tolerance, not equal error.",
        f"**Newmark** (h = {newmark[0]['h']:g} s): β = 1/4 {_told(newmark[0])}, β = 1/2 {_told(newmark[1])} on one "
        f"partition; where the partition changes β = 1/4 {_told(newmark[2])}, β = 1/2 {_told(newmark[3])}. With γ = 1/2 "
        "it is a symmetric method, too, but its partition is not chosen symmetrically.",
        f"Checks: the energy of the exact motion, sampled at the same instants, is constant to "
        f"{number(rows['largest_exact'].max())} J; Gauss(6), whose truncation error is below rounding on one partition, "
        f"{_told(control[0])}, and with a symmetric partition on the default geometry {_told(control[1])}.",
    ]
    return "\n".join(f"- {text}" for text in findings)


def _blame(sun: pd.Series, canonical: pd.Series) -> str:
    """What the drift on velocities comes from, if there is none on momenta."""
    if sun["verdict"] not in (DRIFTS, CREEPS) or canonical["verdict"] != NO_DRIFT:
        return ""
    return (
        " What drifts is not Sun's tableau but its use on (q_i, v_i), where it is not a symplectic map ([why](#why))."
    )


def _credit(paper: list[pd.Series]) -> str:
    """Why the paper's procedure is good for long, if it drifts and yet little."""
    if any(row["verdict"] not in (DRIFTS, CREEPS) for row in paper):
        return ""
    return (
        "As it drifts, a symplectic tableau, to which the paper ascribes its stability, is not what keeps it stable: the energy error is no larger because "
        "the local error is small. "
    )


def _notes(rows: pd.DataFrame) -> str:
    long = rows[rows["t_end"] == rows["t_end"].max()]
    windows = long.groupby("geometry")["n_windows"].max()
    notes = [
        "**Assumed geometry.** Table 2 of the paper is lost. "
        f"{rows[rows['geometry'] == SWITCHING]['problem'].iloc[0]} is assumed; the other geometry was chosen here because one "
        "partition serves it for the whole run. Uniform rods of 1 kg/m, g = 9.81 m/s², released from rest; largest kinetic "
        "energies "
        + " and ".join(
            f"{rows[rows['geometry'] == name]['kinetic'].iloc[0]:.3g} J ({name})" for name in (ONE, SWITCHING)
        )
        + ".",
        "**Energy error** is E(t) − E(0), taken at every step; in the long runs with fixed steps, of PaperNewmark and of BDF, which have too "
        "many to keep, at intervals of a tenth of a period: a quarter of its golden section, with fixed steps rounded to a "
        "multiple of h, so that samples spread evenly over the phases and a beat of samples and period is not taken for a "
        "drift. This changes no fixed step, and shortens one or two of PaperNewmark's hundred or more and of BDF's twenty in each "
        "interval. Other methods with step-size control do not land on given times: their steps are so long that landing three times "
        "in a period was seen to change their drift up to threefold.",
        f"**Drift** is the slope of a least-squares line through the means of {int(windows[ONE])} ({ONE}) and "
        f"{int(windows[SWITCHING])} ({SWITCHING}) windows of whole periods. Its standard error comes from the slopes in ten "
        "equal parts of the run (their standard deviation over √10): right for a random walk, whose increments in the ten parts are "
        "independent, and too large rather than too small for an oscillation, so that neither passes for a drift.",
        "**Verdict**, from the numbers of the row: "
        f"*{NO_DRIFT}*: the slope is within {RESOLVED:g} standard errors of zero, and over the run it makes less than the "
        f"swing, the median range of the error within a window; *{DRIFTS}*: the slope is resolved and over the run exceeds the "
        f"swing; *{CREEPS}*: it is resolved, but over the run still smaller than the swing; *{WANDERS}*: not resolved, yet larger than the "
        f"swing; *{ROUNDS}*: resolved, but less than one rounding (2.2e-16 of the largest kinetic energy) a step; *{IS_LOST}*: the "
        f"energy error exceeds {LOST:.0%} of the largest kinetic energy, and the slope says nothing. Ten parts make {RESOLVED:g} "
        "standard errors a test at 1.5 %: of 70 runs without drift one would be called resolved by chance.",
        "**Sun's drift is … times larger**: the slope of Sun's method on (q_i, v_i) with a lasting partition, at the same step, "
        "geometry and length, over that of the row; with ≥, over the largest slope the row does not exclude (slope and "
        f"{RESOLVED:g} standard errors).",
        "**Variables**: (q_i, v_i), the paper's, or (q_i, p_i). **Partition**: lasting, kept until max |C_qd⁻¹ C_qi| has grown "
        "threefold, or symmetric, chosen in the middle of each step. Newmark, BDF, PaperIRK and PaperNewmark have no such options.",
        "**Steps** were chosen so that energy errors stand clear of rounding and every method converges: compare rows with the "
        "same h, and the methods of order 2 among themselves. Outer loops iterate to 1e-14 at fixed steps. `PaperNewmark`: the tolerance is err_out.",
        "**CPU times** are not measured here: runs share the cores. Evaluations (whole evaluations, dependents and "
        "accelerations) and steps do not depend on that.",
    ]
    return "\n".join(f"- {note}" for note in notes)


COLORS = {
    SUN: "tab:red",
    GAUSS: "tab:blue",
    LOBATTO: "tab:green",
    RADAU: "tab:orange",
    MIDPOINT: "tab:cyan",
    NEWMARK_QUARTER: "tab:gray",
    NEWMARK_HALF: "black",
    PAPER_IRK: "tab:purple",
    BDF_LOOP: "tab:olive",
    PAPER_NEWMARK_QUARTER: "tab:pink",
    PAPER_NEWMARK_HALF: "tab:brown",
}
STYLES = {VELOCITIES_LASTING: "-", VELOCITIES_SYMMETRIC: "--", MOMENTA_LASTING: ":", MOMENTA_SYMMETRIC: "-."}


def figures(rows: pd.DataFrame, series: pd.DataFrame, call: Call) -> None:
    """Draw energy_long.png, energy_variable.png and energy_short.png."""
    long = rows["t_end"] == rows["t_end"].max()
    basic = (rows["variables"] == "velocities") & (rows["partition"] == "lasting")
    fixed = rows["h"].notna() & (rows["solver"] != GAUSS_12)
    h = rows[rows["solver"] == SUN]["h"].max()
    shown = long & (rows["h"] == h) & fixed
    title = f"Fixed steps h = {h:g} s: whose energy drifts"
    _panels(rows[shown], series, "mean", title, call.out / "energy_long.png")
    controlled = rows[long & rows["tol"].notna()]
    n_drifting = int(controlled["verdict"].isin([DRIFTS, CREEPS]).sum())
    title = f"Step-size control: the energy of {n_drifting} of {len(controlled)} runs drifts"
    _panels(controlled, series, "mean", title, call.out / "energy_variable.png")
    title = "Every step of a short run: largest energy error in each period (dashed: variable steps)"
    _panels(
        rows[~long & basic & (fixed | rows["tol"].notna())], series, "largest", title, call.out / "energy_short.png"
    )


def _panels(rows: pd.DataFrame, series: pd.DataFrame, what: str, title: str, path) -> None:  # type: ignore[no-untyped-def]
    """A panel for each geometry: one line a run, its legend beside it."""
    plot, axes = plt.subplots(2, 1, figsize=(9.5, 8.0), sharex=True, layout="constrained")
    for panel, geometry in zip(axes, (ONE, SWITCHING), strict=True):
        for k, row in rows[rows["geometry"] == geometry].iterrows():
            part = series[series["run"] == k]
            style = STYLES[(row["variables"], row["partition"])]
            if what == "largest":
                style = "-" if pd.isna(row["tol"]) else "--"
            setting = f", tol = {row['tol']:.0e}" if pd.notna(row["tol"]) else f", h = {row['h']:g}"
            label = f"{_name(row)}{setting}: {row['verdict']}"
            panel.plot(part["t"], part[what].abs(), style, color=COLORS[row["solver"]], lw=1.3, label=label)
        panel.set(yscale="log", xscale="log" if what == "mean" else "linear")
        panel.set_ylabel(f"|{what} energy error| (J)" if what == "mean" else "largest energy error (J)")
        panel.set_title(f"{geometry}: {rows[rows['geometry'] == geometry]['problem'].iloc[0]}", fontsize=9)
        panel.legend(fontsize=7, loc="upper left", bbox_to_anchor=(1.0, 1.0))
    axes[-1].set_xlabel("t (s)")
    plot.suptitle(title, fontsize=10)
    plot.savefig(path)
    plt.close(plot)
