"""Many linkages at once: ours by a sweep and by single calls, diffrax by vmap, heyoka in batches."""

import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from references.four_bar_minimal import MinimalFourBar
from references.many_at_once import by_diffrax, by_heyoka
from twoloop import Result, solve_dae, sweep
from twoloop.mechanisms import Problem

Array = NDArray[np.float64]
Solve = Callable[[float], Array]  # tolerance -> q at the end (n_runs, n_q), NaN of what failed

GROUP = "many"
TOLERANCES = (1e-6, 1e-9)
SWEEP, SINGLE, HEYOKA, DIFFRAX = (
    "twoloop.sweep, one thread",
    "solve_dae, one by one",
    "heyoka, batches",
    "diffrax, vmap",
)


def assembled(make: Callable[..., Problem], given: Sequence[dict[str, Any]], n: int) -> list[dict[str, Any]]:
    """The first n parameters of linkages that can be assembled."""
    good: list[dict[str, Any]] = []
    for one in given:
        try:
            make(**one)
        except ValueError:
            continue
        good.append(one)
    return good[:n]


def end_of(problem: Problem, result: Result) -> dict[str, float]:
    """Where a run ends, for the rows of a sweep."""
    return {f"q{i}": float(value) for i, value in enumerate(result.q[:, -1])}


def ways(make: Callable[..., Problem], given: Sequence[dict[str, Any]], t_end: float) -> dict[str, Callable[[], Solve]]:
    """What makes the call of each way."""
    problems, span = [make(**one) for one in given], (0.0, t_end)

    def swept(tol: float) -> Array:
        options: dict[str, Any] = {"t_span": span, "rtol": tol, "atol": tol, "t_eval": [t_end]}
        rows = sweep(make, given, measure=end_of, workers=1, parallel="threads", **options)
        return rows[[f"q{i}" for i in range(len(problems[0].q0))]].to_numpy(float)

    def single(tol: float) -> Array:
        made = [solve_dae(p.system, span, p.q0, p.v0, rtol=tol, atol=tol, t_eval=[t_end]) for p in problems]
        return np.array([r.q[:, -1] if r.success else np.full(len(r.q), np.nan) for r in made])

    return {
        SWEEP: lambda: swept,
        SINGLE: lambda: single,
        HEYOKA: lambda: by_heyoka(problems, t_end),
        DIFFRAX: lambda: by_diffrax(problems, t_end),
    }


def rows_of(
    make: Callable[..., Problem], given: Sequence[dict[str, Any]], t_end: float, names: Sequence[str]
) -> Iterator[dict[str, Any]]:
    """A row for each way and tolerance: CPU time of the second call by a run, of the first, errors at the end."""
    known = [MinimalFourBar.from_parameters(make(**one).parameters) for one in given]
    true = np.array([each.states(np.array([t_end]))[0][:, 0] for each in known])
    for name in names:
        try:
            solve = ways(make, given, t_end)[name]()
        except ImportError as why:
            yield {"group": GROUP, "way": name, "message": f"not installed: {why}"}
            continue
        for tol in TOLERANCES:
            seconds, ends = [], true
            for _ in range(2):
                began = time.process_time()
                ends = solve(tol)
                seconds.append(time.process_time() - began)
            errors = np.abs(ends - true).max(axis=1)
            row = {"group": GROUP, "way": name, "tol": tol, "n_runs": len(given), "first_s": seconds[0]}
            row |= {"run_s": seconds[1] / len(given), "n_failed": int(np.isnan(errors).sum())}
            good = errors[~np.isnan(errors)]
            yield row | (
                {"error_median": float(np.median(good)), "error_worst": float(good.max())} if good.size else {}
            )


def findings_of(rows: pd.DataFrame) -> dict[str, Any] | None:
    """The ways that ran, and the cheapest of all at the tightest tolerance over our sweep; None where none was run."""
    made = rows[rows["group"] == GROUP]
    names = ("way", "tol", "n_runs", "run_s", "first_s", "error_median", "error_worst", "n_failed")
    lines = [{name: row[name] for name in names} for _, row in made.iterrows() if pd.notna(row["tol"])]
    last = [line for line in lines if line["tol"] == min(TOLERANCES) and line["n_failed"] == 0]
    swept = [line for line in last if line["way"] == SWEEP]
    if not swept:
        return None
    best = min(last, key=lambda line: line["run_s"])
    found = {"lines": lines, "n": int(best["n_runs"]), "tol": best["tol"], "best": best["way"]}
    return found | {"ours": best["way"] in (SWEEP, SINGLE), "over": swept[0]["run_s"] / best["run_s"]}
