"""Every public function and class has an example, which runs and prints what its docstring says."""

import doctest
import importlib
import re
from pathlib import Path

import pytest

from twoloop import mechanisms
from twoloop.methods import tableaux

PAGE = (Path(__file__).parents[1] / "docs" / "reference.md").read_text()
NAMES = [name for name in re.findall(r"^- `(twoloop[\w.]+)`", PAGE, re.MULTILINE)]
NAMES += [f"twoloop.mechanisms.{name}" for name in mechanisms.__all__]
NAMES += [f"twoloop.methods.tableaux.{name}" for name in ("Tableau", "gauss", "radau_iia", "lobatto_iiie")]
OPTIONAL = {"twoloop.symbolic": "sympy", "twoloop.sweep": "pandas", "twoloop.Result": "pandas"}
OPTIONAL["twoloop.audit.audit_mjcf"] = "mujoco"


def public(name):
    """Return the object of a dotted name, a function where a module has its name, too."""
    module, _, last = name.rpartition(".")
    return getattr(importlib.import_module(module), last)


@pytest.mark.parametrize("name", [name for name in dict.fromkeys(NAMES) if public(name) not in (mechanisms, tableaux)])
def test_its_example_prints_what_it_says(name, tmp_path, monkeypatch):
    for start, package in OPTIONAL.items():
        if name.startswith(start):
            pytest.importorskip(package)
    monkeypatch.chdir(tmp_path)
    found = public(name)
    assert "    Examples\n    --------\n" in found.__doc__
    tests = doctest.DocTestFinder(recurse=False).find(found, name, globs={"__name__": "__main__"})
    examples = [example for test in tests for example in test.examples]
    assert examples
    runner = doctest.DocTestRunner(optionflags=doctest.NORMALIZE_WHITESPACE, verbose=False)
    told = []
    for test in tests:
        runner.run(test, out=told.append)
    assert runner.failures == 0, "".join(told)


def test_the_page_lists_what_the_package_exports():
    package = importlib.import_module("twoloop")
    assert {f"twoloop.{name}" for name in package.__all__} <= set(NAMES)
