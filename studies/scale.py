"""Cost against size: an evaluation of mechanisms of 3 to 3000 bodies, and chains beside Exudyn's own bodies."""

import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cache, partial
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from references.exudyn.pinned import solve_pinned
from studies.bench import figures, tables
from studies.bench.collector import Case, Run, Solver, called_from, timed
from studies.bench.large import ASSEMBLIES, Assembly, open_chain
from studies.bench.solvers import CATALOGUE, DEFAULT
from studies.bench.store import Output, Row
from studies.bench.study import Study
from twoloop import Result, solve_dae
from twoloop.mechanisms import Problem
from twoloop.rows.equal_error import resampled

EVALUATION, CHAIN = "evaluation", "chain"  # groups of rows
SIZES, QUICK_SIZES = (3, 10, 30, 100, 300, 1000, 3000), (3, 10)
METHOD, TOLERANCE = "DOP853", 1e-6
FROM, TO = 30, 1000  # bodies, between which the slope is fitted
SKIPPED, STEPS = 3, (24, 6)  # steps that set a run up, and steps timed: more of small mechanisms
MANY = 300  # bodies, from which on the smaller number of steps is timed
ROUNDS, REPEATS = 3, 3
CHAINS = {20: 1.0, 100: 0.3, 400: 0.15}  # bodies, and how long they move, s: later they are chaotic
ERRORS = (1e-3, 1e-4, 1e-5)  # at the end, over max(1, max |q|)
TOLERANCES = (1e-3, 1e-4, 1e-5, 1e-6, 1e-7, 1e-8)
EXUDYN = {f"Exudyn, {name}": name for name in ("GeneralizedAlpha", "TrapezoidalIndex2")}
N_STEPS = (100, 300, 1000, 3000, 10_000)  # of Exudyn; the last once
OTHERS = ("CVODE from C, Adams",)  # on the smallest chain: its expressions grow faster than the chain
STAGES = 12  # evaluations of a step of DOP853
LIMIT, TIGHT = 60.0, 1e-10  # s of CPU of a run; tolerance of the reference
AGREE = 1e-7  # how far two unlike methods may end apart with it


def problem_of(made: Assembly, t_end: float) -> Problem:
    """An assembly released from rest."""
    q0 = made.q
    energy = made.bodies.energy
    return Problem(made.system.name, made.system, q0, np.zeros_like(q0), (0.0, t_end), energy, conserved=True)


def make(output: Output) -> pd.DataFrame:
    """Rows of evaluations, then of chains."""
    quick = output.call.quick
    with output.kept() as kept:
        rows = [kept.made(key, row) for key, row in (*_evaluations(quick), *_chains(quick))]
    return pd.DataFrame(rows)


def _evaluations(quick: bool) -> Iterator[tuple[str, Callable[[], Row]]]:
    for repeat in range(1 if quick else ROUNDS):
        for n in QUICK_SIZES if quick else SIZES:
            for build in ASSEMBLIES:
                yield f"{EVALUATION} | {build.__name__} | {n} | {repeat}", partial(evaluation, build, n, repeat)


def evaluation(build: Callable[[int], Assembly], n: int, repeat: int) -> Row:
    """Time of an evaluation, with its share of projections and all else of a step, and of a first call."""
    case = build.__name__.replace("_", " ")
    row: Row = {"group": EVALUATION, "case": case, "solver": f"{METHOD} (twoloop)", "n": n, "repeat": repeat}
    row |= {"evaluation_us": None, "step_us": None, "start_s": None, "status": "", "message": ""}
    began = time.process_time()
    problem = problem_of(build(n), 1.0)
    steps = STEPS[n >= MANY]
    try:
        few = _steps(problem, SKIPPED)
        row["start_s"] = time.process_time() - began - few.stats.cpu_time
        many = _steps(problem, SKIPPED + steps)
    except (RuntimeError, ValueError) as error:  # a row that says so, and no point of the fit
        return row | {"status": "FAILED", "message": str(error)}
    spent = 1e6 * (many.stats.cpu_time - few.stats.cpu_time)
    evaluations = (many.stats.n_evaluations or 0) - (few.stats.n_evaluations or 0)
    return row | {"step_us": spent / steps, "evaluation_us": spent / evaluations, "status": "REACHED_END"}


def _steps(problem: Problem, steps: int) -> Result:
    options: dict[str, Any] = {"method": METHOD, "rtol": TOLERANCE, "atol": TOLERANCE, "compiled": False}
    result = solve_dae(problem.system, (0.0, 100.0), problem.q0, problem.v0, max_steps=steps, **options)
    if result.stats.n_accepted != steps:
        raise RuntimeError(result.message)
    return result


def _chains(quick: bool) -> Iterator[tuple[str, Callable[[], Row]]]:
    sizes = list(CHAINS)[:1] if quick else list(CHAINS)
    for repeat in range(1 if quick else REPEATS):
        for n in sizes:
            for solver, values in solvers(n).items():
                for value in values[:2] if quick else values:
                    if repeat > 0 and solver in EXUDYN and value == min(values):
                        continue
                    key = f"{CHAIN} | {n} | {solver} | {value!r} | {repeat}"
                    yield key, partial(chain_row, n, solver, value, repeat)


def solvers(n: int) -> dict[str, tuple[float, ...]]:
    """What runs a chain of n bodies, and tolerances, or steps in s."""
    steps = tuple(CHAINS[n] / n_steps for n_steps in N_STEPS)
    ours = dict.fromkeys((DEFAULT, "DOP853 (twoloop)"), TOLERANCES)
    others = dict.fromkeys(OTHERS, TOLERANCES) if n == min(CHAINS) else {}
    return {**ours, **dict.fromkeys(EXUDYN, steps), **others}


@cache
def case_of(n: int) -> tuple[Case, Assembly]:
    """A chain of n bars."""
    made = open_chain(n)
    problem = problem_of(made, CHAINS[n])
    return Case(f"open chain of {n}", problem, CHAINS[n], n_instants=1, time_limit=LIMIT), made


@cache
def ends(n: int) -> np.ndarray:
    """Where a chain ends, by two unlike methods.

    Raises
    ------
    RuntimeError
        If they end apart.
    """
    problem = case_of(n)[0].problem
    start = problem.system, problem.t_span, problem.q0, problem.v0
    one, other = (solve_dae(*start, method=method, rtol=TIGHT, atol=TIGHT).q[:, -1] for method in ("DOP853", "Adams"))
    if np.abs(one - other).max() > AGREE:
        raise RuntimeError(f"DOP853 and Adams end {np.abs(one - other).max():.1g} apart on a chain of {n}")
    return one


@cache
def solver_of(name: str) -> Solver:
    """A solver of the catalogue, or Exudyn with bodies and joints of its own."""
    if name not in EXUDYN:
        return CATALOGUE[name]

    def run(case: Case, step: float, repeat: int) -> Result:
        bodies = case_of(case.problem.q0.size // 3)[1].bodies
        return solve_pinned(case.problem, bodies, round(case.t_end / step), EXUDYN[name], case.time_limit)

    return replace(CATALOGUE[name], run=run)


def chain_row(n: int, solver: str, value: float, repeat: int) -> Row:
    """A run of a solver on a chain."""
    case, chosen = case_of(n)[0], solver_of(solver)
    run = Run(case, chosen, value)
    row: Row = {"group": CHAIN, "case": case.name, "solver": solver, "family": chosen.family, "n": n, "repeat": repeat}
    row |= {"called_from": called_from(run), "keeps_constraints": chosen.keeps_constraints, chosen.setting: value}
    result, status, message, times = timed(run, repeat)
    row |= {**times, "status": status, "message": message, "error_q": None, "floor": AGREE}
    if result is None or status != "REACHED_END":
        return row
    end, expected = result.q[:, -1], ends(n)
    error = np.abs(end - expected).max() / max(1.0, np.abs(expected).max())
    return row | {"error_q": float(error), "n_evaluations": result.stats.n_evaluations}


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


def findings_of(rows: pd.DataFrame) -> dict[str, Any]:
    """Slopes and times by kind of mechanism; chains at equal error."""
    found: dict[str, Any] = {"kinds": [], "chains": [], "from": FROM, "to": TO, "errors": list(ERRORS), "limit": LIMIT}
    made = rows[(rows["group"] == EVALUATION) & rows["evaluation_us"].notna()]
    for case, own in made.groupby("case", sort=False):
        by_size = own.groupby("n")
        times = {int(n): tuple(each["evaluation_us"].astype(float)) for n, each in by_size}
        us = {n: float(np.median(each)) for n, each in times.items()}
        dear = [n for n in us if any(us[n] > us[m] for m in us if m > n)]
        line = {"case": str(case), "us": us, "dear": dear}
        line["start_s"] = {int(n): float(each["start_s"].median()) for n, each in by_size}
        found["kinds"].append(line | {"slope": None if dear else slope(list(times), list(times.values()))})
    found["failed"] = rows[rows["group"].eq(EVALUATION) & rows["status"].eq("FAILED")][["case", "n"]].to_dict("records")
    chains = rows[rows["group"] == CHAIN].sort_values(
        ["n", "solver", "h", "tol", "repeat"], ascending=[True] * 2 + [False] * 2 + [True]
    )
    for n, own in chains.groupby("n"):
        medians = tables.medians(own.reset_index(drop=True))
        of_chain: dict[str, Any] = {
            "n": int(n),
            "t_end": CHAINS[int(n)],
            "lines": tables.work_precision(medians, ERRORS),
        }
        of_chain["over_exudyn"] = [ratio for error in ERRORS if (ratio := over_exudyn(medians, error))]
        of_chain |= {
            "step": steps_of(medians),
            "fastest": [each for error in ERRORS if (each := fastest(medians, error))],
        }
        found["chains"].append(of_chain)
    return found


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


def fastest(medians: pd.DataFrame, error: float) -> dict[str, Any] | None:
    """The rival with the cheapest run within an error, and the default's time over its; None: one has no such run."""
    costs = {str(name): tables.as_good(own, error) for name, own in medians.groupby("solver", sort=False)}
    rivals = [
        name for name in medians[medians["family"] != "two-loop"]["solver"].unique() if costs[name] == costs[name]
    ]
    ours = costs.get(DEFAULT, np.nan)
    if not rivals or not np.isfinite(ours):
        return None
    best = min(rivals, key=costs.__getitem__)
    return {"error": error, "solver": best, "run_s": costs[best], "ours_s": ours}


def figures_of(rows: pd.DataFrame, found: dict[str, Any]) -> dict[str, Figure]:
    """An evaluation over the number of bodies, and what an accuracy costs on chains."""
    figure, axes = plt.subplots(figsize=(6.4, 4.4), layout="constrained")
    for line, color, marker in zip(found["kinds"], figures.COLORS, "osD^vP", strict=False):
        axes.plot(list(line["us"]), list(line["us"].values()), marker=marker, color=color, label=line["case"])
    axes.set(xscale="log", yscale="log", xlabel="bodies", ylabel="time of an evaluation, projections included (µs)")
    axes.legend(fontsize=8)
    axes.grid(alpha=0.3)
    chains = rows[(rows["group"] == CHAIN) & rows["error_q"].notna()]
    sizes = sorted(set(chains["n"]))
    width: dict[str, Any] = {"figsize": (3.4 * len(sizes) + 1.2, 4.2), "layout": "constrained", "squeeze": False}
    second, panels = plt.subplots(1, len(sizes), sharey=True, **width)
    for panel, n in zip(panels[0], sizes, strict=True):
        for solver, own in chains[chains["n"] == n].groupby("solver", sort=False):
            line = own.assign(setting=own["tol"].fillna(own["h"])).groupby("setting")[["error_q", "call_s"]].median()
            look = figures.style(str(solver), str(own["family"].iloc[0]), bool(own["keeps_constraints"].iloc[0]))
            panel.plot(line["error_q"], line["call_s"], **look | {"label": str(solver)})
        panel.set(xscale="log", yscale="log", xlabel="error of q at the end, over max(1, max |q|)", title=f"{n} bars")
        panel.grid(alpha=0.3)
    panels[0][0].set_ylabel("CPU time of the call (s)")
    shown = {label: line for axes in panels[0] for line, label in zip(*axes.get_legend_handles_labels(), strict=True)}
    second.legend(shown.values(), shown, loc="outside lower center", ncols=3, fontsize=8)
    return {"scale": figure, "scale_chains": second}


STUDY = Study("scale", __doc__, make, findings_of, figures_of)
main = STUDY.main

if __name__ == "__main__":
    main()
