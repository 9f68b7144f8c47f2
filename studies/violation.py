"""Fig. 7 of the paper: violation of position, velocity and acceleration constraints, and what keeping them costs."""

import itertools
from collections.abc import Iterator
from functools import partial
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from studies.index import put_in_index
from studies.report import Call, load_rows, load_series, parse, save_rows, save_series, stamp
from studies.runs import CHECKED, Job, Truth, collect
from studies.solvers import ALPHAS, CATALOGUE, IRK, LINE_UP, PAPER_TOL, baumgarte, two_loop
from studies.violation_report import LEVELS, LEVELS_DRAWN, LOOPS, figures, key, report, summary
from twoloop import Result, paper_irk
from twoloop.mechanisms import Problem, four_bar

Array = NDArray[np.floating]

WINDOWS = 10  # equal parts of the run, to whose largest violations the growth is fitted
CURVE = 50  # equal parts of the run, whose largest violations are drawn
FLOOR = 1e-17  # what counts as a violation of zero where a logarithm is taken


def jobs(problem: Problem, t_end: float, quick: bool) -> Iterator[Job]:
    """Every solver at one setting; PaperIRK by the tolerances of its loops; solvers along their tolerances."""
    for solver, value in LINE_UP.items():
        if not quick or CATALOGUE[solver].two_loop or solver.startswith(("Exudyn", "GSTIFF", "DOP853")):
            yield CATALOGUE[solver].job("line-up", problem, t_end, value, 1)
    for err_in, err_out in itertools.product(LOOPS, (LOOPS[0], LOOPS[-1]) if quick else LOOPS):
        if err_in in (LOOPS[0], LOOPS[-1]):
            run = partial(two_loop, paper_irk(err_in, err_out), problem, t_end, PAPER_TOL)
            yield Job("loops", IRK, problem, run, {"err_in": err_in, "err_out": err_out}, 1)
    solvers = ["DOP853, index 1", "DOP853, projected", baumgarte("DOP853", 10.0), "SunRadau5", "Gauss12"]
    once = []
    if not quick:
        solvers += ["RK45, index 1", "RK45, projected", "LSODA, index 1", "IDA, index1", "IDA, stabilised"]
        once = [baumgarte("DOP853", 1.0), baumgarte("DOP853", 100.0), *(baumgarte("LSODA", alpha) for alpha in ALPHAS)]
    for solver in (*solvers, *once):
        for tolerance in (1e-5, 1e-7) if quick else (1e-4, 1e-5, 1e-6, 1e-7, 1e-8, 1e-9, 1e-10):
            if not solver.startswith("RK45") or tolerance >= 1e-8:  # of order 5, it takes seconds beyond
                repeats = 1 if quick or solver in once else 3
                yield CATALOGUE[solver].job("tolerances", problem, t_end, tolerance, repeats)


def _levels(problem: Problem, result: Result) -> tuple[Array, dict[str, Array]]:
    """Times, and the constraints' residuals (n_t, n_c) there in position, velocity and acceleration."""
    chosen = np.unique(np.linspace(0, result.t.size - 1, CHECKED).astype(int))
    system = problem.system
    points = [(result.t[k], result.q[:, k], result.v[:, k], result.a[:, k]) for k in chosen]
    return result.t[chosen], {
        "q": np.array([system.constraint(t, q) for t, q, _, _ in points]),
        "v": np.array([system.velocity_constraint(t, q, v) for t, q, v, _ in points]),
        "a": np.array([system.jacobian(t, q) @ a - system.gamma(t, q, v) for t, q, v, a in points]),
    }


def _windows(t: Array, size: Array, n: int) -> Array:
    """Largest value in each of n equal parts of the run; NaN where nothing is stored."""
    places = np.minimum((t / t[-1] * n).astype(int), n - 1)
    return np.array([size[places == k].max(initial=FLOOR) if (places == k).any() else np.nan for k in range(n)])


def growth(t: Array, size: Array) -> float:
    """Exponent p of size ~ t^p: least squares through the largest values of equal parts of the run."""
    values = _windows(t, size, WINDOWS)
    ends = np.arange(1, WINDOWS + 1)  # where what grows is largest
    known = ~np.isnan(values)
    return float(np.polyfit(np.log10(ends[known]), np.log10(values[known]), 1)[0])


def _measure(job: Job, result: Result, truth: Truth) -> dict[str, Any]:
    """Columns of this study, and the curves of the figures in the entry "series"."""
    row: dict[str, Any] = {"violation_a": np.nan, "violation_35": np.nan, "violation_36": np.nan, "series": {}}
    row |= {f"{what}_{level}": np.nan for what in ("growth", "early", "late") for level in LEVELS}
    if result.t.size < WINDOWS or job.group == "tolerances":  # of those the common columns are enough
        return row
    t, residuals = _levels(job.problem, result)
    for level, residual in residuals.items():
        size = np.abs(residual).max(axis=1)
        row[f"growth_{level}"] = growth(t, size)
        parts = _windows(t, size, WINDOWS)
        row[f"early_{level}"], row[f"late_{level}"] = parts[0], parts[-1]
        if job.group == "line-up" and job.solver in LEVELS_DRAWN:
            row["series"][level] = _windows(t, size, CURVE)
    row["violation_a"] = np.abs(residuals["a"]).max()
    row["violation_35"], row["violation_36"] = np.abs(residuals["q"][:, 6:]).max(axis=0)
    if job.group == "loops" and job.settings["err_in"] == job.settings["err_out"]:
        row["series"]["closure"] = np.vstack([t, residuals["q"][:, 6:].T])
    return row


def run(call: Call) -> tuple[pd.DataFrame, dict[str, Array]]:
    """Make all rows, and the curves of the figures."""
    t_end = 10.0 if call.quick else 100.0
    problem = four_bar()
    rows = collect(jobs(problem, t_end, call.quick), {problem.name: Truth(problem)}, t_end, _measure)
    rows["t_end"] = t_end
    rows["own_a"] = [CATALOGUE[solver].own_a for solver in rows["solver"]]
    series: dict[str, Array] = {key(row, kind): x for _, row in rows.iterrows() for kind, x in row["series"].items()}
    series["t"] = (np.arange(CURVE) + 0.5) * t_end / CURVE
    return rows.drop(columns="series"), series


def main(words: list[str] | None = None, command: str | None = None) -> None:
    """Run the study and write its report."""
    call = parse("violation", __doc__, words, command)
    path = call.out / "violation.csv"
    if call.redraw:
        rows, line = load_rows(path)
        series = load_series(path.with_name("violation_series.npz"))
    else:
        (rows, series), line = run(call), stamp(call.command)
        save_rows(path, rows, line)
        save_series(path.with_name("violation_series.npz"), series)
    report(rows, line, call)
    figures(rows, series, call)
    text = f"[Report](violation.md), [rows](violation.csv)\n\n![Violations](violation.png)\n\n{summary(rows)[0]}"
    put_in_index(call, "violation", __doc__, text, line)
    print(f"wrote violation.md, violation.csv and figures to {call.out}")


if __name__ == "__main__":
    main()
