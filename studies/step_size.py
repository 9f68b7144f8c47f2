"""Fig. 6 of the paper: step size against time, with rejected attempts and changes of the independent coordinates."""

from collections.abc import Iterator
from functools import partial
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from references.ida import solve_ida
from studies.index import put_in_index
from studies.report import Call, load_rows, load_series, parse, save_rows, save_series, stamp
from studies.runs import Y3, Job, Truth, collect
from studies.solvers import CATALOGUE, IRK, NEWMARK, PRESETS, QUARTER
from studies.step_size_report import IDA_STEPS, LONG, ZOOMED, figures, key, report, summary
from twoloop import Result
from twoloop.mechanisms import Problem, four_bar

Array = NDArray[np.floating]

PERIODS = 2.0  # that the enlarged figures show
CURVE = 1200  # steps that a figure draws one by one; of more, the shortest and the longest in each of half as many bins


def _ida(problem: Problem, t_end: float, tolerance: float, k: int) -> Result:
    """IDA with every step stored, unlike in the catalogue."""
    return solve_ida(problem.system, (0.0, t_end), problem.q0, problem.v0, "stabilised", tolerance, tolerance)


def jobs(problem: Problem, t_end: float, quick: bool) -> Iterator[Job]:
    """The paper's procedures at its settings; the other adaptive solvers at Atol = Rtol of the paper and tighter."""
    for solver in (IRK, NEWMARK, QUARTER):
        yield CATALOGUE[solver].job("paper", problem, t_end, 1e-9, 1)
    for tolerance in (1e-5,) if quick else (1e-5, 1e-8):
        for solver in PRESETS:
            yield CATALOGUE[solver].job("two-loop", problem, t_end, tolerance, 1)
        if not quick:  # seconds to compile
            run = partial(_ida, problem, t_end, tolerance)
            yield Job("others", IDA_STEPS, problem, run, {"tol": tolerance}, 1)
            for solver in ("LSODA, index 1", "DOP853, projected"):
                yield CATALOGUE[solver].job("others", problem, t_end, tolerance, 1)


def _measure(job: Job, result: Result, truth: Truth) -> dict[str, Any]:
    """Columns of this study, and the curves of the figures in the entry "series"."""
    h = result.h
    starts = np.concatenate([[0.0], np.cumsum(h)[:-1]])
    row: dict[str, Any] = {
        "h_median": np.median(h),
        "h_low": np.quantile(h, 0.05),
        "h_high": np.quantile(h, 0.95),
        "h_max": h.max(),
        "share_steps": np.mean(h > LONG),
        "share_time": h[h > LONG].sum() / h.sum(),
        "n_rejected_error": result.stats.n_rejected_error,
        "n_rejected_convergence": result.stats.n_rejected_convergence,
        "retried": np.nan,
        "retried_switch": np.nan,
    }
    zoom = starts < PERIODS * truth.minimal.period
    series = {"whole": _curve(starts, h), "zoom": _curve(starts[zoom], h[zoom])}
    if result.rejected_error is not None:
        assert result.rejected_convergence is not None and result.partitioned is not None
        before = {"error": result.rejected_error, "convergence": result.rejected_convergence}
        retried = (result.rejected_error > 0) | (result.rejected_convergence > 0)
        switched = result.partitioned > 0
        row["retried"] = retried.mean()
        row["retried_switch"] = retried[switched].mean() if switched.any() else np.nan
        if job.solver in ZOOMED:
            for name, count in {**before, "switch": result.partitioned}.items():
                marked = zoom & (count > 0)
                series[name] = np.array([starts[marked], h[marked]])
    return row | {"series": series if job.solver in ZOOMED else {}}


def _curve(t: Array, h: Array) -> Array:
    """Steps to draw, (2, n): all, or of many the shortest and the longest in each of evenly spaced bins of time."""
    if t.size <= CURVE:
        return np.array([t, h])
    edges = np.searchsorted(t, np.linspace(t[0], t[-1], CURVE // 2 + 1)[1:-1])
    parts = [np.sort(part) for part in np.split(h, edges)]
    bins = [(begin, part) for begin, part in zip(np.split(t, edges), parts, strict=True) if part.size]
    return np.array([(times[0], size) for times, part in bins for size in (part[0], part[-1])]).T


def run(call: Call) -> tuple[pd.DataFrame, dict[str, Array]]:
    """Make all rows, and the curves of the figures."""
    t_end = 10.0 if call.quick else 100.0
    problem = four_bar()
    truth = Truth(problem)
    rows = collect(jobs(problem, t_end, call.quick), {problem.name: truth}, t_end, _measure)
    rows["t_end"], rows["period"] = t_end, truth.minimal.period
    series: dict[str, Array] = {key(row, kind): x for _, row in rows.iterrows() for kind, x in row["series"].items()}
    grid = np.linspace(0.0, PERIODS * truth.minimal.period, 400)
    series["truth"] = np.array([grid, truth.minimal.states(grid)[0][Y3]])
    return rows.drop(columns="series"), series


def main(words: list[str] | None = None, command: str | None = None) -> None:
    """Run the study and write its report."""
    call = parse("step_size", __doc__, words, command)
    path = call.out / "step_size.csv"
    if call.redraw:
        rows, line = load_rows(path)
        series = load_series(path.with_name("step_size_series.npz"))
    else:
        (rows, series), line = run(call), stamp(call.command)
        save_rows(path, rows, line)
        save_series(path.with_name("step_size_series.npz"), series)
    report(rows, line, call)
    figures(rows, series, call)
    text = f"[Report](step_size.md), [rows](step_size.csv)\n\n![Step sizes](step_size.png)\n\n{summary(rows)[0]}"
    put_in_index(call, "step_size", __doc__, text, line)
    print(f"wrote step_size.md, step_size.csv and figures to {call.out}")


if __name__ == "__main__":
    main()
