"""Every mechanism of the comparison with the same solvers: what each accuracy costs, and which solver to take."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import pandas as pd

from studies import cases, cli, figures, tables
from studies.bench import Case, Run, collect
from studies.cli import StudyError
from studies.compare import runs_of
from studies.index import write_index
from studies.render import number, power, render, table
from studies.solvers import COMPARED, IDA_C_ORDER_2, NEWTON_4, TOLERANCES
from studies.store import Output

ERRORS = (1e-2, 1e-4, 1e-6)  # the accuracies of the first screen
DOMINATED = 2.0  # a solver that costs this many times as much as another at every error is not to be used
FURTHER = ("Gauss6", "PaperIRK, Atol = Rtol varied", "PaperNewmark, beta = 1/4", "IDA, index1")
STIFF = (NEWTON_4, IDA_C_ORDER_2)  # beside them on stiff cases, where `studies.beam` has the paper's procedures
TIGHT = 1e-4  # from here on a run of a stiff case takes seconds, and is made once
DEFAULT = "SunRadau5"  # of solve_dae
EMPTY = ("ours", "others", "ida", "default_over")
SETTINGS = ("tol", "h", "err_out")


def runs(case: Case, quick: bool) -> list[Run]:
    """The runs of a case; of stiff ones, once where they take seconds, and fewer of those called from Python."""
    stiff = "stiff" in case.tags
    made = runs_of(case, COMPARED if quick else (*COMPARED, *(STIFF if stiff else FURTHER)), quick)
    if not stiff:
        return made
    if quick:  # others take too long
        return [run for run in made if run.solver.called_from == "compiled"]
    coarse = (case.tolerances or TOLERANCES)[::2]
    made = [run for run in made if run.solver.called_from == "compiled" or run.value in coarse]
    return [
        replace(run, repeats=1) if run.solver.called_from == "Python" or run.value <= TIGHT else run for run in made
    ]


def best(ranked: pd.DataFrame) -> dict[str, Any] | None:
    """The first line of a ranking as a finding."""
    if ranked.empty:
        return None
    keys = ("solver", "cpu_s", "cpu_q1", "cpu_q3", "n_evaluations", "called_from", "violation_q", "energy")
    return {**{key: ranked.iloc[0][key] for key in keys}, "keeps": bool(ranked.iloc[0]["keeps_constraints"])}


def class_of(rows: pd.DataFrame, error: float) -> dict[str, Any]:
    """The cheapest of ours, of others and of IDA on one case at one error, how the default does, and what beats it."""
    ranked = tables.ranking(rows, error)
    found: dict[str, Any] = {"error": error, **dict.fromkeys(EMPTY), "before_default": {}}
    if ranked.empty:
        return found
    own, ida = ranked["family"] == "two-loop", ranked["family"] == "SUNDIALS"
    found |= {"ours": best(ranked[own]), "others": best(ranked[~own]), "ida": best(ranked[ida])}
    default = ranked[ranked["solver"] == DEFAULT]["cpu_s"]
    if not default.empty:
        found["default_over"] = float(default.iloc[0] / ranked[own]["cpu_s"].iloc[0])
        cheaper = ranked["cpu_s"] < default.iloc[0]
        kinds = {"ours": own, "others": ~own}
        found["before_default"] = {kind: ranked[cheaper & which]["solver"].tolist() for kind, which in kinds.items()}
    return found


def before_default(at: Sequence[dict[str, Any]], kind: str) -> list[str]:
    """Solvers of ours or of others that are cheaper than the default at every error that it reaches."""
    lists = [line["before_default"][kind] for line in at if line["default_over"] is not None]
    return [name for name in lists[0] if all(name in each for each in lists)] if lists else []


def out_of_phase(runs: pd.DataFrame) -> list[dict[str, Any]]:
    """Of each solver with runs out of phase, the one at its finest setting; `tol`, `h` or `err_out` names it."""
    found = []
    for solver, own in runs[runs["astray"].astype(bool)].groupby("solver", sort=False):
        setting = next(name for name in SETTINGS if name in own and own[name].notna().any())
        run = own.loc[own[setting].astype(float).idxmin()]
        line = {"solver": str(solver), "setting": setting, "value": float(run[setting])}
        found.append(line | {key: float(run[key]) for key in ("error_q", "cpu_s")})
    return found


def dominated(rows: pd.DataFrame, errors: Sequence[float]) -> list[dict[str, Any]]:
    """Solvers that some one other beats at every error that they reach on every case: name, by which, least factor."""
    times: dict[str, dict[tuple[str, float], float]] = {}
    counts: dict[tuple[str, str, float], float] = {}
    for (case, solver), runs in rows.groupby(["case", "solver"], sort=False):
        for error in errors:
            cost = tables.time_for(runs, error)
            if cost == cost:
                times.setdefault(str(solver), {})[str(case), error] = cost
                counts[str(solver), str(case), error] = tables.time_for(runs, error, "n_evaluations")
    found = []
    for solver, own in times.items():
        factors = {
            other: min(cost / theirs[place] for place, cost in own.items())
            for other, theirs in times.items()
            if other != solver and own.keys() <= theirs.keys()
        }
        if factors:
            by = max(factors, key=factors.__getitem__)
            if factors[by] >= DOMINATED:
                called = rows[rows["solver"] == solver]["called_from"].iloc[0]
                line = {"solver": solver, "by": by, "factor": factors[by], "n": len(own), "called_from": str(called)}
                over = {place: cost / times[by][place] for place, cost in own.items()}
                where = min(over, key=over.__getitem__)  # the row in which it does best
                row = {"case": where[0], "error": where[1], "cpu_s": own[where], "by_s": times[by][where]}
                row["evaluations"] = counts[(solver, *where)] / counts[(by, *where)]
                found.append(line | row)
    return found


def findings_of(rows: pd.DataFrame, known: Sequence[Case]) -> dict[str, Any]:
    """What the report and the first screen say, from the medians."""
    listed = []
    for case in known:
        runs = rows[rows["case"] == case.name]
        if runs.empty:
            raise StudyError(f"the rows have none of {case.name}; make them again by python -m studies.work_precision")
        at = [class_of(runs, error) for error in ERRORS]
        over = [line["default_over"] for line in at if line["default_over"] is not None]
        reached = runs[runs["error_q"].notna()]
        astray = out_of_phase(reached)
        listed.append(
            {
                "name": case.name,
                "tags": list(case.tags),
                "t_end": case.t_end,
                "floor": float(runs["floor"].iloc[0]),
                "at": at,
                "default_dominated": bool(over) and min(over) > 1.0,
                "default_over": [min(over), max(over)] if over else [],
                "default_by": before_default(at, "ours"),
                "default_by_others": before_default(at, "others"),
                "astray": astray,
                "drift": _drift(reached),
                "figure": f"work_precision_{_slug(case.name)}.png",
                "note": case.note,
            }
        )
    return {"cases": listed, "dominated": dominated(rows, ERRORS), "limit": DOMINATED, "default": DEFAULT}


def _drift(runs: pd.DataFrame) -> float | None:
    drifting = runs[~runs["keeps_constraints"].astype(bool)]
    return None if drifting.empty else float(drifting["violation_q"].max())


def _slug(name: str) -> str:
    return "_".join("".join(letter if letter.isalnum() else " " for letter in name).split())


def report(output: Output, rows: pd.DataFrame, line: str) -> dict[str, Any]:
    """Write findings, figures and report; the findings."""
    rows = tables.medians(rows)
    known = cases.load(output.call.quick)
    findings = findings_of(rows, known)
    output.save_findings(findings)
    work = {}
    for case, found in zip(known, findings["cases"], strict=True):
        runs = rows[rows["case"] == case.name]
        header = ["solver", "called from", *(power(error) for error in ERRORS)]
        work[case.name] = table(header, tables.work_precision(runs, ERRORS))
        lines = figures.cheapest_lines(runs, ERRORS)
        plot = figures.work_precision(runs, lines, f"{case.name}, {number(case.t_end)} s")
        figures.save(plot, output, found["figure"].removesuffix(".png"))
    more = {"stamp": line, "quick": output.call.quick}
    output.write("work_precision.md", render("work_precision", findings, work, **more))
    return findings


def _work(words: Sequence[str] | None) -> None:
    call = cli.parse("work_precision", __doc__, words)
    with Output(call) as output:
        if call.redraw:
            rows, line = output.load_rows()
        else:
            listed = [run for case in cases.load(call.quick) for run in runs(case, call.quick)]
            with output.kept() as kept:
                rows = collect(listed, kept)
            line = cli.stamp(call.command)
            output.save_rows(rows, line)
        report(output, rows, line)
        write_index(output)
    print(f"wrote work_precision.md, .csv, .json and figures to {output.path}")


def main(words: Sequence[str] | None = None) -> None:
    """Run the study and write its report."""
    cli.main(_work, words)


if __name__ == "__main__":
    main()
