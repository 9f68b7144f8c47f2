"""From the rows of all repetitions to medians with quartiles, cost at equal error, rankings."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from studies.bench.collector import NOTHING_RUN
from studies.bench.names import label
from studies.bench.render import number, power
from studies.bench.store import Array
from twoloop.rows import leaderboard
from twoloop.rows.leaderboard import DECADE, FEWEST, INTERVAL, LEAST, Runs

SETTINGS = ("err_out", "h", "tol")  # a procedure along err_out has a tol, too, which does not vary


def setting_of(rows: pd.DataFrame) -> Array:
    """Value of the setting that varies, of each row; NaN where there is none."""
    found = np.full(len(rows), np.nan)
    for name in SETTINGS:
        if name in rows:
            found = np.where(np.isnan(found), rows[name].to_numpy(float), found)
    return found


def _columns(rows: pd.DataFrame, *more: str) -> dict[str, NDArray[Any]]:
    """Columns that are looked at, and more numbers, as arrays."""
    found: dict[str, NDArray[Any]] = {name: rows[name].to_numpy(float) for name in ("error_q", "floor", *more)}
    found |= {name: rows[name].to_numpy() for name in ("used", "times") if name in rows}
    return found | {"setting": setting_of(rows), "astray": astray(rows).to_numpy()}


def by_solver(rows: pd.DataFrame, *costs: str) -> dict[str, Runs]:
    """Those of each solver, in order of appearance; runs without the first of the costs are left out."""
    columns = _columns(rows, *costs)
    codes, names = pd.factorize(rows["solver"])
    return {str(name): Runs(columns, np.flatnonzero(codes == k), costs[0], str(name)) for k, name in enumerate(names)}


def used(run: pd.Series) -> str:
    """The method that a solver took which chooses; a file has nothing where there is none."""
    return run["used"] if isinstance(run.get("used"), str) else ""


def astray(runs: pd.DataFrame) -> pd.Series:
    """Which runs have another motion than the reference; none where that was not looked at."""
    return runs["astray"].isin((True, "True")) if "astray" in runs else pd.Series(False, runs.index)


TIGHTEST = 1e-13  # tolerance of which tighter ones are of no use
COSTS = ("call_s", "n_evaluations")
RANKED = (*("family", "called_from", "keeps_constraints", *COSTS), *("violation_q", "violation_v", "energy"))
NEARLY = 1.25  # runs whose error is above one by a smaller factor nearly get there
UNLIKE = 3.0  # times the median time of the repetitions of a run: such a one was not the run alone


def medians(rows: pd.DataFrame) -> pd.DataFrame:
    """Return one row for each run: the repetition of median error, with the median of the times of the calls.

    The rows are those of `collect`, with the repetitions of a run one after another. If at least half of the
    repetitions failed, a failed one represents the run. `times`: times of all repetitions that are `alike`.
    """
    firsts = np.flatnonzero(rows["repeat"].diff().fillna(-1) <= 0)
    errors, times = rows["error_q"].astype(float).fillna(np.inf).to_numpy(), rows["call_s"].to_numpy(float)
    chosen, kept = [], []
    for run in np.split(np.arange(len(rows)), firsts[1:]):
        chosen.append(run[np.argsort(errors[run], kind="stable")[len(run) // 2]])
        kept.append(tuple(times[run[alike(times[run], errors[run])]]))
    found = rows.iloc[chosen].drop(columns="repeat").reset_index(drop=True)
    middle = [np.percentile(known, 50) if known else np.nan for known in kept]
    repeats = np.diff(firsts, append=len(rows))
    return found.assign(call_s=middle, repeats=repeats, times=pd.Series(kept, dtype=object))


def alike(times: Array, errors: Array) -> NDArray[np.bool_]:
    """Return a mask of the repetitions whose times are comparable; all that have a time, if fewer than three remain.

    Not comparable: failures where most repetitions ended (by the time limit); an error that is a decade from the median
    (another path of steps); UNLIKE times the median time (code was generated, or the machine was busy).
    """
    known = ~np.isnan(times)
    if known.sum() < FEWEST:
        return known
    ended, middle = np.isfinite(errors), np.median(np.sort(errors)[: max(1, int(np.isfinite(errors).sum()))])
    same = known & (times <= UNLIKE * np.median(times[known]))
    if 2 * ended.sum() > len(errors):
        same &= ended & (errors <= DECADE * middle) & (middle <= DECADE * errors)
    return same if same.sum() >= FEWEST else known


def where(rows: pd.DataFrame, **equal: Any) -> pd.DataFrame:
    """The rows in which each column named has that value, or one of a tuple of values."""
    for column, value in equal.items():
        rows = rows[rows[column].isin(value if isinstance(value, tuple) else (value,))]
    return rows


def time_for(rows: pd.DataFrame, target: float, what: str = "call_s") -> float:
    """Return the time of a call (or another cost) of one solver for an error of at most `target`.

    Between two runs less than a decade apart it is interpolated on a log-log line, so that solvers with few settings do
    not seem expensive. NaN if no run is accurate enough, if no run had such an error, or if the reference is less
    accurate.
    """
    solver = str(rows["solver"].iloc[0]) if len(rows) and "solver" in rows else ""
    runs = Runs(_columns(rows, what), np.arange(len(rows)), what, solver)
    place = leaderboard.locate_target(runs, target)
    return float("nan") if place is None else float(leaderboard.interpolate_cost(runs.column(what), place))


Costs = dict[str, tuple[float, Array]]  # by solver the time at an error, and draws of it (RESAMPLES,)


def costs_at(rows: pd.DataFrame | Mapping[str, Runs], target: float, doubt: bool = False) -> Costs:
    """Return the cost of the cheapest run that reaches an error, for each solver of one case.

    `rows`: a table, or rows grouped by `by_solver`. `doubt`: for solvers without a run near the error, the next looser
    run counts as accurate enough, so that no solver wins because a run is missing. A run out of phase does not.
    """
    found = {}
    for solver, runs in (by_solver(rows, "call_s") if isinstance(rows, pd.DataFrame) else rows).items():
        place = leaderboard.locate_target(runs, target, include_unaimed=True)
        if place is None:
            continue
        if doubt and leaderboard.locate_target(runs, target) is None:
            n_good = place[0]
            place = n_good + (n_good < len(runs.errors) and not runs.column("astray")[n_good]), None
        costs, drawn = runs.column("call_s"), runs.resamples
        known = not np.isnan(drawn[np.argmin(costs[: place[0]])]).any()  # of the cheapest
        found[solver] = (
            float(leaderboard.interpolate_cost(costs, place)),
            leaderboard.interpolate_cost(drawn if known else np.nan * drawn, place),
        )
    return found


def nearly_there(rows: pd.DataFrame, target: float) -> pd.DataFrame:
    """The runs of one case that miss an error by a factor of less than NEARLY, on the motion of the reference."""
    errors = np.maximum(rows["error_q"].to_numpy(float), rows["floor"].to_numpy(float))
    near = (errors > target) & (errors <= NEARLY * target)
    return rows[near & ~astray(rows).to_numpy() & ~np.isnan(rows["call_s"].to_numpy(float))] if near.any() else rows[:0]


def near_misses(rows: pd.DataFrame, target: float) -> Costs:
    """What the runs take that miss an error by little, each run by itself."""
    return each_run(nearly_there(rows, target))


def each_run(runs: pd.DataFrame) -> Costs:
    """What runs take, each by itself: no solver's name, but that of the row."""
    times = runs["times"] if "times" in runs else len(runs) * [()]
    costs = zip(runs["call_s"].astype(float), leaderboard.bootstrap_medians(times), strict=True)
    return {f"row {k}": cost for k, cost in zip(runs.index, costs, strict=True)}


def compared(own: Costs, others: Costs) -> dict[str, Any]:
    """Time of the best of others over that of the best of `own` at one error on one case, and what it comes to.

    Returns ratio; interval, its range over the repetitions drawn again, which is the scatter of these few and no
    confidence interval, or None; verdict: "ahead" where all of the range is above LEAST, "behind" where it is below 1 /
    LEAST, else "undecided"; "alone" where no other gets there, "missed" where own does not and another does, "none"
    where neither does.
    """
    if not own or not others:
        verdict = "alone" if own else "missed" if others else "none"
        return {"ratio": None, "interval": None, "verdict": verdict}
    least, draws = list[float](), list[Array]()
    for side in (own, others):
        best, drawn = min(side.values(), key=lambda each: each[0])
        # NaN if the cheapest was run too few times to be drawn; others that were are far behind, and say nothing
        draws.append(np.fmin.reduce([each for _, each in side.values()]) if np.isfinite(drawn).all() else drawn)
        least.append(best)
    low, high = (float(x) for x in np.percentile(draws[1] / draws[0], INTERVAL))
    verdict = "ahead" if low > LEAST else "behind" if high < 1.0 / LEAST else "undecided"
    return {"ratio": least[1] / least[0], "interval": None if np.isnan(low) else [low, high], "verdict": verdict}


def ranking(rows: pd.DataFrame, target: float) -> pd.DataFrame:
    """Rank the solvers of one case that reach an error, cheapest first; others only if they have runs near it.

    Returns solver, family, called_from, keeps_constraints, call_s, n_evaluations for this error (on the log-log line
    between two runs), and violation_q, violation_v, energy, setting of the cheapest run near it.
    """
    told = {name: rows[name].to_numpy() for name in (*RANKED, *SETTINGS) if name in rows and name not in COSTS}
    lines = []
    for solver, runs in by_solver(rows, *COSTS).items():
        ours = len(runs.rows) > 0 and told["family"][runs.rows[0]] == "two-loop"
        if (place := leaderboard.locate_target(runs, target, include_unaimed=ours)) is not None:
            run = {name: column[leaderboard.cheapest_run(runs, place)] for name, column in told.items()}
            line = run | {what: float(leaderboard.interpolate_cost(runs.column(what), place)) for what in COSTS}
            lines.append(line | {"solver": solver, "setting": setting(run)})
    return pd.DataFrame(lines, columns=["solver", *RANKED, "setting"]).sort_values("call_s", ignore_index=True)


def best(ranked: pd.DataFrame) -> dict[str, Any] | None:
    """The first line of a ranking as a finding; None where there is none."""
    if ranked.empty:
        return None
    first = ranked.iloc[0]
    found = {key: first[key] for key in ("solver", "call_s", "called_from", "setting")}
    return found | {"keeps": bool(first["keeps_constraints"]), "ours": bool(first["family"] == "two-loop")}


def of_both(ranked: pd.DataFrame) -> dict[str, dict[str, Any] | None]:
    """The cheapest of ours and of others in a ranking."""
    own = ranked["family"] == "two-loop"
    return {"ours": best(ranked[own]), "others": best(ranked[~own])}


def work_precision(
    rows: pd.DataFrame, targets: Iterable[float], solvers: Sequence[str] = (), coded: bool | None = None
) -> list[list[str]]:
    """Return lines of a table: solver, called from, CPU time for each target, s; `coded`: see `names.label`."""
    lines = []
    for solver in solvers or list(dict.fromkeys(rows["solver"])):
        if len(runs := rows[rows["solver"] == solver]):
            times = [number(time_for(runs, target)) for target in targets]
            lines.append([label(solver, coded), str(runs["called_from"].iloc[0]), *times])
    return lines


def as_good(runs: pd.DataFrame, target: float) -> float:
    """Return the time of the cheapest run of a solver whose error is at most the target; NaN: there is none."""
    return float(runs[runs["error_q"].astype(float) <= target]["call_s"].astype(float).min())


def setting(row: Mapping[str, Any]) -> str:
    """Name and value of the setting that varies."""
    return next(f"{name} {number(row[name])}" for name in ("h", "err_out", "tol") if pd.notna(row.get(name)))


def failures(rows: pd.DataFrame, coded: bool | None = None) -> list[list[str]]:
    """Return lines of a table of failed runs: solver, setting, status, first sentence of the message."""
    lines = []
    for _, row in rows[rows["status"] != "REACHED_END"].iterrows():
        what = [f"{key} {power(row[key])}" for key in ("err_in", "err_out", "tol", "h") if pd.notna(row.get(key))]
        setting = "all" if row["status"] in NOTHING_RUN else ", ".join(what)
        status, message = str(row["status"]).lower().replace("_", " "), str(row["message"]).split(". ")[0]
        if (line := [label(str(row["solver"]), coded), setting, status, message]) not in lines:
            lines.append(line)
    return lines
