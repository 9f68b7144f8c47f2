"""Many linkages at once: ours by a sweep and by single calls, diffrax by vmap, heyoka in batches."""

import time
from collections.abc import Callable, Iterator, Sequence
from itertools import product
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from references.equations.many_at_once import by_diffrax, by_heyoka
from references.paper.four_bar_minimal import MinimalFourBar
from studies.bench import tables
from studies.bench.collector import REPEATS
from twoloop import Result, solve_dae, sweep
from twoloop.mechanisms import Problem

Array = NDArray[np.float64]
Solve = Callable[[float], Array]  # tolerance -> q at the end (n_runs, n_q), NaN of what failed

GROUP = "many"
TOLERANCES, QUICK_TOLERANCES = tuple(float(f"1e-{k}") for k in range(4, 12)), (1e-6, 1e-9)
ERRORS = (1e-4, 1e-6, 1e-8)  # of the worst of the runs, at which ways are compared
FLOOR = 1e-11  # to which the equation in one coordinate is known
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
    make: Callable[..., Problem], given: Sequence[dict[str, Any]], t_end: float, names: Sequence[str], quick: bool
) -> Iterator[dict[str, Any]]:
    """A row for each way, tolerance and repetition: CPU time by a run, that of the first call, errors at the end.

    The calls after the first are repeated in turn, so that a slow minute of the machine falls on all alike.
    """
    known = [MinimalFourBar.from_parameters(make(**one).parameters) for one in given]
    true = np.array([each.states(np.array([t_end]))[0][:, 0] for each in known])
    made = ways(make, given, t_end)
    solves: dict[str, Solve] = {}
    for name in names:
        try:
            solves[name] = made[name]()
        except ImportError as why:
            yield {"group": GROUP, "way": name, "message": f"not installed: {why}"}
    for tol in QUICK_TOLERANCES if quick else TOLERANCES:
        first = {name: _timed(solve, tol)[0] for name, solve in solves.items()}
        for repeat, (name, solve) in product(range(1 if quick else REPEATS), solves.items()):
            spent, ends = _timed(solve, tol)
            errors = np.abs(ends - true).max(axis=1)
            row = {"group": GROUP, "way": name, "tol": tol, "repeat": repeat, "n_runs": len(given)}
            row |= {"first_s": first[name], "run_s": spent / len(given), "n_failed": int(np.isnan(errors).sum())}
            good = errors[~np.isnan(errors)]
            yield row | (
                {"error_median": float(np.median(good)), "error_worst": float(good.max())} if good.size else {}
            )


def _timed(solve: Solve, tol: float) -> tuple[float, Array]:
    began = time.process_time()
    ends = solve(tol)
    return time.process_time() - began, ends


def findings_of(rows: pd.DataFrame) -> dict[str, Any] | None:
    """The ways that ran, and at equal error ours beside the others; None where no sweep was run.

    The error of a way is the largest of its runs, at a tolerance at which none failed.
    """
    made = rows[rows["group"] == GROUP]
    if "tol" not in made or SWEEP not in set(made["way"]):
        return None
    made = made[made["tol"].notna()]  # of packages that are there
    made = made.assign(error_q=made["error_worst"].where(made["n_failed"] == 0), call_s=made["run_s"], floor=FLOOR)
    made = made.assign(solver=made["way"], status="REACHED_END").sort_values(["way", "tol", "repeat"])
    medians = tables.medians(made)
    own, at = medians["way"].isin((SWEEP, SINGLE)), []
    for error in ERRORS:
        ours, others = tables.costs_at(medians[own], error), tables.costs_at(medians[~own], error, doubt=True)
        cheapest = [min(side, key=lambda name: side[name][0], default=None) for side in (ours, others)]
        line = {"error": error, "ours": cheapest[0], "rival": cheapest[1], **tables.compared(ours, others)}
        at.append(line | {"run_s": {name: cost for name, (cost, _) in (ours | others).items()}})
    over = [line["run_s"][SWEEP] / line["run_s"][SINGLE] for line in at if {SWEEP, SINGLE} <= line["run_s"].keys()]
    found = {"n": int(made["n_runs"].iloc[0]), "repeats": int(medians["repeats"].max()), "at": at}
    return found | {
        "ways": [SWEEP, SINGLE, HEYOKA, DIFFRAX],
        "sweep_over_single": [min(over), max(over)] if over else None,
    }
