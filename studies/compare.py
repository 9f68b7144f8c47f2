"""Compare solvers on a mechanism of your own, or a solver of your own: methods of twoloop beside other projects."""

import threading
import time
from collections.abc import Iterable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from studies.bench import cli, figures, tables
from studies.bench.cli import StudyError
from studies.bench.collector import FILE, REPEATS, Case, Run, Solver, collect
from studies.bench.names import label
from studies.bench.outsider import N_TIMES, Outsider
from studies.bench.reference_motion import ReferenceMotion, check_published, make_reference
from studies.bench.render import number, power, render, table
from studies.bench.row_files import in_format, mechanism_of, rows_of_file, versions
from studies.bench.solvers import CATALOGUE, COMPARED
from studies.bench.store import Output, Row
from twoloop import Result
from twoloop.mechanisms import Problem
from twoloop.mechanisms.registry import problem_from
from twoloop.methods.presets import is_small
from twoloop.rows.leaderboard import boards
from twoloop.rows.row_format import CALIBRATION, calibration_s, format_rows

GROUP = "compare"
FOLDER = "compare"  # of the report, unless --out is given
ERRORS = (1e-2, 1e-4, 1e-6, 1e-8)
QUICK = (1e-3, 1e-6, 1e-9)  # values of tolerances in a quick comparison
TICK = 10.0  # s between two lines that say that the reference is still being made
REFERENCE_LIMIT = 300.0  # s of wall-clock time for each run of the reference


def load_problem(where: str) -> Problem:
    """Return the problem of FILE.py:FUNCTION, or a ready mechanism by its name; raise StudyError if there is none."""
    try:
        return problem_from(where)
    except ValueError as error:
        raise StudyError(str(error)) from None


def known_of(problem: Problem, t_end: float, limit: float) -> ReferenceMotion:
    """Make the reference, and print how long it takes, as it is the longest part of many comparisons."""
    print(f"making the reference of {problem.name!r} to {t_end:g} s, at most {limit:g} s a run ...", flush=True)
    began, ended = time.perf_counter(), threading.Event()

    def tick() -> None:
        while not ended.wait(TICK):
            print(f"  ... {time.perf_counter() - began:.0f} s", flush=True)

    threading.Thread(target=tick, daemon=True).start()
    try:
        made = make_reference(problem, t_end, limit, partial(print, flush=True))
    except StudyError as error:
        raise StudyError(f"{error}. Choose a shorter --t-end, or more than --reference-limit {limit:g}") from None
    except Exception as error:  # of the mechanism's functions
        said = "; ".join([f"{type(error).__name__}: {error}", *getattr(error, "__notes__", [])])
        raise StudyError(f"no reference for {problem.name!r}: {said}") from error
    finally:
        ended.set()
    print(f"... made in {time.perf_counter() - began:.1f} s; it holds to {made.floor:.0e}", flush=True)
    return made


def runs_of(case: Case, solvers: Iterable[str | Solver], quick: bool) -> list[Run]:
    """List all runs of the comparison of a case; a `Solver` that is no name is from a file."""
    runs, at_times = [], replace(case, n_instants=N_TIMES - 1, known=lambda: case.reference)
    for each in solvers:
        solver, of = (CATALOGUE[each], case) if isinstance(each, str) else (each, at_times)
        values = solver.grid(case)
        if quick:
            own = (case.tolerances or ())[:6:2]  # a case that has its own has loose ones
            values = own or QUICK if solver.setting == "tol" else values[:2]
        runs += [Run(of, solver, value, GROUP, 1 if quick else REPEATS) for value in values]
    return runs


def beside(outsiders: Mapping[str, Outsider], run: Run, result: Result) -> dict[str, Any]:
    """Measure the calibration where the solver ran, and the error at the end over the largest coordinate."""
    outsider = outsiders.get(run.solver.name)
    q, _ = run.case.reference.states(run.case.instants[-1:])
    size = max(1.0, float(np.abs(q).max()))
    ended = float(np.abs(result.q[:, -1] - q[:, 0]).max()) / size if result.success else None
    calibrated = calibration_s() if outsider is None else outsider.calibrated
    found = {"calibration": CALIBRATION, "calibration_s": calibrated}
    return found | {"error_over": ended, "floor_over": run.case.reference.floor / size}


def rows_from(files: Iterable[str], mechanism: str, t_end: float) -> list[Row]:
    """Return the rows of files (or of the shipped "archive") for a mechanism; raise StudyError if a file has none."""
    found = []
    for file in files:
        rows = rows_of_file(file)
        own = [row for row in rows if row["mechanism"] == mechanism and abs(row["t_end"] / t_end - 1.0) < 1e-9]
        if not own:
            known = sorted({f"{row['mechanism']} to {row['t_end']:g} s" for row in rows})
            raise StudyError(f"{file} has no rows of {mechanism} to {t_end:g} s, but of {', '.join(known)}")
        found += own
    return found


def findings_of(rows: pd.DataFrame, case: Case, errors: Sequence[float]) -> dict[str, Any]:
    floor = float(rows["floor"].iloc[0])
    found: dict[str, Any] = {"name": case.name, "t_end": case.t_end, "floor": floor, "n_instants": case.n_instants}
    found["coded"] = is_small(case.problem.system)
    found |= {"python": case.problem.system.called_in_python, "unresolved": [e for e in errors if e < floor]}
    found["any_compiled"] = bool((rows["called_from"] != "Python").any())
    found["cheapest"] = []
    for error in errors:
        ours, others = tables.of_both(tables.ranking(rows, error)).values()
        first = None if ours is None or others is None else bool(ours["call_s"] < others["call_s"])
        found["cheapest"].append({"error": error, "ours": ours, "others": others, "ours_first": first})
    return found | {"failed": bool((rows["status"] != "REACHED_END").any())}


def report(
    output: Output, case: Case, rows: pd.DataFrame, line: str, errors: Sequence[float], given: Mapping[str, Any]
) -> None:
    """Write findings, figure, rows in the format, and report; `given`: versions of solvers, rows from elsewhere."""
    rows = tables.medians(rows)
    columns = {"error": "error_q", "floor": "floor", "error_end": "error_over", "floor_end": "floor_over"}
    own = [in_format(run, columns, given["versions"]) for run in rows.to_dict("records")]
    output.write("compare.jsonl", format_rows(own))
    findings = findings_of(rows, case, errors)
    if output.call.redraw:  # without making the reference again
        findings |= {key: output.load_findings().get(key) for key in ("source", "published")}
    else:
        published = check_published(case.problem, case.reference, case.t_end)
        findings |= {"source": case.reference.source, "published": published}
    output.save_findings(findings)
    coded = findings["coded"]
    lines = figures.lines_of(rows, errors, coded)
    if lines:
        figures.save(figures.work_precision(rows, lines, message(findings), coded=coded), output, "compare")
    middle = errors[len(errors) // 2]
    header = ["solver", "called from", *(power(error) for error in errors)]
    kept = {"solver": "solver", "call_s": "CPU (s)", "n_evaluations": "evaluations", "violation_q": "max abs C"}
    kept |= {"violation_v": "max abs C_q v + C_t", "energy": "energy error (J)"}
    best = tables.ranking(rows, middle)
    best["solver"] = [label(name, coded) for name in best["solver"]]
    quality = [[run[key] for key in kept] for _, run in best.iterrows()]
    work = table(header, tables.work_precision(rows, errors, coded=coded))
    ready = {"work": work, "kept": table([*kept.values()], quality), "failed": _failed(rows, coded)}
    all_rows = [*own, *given["rows"]]
    found = [board for error in errors for board in boards(all_rows, error)] if given["rows"] else []
    ready["beside"] = "\n\n".join(map(str, found)).replace("`", "'")
    more = {"stamp": line, "quick": output.call.quick, "middle": middle, "note": case.note, "drawn": bool(lines)}
    files = dict.fromkeys(rows[rows["family"] == FILE]["solver"])
    more |= {"files": [f"`{name}`" for name in files], "n_times": N_TIMES}
    output.write("compare.md", render("compare", findings, ready, **more))


def message(found: dict[str, Any]) -> str:
    """Say what the figure shows: the ratio of both sides at the smallest error that both reach."""
    both = [at for at in found["cheapest"] if at["ours_first"] is not None]
    about = f"{found['name']}, {number(found['t_end'])} s"
    if not both:
        return about
    at = both[-1]
    ratio = at["others"]["call_s"] / at["ours"]["call_s"]
    told = f"{number(ratio)} times the time of twoloop for an error of {power(at['error'])}"
    return f"{about}: {label(at['others']['solver'])} takes {told}"


def _failed(rows: pd.DataFrame, coded: bool) -> str:
    return table(["solver", "setting", "status", "message"], tables.failures(rows, coded))


def _work(words: Sequence[str] | None) -> None:
    parser = cli.parser("compare", __doc__, quick="one repetition and few settings", folder=FOLDER)
    what = "FILE.py:FUNCTION, which returns a twoloop.mechanisms.Problem, or a ready mechanism"
    parser.add_argument("where", metavar="MECHANISM", help=what)
    what = "FILE.py:FUNCTION, simulate(problem, times, tolerance) as check_simulator takes it, or sundae_ida, "
    what += "a file of references.as_shown; may be given again"
    parser.add_argument("--solver", action="append", default=[], metavar="FILE.py:FUNCTION", help=what)
    what = "rows to show beside (twoloop rows check); the word archive: those that are shipped"
    parser.add_argument("--with", dest="files", nargs="+", default=[], metavar="FILE.jsonl", help=what)
    parser.add_argument("--time-limit", type=float, default=Case.time_limit, metavar="S", help="s, for each run")
    parser.add_argument("--t-end", type=float, help="s; default: the end of the problem's t_span")
    parser.add_argument("--solvers", nargs="+", metavar="NAME", help=f"of {', '.join(CATALOGUE)}")
    limit: dict[str, Any] = {"default": REFERENCE_LIMIT, "metavar": "S", "help": "s, for each run of the reference"}
    parser.add_argument("--reference-limit", type=float, **limit)
    parser.add_argument("--errors", nargs="+", type=float, default=list(ERRORS), help="errors to compare the cost at")
    given = parser.parse_args(words)
    unknown = [name for name in given.solvers or () if name not in CATALOGUE]
    if unknown:
        raise StudyError(f"no solver is called {unknown[0]!r}; there are: {'; '.join(CATALOGUE)}")
    given.out = given.out or Path(FOLDER)
    problem = load_problem(given.where)
    t_end = problem.t_span[1] if given.t_end is None else given.t_end
    positive = {"errors": given.errors, "reference-limit": [given.reference_limit], "time-limit": [given.time_limit]}
    for name, values in (positive | {"t-end": [t_end]}).items():
        if wrong := [value for value in values if not value > 0.0]:
            raise StudyError(f"--{name} must be positive; given {wrong[0]:g}")
    known = partial(known_of, problem, t_end, given.reference_limit)
    limits: dict[str, Any] = {"time_limit": given.time_limit, "timed": 0.004 if given.quick else 0.02}
    case = Case(problem.name, problem, t_end, known, note=problem.note, **limits)
    elsewhere = rows_from(given.files, mechanism_of(problem.name), t_end)
    outsiders = {each.name: each for each in (Outsider(where, given.where) for where in given.solver)}
    if len(outsiders) < len(given.solver):
        raise StudyError(f"--solver must name different ones; given {', '.join(given.solver)}")
    told = {"versions": versions() | {each.name: each.digest for each in outsiders.values()}, "rows": elsewhere}
    call, errors = cli.call_of("compare", given, words), sorted(given.errors, reverse=True)
    with Output(call) as output, ExitStack() as ending:
        for outsider in outsiders.values():
            ending.callback(outsider.end)
            if not call.redraw:
                outsider.start()
        if call.redraw:
            rows, line = output.load_rows()
        else:
            solvers = [*(given.solvers or COMPARED), *(each.solver() for each in outsiders.values())]
            runs, line, failed = runs_of(case, solvers, call.quick), cli.stamp(call.command), ""
            files = {each.name: [each.digest, given.time_limit] for each in outsiders.values()}
            try:
                with output.kept({"where": given.where, "t_end": t_end, "files": files}) as kept:
                    rows = collect(runs, kept, partial(beside, outsiders))  # raises without a reference
                output.save_rows(rows, line)
                if not (rows["status"] == "REACHED_END").any():
                    failed = _failed(rows, is_small(case.problem.system))
                    raise StudyError(f"no solver reached the end; the first said: {rows['message'].iloc[0]}")
            except StudyError as error:
                found = {"name": case.name, "why": str(error)}
                output.write("compare.md", render("compare_failed", found, {"failed": failed}, stamp=line))
                raise
        report(output, case, rows, line, errors, told)
    print(f"wrote compare.md, .csv, .jsonl, .json, .png and .svg to {output.path}")


def main(words: Sequence[str] | None = None) -> None:
    cli.main(_work, words)


if __name__ == "__main__":
    main()
