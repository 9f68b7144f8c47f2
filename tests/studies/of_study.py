"""What tests of studies share: a report made of made-up rows, and what holds for each quick run."""

import json

import pytest

from studies.bench.cli import Call
from studies.bench.render import render
from studies.bench.store import Output

GOOD = {"status": "REACHED_END", "message": "", "repeat": 0}  # of a row, before medians


def median(solver, error, seconds, **more):
    """A row of the medians of one run, of ours and on the constraints unless it is told otherwise."""
    row = GOOD | {"solver": solver, "family": "two-loop", "called_from": "compiled", "keeps_constraints": True}
    row |= {"error_q": error, "floor": 1e-14, "call_s": seconds, "call_q1": seconds, "call_q3": seconds}
    return row | {"violation_q": 1e-16, "violation_v": 1e-16, "energy": 0.0, "n_evaluations": 1e4} | more


def found_of(study, folder, rows, quick=False):
    """The findings of a module's study, with which the report was written."""
    name = study.STUDY.name
    with Output(Call(name, quick, folder, True, "")) as output:
        study.STUDY.report(output, rows, "stamp")
    return json.loads((folder / f"{name}.json").read_text())


def said(study, rows, quick=False):
    """The findings of a module's study from rows, and the text of its report."""
    found = study.STUDY.findings(rows)
    return found, render(study.STUDY.name, found, {}, stamp="stamp", quick=quick, rows=rows)


class QuickRun:
    """The tests that subclasses inherit, of the quick run of the study of their module, its `STUDIED`."""

    pictures: tuple[str, ...]

    @pytest.mark.usefixtures("unsaved")
    def test_it_is_drawn_again_as_it_was(self, request, out):
        study = request.module.STUDIED.STUDY
        text = (out / f"{study.name}.md").read_text()
        study.main(["--quick", "--out", str(out), "--redraw"])
        assert (out / f"{study.name}.md").read_text() == text
        for name in self.pictures:
            assert all((out / f"{name}.{suffix}").stat().st_size > 10_000 for suffix in ("png", "svg"))
        assert all(series.stat().st_size < 300_000 for series in out.glob("*_series.npz"))
        assert not list(out.glob("*.partial.jsonl"))
