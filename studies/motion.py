"""Figs. 2-5 of the paper: the height of bar 3's centre by every solver, over 2 s and 100 s, with its error."""

from collections.abc import Iterator
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.interpolate import BPoly, CubicHermiteSpline

from references.gear import STARTS
from studies.index import put_in_index
from studies.motion_report import DRAWN, VISIBLE, figures, key, report, summary
from studies.report import Call, load_rows, load_series, parse, save_rows, save_series, stamp
from studies.runs import Y3, Job, Truth, collect
from studies.solvers import CATALOGUE, GEAR_ORDERS, LINE_UP, gear
from twoloop import Result
from twoloop.mechanisms import Problem, four_bar

Array = NDArray[np.floating]

SHORT = 2.0  # s, Fig. 2
STEPS = (0.02, 0.01, 0.005, 0.002, 0.001)
EXUDYN = ("GeneralizedAlpha", "HHT", "TrapezoidalIndex2")
POINTS = 20000  # stored instants, evenly chosen, at which y3 is compared with the truth
FINE = 0.002  # s, at which y3 between the steps is looked at for its highest points
GRID_SHORT, GRID_LONG, GRID_LOG = 201, 2001, 80  # points of the curves in the figures


def jobs(problem: Problem, t_end: float, quick: bool) -> Iterator[Job]:
    """Every solver at one sensible setting; then the solvers of fixed step at several steps."""
    for solver, value in LINE_UP.items():
        if not quick or CATALOGUE[solver].two_loop or solver.startswith("Exudyn"):
            yield CATALOGUE[solver].job("line-up", problem, t_end, value, 1)
    for order in (2, 5) if quick else GEAR_ORDERS:
        for start in STARTS:
            if order > 1 or start == "accurate":  # of order 1 there is nothing to start
                for step in (0.02, 0.01, 0.005) if quick else STEPS:
                    yield CATALOGUE[gear(order, start)].job("GSTIFF stand-in", problem, t_end, step, 1)
        if order <= 3 and not quick:
            yield CATALOGUE[gear(order)].job("GSTIFF stand-in", problem, t_end, 5e-4, 1)
    for solver in EXUDYN:
        for step in (0.01,) if quick else STEPS[:-1]:
            yield CATALOGUE[f"Exudyn, {solver}"].job("Exudyn", problem, t_end, step, 1)


def _measure(job: Job, result: Result, truth: Truth, t_end: float) -> dict[str, Any]:
    """Columns of this study, and the curves of the figures in the entry "series"."""
    row: dict[str, Any] = dict.fromkeys(("error_y3", "error_y3_short", "error_q_short", "energy_short"), np.nan)
    row |= {"top": np.nan, "top_late": np.nan, "growth": np.nan, "good_until": 0.0, "series": {}}
    if result.t.size < 2:
        return row
    chosen = np.unique(np.linspace(0, result.t.size - 1, POINTS).astype(int))
    chosen = np.union1d(chosen, np.flatnonzero(result.t <= SHORT)[:POINTS])
    t, q, v = result.t[chosen], result.q[:, chosen], result.v[:, chosen]
    error = np.abs(q - truth.minimal.states(t)[0])
    worst = np.maximum.accumulate(error[Y3])
    early = t <= SHORT * (1.0 + 1e-9)
    problem = job.problem
    drift = problem.energy(t, q, v) - problem.energy(0.0, problem.q0, problem.v0)
    row["error_y3"] = worst[-1] if result.success else np.nan
    row["error_y3_short"], row["error_q_short"] = worst[early][-1], error[:, early].max()
    row["energy_short"] = drift[early][np.abs(drift[early]).argmax()]
    row["good_until"] = t[-1] if worst[-1] <= VISIBLE else t[np.argmax(worst > VISIBLE)]
    if result.success:
        row["growth"] = np.log10(worst[-1] / worst[np.searchsorted(t, 0.1 * t[-1])])
        # between steps as well: does the curve pass y = 0, and does it still come back to it at the end?
        fine = np.arange(0.0, t[-1], FINE)
        y3 = BPoly.from_derivatives(t, np.array([q[Y3], v[Y3], result.a[Y3, chosen]]).T)(fine)
        row["top"], row["top_late"] = y3.max(), y3[fine >= t[-1] - 1.5 * truth.minimal.period].max()
    row["series"] = _series(t, q[Y3], v[Y3], worst, t_end, (job.solver, job.settings.get("h")) in DRAWN)
    return row


def _series(t: Array, y: Array, rate: Array, worst: Array, t_end: float, drawn: bool) -> dict[str, Array]:
    def largest_up_to(grid: Array) -> Array:
        values = worst[np.searchsorted(t, grid * (1.0 + 1e-9), side="right") - 1]
        return np.where(grid <= t[-1] * (1.0 + 1e-9), values, np.nan)

    series = {"log": largest_up_to(np.geomspace(0.1, t_end, GRID_LOG))}
    if drawn:
        curve = CubicHermiteSpline(t, y, rate, extrapolate=False)
        series["short"] = curve(np.linspace(0.0, SHORT, GRID_SHORT))
        series["short_error"] = largest_up_to(np.linspace(0.0, SHORT, GRID_SHORT))
        series["long"] = curve(np.linspace(0.0, t_end, GRID_LONG))
    return series


def run(call: Call) -> tuple[pd.DataFrame, dict[str, Array]]:
    """Make all rows, and the curves of the figures."""
    t_end = 10.0 if call.quick else 100.0
    problem = four_bar()
    truth = Truth(problem)

    def measure(job: Job, result: Result, truth: Truth) -> dict[str, Any]:
        return _measure(job, result, truth, t_end)

    rows = collect(jobs(problem, t_end, call.quick), {problem.name: truth}, t_end, measure)
    rows["t_end"], rows["kinetic"], rows["range_y3"] = t_end, truth.kinetic, truth.range_y3
    series: dict[str, Array] = {key(row, kind): x for _, row in rows.iterrows() for kind, x in row["series"].items()}
    series["log"] = np.geomspace(0.1, t_end, GRID_LOG)
    for kind, grid in (
        ("short", np.linspace(0.0, SHORT, GRID_SHORT)),
        ("long", np.linspace(0.0, t_end, GRID_LONG)),
    ):
        series[kind], series[f"truth {kind}"] = grid, truth.minimal.states(grid)[0][Y3]
    return rows.drop(columns="series"), series


def main(words: list[str] | None = None, command: str | None = None) -> None:
    """Run the study and write its report."""
    call = parse("motion", __doc__, words, command)
    path = call.out / "motion.csv"
    if call.redraw:
        rows, line = load_rows(path)
        series = load_series(path.with_name("motion_series.npz"))
    else:
        (rows, series), line = run(call), stamp(call.command)
        save_rows(path, rows, line)
        save_series(path.with_name("motion_series.npz"), series)
    report(rows, line, call)
    figures(rows, series, call)
    text = f"[Report](motion.md), [rows](motion.csv)\n\n![y3 over the long run](motion_long.png)\n\n{summary(rows)[0]}"
    put_in_index(call, "motion", __doc__, text, line)
    print(f"wrote motion.md, motion.csv and figures to {call.out}")


if __name__ == "__main__":
    main()
