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
from studies.bench.solvers import CVODE_C, CYRK, DEFAULT, HEYOKA, IDA_C, IRK, OWN_EXPLICIT
from studies.bench.study import Study, rows_of
from studies.bench.tables import setting, setting_of, where
from studies.energy.drift import DRIFTING, IRREGULAR, IS_LOST, NO_DRIFT, bound, verdict
from studies.energy.runs import (
    BASIC,
    EVEN,
    GAUSS,
    MOMENTA,
    NEWMARK,
    ONE,
    RADAU,
    SUN,
    SWITCHING,
    TRAPEZOIDAL,
    VARIANTS,
    Variant,
    measure,
    runs,
)

SHARES = (1e-3, 1e-5, 1e-7)  # of the largest kinetic energy: energy errors at which costs are compared
PARTED = 3.0  # times the error of a run: what is less is no other phase
KEEPING = f"{GAUSS}, symmetric partition"
FATES = dict.fromkeys(DRIFTING, "drift") | {each: each for each in (NO_DRIFT, IS_LOST, IRREGULAR)}  # in one word
DRAWN = (DEFAULT, OWN_CODE, IDA_C, HEYOKA, CYRK, CVODE_C, TRAPEZOIDAL, KEEPING, IRK)  # over cost


def judged(rows: pd.DataFrame) -> pd.DataFrame:
    """The rows with the verdict on each run, and with the method's name."""
    return rows.assign(verdict=rows.apply(verdict, axis=1), name=rows.apply(name_of, axis=1))


def name_of(row: pd.Series) -> str:
    """Method with what is not the default."""
    extra = ["momenta"] * (row["variables"] == "momenta") + ["symmetric partition"] * (row["partition"] == "symmetric")
    return ", ".join([row["solver"], *extra])


def of(rows: pd.DataFrame, solver: str, variant: Variant = BASIC) -> pd.DataFrame:
    """The runs of a method on certain variables, with a certain choice of the partition."""
    return where(rows, solver=solver, variables=variant[0], partition=variant[1])


def pick(rows: pd.DataFrame, motion: str, solver: str, variant: Variant = BASIC, group: str = "fixed") -> pd.Series:
    """The long run of a method with fixed steps (group "fixed") or step-size control ("controlled")."""
    chosen = of(where(rows, case=motion, group=group), solver, variant)
    if chosen.empty:
        raise StudyError(f"the rows have no run of {solver} on {motion}; make them again by python -m studies.energy")
    return chosen.iloc[0]


def told(row: pd.Series) -> dict[str, Any]:
    """A run as a finding."""
    names = ("solver", "name", "called_from", "call_s", "n_evaluations", "violation_q", "error_q", "verdict", "status")
    found = {name: row[name] for name in names}
    found["setting"] = setting(row)
    found["label"] = f"{label(row['name'], coded=True)}, {found['setting']}"
    found |= {"kinetic": float(row["kinetic"]), "fixed_steps": bool(pd.notna(row["h"]))}
    found["explicit"] = row.get("used") == "explicit" or row["solver"] == OWN_EXPLICIT
    found |= {"drift": row["slope"] * row["t_end"], "bound": bound(row), "energy": abs(row["energy"])}
    found |= {"calm": row["verdict"] == NO_DRIFT, "drifts": row["verdict"] in DRIFTING}
    return found | {"keeps": bool(row["keeps_constraints"])}


def ended(rows: pd.DataFrame) -> pd.Series:
    """Which runs reached their end and have not lost the motion."""
    return (rows["status"] == "REACHED_END") & ~rows["lost"].fillna(True).astype(bool)


def settled(rows: pd.DataFrame) -> pd.Series:
    """Largest energy error of each run and of those of its solver with tighter settings; inf where one did not end."""
    worst = rows["energy"].abs().where(ended(rows), np.inf)
    runs = rows.assign(worst=worst, setting=setting_of(rows), fixed=rows["h"].notna())
    return runs.sort_values("setting").groupby(["name", "fixed"])["worst"].cummax().reindex(rows.index)


def cheapest(rows: pd.DataFrame) -> dict[str, Any] | None:
    """The cheapest of some runs."""
    return None if rows.empty else told(rows.loc[rows["call_s"].idxmin()])


def ranked(reached: pd.DataFrame, good: pd.Series, near: pd.Series, one: pd.Series, other: pd.Series) -> str:
    """The verdict on one side of runs against another, by the rule of `work_precision`."""
    return str(
        headline.compared(*(tables.each_run(reached[of & side]) for of in (good, near) for side in (one, other)))[
            "verdict"
        ]
    )


def _phase_later(reached: pd.DataFrame, run: dict[str, Any] | None) -> float | None:
    """The largest error of positions with tighter tolerances of a solver, where it is far larger than with this one."""
    if run is None or not run.get("error_q"):
        return None
    own = reached[reached["solver"] == run["solver"]]
    tol = own.loc[(own["call_s"] - run["call_s"]).abs().idxmin(), "tol"]
    largest = float(own[own["tol"] < tol]["error_q"].max())
    return largest if largest > PARTED * run["error_q"] else None


def long_of(rows: pd.DataFrame) -> dict[str, Any]:
    """The class "long and conservative": what small energy errors cost with a drift and without, alternatives."""
    reached = rows.assign(worst=settled(rows))[ended(rows)]
    calm, own = reached["verdict"] == NO_DRIFT, reached["family"] == "two-loop"
    kinetic = float(reached["kinetic"].iloc[0])
    at = []
    for share in (np.inf, *SHARES):
        good = reached["worst"] <= share * kinetic
        near = ~good & (reached["worst"] <= tables.NEARLY * share * kinetic)
        level: dict[str, Any] = {"share": share, "energy": share * kinetic}
        for name, which in (("no_drift", calm), ("drift", ~calm)):
            of_us, of_others = which & own, which & ~own
            level[name] = {"ours": cheapest(reached[good & of_us]), "others": cheapest(reached[good & of_others])}
            level[name]["verdict"] = ranked(reached, good, near, of_us, of_others)
        times = {name: reached[good & (reached["solver"] == name)]["call_s"] for name in (DEFAULT, OWN_CODE)}
        level["times"] = {name: float(each.min()) for name, each in times.items() if len(each)}
        level["phase_later"] = _phase_later(reached, level["drift"]["ours"])
        level["verdict"], free = ranked(reached, good, near, own, ~own), ranked(reached, good, near, calm, ~calm)
        at.append(level | {"pays": free in ("ahead", "alone"), "undecided": free == "undecided"})
    kept = [level["no_drift"]["ours"] for level in at[1:] if level["no_drift"]["ours"]]
    sides = [(level["no_drift"]["ours"], level["drift"]["ours"]) for level in at[1:]]
    both = [side for side in sides if all(side)]
    over_drifting = [one["call_s"] / other["call_s"] for one, other in both]
    plain = [
        level["no_drift"]["ours"]["call_s"] / level["times"][DEFAULT]
        for level in at[1:]
        if level["no_drift"]["ours"] and DEFAULT in level["times"]
    ]
    listed = where(rows, group="other")
    places = [run["energy"].abs().fillna(np.inf).idxmin() for _, run in listed.groupby("name", sort=False)]
    calm_ours: dict[str, Any] = {"labels": list(dict.fromkeys(run["label"] for run in kept))}
    calm_ours["fixed"] = bool(kept) and all(run["fixed_steps"] for run in kept)
    calm_ours["over_drifting"] = [min(over_drifting), max(over_drifting)] if over_drifting else None
    calm_ours["over_plain"] = [min(plain), max(plain)] if plain else None
    default = reached[own & ~calm & reached["solver"].isin((DEFAULT, OWN_CODE))]
    calm_ours["least"] = {"calm": float(reached[own & calm]["worst"].min()), "drifting": float(default["worst"].min())}
    calm_ours["drifting_explicit"] = bool(both) and all(other["explicit"] for _, other in both)
    found = {"case": SWITCHING, "problem": rows["problem"].iloc[0], "t_end": float(rows["t_end"].iloc[0])}
    found |= {"kinetic": kinetic, "no_drift": at[0]["no_drift"], "at": at[1:]}
    found |= {"calm_ours": calm_ours, "n_pays": sum(level["pays"] for level in at[1:])}
    found["n_undecided"] = sum(level["undecided"] for level in at[1:])
    found["n_verdicts"] = dict(Counter(level["verdict"] for level in at[1:]))
    found["repeats"] = int(rows["repeats"].max()) if "repeats" in rows else 1
    return found | {"alternatives": [told(rows.loc[place]) for place in places]}  # of each the run of least error


def variants_of(fixed: pd.DataFrame) -> list[dict[str, Any]]:
    """Fixed steps: the runs of each method in each variant on both geometries, None where there is none."""
    places = [(ONE, BASIC), (ONE, MOMENTA), *((SWITCHING, variant) for variant in VARIANTS)]
    found = []
    for solver in dict.fromkeys(fixed["solver"]):
        runs = [of(fixed[fixed["case"] == geometry], solver, variant) for geometry, variant in places]
        h = fixed[fixed["solver"] == solver]["h"].iloc[0]
        found.append({"solver": solver, "h": h, "runs": [None if run.empty else told(run.iloc[0]) for run in runs]})
    return found


def findings_of(rows: pd.DataFrame) -> dict[str, Any]:
    rows = judged(rows)
    fixed = where(rows, group="fixed", case=SWITCHING)
    even = fixed["partition"] == "symmetric"
    kinds = {"lasting": ~even, "even": even & (fixed["solver"] != SUN), "uneven": even & (fixed["solver"] == SUN)}
    calm = {name: fixed[which]["verdict"] == NO_DRIFT for name, which in kinds.items()}
    controlled = rows[rows["group"] == "controlled"]
    steady = controlled[~controlled["verdict"].isin(DRIFTING)]
    chosen = ((SUN,), (GAUSS,), (SUN, MOMENTA), (RADAU,))
    sun, gauss, canonical, radau = (told(pick(rows, ONE, *which)) for which in chosen)
    both = {"one": ONE, "switching": SWITCHING}
    found: dict[str, Any] = {"long": long_of(rows[rows["case"] == SWITCHING]), "sun": sun, "gauss": gauss}
    found["radau"] = radau
    found["radau_over_sun"] = abs(radau["drift"] / sun["drift"]) if sun["drifts"] and radau["drifts"] else None
    found |= {"canonical": canonical, "sun_over_gauss": abs(sun["drift"]) / gauss["bound"]}
    found["sun_over_canonical"] = abs(sun["drift"]) / canonical["bound"]
    found["variants"] = variants_of(rows[rows["group"] == "fixed"])
    found |= {"n": {name: len(each) for name, each in calm.items()}}
    found |= {"n_calm": {name: int(each.sum()) for name, each in calm.items()}}
    found["uneven_drifts"] = bool(fixed[kinds["uneven"]]["verdict"].isin(DRIFTING).all())
    found["n_controlled"] = len(controlled)
    found["controlled_steady"] = [told(run) | {"case": run["case"]} for _, run in steady.iterrows()]
    found["lasting"] = dict(Counter(FATES.get(each, "fail") for each in fixed[kinds["lasting"]]["verdict"]))
    found["paper"] = {name: told(pick(rows, motion, IRK, group="controlled")) for name, motion in both.items()}
    found["failed"] = int((rows["status"] != "REACHED_END").sum())
    found["problems"] = {name: rows[rows["case"] == motion]["problem"].iloc[0] for name, motion in both.items()}
    return found


def figures_of(rows: pd.DataFrame, found: dict[str, Any]) -> dict[str, Figure]:
    rows = judged(rows)
    return {"energy_cost": cost_figure(rows), "energy_long": time_figure(rows)}


def cost_figure(rows: pd.DataFrame) -> Figure:
    """Cost of the long run over its largest energy error, on the geometry whose partition changes."""
    long = rows[rows["case"] == SWITCHING]
    errors = long["energy"].abs().where(ended(long))
    long = long.assign(error_q=errors, floor=0.0, solver=long["name"], astray=False)
    long = long[long["solver"].isin(DRAWN) & ((long["solver"] != KEEPING) | long["h"].notna())]
    title = f"{number(long['t_end'].iloc[0])} s; ringed: no drift"
    figure = figures.work_precision(long, DRAWN, title, "largest energy error over the run (J)", coded=True)
    calm = long[long["verdict"] == NO_DRIFT]
    for axes, what in zip(figure.axes, ("call_s", "n_evaluations"), strict=True):
        ring: dict[str, Any] = {"markerfacecolor": "none", "markersize": 11, "markeredgewidth": 0.8}
        axes.plot(calm["error_q"], calm[what], "o", color="black", **ring)
    return figure


def time_figure(rows: pd.DataFrame) -> Figure:
    """Mean energy error over time with fixed steps, on both geometries."""
    dashes = {BASIC: "-", MOMENTA: ":", EVEN: "--"}
    chosen = [(SUN, BASIC), (SUN, MOMENTA), (GAUSS, BASIC), (GAUSS, EVEN), (RADAU, BASIC), (NEWMARK, BASIC)]
    figure, panels = plt.subplots(1, 2, figsize=(10.5, 3.8), sharey=True, layout="constrained")
    for axes, motion in zip(panels, (ONE, SWITCHING), strict=True):
        for solver, variant in chosen:
            for _, row in of(where(rows, group="fixed", case=motion), solver, variant).iterrows():
                if curves := row["series"]:
                    look = figures.look(row, coded=True) | {"linestyle": dashes[variant], "marker": ""}
                    look["label"] = f"{row['name']}, h = {row['h']:g} s"
                    axes.plot(curves["t"], np.abs(curves["mean"]), **look)
        axes.set(xscale="log", yscale="log", xlabel="time (s)")
        axes.set_title(f"{motion}: {rows[rows['case'] == motion]['problem'].iloc[0]}", fontsize=9)
    panels[0].set_ylabel("|mean energy error of a window| (J)")
    figures.legend(figure, panels)
    return figure


STUDY = Study("energy", __doc__, rows_of(runs, measure), findings_of, figures_of, medians=True, curves=True)
