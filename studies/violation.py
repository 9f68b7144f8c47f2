"""Fig. 7 of the paper: violation of position, velocity and acceleration constraints, and what keeping them costs."""

from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from references.scipy.index1 import ALPHAS, baumgarte
from studies.bench import figures, tables
from studies.bench.cases import four_bar
from studies.bench.cli import StudyError
from studies.bench.collector import REPEATS, Run
from studies.bench.metrics import CHECKED, violations
from studies.bench.render import number
from studies.bench.solvers import (
    CATALOGUE,
    CVODE_C,
    CVODE_C_PROJECTED,
    GIVEN,
    HEYOKA,
    IDA_C,
    IRK,
    LINE_UP,
    OWN_EXPLICIT,
    gear,
    paper_irk_at,
)
from studies.bench.store import Array
from studies.bench.study import Study, rows_of
from twoloop import Result

LOOSE, TIGHT = 1e-3, 1e-9  # err_in and err_out of Table 3
LEVELS = {"q": "max |C| (m)", "v": "max |C_q v + C_t| (m/s)", "a": "max |C_q a − Q_d| (m/s²)"}
CLOSURE = slice(6, 8)  # places of (35) and (36) among the constraints
# a violation grows when it goes like t^p with p at least that of a random walk, and ends above TIMES its start
SLOPE, TIMES = 0.5, 2.0
KEPT = 1e-12  # m, m/s: a constraint violated no more than this is kept
WINDOWS = 10  # equal parts of the run, to whose largest violations the growth is fitted
CURVE = 50  # equal parts of the run, whose largest violations are drawn
ZERO = 1e-17  # what counts as a violation of zero where a logarithm is taken

PAIRS = (  # kept, not kept
    ("DOP853, projected", "DOP853, index 1"),
    (CVODE_C_PROJECTED, "CVODE from C, BDF"),
    ("IDA, stabilised", "IDA, index1"),
)
OWN = (GIVEN, "SunRadau5", "Gauss12", OWN_EXPLICIT)
ALONG = (*(name for pair in PAIRS for name in pair), "LSODA, index 1", IDA_C, HEYOKA, CVODE_C, *OWN)
MORE = {CVODE_C_PROJECTED: 1e-8}  # tolerance, in the line-up of this study
STABILISED = tuple(baumgarte(name, alpha) for name in ("DOP853", "LSODA") for alpha in ALPHAS)
QUICK_ALONG = (*PAIRS[0], baumgarte("DOP853", 10.0), *OWN)
DRAWN = (*PAIRS[0], *PAIRS[1], HEYOKA, CVODE_C, IDA_C, GIVEN)  # cost over error
EXUDYN = ("Exudyn, GeneralizedAlpha", "Exudyn, TrapezoidalIndex2")
OVER_TIME = ("DOP853, index 1", "IDA, index1", "IDA, stabilised", CVODE_C, HEYOKA, gear(2), *EXUDYN)
LISTED = tuple(dict.fromkeys((*OVER_TIME, CVODE_C_PROJECTED, IDA_C, "DOP853, projected", gear(5))))
TARGETS = (1e-2, 1e-4, 1e-6)


def runs(quick: bool) -> list[Run]:
    """Every solver at one setting; PaperIRK with loose loops; solvers along their tolerances."""
    case = four_bar.cases(quick)[0]
    settings = LINE_UP | MORE
    line_up = [CATALOGUE[name] for name in settings]
    if quick:
        line_up = [s for s in line_up if s.family == "two-loop" or s.name.startswith(("Exudyn", "GSTIFF", "DOP853"))]
    made = [Run(case, solver, settings[solver.name], "line-up", 1) for solver in line_up]
    made += [Run(case, paper_irk_at(LOOSE), err_out, "loops", 1) for err_out in (LOOSE, TIGHT)]
    for name in QUICK_ALONG if quick else (*ALONG, *STABILISED):
        values = (1e-5, 1e-7) if quick else CATALOGUE[name].grid(case)
        made += [Run(case, CATALOGUE[name], value, "tolerances", 1 if quick else REPEATS) for value in values]
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
    row: dict[str, Any] = {}
    system = run.case.problem.system
    t, levels = violations(system, result)
    for level, size in levels.items():
        parts = _windows(t, size, WINDOWS)
        row[f"growth_{level}"], row[f"early_{level}"], row[f"late_{level}"] = growth(t, size), parts[0], parts[-1]
    stored = np.searchsorted(result.t, t)
    closure = np.array([system.constraint(result.t[k], result.q[:, k].copy())[CLOSURE] for k in stored])
    row["violation_35"], row["violation_36"] = np.abs(closure).max(axis=0)
    return row | {"series": {level: _windows(t, levels[level], CURVE) for level in "qv"}}


def grows(row: pd.Series, level: str) -> bool:
    """Whether the violation of a level grows, by the criterion of the report."""
    return bool(row[f"growth_{level}"] >= SLOPE and row[f"late_{level}"] > TIMES * row[f"early_{level}"])


def kind(row: pd.Series, level: str) -> str:
    """ "kept", "grows" or "bounded"."""
    if row[f"violation_{level}"] <= KEPT:
        return "kept"
    return "grows" if grows(row, level) else "bounded"


def pair(rows: pd.DataFrame, first: str, second: str) -> dict[str, Any] | None:
    """Evaluations and CPU time of the first solver over those of the second at equal error; None if never reached."""
    one, two = (rows[rows["solver"] == name] for name in (first, second))
    # where all runs of a solver are better than a target, its cost at the target is not known
    targets = [target for target in TARGETS if target <= min(one["error_q"].max(), two["error_q"].max())]
    found: dict[str, Any] = {"first": first, "second": second}
    for what in ("n_evaluations", "call_s"):
        ratios = [tables.time_for(one, target, what) / tables.time_for(two, target, what) for target in targets]
        ratios = [ratio for ratio in ratios if not np.isnan(ratio)]
        if not ratios:
            return None
        found[what] = [min(ratios), max(ratios)]
    return found | {"dearer": found["call_s"][0] > tables.LEAST}


def findings_of(rows: pd.DataFrame) -> dict[str, Any]:
    line_up, loops, along = (rows[rows["group"] == group] for group in ("line-up", "loops", "tolerances"))
    ours = line_up[line_up["family"] == "two-loop"]
    irk, loose = ours[ours["solver"] == IRK], loops.set_index("err_out")["violation_q"]
    if irk.empty or not {LOOSE, TIGHT} <= set(loose.index):
        raise StudyError("the rows lack runs of PaperIRK; make them again by python -m studies.violation")
    irk, known = irk.iloc[0], line_up[line_up["growth_q"].notna()]
    own = known["family"] == "two-loop"
    others = [row for _, row in known[~own].iterrows() if kind(row, "q") == "grows"]
    sizes = [float(row["violation_q"]) for row in others]
    listed = line_up[line_up["violation_q"].notna()].set_index("solver", drop=False)
    of_alpha = along[along["solver"].str.contains("Baumgarte") & along["error_q"].notna()]["violation_q"]
    failed = rows["status"] != "REACHED_END"
    at_each = [costs for target in TARGETS if (costs := tables.costs_at(along, target, doubt=True))]
    first = [min((cost, solver) for solver, (cost, _) in costs.items())[1] for costs in at_each]
    kept = along.groupby("solver")["keeps_constraints"].first()
    told: dict[str, Any] = {"t_end": float(rows["t_end"].iloc[0]), "problem": rows["problem"].iloc[0], "kept": KEPT}
    told |= {"slope": SLOPE, "times": TIMES, "checked": CHECKED, "v35": irk["violation_35"], "v36": irk["violation_36"]}
    told |= {"irk_grows": grows(irk, "q"), "n_ours": len(ours)}
    told |= {"ours": [ours[f"violation_{level}"].max() for level in LEVELS]}
    told |= {"ours_keep": bool((ours[["violation_q", "violation_v"]].max(axis=1) <= KEPT).all())}
    told |= {"ours_growing": [row["solver"] for _, row in known[own].iterrows() if grows(row, "q")]}
    told |= {"others_growing": [row["solver"] for row in others]}
    told |= {"growing_unprojected": all(not row["keeps_constraints"] for row in others)}
    told |= {"growing_to": [min(sizes, default=0.0), max(sizes, default=0.0)], "inner_loose": float(loose[TIGHT])}
    told |= {"both_loose": float(loose[LOOSE]), "inner_alone_kept": bool(loose[TIGHT] <= KEPT)}
    told |= {"both_kept": bool(loose[LOOSE] <= KEPT), "baumgarte": [of_alpha.min(), of_alpha.max()]}
    told |= {"baumgarte_n": len(of_alpha), "baumgarte_kept": int((of_alpha <= KEPT).sum()), "n_ranked": len(first)}
    told |= {"n_kept_first": sum(bool(kept[solver]) for solver in first)}
    told |= {"with_newest": bool(along["family"].eq("CyRK").any())}
    columns = ["solver", "called_from", "error_q", "violation_q", "violation_v"]
    lines = [listed.loc[name] for name in LISTED if name in listed.index]
    told["listed"] = [
        {**row[columns], "setting": tables.setting(row), "kinds": [kind(row, level) for level in "qv"]} for row in lines
    ]
    told["targets"] = TARGETS
    told |= {"cost": tables.work_precision(along, TARGETS, (*DRAWN, OWN_EXPLICIT, *STABILISED[1::3]), coded=True)}
    told |= {"n_failed": int(failed.sum()), "n_failed_ours": int((failed & (rows["family"] == "two-loop")).sum())}
    return told | {"pairs": [found for names in PAIRS if (found := pair(along, *names))]}


def figures_of(rows: pd.DataFrame, found: dict[str, Any]) -> dict[str, Figure]:
    """Largest violation in each part of the run, and cost over error."""
    line_up, along = (rows[rows["group"] == group] for group in ("line-up", "tolerances"))
    t = (np.arange(CURVE) + 0.5) * line_up["t_end"].iloc[0] / CURVE
    over_time, axes = plt.subplots(1, 2, figsize=(9.2, 3.8), sharex=True, sharey=True, layout="constrained")
    for panel, level in zip(axes, "qv", strict=True):
        drawn = [(row, row["series"][level]) for _, row in line_up.iterrows() if level in row["series"]]
        ours = [sizes for row, sizes in drawn if row["family"] == "two-loop"]
        low, high = np.nanmin(ours, axis=0), np.nanmax(ours, axis=0)
        panel.fill_between(t, low, high, color=figures.VIOLET, alpha=0.25, lw=0, label="all methods of ours")
        for row, sizes in drawn:
            if row["solver"] in OVER_TIME:
                panel.plot(t, sizes, markevery=7, **figures.look(row, coded=True))
        panel.set(xlabel="t (s)", yscale="log", ylabel=LEVELS[level])
        panel.tick_params(labelleft=True)
    figures.legend(over_time, axes)
    over_time.suptitle("Largest violation in each fiftieth of the run", fontsize=10)
    title = f"{rows['problem'].iloc[0]}, {number(rows['t_end'].iloc[0])} s"
    return {"violation": over_time, "violation_cost": figures.work_precision(along, DRAWN, title, coded=True)}


STUDY = Study("violation", __doc__, rows_of(runs, measure), findings_of, figures_of, medians=True, curves=True)

if __name__ == "__main__":
    STUDY.main()
