"""Which of the paper's claims hold: a verdict and a number for each, from the rows of the other studies."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import pandas as pd

from studies.bench import cli
from studies.bench.cli import StudyError
from studies.bench.index import run_study, write_index
from studies.bench.render import render
from studies.bench.store import Output
from studies.claims import experiments, judges
from studies.claims.judges import STUDIES, UNTESTABLE, Claim, Judgement, Rows, Verdict, load, read
from studies.reproduction.study import PARTS

COLUMNS = ("section", "statement", "criterion", "fixed", "judge", "stand_in", "inputs", "circular", "assumed")  # of CSV
Judged = Mapping[str, tuple[Claim, Judgement]]
JUDGES: dict[str, Callable[..., Judgement]] = vars(judges)  # by the names that claims.toml has


def judged(rows: Rows) -> Judged:
    """Judge every claim."""
    return {claim.key: (claim, claim.judgement(JUDGES[claim.judge], rows)) for claim in load()}


def findings_of(pairs: Judged) -> dict[str, Any]:
    """Count the verdicts, and tell the answer, verdict and numbers of each claim."""
    verdicts = [found.verdict for _, found in pairs.values()]
    counts = {verdict: verdicts.count(verdict) for verdict in Verdict}
    untestable, n = sum(counts[verdict] for verdict in UNTESTABLE), len(pairs)
    answer = f"Of {n} claims, {counts[Verdict.HOLDS]} hold, {counts[Verdict.PART]} hold in part, "
    answer += f"{counts[Verdict.FAILS]} do not hold, and {untestable} cannot be tested with what the paper's text gives"
    answer += f"; {counts[Verdict.NOT_RUN]} were not judged" * bool(counts[Verdict.NOT_RUN])
    found: dict[str, Any] = {"answer": f"{answer}.", "n": n, "counts": counts, "untestable": untestable}
    found["after"] = sum(claim.fixed == "after" for claim, _ in pairs.values())
    return found | {"claims": {key: {"verdict": each.verdict, **each.values} for key, (_, each) in pairs.items()}}


def report(output: Output, rows: Rows, line: str) -> dict[str, Any]:
    """Write findings, rows and report; return the findings."""
    pairs = judged(rows)
    lines = [
        {"claim": key, "verdict": found.verdict.value, "number": claim.text(found)}
        | {name: getattr(claim, name) for name in COLUMNS}
        for key, (claim, found) in pairs.items()
    ]
    findings = findings_of(pairs) | {"experiments": dict(rows.experiments)}
    findings["procedures"] = experiments.iterations_of_procedures(rows.experiments)
    output.save_findings(findings)
    output.save_rows(pd.DataFrame(lines), line)
    output.write("claims.md", render("claims", findings, {}, lines=lines, stamp=line, quick=output.call.quick))
    return findings


def _work(words: Sequence[str] | None) -> None:
    call = cli.parse("claims", __doc__, words)
    options = ["--quick"] * call.quick + ["--out", str(call.out)]
    missing = [name for name in STUDIES if not (call.redraw or (call.out / f"{name}.csv").exists())]
    if "table3_full" in missing:
        run_study("table3", ["--full", *options])
    if "energy" in missing:
        run_study("energy", options)
    if parts := [name for name in missing if name in PARTS]:
        run_study("reproduction", [*parts, *options])
    with Output(call) as output:
        if call.redraw:
            _, line = output.load_rows()
            made = output.load_findings().get("experiments")
            if not isinstance(made, dict):
                raise StudyError(f"{output.path / 'claims.json'} has no experiments; run python -m studies.claims")
        else:
            made, line = experiments.make(call.quick), cli.stamp(call.command)
        findings = report(output, Rows(read(output.path), made), line)
        write_index(output)
    print(f"{findings['answer']} Wrote claims.md, .csv and .json to {output.path}")


def main(words: Sequence[str] | None = None) -> None:
    cli.main(_work, words)
