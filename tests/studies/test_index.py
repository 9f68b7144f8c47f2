"""The list of studies, running them all, and the index of the reports."""

import sys

import pytest

from studies import __main__ as command
from studies import index
from studies.report import parse

LINE = "`python -m studies.x`; 2026-01-01; commit abc; somewhere"


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
    monkeypatch.setattr(command.importlib, "import_module", load)
    monkeypatch.setattr(sys, "argv", ["studies", "all", "--quick"])
    with pytest.raises(SystemExit, match=r"2 of 4 studies failed.*bad, missing") as exit_:
        command.main()
    assert exit_.value.code not in (0, None)
    assert ran == [("good", ["--quick"]), ("bad", ["--quick"]), ("last", ["--quick"])]
    assert "broken on purpose" in capsys.readouterr().err


def test_one_study_runs_by_its_name(monkeypatch):
    ran = []
    monkeypatch.setattr(command.importlib, "import_module", lambda name: type("S", (), {"main": ran.append}))
    monkeypatch.setattr(sys, "argv", ["studies", "table3", "--quick"])
    command.main()
    assert ran == [["--quick"]]


def call(tmp_path):
    return parse("x", "", ["--out", str(tmp_path)], None)


def test_a_study_writes_its_own_section_only(tmp_path):
    index.put_in_index(call(tmp_path), "motion", "The motion.", "![y3](motion_long.png)", LINE)
    index.put_in_index(call(tmp_path), "table3", "The table.", "| a |\n|---|\n| 1 |", LINE)
    first = (tmp_path / "README.md").read_text()
    index.put_in_index(call(tmp_path), "motion", "The motion.", "changed", LINE)
    second = (tmp_path / "README.md").read_text()
    assert "motion_long.png" in first and "motion_long.png" not in second and "changed" in second
    assert first.replace("![y3](motion_long.png)", "changed") == second
    assert second.index("## table3") < second.index("## motion")  # the order of STUDIES
    assert "Not run here yet: `python -m studies.violation`" in second
    assert "Made by `python -m studies.x`, 2026-01-01, commit abc." in second


def test_the_index_is_the_same_when_a_study_is_drawn_again(tmp_path):
    for _ in range(2):
        for name in index.STUDIES:
            index.put_in_index(call(tmp_path), name, "Title.", f"headline of {name}", LINE)
    text = (tmp_path / "README.md").read_text()
    assert text.count("headline of") == len(index.STUDIES) and "Not run" not in text
