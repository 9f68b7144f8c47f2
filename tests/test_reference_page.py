"""The reference has an entry for all that a user can import."""

import re
from pathlib import Path

import pytest

import twoloop
from twoloop.methods.presets import PRESETS

TEXT = (Path(__file__).parents[1] / "docs" / "reference.md").read_text(encoding="utf-8")
ENTRIES = set(re.findall(r"^\.\. auto(?:class|function|exception):: (\S+)", TEXT, re.MULTILINE))


@pytest.mark.parametrize("name", twoloop.__all__)
def test_every_name_of_the_package_has_an_entry(name):
    assert f"twoloop.{name}" in ENTRIES


def test_so_has_every_name_of_its_symbolic_part():
    symbolic = pytest.importorskip("twoloop.symbolic", exc_type=ImportError)
    assert {f"twoloop.symbolic.{name}" for name in symbolic.__all__} <= ENTRIES


def test_so_has_every_method_that_a_name_stands_for():
    kinds = {type(method).__qualname__ for method in PRESETS.values()}
    assert kinds <= {entry.rpartition(".")[2] for entry in ENTRIES}
