"""Mutants of kernels: what is changed, that a test which sees one is named, and what is counted."""

import ast
from pathlib import Path

import pandas as pd
import pytest

from studies.bench.cli import ROOT
from studies.planted_errors import mutants
from studies.planted_errors.mutants import Mutant, mutants_of

SOURCE = """
NUMBER = 3


def plain(a):
    return a + 1


@kernel
def compiled(a, b):
    if a < b and a != 2.0:
        return a * (b - 1)
    return 0.0
"""


def changes(source=SOURCE):
    return [(mutant.line, mutant.old, mutant.new) for mutant in mutants_of("x", source)]


def test_operators_comparisons_words_and_numbers_of_compiled_functions_are_changed():
    assert sorted(changes()) == sorted(
        [
            *[(11, "<", "<="), (11, "and", "or"), (11, "!=", "=="), (11, "2.0", "4.0")],
            *[(12, "*", "/"), (12, "-", "+"), (12, "1", "2"), (13, "0.0", "1.0")],
        ]
    )


def test_a_mutant_is_one_change_of_one_line():
    for mutant in mutants_of("x", SOURCE):
        made = mutant.applied(SOURCE)
        differ = [(a, b) for a, b in zip(SOURCE.splitlines(), made.splitlines(), strict=True) if a != b]
        assert len(differ) == 1 and ast.dump(ast.parse(made)) != ast.dump(ast.parse(SOURCE))


@pytest.mark.slow
def test_the_sample_is_the_same_every_time_and_of_all_kernels():
    chosen = mutants.sample(False)
    assert chosen == mutants.sample(False)
    assert len({mutant.name for mutant in chosen}) == len(chosen) == mutants.N_EACH * len(mutants.TESTS)
    for kernel, tests in mutants.TESTS.items():
        source = mutants.file_of(ROOT, kernel).read_text()
        for mutant in (each for each in chosen if each.kernel == kernel):
            assert source.splitlines()[mutant.line - 1][mutant.begin : mutant.end] == mutant.old
            ast.parse(mutant.applied(source))
        assert all((ROOT / test).is_file() for test in tests)


@pytest.fixture
def folder(tmp_path):
    path = mutants.file_of(tmp_path, "x")
    path.parent.mkdir(parents=True)
    path.write_text("def f():\n    return 1\n")
    (tmp_path / "test_x.py").write_text(
        "from pathlib import Path\n\n\ndef test_it():\n"
        "    assert 'return 1' in next(Path(__file__).parent.rglob('x_step.py')).read_text()\n"
    )
    return tmp_path


def row(folder, new, monkeypatch):
    monkeypatch.setitem(mutants.TESTS, "x", ("test_x.py",))
    return mutants.row_of(Mutant("x", 2, 11, 12, "1", new, "return 1"), folder)


@pytest.mark.slow
def test_a_mutant_that_is_seen_and_one_that_is_not(folder: Path, monkeypatch):
    assert row(folder, "2", monkeypatch)["seen_by"] == "test_x.py::test_it"
    assert row(folder, "1 ", monkeypatch)["seen_by"] == mutants.NONE
    assert mutants.file_of(folder, "x").read_text() == "def f():\n    return 1\n"


def test_mutants_that_no_test_sees_are_listed_with_the_reason(monkeypatch):
    line = {"kernel": "bdf", "line": 3, "text": "a | b", "old": "1", "new": "2"}
    rows = pd.DataFrame([line | {"seen_by": mutants.NONE}, line | {"seen_by": "test_x.py::test_it"}])
    monkeypatch.setitem(mutants.ARGUED, "bdf | a | b | 1 | 2", "because")
    found = mutants.findings_of(rows)
    assert (found["n"], found["seen"], found["kernels"]) == (2, 1, {"bdf": {"n": 2, "seen": 1}})
    assert [(each["line"], each["why"]) for each in found["survivors"]] == [("3", "because")]
