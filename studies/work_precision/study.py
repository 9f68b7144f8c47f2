"""Every mechanism with every solver, ours and others': what each accuracy costs, and which solver to take.

Four cases are run at length, over their whole motion; all others, with more rivals, by `rivals`. What was aimed
at is judged in `goals`, where a rival is ahead in `behind`; how cost grows with size is in
`studies.work_precision.scaling`, how far it is from what the machine can do in `studies.work_precision.limit`.
"""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from importlib.metadata import PackageNotFoundError, version
from itertools import product
from typing import Any

import pandas as pd

from studies.bench import adaptive, cases, figures, headline, study, tables
from studies.bench.cli import StudyError
from studies.bench.collector import Case, Run, row_of
from studies.bench.render import number, render, table
from studies.bench.solvers import (
    COMPARED,
    COMPARED_OWN,
    DEFAULT,
    IDA_C_ORDER_2,
    IDA_FORMS,
    IRK_LINE,
    QUARTER,
    RADAU,
    RIVALS,
    TOLERANCES,
)
from studies.bench.store import Output, Row
from studies.compare import runs_of
from studies.work_precision import behind, first_calls, goals, limit, minimal, processors, rivals, scaling

ERRORS = (1e-2, 1e-4, 1e-6)  # the accuracies of the first screen
DOMINATED = 2.0  # a solver that costs this many times as much as another at every error is not to be used
FURTHER = ("Gauss6", IRK_LINE, QUARTER, f"IDA, {IDA_FORMS[0]}")
STIFF = ("TRBDF2", *RADAU[1:], IDA_C_ORDER_2)  # in their place on stiff cases; the paper's: `studies.beam`
IDA = ("IDA from C", "IDA, ")  # how its lines begin; CVODE is of the same family, and IDAS is CasADi's
QUICK = (*COMPARED[:4], "RadauIIA5", "IDA, stabilised")  # others take seconds to compile or to run
QUICK_CASES = ("four-bar",)  # the beams' references take seconds
TIME_LIMIT = 3.0  # s of CPU of a run: slower ones are of no use beside others
SETTING = ["case", "solver", "tol", "h"]
PARTS = (
    rivals.GROUP,
    scaling.GROUP,
    limit.GROUP,
    behind.GROUP,
    first_calls.GROUP,
    minimal.GROUP,
)  # groups of rows that are not of the four cases
PACKAGES = ("heyoka", "scikit-sundae", "scipy", "extensisq", "diffrax", "casadi", "solve-dae", "exudyn")


def runs(case: Case, quick: bool) -> list[Run]:
    """The runs of a case, at every other value of the grid: between them `adaptive` asks where that is of use."""
    stiff = "stiff" in case.tags
    if quick:
        return runs_of(case, QUICK, quick)
    made = runs_of(case, dict.fromkeys((*COMPARED_OWN, *RIVALS, *(STIFF if stiff else FURTHER))), quick)
    coarse = (case.tolerances or TOLERANCES)[::2]
    return [run for run in made if run.solver.setting != "tol" or run.value in coarse]


def class_of(rows: pd.DataFrame, error: float) -> dict[str, Any]:
    """The cheapest of ours, of others and of IDA on one case at one error, how the default does, and what beats it."""
    ranked = tables.ranking(rows, error)
    found: dict[str, Any] = {"error": error, "ida": None, "default_over": None, "before_default": {}}
    found["standing"] = headline.of_error(rows, error)
    ida = [own for _, own in tables.put(rows[rows["solver"].str.startswith(IDA)]).groupby("solver")]
    found["ida_missed"] = bool(ida) and all(tables.missed(own, error) for own in ida)
    found["ida_tightest"] = max((t for t in map(tables.tightest, ida) if t == t), default=None)
    found |= tables.of_both(ranked)
    if ranked.empty:
        return found
    found["ida"] = tables.best(ranked[ranked["solver"].str.startswith(IDA)])
    default = ranked[ranked["solver"] == DEFAULT]["call_s"]
    if not default.empty:
        own, cheaper = ranked["family"] == "two-loop", ranked["call_s"] < default.iloc[0]
        found["default_over"] = float(default.iloc[0] / ranked[own]["call_s"].iloc[0])
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
        setting = next(name for name in tables.SETTINGS if name in own and own[name].notna().any())
        run = own.loc[own[setting].astype(float).idxmin()]
        line = {"solver": str(solver), "setting": setting, "value": float(run[setting])}
        found.append(line | {key: float(run[key]) for key in ("error_q", "call_s")})
    return found


def dominated(rows: pd.DataFrame, errors: Sequence[float]) -> list[dict[str, Any]]:
    """Solvers that some one other beats at every error that they reach on every case: name, by which, least factor."""
    costs: dict[str, dict[tuple[str, float], pd.Series]] = {}
    for case, error in product(dict.fromkeys(rows["case"]), errors):
        for _, line in tables.ranking(rows[rows["case"] == case], error).iterrows():
            costs.setdefault(line["solver"], {})[case, error] = line
    found = []
    for solver, own in costs.items():
        over = {
            other: {place: line["call_s"] / theirs[place]["call_s"] for place, line in own.items()}
            for other, theirs in costs.items()
            if other != solver and own.keys() <= theirs.keys()
        }
        by = max(over, key=lambda other: min(over[other].values()), default="")
        if not by or min(over[by].values()) < DOMINATED:
            continue
        where = min(over[by], key=over[by].__getitem__)  # the row in which it does best
        mine, theirs = own[where], costs[by][where]
        line = {
            "solver": solver,
            "by": by,
            "factor": over[by][where],
            "n": len(own),
            "called_from": mine["called_from"],
        }
        line |= {"case": where[0], "error": where[1], "call_s": mine["call_s"], "by_s": theirs["call_s"]}
        found.append(line | {"evaluations": mine["n_evaluations"] / theirs["n_evaluations"]})
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
        slug = "_".join("".join(letter if letter.isalnum() else " " for letter in case.name).split())
        found: dict[str, Any] = {"name": case.name, "tags": list(case.tags), "t_end": case.t_end, "at": at}
        found |= {"default_dominated": bool(over) and min(over) > 1.0}
        found |= {"default_over": [min(over), max(over)] if over else []}
        found |= {"default_by": before_default(at, "ours"), "default_by_others": before_default(at, "others")}
        found["astray"] = out_of_phase(runs[runs["error_q"].notna()])
        listed.append(found | {"figure": f"work_precision_{slug}.png", "note": case.note})
    drifting = rows[~rows["keeps_constraints"].astype(bool)]["violation_q"].max()
    found = {"cases": listed, "dominated": dominated(rows, ERRORS), "limit": DOMINATED, "default": DEFAULT}
    return found | {"drift": None if pd.isna(drifting) else float(drifting)}


def known_cases(quick: bool) -> list[Case]:
    """The cases at length."""
    return [replace(case, time_limit=TIME_LIMIT) for case in cases.load(quick) if not quick or case.name in QUICK_CASES]


def make(output: Output) -> pd.DataFrame:
    """Make all rows."""
    quick = output.call.quick
    at_length = [run for case in known_cases(quick) for run in runs(case, quick)]
    with output.kept() as kept:
        errors = () if quick else ERRORS
        made = [adaptive.collect(at_length, kept, _row, lambda run: True, errors)]
        made += [rivals.collect(rivals.runs(quick), kept), behind.collect(kept, quick)]
        made += [scaling.collect(quick, kept), limit.collect(kept, quick), first_calls.collect(kept, quick)]
        made.append(minimal.collect(kept, quick))
    return pd.concat(made, ignore_index=True)


def _row(run: Run, repeat: int, built: adaptive.Built) -> Row:
    return row_of(run, repeat, None, built)


def part(rows: pd.DataFrame, group: str | None = None) -> pd.DataFrame:
    """The rows of one group, without columns that it has not; None: of the four cases."""
    chosen = ~rows["group"].isin(PARTS) if group is None else rows["group"] == group
    return rows[chosen].dropna(axis="columns", how="all").reset_index(drop=True)


def versions() -> dict[str, str]:
    """Of the packages compared, those that are installed."""
    found = {}
    for package in PACKAGES:
        with suppress(PackageNotFoundError):
            found[package] = version(package)
    return found


def report(output: Output, rows: pd.DataFrame, line: str) -> dict[str, Any]:
    """Write findings, figures and report; the findings."""
    everywhere = tables.medians(part(rows, rivals.GROUP))
    known, medians = known_cases(output.call.quick), tables.medians(part(rows).reindex(columns=rows.columns))
    found, machine = rivals.findings_of(everywhere), limit.findings_of(part(rows, limit.GROUP))
    operations = part(rows, behind.GROUP).set_index("case").get("operations", pd.Series(dtype=float))
    operation_ns = machine["alone_ns"] / machine["operations"]
    findings = findings_of(medians, known) | {"rivals": found, "machine": machine}
    findings["behind"] = behind.findings_of(found, everywhere, operations.to_dict(), operation_ns)
    findings |= {"goals": goals.findings_of(known, medians, everywhere), "asked": asked(part(rows, rivals.GROUP))}
    findings |= {"scaling": scaling.findings_of(part(rows, scaling.GROUP)), "versions": versions()}
    findings |= {
        "in_table": rivals.IN_TABLE,
        "fitted": scaling.FITTED,
        "first_calls": first_calls.findings_of(part(rows, first_calls.GROUP)),
    }
    in_angles = part(rows, minimal.GROUP)
    findings["repetition"] = {"calls": int(part(rows, rivals.GROUP)["calls"].max()), "below": rivals.TIMED}
    findings["price"] = headline.price(everywhere, part(rows, first_calls.GROUP), rivals.HEADLINE)
    findings["minimal"] = minimal.findings_of(in_angles if in_angles.empty else tables.medians(in_angles), everywhere)
    findings |= {} if output.call.quick else processors.kept(output, rows, line, found)
    output.save_findings(findings)
    draw(output, findings, everywhere, medians)
    text = render("work_precision", findings, ready(findings), stamp=line, quick=output.call.quick)
    output.write("work_precision.md", text)
    return findings


def asked(rows: pd.DataFrame) -> dict[str, Any]:
    """How many pairs of rival and mechanism were refused, or not asked for all accuracies, and the rule."""
    others = rows[rows["family"] != "two-loop"]
    pairs = others.groupby(["solver", "case"]).ngroups
    put = [own for _, own in tables.put(others).groupby(["solver", "case"])]
    return {
        "n": pairs,
        "refused": pairs - len(put),
        "fewer": sum(not tables.missed(own, 0.0) for own in put),
        "far": adaptive.FAR,
        "running": adaptive.RUNNING,
        "outclassed": adaptive.OUTCLASSED,
        "limit": rivals.TIME_LIMIT,
    }


def draw(output: Output, findings: dict[str, Any], everywhere: pd.DataFrame, medians: pd.DataFrame) -> None:
    """Write all figures."""
    for case in findings["cases"]:
        own = medians[medians["case"] == case["name"]]
        lines = figures.lines_of(own, ERRORS)
        plot = figures.work_precision(own, lines, f"{case['name']}, {number(case['t_end'])} s")
        figures.save(plot, output, case["figure"].removesuffix(".png"))
    figures.save(rivals.picture(everywhere), output, "work_precision")
    figures.save(rivals.heat_map(findings["rivals"]), output, "work_precision_ratios")


def ready(findings: dict[str, Any]) -> dict[str, str]:
    """The tables of the report."""
    ours = ["`auto`", "`auto, compiled`", "best of ours"]
    geometries = [geometry["case"] for geometry in findings["rivals"]["four_bar"]]
    first = ["solver", "built by", "first call (s)", "least", "most", "later call (ms)", "pays from run"]
    profile = ["worst", "ours", "steps × ns", "rival", "steps × ns", "evaluation (ns)", "without", "in the way"]
    return {
        "goals": table(["rival", "wanted", *geometries], rivals.goal_lines(findings["rivals"])),
        "ratios": table(["mechanism", *ours], rivals.lines(findings["rivals"])),
        "behind": table(profile, behind.lines(findings["behind"])),
        "scaling": scaling.pivot(findings["scaling"]),
        "evaluations": scaling.evaluations(findings["scaling"]),
        "first": table(first, first_calls.lines(findings["first_calls"])),
        "minimal": table(["mechanism", *ours, "fastest rival"], minimal.lines(findings["minimal"])),
    }


def main(words: Sequence[str] | None = None) -> None:
    """Run the study and write its report."""
    study.run_rows("work_precision", __doc__, words, make, report)


if __name__ == "__main__":
    main()
