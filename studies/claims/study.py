"""Which of the paper's claims hold: a verdict and a number for each, computed from the rows of all studies."""

import tomllib
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd

from studies.bench import cli
from studies.bench.cli import StudyError
from studies.bench.index import run_study, write_index
from studies.bench.render import render
from studies.bench.store import Output
from studies.claims import beam_judges, experiments, judges
from studies.claims.rows import STUDIES, Rows, processors, read
from studies.claims.verdicts import Claim, Judgement, Verdict, load

ERRATA = tomllib.loads(Path(__file__).with_name("errata.toml").read_text())
COLUMNS = (  # of a claim, for claims.csv
    *("section", "statement", "criterion", "fixed", "judge"),
    *("stand_in", "inputs", "choice", "assumed"),
)
Judged = Mapping[str, tuple[Claim, Judgement]]
JUDGES: dict[str, Callable[..., Judgement]] = vars(judges) | vars(beam_judges)  # by the names that claims.toml has


def judged(rows: Rows) -> Judged:
    """Every claim with its judgement."""
    return {claim.key: (claim, claim.judgement(JUDGES[claim.judge], rows)) for claim in load()}


def findings_of(pairs: Judged) -> dict[str, Any]:
    """Verdicts and numbers by claim, how many of each verdict, and the places of those that hold by construction.

    What the paper chose, and does not claim, is not counted among its claims.
    """
    circular: dict[str, list[str]] = {}
    for k, (claim, found) in enumerate(pairs.values(), 1):
        if found.verdict is Verdict.CIRCULAR:
            circular.setdefault(claim.circular, []).append(str(k))
    verdicts = [found.verdict for _, found in pairs.values()]
    counted = [(claim, found.verdict) for claim, found in pairs.values() if not claim.choice]
    told: dict[str, Any] = {"n": len(counted), "after": sum(claim.fixed == "after" for claim, _ in counted)}
    told |= {"by_stand_in": sum(bool(claim.stand_in) and verdict is not Verdict.NOT_RUN for claim, verdict in counted)}
    told |= {"judged": sum(verdict is not Verdict.NOT_RUN for _, verdict in counted)}
    told |= {"places": {key: k for k, key in enumerate(pairs, 1)}}
    told |= {"counts": {verdict.value: verdicts.count(verdict) for verdict in Verdict}}
    told |= {"claims": {key: {"verdict": each.verdict.value, **each.values} for key, (_, each) in pairs.items()}}
    return told | {"circular": circular}


def report(output: Output, rows: Rows, line: str) -> dict[str, Any]:
    """Write findings, rows and reports; the findings."""
    pairs, lines = judged(rows), []
    for key, (claim, found) in pairs.items():
        told = {"claim": key, "verdict": found.verdict.value, "number": claim.text(found), "why_not_run": found.why}
        lines.append(told | {name: getattr(claim, name) for name in COLUMNS})
    findings, table = findings_of(pairs) | {"experiments": dict(rows.experiments)}, pd.DataFrame(lines)
    findings["processors"] = processors(output.path)
    output.save_findings(findings)
    output.save_rows(table, line)
    more = {"stamp": line, "quick": output.call.quick}
    for name in ("claims", "claims_that_hold"):
        output.write(f"{name}.md", render(name, findings, {}, lines=table.to_dict("records"), **more))
    output.write("errata.md", render("errata", ERRATA, {}, **more))
    return findings


def _work(words: Sequence[str] | None) -> None:
    call = cli.parse("claims", __doc__, words)
    for name in () if call.redraw else STUDIES:
        if not (call.out / f"{name}.csv").exists():
            run_study(name, ["--quick"] * call.quick + ["--out", str(call.out)])
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
    print(", ".join(f"{n} {verdict}" for verdict, n in findings["counts"].items() if n))
    print(f"wrote claims.md, claims_that_hold.md, claims.csv, .json and errata.md to {output.path}")


def main(words: Sequence[str] | None = None) -> None:
    cli.main(_work, words)
