"""Fig. 7 of the paper: violation of position, velocity and acceleration constraints over 100 s."""

from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from references.scipy.index1 import ALPHAS, baumgarte
from studies.bench import figures, four_bar, solvers, tables
from studies.bench.cli import StudyError
from studies.bench.collector import REPEATS, Run
from studies.bench.metrics import violations
from studies.bench.store import Array
from twoloop import Result

LOOSE = 1e-3  # err_in and err_out, the loosest of Table 3
CLOSURE = slice(6, 8)  # places of (35) and (36) among the constraints
# a violation grows when it goes like t^p with p at least that of a random walk, and ends above TIMES its start
SLOPE, TIMES = 0.5, 2.0
KEPT = 1e-12  # m, m/s: a constraint violated no more than this is kept
WINDOWS = 10  # equal parts of the run, to whose largest violations the growth is fitted
CURVE = 50  # equal parts of the run, whose largest violations are drawn
ZERO = 1e-17  # what counts as a violation of zero where a logarithm is taken

PAIRS = (  # kept, not kept
    ("DOP853, projected", "DOP853, index 1"),
    (solvers.CVODE_C_PROJECTED, "CVODE from C, BDF"),
    ("IDA, stabilised", "IDA, index1"),
)
OWN = (solvers.GIVEN, "SunRadau5", "Gauss12", solvers.OWN_EXPLICIT)
BAUMGARTE = baumgarte("DOP853", 10.0)
STABILISED = tuple(baumgarte(name, alpha) for name in ("DOP853", "LSODA") for alpha in ALPHAS)
SHOWN = ("Exudyn, GeneralizedAlpha", "IDA, stabilised", BAUMGARTE, solvers.CVODE_C, "DOP853, index 1")
TARGETS = (1e-2, 1e-4, 1e-6)


def runs(quick: bool) -> list[Run]:
    """List a run of each method and of `SHOWN`, PaperIRK with loose loops, and solvers along their tolerances."""
    case = four_bar.cases(quick)[0]
    line_up = [solvers.CATALOGUE[name] for name in solvers.LINE_UP]
    line_up = [solver for solver in line_up if solver.family == "two-loop" or solver.name in SHOWN]
    listed = [Run(case, solver, solvers.LINE_UP[solver.name], "line-up", 1) for solver in line_up]
    listed.append(Run(case, solvers.paper_irk_at(LOOSE), LOOSE, "loops", 1))
    for name in (*PAIRS[0], BAUMGARTE, *OWN) if quick else (*sum(PAIRS, ()), *OWN, *STABILISED):
        values = (1e-5, 1e-7) if quick else solvers.CATALOGUE[name].grid(case)
        listed += [Run(case, solvers.CATALOGUE[name], value, "tolerances", 1 if quick else REPEATS) for value in values]
    return listed


def windows(t: Array, size: Array, n: int) -> Array:
    """Return the largest value in each of n equal parts of the run; NaN where nothing is stored."""
    places = np.minimum((t / t[-1] * n).astype(int), n - 1)
    return np.array([size[places == k].max(initial=ZERO) if (places == k).any() else np.nan for k in range(n)])


def growth(t: Array, size: Array) -> float:
    """Fit the exponent p of size ~ t^p through the largest values of equal parts of the run."""
    values = windows(t, size, WINDOWS)
    ends = np.arange(1, WINDOWS + 1)  # where what grows is largest
    known = ~np.isnan(values)
    return float(np.polyfit(np.log10(ends[known]), np.log10(values[known]), 1)[0])


def measure(run: Run, result: Result) -> dict[str, Any]:
    """Measure how the violations grow, and sample the curves of the figure ("series")."""
    if result.t.size < WINDOWS or run.group == "tolerances":  # of those the common columns are enough
        return {}
    system = run.case.problem.system
    t, levels = violations(system, result)
    parts = windows(t, levels["q"], WINDOWS)
    row = {"growth_q": growth(t, levels["q"]), "early_q": parts[0], "late_q": parts[-1]}
    stored = np.searchsorted(result.t, t)
    closure = np.array([system.constraint(result.t[k], result.q[:, k].copy())[CLOSURE] for k in stored])
    row["violation_35"], row["violation_36"] = np.abs(closure).max(axis=0)
    return row | {"series": {"q": windows(t, levels["q"], CURVE)}}


def grows(row: pd.Series) -> bool:
    """Tell whether the violation of the positions grows."""
    return bool(row["growth_q"] >= SLOPE and row["late_q"] > TIMES * row["early_q"])


def findings_of(rows: pd.DataFrame) -> dict[str, Any]:
    line_up, loops, along = (rows[rows["group"] == group] for group in ("line-up", "loops", "tolerances"))
    line_up = line_up[line_up["growth_q"].notna()].set_index("solver")
    loose = loops.set_index("err_out")["violation_q"]
    if solvers.IRK not in line_up.index or LOOSE not in loose.index:
        raise StudyError("the rows lack runs of PaperIRK; run python -m studies.reproduction violation")
    irk, ours = line_up.loc[solvers.IRK], line_up[line_up["family"] == "two-loop"]
    along = along[along["error_q"].notna()]
    worst = max(ours["violation_q"].max(), along[along["family"] == "two-loop"]["violation_q"].max())
    found: dict[str, Any] = {"t_end": float(rows["t_end"].iloc[0]), "kept": KEPT}
    found |= {"irk": [float(irk["violation_35"]), float(irk["violation_36"])], "irk_grows": grows(irk)}
    found |= {"n_ours": len(ours), "ours_q": float(worst), "both_loose": float(loose[LOOSE])}
    found["ours_grow"] = [name for name, row in ours.iterrows() if grows(row)]
    stabilised = along[along["solver"].str.contains("Baumgarte")]["violation_q"]
    found["baumgarte"] = [stabilised.min(), stabilised.max()] if len(stabilised) else None
    ratios: list[float] = []
    for pair in PAIRS:
        kept, drifting = (along[along["solver"] == name] for name in pair)
        # where all runs of a solver are better than a target, its cost at the target is not known
        targets = [target for target in TARGETS if target <= min(kept["error_q"].max(), drifting["error_q"].max())]
        ratios += [float(tables.time_for(kept, error) / tables.time_for(drifting, error)) for error in targets]
    ratios = [ratio for ratio in ratios if not np.isnan(ratio)]
    found["cost"] = [min(ratios), max(ratios)] if ratios else None
    shown = line_up.loc[[name for name in SHOWN if name in line_up.index]]
    columns = ["violation_q", "violation_v"]
    return found | {"runs": [{"solver": name, **row[columns], "grows": grows(row)} for name, row in shown.iterrows()]}


def figure_of(rows: pd.DataFrame, found: dict[str, Any]) -> Figure:
    """Draw the largest violation of the positions in each fiftieth of the run."""
    line_up = rows[(rows["group"] == "line-up") & rows["series"].map(lambda curves: "q" in curves)]
    t = (np.arange(CURVE) + 0.5) * found["t_end"] / CURVE
    figure, panel = plt.subplots(figsize=(7.6, 3.8), layout="constrained")
    ours = np.stack(line_up[line_up["family"] == "two-loop"]["series"].map(lambda curves: curves["q"]).tolist())
    low, high = np.nanmin(ours, axis=0), np.nanmax(ours, axis=0)
    panel.fill_between(t, low, high, color=figures.VIOLET, alpha=0.3, lw=0, label="all methods of twoloop")
    for _, row in line_up[line_up["solver"].isin(SHOWN)].iterrows():
        panel.plot(t, row["series"]["q"], **figures.look(row, coded=True) | {"marker": ""})
    panel.set(xlabel="t (s)", yscale="log", ylabel="largest violation |C| (m)")
    kept = "keep the constraints to rounding" if found["ours_q"] <= KEPT else "violate the constraints"
    figures.message(figure, f"All methods of twoloop {kept}; solvers that do not project drift", panel)
    return figure
