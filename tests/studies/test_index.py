"""The list of studies, running them all, and the index of the reports."""

import json
import sys

import pytest

from studies import __main__ as command
from studies import index
from studies.cli import StudyError


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


def case(**changed):
    """A case as `work_precision` finds it."""
    best = {"solver": "ours", "cpu_s": 0.1, "cpu_q1": 0.1, "cpu_q3": 0.1, "n_evaluations": 100.0, "keeps": True}
    best |= {"called_from": "compiled", "violation_q": 1e-15, "energy": 1e-3}
    at = [{"error": 1e-4, "ours": best, "others": best | {"solver": "theirs", "keeps": False}, "default_over": 2.0}]
    found = {"name": "crane", "tags": ["stiff"], "t_end": 1.0, "floor": 1e-9, "at": at, "figure": "crane.png"}
    found |= {"default_dominated": True, "default_over": [2.0, 3.0], "astray": [], "drift": None, "note": ""}
    return found | changed


def screen(tmp_path, cases, dominated=(), **others):
    found = {"cases": cases, "dominated": list(dominated), "limit": 2.0, "default": "SunRadau5"}
    for name, each in {"work_precision": found, **others}.items():
        (tmp_path / f"{name}.json").write_text(json.dumps(each))
    return index.first_screen(tmp_path, False)


def test_the_first_screen_turns_with_the_findings(tmp_path):
    worse = {"solver": "slow", "by": "ours", "factor": 3.0, "n": 6, "called_from": "Python"}
    text = screen(tmp_path, [case()], [worse])
    assert "| crane (stiff) | 1e-4 | `ours` | 0.10 |" in text and "`theirs` (drifts)" in text
    assert "is never the cheapest of ours: it takes 2.0 to 3.0 times as long" in text
    assert "`slow` (called from Python): `ours` takes at most 1/3.0 of its time" in text
    text = screen(tmp_path, [case(default_dominated=False, default_over=[1.0, 2.0])])
    assert "is the cheapest of ours at one of these errors" in text and "is dominated everywhere" in text
    nothing = [{"error": 1e-4, "ours": None, "others": None, "default_over": None}]
    text = screen(tmp_path, [case(at=nothing, default_dominated=False, default_over=[])])
    assert "reaches none of these errors" in text and "none reaches it" in text


def test_what_the_paper_promised_turns_with_the_findings(tmp_path):
    found = {"newmark_dearer_everywhere": True, "newmark_over_irk": [2.0, 6.0], "one_constant": False}
    found |= {"irk_over": [8.0, 15.0], "newmark_over": [25.0, 30.0]}
    text = screen(tmp_path, [case()], table3=found)
    assert "holds on the linkage at every error compared, by 2.0 to 6.0 times" in text
    assert "do not follow the paper's up to one factor (8.0 to 15 for Runge" in text
    text = screen(tmp_path, [case()], table3=found | {"newmark_dearer_everywhere": False, "one_constant": True})
    assert "does not hold at every error" in text and "times follow the paper's up to one factor" in text


def test_an_empty_folder_says_what_to_run(tmp_path):
    text = index.first_screen(tmp_path, False)
    assert "Not compared here yet: `python -m studies.work_precision`" in text
    assert text.count("not run here") == len(index.STUDIES)


def test_the_readme_changes_between_its_marks_only(tmp_path):
    screen(tmp_path, [case()])
    readme = tmp_path / "README.md"
    readme.write_text("above\n<!-- generated: begin -->\nold\n<!-- generated: end -->\nbelow\n")
    index.put_in_readme(tmp_path, readme)
    text = readme.read_text()
    assert text.startswith("above\n") and text.endswith("\nbelow\n") and "old" not in text
    assert "| crane | 1e-4 | `ours` 0.10 s | `theirs` 0.10 s |" in text
    with pytest.raises(StudyError, match="there is no work_precision"):
        index.put_in_readme(tmp_path / "nowhere", readme)
