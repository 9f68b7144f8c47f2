"""Table 3 of the paper: computation time of both two-loop procedures over their tolerances, beside other solvers."""

import statistics
import subprocess
import sys
import time
from collections.abc import Sequence
from functools import partial

import numpy as np
import pandas as pd
from rich.console import Console
from rich.table import Table

from studies import cli, figures, tables
from studies.bench import Case, Run, Solver, collect
from studies.cases import four_bar
from studies.cli import Call, StudyError
from studies.index import write_index
from studies.metrics import ASTRAY, LOST
from studies.render import number, power, render, table
from studies.solvers import (
    CATALOGUE,
    IDA_C,
    IDA_FORMS,
    IRK,
    IRK_LINE,
    NEWMARK,
    OWN_EXPLICIT,
    QUARTER,
    paper_irk_at,
    paper_newmark_at,
)
from studies.store import Output
from studies.table3_causes import FAMILIES, TOLERANCES, causes, machine, printed
from twoloop import Result, RungeKutta, solve_dae
from twoloop.tableaux import gauss

SECOND = four_bar.SECOND
TARGETS = (1e-1, 1e-2, 1e-4, 1e-6, 1e-8)
PRESETS = ("SunRadau5", "Gauss6", "Gauss12", "BDF", OWN_EXPLICIT)
EXUDYN = ("Exudyn, GeneralizedAlpha", "Exudyn, TrapezoidalIndex2")
SCIPY = ("LSODA, index 1", "DOP853, index 1", "DOP853, projected")
DRAWN = (NEWMARK, IRK_LINE, "SunRadau5", "Gauss12", OWN_EXPLICIT, IDA_C, "DOP853, projected")
PAPER_END = 100.0  # s, of the paper's runs
STEP = 0.01  # s, of the runs that tell what a partition costs


def _fixed(partition: str, case: Case, step: float, repeat: int) -> Result:
    problem, method = case.problem, RungeKutta(gauss(1), partition=partition)  # type: ignore[arg-type]
    return solve_dae(problem.system, (0.0, case.t_end), problem.q0, problem.v0, method=method, step_size=step)


def runs(first: Case, second: Case, quick: bool) -> list[Run]:
    """The cells of the table on both geometries, what a partition costs, and the other solvers."""
    made = []
    for case, once in ((first, quick), (second, True)):
        for group, at in (("Table 3: IRK", paper_irk_at), ("Table 3: Newmark", paper_newmark_at)):
            cells = [(e_in, e_out) for e_in in TOLERANCES for e_out in TOLERANCES if case is first or e_in == e_out]
            made += [Run(case, at(e_in), e_out, group, 1 if once else 3) for e_in, e_out in cells]
    for partition in ("lasting", "symmetric"):
        solver = Solver(f"fixed step, {partition}", "two-loop", "compiled", True, "h", partial(_fixed, partition))
        made.append(Run(first, solver, STEP, "partition", 3))
    names = [NEWMARK, QUARTER, IRK_LINE, *PRESETS, IDA_C, "IDA, stabilised", *SCIPY, *EXUDYN]
    names += [] if quick else [f"IDA, {form}" for form in IDA_FORMS if form != "stabilised"]
    for case in (first,) if quick else (first, second):
        for name in names:
            solver = CATALOGUE[name]
            values = solver.grid(case) if name not in (NEWMARK, QUARTER) else (1e-6, 1e-8, 1e-10)
            for value in values[1:3] if quick else values:
                long = value < 1e-3 if solver.setting == "h" else value < 1e-9 and solver.setting == "err_out"
                made.append(Run(case, solver, value, "comparison", 1 if quick or long else 3))
    return made


def _extra(run: Run, result: Result) -> dict[str, float]:
    """Height of bar 3's centre, by which the paper judges energy."""
    return {"y3_max": float(result.q[four_bar.Y3].max()) if result.t.size else float("nan")}


def _start_up() -> float:
    """Wall time of a fresh process with a warm cache, from its start to the end of a first millisecond of motion."""
    code = (
        "from twoloop import solve_dae; from twoloop.mechanisms import four_bar; p = four_bar(); "
        "solve_dae(p.system, (0.0, 1e-3), p.q0, p.v0)"
    )
    began = time.perf_counter()
    subprocess.run([sys.executable, "-c", code], check=True)
    return time.perf_counter() - began


def make(output: Output, quick: bool) -> pd.DataFrame:
    """Make all rows."""
    first, second = four_bar.cases(quick)
    with output.kept() as kept:
        rows = collect(runs(first, second, quick), kept, _extra)
    kinetic = {case.problem.name: case.scale.kinetic for case in (first, second)}
    rows["kinetic"] = rows["problem"].map(kinetic)
    for angle in ("θ1", "θ2", "θ3"):
        count = {case.problem.name: four_bar.in_line(case.problem)[angle] for case in (first, second)}
        rows[f"in_line_{angle}"] = rows["problem"].map(count)
    rows["start_up_s"] = statistics.median(_start_up() for _ in range(1 if quick else 3))
    return rows


def mark(row: pd.Series) -> str:
    """★ for a lost solution, † for one out of phase."""
    return " ★" if row["lost"] else " †" if row["astray"] else ""


def grid(rows: pd.DataFrame, group: str, show) -> list[list[str]]:  # type: ignore[no-untyped-def]
    """Lines of a table, err_in by err_out, of what `show(cell, printed time)` makes of a cell."""
    paper = printed(group)
    lines = []
    for i, e_in in enumerate(TOLERANCES):
        line = [power(e_in)]
        for j, e_out in enumerate(TOLERANCES):
            cell = machine(rows, group, e_in, e_out)
            line.append("not run" if cell is None else show(cell, paper[i][j]))
        lines.append(line)
    return lines


def _time(cell: pd.Series, paper: float | None) -> str:
    spread = tables.with_quartiles(cell["cpu_s"], cell["cpu_q1"], cell["cpu_q3"])
    if cell["t_end"] != PAPER_END:  # a quick run: nothing printed is for so short a motion
        return spread + mark(cell)
    times = "" if paper is None else f" ×{number(paper / cell['cpu_s'])}"
    return f"{spread}{mark(cell)} / {'★' if paper is None else f'{paper:.2f}'}{times}"


def counts(rows: pd.DataFrame) -> list[list[str]]:
    """Evaluations, steps and error of both procedures with err_in = 1e-9, on which they hardly depend."""
    lines = []
    for group, name in (("Table 3: IRK", "Runge–Kutta"), ("Table 3: Newmark", "Newmark")):
        line = [name]
        for err_out in TOLERANCES:
            cell = machine(rows, group, TOLERANCES[-1], err_out)
            keys = ("n_evaluations", "n_steps", "error_q")
            line.append("not run" if cell is None else " / ".join(number(float(cell[key])) for key in keys))
        lines.append(line)
    return lines


def findings_of(rows: pd.DataFrame) -> dict[str, object]:
    """What the report says, from the medians."""
    first = rows[rows["problem"] == rows["problem"].iloc[0]]
    irk, newmark = (machine(first, group, 1e-9, 1e-9) for group in FAMILIES)
    coarse = machine(first, "Table 3: IRK", 1e-9, 1e-3)
    if irk is None or newmark is None or coarse is None:
        raise StudyError("the rows lack cells of Table 3; make them again by python -m studies.table3")
    found: dict[str, object] = {
        "t_end": float(first["t_end"].iloc[0]),
        "irk_s": irk["cpu_s"],
        "newmark_s": newmark["cpu_s"],
        "ratio_s": newmark["cpu_s"] / irk["cpu_s"],
        "ratio_evaluations": newmark["n_evaluations"] / irk["n_evaluations"],
        "paper_ratio": 50.93 / 3.60,
        "irk_error": irk["error_q"],
        "newmark_error": newmark["error_q"],
        "coarse_steps": coarse["n_steps"],
        "fine_steps": irk["n_steps"],
        "coarse_more_steps": bool(coarse["n_steps"] > 1.5 * irk["n_steps"]),
        "coarse_astray": bool(coarse["astray"]),
        "coarse_error": coarse["error_q"],
        "lost_limit": LOST,
        "astray_limit": ASTRAY,
        "start_up_s": float(first["start_up_s"].iloc[0]),
        "floor": float(first["floor"].iloc[0]),
    }
    for name, group in (("irk", "Table 3: IRK"), ("newmark", "Table 3: Newmark")):
        cells = first[first["group"] == group]
        for what in ("lost", "astray"):
            bad = cells[cells[what].astype(bool)]["err_out"].unique()
            found[f"{name}_{what}"] = [power(e) for e in sorted(bad, reverse=True)]
    found["equal_error"] = equal_error(first)
    ratios = [line[key] for line in found["equal_error"] for key in ("half", "quarter") if line[key] is not None]  # type: ignore[attr-defined]
    found["newmark_dearer_everywhere"] = bool(ratios and min(ratios) > 1.0)
    found["newmark_over_irk"] = [min(ratios), max(ratios)] if ratios else []
    best = {f"{target:.0e}": tables.ranking(first, target) for target in (1e-2, 1e-4, 1e-6)}
    found["cheapest"] = [
        {
            "error": float(error),
            "solver": ranked.iloc[0]["solver"],
            "cpu_s": ranked.iloc[0]["cpu_s"],
            "ours": bool(ranked.iloc[0]["family"] == "two-loop"),
            "paper_times": _over(ranked, IRK_LINE),
            "ida_times": _over(ranked, IDA_C),
        }
        for error, ranked in best.items()
        if len(ranked)
    ]
    failed = rows[rows["status"] != "REACHED_END"]
    found["n_failed"] = len(failed)
    found["n_failed_two_loop"] = int((failed["family"] == "two-loop").sum())
    found["n_runs"] = len(rows)
    ours = rows[(rows["family"] == "two-loop") & (rows["err_in"].isna() | (rows["err_in"] == 1e-9))]
    found["violation"] = float(ours["violation_q"].max())
    found["violation_grows"] = bool(ours["violation_late"].max() > 2.0 * ours["violation_early"].max())
    drifting = rows[~rows["keeps_constraints"].astype(bool)]
    found["violation_drift"] = float(drifting["violation_q"].max()) if len(drifting) else None
    return found | causes(first)


def _over(ranked: pd.DataFrame, solver: str) -> float | None:
    """Time of a solver over that of the cheapest; None where it does not reach the error."""
    line = ranked[ranked["solver"] == solver]
    return None if line.empty else float(line["cpu_s"].iloc[0] / ranked["cpu_s"].iloc[0])


def equal_error(first: pd.DataFrame) -> list[dict[str, float | None]]:
    """CPU time of Newmark over that of Runge-Kutta at equal error over the run, err_in = 1e-9.

    None where one of them has no run on either side of the error.
    """
    fine = first[first["err_in"].isna() | (first["err_in"] == TOLERANCES[-1])]
    lines = []
    for target in (0.3, 0.1, 0.03, 0.01, 0.003):
        half, quarter, irk = (
            tables.time_for(runs, target) if target <= runs["error_q"].max() else float("nan")
            for runs in (fine[fine["solver"] == solver] for solver in (NEWMARK, QUARTER, IRK_LINE))
        )
        ratios = {"half": half / irk, "quarter": quarter / irk}
        lines.append({"error": target, **{name: None if np.isnan(x) else x for name, x in ratios.items()}})
    return lines


def report(output: Output, rows: pd.DataFrame, line: str) -> dict[str, object]:
    """Write findings, figures and report; the findings."""
    rows = tables.medians(rows)
    findings = findings_of(rows)
    output.save_findings(findings)
    problems = list(dict.fromkeys(rows["problem"]))
    header = ["err_in \\ err_out", *(power(e) for e in TOLERANCES)]
    compared = {problem: rows[(rows["problem"] == problem) & (rows["group"] != "partition")] for problem in problems}
    ready = {}
    for group, name in (("Table 3: IRK", "irk"), ("Table 3: Newmark", "newmark")):
        first = compared[problems[0]]
        ready[f"{name}_time"] = table(header, grid(first, group, _time))
    ready["counts"] = table(["err_out", *header[1:]], counts(compared[problems[0]]))
    work = ["solver", "called from", *(power(target) for target in TARGETS)]
    for problem, name in zip(problems, ("first", "second"), strict=True):
        listed = [solver for solver in dict.fromkeys(compared[problem]["solver"]) if solver != IRK]
        ready[name] = table(work, tables.work_precision(compared[problem], TARGETS, listed))
        drawn = [solver for solver in DRAWN if solver in set(compared[problem]["solver"])]
        seconds = f"{number(findings['t_end'])} s"
        shown = compared[problem]
        shown = shown[shown["err_in"].isna() | (shown["err_in"] == TOLERANCES[-1])]
        suffix = "" if name == "first" else "_second"
        figures.save(figures.work_precision(shown, drawn, f"{problem}, {seconds}"), output, f"table3{suffix}")
    failed = tables.failures(rows)
    ready["failed"] = table(["solver", "setting", "status", "message"], failed) if failed else ""
    more = {"stamp": line, "quick": output.call.quick, "first": problems[0], "second": problems[1]}
    output.write("table3.md", render("table3", findings, ready, **more))
    return findings


def show(rows: pd.DataFrame) -> None:
    """Print the table to the terminal."""
    first = tables.medians(rows[rows["problem"] == rows["problem"].iloc[0]])
    paper = " / the paper's, × its ratio to ours" if first["t_end"].iloc[0] == PAPER_END else ""
    console = Console()
    for group in FAMILIES:
        shown = Table(title=f"{group}: CPU time (s) over {first['t_end'].iloc[0]:g} s{paper}")
        for name in ("err_in \\ err_out", *(power(e) for e in TOLERANCES)):
            shown.add_column(name, justify="right")
        for line in grid(first, group, _time):
            shown.add_row(*line)
        console.print(shown)


def _work(words: Sequence[str] | None) -> None:
    call: Call = cli.parse("table3", __doc__, words)
    with Output(call) as output:
        if call.redraw:
            rows, line = output.load_rows()
        else:
            rows, line = make(output, call.quick), cli.stamp(call.command)
            output.save_rows(rows, line)
        report(output, rows, line)
        write_index(output)
    show(rows)
    print(f"wrote table3.md, .csv, .json and figures to {output.path}")


def main(words: Sequence[str] | None = None) -> None:
    """Run the study and write its report."""
    cli.main(_work, words)


if __name__ == "__main__":
    main()
