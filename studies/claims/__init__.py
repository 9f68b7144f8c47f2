"""What of the paper's claims holds: a verdict and a number for each, computed from the rows of all studies."""

import importlib
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd

from studies import cli
from studies.claims import beam, errata, experiments, introduction, linkage, method
from studies.claims.rows import STUDIES, Rows, read
from studies.claims.verdicts import Claim, Judge, Judgement, Verdict, load
from studies.cli import Call, StudyError
from studies.index import write_index
from studies.render import render, table
from studies.store import Output

JUDGES: dict[str, Judge] = {
    name: each
    for module in (introduction, method, linkage, beam)
    for name, each in vars(module).items()
    if getattr(each, "__module__", "") == module.__name__ and callable(each) and not name.startswith("_")
}
Judged = Mapping[str, tuple[Claim, Judgement]]


def judged(rows: Rows) -> dict[str, tuple[Claim, Judgement]]:
    """Every claim with its judgement."""
    return {claim.key: (claim, claim.judgement(JUDGES, rows)) for claim in load()}


def findings_of(pairs: Judged) -> dict[str, Any]:
    """Verdicts and numbers by claim, and how many of each verdict."""
    circular: dict[str, list[str]] = {}
    for key, (claim, each) in pairs.items():
        if each.verdict is Verdict.CIRCULAR:
            circular.setdefault(claim.circular, []).append(key)
    counts = Counter(found.verdict.value for _, found in pairs.values())
    return {
        "n": len(pairs),
        "counts": {verdict.value: counts[verdict.value] for verdict in Verdict},
        "claims": {key: {"verdict": each.verdict.value, **each.values} for key, (_, each) in pairs.items()},
        "circular": [{"why": why, "claims": keys} for why, keys in circular.items()],
        "not_run": {key: each.why for key, (_, each) in pairs.items() if each.verdict is Verdict.NOT_RUN},
    }


def csv_rows(pairs: Judged) -> pd.DataFrame:
    """One row a claim: verdict, number, criterion, judge."""
    lines = []
    for key, (claim, found) in pairs.items():
        line = {"claim": key, "section": claim.section, "statement": claim.statement, "verdict": found.verdict.value}
        line |= {"number": claim.text(found), "why_not_run": found.why, "criterion": claim.criterion}
        line |= {"fixed": claim.fixed, "judge": claim.judge, "stand_in": claim.stand_in}
        lines.append(line)
    return pd.DataFrame(lines)


def claims_table(pairs: Judged) -> str:
    """The table of the report."""
    lines = []
    for k, (claim, found) in enumerate(pairs.values(), 1):
        name = f"{k}. {claim.statement.removesuffix('.')}{' †' * claim.assumed}"
        judged = found.verdict not in (Verdict.NOT_RUN, Verdict.UNCHECKED)
        lines.append([name, claim.section, claim.text(found), found.verdict.value, claim.fixed if judged else ""])
    return table(["claim", "section", "number", "verdict", "criterion"], lines)


def report(output: Output, rows: Rows, line: str) -> dict[str, Any]:
    """Write findings, rows and both reports; the findings."""
    pairs = judged(rows)
    findings = findings_of(pairs) | {"experiments": dict(rows.experiments)}
    output.save_findings(findings)
    output.save_rows(csv_rows(pairs), line)
    more = {"stamp": line, "quick": output.call.quick}
    output.write("claims.md", render("claims", findings, {"claims": claims_table(pairs)}, **more))
    output.write("errata.md", render("errata", {}, errata.tables(), **more))
    return findings


def _make_missing(call: Call) -> None:
    """Run the studies that have no rows in the folder."""
    for name in STUDIES:
        path: Path = call.out / f"{name}.csv"
        if not path.exists():
            words = [*(["--quick"] if call.quick else []), "--out", str(call.out)]
            importlib.import_module(f"studies.{name}").main(words)


def _work(words: Sequence[str] | None) -> None:
    call = cli.parse("claims", __doc__, words)
    if not call.redraw:
        _make_missing(call)
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
    print(f"wrote claims.md, .csv, .json and errata.md to {output.path}")


def main(words: Sequence[str] | None = None) -> None:
    """Run the study and write its report."""
    cli.main(_work, words)
