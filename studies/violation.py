"""Fig. 7 of the paper: violation of position, velocity and acceleration constraints, and what keeping them costs."""

import itertools
from collections.abc import Sequence
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from numpy.typing import NDArray

from studies import figures, study, tables
from studies.bench import Case, Run, collect
from studies.cases import four_bar
from studies.cli import StudyError
from studies.metrics import CHECKED, violations
from studies.render import number, power, render, table
from studies.solvers import ALPHAS, CATALOGUE, IDA_C, IRK, LINE_UP, OWN_EXPLICIT, baumgarte, gear, paper_irk_at
from studies.store import Output
from twoloop import Result

Array = NDArray[np.floating]

LOOPS = (1e-3, 1e-5, 1e-7, 1e-9)  # err_in and err_out of Table 3
LEVELS = {"q": "max |C| (m)", "v": "max |C_q v + C_t| (m/s)", "a": "max |C_q a − Q_d| (m/s²)"}
HEADINGS = ("max abs C (m)", "max abs C_q v + C_t (m/s)", "max abs C_q a − Q_d (m/s²)")  # a bar would end a cell
CLOSURE = slice(6, 8)  # places of (35) and (36) among the constraints
SLOPE, TIMES = 0.25, 2.0  # a violation grows when it goes like t^p with p above SLOPE and ends above TIMES its start
EQUAL = 1.1  # times cheaper: less does not count as a difference
KEPT = 1e-12  # m, m/s: a constraint violated no more than this is kept
WINDOWS = 10  # equal parts of the run, to whose largest violations the growth is fitted
CURVE = 50  # equal parts of the run, whose largest violations are drawn
ZERO = 1e-17  # what counts as a violation of zero where a logarithm is taken

PAIRS = (("DOP853, projected", "DOP853, index 1"), ("IDA, stabilised", "IDA, index1"))  # kept, not kept
PLAIN = ("LSODA, index 1", "DOP853, index 1")
OWN = ("SunRadau5", "Gauss12", OWN_EXPLICIT)
ALONG = (*itertools.chain(*PAIRS), "LSODA, index 1", baumgarte("DOP853", 10.0), IDA_C, *OWN)
QUICK_ALONG = (*PAIRS[0], baumgarte("DOP853", 10.0), *OWN)
ONCE = tuple(baumgarte(name, alpha) for name in ("DOP853", "LSODA") for alpha in ALPHAS)
DRAWN = (*PAIRS[0], "LSODA, index 1", "IDA, stabilised", IDA_C, "Gauss12", OWN_EXPLICIT)  # cost over error
EXUDYN = ("Exudyn, GeneralizedAlpha", "Exudyn, TrapezoidalIndex2")
OVER_TIME = (*PLAIN, baumgarte("DOP853", 10.0), "IDA, stabilised", gear(2), *EXUDYN)
TARGETS, MIDDLE = (1e-2, 1e-4, 1e-6), 1e-4


def runs(case: Case, quick: bool) -> list[Run]:
    """Every solver at one setting; PaperIRK by the tolerances of its loops; solvers along their tolerances."""
    line_up = [CATALOGUE[name] for name in LINE_UP]
    if quick:
        line_up = [s for s in line_up if s.family == "two-loop" or s.name.startswith(("Exudyn", "GSTIFF", "DOP853"))]
    made = [Run(case, solver, LINE_UP[solver.name], "line-up", 1) for solver in line_up]
    ends = (LOOPS[0], LOOPS[-1])
    for err_in, err_out in itertools.product(ends, ends if quick else LOOPS):
        made.append(Run(case, paper_irk_at(err_in), err_out, "loops", 1))
    for name in QUICK_ALONG if quick else dict.fromkeys((*ALONG, *ONCE)):
        repeats = 3 if name in ALONG and not quick else 1
        values = (1e-5, 1e-7) if quick else CATALOGUE[name].grid(case)
        made += [Run(case, CATALOGUE[name], value, "tolerances", repeats) for value in values]
    return made


def _windows(t: Array, size: Array, n: int) -> Array:
    """Largest value in each of n equal parts of the run; NaN where nothing is stored."""
    places = np.minimum((t / t[-1] * n).astype(int), n - 1)
    return np.array([size[places == k].max(initial=ZERO) if (places == k).any() else np.nan for k in range(n)])


def growth(t: Array, size: Array) -> float:
    """Exponent p of size ~ t^p: least squares through the largest values of equal parts of the run."""
    values = _windows(t, size, WINDOWS)
    ends = np.arange(1, WINDOWS + 1)  # where what grows is largest
    known = ~np.isnan(values)
    return float(np.polyfit(np.log10(ends[known]), np.log10(values[known]), 1)[0])


def measure(run: Run, result: Result) -> dict[str, Any]:
    """Columns of this study, and the curves of the figure in the entry "series"."""
    if result.t.size < WINDOWS or run.group == "tolerances":  # of those the common columns are enough
        return {}
    system = run.case.problem.system
    t, levels = violations(system, result)
    row: dict[str, Any] = {"series": {}}
    for level, size in levels.items():
        parts = _windows(t, size, WINDOWS)
        row[f"growth_{level}"], row[f"early_{level}"], row[f"late_{level}"] = growth(t, size), parts[0], parts[-1]
        row["series"][level] = _windows(t, size, CURVE)
    stored = np.searchsorted(result.t, t)
    closure = np.array([system.constraint(result.t[k], result.q[:, k].copy())[CLOSURE] for k in stored])
    row["violation_35"], row["violation_36"] = np.abs(closure).max(axis=0)
    return row


def make(output: Output) -> tuple[pd.DataFrame, dict[str, Array]]:
    """Make all rows, and the curves of the figure."""
    quick = output.call.quick
    case = four_bar.cases(quick)[0]
    with output.kept() as kept:
        rows = collect(runs(case, quick), kept, measure)
    rows["own_accelerations"] = [CATALOGUE[solver].own_accelerations for solver in rows["solver"]]
    drawn = rows[(rows["group"] == "line-up") & rows["series"].map(lambda each: isinstance(each, dict))]
    series = {
        f"{row['solver']} {level}": np.array(row["series"][level], dtype=float)
        for _, row in drawn.iterrows()
        for level in ("q", "v")
    }
    return rows.drop(columns="series"), series


def grows(row: pd.Series, level: str) -> bool:
    """Whether the violation of a level grows, by the criterion of the report."""
    return bool(row[f"growth_{level}"] > SLOPE and row[f"late_{level}"] > TIMES * row[f"early_{level}"])


def kind(row: pd.Series, level: str) -> str:
    """ "kept", "grows" or "bounded"."""
    if row[f"violation_{level}"] <= KEPT:
        return "kept"
    return "grows" if grows(row, level) else "bounded"


def pair(rows: pd.DataFrame, first: str, second: str) -> dict[str, Any] | None:
    """Evaluations and CPU time of the first solver over those of the second at equal error; None if never reached."""
    one, two = (rows[rows["solver"] == name] for name in (first, second))
    if one.empty or two.empty:
        return None
    # where all runs of a solver are better than a target, its cost at the target is not known
    least = min(one["error_q"].max(), two["error_q"].max())
    ratios = []
    for target in (10.0**-k for k in range(1, 9)):
        of = [tables.time_for(one, target, what) / tables.time_for(two, target, what) for what in _COSTS]
        if least >= target and not np.isnan(of).any():
            ratios.append((target, *of))
    if not ratios:
        return None
    targets, evaluations, cpu = zip(*ratios, strict=True)
    found = {"first": first, "second": second, "errors": [max(targets), min(targets)]}
    found |= {"evaluations": [min(evaluations), max(evaluations)], "cpu": [min(cpu), max(cpu)]}
    return found | {"dearer": min(cpu) > 1.0, "cheaper": max(cpu) < 1.0}


_COSTS = ("n_evaluations", "cpu_s")


def cheapest(along: pd.DataFrame, target: float) -> dict[str, Any]:
    """The cheapest solver that keeps the constraints and the cheapest that does not, for an error."""
    ranked = tables.ranking(along, target)
    found: dict[str, Any] = {"error": target, "kept": None, "drifting": None, "ratio": None}
    if ranked.empty:
        return found
    keeps = ranked["keeps_constraints"].astype(bool)
    for name, part in (("kept", ranked[keeps]), ("drifting", ranked[~keeps])):
        if not part.empty:
            found[name] = {k: part.iloc[0][k] for k in ("solver", "cpu_s", "called_from", "violation_q")}
    if found["kept"] and found["drifting"]:
        found["ratio"] = found["kept"]["cpu_s"] / found["drifting"]["cpu_s"]
    return found


def findings_of(rows: pd.DataFrame) -> dict[str, Any]:
    """What the report says, from the medians."""
    line_up, loops = (rows[rows["group"] == group] for group in ("line-up", "loops"))
    along = rows[rows["group"] == "tolerances"]
    ours = line_up[line_up["family"] == "two-loop"]
    irk = ours[ours["solver"] == IRK]
    loose = loops[(loops["err_in"] == LOOPS[0]) & loops["err_out"].isin((LOOPS[0], LOOPS[-1]))].set_index("err_out")
    if irk.empty or len(loose) < 2:
        raise StudyError("the rows lack runs of PaperIRK; make them again by python -m studies.violation")
    irk = irk.iloc[0]
    measured = ours[ours["growth_q"].notna()]
    growing = [row["solver"] for _, row in measured.iterrows() if any(grows(row, level) for level in LEVELS)]
    plain = line_up[line_up["solver"].isin(PLAIN) & line_up["growth_q"].notna()]
    bounded = line_up[line_up["solver"].str.contains("Baumgarte") & line_up["growth_q"].notna()]
    of_alpha = along[along["solver"].str.contains("Baumgarte") & along["error_q"].notna()]["violation_q"]
    eq6, own = (line_up[line_up["own_accelerations"].astype(bool) == which] for which in (False, True))
    return {
        "t_end": float(rows["t_end"].iloc[0]),
        "floor": float(rows["floor"].max()),
        "problem": rows["problem"].iloc[0],
        "kept": KEPT,
        "slope": SLOPE,
        "times": TIMES,
        "equal": EQUAL,
        "checked": CHECKED,
        "v35": irk["violation_35"],
        "v36": irk["violation_36"],
        "irk_grows": grows(irk, "q"),
        "irk_exponent": round(irk["growth_q"], 2) + 0.0,  # no minus zero
        "n_ours": len(ours),
        "ours": [ours[f"violation_{level}"].max() for level in LEVELS],
        "ours_keep": bool((ours[["violation_q", "violation_v"]].max(axis=1) <= KEPT).all()),
        "ours_growing": growing,
        "inner_loose": float(loose.loc[LOOPS[-1], "violation_q"]),
        "both_loose": float(loose.loc[LOOPS[0], "violation_q"]),
        "loose": LOOPS[0],
        "tight": LOOPS[-1],
        "inner_alone_kept": bool(loose.loc[LOOPS[-1], "violation_q"] <= KEPT),
        "both_kept": bool(loose.loc[LOOPS[0], "violation_q"] <= KEPT),
        "plain": [str(name) for name in plain["solver"]],
        "plain_growing": [row["solver"] for _, row in plain.iterrows() if grows(row, "q")],
        "plain_violation": plain["violation_q"].max(),
        "baumgarte_growing": [row["solver"] for _, row in bounded.iterrows() if grows(row, "q")],
        "baumgarte": [of_alpha.min(), of_alpha.max()] if len(of_alpha) else [],
        "baumgarte_n": len(of_alpha),
        "baumgarte_kept": int((of_alpha <= KEPT).sum()),
        "eq6_a": eq6["violation_a"].max(),
        "own_a": [own["violation_a"].min(), own["violation_a"].max()],
        "own_worse": bool(own["violation_a"].min() > eq6["violation_a"].max()),
        "cheapest": [cheapest(along, target) for target in TARGETS],
        "pairs": [found for found in (pair(along, *names) for names in PAIRS) if found],
        "gauss": pair(along, "Gauss12", "DOP853, projected"),
        "n_failed": int((rows["status"] != "REACHED_END").sum()),
    }


def setting(row: pd.Series) -> str:
    """Name and value of the setting that varies."""
    return next(f"{name} {power(row[name])}" for name in ("h", "err_out", "tol") if pd.notna(row.get(name)))


def line_up_table(rows: pd.DataFrame) -> str:
    """Violations of all solvers at one setting, a line each."""
    header = ["solver", "called from", "setting", "error", *HEADINGS]
    lines = []
    for _, row in rows[(rows["group"] == "line-up") & rows["violation_q"].notna()].iterrows():
        cells = [row["solver"], row["called_from"], setting(row), number(row["error_q"])]
        for level in "qv":
            cells.append(f"{number(row[f'violation_{level}'])} {kind(row, level)}")
        cells.append(f"{number(row['violation_a'])}{'' if row['own_accelerations'] else ' ='}")
        lines.append(cells)
    return table(header, lines)


def cost_table(along: pd.DataFrame) -> str:
    """CPU time for some errors; evaluations and violations at one of them."""
    names = [name for name in (*ALONG, "LSODA, Baumgarte 10") if (along["solver"] == name).any()]
    work = tables.work_precision(along, TARGETS, names)
    ranked = tables.ranking(along, MIDDLE)
    at = {} if ranked.empty else ranked.set_index("solver").to_dict("index")
    header = ["solver", "called from", *(f"CPU (s), {power(target)}" for target in TARGETS)]
    header += [f"{what}, {power(MIDDLE)}" for what in ("evaluations", *HEADINGS[:2])]
    lines = []
    for line in work:
        costs = at.get(line[0])
        keys = ("n_evaluations", "violation_q", "violation_v")
        lines.append(line + (["not reached"] * 3 if costs is None else [number(costs[key]) for key in keys]))
    return table(header, lines)


def baumgarte_table(along: pd.DataFrame) -> str:
    """max |C| / error by stabilisation (lines) and tolerance (columns)."""
    tolerances = sorted(along["tol"].dropna().unique(), reverse=True)
    lines = []
    for method in ("DOP853", "LSODA"):
        names = [f"{method}, index 1", *(baumgarte(method, alpha) for alpha in ALPHAS)]
        for name in names:
            part = along[along["solver"] == name].set_index("tol")
            if not part.empty:
                lines.append([name, *(_two(part.loc[tol]) if tol in part.index else "not run" for tol in tolerances)])
    return table(["max abs C / error; tolerance", *(power(tol) for tol in tolerances)], lines)


def _two(row: pd.Series) -> str:
    if pd.isna(row["error_q"]):
        return str(row["status"]).lower().replace("_", " ")
    return f"{number(row['violation_q'])} / {number(row['error_q'])}"


def over_time(rows: pd.DataFrame, series: dict[str, Array], t_end: float) -> Figure:
    """Largest violation in each part of the run, positions and velocities."""
    t = (np.arange(CURVE) + 0.5) * t_end / CURVE
    line_up = rows[rows["group"] == "line-up"].set_index("solver", drop=False)
    ours = [name for name in line_up.index[line_up["family"] == "two-loop"] if f"{name} q" in series]
    figure, axes = plt.subplots(1, 2, figsize=(9.2, 3.8), sharex=True, sharey=True, layout="constrained")
    for panel, level in zip(axes, ("q", "v"), strict=True):
        sizes = np.array([series[f"{name} {level}"] for name in ours])
        low, high = np.nanmin(sizes, axis=0), np.nanmax(sizes, axis=0)
        panel.fill_between(t, low, high, color=figures.GREY, alpha=0.5, lw=0, label="all two-loop procedures")
        for name in OVER_TIME:
            if f"{name} {level}" in series:
                row = line_up.loc[name]
                look = figures.style(name, row["family"], bool(row["keeps_constraints"]))
                panel.plot(t, series[f"{name} {level}"], label=name, markevery=7, **look)
        panel.set(xlabel="t (s)", yscale="log", ylabel=LEVELS[level])
        panel.tick_params(labelleft=True)
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside right upper")
    figure.suptitle("Largest violation in each fiftieth of the run", fontsize=10)
    return figure


def report(output: Output, rows: pd.DataFrame, series: dict[str, Array], line: str) -> dict[str, Any]:
    """Write findings, figures and report; the findings."""
    rows = tables.medians(rows)
    found = findings_of(rows)
    output.save_findings(found)
    along = rows[rows["group"] == "tolerances"]
    figures.save(over_time(rows, series, found["t_end"]), output, "violation")
    drawn = [name for name in DRAWN if (along["solver"] == name).any()]
    seconds = f"{found['problem']}, {number(found['t_end'])} s"
    figures.save(figures.work_precision(along, drawn, seconds), output, "violation_cost")
    ready = {
        "line_up": line_up_table(rows),
        "cost": cost_table(along),
        "baumgarte": baumgarte_table(along),
        "failed": table(["solver", "setting", "status", "message"], tables.failures(rows)),
    }
    output.write("violation.md", render("violation", found, ready, stamp=line, quick=output.call.quick))
    return found


def main(words: Sequence[str] | None = None) -> None:
    """Run the study and write its report."""
    study.run("violation", __doc__, words, make, report)


if __name__ == "__main__":
    main()
