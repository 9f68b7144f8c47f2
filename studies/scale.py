"""Cost against size: an evaluation of mechanisms of 3 to 3000 bodies, and chains beside other solvers."""

import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cache, partial
from itertools import pairwise, product
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from references.engines.trees import ENGINES, TreeDynamics, end_by_pinocchio
from references.exudyn.mechanisms import solve_pinned
from references.sundials.ida_sparse import solve_ida_sparse
from studies.bench import figures, tables
from studies.bench.cli import track
from studies.bench.collector import Case, Run, Solver, called_from, timed
from studies.bench.large import PLANAR, SPATIAL, Assembly, open_chain, tree
from studies.bench.names import label
from studies.bench.render import listed, number, power
from studies.bench.solvers import CATALOGUE, CVODE_C, CYRK, DEFAULT, HEYOKA, at_instants
from studies.bench.store import Output, Row
from studies.bench.study import Study
from twoloop import Result, solve_dae
from twoloop.mechanisms import Problem

EVALUATION, CHAIN = "evaluation", "chain"  # groups of rows
Keyed = Iterator[tuple[str, Callable[[], Row]]]  # what a row is kept by, and what makes it
SIZES, QUICK_SIZES = (3, 10, 30, 100, 300, 1000, 3000), (3, 10)
METHOD, TOLERANCE = "DOP853", 1e-6
SKIPPED, STEPS = 3, 6  # steps that set a run up, and steps timed: few, as motions differ later by size
MANY, AGAIN = 300, 5  # bodies, below which the steps are timed so many times
ROUNDS, REPEATS = 3, 3
CHAINS = {20: 1.0, 100: 0.3, 400: 0.15}  # bodies, and how long they move, s: later they are chaotic
ERRORS = (1e-3, 1e-4, 1e-5)  # at the end, over max(1, max |q|)
TOLERANCES = (1e-3, 1e-4, 1e-5, 1e-6, 1e-7, 1e-8)
EXUDYN = {f"Exudyn, {name}": name for name in ("GeneralizedAlpha", "TrapezoidalIndex2")}
N_STEPS = (100, 300, 1000, 3000, 10_000, 30_000)  # of Exudyn; the last two once
ONCE = 2
SPARSE_IDA, IDA_TOLERANCES = "IDA, sparse", (1e-4, 1e-5, 1e-6, 1e-7, 1e-8)  # where entries are given by values: once
OTHERS = {20: (CVODE_C, CYRK, HEYOKA), 100: (CVODE_C, CYRK)}  # by size: their expressions grow faster than the chain
LIMIT, TIGHT = 60.0, 1e-10  # s of CPU of a run; tolerance of the reference
AGREE = 1e-7  # how far two unlike methods may end apart with it


def problem_of(made: Assembly, t_end: float) -> Problem:
    """Return an assembly released from rest."""
    start = made.q, np.zeros_like(made.q), (0.0, t_end)
    return Problem(made.system.name, made.system, *start, made.bodies.energy, conserved=True)


def evaluations(quick: bool) -> Keyed:
    """Make rows of evaluations of twoloop."""
    for repeat in range(1 if quick else ROUNDS):
        for n in QUICK_SIZES if quick else SIZES:
            for build in (*PLANAR, *SPATIAL):
                yield f"{EVALUATION} | {build.__name__} | {n} | {repeat}", partial(evaluation, build, n, repeat)


def evaluation(build: Callable[[int], Assembly], n: int, repeat: int) -> Row:
    """Time an evaluation, its share of projections (`passes` in a step) and all else of a step, and a first call."""
    case = build.__name__.replace("_", " ")
    row: Row = {"group": EVALUATION, "case": case, "solver": f"{METHOD} (twoloop)", "n": n, "repeat": repeat}
    row |= {"evaluation_us": None, "step_us": None, "passes": None, "start_s": None, "status": "", "message": ""}
    began = time.process_time()
    problem = problem_of(build(n), 1.0)
    times = []
    try:
        few = _steps(problem, SKIPPED)
        row["start_s"] = time.process_time() - began - few.stats.cpu_time
        for _ in range(1 if n >= MANY else AGAIN):
            few, many = _steps(problem, SKIPPED), _steps(problem, SKIPPED + STEPS)
            times.append(1e6 * (many.stats.cpu_time - few.stats.cpu_time))
    except (RuntimeError, ValueError) as error:  # a row that says so, and no point of the fit
        return row | {"status": "FAILED", "message": str(error)}
    spent = float(np.median(times))
    evaluations = (many.stats.n_evaluations or 0) - (few.stats.n_evaluations or 0)
    passes = ((many.stats.n_inner or 0) - (few.stats.n_inner or 0)) / STEPS
    row |= {"step_us": spent / STEPS, "evaluation_us": spent / evaluations, "passes": passes}
    return row | {"status": "REACHED_END"}


def _steps(problem: Problem, steps: int) -> Result:
    options: dict[str, Any] = {"method": METHOD, "rtol": TOLERANCE, "atol": TOLERANCE, "compiled": False}
    result = solve_dae(problem.system, (0.0, 100.0), problem.q0, problem.v0, max_steps=steps, **options)
    if result.stats.n_accepted != steps:
        raise RuntimeError(result.message)
    return result


def chains(quick: bool) -> Keyed:
    """Make rows of runs of chains."""
    sizes = list(CHAINS)[:1] if quick else list(CHAINS)
    for repeat in range(1 if quick else REPEATS):
        for n in sizes:
            for solver, values in solvers(n).items():
                for value in values[:2] if quick else values:
                    if repeat > 0 and (solver == SPARSE_IDA or (solver in EXUDYN and value in values[-ONCE:])):
                        continue
                    key = f"{CHAIN} | {n} | {solver} | {value!r} | {repeat}"
                    yield key, partial(chain_row, n, solver, value, repeat)


def solvers(n: int) -> dict[str, tuple[float, ...]]:
    """Return the solvers of a chain of n bodies, with tolerances, or steps in s."""
    steps = tuple(CHAINS[n] / n_steps for n_steps in N_STEPS)
    ours = dict.fromkeys((DEFAULT, "DOP853 (twoloop)"), TOLERANCES)
    others: dict[str, tuple[float, ...]] = dict.fromkeys(OTHERS.get(n, ()), TOLERANCES)
    if n != min(CHAINS):
        others[SPARSE_IDA] = IDA_TOLERANCES
    return {**ours, **dict.fromkeys(EXUDYN, steps), **others}


@cache
def case_of(n: int, t_end: float) -> tuple[Case, Assembly]:
    """Return a chain of n bars."""
    made = open_chain(n)
    problem = problem_of(made, t_end)
    return Case(f"open chain of {n}", problem, t_end, n_instants=1, time_limit=LIMIT), made


@cache
def ends(n: int, t_end: float) -> tuple[np.ndarray, str]:
    """Return the end of a chain by two routes, and the name of the second; RuntimeError if the ends differ."""
    case, made = case_of(n, t_end)
    options: dict[str, Any] = {"rtol": TIGHT, "atol": TIGHT}
    one = solve_dae(*case.start, method=METHOD, **options).q[:, -1]
    try:
        other, second = end_by_pinocchio(made.bodies, made.q[2::3], t_end, TIGHT), "Pinocchio"
    except RuntimeError:  # it is not installed
        other, second = solve_dae(*case.start, method="Adams", **options).q[:, -1], "Adams"
    if np.abs(one - other).max() > AGREE:
        raise RuntimeError(f"{METHOD} and {second} end {np.abs(one - other).max():.1g} apart on a chain of {n}")
    return one, second


@cache
def solver_of(name: str) -> Solver:
    """Return a solver of the catalogue, IDA with sparse factors, or Exudyn with bodies and joints of its own."""
    if name == SPARSE_IDA:
        ida = lambda case, tol, _: at_instants(solve_ida_sparse, case, rtol=tol, atol=tol)  # noqa: E731
        return Solver(name, "SUNDIALS", "Python", True, "tol", ida)
    if name not in EXUDYN:
        return CATALOGUE[name]

    def run(case: Case, step: float, repeat: int) -> Result:
        bodies = case_of(case.problem.q0.size // 3, case.t_end)[1].bodies
        return solve_pinned(case.problem, bodies, round(case.t_end / step), EXUDYN[name], case.time_limit)

    return replace(CATALOGUE[name], run=run)


def chain_row(n: int, solver: str, value: float, repeat: int) -> Row:
    """Run a solver on a chain."""
    case, chosen = case_of(n, CHAINS[n])[0], solver_of(solver)
    run = Run(case, chosen, value)
    row: Row = {"group": CHAIN, "case": case.name, "solver": solver, "family": chosen.family, "n": n, "repeat": repeat}
    row |= {"called_from": called_from(run), "keeps_constraints": chosen.keeps_constraints, chosen.setting: value}
    built = {run.key(0)} if solver in EXUDYN or solver == SPARSE_IDA else None  # before the call that is timed
    result, status, message, times = timed(run, repeat, built)  # type: ignore[arg-type]
    row |= {**times, "status": status, "message": message, "error_q": None, "floor": AGREE}
    expected, row["reference"] = ends(n, CHAINS[n])
    if result is None or status != "REACHED_END":
        return row
    error = np.abs(result.q[:, -1] - expected).max() / max(1.0, np.abs(expected).max())
    return row | {"error_q": float(error), "n_evaluations": result.stats.n_evaluations}


TREE = "tree"  # group of rows
TREES, TREE_SIZES = (open_chain, tree), (10, 30, 100, 300)  # of 600, Pinocchio holds over 7 GB
SOON, APART = 0.01, 1e-6  # s, after which a tree moves; largest relative difference of accelerations
TIMED = 0.05  # s of CPU time, of evaluations one after another


def trees(quick: bool) -> Keyed:
    """Make rows of accelerations of trees in engines."""
    rounds, sizes = range(1 if quick else ROUNDS), QUICK_SIZES[1:] if quick else TREE_SIZES
    for repeat, n, build, engine in product(rounds, sizes, TREES, ENGINES):
        key = f"{TREE} | {build.__name__} | {n} | {engine} | {repeat}"
        yield key, partial(tree_row, build, n, engine, repeat)


@cache
def _moving(build: Callable[[int], Assembly], n: int) -> tuple[Assembly, np.ndarray, np.ndarray, np.ndarray]:
    """Return a tree soon after its release: angles, angular velocities and accelerations."""
    made = build(n)
    result = solve_dae(made.system, (0.0, SOON), made.q, np.zeros_like(made.q))
    q, v, a = (each[2::3, -1] for each in (result.q, result.v, result.a))
    return made, q, v, a


@cache
def _dynamics(build: Callable[[int], Assembly], n: int, engine: str) -> tuple[TreeDynamics, float]:
    """Return the tree in an engine, and the time that it takes to build, s."""
    made, angles, rates, _ = _moving(build, n)
    began = time.process_time()
    dynamics = ENGINES[engine](made.bodies, angles, rates)
    return dynamics, time.process_time() - began


def tree_row(build: Callable[[int], Assembly], n: int, engine: str, repeat: int) -> Row:
    """Time an evaluation of an engine whose accelerations agree with those of twoloop."""
    case, expected = build.__name__.replace("_", " "), _moving(build, n)[3]
    row: Row = {"group": TREE, "case": case, "solver": engine, "n": n, "repeat": repeat, "evaluation_us": None}
    try:
        dynamics, took = _dynamics(build, n, engine)
    except RuntimeError as error:
        return row | {"status": "NOT_AVAILABLE", "message": str(error)}
    began = time.process_time()
    dynamics.evaluate()
    times = max(1, int(TIMED / max(1e-9, time.process_time() - began)))
    apart = float(np.abs(dynamics.angular() - expected).max() / np.abs(expected).max())
    row |= {"start_s": took, "error_q": apart}
    if not apart < APART:
        message = f"accelerations are {apart:.1g} of the largest apart from those of twoloop"
        return row | {"status": "FAILED", "message": message}
    began = time.process_time()
    for _ in range(times):
        dynamics.evaluate()
    return row | {"evaluation_us": 1e6 * (time.process_time() - began) / times, "status": "REACHED_END"}


FROM, TO = 30, 1000  # bodies, between which the power is fitted
CAREFUL = 5.0  # passes of the projection in a step, beyond which stages are projected too
BEND = 0.3  # by which the power between two sizes differs notably from the fitted one
SHOWN = ("open chain", "ladder", "tree", "grid", "open chain of hinges", "tree of hinges")  # in the figure
COMPARED = ERRORS[1]  # error of the table of chains
OURS = "twoloop, compiled=False"
ONE_OF = list(EXUDYN)[1:]  # Exudyn's other solver is much the same: it is in no figure


def make(output: Output) -> pd.DataFrame:
    """Make the rows of evaluations, of trees in engines, and of chains."""
    keyed = [each for part in (evaluations, trees, chains) for each in part(output.call.quick)]
    keyed = [each for each in keyed if output.call.wants(*each[0].split(" | "))]
    with output.kept() as kept:
        return pd.DataFrame([kept.made(key, run) for key, run in track(keyed, lambda each: each[0])])


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
        text += f"; on {largest['n']} bodies {_short(best['solver'])} takes {number(best['ratio'])} times as long"
        text += f" ({power(COMPARED)})"
    return f"{text}."


def figures_of(rows: pd.DataFrame, found: dict[str, Any]) -> dict[str, Figure]:
    """Draw an evaluation over the number of bodies, and time over error on chains."""
    figure, axes = plt.subplots(figsize=(7.6, 4.0), layout="constrained")
    kinds = [each for each in found["kinds"] if each["case"] in SHOWN]
    for each, color in zip(kinds, figures.shades(len(kinds)), strict=True):
        axes.plot(list(each["us"]), list(each["us"].values()), "o-", color=color, label=each["case"])
    axes.set(xscale="log", yscale="log", xlabel="bodies", ylabel="time of an evaluation (µs)")
    figures.message(figure, _growth(found), axes)
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
    at = {each["n"]: each["fastest"].get(power(COMPARED)) for each in found["chains"]}
    parts = [f"{number(best['ratio'])} ({n} bars, {_short(best['solver'])})" for n, best in at.items() if best]
    text = f"At an error of {power(COMPARED)} the fastest other solver takes {listed(parts)} times as long as twoloop"
    figures.message(second, text if parts else "No two solvers reach the same error", panels[0])
    return {"scale": figure, "scale_chains": second}


def _short(solver: str) -> str:
    return OURS if solver == DEFAULT else label(solver).split()[0].rstrip(",")


STUDY = Study("scale", __doc__, make, findings_of, figures_of)

if __name__ == "__main__":
    STUDY.main()
