"""The beam study from its runs to its report."""

from collections.abc import Sequence
from typing import Any

import matplotlib.pyplot as plt
import pandas as pd
from matplotlib.figure import Figure
from matplotlib.ticker import NullLocator

import studies.beam as package
from studies import cli, figures, tables
from studies.beam.findings import TARGETS, findings_of
from studies.beam.growth import CHANGES, FIXED_STEP, element_rows, modulus_rows, sensitivity_rows
from studies.beam.limits import GAUSS_SEIDEL, along_rows, growth_test_rows, limit_rows
from studies.beam.runs import EXUDYN, NEWTON, PAPER, by_tip, cases, measure, runs
from studies.bench import collect
from studies.index import write_index
from studies.render import number, render, table
from studies.store import Output

ERROR = "largest error of the tip's height over the run (m)"
DRAWN_TOL = 1e-2  # of RadauIIA5 in the figure of growth


def make(output: Output, quick: bool) -> pd.DataFrame:
    """Make all rows."""
    known = cases(quick)
    with output.kept() as kept:
        rows = collect(runs(known, quick), kept, measure)
        more = [*limit_rows(), *growth_test_rows(), *along_rows(known, quick), *sensitivity_rows(known)]
        more += [*element_rows(quick), *modulus_rows(quick)]
    return pd.concat([rows, pd.DataFrame(more)], ignore_index=True)


def cost_table(runs_: pd.DataFrame) -> str:
    """CPU time for each target, and what the cheapest run within the last of them took."""
    header = ["solver", "called from", *(f"{1e3 * target:g} mm" for target in TARGETS)]
    header += ["evaluations", "steps", "rejected", "violation", "h w_max"]
    lines = []
    for line in tables.work_precision(runs_, TARGETS):
        part = runs_[runs_["solver"] == line[0]]
        good = part[part["error_q"] <= TARGETS[-1]]
        if good.empty:
            lines.append([*line, *["none so good"] * 5])
            continue
        run = good.loc[good["cpu_s"].astype(float).idxmin()]
        keys = ("n_evaluations", "n_steps", "n_rejected", "violation_q")
        told = [number(run[key]) if pd.notna(run[key]) else "not told" for key in keys]
        step = "not told" if pd.isna(run["h_median"]) else number(run["h_median"] * run["w_max_case"])
        lines.append([*line, *told, step])
    return table(header, lines)


def limit_table(rows: pd.DataFrame) -> str:
    """Step limits of fixed-point iterations."""
    header = ["iteration", "theory", "no test ends it", "ten steps of the linearised beam"]
    lines = []
    for _, row in rows[rows["group"] == "limit"].iterrows():
        free = number(row["free"], 3) if row["solver"] == GAUSS_SEIDEL else "not tried"
        lines.append([row["solver"], number(row["theory"], 3), free, number(row["measured"], 3)])
    return table(header, lines)


def sensitivity_table(findings: dict[str, Any]) -> str:
    """Largest change of the tip by changed beams, mm."""
    names = [case["name"] for case in findings["cases"]]
    lines = [[change, *(1e3 * case["changes"][change] for case in findings["cases"])] for change in CHANGES]
    return table(["change", *(f"{name} (mm)" for name in names)], lines)


def growth_figure(rows: pd.DataFrame) -> Figure:
    """CPU time a step over elements, and evaluations a second of motion over Young's modulus."""
    figure, (mesh, stiffness) = plt.subplots(1, 2, figsize=(9.2, 3.6), layout="constrained")
    elements = rows[rows["group"] == "elements"]
    look = {"dense": (figures.GREY, "s", "all of the matrices"), "banded": (figures.ORANGE, "^", "their band")}
    for kind, (color, marker, label) in look.items():
        line = elements[elements["solver"] == kind].sort_values("n_elements")
        each = 1e3 * line["cpu_s"].astype(float) / line["n_steps"].astype(float)
        mesh.plot(line["n_elements"].astype(float), each, color=color, marker=marker, label=label)
    mesh.set(xscale="log", yscale="log", xlabel="elements", ylabel="CPU time per step (ms)")
    counts = sorted(elements["n_elements"].astype(int).unique())
    mesh.set_xticks(counts, [str(n) for n in counts])
    mesh.xaxis.set_minor_locator(NullLocator())
    mesh.set_title(f"Newton's method (RadauIIA5), steps of {number(FIXED_STEP)} s", fontsize=9)
    mesh.legend(title="linear algebra with")
    modulus = rows[rows["group"] == "modulus"]
    for solver, label in ((PAPER, "PaperIRK (fixed-point iteration)"), (NEWTON, "RadauIIA5 (Newton's method)")):
        line = modulus[(modulus["solver"] == solver) & ((solver == PAPER) | (modulus["tol"] == DRAWN_TOL))]
        each = line["n_evaluations"].astype(float) / line["t_end"].astype(float)
        stiffness.plot(line["modulus"].astype(float), each, label=label, **figures.style(solver))
    stiffness.set(
        xscale="log", yscale="log", xlabel="Young's modulus (N/m²)", ylabel="evaluations per second of motion"
    )
    stiffness.set_title("Cost and stiffness", fontsize=9)
    stiffness.legend()
    return figure


def drawn(runs_: pd.DataFrame) -> list[str]:
    """The cheapest lines at the targets, the paper's procedure among them in any case."""
    comparable = runs_[runs_["solver"] != EXUDYN]
    lines = figures.cheapest_lines(comparable, TARGETS, figures.MOST_LINES - 1)
    return lines if PAPER in lines else [PAPER, *lines]


def report(output: Output, rows: pd.DataFrame, line: str) -> dict[str, Any]:
    """Write findings, figures and report; the findings."""
    rows = tables.medians(rows)
    rows = rows.assign(error_q=rows["error_q"].where(rows["group"] != "run", rows["error_tip"]))
    findings = findings_of(rows)
    output.save_findings(findings)
    ready = {}
    for case in findings["cases"]:
        runs_ = by_tip(rows)
        runs_ = runs_[runs_["case"] == case["name"]].assign(w_max_case=case["w_max"])
        ready[case["name"]] = cost_table(runs_)
        title = f"{case['name']} beam, {number(case['t_end'])} s"
        plot = figures.work_precision(runs_, drawn(runs_), title, ERROR)
        figures.save(plot, output, case["figure"].removesuffix(".png"))
    figures.save(growth_figure(rows), output, "beam_growth")
    ready |= {"limits": limit_table(rows), "changes": sensitivity_table(findings)}
    failed = tables.failures(by_tip(rows))
    ready["failed"] = table(["solver", "setting", "status", "message"], failed) if failed else ""
    more = {"stamp": line, "quick": output.call.quick}
    output.write("beam.md", render("beam", findings, ready, **more))
    return findings


def _work(words: Sequence[str] | None) -> None:
    call = cli.parse("beam", package.__doc__, words)
    with Output(call) as output:
        if call.redraw:
            rows, line = output.load_rows()
        else:
            line = cli.stamp(call.command)
            rows = make(output, call.quick)
            output.save_rows(rows, line)
        report(output, rows, line)
        write_index(output)
    print(f"wrote beam.md, .csv, .json and figures to {output.path}")


def main(words: Sequence[str] | None = None) -> None:
    """Run the study and write its report."""
    cli.main(_work, words)
