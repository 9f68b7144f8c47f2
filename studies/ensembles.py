"""Thousands of runs of one mechanism in one call: `twoloop.ensemble` beside heyoka, CyRK, CVODE and diffrax."""

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from references.driver import user_call
from references.equations.many_at_once import by_cvode, by_cyrk, by_diffrax, by_heyoka, by_heyoka_ensemble
from references.paper.four_bar_minimal import MinimalFourBar
from studies.bench import figures, tables
from studies.bench.cli import StudyError, processor
from studies.bench.collector import REPEATS
from studies.bench.render import number
from studies.bench.store import Array, Output
from studies.bench.study import Study
from twoloop import consistent_states, ensemble, mechanisms, solve_dae
from twoloop.ensembles.lanes import threads_of
from twoloop.mechanisms import Problem, four_bar
from twoloop.mechanisms.four_bar import DENSITY, GRAVITY

VARIED, DRAWN = "random linkages", "in one call"  # groups of rows
SPAN = 6.0  # s
SPREAD = 0.02  # of lengths that are varied
SEED, SEED_DRAWN = 2016, 2017
BLOCK = 50_000  # linkages in a call, which bounds the memory
N_TIMES = 12  # of each run, at which its energy is taken
N_WORST, N_ANY = 20, 100  # linkages whose ends are compared: of largest energy errors, of most steps; of all
RANGES = {"L1": (0.8, 1.5), "L2": (1.0, 2.0), "L3": (0.8, 1.6), "ground": (2.0, 3.0), "theta3": (-1.0, 1.0)}


def drawn(n: int) -> list[dict[str, Any]]:
    """Return the parameters of n linkages, always the same ones."""
    random, given = np.random.default_rng(SEED), []
    for _ in range(n):
        values = {name: round(float(random.uniform(*limits)), 4) for name, limits in RANGES.items()}
        given.append({**values, "branch": int(random.choice((-1, 1)))})
    return given


def linkage(L1: float, L2: float, L3: float, ground: float, theta3: float, branch: int) -> Problem:
    """Return a linkage of these lengths, released from rest."""
    return four_bar((L1, L2, L3), ground, theta3, branch)


def varied_row(n: int, block: int = 2 * BLOCK) -> dict[str, Any]:
    """Vary the lengths of the four-bar, assemble and run n linkages on all cores, and time it."""
    problem, random = four_bar(), np.random.default_rng(11)
    began, failed, singly, spent = time.perf_counter(), 0, 0, time.process_time()
    for first in range(0, n, block):
        varied = 1.0 + SPREAD * random.uniform(-1.0, 1.0, (min(block, n - first), 4))
        p = problem.system.parameters * varied
        q, v = consistent_states(problem.system, 0.0, problem.q0, problem.v0, parameters=p, keep=[8])
        runs = ensemble(problem.system, (0.0, SPAN), q, v, parameters=p)
        failed, singly = failed + int((~runs.success).sum()), singly + int(runs.singly.sum())
    row = {"group": VARIED, "n_runs": n, "n_threads": threads_of(None), "wall": time.perf_counter() - began}
    return row | {"cpu": time.process_time() - spent, "n_failed": failed, "n_singly": singly}


def assembled(n: int) -> tuple[Array, Array]:
    """Draw n linkages; return those that can be assembled (m, 6) with their positions (m, 9).

    Columns of the first: those of `RANGES`, and the branch. Joint 2-3 is the third corner of a triangle with O.
    """
    low, high = np.array(list(RANGES.values())).T
    uniform = np.random.default_rng(SEED_DRAWN).uniform(size=(n, 6))
    given = np.column_stack([low + (high - low) * uniform[:, :5], np.where(uniform[:, 5] < 0.5, -1.0, 1.0)])
    L1, L2, L3, ground, theta3, branch = given.T
    x, y = ground - L3 * np.cos(theta3), -L3 * np.sin(theta3)
    distance = np.hypot(x, y)
    reach = (np.abs(L1 - L2) < distance) & (distance < L1 + L2)
    given, x, y, distance = given[reach], x[reach], y[reach], distance[reach]
    L1, L2, L3, ground, theta3, branch = given.T
    theta1 = np.arctan2(y, x) + branch * np.arccos((L1**2 + distance**2 - L2**2) / (2.0 * L1 * distance))
    theta2 = np.arctan2(y - L1 * np.sin(theta1), x - L1 * np.cos(theta1))
    ends, places = np.zeros((2, len(given))), []
    for length, angle in ((L1, theta1), (L2, theta2), (L3, theta3)):
        bar = length * np.array([np.cos(angle), np.sin(angle)])
        places += [*(ends + 0.5 * bar), angle]
        ends = ends + bar
    return given, np.ascontiguousarray(np.transpose(places))


def energies(lengths: Array, q: Array, v: Array) -> Array:
    """Return energies (n, n_t) at states (n, 9, n_t), over the sum of weights times lengths of the bars (n, 3)."""
    masses = (DENSITY * lengths)[:, :, None]
    speeds = v[:, 0::3] ** 2 + v[:, 1::3] ** 2 + lengths[:, :, None] ** 2 / 12.0 * v[:, 2::3] ** 2
    total = (masses * (0.5 * speeds + GRAVITY * q[:, 1::3])).sum(axis=1)
    return np.asarray(total / (GRAVITY * DENSITY * (lengths**2).sum(axis=1, keepdims=True)))


def end_error(given: Array, q: Array, t_end: float) -> float:
    """Return how far a run ends from the solution of the equation in one coordinate; NaN where that fails."""
    *lengths, ground, theta3, branch = given.tolist()
    try:
        known = MinimalFourBar(tuple(lengths), ground, theta3, int(branch), DENSITY, GRAVITY)
    except ValueError:
        return float("nan")
    return float(np.abs(known.states(np.array([t_end]))[0][:, 0] - q).max())


def drawn_row(n: int, t_end: float = SPAN) -> dict[str, Any]:
    """Draw, assemble and run n linkages; return the times, and errors of energy and of some ends.

    `end_error_hard`: of the runs with the largest energy errors and most steps, and of runs not in lanes;
    `end_error_any`: of the first runs.
    """
    times, system, began = np.linspace(0.0, t_end, N_TIMES + 1)[1:], four_bar().system, time.perf_counter()
    given, q0 = assembled(n)
    errors, steps, ends, singly, failed = [], [], [], [], 0
    for first in range(0, len(given), BLOCK):
        some = slice(first, first + BLOCK)
        p = given[some, :4]
        runs = ensemble(system, (0.0, t_end), q0[some], np.zeros(9), parameters=p, t_eval=times)
        before = energies(p[:, :3], q0[some][:, :, None], np.zeros((len(p), 9, 1)))
        differences = np.abs(energies(p[:, :3], runs.q, runs.v) - before).max(axis=1)
        errors.append(np.where(runs.success, differences, np.nan))
        steps.append(runs.n_steps)
        ends.append(runs.q[:, :, -1].copy())
        singly += [first + k for k in runs.reasons if k > 0]  # the first of a call checks the system
        failed += int((~runs.success).sum())
    wall = time.perf_counter() - began
    off, taken, q = np.concatenate(errors), np.concatenate(steps), np.concatenate(ends)
    row: dict[str, Any] = {"group": DRAWN, "n_runs": n, "n_threads": threads_of(None), "wall": wall}
    row |= {"n_assembled": len(given), "n_failed": failed, "n_singly": len(singly)}
    row |= {"energy_median": float(np.nanmedian(off)), "energy_error": float(np.nanmax(off))}
    hard = {*np.argsort(-np.nan_to_num(off))[:N_WORST], *np.argsort(-taken)[:N_WORST], *singly}
    for name, chosen in (("hard", sorted(hard)), ("any", range(min(N_ANY, len(given))))):
        row[f"end_error_{name}"] = float(np.nanmax([end_error(given[k], q[k], t_end) for k in chosen]))
    return row


Solve = Callable[[float], Array]  # tolerance -> q at the end (n_runs, n_q), NaN of what failed

GROUP = "many"  # of rows; the other groups are VARIED and DRAWN
TOLERANCES, QUICK_TOLERANCES = tuple(float(f"1e-{k}") for k in range(4, 12)), (1e-6, 1e-9)
BETWEEN = (1e-3, *(float(f"3e-{k}") for k in range(4, 12)))  # of ways whose error leaps from one of these to the next
ERRORS = (1e-4, 1e-6, 1e-8)  # of the worst of the runs, at which ways are compared
SHOWN = 1e-6  # in the table of times
TIGHT, AGREE = 1e-12, 1e-8  # tolerance of references, and how far two unlike methods may end apart with it
ENSEMBLE, SINGLE, HEYOKA, DIFFRAX = "ensemble", "solve_dae, compiled, one by one", "heyoka, batches", "diffrax, vmap"
CYRK, CVODE = "CyRK, DOP853, one by one", "CVODE from C, Adams, one by one"
PROPAGATE = "heyoka, ensemble_propagate"
WAYS = {  # what the report calls each
    ENSEMBLE: "twoloop, ensemble",
    SINGLE: "twoloop, one by one",
    HEYOKA: HEYOKA,
    PROPAGATE: PROPAGATE,
    CYRK: "CyRK, one by one",
    CVODE: "CVODE, one by one",
    DIFFRAX: DIFFRAX,
}
# those in the figure, and the solver whose colour and marker each has
LOOKS = {ENSEMBLE: "auto", SINGLE: "auto, compiled", HEYOKA: "heyoka", CYRK: "CyRK, DOP853"}
LOOKS |= {CVODE: "CVODE from C, Adams", DIFFRAX: "Dopri8, diffrax"}
OWN, LEAPING = (ENSEMBLE, SINGLE), (ENSEMBLE, HEYOKA)
LINKAGES = "random four-bar linkages"
# mechanisms whose runs differ by their velocities at the start, and how long they run
STARTS = {"andrews": 0.03, "spatial_slider_crank": 2.0, "redundant_slider_crank": 2.0}
N_RUNS, N_QUICK, N_SINGLE = 1000, 16, 32  # N_SINGLE: of those that are made one by one


@dataclass(frozen=True)
class Ensemble:
    """Runs of one mechanism, each a problem, and where they end."""

    name: str
    problems: Sequence[Problem]
    t_end: float
    true: Array  # (n_runs, n_q)


def linkages_of(n: int, t_end: float = SPAN) -> Ensemble:
    """Return the first n random linkages that can be assembled; the equation in one coordinate gives their ends."""
    problems: list[Problem] = []
    for given in drawn(2 * n):
        try:
            problems.append(linkage(**given))
        except ValueError:
            continue
    known = [MinimalFourBar.from_parameters(each.parameters) for each in problems[:n]]
    true = np.array([each.states(np.array([t_end]))[0][:, 0] for each in known])
    return Ensemble(LINKAGES, problems[:n], t_end, true)


def of_starts(name: str, n: int, t_end: float) -> Ensemble:
    """Return runs of a mechanism that differ by their initial velocities; raise StudyError if two methods disagree."""
    problem = getattr(mechanisms, name)()
    random = np.random.default_rng(7)
    fastest = max(1.0, float(np.abs(problem.v0).max()))
    guesses = problem.v0 + 0.1 * fastest * random.uniform(-1.0, 1.0, (n, len(problem.q0)))
    q, v = consistent_states(problem.system, 0.0, problem.q0, guesses)
    problems = [replace(problem, q0=q[k], v0=v[k], reference=None) for k in range(n)]
    ends = [in_lanes(problems, t_end, "DOP853")(TIGHT), one_by_one(problems, t_end, "Taylor")(TIGHT)]
    apart = float(np.abs(ends[0] - ends[1]).max())
    if not apart < AGREE:
        raise StudyError(f"the ends of {problem.name} by DOP853 and by Taylor are {apart:.1e} apart")
    return Ensemble(problem.name, problems, t_end, ends[0])


def one_by_one(problems: Sequence[Problem], t_end: float, method: str = "auto") -> Solve:
    """Return a function that makes the runs by single calls of `solve_dae`."""

    def end(p: Problem, tol: float) -> Array:
        given: dict[str, Any] = {"method": method, "rtol": tol, "atol": tol, "t_eval": [t_end], "compiled": True}
        run = solve_dae(p.system, (0.0, t_end), p.q0, p.v0, **given)
        return run.q[:, -1] if run.success else np.full(len(p.q0), np.nan)

    return lambda tol: np.array([end(problem, tol) for problem in problems])


def in_lanes(problems: Sequence[Problem], t_end: float, method: str = "auto") -> Solve:
    """Return a function that makes the runs by one call of `ensemble` on one thread."""
    system, p = problems[0].system, np.array([each.system.parameters for each in problems])
    q, v = (np.array([getattr(each, name) for each in problems]) for name in ("q0", "v0"))

    def solve(tol: float) -> Array:
        given: dict[str, Any] = {"rtol": tol, "atol": tol, "t_eval": [t_end], "threads": 1, "method": method}
        return ensemble(system, (0.0, t_end), q, v, parameters=p if p.size else None, **given).q[:, :, -1]

    return solve


def ways(of: Ensemble) -> dict[str, Callable[[], Solve]]:
    """Return for each way a function that sets it up."""
    few = of.problems[:N_SINGLE]
    return {
        ENSEMBLE: lambda: in_lanes(of.problems, of.t_end),
        SINGLE: lambda: one_by_one(few, of.t_end),
        HEYOKA: lambda: by_heyoka(of.problems, of.t_end),
        PROPAGATE: lambda: by_heyoka_ensemble(of.problems, of.t_end),
        CYRK: lambda: by_cyrk(few, of.t_end),
        CVODE: lambda: by_cvode(few, of.t_end),
        DIFFRAX: lambda: by_diffrax(of.problems, of.t_end),
    }


def rows_of(of: Ensemble, names: Sequence[str], quick: bool) -> Iterator[dict[str, Any]]:
    """Return a row for each way, tolerance and repetition: CPU time of a run, errors at the end."""
    setups, solves = ways(of), {}
    head = {"group": GROUP, "case": of.name, "n_runs": len(of.problems), "t_end": of.t_end}
    for name in names:
        try:
            solve = setups[name]()
            solve(TOLERANCES[0])  # some are built in the first call
            solves[name] = solve
        except (RuntimeError, ValueError) as why:  # not installed, or not for this mechanism
            yield head | {"way": name, "message": str(why)}
    for tol in QUICK_TOLERANCES if quick else sorted((*TOLERANCES, *BETWEEN), reverse=True):
        chosen = {name: solve for name, solve in solves.items() if tol not in BETWEEN or name in LEAPING}
        for solve in chosen.values():  # which may build
            solve(tol)
        for repeat, (name, solve) in product(range(1 if quick else REPEATS), chosen.items()):
            user_call.forget()
            began = time.process_time()
            ends = solve(tol)
            spent = time.process_time() - began if user_call.seconds is None else user_call.seconds
            errors = np.abs(ends - of.true[: len(ends)]).max(axis=1)
            row = head | {"way": name, "tol": tol, "repeat": repeat, "run_s": spent / len(ends)}
            row |= {"n_failed": int(np.isnan(errors).sum())}
            if not np.isnan(errors).all():
                row |= {"error_median": float(np.nanmedian(errors)), "error_worst": float(np.nanmax(errors))}
            yield row


def make(output: Output) -> pd.DataFrame:
    """Make the rows of all groups."""
    quick, rows = output.call.quick, []
    n = N_QUICK if quick else N_RUNS
    sets = [lambda: linkages_of(n), *(lambda name=name, t=t: of_starts(name, n, t) for name, t in STARTS.items())]
    for build in sets[: 1 if quick else None] if output.call.wants(GROUP, LINKAGES, *STARTS, *WAYS) else ():
        of = build()
        # diffrax takes ten seconds to compile, and minutes for larger mechanisms
        names = [way for way in WAYS if way != DIFFRAX or (of.name == LINKAGES and not quick)]
        names = [way for way in names if output.call.wants(GROUP, of.name, way)]
        rows += list(rows_of(of, names, quick))
    varied_row(16)  # compiles what is not on disk
    for n in (200,) if quick else (10_000, 1_000_000):
        rows += [draw(n) for group, draw in ((VARIED, varied_row), (DRAWN, drawn_row)) if output.call.wants(group)]
    return pd.DataFrame(rows).assign(processor=processor())


def findings_of(rows: pd.DataFrame) -> dict[str, Any]:
    """Compare `ensemble` with the fastest other solver at equal largest errors; then the random linkages."""
    runs = _runs(rows)
    found: dict[str, Any] = {"errors": list(ERRORS), "shown": SHOWN, "n_single": N_SINGLE, "cases": []}
    for case, own_rows in runs.groupby("case", sort=False):
        medians = tables.medians(own_rows)
        own, at = medians["way"].isin(OWN), []
        for error in ERRORS:
            ours, others = tables.costs_at(medians[own], error), tables.costs_at(medians[~own], error)
            line = {"error": error, **tables.compared({k: c for k, c in ours.items() if k == ENSEMBLE}, others)}
            line["solver"] = WAYS[min(others, key=lambda name: others[name][0])] if others else None
            at.append(line | {"run_s": {WAYS[name]: cost for name, (cost, _) in (ours | others).items()}})
        n_runs, t_end = (own_rows[name].iloc[0] for name in ("n_runs", "t_end"))
        found["cases"].append({"case": case, "n_runs": int(n_runs), "t_end": float(t_end), "at": at})
        found["repeats"] = int(medians["repeats"].max())
    lines = [line | {"case": each["case"]} for each in found["cases"] for line in each["at"]]
    ratios = [line["ratio"] for line in lines if line["ratio"] is not None]
    found["ratios"] = [min(ratios), max(ratios)] if ratios else None
    verdicts = [line["verdict"] for line in lines if line["verdict"] not in ("alone", "none")]
    found["compared"], found["ahead"] = len(verdicts), verdicts.count("ahead")
    kept = ("case", "error", "ratio", "solver")
    found["not_ahead"] = [{name: line[name] for name in kept} for line in lines if (line["ratio"] or 2.0) <= 1.0]
    found["refused"] = rows.reindex(columns=["way", "case", "message"]).dropna().to_dict("records")
    many = rows[rows["group"] == VARIED].iloc[-1]
    names = ("n_runs", "n_threads", "wall", "cpu", "n_failed", "n_singly")
    found["million"] = {name: float(many[name]) for name in names} | {"t_end": SPAN}
    about = rows[rows["group"].isin((VARIED, DRAWN))]
    about = about.reindex(columns=LINKAGE_COLUMNS).astype(object)
    found["linkages"] = about.where(about.notna(), None).to_dict("records")
    return found | {"answer": _answer(found)}


LINKAGE_COLUMNS = ["group", *("n_runs", "n_assembled", "wall", "n_failed", "n_singly", "energy_median")]
LINKAGE_COLUMNS += ["energy_error", "end_error_any", "end_error_hard"]


def _answer(found: dict[str, Any]) -> str:
    many, ratios = found["million"], found["ratios"]
    n = "a million" if many["n_runs"] == 1e6 else f"{many['n_runs']:,.0f}"
    text = f"{n} four-bar linkages over {many['t_end']:.0f} s take {number(many['wall'])} s on {many['n_threads']:.0f} "
    text += f"core{'s' if many['n_threads'] > 1 else ''}"
    if ratios:
        text += f"; at equal error the fastest other solver takes {_span(ratios)} times as long"
    return f"{text[0].upper()}{text[1:]}."


def _span(values: Sequence[float]) -> str:
    return " to ".join(dict.fromkeys(map(number, values)))


def _runs(rows: pd.DataFrame) -> pd.DataFrame:
    """Return the rows of ways, of packages that are there, with columns as `tables` has them."""
    own = rows[(rows["group"] == GROUP) & rows["tol"].notna()]
    own = own.assign(error_q=own["error_worst"].where(own["n_failed"] == 0), call_s=own["run_s"], floor=AGREE / 10)
    return own.assign(solver=own["way"], status="REACHED_END").sort_values(["case", "way", "tol", "repeat"])


def figures_of(rows: pd.DataFrame, found: dict[str, Any]) -> dict[str, Figure]:
    """Draw the CPU time of a run over the largest error, a panel a mechanism."""
    runs, cases = _runs(rows), [each["case"] for each in found["cases"]]
    lines, columns = -(-len(cases) // 2), min(2, len(cases))
    size = 4.0 * columns + 1.4, 2.7 * lines + 0.9
    figure, grid = plt.subplots(lines, columns, figsize=size, layout="constrained", squeeze=False, sharey=True)
    panels = list(grid.flat)[: len(cases)]
    for axes, case in zip(panels, cases, strict=True):
        medians = tables.medians(runs[runs["case"] == case])
        for way, solver in LOOKS.items():
            line = figures.line_of(medians[medians["way"] == way])
            look = figures.style(solver) | {"label": WAYS[way]}
            axes.plot(line["error_q"].astype(float), 1e6 * line["call_s"].astype(float), **look)
        axes.set(xscale="log", yscale="log", title=case)
    for axes in grid[-1]:
        axes.set_xlabel("largest error at the end (m, rad)")
    for axes in grid[:, 0]:
        axes.set_ylabel("CPU time of a run (µs)")
    if ratios := found["ratios"]:
        text = f"At equal error the fastest other solver takes {_span(ratios)} times as long as ensemble"
        figures.message(figure, text)
    figures.label_lines(panels)
    return {"ensembles": figure}


STUDY = Study("ensembles", __doc__, make, findings_of, figures_of)

if __name__ == "__main__":
    STUDY.main()
