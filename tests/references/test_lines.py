"""Rivals are found by the place of their files, and stand in the catalogue of the studies."""

import sys

import references
from references import lines as lines_module
from references.lines import Line, lines
from studies.bench.solvers import CATALOGUE, RIVALS

FILE = """
from references.driver import adapter
from references.lines import Line


@adapter(derivatives=False)
def solve(task, rtol=1e-8, atol=1e-8):
    raise NotImplementedError


LINES = (Line("newcomer", "numpy", "numpy", solve),)
"""


def test_names_are_those_of_the_catalogue():
    found = lines()
    names = [line.name for line in found]
    assert len(set(names)) == len(names) > 25 and set(names) <= set(CATALOGUE)
    assert {line.name for line in found if line.rival} <= set(RIVALS) <= set(CATALOGUE)
    for line in found:
        assert CATALOGUE[line.name].keeps_constraints == line.keeps and CATALOGUE[line.name].family == line.family


def test_a_file_in_the_folder_is_enough(tmp_path, monkeypatch):
    (tmp_path / "newcomer.py").write_text(FILE)
    monkeypatch.setattr(lines_module, "__file__", str(tmp_path / "lines.py"))
    monkeypatch.setattr(references, "__path__", [*references.__path__, str(tmp_path)])
    found = lines.__wrapped__()
    monkeypatch.delitem(sys.modules, "references.newcomer")
    assert [line.name for line in found] == ["newcomer"] and isinstance(found[0], Line)
