"""Rivals are found by the place of their files, and stand in the catalogue of the studies."""

import sys

import references
from references import lines as lines_module
from references.lines import Line, lines
from studies.bench.solvers import CATALOGUE, OTHER_SOLVERS
from tests.processes import run_python

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
    assert [line.name for line in found if line.compared] == list(OTHER_SOLVERS)
    for line in found:
        assert CATALOGUE[line.name].keeps_constraints == line.keeps and CATALOGUE[line.name].family == line.family


def test_a_file_in_the_folder_is_enough(tmp_path, monkeypatch):
    (tmp_path / "newcomer.py").write_text(FILE)
    monkeypatch.setattr(lines_module, "__file__", str(tmp_path / "lines.py"))
    monkeypatch.setattr(references, "__path__", [*references.__path__, str(tmp_path)])
    found = lines.__wrapped__()
    monkeypatch.delitem(sys.modules, "references.newcomer")
    assert [line.name for line in found] == ["newcomer"] and isinstance(found[0], Line)


def test_a_package_that_is_not_installed_leaves_the_others():
    told = run_python(
        """
        import sys
        for name in ("exudyn", "sksundae", "heyoka", "casadi", "diffrax", "solve_dae", "extensisq", "CyRK"):
            sys.modules[name] = None
        from references.lines import lines
        from references.sundials.ida import solve_ida
        from twoloop.mechanisms import projection_pendulum
        problem = projection_pendulum()
        print(len(lines()))
        try:
            solve_ida(problem.system, (0.0, 1.0), problem.q0, problem.v0)
        except RuntimeError as error:
            print(error)
        """
    )
    said = "scikit-sundae is not installed: pip install 'twoloop[references]'"
    assert told.stdout.splitlines() == [str(len(lines())), said]
