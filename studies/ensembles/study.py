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
from studies.ensembles import linkages
from twoloop import consistent_states, ensemble, mechanisms, solve_dae
from twoloop.mechanisms import Problem

Solve = Callable[[float], Array]  # tolerance -> q at the end (n_runs, n_q), NaN of what failed

GROUP = "many"  # of rows; the other groups are of `linkages`
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


def linkages_of(n: int, t_end: float = linkages.SPAN) -> Ensemble:
    """Return the first n random linkages that can be assembled; the equation in one coordinate gives their ends."""
    problems: list[Problem] = []
    for given in linkages.drawn(2 * n):
        try:
            problems.append(linkages.linkage(**given))
        except ValueError:
            continue
    known = [MinimalFourBar.from_parameters(each.parameters) for each in problems[:n]]
    true = np.array([each.states(np.array([t_end]))[0][:, 0] for each in known])
    return Ensemble(LINKAGES, problems[:n], t_end, true)


def of_starts(name: str, n: int, t_end: float) -> Ensemble:
    """Return runs of a mechanism that differ by their velocities at the start.

    Raises StudyError if two unlike methods do not agree where a run ends.
    """
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
    """Make a row for each way, tolerance and repetition: CPU time by a run, errors at the end.

    The calls after the first are repeated in turn, so that a slow minute of the machine affects all alike.
    """
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
            spent, ends = _timed(solve, tol)
            errors = np.abs(ends - of.true[: len(ends)]).max(axis=1)
            row = head | {"way": name, "tol": tol, "repeat": repeat, "run_s": spent / len(ends)}
            row |= {"n_failed": int(np.isnan(errors).sum())}
            if not np.isnan(errors).all():
                row |= {"error_median": float(np.nanmedian(errors)), "error_worst": float(np.nanmax(errors))}
            yield row


def _timed(solve: Solve, tol: float) -> tuple[float, Array]:
    """Return the CPU time of the call that a user writes, s, and the ends."""
    user_call.forget()
    began = time.process_time()
    ends = solve(tol)
    spent = time.process_time() - began
    return spent if user_call.seconds is None else user_call.seconds, ends


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
    return pd.DataFrame([*rows, *linkages.rows(output.call)]).assign(processor=processor())


def findings_of(rows: pd.DataFrame) -> dict[str, Any]:
    """Compare `ensemble` with the fastest other solver at equal error; then the random linkages.

    The error of a way is the largest of its runs, at a tolerance at which none failed.
    """
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
    found["compared"], found["ahead"] = len(ratios), sum(line["verdict"] == "ahead" for line in lines)
    kept = ("case", "error", "ratio", "solver")
    found["not_ahead"] = [{name: line[name] for name in kept} for line in lines if (line["ratio"] or 2.0) <= 1.0]
    found["refused"] = rows.reindex(columns=["way", "case", "message"]).dropna().to_dict("records")
    many = rows[rows["group"] == linkages.VARIED].iloc[-1]
    names = ("n_runs", "n_threads", "wall", "cpu", "n_failed", "n_singly")
    found["million"] = {name: float(many[name]) for name in names} | {"t_end": linkages.SPAN}
    about = rows[rows["group"].isin((linkages.VARIED, linkages.DRAWN))]
    found["linkages"] = (
        about.reindex(columns=LINKAGE_COLUMNS).astype(object).where(about.notna(), None).to_dict("records")
    )
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
