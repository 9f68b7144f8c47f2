"""Every mechanism with every solver, ours and others': what each accuracy costs, and which solver to take.

Four cases are run at length, over their whole motion; all others, with more rivals, by `rivals`.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pandas as pd

from references.heyoka.taylor import LARGEST_UNROLLED
from studies.bench import adaptive, cases, figures, headline, study, tables
from studies.bench.cli import StudyError
from studies.bench.collector import Case, Run, row_of
from studies.bench.render import number, render
from studies.bench.row_files import versions
from studies.bench.solvers import (
    COMPARED,
    COMPARED_OWN,
    DEFAULT,
    IDA_C_BANDED,
    IDA_C_ORDER_2,
    IDA_INDEX_1,
    IRK_LINE,
    QUARTER,
    RADAU,
    OTHER_SOLVERS,
    TOLERANCES,
)
from studies.bench.store import KeptRows, Output
from studies.compare import GROUP, runs_of
from studies.work_precision import behind, builds, first_calls, minimal, processors, rivals
from twoloop.rows.calibration import CALIBRATION, calibration_s

ERRORS = (1e-2, 1e-4, 1e-6)  # the accuracies of the first screen
FURTHER = ("Gauss6", IRK_LINE, QUARTER, IDA_INDEX_1)
STIFF = ("TRBDF2", *RADAU[1:], IDA_C_ORDER_2, IDA_C_BANDED)  # in their place on stiff cases
BETWEEN = (7e-4, 5e-4, 3e-4, 2e-4)  # tolerances of the first of these, whose loose runs lie on no line
QUICK = (*COMPARED[:4], "RadauIIA5", "IDA, stabilised")  # others take seconds to compile or to run
QUICK_CASES = ("four-bar",)  # the beams' references take seconds
SHOWN = (
    GROUP,
    rivals.GROUP,
    first_calls.GROUP,
    builds.GROUP,
    minimal.GROUP,
)  # groups of rows of the report
TIME_LIMIT = 3.0  # s of CPU of a run: slower ones are of no use beside others


def runs(case: Case, quick: bool) -> list[Run]:
    """The runs of a case, at every other value of the grid: between them `adaptive` asks where that is of use."""
    stiff = "stiff" in case.tags
    if quick:
        return runs_of(case, QUICK, quick)
    made = runs_of(case, dict.fromkeys((*COMPARED_OWN, *OTHER_SOLVERS, *(STIFF if stiff else FURTHER))), quick)
    coarse = (case.tolerances or TOLERANCES)[::2]
    made = [run for run in made if run.solver.setting != "tol" or run.value in coarse]
    rough = {run.solver.name: run for run in made if stiff and run.solver.name == STIFF[0]}.values()
    return made + [replace(run, value=value) for run in rough for value in BETWEEN]


def classes_of(rows: pd.DataFrame) -> list[dict[str, Any]]:
    """The cheapest of ours and of others on one case at each error, and how the default does."""
    made = zip(ERRORS, rivals.standings(rows, ERRORS), tables.rankings(rows, ERRORS), strict=True)
    return [{"error": error, "standing": at} | tables.of_both(ranked) for error, at, ranked in made]


def findings_of(rows: pd.DataFrame, known: Sequence[Case]) -> dict[str, Any]:
    """What the report and the first screen say, from the medians."""
    listed = []
    for case in known:
        runs = rows[rows["case"] == case.name]
        if runs.empty:
            raise StudyError(f"the rows have none of {case.name}; make them again by python -m studies.work_precision")
        slug = "_".join("".join(letter if letter.isalnum() else " " for letter in case.name).split())
        found: dict[str, Any] = {"name": case.name, "tags": list(case.tags), "t_end": case.t_end}
        found |= {"at": classes_of(runs), "figure": f"work_precision_{slug}.png"}
        listed.append(found | {"processor": str(runs["processor"].iloc[0]) if "processor" in runs else ""})
    return {"cases": listed, "default": DEFAULT}


def banded_over_dense(rows: pd.DataFrame) -> dict[str, Any] | None:
    """Times of IDA with banded matrices over those with dense ones, otherwise alike; None: there are no such runs."""
    one, other = (
        rows[rows["solver"] == name].set_index(["case", "tol"])["call_s"].astype(float)
        for name in (IDA_C_BANDED, IDA_C_ORDER_2)
    )
    ratios = (one / other).dropna()
    if ratios.empty:
        return None
    least, median, most = np.percentile(ratios, (0, 50, 100)).tolist()
    return {"n": len(ratios), "least": least, "median": median, "most": most}


def known_cases(quick: bool) -> list[Case]:
    return [replace(case, time_limit=TIME_LIMIT) for case in cases.load(quick) if not quick or case.name in QUICK_CASES]


def make(output: Output) -> pd.DataFrame:
    quick = output.call.quick
    with output.kept() as kept:
        made = [at_length(known_cases(quick), quick, kept)]
        made += [rivals.collect(rivals.runs(quick), kept)]
        made += [first_calls.collect(kept, quick), builds.collect(kept, quick), minimal.collect(kept, quick)]
    return calibrated(pd.concat(made, ignore_index=True))


def calibrated(rows: pd.DataFrame) -> pd.DataFrame:
    """Rows with the time of the calibration, which lays those of several processors side by side, as it is now."""
    return rows.assign(calibration=CALIBRATION, calibration_s=calibration_s())


def at_length(known: Sequence[Case], quick: bool, kept: KeptRows, solvers: Sequence[str] = ()) -> pd.DataFrame:
    """The rows of cases over their whole motion; `solvers`: of these alone."""
    made = [run for case in known for run in runs(case, quick) if not solvers or run.solver.name in solvers]
    row = lambda run, repeat, built: row_of(run, repeat, None, built)  # noqa: E731
    return adaptive.collect(made, kept, row, lambda run: True, () if quick else ERRORS)


def part(rows: pd.DataFrame, group: str = GROUP) -> pd.DataFrame:
    """The rows of one group, by default of the four cases, without columns that it has not."""
    return rows[rows["group"] == group].dropna(axis="columns", how="all").reset_index(drop=True)


def measured_on(rows: pd.DataFrame) -> dict[str, Any]:
    """At how many commits, and on which processors, the rows were measured."""
    made = rows.reindex(columns=["processor", "commit"]).dropna().astype(str)
    told: dict[str, Any] = {"commits": made["commit"].nunique(), "processors": sorted(made["processor"].unique())}
    return told | sessions(rows)


def sessions(rows: pd.DataFrame) -> dict[str, Any]:
    """In how many sessions each mechanism was measured, at most, and how unlike the calibrations of these are.

    `speeds`: the largest time of the calibration over the least of a mechanism, in the median and at most.
    """
    known = rows[rows["group"] == rivals.GROUP].reindex(columns=["case", "commit", "calibration_s"])
    by_case = known.dropna(subset=["commit"]).groupby("case")
    most = int(by_case["commit"].nunique().max()) if len(by_case) else 0
    times = known.groupby(["case", "commit"])["calibration_s"].median().groupby("case")
    unlike = (times.max() / times.min()).dropna()
    told = {"sessions": most, "in_angles_apart": _in_angles_apart(rows)}
    return told | ({"speeds": [float(unlike.median()), float(unlike.max())]} if len(unlike) else {})


def _in_angles_apart(rows: pd.DataFrame) -> int:
    """How many mechanisms have ODEs in angles of another commit than ours."""
    made = rows.reindex(columns=["group", "family", "case", "commit"]).drop_duplicates()
    ours = made[(made["group"] == rivals.GROUP) & (made["family"] == "two-loop")].set_index(["case", "commit"])
    in_angles = made[made["group"] == minimal.GROUP].drop_duplicates(["case", "commit"]).set_index(["case", "commit"])
    return int((~in_angles.index.isin(ours.index)).sum())


def with_one_name(rows: pd.DataFrame) -> pd.DataFrame:
    """Rows whose processors are named without their family, where rows from before that was kept lack it."""
    bare = rows["processor"].str.partition(" (family ")[0]
    return rows.assign(processor=bare.where(bare.isin(rows["processor"]), rows["processor"]))


def on_the_same_processor(rows: pd.DataFrame, others: pd.DataFrame) -> pd.DataFrame:
    """The rows of mechanisms that were measured on the processor on which the others were."""
    if "processor" not in rows or "processor" not in others:
        return rows
    return rows[rows["processor"] == rows["case"].map(others.groupby("case")["processor"].first())]


def report(output: Output, rows: pd.DataFrame, line: str) -> dict[str, Any]:
    rows = with_one_name(rows) if "processor" in rows else rows
    everywhere = tables.medians(part(rows, rivals.GROUP))
    known, medians = known_cases(output.call.quick), tables.medians(part(rows).reindex(columns=rows.columns))
    found = rivals.findings_of(everywhere)
    findings = findings_of(medians, known) | {"rivals": found}
    findings["behind"] = behind.findings_of(found["mechanisms"], everywhere)
    findings |= {"violation": violation(medians), "asked": asked(part(rows, rivals.GROUP))}
    findings["banded"] = banded_over_dense(medians)
    findings["versions"], findings["unlike"] = versions(), unlike(pd.concat([medians, everywhere], ignore_index=True))
    findings["first_calls"] = first_calls.findings_of(first_calls.at_error(part(rows, first_calls.GROUP), everywhere))
    findings["builds"] = builds.findings_of(part(rows, builds.GROUP), found["with_code"])
    findings |= {"build_asked": builds.ASKED, "build_processes": builds.PROCESSES}
    findings["unrolled"] = LARGEST_UNROLLED
    in_angles = on_the_same_processor(part(rows, minimal.GROUP), part(rows, rivals.GROUP))
    findings["measured"] = measured_on(rows[rows["group"].isin(SHOWN)])
    findings["repetition"] = {"calls": int(part(rows, rivals.GROUP)["calls"].max()), "below": rivals.TIMED}
    findings["repetition"]["outclassed"] = adaptive.OUTCLASSED
    findings["price"] = headline.price(everywhere, part(rows, first_calls.GROUP), rivals.HEADLINE)
    in_angles = in_angles if in_angles.empty else tables.medians(in_angles)
    findings["minimal"] = minimal.findings_by_kind(in_angles, everywhere)
    findings |= {} if output.call.quick else processors.kept(output, rows, line, found)
    output.save_findings(findings)
    draw(output, findings, everywhere, medians)
    text = render("work_precision", findings, {}, stamp=line, quick=output.call.quick)
    output.write("work_precision.md", text)
    return findings


def unlike(medians: pd.DataFrame) -> dict[str, Any]:
    """How many repetitions were not of the run alone, and of which runs."""
    own = medians[medians["unlike"] > 0]
    named = [f"{run['solver']} on {run['case']} at {tables.setting(run)}" for _, run in own.iterrows()]
    return {"n": int(own["unlike"].sum()), "runs": named, "times": tables.UNLIKE}


def violation(rows: pd.DataFrame) -> float | None:
    """The largest violation of the positions by ours at any stored state of the four-bars."""
    own = rows[(rows["family"] == "two-loop") & rows["case"].isin(rivals.GEOMETRIES)]["violation_q"].dropna()
    return float(own.astype(float).max()) if len(own) else None


def asked(rows: pd.DataFrame) -> dict[str, Any]:
    """How many pairs of rival and mechanism were refused, or not asked for all accuracies, and the rule."""
    others = rows[rows["family"] != "two-loop"]
    pairs = others.groupby(["solver", "case"]).ngroups
    put = [own for _, own in tables.put(others).groupby(["solver", "case"])]
    found: dict[str, Any] = {"n": pairs, "refused": pairs - len(put)}
    found |= {"fewer": sum(not tables.missed(own, 0.0) for own in put), "far": adaptive.FAR, "close": adaptive.CLOSE}
    return found | {"running": adaptive.RUNNING, "limit": rivals.TIME_LIMIT}


def draw(output: Output, findings: dict[str, Any], everywhere: pd.DataFrame, medians: pd.DataFrame) -> None:
    for case in findings["cases"]:
        own = medians[medians["case"] == case["name"]]
        lines = figures.lines_of(own, ERRORS)
        coded = case["name"] in findings["rivals"]["with_code"]
        plot = figures.work_precision(own, lines, f"{case['name']}, {number(case['t_end'])} s", coded=coded)
        figures.save(plot, output, case["figure"].removesuffix(".png"))
    figures.save(rivals.picture(everywhere), output, "work_precision")
    figures.save(rivals.heat_map(findings["rivals"]), output, "work_precision_ratios")


def main(words: Sequence[str] | None = None) -> None:
    study.run_rows("work_precision", __doc__, words, make, report)
