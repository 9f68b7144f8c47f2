"""Table 3 of the paper: computation time of both two-loop procedures over their tolerances, beside other solvers."""

import itertools
import statistics
import subprocess
import sys
import time
from collections.abc import Iterator
from functools import partial

import pandas as pd
from rich.console import Console
from rich.table import Table

from references import ida
from studies.index import put_in_index
from studies.report import REPORTS, Call, load_rows, parse, put_in_readme, save_rows, stamp
from studies.runs import Job, Truth, collect
from studies.solvers import CATALOGUE, IDA_C, IRK, IRK_LINE, NEWMARK, QUARTER, two_loop
from studies.table3_report import (
    EXPLICIT,
    EXUDYN,
    FAMILIES,
    PAPER_IRK,
    PAPER_NEWMARK,
    PRESETS_SHOWN,
    TOLERANCES,
    figure,
    grid,
    headline,
    ratios,
    report,
    time_of,
)
from twoloop import paper_irk, paper_newmark, solve_dae
from twoloop.mechanisms import Problem, four_bar
from twoloop.plan import Method

SECOND = {"lengths": (0.8, 1.2, 1.0), "ground": 2.0}


def cells(problem: Problem, t_end: float, grid: list[tuple[float, float]], repeats: int) -> Iterator[Job]:
    """The cells of Table 3, both procedures; Atol = Rtol = 1e-5 in the Runge-Kutta step control, as in the paper."""
    for (group, solver), (err_in, err_out) in itertools.product(FAMILIES.items(), grid):
        method: Method = paper_irk(err_in, err_out) if solver == IRK else paper_newmark(err_in, err_out)
        settings = {"err_in": err_in, "err_out": err_out}
        yield Job(group, solver, problem, partial(two_loop, method, problem, t_end, 1e-5), settings, repeats)


def others(problem: Problem, t_end: float, quick: bool) -> Iterator[Job]:
    """Both procedures along one parameter, the presets, IDA, Exudyn and SciPy."""

    def job(solver: str, value: float, repeats: int = 3) -> Job:
        return CATALOGUE[solver].job("comparison", problem, t_end, value, repeats)

    for solver in (NEWMARK, QUARTER):
        for err_out in (1e-6,) if quick else (1e-6, 1e-8, 1e-10):
            yield job(solver, err_out, 3 if err_out > 1e-9 else 1)
    for tolerance in (1e-5, 1e-8) if quick else (1e-3, 1e-5, 1e-7, 1e-9):
        yield job(IRK_LINE, tolerance)
    for name in PRESETS_SHOWN:
        for tolerance in (1e-5, 1e-8) if quick else (1e-4, 1e-6, 1e-8, 1e-10, 1e-12):
            yield job(name, tolerance)
    for tolerance in (1e-5, 1e-7) if quick else (1e-5, 1e-6, 1e-7, 1e-8, 1e-9, 1e-10, 1e-11):
        for form in ("stabilised",) if quick else ida.FORMS:
            yield job(f"IDA, {form}", tolerance)
        if not quick:  # its residual and Jacobian, like those of SciPy's solvers, take seconds to compile
            yield job(IDA_C, tolerance)
    for solver in () if quick else EXPLICIT:
        for tolerance in (1e-5, 1e-7, 1e-9, 1e-11):
            yield job(solver, tolerance)
    for solver in EXUDYN:
        for step in (1e-2, 2e-3) if quick else (1e-2, 4e-3, 2e-3, 1e-3, 4e-4, 1e-4):
            yield job(f"Exudyn, {solver}", step, 3 if step >= 1e-3 else 1)


def run(call: Call) -> pd.DataFrame:
    """Make all rows."""
    t_end = 10.0 if call.quick else 100.0
    first, second = four_bar(), four_bar(**SECOND)  # type: ignore[arg-type]
    for method in ("PaperIRK", "PaperNewmark", "SunRadau5"):
        solve_dae(first.system, (0.0, 0.01), first.q0, first.v0, method=method)  # compile before timing
    truths = {problem.name: Truth(problem) for problem in (first, second)}
    diagonal = [(e, e) for e in TOLERANCES]
    whole = [(e_in, e_out) for e_in in TOLERANCES for e_out in TOLERANCES]
    jobs = [
        *cells(first, t_end, whole, 1 if call.quick else 3),
        *others(first, t_end, call.quick),
        *cells(second, t_end, diagonal, 1),
        *(() if call.quick else others(second, t_end, call.quick)),
    ]
    rows = collect(jobs, truths, t_end)
    rows["t_end"] = t_end
    for angle in ("θ1", "θ2", "θ3"):
        rows[f"in_line_{angle}"] = rows["problem"].map({name: truth.in_line[angle] for name, truth in truths.items()})
    rows["kinetic"] = rows["problem"].map({name: truth.kinetic for name, truth in truths.items()})
    rows["start_up_s"] = statistics.median(_start_up() for _ in range(1 if call.quick else 3))
    return rows


def _start_up() -> float:
    """Wall time of a fresh process with a warm cache, from its start to the end of a first millisecond of motion."""
    code = (
        "from twoloop import solve_dae; from twoloop.mechanisms import four_bar; p = four_bar(); "
        "solve_dae(p.system, (0.0, 1e-3), p.q0, p.v0)"
    )
    began = time.perf_counter()
    subprocess.run([sys.executable, "-c", code], check=True)
    return time.perf_counter() - began


def show(rows: pd.DataFrame) -> None:
    """Print the table to the terminal."""
    first = rows[rows["problem"] == rows["problem"].iloc[0]]
    console = Console()
    for group, printed in zip(FAMILIES, (PAPER_IRK, PAPER_NEWMARK), strict=True):
        seconds = f"CPU time (s) over {rows['t_end'].iloc[0]:g} s"
        table = Table(title=f"{group}: {seconds}, the paper's over 100 s in brackets")
        for name in ("err_in \\ err_out", *(f"{e:.0e}" for e in TOLERANCES)):
            table.add_column(name, justify="right")
        for line in grid(first, group, time_of, printed):
            table.add_row(*line)
        console.print(table)
    for title, paper, ours, evaluations, _ in ratios(first):
        console.print(f"{title}: {ours} in time, {evaluations} in evaluations (paper {paper})")


def main(words: list[str] | None = None, command: str | None = None) -> None:
    """Run the study and write its report."""
    call = parse("table3", __doc__, words, command)
    path = call.out / "table3.csv"
    if call.redraw:
        rows, line = load_rows(path)
    else:
        rows, line = run(call), stamp(call.command)
        save_rows(path, rows, line)
    report(rows, line, call)
    figure(rows, call)
    text = f"[Report](table3.md), [rows](table3.csv)\n\n{headline(rows, line)}"
    put_in_index(call, "table3", __doc__, text, line)
    if call.out == REPORTS:
        put_in_readme(headline(rows, line))
    show(rows)
    print(f"wrote table3.md, table3.csv and table3.png to {call.out}")


if __name__ == "__main__":
    main()
