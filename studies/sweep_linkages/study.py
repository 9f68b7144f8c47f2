"""Ten thousand random linkages: energy error and period of each, how a sweep scales, and a million in one call."""

import time
from functools import partial
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from studies.bench import figures
from studies.bench.cli import StudyError, processor
from studies.bench.store import Array, Output, sources
from studies.bench.study import Study
from studies.sweep_linkages import as_a_table, in_one_call
from studies.sweep_linkages.in_one_call import RANGES
from twoloop import Result, sweep
from twoloop.ensembles.in_lanes import threads_of
from twoloop.mechanisms import Problem, four_bar

SEED = 2016
N_RUNS, N_QUICK = 10_000, 20
N_SCALING, N_SCALING_QUICK = 1_000, 10
SPAN = (0.0, 6.0)
N_IN_ONE_CALL, N_IN_ONE_CALL_QUICK = (10_000, 1_000_000), (100,)
AT_REST = 1e-4  # of the largest velocity of a run: below it the linkage has turned back
SAME = 1e-6  # s: zeros of several bars closer than this are one rest
BARS = (2, 5, 8)  # angles of the three bars
WAYS = (("processes", 1), ("processes", 2), ("threads", 1), ("threads", 2))
ONE = {"processes": "process", "threads": "thread"}
SCALES = 1.8  # on two cores, as the project asks for


def linkage(L1: float, L2: float, L3: float, ground: float, theta3: float, branch: int) -> Problem:
    """A linkage of these lengths, released from rest."""
    return four_bar((L1, L2, L3), ground, theta3, branch)


def drawn(n: int) -> list[dict[str, Any]]:
    """Parameters of n linkages, always the same ones."""
    rng = np.random.default_rng(SEED)
    made = []
    for _ in range(n):
        values = {name: round(float(rng.uniform(*limits)), 4) for name, limits in RANGES.items()}
        made.append({**values, "branch": int(rng.choice((-1, 1)))})
    return made


def turning(angle: int, t: float, q: Array, v: Array) -> float:
    """Zero where one bar turns back, as all do wherever the linkage is at rest."""
    return float(v[angle])


# of all three bars: one whose acceleration at rest is nearly zero turns back three times within milliseconds, of which
# signs taken four times a step, and at least every 400th of the run, see one
TURNING = tuple(partial(turning, angle) for angle in BARS)


def rests(result: Result) -> Array:
    """Times after the start at which the linkage is at rest."""
    assert result.t_events is not None and result.v_events is not None
    least = AT_REST * np.abs(result.v).max()
    events = zip(result.t_events, result.v_events, strict=True)
    times = np.sort(np.concatenate([t[np.abs(v).max(axis=1, initial=0.0) < least] for t, v in events]))
    times = times[times > SAME]
    return times[np.diff(times, prepend=0.0) > SAME]


def measured(problem: Problem, result: Result) -> dict[str, Any]:
    """Energy error over the largest kinetic energy, and the period: the second return to rest is that to the start."""
    energy = result.energy
    kinetic = energy - problem.energy(result.t, result.q, 0.0 * result.v)
    stops = rests(result)
    half, period = stops[:2] if len(stops) > 1 else (np.nan, np.nan)
    found: dict[str, Any] = {"energy_error": _short(np.abs(energy - energy[0]).max() / kinetic.max(), 4)}
    found |= {"half": _short(half, 12), "period": _short(period, 12)}
    return found | {"n_evaluations": result.stats.n_evaluations}


def _short(value: float, digits: int) -> float:
    """With so many digits: a file of ten thousand rows should hold no others."""
    return float(f"{value:.{digits}g}")


def make(output: Output) -> pd.DataFrame:
    """The rows of all linkages, then one of each way to sweep, with its wall-clock time."""
    quick = output.call.quick
    if not quick and threads_of(None) < 2:
        raise StudyError("two processes are timed on two cores, and this one may use a single one: lift that")
    ways = WAYS[2:] if quick else WAYS  # new processes take seconds to start: not for a quick run
    options: dict[str, Any] = {"measure": measured, "t_span": SPAN, "events": TURNING}
    # what an interrupted run leaves is of no use to other sources
    kept = output.file(f"sweep_linkages.{sources()[:16]}.partial.parquet")
    given = drawn(N_QUICK if quick else N_RUNS)
    rows = sweep(linkage, given, **options, workers=2, parallel=ways[0][0], out=kept)
    rows["message"] = rows["message"].where(rows["status"] != "REACHED_END", "")
    parts = [rows.drop(columns="seconds").assign(group="linkages")]
    for parallel, workers in ways:
        chosen = drawn(N_SCALING_QUICK if quick else N_SCALING)
        began = time.perf_counter()
        timed = sweep(linkage, chosen, **options, workers=workers, parallel=parallel)
        row = {"group": "scaling", "parallel": parallel, "workers": workers, "n_runs": len(timed)}
        parts.append(pd.DataFrame([row | {"wall": time.perf_counter() - began}]))
    kept.unlink()
    parallel, workers = ways[1]  # two processes
    parts.append(pd.DataFrame(as_a_table.rows_of(linkage, given, SPAN, parallel, workers)))
    next(in_one_call.blocks(N_IN_ONE_CALL_QUICK[0], SPAN[1]))  # which loads the code
    one_call = [in_one_call.row_of(n, SPAN[1]) for n in (N_IN_ONE_CALL_QUICK if quick else N_IN_ONE_CALL)]
    parts.append(pd.DataFrame(one_call))
    return pd.concat(parts, ignore_index=True).assign(processor=processor())


def findings_of(rows: pd.DataFrame) -> dict[str, Any]:
    linkages = rows[rows["group"] == "linkages"]
    done = linkages[linkages["status"] == "REACHED_END"]
    if not len(done):
        raise StudyError("no linkage reached the end; the rows say why")
    failed = linkages[linkages["status"] != "REACHED_END"]
    causes = failed["message"].astype(str).str.startswith("ValueError: the linkage cannot be assembled")
    periodic = done[done["period"].notna()]
    worst = done.loc[done["energy_error"].idxmax()]
    scaling = rows[rows["group"] == "scaling"]
    wall = {(row["parallel"], int(row["workers"])): float(row["wall"]) for _, row in scaling.iterrows()}
    ratios = {way: wall[way, 1] / wall[way, 2] for way in ("processes", "threads") if (way, 1) in wall}
    returned = np.abs(periodic["period"] - 2.0 * periodic["half"]) / periodic["period"]
    found: dict[str, Any] = {"n": len(linkages), "n_done": len(done), "n_unassembled": int(causes.sum())}
    found |= {"others": failed[~causes]["status"].value_counts().to_dict()}
    found |= {"speeds": [_speed(row) for _, row in scaling.sort_values("wall").iterrows()], "t_end": SPAN[1]}
    found |= {"energy": _quantiles(done["energy_error"])}
    found |= {"worst": {name: float(worst[name]) for name in (*RANGES, "branch", "energy_error")}}
    found |= {"n_periodic": len(periodic), "period": _quantiles(periodic["period"]) if len(periodic) else None}
    found |= {"return": _quantiles(returned) if len(periodic) else None, "n_scaling": int(scaling["n_runs"].iloc[0])}
    found |= {"ratios": ratios, "asked": SCALES}
    found |= {"block": in_one_call.BLOCK, "n_times": in_one_call.N_TIMES}
    found |= {"n_worst": in_one_call.N_WORST, "n_any": in_one_call.N_ANY}
    found |= {"table": rows[rows["group"] == as_a_table.GROUP].to_dict("records")}
    found |= {"in_one_call": rows[rows["group"] == in_one_call.GROUP].to_dict("records")}
    return found | {"scales": ratios["processes"] >= SCALES if "processes" in ratios else None}


def _speed(row: pd.Series) -> dict[str, Any]:
    """How many runs a second a way of sweeping makes."""
    n = int(row["workers"])
    words = f"Two {row['parallel']}" if n > 1 else f"One {ONE[row['parallel']]}"
    return {"words": words, "workers": n, "per_second": int(row["n_runs"]) / row["wall"]}


def _quantiles(values: pd.Series) -> dict[str, float]:
    return {"low": values.min(), "median": values.median(), "high": values.quantile(0.95), "worst": values.max()}


def figures_of(rows: pd.DataFrame, found: dict[str, Any]) -> dict[str, Figure]:
    """Energy errors and periods of all linkages."""
    done = rows[(rows["group"] == "linkages") & (rows["status"] == "REACHED_END")]
    figure, (left, right) = plt.subplots(1, 2, figsize=(9.2, 3.4), layout="constrained")
    errors = done["energy_error"].clip(lower=1e-16)
    left.hist(errors, bins=np.geomspace(errors.min(), 1.01 * errors.max(), 40), color=figures.BLUE)
    left.set(xscale="log", xlabel="largest energy error over largest kinetic energy", ylabel="linkages")
    right.hist(done["period"].dropna(), bins=40, color=figures.BLUE)
    right.set(xlabel="period (s)", ylabel="linkages")
    return {"sweep_linkages": figure}


STUDY = Study("sweep_linkages", __doc__, make, findings_of, figures_of)
