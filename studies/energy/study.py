"""Energy over long times: which methods let it drift, what a run without drift costs, and why."""

from collections import Counter
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from studies.bench import figures, headline, tables
from studies.bench.cli import StudyError
from studies.bench.headline import OWN_CODE
from studies.bench.names import label
from studies.bench.render import number
from studies.bench.solvers import CYRK, HEYOKA, IDA_C, IRK
from studies.bench.study import Study, rows_of
from studies.bench.tables import setting, setting_of, where
from studies.energy.drift import DRIFTING, IRREGULAR, IS_LOST, NO_DRIFT, bound, verdict
from studies.energy.runs import EVEN, GAUSS, LASTING, NEWMARK, ONE, RADAU, SUN, SWITCHING, TRAPEZOIDAL, measure, runs

SHARES = (1e-3, 1e-5, 1e-7)  # of the largest kinetic energy: energy errors at which costs are compared
KEEPING = f"{GAUSS}, symmetric partition"
FATES = dict.fromkeys(DRIFTING, "drifts") | {NO_DRIFT: "no drift", IS_LOST: "loses the motion", IRREGULAR: "irregular"}
DRAWN = (OWN_CODE, KEEPING, CYRK, HEYOKA, IDA_C, TRAPEZOIDAL)  # over cost
PLACES = ((ONE, LASTING), (SWITCHING, LASTING), (SWITCHING, EVEN))  # of the table of fixed steps


def judged(rows: pd.DataFrame) -> pd.DataFrame:
    """Add the verdict on each run, and the method's name."""
    return rows.assign(verdict=rows.apply(verdict, axis=1), name=rows.apply(name_of, axis=1))


def name_of(row: pd.Series) -> str:
    """Name a method, with what is not the default."""
    return ", ".join([row["solver"], *["symmetric partition"] * (row["partition"] == EVEN)])


def of(rows: pd.DataFrame, solver: str, partition: str = LASTING) -> pd.DataFrame:
    """Choose the runs of a method with a certain choice of the partition."""
    return where(rows, solver=solver, partition=partition)


def pick(rows: pd.DataFrame, motion: str, solver: str, partition: str = LASTING, group: str = "fixed") -> pd.Series:
    """Choose the long run of a method with fixed steps (group "fixed") or step-size control ("controlled")."""
    chosen = of(where(rows, case=motion, group=group), solver, partition)
    if chosen.empty:
        raise StudyError(f"the rows have no run of {solver} on {motion}; make them again by python -m studies.energy")
    return chosen.iloc[0]


def told(row: pd.Series) -> dict[str, Any]:
    """Describe a run."""
    names = ("solver", "name", "call_s", "n_evaluations", "error_q", "verdict", "status")
    found = {name: row[name] for name in names} | {"energy": abs(row["energy"])}
    found["label"] = f"{label(row['name'], coded=True)}, {setting(row)}"
    found |= {"drift": row["slope"] * row["t_end"], "bound": bound(row), "fixed_steps": bool(pd.notna(row["h"]))}
    return found | {"calm": row["verdict"] == NO_DRIFT, "drifts": row["verdict"] in DRIFTING}


def ended(rows: pd.DataFrame) -> pd.Series:
    """Tell which runs reached their end and have not lost the motion."""
    return (rows["status"] == "REACHED_END") & ~rows["lost"].fillna(True).astype(bool)


def settled(rows: pd.DataFrame) -> pd.Series:
    """Return the largest energy error of each run and of those with tighter settings; inf where one did not end."""
    worst = rows["energy"].abs().where(ended(rows), np.inf)
    runs = rows.assign(worst=worst, setting=setting_of(rows), fixed=rows["h"].notna())
    return runs.sort_values("setting").groupby(["name", "fixed"])["worst"].cummax().reindex(rows.index)


def cheapest(rows: pd.DataFrame) -> dict[str, Any] | None:
    """Describe the cheapest of some runs."""
    return None if rows.empty else told(rows.loc[rows["call_s"].idxmin()])


def ranked(reached: pd.DataFrame, good: pd.Series, near: pd.Series, one: pd.Series, other: pd.Series) -> str:
    """Compare two sides of runs by the rule of `work_precision`."""
    costs = (tables.each_run(reached[which & side]) for which in (good, near) for side in (one, other))
    return str(headline.compared(*costs)["verdict"])


def long_of(rows: pd.DataFrame) -> dict[str, Any]:
    """Compare what small energy errors cost over long times, with a drift and without."""
    reached = rows.assign(worst=settled(rows))[ended(rows)]
    calm, own = reached["verdict"] == NO_DRIFT, reached["family"] == "two-loop"
    kinetic = float(reached["kinetic"].iloc[0])
    at: list[dict[str, Any]] = []
    for share in SHARES:
        good = reached["worst"] <= share * kinetic
        near = ~good & (reached["worst"] <= tables.NEARLY * share * kinetic)
        level: dict[str, Any] = {"share": share, "energy": share * kinetic}
        for name, which in (("no_drift", calm), ("drift", ~calm)):
            sides = {"own": own, "other": ~own}
            level[name] = {side: cheapest(reached[good & which & theirs]) for side, theirs in sides.items()}
        level["verdict"] = ranked(reached, good, near, own, ~own)
        at.append(level | {"pays": ranked(reached, good, near, calm, ~calm)})
    pairs = [(level["no_drift"]["own"], level["drift"]["own"]) for level in at]
    ratios = [calmer["call_s"] / drifting["call_s"] for calmer, drifting in pairs if calmer and drifting]
    found: dict[str, Any] = {"problem": rows["problem"].iloc[0], "t_end": float(rows["t_end"].iloc[0]), "at": at}
    found |= {"kinetic": kinetic, "ratios": [min(ratios), max(ratios)] if ratios else None}
    found["n_verdicts"] = dict(Counter(level["verdict"] for level in at))
    found["n_pays"] = sum(level["pays"] in ("ahead", "alone") for level in at)
    others = reached[~own & (reached["group"] == "other")]
    found["others"] = sorted(set(others["name"]))
    found["others_calm"] = sorted(set(others[others["verdict"] == NO_DRIFT]["name"]))
    return found | {"repeats": int(rows["repeats"].max()) if "repeats" in rows else 1}


def fates_of(fixed: pd.DataFrame) -> list[dict[str, Any]]:
    """Say in a word what the energy does with fixed steps, for each method in each of PLACES."""
    found = []
    for solver in dict.fromkeys(fixed["solver"]):
        runs = [of(fixed[fixed["case"] == geometry], solver, partition) for geometry, partition in PLACES]
        fates = ["–" if run.empty else FATES.get(run.iloc[0]["verdict"], "fails") for run in runs]
        found.append({"solver": solver, "fates": fates})
    return found


def findings_of(rows: pd.DataFrame) -> dict[str, Any]:
    """Describe what drifts, what a run without drift costs, and why."""
    rows = judged(rows)
    fixed, controlled = where(rows, group="fixed", case=SWITCHING), rows[rows["group"] == "controlled"]
    even = fixed["partition"] == EVEN
    kinds = {"lasting": ~even, "even": even & (fixed["solver"] != SUN), "uneven": even & (fixed["solver"] == SUN)}
    found: dict[str, Any] = {"long": long_of(rows[rows["case"] == SWITCHING])}
    for name, solver in (("sun", SUN), ("gauss", GAUSS), ("radau", RADAU)):
        found[name] = told(pick(rows, ONE, solver))
    found["fates"] = fates_of(rows[rows["group"] == "fixed"])
    found["n"] = {name: int(which.sum()) for name, which in kinds.items()}
    found["n_calm"] = {name: int((fixed[which]["verdict"] == NO_DRIFT).sum()) for name, which in kinds.items()}
    found["uneven_drifts"] = bool(fixed[kinds["uneven"]]["verdict"].isin(DRIFTING).all())
    drift = controlled["verdict"].isin(DRIFTING)
    found["controlled"] = {"n": len(controlled), "drift": int(drift.sum())}
    found["steady"] = [told(run) | {"case": run["case"]} for _, run in controlled[~drift].iterrows()]
    motions = {"one": ONE, "changing": SWITCHING}
    found["paper"] = {name: told(pick(rows, motion, IRK, group="controlled")) for name, motion in motions.items()}
    found["failed"] = int((rows["status"] != "REACHED_END").sum())
    found["one"] = rows[rows["case"] == ONE]["problem"].iloc[0]
    return found | {"answer": answer_of(found["long"])}


def answer_of(long: dict[str, Any]) -> str:
    """Say in one sentence what a run without drift costs."""
    if long["ratios"] is None:
        return "No method was compared with and without drift."
    low, high = (number(ratio) for ratio in long["ratios"])
    cheaper = "never" if not long["n_pays"] else f"at {long['n_pays']} of {len(long['at'])} energy errors"
    return (
        f"Over {number(long['t_end'])} s a run without drift is {cheaper} the cheapest: at equal energy error, "
        f"twoloop's take {low} to {high} times as long as those whose energy drifts."
    )


def figures_of(rows: pd.DataFrame, found: dict[str, Any]) -> dict[str, Figure]:
    """Draw cost over energy error, and energy error over time."""
    rows = judged(rows)
    return {"energy_cost": cost_figure(rows, found["long"]), "energy_long": time_figure(rows, found)}


def cost_figure(rows: pd.DataFrame, found: dict[str, Any]) -> Figure:
    """Draw the cost of the long run over its largest energy error, on the geometry whose partition changes."""
    long = rows[rows["case"] == SWITCHING]
    errors = long["energy"].abs().where(ended(long))
    long = long.assign(error_q=errors, floor=0.0, solver=long["name"], astray=False)
    long = long[(long["solver"] != KEEPING) | long["h"].notna()]
    times = " to ".join(number(ratio) for ratio in found["ratios"] or ()) or "–"
    title = f"Without drift ({KEEPING}), energy costs {times} times as much"
    return figures.work_precision(long, DRAWN, title, "largest energy error over the run (J)", coded=True)


def time_figure(rows: pd.DataFrame, found: dict[str, Any]) -> Figure:
    """Draw the mean energy error over time with fixed steps, on both geometries."""
    dashes = {LASTING: "-", EVEN: "--"}
    chosen = [(SUN, LASTING), (GAUSS, LASTING), (GAUSS, EVEN), (RADAU, LASTING), (NEWMARK, LASTING)]
    figure, panels = plt.subplots(1, 2, figsize=(10.5, 3.8), sharey=True, layout="constrained")
    titles = {ONE: "the partition never changes", SWITCHING: "the partition changes"}
    for axes, motion in zip(panels, titles, strict=True):
        for solver, partition in chosen:
            for _, row in of(where(rows, group="fixed", case=motion), solver, partition).iterrows():
                if curves := row["series"]:
                    look = figures.look(row, coded=True) | {"label": row["name"]}
                    look |= {"linestyle": dashes[partition], "marker": ""}
                    axes.plot(curves["t"], np.abs(curves["mean"]), **look)
        axes.set(xscale="log", yscale="log", xlabel="time (s)")
        axes.set_title(f"{rows[rows['case'] == motion]['problem'].iloc[0]}: {titles[motion]}", fontsize=9)
    panels[0].set_ylabel("|mean energy error of a window| (J)")
    even = found["n_calm"]["even"] == found["n"]["even"] and not found["n_calm"]["lasting"]
    words = "Where the partition changes, only a symmetric choice of it keeps the energy"
    figures.message(figure, words if even else "Energy errors of runs with fixed steps")
    figures.label_lines(panels)
    return figure


STUDY = Study("energy", __doc__, rows_of(runs, measure), findings_of, figures_of, medians=True, curves=True)
