"""Energy over long times: which methods let it drift, what a run without drift costs, and why."""

import math
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from functools import cache, partial
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from references.casadi.integrators import solve_sundials
from references.diffrax.dopri8 import solve_diffrax
from references.paper.four_bar_minimal import MinimalFourBar
from references.scipy.index1 import solve_index1
from studies.bench import figures, headline, solvers, tables
from studies.bench.cli import StudyError
from studies.bench.collector import REPEATS, Case, Run, Solver
from studies.bench.headline import OWN_CODE
from studies.bench.names import label
from studies.bench.reference_motion import ReferenceMotion
from studies.bench.render import number
from studies.bench.solvers import CYRK, HEYOKA, IDA_C, IRK
from studies.bench.store import Array
from studies.bench.study import Study, rows_of
from studies.bench.tables import setting, setting_of, where
from twoloop import BDF, Newmark, Result, RungeKutta, paper_irk, solve_dae
from twoloop.mechanisms import Problem, four_bar
from twoloop.methods.plan import Method
from twoloop.methods.tableaux import gauss, radau_iia, sun_radau_iib

EPS = float(np.finfo(float).eps)
RESOLVED = 3.0  # standard errors from which a slope counts as one
DRIFTS, SLOWLY, ROUNDS, IRREGULAR = "drifts", "drifts within the swing", "drifts within rounding", "changes irregularly"
NO_DRIFT, IS_LOST = "no drift", "lost"
DRIFTING = (DRIFTS, SLOWLY, ROUNDS)  # verdicts of runs with a slope; irregular changes have none, nor are they calm
WINDOWS = 100  # at most, in which the energy error is averaged
BLOCKS = 10  # of windows; the scatter of their slopes is the uncertainty of the slope


def windows(t: Array, error: Array, period: float, t_end: float) -> dict[str, Array]:
    """Mean and range of the energy error in windows of whole periods, WINDOWS or fewer."""
    width = math.ceil(t_end / WINDOWS / period) * period
    edges = width * np.arange(int(t[-1] / width) + 1)
    parts = np.split(error, np.searchsorted(t, edges))[1:-1]
    return {
        "t": edges[:-1] + 0.5 * width,
        "mean": np.array([part.mean() for part in parts]),
        "range": np.array([np.ptp(part) for part in parts]),
    }


def drift(t: Array, mean: Array) -> tuple[float, float]:
    """Return the slope of the windows' means by least squares, and its standard error from the slopes of BLOCKS parts.

    The scatter between blocks is right for a random walk, to which the residuals of one line are blind, and too large
    for an oscillation. Raises ValueError if there are fewer than two windows in a block.
    """
    if t.size < 2 * BLOCKS:
        raise ValueError(f"the slope of an energy error needs {2 * BLOCKS} windows or more; given {t.size}: run longer")
    slope = float(np.polyfit(t, mean, 1)[0])
    parts = np.array_split(np.arange(t.size), BLOCKS)
    slopes = [np.polyfit(t[part], mean[part], 1)[0] for part in parts]
    return slope, float(np.std(slopes, ddof=1) / math.sqrt(BLOCKS))


def verdict(row: pd.Series) -> str:
    """Return what the energy of a run does, from the numbers of its row alone.

    Without a slope, a run is free of drift only if the scatter of its windows cannot hide a change above the swing: a
    net slope of zero may be a walk that came back.
    """
    if row["status"] != "REACHED_END":
        status = str(row["status"]).lower().replace("_", " ")
        return status if pd.isna(row["t_reached"]) else f"{status} at {row['t_reached']:.4g} s"
    if row["lost"]:
        return IS_LOST
    if abs(row["slope"]) <= RESOLVED * row["slope_error"]:
        return NO_DRIFT if bound(row) <= row["swing"] else IRREGULAR
    change = abs(row["slope"]) * row["t_end"]
    if change <= EPS * row["kinetic"] * row["n_steps"]:
        return ROUNDS
    return DRIFTS if change > row["swing"] else SLOWLY


def bound(row: pd.Series) -> float:
    """The greatest change of the energy over a run, J, that the scatter of its windows does not exclude."""
    return float((abs(row["slope"]) + RESOLVED * row["slope_error"]) * row["t_end"])


ONE, SWITCHING = "one partition", "switching"
GEOMETRIES: dict[str, dict[str, Any]] = {
    ONE: {"lengths": (1.0, 1.2, 0.5), "ground": 1.0, "theta3": math.pi, "branch": 1},
    SWITCHING: {},
}
LONG, QUICK = 10_000.0, 75.0  # s
FLOOR = 1e-9  # m, rad; the one-coordinate solution after 10,000 s, some thousand periods
TIME_LIMIT = 300.0  # CPU s
MOST_STEPS = 30_000_000  # of solvers that count them and do not look at the clock
NOT_QUICK = (solvers.DIFFRAX, solvers.CVODES, solvers.CVODE_C_PROJECTED, solvers.CYRK)  # compile for seconds
GOLDEN = (3.0 - math.sqrt(5.0)) / 2.0  # of a period: far from every fraction of few parts, so no phase is left out

SUN, GAUSS, RADAU, MIDPOINT = "Sun Radau IIB(3)", "Gauss(3)", "Radau IIA(3)", "implicit midpoint"
NEWMARK = "Newmark, β = 1/2"
TABLEAUX = {SUN: sun_radau_iib(3), GAUSS: gauss(3), RADAU: radau_iia(3), MIDPOINT: gauss(1)}
METHODS: dict[str, Method] = {name: RungeKutta(tableau) for name, tableau in TABLEAUX.items()}
METHODS |= {NEWMARK: Newmark(0.5), solvers.IRK: paper_irk(), solvers.OWN_BDF: BDF()}
LASTING, EVEN = "lasting", "symmetric"  # choices of the partition
H, H_SMALL = 0.02, 0.01  # s; H_SMALL for methods of order 2
FIXED: dict[str, dict[str, tuple[str, ...]]] = {
    ONE: dict.fromkeys((SUN, GAUSS, RADAU, MIDPOINT, NEWMARK), (LASTING,)),
    SWITCHING: dict.fromkeys((SUN, GAUSS, MIDPOINT), (LASTING, EVEN)) | {NEWMARK: (LASTING,)},
}
COARSER = {GAUSS: (0.04, 0.03), MIDPOINT: (0.02,)}  # s, further steps of what is free of drift on SWITCHING, EVEN
CONTROLLED = {
    ONE: {solvers.IRK: LASTING, GAUSS: LASTING},
    SWITCHING: {solvers.IRK: LASTING, SUN: LASTING, GAUSS: EVEN, solvers.OWN_BDF: LASTING},
}
TOL = 1e-5  # Rtol = Atol
# of those on SWITCHING which may set a price: all others take three times as long for no smaller an energy error
REPEATED = (
    *(solvers.DEFAULT, OWN_CODE, solvers.OWN_EXPLICIT, "Gauss12", GAUSS, MIDPOINT, "Exudyn, TrapezoidalIndex2"),
    *(solvers.CVODE_C, solvers.CYRK, solvers.HEYOKA),
)
LSODA, PROJECTED = "LSODA, index 1", "DOP853, projected"
ALPHA, TRAPEZOIDAL = "Exudyn, GeneralizedAlpha", "Exudyn, TrapezoidalIndex2"


@cache
def linkage(geometry: str) -> tuple[Problem, MinimalFourBar]:
    """A linkage released from rest, and its true motion."""
    problem = four_bar(**GEOMETRIES[geometry])
    return problem, MinimalFourBar.from_parameters(problem.parameters)


@cache
def case_of(geometry: str, t_end: float) -> Case:
    """A linkage released from rest for so long, sampled at times spread over the phases of its period."""
    problem, motion = linkage(geometry)
    known = ReferenceMotion(motion.states, FLOOR, "one-coordinate formulation of its own")
    n = math.ceil(t_end / (0.25 * GOLDEN * motion.period))
    return Case(geometry, problem, t_end, lambda: known, n, time_limit=TIME_LIMIT, timed=0.0)


def instants(case: Case, h: float) -> Array | None:
    """Return multiples of a fixed step h near the case's instants, and its end; None (all steps) for short motions."""
    if case.t_end <= QUICK:
        return None
    interval = h * max(1, round(case.t_end / case.n_instants / h))
    n = int(case.t_end / interval * (1.0 - 1e-12))
    return np.append(interval * np.arange(n + 1, dtype=np.float64), case.t_end)


def _fixed(method: Method, case: Case, h: float, repeat: int) -> Result:
    return solve_dae(*case.start, method=method, step_size=h, t_eval=instants(case, h))


def _controlled(method: str | Method, case: Case, tol: float, repeat: int, compiled: bool = False) -> Result:
    """Every step is stored, except where steps are much shorter than the intervals of the sampling instants."""
    short = (method == "DOP853" and tol < 1e-9) or isinstance(method, BDF)
    times = case.instants if short else None
    return solve_dae(*case.start, method=method, rtol=tol, atol=tol, t_eval=times, compiled=compiled)


def _index1(method: str, stabilisation: str, case: Case, tol: float, repeat: int) -> Result:
    options: dict[str, Any] = {"stabilisation": stabilisation, "t_eval": np.append(0.0, case.instants)}
    return solve_index1(*case.start, method, tol, tol, **options)


def _long(solve: Callable[..., Result], case: Case, tol: float, repeat: int) -> Result:
    return solvers.at_instants(solve, case, rtol=tol, atol=tol, most_steps=MOST_STEPS)


def _exudyn(solver: str, case: Case, h: float, repeat: int) -> Result:
    from references.exudyn.mechanisms import solve_exudyn

    n_steps = round(case.t_end / h)
    every = next(k for k in range(max(1, int(case.t_end / case.n_instants / h)), 0, -1) if n_steps % k == 0)
    return solve_exudyn(case.problem, case.t_end, n_steps, solver, store_every=every)


FINE = (1e-6, 1e-8, 1e-10, 1e-12)
FINER = (1e-6, 3e-7, 1e-7, 3e-8, 1e-8, 3e-9, 1e-9, 3e-10, 1e-10, 3e-11, 1e-11, 1e-12)  # of those that set the price
# on SWITCHING: settings, loose to tight (quick: the first), and how each stores states at the case's instants
OTHERS: dict[str, tuple[tuple[float, ...], Callable[[Case, float, int], Result]]] = {
    solvers.DEFAULT: (FINER, partial(_controlled, "auto")),
    OWN_CODE: (FINER, partial(_controlled, "auto", compiled=True)),
    solvers.OWN_EXPLICIT: (FINE, partial(_controlled, "DOP853")),
    "Gauss12": ((1e-5, 1e-7), partial(_controlled, "Gauss12")),
    solvers.IDA_C: (FINE, solvers.CATALOGUE[solvers.IDA_C].run),
    solvers.CVODE_C: (FINER, solvers.CATALOGUE[solvers.CVODE_C].run),
    solvers.CYRK: (FINER, solvers.CATALOGUE[solvers.CYRK].run),
    solvers.CVODE_C_PROJECTED: (FINE, solvers.CATALOGUE[solvers.CVODE_C_PROJECTED].run),
    solvers.DIFFRAX: (FINE, partial(_long, solve_diffrax)),
    solvers.CVODES: (FINE, partial(_long, partial(solve_sundials, method="BDF"))),
    solvers.HEYOKA: ((*FINER, 1e-14), solvers.CATALOGUE[solvers.HEYOKA].run),
    LSODA: ((1e-8, 1e-10, 1e-12), partial(_index1, "LSODA", "none")),
    PROJECTED: ((1e-7, 1e-9, 1e-11), partial(_index1, "DOP853", "projection")),
    ALPHA: ((0.01,), partial(_exudyn, "GeneralizedAlpha")),
    TRAPEZOIDAL: ((0.02, 0.01, 0.005), partial(_exudyn, "TrapezoidalIndex2")),
}


def _two_loop(name: str, setting: str, partition: str) -> Solver:
    method = METHODS[name]
    if isinstance(method, RungeKutta) and partition == EVEN:
        method = replace(method, partition="symmetric")
    run = partial(_fixed if setting == "h" else _controlled, method)
    return Solver(name, "two-loop", "compiled", True, setting, run, fixed={"partition": partition})


def runs(quick: bool) -> list[Run]:
    """All runs; those whose times are compared are repeated."""
    found, cases = list[Run](), {name: case_of(name, QUICK if quick else LONG) for name in GEOMETRIES}
    for name, (values, run) in OTHERS.items():
        for value in () if quick and name in NOT_QUICK else reversed(values[:1] if quick else values):
            found.append(Run(cases[SWITCHING], replace(solvers.CATALOGUE[name], run=run), value, "other", 1))
    for geometry, controlled in CONTROLLED.items():
        for name, partition in controlled.items():
            found.append(Run(cases[geometry], _two_loop(name, "tol", partition), TOL, "controlled", 1))
    for geometry, methods in FIXED.items():
        for name, partitions in methods.items():
            h = H_SMALL if name in (MIDPOINT, NEWMARK) else H
            for partition in partitions:
                found.append(Run(cases[geometry], _two_loop(name, "h", partition), h, "fixed", 1))
    for name, steps in COARSER.items():
        for h in () if quick else steps:
            found.append(Run(cases[SWITCHING], _two_loop(name, "h", EVEN), h, "coarser", 1))
    compared = {(SWITCHING, name) for name in REPEATED} if not quick else set()
    return [replace(run, repeats=REPEATS) if (run.case.name, run.solver.name) in compared else run for run in found]


def measure(run: Run, result: Result) -> dict[str, Any]:
    """What the energy of a run does: slope and swing, and the windows that a figure shows."""
    case, problem = run.case, run.case.problem
    reached = float(result.t[-1]) if result.t.size else 0.0  # a run that fails at once has no output
    row: dict[str, Any] = {"t_reached": reached, "kinetic": case.scale.kinetic, "series": {}}
    row |= dict.fromkeys(("slope", "slope_error", "swing"))
    if not result.success:
        return row
    error = problem.energy(result.t, result.q, result.v) - problem.energy(0.0, problem.q0, problem.v0)
    seen = windows(result.t, error, linkage(case.name)[1].period, case.t_end)
    row["slope"], row["slope_error"] = drift(seen["t"], seen["mean"])
    row["swing"] = float(np.median(seen["range"]))
    return row | {"series": {"t": seen["t"], "mean": seen["mean"]}}


SHARES = (1e-3, 1e-5, 1e-7)  # of the largest kinetic energy: energy errors at which costs are compared
KEEPING = f"{GAUSS}, symmetric partition"
FATES = dict.fromkeys(DRIFTING, "drifts") | {NO_DRIFT: "no drift", IS_LOST: "loses the motion", IRREGULAR: "irregular"}
DRAWN = (OWN_CODE, KEEPING, CYRK, HEYOKA, IDA_C, TRAPEZOIDAL)  # over cost
PLACES = ((ONE, LASTING), (SWITCHING, LASTING), (SWITCHING, EVEN))  # of the table of fixed steps


def judged(rows: pd.DataFrame) -> pd.DataFrame:
    """Add the verdict on each run, and the method's name, with what is not the default."""
    name = rows["solver"] + rows["partition"].eq(EVEN).map({True: ", symmetric partition", False: ""})
    return rows.assign(verdict=rows.apply(verdict, axis=1), name=name)


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


def findings_of(rows: pd.DataFrame) -> dict[str, Any]:
    """Describe what drifts, what a run without drift costs, and why."""
    rows = judged(rows)
    fixed, controlled = where(rows, group="fixed", case=SWITCHING), rows[rows["group"] == "controlled"]
    even = fixed["partition"] == EVEN
    kinds = {"lasting": ~even, "even": even & (fixed["solver"] != SUN), "uneven": even & (fixed["solver"] == SUN)}
    found: dict[str, Any] = {"long": long_of(rows[rows["case"] == SWITCHING])}
    for name, solver in (("sun", SUN), ("gauss", GAUSS), ("radau", RADAU)):
        found[name] = told(pick(rows, ONE, solver))
    found["fates"] = []
    for solver in dict.fromkeys(rows[rows["group"] == "fixed"]["solver"]):
        runs = [of(where(rows, group="fixed", case=geometry), solver, partition) for geometry, partition in PLACES]
        fates = ["–" if run.empty else FATES.get(run.iloc[0]["verdict"], "fails") for run in runs]
        found["fates"].append({"solver": solver, "fates": fates})
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
    figures.message(figure, words if even else "Energy errors of runs with fixed steps", panels)
    return figure


STUDY = Study("energy", __doc__, rows_of(runs, measure), findings_of, figures_of, medians=True, curves=True)

if __name__ == "__main__":
    STUDY.main()
