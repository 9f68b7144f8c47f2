"""Thousands of runs of one mechanism in one call: ours in lanes, heyoka in batches, diffrax by vmap, others singly."""

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
from studies.bench.names import label
from studies.bench.store import Array, Output
from studies.bench.study import Study
from studies.bench.takes import SCATTER
from studies.ensembles import lanes
from studies.sweep_linkages.study import drawn, linkage
from twoloop import consistent_states, ensemble, mechanisms, solve_dae
from twoloop.ensembles.in_lanes import threads_of
from twoloop.mechanisms import Problem

Solve = Callable[[float], Array]  # tolerance -> q at the end (n_runs, n_q), NaN of what failed

GROUP, GEOMETRY, THREADS = "many", "random linkages", "threads"
TOLERANCES, QUICK_TOLERANCES = tuple(float(f"1e-{k}") for k in range(4, 12)), (1e-6, 1e-9)
BETWEEN = (1e-3, *(float(f"3e-{k}") for k in range(4, 12)))  # of ways whose error leaps from one of these to the next
ERRORS = (1e-4, 1e-6, 1e-8)  # of the worst of the runs, at which ways are compared
USUAL = 1e-8  # tolerances of an ensemble that is given none
TIGHT, AGREE = 1e-12, 1e-8  # tolerance of references, and how far two unlike methods may end apart with it
ENSEMBLE, SINGLE, HEYOKA, DIFFRAX = "ensemble", "solve_dae, compiled, one by one", "heyoka, batches", "diffrax, vmap"
CYRK, CVODE = "CyRK, DOP853, one by one", "CVODE from C, Adams, one by one"
PROPAGATE = "heyoka, ensemble_propagate"
# whose colour and marker each has: solver, family, whether it keeps the constraints
LOOKS: dict[str, tuple[str, str, bool]] = {
    ENSEMBLE: ("Taylor, compiled", "two-loop", True),
    SINGLE: ("auto, compiled", "two-loop", True),
    HEYOKA: ("heyoka", "heyoka", False),
    PROPAGATE: ("heyoka, minimal coordinates", "heyoka", False),
    CYRK: ("CyRK, DOP853", "CyRK", False),
    CVODE: ("CVODE from C, Adams", "SUNDIALS", False),
    DIFFRAX: ("Dopri8, diffrax", "diffrax", False),
}
OWN, WAYS, LEAPING = (ENSEMBLE, SINGLE), tuple(LOOKS), (ENSEMBLE, HEYOKA)
RIVALS = {HEYOKA: "heyoka's batches", PROPAGATE: "heyoka's ensemble_propagate"}
RIVALS |= {way: f"{package} one run at a time" for way, package in ((CYRK, "CyRK"), (CVODE, "CVODE"))}
RIVALS |= {DIFFRAX: "diffrax (on linkages only)"}
LINKAGES = "random four-bar linkages"
# mechanisms whose runs differ by their velocities at the start, and how long they run
STARTS = {"andrews": 0.03, "spatial_slider_crank": 2.0, "redundant_slider_crank": 2.0}
N_RUNS, N_QUICK, N_SINGLE = 1000, 16, 32  # N_SINGLE: of those that are made one by one
SPAN = 6.0  # s, of the linkages
N_GEOMETRY, N_GEOMETRY_QUICK = (10_000, 1_000_000), (200,)
BLOCK = 100_000  # linkages at a time
SPREAD = 0.02  # of lengths, of the mechanism with geometry and starts


@dataclass(frozen=True)
class Ensemble:
    """Runs of one mechanism, each a problem, and where they end."""

    name: str
    problems: Sequence[Problem]
    t_end: float
    true: Array  # (n_runs, n_q)


def assembled(n: int) -> list[Problem]:
    """The first n random linkages that can be assembled."""
    made: list[Problem] = []
    for one in drawn(2 * n):
        try:
            made.append(linkage(**one))
        except ValueError:
            continue
    return made[:n]


def linkages(n: int, t_end: float = SPAN) -> Ensemble:
    """Linkages of random lengths, and where the equation in one coordinate has them end."""
    problems = assembled(n)
    known = [MinimalFourBar.from_parameters(each.parameters) for each in problems]
    true = np.array([each.states(np.array([t_end]))[0][:, 0] for each in known])
    return Ensemble(LINKAGES, problems, t_end, true)


def of_starts(name: str, n: int, t_end: float) -> Ensemble:
    """A mechanism with velocities of its own in each run.

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
    """Runs by single calls of the compiled default, or of another method."""

    def solve(tol: float) -> Array:
        given: dict[str, Any] = {"method": method, "rtol": tol, "atol": tol, "t_eval": [t_end], "compiled": True}
        made = [solve_dae(p.system, (0.0, t_end), p.q0, p.v0, **given) for p in problems]
        return np.array(
            [r.q[:, -1] if r.success else np.full(len(p.q0), np.nan) for p, r in zip(problems, made, strict=True)]
        )

    return solve


def in_lanes(problems: Sequence[Problem], t_end: float, method: str = "auto") -> Solve:
    """Runs by one call of `ensemble` on one thread, by the default or another method."""
    system, p = problems[0].system, np.array([each.system.parameters for each in problems])
    q, v = (np.array([getattr(each, name) for each in problems]) for name in ("q0", "v0"))

    def solve(tol: float) -> Array:
        given: dict[str, Any] = {"rtol": tol, "atol": tol, "t_eval": [t_end], "threads": 1, "method": method}
        return ensemble(system, (0.0, t_end), q, v, parameters=p if p.size else None, **given).q[:, :, -1]

    return solve


def ways(of: Ensemble) -> dict[str, Callable[[], Solve]]:
    """What makes the call of each way."""
    return {
        ENSEMBLE: lambda: in_lanes(of.problems, of.t_end),
        SINGLE: lambda: one_by_one(of.problems[:N_SINGLE], of.t_end),
        HEYOKA: lambda: by_heyoka(of.problems, of.t_end),
        PROPAGATE: lambda: by_heyoka_ensemble(of.problems, of.t_end),
        CYRK: lambda: by_cyrk(of.problems[:N_SINGLE], of.t_end),
        CVODE: lambda: by_cvode(of.problems[:N_SINGLE], of.t_end),
        DIFFRAX: lambda: by_diffrax(of.problems, of.t_end),
    }


def rows_of(of: Ensemble, names: Sequence[str], quick: bool) -> Iterator[dict[str, Any]]:
    """A row for each way, tolerance and repetition: CPU time by a run, errors at the end.

    The calls after the first are repeated in turn, so that a slow minute of the machine falls on all alike.
    """
    made, solves = ways(of), {}
    head = {"group": GROUP, "case": of.name, "n_runs": len(of.problems), "t_end": of.t_end}
    for name in names:
        try:
            solves[name] = made[name]()
        except (ImportError, ValueError) as why:
            said = "not installed" if isinstance(why, ImportError) else "not run"
            yield head | {"way": name, "message": f"{said}: {why}"}
    for tol in QUICK_TOLERANCES if quick else sorted((*TOLERANCES, *BETWEEN), reverse=True):
        asked = {name: solve for name, solve in solves.items() if tol not in BETWEEN or name in LEAPING}
        for solve in asked.values():  # which may build
            solve(tol)
        for repeat, (name, solve) in product(range(1 if quick else REPEATS), asked.items()):
            spent, ends = _timed(solve, tol)
            errors = np.abs(ends - of.true[: len(ends)]).max(axis=1)
            row = head | {"way": name, "tol": tol, "repeat": repeat}
            row |= {"run_s": spent / len(ends), "n_failed": int(np.isnan(errors).sum())}
            good = errors[~np.isnan(errors)]
            yield row | (
                {"error_median": float(np.median(good)), "error_worst": float(good.max())} if good.size else {}
            )


def _timed(solve: Solve, tol: float) -> tuple[float, Array]:
    """CPU time of the call that a user writes, s, and the ends."""
    user_call.forget()
    began = time.process_time()
    ends = solve(tol)
    spent = time.process_time() - began
    return spent if user_call.seconds is None else user_call.seconds, ends


def varied(n: int, random: np.random.Generator) -> tuple[Array, Array, Array]:
    """Lengths of n linkages about those of the four-bar, and where each starts."""
    problem = mechanisms.four_bar()
    p = problem.system.parameters * (1.0 + SPREAD * random.uniform(-1.0, 1.0, (n, 4)))
    return p, *consistent_states(problem.system, 0.0, problem.q0, problem.v0, parameters=p, keep=[8])


def with_geometry(n: int) -> dict[str, Any]:
    """Linkages with slightly different lengths: assembled and run, in blocks, on all cores; the total time."""
    system, random = mechanisms.four_bar().system, np.random.default_rng(11)
    began, failed, singly, spent = time.perf_counter(), 0, 0, time.process_time()
    for first in range(0, n, BLOCK):
        p, q, v = varied(min(BLOCK, n - first), random)
        runs = ensemble(system, (0.0, SPAN), q, v, parameters=p)
        failed, singly = failed + int((~runs.success).sum()), singly + int(runs.singly.sum())
    spent = time.process_time() - spent
    wall = time.perf_counter() - began
    row = {"group": GEOMETRY, "n_runs": n, "n_threads": threads_of(None), "wall": wall, "cpu": spent}
    return row | {"n_failed": failed, "n_singly": singly}


def on_threads(n: int, quick: bool) -> Iterator[dict[str, Any]]:
    """Wall-clock time of such linkages at the usual tolerances, without their starts, on one thread and on more."""
    system, (p, q, v) = mechanisms.four_bar().system, varied(n, np.random.default_rng(11))
    numbers = range(1, threads_of(None) + 1)
    for repeat, threads in product(
        range(-1, 1 if quick else REPEATS), numbers
    ):  # in turn; the first calls do not count
        began = time.perf_counter()
        ensemble(system, (0.0, SPAN), q, v, parameters=p, threads=threads)
        wall = time.perf_counter() - began
        if repeat >= 0:
            yield {"group": THREADS, "n_runs": n, "n_threads": threads, "repeat": repeat, "wall": wall}


def make(output: Output) -> pd.DataFrame:
    quick, rows = output.call.quick, []
    n = N_QUICK if quick else N_RUNS
    sets = [lambda: linkages(n), *(lambda name=name, t=t: of_starts(name, n, t) for name, t in STARTS.items())]
    for each in sets[: 1 if quick else None]:
        made = each()
        # diffrax takes ten seconds to compile, and minutes for larger mechanisms
        rest = (DIFFRAX,) if made.name == LINKAGES and not quick else ()
        rows += list(rows_of(made, (ENSEMBLE, SINGLE, HEYOKA, PROPAGATE, CYRK, CVODE, *rest), quick))
    rows += lanes.rows(n, quick)
    rows += list(on_threads(N_GEOMETRY_QUICK[0] if quick else N_GEOMETRY[0], quick))
    with_geometry(N_QUICK)  # compiles what is not on disk
    rows += [with_geometry(n) for n in (N_GEOMETRY_QUICK if quick else N_GEOMETRY)]
    return pd.DataFrame(rows).assign(processor=processor())


def findings_of(rows: pd.DataFrame) -> dict[str, Any]:
    """The ways that ran, and at equal error ours beside the others.

    The error of a way is the largest of its runs, at a tolerance at which none failed.
    """
    made = _runs(rows)
    found: dict[str, Any] = {"cases": []}
    for case, own_rows in made.groupby("case", sort=False):
        medians = tables.medians(own_rows)
        own, at = medians["way"].isin(OWN), []
        for error in ERRORS:
            ours, others = tables.costs_at(medians[own], error), tables.costs_at(medians[~own], error)
            line = {"error": error, **tables.compared({k: c for k, c in ours.items() if k == ENSEMBLE}, others)}
            line["rival"] = min(others, key=lambda name: others[name][0], default=None)
            if line["verdict"] == "missed" and set(others) == {CYRK}:  # whose fewer runs have a smaller largest error
                line["verdict"] = "none"
            at.append(line | {"run_s": {name: cost for name, (cost, _) in (ours | others).items()}})
        n_runs, t_end = (own_rows[name].iloc[0] for name in ("n_runs", "t_end"))
        found["cases"].append({"case": case, "n_runs": int(n_runs), "t_end": float(t_end), "at": at})
        found["repeats"] = int(medians["repeats"].max())
    lines = [line | {"case": each["case"]} for each in found["cases"] for line in each["at"]]
    every = [line["ratio"] for line in lines if line["ratio"] is not None]
    found["ratios"] = [min(every), max(every)] if every else None
    behind = [line for line in lines if line["verdict"] == "behind"]
    found["rivals_ahead"] = [{key: line[key] for key in ("case", "error", "ratio", "rival")} for line in behind]
    found["rivals"] = [said for way, said in RIVALS.items() if (made["way"] == way).any()]
    usual = made[(made["case"] == LINKAGES) & (made["way"] == ENSEMBLE) & (made["tol"] == USUAL)]
    found["usual"] = None
    if len(usual):  # the errors of runs at the default tolerances, which are not measured where geometry is varied
        errors = usual[["error_median", "error_worst"]].iloc[0].astype(float)
        found["usual"] = {"n": int(usual["n_runs"].iloc[0]), "median": errors.iloc[0], "worst": errors.iloc[1]}
    found["n_single"], found["scatter"] = N_SINGLE, SCATTER
    names = ("ahead", "behind", "undecided", "alone", "missed", "none")
    found["n_few"] = sum(line["verdict"] == "none" and CYRK in line["run_s"] for line in lines)
    found["verdicts"] = {name: sum(line["verdict"] == name for line in lines) for name in names}
    geometry = rows[rows["group"] == GEOMETRY]
    found["refused"] = rows.reindex(columns=["way", "case", "message"]).dropna().to_dict("records")
    known = ["n_runs", "n_threads", "wall", "cpu", "n_failed", "n_singly"]
    found["geometry"] = geometry.reindex(columns=known).fillna({"n_threads": 1}).to_dict("records")
    found |= {"threads": _scaling(rows), "lanes": _of_lanes(rows)}
    return found


def _scaling(rows: pd.DataFrame) -> list[dict[str, float]]:
    """Wall-clock time of a run on so many threads, s, and how many times as fast that is as one."""
    made = rows[rows["group"] == THREADS]
    if made.empty:
        return []
    times = (made["wall"] / made["n_runs"]).groupby(made["n_threads"]).median()
    n_runs = int(made["n_runs"].iloc[0])
    return [{"n": int(n), "n_runs": n_runs, "run_s": each, "gain": times.iloc[0] / each} for n, each in times.items()]


def _of_lanes(rows: pd.DataFrame) -> list[dict[str, Any]]:
    """CPU time of a run in so many lanes, s, the operations of that, a second and as a share of the core's peak."""
    made = rows[rows["group"] == lanes.GROUP].reindex(columns=["n_lanes", "run_s", "operations", "most", "message"])
    found = []
    for line in made.to_dict("records"):
        if pd.isna(line["run_s"]):
            found.append({"n": int(line["n_lanes"]), "message": line["message"]})
            continue
        rate = line["operations"] / line["run_s"]
        of_line = {"n": int(line["n_lanes"]), "run_s": line["run_s"], "operations": line["operations"]}
        found.append(of_line | {"rate": rate, "most": line["most"], "share": rate / line["most"]})
    return found


def _runs(rows: pd.DataFrame) -> pd.DataFrame:
    """The rows of ways, of packages that are there, with columns as `tables` has them."""
    made = rows[(rows["group"] == GROUP) & rows["tol"].notna()]
    made = made.assign(error_q=made["error_worst"].where(made["n_failed"] == 0), call_s=made["run_s"], floor=AGREE / 10)
    return made.assign(solver=made["way"], status="REACHED_END").sort_values(["case", "way", "tol", "repeat"])


def figures_of(rows: pd.DataFrame, found: dict[str, Any]) -> dict[str, Figure]:
    """CPU time of a run over the largest error, a panel a mechanism."""
    made, cases = _runs(rows), [each["case"] for each in found["cases"]]
    width = 3.4 * len(cases) + 1.2
    of_panels: dict[str, Any] = {"figsize": (width, 4.2), "layout": "constrained", "squeeze": False, "sharey": True}
    figure, panels = plt.subplots(1, len(cases), **of_panels)
    for axes, case in zip(panels[0], cases, strict=True):
        medians = tables.medians(made[made["case"] == case])
        for way, look in LOOKS.items():
            line = figures.with_gaps(medians[medians["way"] == way])
            if line["error_q"].notna().any():
                axes.plot(line["error_q"], 1e6 * line["call_s"], label=label(way), **figures.style(*look))
        axes.set(xscale="log", yscale="log", xlabel="largest error of q at the end (m, rad)", title=case)
        axes.grid(alpha=0.3)
    panels[0][0].set_ylabel("CPU time of a run (µs)")
    figures.legend(figure, panels[0], figures.GAPS, below=len(WAYS))
    return {"ensembles": figure}


STUDY = Study("ensembles", __doc__, make, findings_of, figures_of)

if __name__ == "__main__":
    STUDY.main()
