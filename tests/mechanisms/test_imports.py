"""Mechanisms are imported one by one: the first import of a mechanism compiles its callbacks and no others."""

import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest

from twoloop import mechanisms

ROOT = Path(__file__).parents[2]


def imported(statement):
    """Modules of mechanisms after a statement in a new process."""
    source = f"import sys; {statement}; print(*(m for m in sys.modules if m.startswith('twoloop.mechanisms.')))"
    done = subprocess.run([sys.executable, "-c", source], cwd=ROOT, capture_output=True, text=True, check=True)
    return {name.removeprefix("twoloop.mechanisms.") for name in done.stdout.split()}


def test_a_mechanism_imports_no_other():
    assert imported("import twoloop.mechanisms") == set()
    assert imported("from twoloop.mechanisms import four_bar") == {"four_bar", "points", "problem", "rotation"}


def test_names_are_functions_also_after_an_import_of_the_module():
    source = "import twoloop.mechanisms.four_bar; from twoloop.mechanisms import four_bar; assert callable(four_bar)"
    assert "andrews" not in imported(source)
    assert not [name for name in mechanisms.__all__ if isinstance(getattr(mechanisms, name), ModuleType)]
    assert set(mechanisms.__all__) <= set(dir(mechanisms))


def test_unknown_names():
    with pytest.raises(ImportError, match="cannot import name 'five_bar'"):
        from twoloop.mechanisms import five_bar  # noqa: F401
