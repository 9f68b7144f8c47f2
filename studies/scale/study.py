"""Cost against size: an evaluation of mechanisms of 3 to 3000 bodies, and chains beside others' solvers."""

from itertools import pairwise
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from studies.bench import figures, tables
from studies.bench.solvers import DEFAULT
from studies.bench.study import Study, kept_rows
from studies.scale.agreement import agreements, found_of
from studies.scale.rivals import BUDGET, TREE, UNTIL, UNTIL_END, trees, until
from studies.scale.runs import (
    CHAIN,
    CHAINS,
    ERRORS,
    EVALUATION,
    FROM,
    LIMIT,
    MEMORY,
    METHOD,
    SPARSE_IDA,
    STAGES,
    TO,
    TOLERANCE,
    chains,
    evaluations,
)
from twoloop.rows.equal_error import resampled

CAREFUL = 5.0  # passes of the projection in a step, beyond which stages are put on the constraints too
BEND = 0.3  # by which a power from one size to the next differs notably from the fitted one


def slope(n: Any, times: Any) -> list[float] | None:
    """p of cost ~ n^p over the sizes from FROM to TO, and its range over repetitions drawn again; None: too few."""
    n = np.asarray(n, dtype=float)
    kept = np.flatnonzero((n >= FROM) & (n <= TO))
    if kept.size < 2:
        return None
    drawn = np.log(resampled([times[k] for k in kept]))
    middle = np.log([np.median(times[k]) for k in kept])
    x = np.log(n[kept])
    return [float(np.polyfit(x, middle, 1)[0]), *np.percentile(np.polyfit(x, drawn, 1)[0], tables.INTERVAL).tolist()]


def powers(us: dict[int, float]) -> list[dict[str, Any]]:
    """p of cost ~ n^p from one size to the next, from FROM on, by medians."""
    n = [each for each in us if each >= FROM]
    return [
        {"from": low, "to": high, "power": float(np.log(us[high] / us[low]) / np.log(high / low))}
        for low, high in pairwise(n)
    ]


def findings_of(rows: pd.DataFrame) -> dict[str, Any]:
    """Slopes and times by kind of mechanism; chains at equal error."""
    found: dict[str, Any] = {"kinds": [], "chains": [], "from": FROM, "to": TO, "errors": list(ERRORS), "limit": LIMIT}
    found |= {"once": {}, "agreement": found_of(rows)}
    made = rows[(rows["group"] == EVALUATION) & rows["evaluation_us"].notna()]
    for case, own in made.groupby("case", sort=False):
        by_size = own.groupby("n")
        times = {int(n): tuple(each["evaluation_us"].astype(float)) for n, each in by_size}
        us = {n: float(np.median(each)) for n, each in times.items()}
        dear = [n for n in us if any(us[n] > us[m] for m in us if m > n)]
        line = {"case": str(case), "us": us, "dear": dear}
        near = own[own["passes"] > CAREFUL] if "passes" in own else own[:0]
        line["careful"] = sorted({int(n) for n in near["n"]})
        line["start_s"] = {int(n): float(each["start_s"].median()) for n, each in by_size}
        fitted, between = None if dear else slope(list(times), list(times.values())), powers(us)
        apart = [abs(each["power"] - fitted[0]) for each in between] if fitted else []
        found["kinds"].append(line | {"slope": fitted, "powers": between, "bends": max(apart, default=0.0) > BEND})
    found["failed"] = rows[rows["group"].eq(EVALUATION) & rows["status"].eq("FAILED")][["case", "n"]].to_dict("records")
    for n, medians in _chains(rows).items():
        of_chain: dict[str, Any] = {"n": n, "t_end": CHAINS[n]}
        of_chain["lines"] = tables.work_precision(medians, ERRORS)
        of_chain["over_exudyn"] = {error: ratio for error in ERRORS if (ratio := over_exudyn(medians, error))}
        of_chain["step"] = steps_of(medians)
        of_chain["fastest"] = [each for error in ERRORS if (each := fastest(medians, error))]
        found["once"] |= once(medians)
        least, step = min(of_chain["over_exudyn"].values(), default=0.0), of_chain["step"]
        of_chain["by_order"] = bool(step) and (step["exudyn"] / step["ours"]) ** 2 < least
        found["chains"].append(of_chain)
    held = rows[rows["group"].eq(MEMORY)].reindex(columns=["n", "memory_mb"]).dropna()
    found["memory"] = {int(n): float(mb) for n, mb in held.itertuples(index=False)}
    beside = (_beside_engines(line, rows[rows["group"] == TREE]) for line in found["kinds"])
    found["trees"] = [line for line in beside if line["engines"]]
    grown = rows[rows["group"] == UNTIL]
    found["until"] = [_until(str(solver), own) for solver, own in grown.groupby("solver", sort=False)]
    found |= {"budget": BUDGET, "sparse_ida": SPARSE_IDA, "tolerance": TOLERANCE, "until_end": UNTIL_END, "bend": BEND}
    of_reference = rows["reference"].dropna() if "reference" in rows else rows["group"][:0]
    found["references"] = sorted(set(of_reference))
    return found


def _chains(rows: pd.DataFrame) -> dict[int, pd.DataFrame]:
    """Medians of the runs of chains, by the number of bars."""
    order = {"n": True, "solver": True, "h": False, "tol": False, "repeat": True}
    chains = rows[rows["group"] == CHAIN].sort_values([*order], ascending=[*order.values()])
    return {int(n): tables.medians(own.reset_index(drop=True)) for n, own in chains.groupby("n")}


def _beside_engines(line: dict[str, Any], rows: pd.DataFrame) -> dict[str, Any]:
    """Of a kind of tree: µs of an evaluation by the number of bodies, of ours and of the engines that were right."""
    found: dict[str, Any] = {"case": line["case"], "ours": line["us"], "engines": {}, "start_s": {}}
    right = rows[rows["case"].eq(line["case"]) & rows["status"].eq("REACHED_END")]
    for engine, own in right.groupby("solver", sort=False):
        by_size = own.groupby("n")[["evaluation_us", "start_s"]].median()
        found["engines"][str(engine)] = by_size["evaluation_us"].to_dict()
        found["start_s"][str(engine)] = by_size["start_s"].to_dict()
    return found


def _until(solver: str, rows: pd.DataFrame) -> dict[str, Any]:
    """A solver's chains that were run, by n, and why it stopped."""
    run = rows[rows["status"] == "REACHED_END"]
    stopped = rows[rows["status"] != "REACHED_END"]
    made = {int(row["n"]): {key: row[key] for key in ("build_s", "call_s", "error_q")} for _, row in run.iterrows()}
    built = [each["build_s"] for each in made.values()]
    cold = len(built) > 1 and built[0] > built[1]  # the first holds what the package does once in a process
    why = None if stopped.empty else {"n": int(stopped["n"].iloc[0]), "message": str(stopped["message"].iloc[0])}
    return {"solver": solver, "made": made, "stopped": why, "cold": cold}


def over_exudyn(medians: pd.DataFrame, error: float) -> float | None:
    """Time of Exudyn, by the cheaper of its runs about an error, over that of the default's cheapest run within it."""
    ours = tables.as_good(medians[medians["solver"] == DEFAULT], error)
    costs = tables.costs_at(medians[medians["family"] == "Exudyn"], error, doubt=True)
    return min(cost for cost, _ in costs.values()) / ours if costs and ours == ours else None


def steps_of(medians: pd.DataFrame) -> dict[str, Any] | None:
    """Time of a step of Exudyn (s), of its finest run that ended, and of `DOP853`; None: one of them has no run."""
    ended = medians[medians["error_q"].notna()]
    theirs, ours = ended[ended["family"] == "Exudyn"], ended[ended["solver"] == f"{METHOD} (twoloop)"]
    if theirs.empty or ours["n_evaluations"].isna().all():
        return None
    finest = theirs[theirs["h"] == theirs["h"].min()].sort_values("call_s").iloc[0]
    exudyn = float(finest["call_s"] * finest["h"] / CHAINS[int(finest["n"])])
    return {"exudyn": exudyn, "ours": STAGES * float((ours["call_s"] / ours["n_evaluations"]).min())}


def once(medians: pd.DataFrame) -> dict[str, bool]:
    """The solvers with settings that were run once where others have repetitions, and whether all of theirs were."""
    single = (medians["repeats"] == 1) & (medians["repeats"].max() > 1)
    return {str(name): bool(own.all()) for name, own in single.groupby(medians["solver"], sort=False) if own.any()}


def fastest(medians: pd.DataFrame, error: float) -> dict[str, Any] | None:
    """The rival that is the cheapest at an error, and its time over the default's; None: one of them has none.

    over: the least and the most that it can be. They differ where one of the two has no run within a decade of the
    error, so that its price lies between those of the runs on either side.
    """
    high = tables.costs_at(medians, error)
    low = tables.costs_at(medians, error, doubt=True)
    known = [name for name in medians[medians["family"] != "two-loop"]["solver"].unique() if name in high]
    if not known or DEFAULT not in high:
        return None
    best = min(known, key=lambda name: high[name][0])
    over = [low[best][0] / high[DEFAULT][0], high[best][0] / low[DEFAULT][0]]
    return {"error": error, "solver": str(best), "over": over}


def figures_of(rows: pd.DataFrame, found: dict[str, Any]) -> dict[str, Figure]:
    """An evaluation over the number of bodies, and what an accuracy costs on chains."""
    figure, axes = plt.subplots(figsize=(6.4, 4.4), layout="constrained")
    for line, color, marker in zip(found["kinds"], figures.shades(len(found["kinds"])), "osD^vPX<>", strict=False):
        axes.plot(list(line["us"]), list(line["us"].values()), marker=marker, color=color, label=line["case"])
    axes.set(xscale="log", yscale="log", xlabel="bodies", ylabel="time of an evaluation, projections included (µs)")
    axes.legend(fontsize=8, title="mechanism")
    axes.grid(alpha=0.3)
    chains, names = _chains(rows), rows[rows["group"] == CHAIN]["solver"].unique()
    width: dict[str, Any] = {"figsize": (3.4 * len(chains) + 1.2, 4.2), "layout": "constrained", "squeeze": False}
    second, panels = plt.subplots(1, len(chains), sharey=True, **width)
    for panel, (n, medians) in zip(panels[0], chains.items(), strict=True):
        for solver in names:
            own = medians[medians["solver"] == solver]
            line = figures.with_gaps(own)
            if line["error_q"].notna().any():
                panel.plot(line["error_q"], line["call_s"], **figures.look(own.iloc[0]))
        panel.set(xscale="log", yscale="log", xlabel="error of q at the end, over max(1, max |q|)", title=f"{n} bars")
        panel.grid(alpha=0.3)
    panels[0][0].set_ylabel("CPU time of the call (s)")
    figures.legend(second, panels[0], figures.GAPS, below=3)
    return {"scale": figure, "scale_chains": second}


STUDY = Study("scale", __doc__, kept_rows(agreements, evaluations, trees, chains, until), findings_of, figures_of)
