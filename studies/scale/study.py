"""Cost against size: an evaluation of mechanisms of 3 to 3000 bodies, and chains beside other solvers."""

from itertools import pairwise
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from studies.bench import figures, tables
from studies.bench.names import label
from studies.bench.render import listed, number, power
from studies.bench.solvers import DEFAULT
from studies.bench.study import Study, kept_rows
from studies.scale.engines import TREE, trees
from studies.scale.runs import CHAIN, CHAINS, ERRORS, EVALUATION, EXUDYN, LIMIT, chains, evaluations

FROM, TO = 30, 1000  # bodies, between which the power is fitted
CAREFUL = 5.0  # passes of the projection in a step, beyond which stages are projected too
BEND = 0.3  # by which the power between two sizes differs notably from the fitted one
SHOWN = ("open chain", "ladder", "tree", "grid", "open chain of hinges", "tree of hinges")  # in the figure
COMPARED = ERRORS[1]  # error of the table of chains
OURS = "twoloop, compiled=False"
ONE_OF = list(EXUDYN)[1:]  # Exudyn's other solver is much the same: it is in no figure


def slope(n: Any, times: Any) -> float | None:
    """Return p of cost ~ n^p over the sizes from FROM to TO; None: too few sizes."""
    n, times = np.asarray(n, dtype=float), np.asarray(times, dtype=float)
    kept = (n >= FROM) & (n <= TO)
    return float(np.polyfit(np.log(n[kept]), np.log(times[kept]), 1)[0]) if kept.sum() > 1 else None


def findings_of(rows: pd.DataFrame) -> dict[str, Any]:
    """Fit the growth of an evaluation by kind of mechanism; compare solvers on chains at equal error."""
    found: dict[str, Any] = {"from": FROM, "to": TO, "errors": list(ERRORS), "limit": LIMIT, "shown": COMPARED}
    found["kinds"] = [
        _kind(str(case), own) for case, own in rows[rows["group"] == EVALUATION].groupby("case", sort=False)
    ]
    found["chains"] = [_chain(n, medians) for n, medians in _chains(rows).items()]
    found["solvers"] = list(dict.fromkeys(name for chain in found["chains"] for name in chain["call_s"]))
    right = rows[rows["group"].eq(TREE) & rows["status"].eq("REACHED_END")]
    found["trees"] = {
        f"{case}, {engine}": own.groupby("n")["evaluation_us"].median().to_dict()
        for (case, engine), own in right.groupby(["case", "solver"], sort=False)
    }
    found["bend"] = BEND
    found["references"] = sorted(set(rows["reference"].dropna())) if "reference" in rows else []
    return found | {"answer": _answer(found)}


def _kind(case: str, rows: pd.DataFrame) -> dict[str, Any]:
    """Return µs of an evaluation by the number of bodies, the power of its growth, and where this is no power."""
    us = {int(n): float(t) for n, t in rows.groupby("n")["evaluation_us"].median().dropna().items()}
    careful = rows[rows["passes"] > CAREFUL]["n"] if "passes" in rows else rows["n"][:0]
    fitted, sizes = slope(list(us), list(us.values())), [n for n in us if n >= FROM]
    between = [np.log(us[b] / us[a]) / np.log(b / a) for a, b in pairwise(sizes)]
    bends = fitted is not None and max((abs(each - fitted) for each in between), default=0.0) > BEND
    found = {"case": case, "us": us, "slope": fitted, "bends": bool(bends), "careful": sorted(set(map(int, careful)))}
    starts = rows.groupby("n")["start_s"].median().dropna()
    found["start_s"] = {int(n): float(t) for n, t in starts.items()}
    return found | {"failed": sorted(set(map(int, rows[rows["status"].eq("FAILED")]["n"])))}


def _chain(n: int, medians: pd.DataFrame) -> dict[str, Any]:
    """Return the time of the cheapest run of each solver with at most each error; the fastest other solver's ratio."""
    call_s: dict[str, dict[str, float | None]] = {}
    for name, own in medians.groupby("solver", sort=False):
        costs = {power(error): tables.as_good(own, error) for error in ERRORS}
        call_s[str(name)] = {error: cost if cost == cost else None for error, cost in costs.items()}
    ours, others = call_s[DEFAULT], set(medians[medians["family"] != "two-loop"]["solver"])
    ratios = {}
    for error, own in ours.items():
        costs = {name: cost for name in others if (cost := call_s[name][error]) is not None}
        if own and costs:
            best = min(costs, key=costs.__getitem__)
            ratios[error] = {"solver": best, "ratio": costs[best] / own}
    return {"n": n, "t_end": CHAINS[n], "call_s": call_s, "fastest": ratios}


def _chains(rows: pd.DataFrame) -> dict[int, pd.DataFrame]:
    """Return the medians of the runs of chains, by the number of bars."""
    order = {"n": True, "solver": True, "h": False, "tol": False, "repeat": True}
    chained = rows[rows["group"] == CHAIN].sort_values([*order], ascending=[*order.values()])
    return {int(n): tables.medians(own.reset_index(drop=True)) for n, own in chained.groupby("n")}


def _growth(found: dict[str, Any]) -> str:
    kinds = [each for each in found["kinds"] if each["slope"] is not None]
    straight = [each["slope"] for each in kinds if not each["bends"]] or [each["slope"] for each in kinds]
    if not straight:
        return "Too few sizes were run to fit a power"
    low, high = f"{min(straight):.2f}", f"{max(straight):.2f}"
    text = f"An evaluation's time grows with the number of bodies to the power {low}{f' to {high}' * (low != high)}"
    bent = [f" ({each['case']} {each['slope']:.2f})" for each in kinds if each["case"] == "grid"]
    return text + "".join(bent)


def _answer(found: dict[str, Any]) -> str:
    text, largest = _growth(found), found["chains"][-1] if found["chains"] else {"fastest": {}}
    if best := largest["fastest"].get(power(COMPARED)):
        text += f"; on {largest['n']} bodies the fastest other solver takes {number(best['ratio'])} times as long"
        text += f" ({power(COMPARED)})"
    return f"{text}."


def figures_of(rows: pd.DataFrame, found: dict[str, Any]) -> dict[str, Figure]:
    """Draw an evaluation over the number of bodies, and time over error on chains."""
    figure, axes = plt.subplots(figsize=(7.6, 4.0), layout="constrained")
    kinds = [each for each in found["kinds"] if each["case"] in SHOWN]
    for each, color in zip(kinds, figures.shades(len(kinds)), strict=True):
        axes.plot(list(each["us"]), list(each["us"].values()), "o-", color=color, label=each["case"])
    axes.set(xscale="log", yscale="log", xlabel="bodies", ylabel="time of an evaluation (µs)")
    figures.message(figure, _growth(found))
    figures.label_lines(axes)
    chained = _chains(rows)
    second, panels = plt.subplots(1, len(chained), sharey=True, figsize=(9.6, 3.6), layout="constrained", squeeze=False)
    for panel, (n, medians) in zip(panels[0], chained.items(), strict=True):
        for solver in found["solvers"]:
            line = figures.line_of(medians[medians["solver"] == solver])
            if len(line) and solver not in (*ONE_OF, "DOP853 (twoloop)"):
                look = figures.style(solver) | {"label": _short(solver)}
                panel.plot(line["error_q"].astype(float), line["call_s"].astype(float), **look)
        panel.set(xscale="log", yscale="log", title=f"{n} bars")
    panels[0][len(chained) // 2].set_xlabel("error at the end, over max(1, max |q|)")
    panels[0][0].set_ylabel(figures.TIME)
    figures.message(second, _of_chains(found))
    figures.label_lines(panels[0])
    return {"scale": figure, "scale_chains": second}


def _of_chains(found: dict[str, Any]) -> str:
    """Say on which chains another solver is faster at the error of the table, and by how much."""
    at = {each["n"]: each["fastest"].get(power(COMPARED)) for each in found["chains"]}
    parts = [f"{number(best['ratio'])} ({n} bars, {_short(best['solver'])})" for n, best in at.items() if best]
    text = f"At an error of {power(COMPARED)} the fastest other solver takes {listed(parts)} times as long as twoloop"
    return text if parts else "No two solvers reach the same error"


def _short(solver: str) -> str:
    return OURS if solver == DEFAULT else label(solver).split()[0].rstrip(",")


STUDY = Study("scale", __doc__, kept_rows(evaluations, trees, chains), findings_of, figures_of)
