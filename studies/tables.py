"""From the rows of all repetitions to medians with quartiles, cost at equal error, rankings."""

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
import pandas as pd

from studies.bench import NOTHING_RUN
from studies.render import number, power

SPREAD = 0.05  # of the median: times whose quartiles are closer are shown without them


def medians(rows: pd.DataFrame) -> pd.DataFrame:
    """One row a run: the repetition of median error, with median and quartiles of the CPU time of all repetitions.

    The rows are those of `collect`, in its order: the repetitions of a run one below the other. A run of which any
    repetition failed is represented by a failed one if half of them or more failed.
    """
    firsts = np.flatnonzero(rows["repeat"].diff().fillna(-1) <= 0)
    errors, times = rows["error_q"].astype(float).fillna(np.inf).to_numpy(), rows["call_s"].to_numpy(float)
    chosen, quartiles = [], []
    for run in np.split(np.arange(len(rows)), firsts[1:]):
        chosen.append(run[np.argsort(errors[run], kind="stable")[len(run) // 2]])
        known = times[run][~np.isnan(times[run])]
        quartiles.append(np.percentile(known, (25, 50, 75)) if known.size else np.full(3, np.nan))
    found = rows.iloc[chosen].drop(columns="repeat").reset_index(drop=True)
    found[["call_q1", "call_s", "call_q3"]] = np.array(quartiles)
    return found.assign(repeats=np.diff(firsts, append=len(rows)))


def time_for(rows: pd.DataFrame, target: float, what: str = "call_s") -> float:
    """CPU time (or another cost) of one solver for an error of at most `target`; NaN where no run is so good.

    Between the two runs on either side of the target, on the log-log line through them: solvers whose settings lie
    far apart are not made to look expensive by it. NaN too where the target is below what the reference resolves.
    """
    errors, costs, floors = (rows[name].to_numpy(float) for name in ("error_q", what, "floor"))
    known = np.flatnonzero(~np.isnan(errors) & ~np.isnan(costs))
    if not known.size or (target < floors[known]).any():
        return float("nan")
    order = known[np.argsort(errors[known], kind="stable")]
    errors, costs = np.maximum(errors, floors)[order], costs[order]
    n_good = int((errors <= target).sum())
    if n_good == 0:
        return float("nan")
    best = float(costs[:n_good].min())
    if n_good < len(errors) and errors[n_good - 1] > 0.0:
        x = np.log(errors[n_good - 1 : n_good + 1])
        share = (np.log(target) - x[0]) / (x[1] - x[0])
        between = np.exp((1.0 - share) * np.log(costs[n_good - 1]) + share * np.log(costs[n_good]))
        best = min(best, float(between))
    return best


def ranking(rows: pd.DataFrame, target: float) -> pd.DataFrame:
    """The solvers of one case that reach an error, cheapest first.

    Returns
    -------
    DataFrame
        solver, family, called_from, keeps_constraints, call_s, call_q1, call_q3, n_evaluations for this error (on the
        log-log line between two runs), and violation_q, violation_v, energy of the cheapest run that is as good.
    """
    lines = []
    for solver, runs in rows.groupby("solver", sort=False):
        cpu = time_for(runs, target)
        if np.isnan(cpu):
            continue
        good = runs[runs["error_q"] <= target]
        run = good.loc[good["call_s"].astype(float).idxmin()]
        line = {"solver": solver, **{key: run[key] for key in ("family", "called_from", "keeps_constraints")}}
        line |= {
            "call_s": cpu,
            **{what: time_for(runs, target, what) for what in ("call_q1", "call_q3", "n_evaluations")},
        }
        lines.append(line | {key: run[key] for key in ("violation_q", "violation_v", "energy")})
    return pd.DataFrame(lines).sort_values("call_s", ignore_index=True) if lines else pd.DataFrame()


def best(ranked: pd.DataFrame) -> dict[str, Any] | None:
    """The first line of a ranking as a finding; None where there is none."""
    if ranked.empty:
        return None
    keys = ("solver", "call_s", "n_evaluations", "called_from", "violation_q", "energy")
    found = {key: ranked.iloc[0][key] for key in keys}
    kept, family = ranked.iloc[0][["keeps_constraints", "family"]]
    return found | {"keeps": bool(kept), "ours": bool(family == "two-loop")}


def of_both(ranked: pd.DataFrame) -> dict[str, dict[str, Any] | None]:
    """The cheapest of ours and of others in a ranking."""
    if ranked.empty:
        return {"ours": None, "others": None}
    own = ranked["family"] == "two-loop"
    return {"ours": best(ranked[own]), "others": best(ranked[~own])}


def why_not(rows: pd.DataFrame) -> str:
    """What a table shows for a solver that did not reach an error: its smallest error, or why there is none."""
    reached = rows[rows["error_q"].notna()]
    if reached.empty:
        first = rows["status"].iloc[0]
        return first.lower().replace("_", " ")
    best = float(reached["error_q"].min())
    stopped = bool((rows["status"] == "TIME_LIMIT").any())
    return f"least error {number(best)}" + (", then time limit" if stopped else "")


def work_precision(rows: pd.DataFrame, targets: Iterable[float], solvers: Sequence[str] = ()) -> list[list[str]]:
    """Lines of a table: solver, called from, CPU time with quartiles in seconds for each target.

    Instead of a dash the cell of a target that is not reached says how far the solver came.
    """
    lines = []
    for solver in solvers or list(dict.fromkeys(rows["solver"])):
        runs = rows[rows["solver"] == solver]
        if runs.empty:
            continue
        line = [solver, str(runs["called_from"].iloc[0])]
        for target in targets:
            middle, low, high = (time_for(runs, target, what) for what in ("call_s", "call_q1", "call_q3"))
            line.append(why_not(runs) if np.isnan(middle) else with_quartiles(middle, low, high))
        lines.append(line)
    return lines


def with_quartiles(middle: float, low: float, high: float) -> str:
    """Seconds, the quartiles in brackets where they are more than `SPREAD` of the median apart."""
    texts = [number(value) for value in (low, middle, high)]
    near = high - low <= SPREAD * middle or len(set(texts)) == 1
    return texts[1] if near else f"{texts[1]} ({texts[0]}–{texts[2]})"


def setting(row: pd.Series) -> str:
    """Name and value of the setting that varies."""
    return next(f"{name} {number(row[name])}" for name in ("h", "err_out", "tol") if pd.notna(row.get(name)))


def failures(rows: pd.DataFrame) -> list[list[str]]:
    """Lines of a table of runs that did not reach the end: solver, setting, status, first sentence of the message."""
    lines = []
    for _, row in rows[rows["status"] != "REACHED_END"].iterrows():
        what = [f"{key} {power(row[key])}" for key in ("err_in", "err_out", "tol", "h") if pd.notna(row.get(key))]
        setting = "all" if row["status"] in NOTHING_RUN else ", ".join(what)
        status, message = str(row["status"]).lower().replace("_", " "), str(row["message"]).split(". ")[0]
        if [row["solver"], setting, status, message] not in lines:
            lines.append([row["solver"], setting, status, message])
    return lines


def unfinished(rows: pd.DataFrame) -> list[str]:
    """ "solver (setting, setting)" of the runs that did not reach the end, for a sentence; the CSV has the messages."""
    settings: dict[str, list[str]] = {}
    for solver, setting, *_ in failures(rows):
        settings.setdefault(solver, []).append(setting)
    return [f"{solver} ({', '.join(dict.fromkeys(each))})" for solver, each in settings.items()]
