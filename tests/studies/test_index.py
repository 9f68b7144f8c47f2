"""The list of studies, running them all, and the index of the reports."""

import json
import sys

import pytest

from studies import __main__ as command
from studies.bench import study as index
from studies.bench.cli import REPORTS, Call, StudyError
from studies.bench.store import Output


def test_the_list_names_every_study_with_its_first_line(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["studies"])
    command.main()
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == len(index.STUDIES) >= 5
    for name, line in zip(index.STUDIES, lines, strict=True):
        assert line.startswith(f"python -m studies.{name}") and line.endswith(".") and len(line) > 60


def test_unknown_words_are_refused(monkeypatch):
    monkeypatch.setattr(sys, "argv", ["studies", "motoin"])
    with pytest.raises(SystemExit, match="given motoin, which is none of"):
        command.main()


def test_a_failing_study_is_named_and_the_others_run(monkeypatch, capsys):
    ran = []

    class Study:
        def __init__(self, name):
            self.name = name

        def main(self, words):
            ran.append((self.name, words))
            if self.name == "bad":
                raise RuntimeError("broken on purpose")

    def load(name):
        if name == "studies.missing":
            raise ImportError("no such package")
        return Study(name.removeprefix("studies."))

    monkeypatch.setattr(command, "STUDIES", ("good", "bad", "missing", "last"))
    monkeypatch.setattr(index.importlib, "import_module", load)
    monkeypatch.setattr(sys, "argv", ["studies", "all", "--quick"])
    with pytest.raises(SystemExit, match=r"2 of 4 studies failed.*bad, missing") as exit_:
        command.main()
    assert exit_.value.code not in (0, None)
    assert ran == [("good", ["--quick"]), ("bad", ["--quick"]), ("last", ["--quick"])]
    assert "broken on purpose" in capsys.readouterr().err


def test_one_study_runs_by_its_name(monkeypatch):
    ran = []
    monkeypatch.setattr(index.importlib, "import_module", lambda name: type("S", (), {"main": ran.append}))
    monkeypatch.setattr(sys, "argv", ["studies", "table3", "--quick"])
    command.main()
    assert ran == [["--quick"]]


STAMP = "# full crane; `python -m studies.crane`; 2026-11-2{}; commit abc; {}, 2 cores; Linux, Python 3.11.7"


def made(folder, name, answer="It does.", rows="solver\na\n", day=5, machine="AMD EPYC (family 25 model 1)"):
    """Write a report with its findings and rows."""
    (folder / f"{name}.md").write_text("a report")
    (folder / f"{name}.json").write_text(json.dumps({"answer": answer} if answer else {}))
    for each in index.PARTS if name == "reproduction" else (name,):
        (folder / f"{each}.csv").write_text(f"{STAMP.format(day, machine)}\n{rows}")


def written(folder):
    with Output(Call("scale", False, folder, True, "")) as output:
        index.write_index(output)
    return (folder / "README.md").read_text()


def test_the_index_has_a_line_a_report_in_its_order(tmp_path):
    names = list(index.REPORTS)
    for name in reversed(names):
        made(tmp_path, name, f"Answer of {name}.")
    lines = [line for line in written(tmp_path).splitlines() if line.startswith("|[")]
    assert len(lines) == len(names) >= 10
    for name, line in zip(names, lines, strict=True):
        question = index.REPORTS[name]
        cells = [f"[{name}]({name}.md)", question, f"Answer of {name}.", "2026-11-25", "AMD EPYC"]
        assert line == f"|{'|'.join(cells)}|"


def test_what_has_no_answer_is_left_out(tmp_path):
    made(tmp_path, "scale", None)
    made(tmp_path, "energy")
    (tmp_path / "energy.csv").unlink()
    assert "|[" not in written(tmp_path)
    (tmp_path / "scale.json").write_text("{")
    with pytest.raises(StudyError, match=r"scale\.json cannot be read .* python -m studies\.scale again"):
        written(tmp_path)


def test_dates_and_processors_of_several_files_of_rows_are_all_told(tmp_path):
    made(tmp_path, "reproduction")
    made_on = "solver,processor\na,AMD EPYC\nb,Intel(R) Xeon(R) Processor (family 6)\n"
    first = index.PARTS[0]
    (tmp_path / f"{first}.csv").write_text(f"{STAMP.format(8, 'another')}\n{made_on}")
    line = index.line_of(tmp_path, "reproduction")
    assert line["date"] == "2026-11-25 to 2026-11-28" and line["processor"] == "AMD EPYC and Intel Xeon"


def test_every_report_is_of_a_study():
    assert set(index.REPORTS) <= set(index.STUDIES)


def test_the_committed_index_is_that_of_the_committed_reports():
    text, answers = (REPORTS / "README.md").read_text(), 0
    for name in index.REPORTS:
        line = index.line_of(REPORTS, name)
        if line:
            answers += 1
            assert f"|{line['answer']}|{line['date']}|{line['processor']}|" in text, "run a study with --redraw"
            assert len(line["answer"].split()) <= 30, name
    assert answers >= 1
