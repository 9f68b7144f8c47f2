"""`studies.compare` on the mechanism of docs/compare.md, outside the repository."""

import json

import pandas as pd
import pytest

from studies import compare
from studies.bench.cli import ROOT, StudyError
from studies.bench.collector import Case
from studies.bench.render import render
from tests.problems import pendulum, pendulum_state
from tests.studies.of_study import median
from twoloop.mechanisms import Problem
from twoloop.rows import row_format

CODE, SOLVER = (part.split("```")[0] for part in (ROOT / "docs" / "compare.md").read_text().split("```python\n")[1:])
PLAIN = CODE.replace("compile=True", "compile=False")  # machine code takes longer to make than all else here
SOLVERS = ("DOP853 (twoloop)", "Exudyn, GeneralizedAlpha")


@pytest.fixture
def file(tmp_path):
    (tmp_path / "swing.py").write_text(PLAIN)
    (tmp_path / "my_solver.py").write_text(SOLVER)
    return tmp_path / "swing.py"


@pytest.mark.parametrize("code", [PLAIN, pytest.param(CODE, marks=pytest.mark.slow)], ids=["plain", "compiled"])
@pytest.mark.slow
def test_the_page_of_the_docs_runs_outside_the_repository(file, code, monkeypatch):
    file.write_text(code)
    words = ["swing.py:swing", "--quick", "--t-end", "0.512345", "--out", "report", "--errors", "1e-3", "1e-5"]
    monkeypatch.chdir(file.parent)
    compare.main([*words, "--solvers", *SOLVERS, "--solver", "my_solver.py:solve"])
    out = file.parent / "report"
    text, rows = (out / "compare.md").read_text(), pd.read_csv(out / "compare.csv", comment="#")
    assert set(rows["solver"]) == {*SOLVERS, "my_solver.py:solve"} and "NOT_APPLICABLE" in set(rows["status"])
    assert "model of its own" in text and "Quick run" in text and "1e-5" in text
    findings = json.loads((out / "compare.json").read_text())
    assert findings["floor"] < 1e-9 and [at["error"] for at in findings["cheapest"]] == [1e-3, 1e-5]
    assert {"compare.png", "compare.svg"} <= {path.name for path in out.iterdir()}
    monkeypatch.setattr(compare.figures, "save", lambda *arguments: None)  # longer than all else of a report
    monkeypatch.setattr(compare.figures, "work_precision", lambda *arguments, **more: None)
    (out / "compare.md").unlink()
    monkeypatch.chdir(file.parent.parent)
    again = [f"{file}:swing", *words[1:-4], str(out), *words[-3:], "--redraw"]
    again += ["--solver", f"{file.parent}/my_solver.py:solve"]
    compare.main(again)
    assert (out / "compare.md").read_text() == text
    own = row_format.read_rows(out / "compare.jsonl")
    mine = [row for row in own if row["solver"] == "my_solver.py:solve" and row["status"] == "REACHED_END"]
    assert len(mine) == 3 and all(row["calibration_s"] > 0.0 and row["evaluations"] > 0 for row in mine)
    assert mine[-1]["error"] < 1e-5 and "keeps_constraints" not in mine[0] and mine[0]["mechanism"] == "swing"
    elsewhere = file.parent / "elsewhere.jsonl"
    elsewhere.write_text(row_format.format_rows(row | {"processor": "abacus"} for row in own))
    compare.main([*again, "--with", str(elsewhere)])
    assert "swing to 0.512345 s, error 0.001 over the motion, m or rad; abacus" in (out / "compare.md").read_text()
    for words, says in (
        (["--with", "archive"], "archive has no rows of swing to 0.512345 s, but of"),
        (["--with", str(file)], "not in the format of rows"),
        (["--solver", again[-1]], "--solver must name different ones"),
    ):
        with pytest.raises(SystemExit, match=says):
            compare.main([*again, *words])


@pytest.mark.parametrize(
    ("where", "says"),
    [
        ("swing.py", "give FILE.py:FUNCTION"),
        ("missing.py:swing", "there is no file"),
        ("{file}:swong", "has no function swong"),
        ("{file}:np", "has no function np"),
        ("{file}:wrong", "it returned int"),
    ],
)
def test_wrong_mechanisms_are_named(file, where, says):
    file.write_text(PLAIN + "\n\ndef wrong():\n    return 3\n")
    with pytest.raises(StudyError, match=says):
        compare.load_problem(where.format(file=file))


def test_help_names_the_folder_of_its_own_report(capsys):
    with pytest.raises(SystemExit):
        compare.main(["--help"])
    text = " ".join(capsys.readouterr().out.split())
    assert "folder for the report (default: compare)" in text and "one repetition and few settings" in text
    assert "reports/quick" not in text  # a report on a mechanism of one's own goes elsewhere


def test_errors_are_one_line(file, capsys):
    for words, says in (
        ([f"{file}:swing", "--solvers", "Guass12"], "no solver is called 'Guass12'"),
        ([f"{file}:swing", "--t-end", "-1"], "--t-end must be positive"),
        ([f"{file}:swing", "--errors", "0"], "--errors must be positive"),
    ):
        with pytest.raises(SystemExit, match=f"^error: {says}"):
            compare.main(words)


def findings(**rows):
    q, v, _ = pendulum_state(0.0)
    case = Case("swing", Problem("swing", pendulum(), q, v, (0.0, 1.0), lambda t, q, v: 0.0), 1.0)
    lines = [
        median(name, error, cpu, family=family, tol=1e-6, floor=1e-10) for name, (family, error, cpu) in rows.items()
    ]
    return compare.findings_of(pd.DataFrame(lines), case, (1e-4,)) | {"source": "", "published": None}


def text_of(found):
    tables = {"work": "", "kept": "", "failed": "", "beside": ""}
    more = {"middle": 1e-4, "note": "", "drawn": True, "files": [], "n_times": 101}
    return render("compare", found, tables, stamp="", quick=False, **more)


def test_the_sentences_turn_with_the_rows():
    ours, theirs = ("two-loop", 1e-5, 1.0), ("SciPy", 1e-5, 2.0)
    assert "`ours` is cheapest" in text_of(findings(ours=ours, theirs=theirs))
    assert "theirs takes 2.0 times the time of twoloop for an error of 1e-4" in compare.message(
        findings(ours=ours, theirs=theirs)
    )
    assert compare.message(findings(ours=ours)) == "swing, 1.0 s"
    assert "`theirs` (compiled) is cheapest" in text_of(findings(ours=("two-loop", 1e-5, 3.0), theirs=theirs))
    assert "None of the other solvers reaches it" in text_of(findings(ours=ours, theirs=("SciPy", 1e-2, 2.0)))
    assert "No method of twoloop" in text_of(findings(ours=("two-loop", 1e-2, 1.0), theirs=theirs))
    assert "no solver reaches it" in text_of(findings(ours=("two-loop", 1e-2, 1.0)))
    assert "check the problem" in text_of(findings(ours=ours) | {"published": 1e-3})
    assert "check the problem" not in text_of(findings(ours=ours) | {"published": 1e-10})
