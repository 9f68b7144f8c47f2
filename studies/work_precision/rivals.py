"""Every mechanism with a verified end x every solver of ours and of other projects: which is ahead at which error.

Errors are those at the end of the reference, which is known there to more digits than by any motion between: the
largest of a coordinate, over the largest coordinate where that exceeds 1. A part of `studies.work_precision`.
"""

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure

from references.paper.four_bar_minimal import MinimalFourBar
from studies.bench import adaptive, figures, headline, tables
from studies.bench.cases.four_bar import SECOND
from studies.bench.cli import StudyError
from studies.bench.collector import REPEATS, Run, Warm, warm_up
from studies.bench.end_states import case_of, row_of
from studies.bench.render import number, power
from studies.bench.solvers import CATALOGUE, HEYOKA, OWN, OTHER_SOLVERS, TAYLOR
from studies.bench.store import KeptRows, Row
from studies.validation.study import MAKE
from twoloop import mechanisms, solve_dae
from twoloop.mechanisms import Problem, Reference
from twoloop.methods.code_for import is_small

GROUP = "every mechanism"
DECADES = tuple(10.0**-k for k in range(3, 14))
CLOSE = 1.3  # ratio of our choice, below which another session may rank two times otherwise
RANGES = {  # of errors; none: all of them on the mechanisms that cross singular positions
    "1e-3 to 1e-6": DECADES[:4],
    "1e-7 to 1e-10": DECADES[4:8],
    "1e-11 to 1e-13": DECADES[8:],
    "singular positions": (),
}
ROUNDING = "1e-11 to 1e-13"  # where ratios compare rounding errors: told in words, beside the table
TYPICAL = (1e-4, 1e-6, 1e-8, 1e-10)  # errors at which the default is compared with the cheapest rival in the median
SHOWN = DECADES[::2]  # by which the lines of the picture are chosen
HEADLINE = "four-bar"
MARKS = (  # of the cells of the heat map
    "(ratio): undecided, also where a cheaper run just misses the error; ours, others: only they reach it;\n"
    "ours?: not all rivals were run at such tolerances; –: reached by neither; from 1e-11 on, rounding errors count"
)
GEOMETRIES: dict[str, Callable[[], Problem]] = {
    HEADLINE: mechanisms.four_bar,
    "four-bar, second": lambda: mechanisms.four_bar(**SECOND),  # type: ignore[arg-type]
}
QUICK = ("four-bar", "knife edge")
QUICK_SOLVERS = (headline.DEFAULT, headline.OWN_CODE, TAYLOR, "DOP853 (twoloop)", HEYOKA, "CVODE from C, Adams")
TOLERANCES = (1e-3, 1e-5, 1e-7, 1e-9, 1e-11, 1e-14)
BELOW = (3e-15, 3e-16)  # of CVODE and IDA, whose errors may fall until there
BUILT = (1e-3, 1e-7, 1e-11, 1e-15)  # of solvers that are built for each tolerance
STEPS = (100, 300, 1000, 3000, 10_000)  # of those of fixed steps
QUICK_TOLERANCES = (1e-3, 1e-5)
TIMED = 0.1  # s; a shorter run is called several times more
TIME_LIMIT = 1.0  # s of CPU of a run
COMPILING = 30.0  # s of what is built before
TIGHT = 1e-12  # tolerance of the reference of the second geometry, well above rounding, which a third way holds ...
FAR = 1e-11  # ... to so much


@cache
def problems(quick: bool) -> dict[str, Problem]:
    """The mechanisms by name, each with a reference."""
    made = {name: replace(make(), name=name) for name, make in GEOMETRIES.items()}
    made["four-bar, second"] = replace(made["four-bar, second"], reference=_end_of_second(made["four-bar, second"]))
    for problem in (make() for make in MAKE):
        made[problem.name] = problem
    return {name: problem for name, problem in made.items() if not quick or name in QUICK}


@cache
def tags() -> dict[str, tuple[str, ...]]:
    """What kind of mechanism each of the published ones is."""
    return {problem.name: problem.tags for problem in (make() for make in MAKE)}


def _end_of_second(problem: Problem) -> Reference:
    """Its state after 10 s by Gauss14, from which DOP853 differs in the last of its digits.

    Raises StudyError if a run fails, or the equation in one coordinate, which shares nothing with them, does not agree
    to FAR.
    """
    t_end, ends = 10.0, []
    for method in ("Gauss14", "DOP853"):
        span = (0.0, t_end)
        result = solve_dae(problem.system, span, problem.q0, problem.v0, method=method, rtol=TIGHT, atol=TIGHT)
        if not result.success:
            raise StudyError(f"{method} does not reach the end of {problem.name}: {result.message}")
        ends.append((result.q[:, -1], result.v[:, -1]))
    known = MinimalFourBar.from_parameters(problem.parameters).states(np.array([t_end]))[0]
    apart = float(np.abs(ends[0][0] - known[:, 0]).max())
    if apart > FAR:
        raise StudyError(f"the end of {problem.name} is {apart:.1e} from that of the equation in one coordinate")
    differ = max(float(np.abs(ends[0][0] - ends[1][0]).max()), 1e-15)
    said = f"DOP853, which differs by {differ:.1e}; the equation in one coordinate, by {apart:.1e}"
    return Reference(t_end, *ends[0], f"Gauss14 at {TIGHT:g}", digits={"q": float(-np.log10(differ))}, verified=said)


def runs(quick: bool) -> list[Run]:
    """Every mechanism, solver and setting."""
    found = []
    for name, problem in problems(quick).items():
        case = replace(case_of(problem), name=name, time_limit=TIME_LIMIT, timed=TIMED)
        case = replace(case, step_sizes=tuple(case.t_end / n for n in STEPS))
        for solver in (CATALOGUE[each] for each in (QUICK_SOLVERS if quick else (*OWN, *OTHER_SOLVERS))):
            grid = BUILT if solver.builds_each else TOLERANCES if solver.setting == "tol" else case.steps()
            grid = (*grid, *BELOW) if grid is TOLERANCES and solver.family == "SUNDIALS" else grid
            values = QUICK_TOLERANCES if quick else grid
            found += [Run(case, solver, value, GROUP, 1 if quick else REPEATS) for value in values]
    return found


def collect(todo: Sequence[Run], kept: KeptRows) -> pd.DataFrame:
    """Rows of all runs that are of use; on the four-bars however far behind a solver is, and repeated where priced."""
    quick = all(run.repeats == 1 for run in todo)
    errors, priced = () if quick else DECADES, lambda run: run.case.name == HEADLINE
    return adaptive.collect(todo, kept, row_at_end, lambda run: run.case.name in GEOMETRIES, errors, priced, priced)


def row_at_end(run: Run, repeat: int, built: Warm) -> Row:
    """A repetition of a run, measured by the end of the reference."""
    warm_up(run, repeat, built, COMPILING)
    row = row_of(run) | {"repeat": repeat, "keeps_constraints": run.solver.keeps_constraints}
    return row | {"n_steps": row.pop("n_accepted")}


@cache
def given_on(case: str) -> str:
    """The solver that the default is on a mechanism: `auto`, with code for the mechanism if it is small."""
    problem = problems(False).get(case)
    return headline.OWN_CODE if problem is not None and is_small(problem.system) else headline.DEFAULT


def standings(rows: pd.DataFrame, errors: Sequence[float]) -> list[dict[str, dict[str, Any]]]:
    """How the default and ours stand on one mechanism at each error; `rows`: its medians."""
    return headline.of_errors(rows, errors, given_on(str(rows["case"].iloc[0])))


def at_decades(rows: pd.DataFrame) -> list[dict[str, Any]]:
    """The cheapest of ours and of others by decade on one mechanism, and how default and best of ours stand."""
    made = []
    for error, standing, ranked in zip(DECADES, standings(rows, DECADES), tables.rankings(rows, DECADES), strict=True):
        found: dict[str, Any] = {"error": error, "standing": standing}
        for which, cheapest in tables.of_both(ranked).items():
            found[which] = cheapest and {key: cheapest[key] for key in ("solver", "call_s")}
        best = standing[headline.BEST]
        if found["others"] is None and best["rival"]["solver"]:  # not asked for about so much
            found["others"] = {key: best["rival"][key] for key in ("solver", "call_s")}
        found["close"] = best["rival"]["close"]
        made.append(found | {key: best[key] for key in ("ratio", "verdict")})
    return made


def findings_of(rows: pd.DataFrame) -> dict[str, Any]:
    """Ratios of the fastest rival to the fastest of ours by mechanism and decade."""
    made: list[dict[str, Any]] = [
        {"case": name, "tags": list(tags().get(str(name), ())), "at": at_decades(own)}
        for name, own in sorted(rows.groupby("case"), key=lambda each: _place(str(each[0])))
    ]
    every = [at for each in made for at in each["at"] if at["ratio"] is not None]
    found: dict[str, Any] = {"mechanisms": made, "n": len(every)}
    standing = {each["case"]: [at["standing"] for at in each["at"]] for each in made}
    found["standings"] = headline.counted(standing.values())
    found["unbeaten"] = [case for case, own in standing.items() if headline.is_unbeaten(own, headline.GIVEN)]
    behind = Counter(at["standing"][headline.BEST]["rival"]["solver"] for at in every if at["verdict"] == "behind")
    found["behind"] = dict(behind.most_common())
    found["alone"] = [each["case"] for each in made if not any(at["others"] for at in each["at"])]
    asked = {each["case"] for each in made if any(at["verdict"] == "alone" for at in each["at"])}
    found["not_put"] = [name for name in found["alone"] if name not in asked]
    found["put"], found["fewest"], found["close"] = put(rows), fewest(rows), close(every)
    found["put"]["ours"] = int(rows.loc[rows["family"] == "two-loop", "solver"].nunique())
    found["with_code"] = [each["case"] for each in made if given_on(each["case"]) == headline.OWN_CODE]
    ranges = {name: _within(made, name, errors) for name, errors in RANGES.items()}
    found |= {"rounding": ranges.pop(ROUNDING), "ranges": list(ranges.values())}
    found["reached"] = reached(rows)
    found["typical"] = [each for error in TYPICAL if (each := _typical(made, error)) is not None]
    python = rows[rows["called_from"] == "Python"]["solver"].unique()
    ahead = [at["standing"][headline.BEST] for at in every if at["standing"][headline.BEST]["verdict"] == "ahead"]
    found["ahead_of_python"] = sum(best["rival"]["solver"] in python for best in ahead)
    found["processors"] = sorted(rows["processor"].dropna().unique()) if "processor" in rows else []
    found["drift"] = drift(rows, made)
    return found


def _place(case: str) -> int:
    """Where a mechanism stands among all; those of elsewhere are last."""
    names = list(problems(False))
    return names.index(case) if case in names else len(names)


def _within(made: Sequence[dict[str, Any]], name: str, errors: Sequence[float]) -> dict[str, Any]:
    """Standings within a range of errors on mechanisms without singular positions; on the others at all errors."""
    singular = not errors
    own = [each for each in made if ("singular" in each["tags"]) is singular]
    pairs = [[at["standing"] for at in each["at"] if singular or at["error"] in errors] for each in own]
    variants = sorted({each["case"].partition(",")[0] for each in own}) if singular else []
    told: dict[str, Any] = {"name": name, "errors": list(errors), "n_mechanisms": len(own), "of": variants}
    ahead = [any(at[headline.GIVEN]["verdict"] == "ahead" for at in each) for each in pairs]
    told["faster_on"] = [each["case"] for each, faster in zip(own, ahead, strict=True) if faster]
    return told | {"standings": headline.counted(pairs)}


def reached(rows: pd.DataFrame) -> dict[str, Any]:
    """At how many of the errors that any solver reaches at singular positions each does; `missed`: not the default."""
    crossed = rows[rows["case"].map(lambda case: "singular" in tags().get(str(case), ())) & rows["error_q"].notna()]
    least = crossed.groupby(["case", "solver"])["error_q"].min()
    errors = [(case, error) for case, own in least.groupby("case") for error in DECADES if own.min() <= error]
    count: dict[str, dict[str, int]] = {"ours": {}, "rivals": {}}
    for (own, solver), _ in crossed.groupby([crossed["family"] == "two-loop", "solver"]):
        there = sum(least.get((case, solver), np.inf) <= error for case, error in errors)
        count["ours" if own else "rivals"][str(solver)] = there
    default = [pair for pair in errors if least.get((pair[0], given_on(str(pair[0]))), np.inf) <= pair[1]]
    others = crossed[crossed["family"] != "two-loop"].groupby("case")["error_q"].min()
    missed = [pair for pair in errors if pair not in default and others.get(pair[0], np.inf) <= pair[1]]
    told = {"n": len(errors), "default": len(default), "missed": len(missed)}
    ordered = {which: dict(sorted(by.items(), key=lambda item: -item[1])) for which, by in count.items()}
    return told | {"by": ordered["ours"], "rivals": ordered["rivals"]}


def _typical(made: Sequence[dict[str, Any]], error: float) -> dict[str, Any] | None:
    """Time of the cheapest rival over that of the default at an error, over mechanisms; and the median of the latter.

    Those with singular positions, at which accelerations are not defined, do not count. None: it is not known on any.
    """
    smooth = [each for each in made if "singular" not in each["tags"]]
    at = [at["standing"][headline.GIVEN] for each in smooth for at in each["at"] if at["error"] == error]
    known = [(own["ratio"], own["call_s"]) for own in at if own["ratio"] is not None]
    if not known:
        return None
    ratios, calls = zip(*known, strict=True)
    quartiles = np.percentile(ratios, (25, 50, 75)).tolist()
    spread = {"quartiles": quartiles, "range": [min(ratios), max(ratios)]}
    return {"error": error, "n": len(known), **spread, "call_s": float(np.median(calls))}


def drift(rows: pd.DataFrame, made: Sequence[dict[str, Any]]) -> dict[str, float] | None:
    """How far the fastest rivals leave the constraints where they are faster than the default.

    |C| of the cheapest run that is accurate enough over the error compared; None: all of them keep the constraints.
    """
    known = rows.reindex(columns=[*rows.columns, *{"violation_q", "keeps_constraints"} - set(rows.columns)])
    leaves = known[known[["error_q", "violation_q"]].notna().all(axis=1) & known["keeps_constraints"].eq(False)]
    ratios = []
    for case, at in ((each["case"], at) for each in made for at in each["at"]):
        standing = at["standing"][headline.GIVEN]
        own = leaves[(leaves["case"] == case) & (leaves["solver"] == standing["rival"]["solver"])]
        own = own[own["error_q"].astype(float) <= at["error"]]
        if standing["verdict"] == "behind" and len(own):
            ratios.append(float(own.loc[own["call_s"].astype(float).idxmin(), "violation_q"]) / at["error"])
    return {"median": float(np.median(ratios)), "most": max(ratios)} if ratios else None


def close(every: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """In how many of the pairs in which the default is ahead or behind the two times are close."""
    decided = [at["standing"][headline.GIVEN] for at in every]
    ratios = [each["ratio"] for each in decided if each["verdict"] in ("ahead", "behind") and each["ratio"] is not None]
    return {"factor": CLOSE, "of": len(ratios), "n": sum(1.0 / CLOSE < ratio < CLOSE for ratio in ratios)}


def fewest(rows: pd.DataFrame) -> dict[str, Any]:
    """The mechanism on which the fewest rivals end a run: how many, of those put to any."""
    others = rows[rows["family"] != "two-loop"]
    n = int(others["solver"].nunique())
    ended = others[others["error_q"].notna()].groupby("case")["solver"].nunique()
    ended = ended.reindex(rows["case"].unique(), fill_value=0)
    return {"case": str(ended.idxmin()), "ended": int(ended.min()), "n": n}


def put(rows: pd.DataFrame) -> dict[str, Any]:
    """How many of the rivals our adapters could put to the mechanisms, and the factors by which standings are told."""
    others = rows[rows["family"] != "two-loop"]
    there = tables.put(others).groupby("case")["solver"].nunique()
    there, n = there.reindex(rows["case"].unique(), fill_value=0), int(others["solver"].nunique())
    found = {"n": n, "least": int(there.min()), "mechanisms": len(there)}
    return found | {"counts": tables.LEAST, "nearly": tables.NEARLY}


def cell(found: dict[str, Any]) -> str:
    """A ratio, in brackets where it is undecided; or who gets there."""
    if found["ratio"] is None:
        return {"alone": "ours", "unasked": "ours?", "missed": "others", "none": "–"}[found["verdict"]]
    text = number(found["ratio"])
    return f"({text})" if found["verdict"] == "undecided" else text


def picture(rows: pd.DataFrame) -> Figure:
    """The README's picture: what a call takes over error on the four-bar: default, cheapest of ours, main rivals."""
    rows = rows[rows["case"] == HEADLINE]
    figure, axes = plt.subplots(figsize=(7.6, 4.4), layout="constrained")
    priced = (headline.price(rows.assign(t_end=0.0), rows[:0], HEADLINE) or {"lines": []})["lines"]
    named, once = [at["solver"] for line in priced for at in line["at"] if at["solver"]], []
    for solver in figures.default_first([*figures.lines_of(rows, SHOWN), *named], coded=True):
        line = figures.with_gaps(rows[rows["solver"] == solver])
        look = figures.look(line[line["error_q"].notna()].iloc[0], coded=True)
        axes.plot(line["error_q"].astype(float), 1e3 * line["call_s"].astype(float), **look)
        once += [line[line["repeats"] == 1]] if "repeats" in line else []
    single = pd.concat(once).dropna(subset=["error_q"]) if once else rows[:0]
    alone: dict[str, Any] = {"linestyle": "", "marker": "+", "color": "black", "markersize": 10, "markeredgewidth": 0.8}
    alone |= {"zorder": 4}
    if len(single):
        errors, times = single["error_q"].astype(float), 1e3 * single["call_s"].astype(float)
        axes.plot(errors, times, **alone, label="timed once")
    error = "error after 10 s, over max(1, max |q|)"
    axes.set(xscale="log", yscale="log", xlabel=error, ylabel="CPU time of the call (ms)")
    figures.legend(figure, [axes], figures.LEGEND)
    figure.suptitle("Four-bar linkage, 10 s: what an accuracy costs", fontsize=10)
    return figure


def heat_map(found: dict[str, Any]) -> Figure:
    """Mechanism x decade: the time of the fastest rival over that of the default and of the best of ours."""
    names = [each["case"] for each in found["mechanisms"]]
    whose = (headline.GIVEN, headline.BEST)
    size = (5.2 * len(whose) + 1.6, 0.34 * len(names) + 1.6)
    figure, panels = plt.subplots(1, len(whose), figsize=size, sharey=True, layout="constrained")
    colours = plt.get_cmap("RdBu").with_extremes(bad="#e6e6e6")
    for axes, name in zip(panels, whose, strict=True):
        standings = [[at["standing"][name] for at in each["at"]] for each in found["mechanisms"]]
        shown = np.array([[each["ratio"] or np.nan for each in line] for line in standings], dtype=float)
        image = axes.imshow(shown, norm=LogNorm(0.04, 25.0), cmap=colours, aspect="auto")
        for (i, j), value in np.ndenumerate(shown):
            color = "white" if abs(np.log10(value)) > 0.8 else "black"  # black on the grey of those without a ratio
            axes.text(j, i, cell(standings[i][j]), ha="center", va="center", fontsize=8, color=color)
        axes.set_xticks(range(len(DECADES)), [power(error) for error in DECADES], fontsize=8)
        axes.set_yticks(range(len(names)), names)
        axes.grid(False)
        axes.set(title=name, xlabel="error at the end")
    figure.suptitle(f"Time of the fastest rival over ours (blue: ours faster)\n{MARKS}", fontsize=10)
    figure.colorbar(image, ax=panels, label="ratio", extend="both")
    return figure
