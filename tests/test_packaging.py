"""What is shipped, with which versions of others, and what is used of numba's private parts."""

import re
import tomllib
import zipfile
from pathlib import Path

import pytest
from hatchling.build import build_wheel
from numba.core.types.functions import BaseFunction, Function
from numba.np import arrayobj

from twoloop.kernels.compile import check_version

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]


def pins(name):
    """Package: version, of a file of exact requirements."""
    lines = (ROOT / name).read_text().splitlines()
    return dict(line.split("==") for line in lines if line and not line.startswith("#"))


def numbers(version):
    return [int(part) for part in re.findall(r"\d+", version)]


def test_the_wheel_says_that_it_is_typed(tmp_path, monkeypatch):
    monkeypatch.chdir(ROOT)
    with zipfile.ZipFile(tmp_path / build_wheel(str(tmp_path))) as wheel:
        names = set(wheel.namelist())
        entry_points = wheel.read(f"twoloop-{_version()}.dist-info/entry_points.txt").decode()
    assert "[pytest11]\ntwoloop.testing.plugin = twoloop.testing.plugin" in entry_points
    assert "twoloop/testing/known_motions.npz" in names
    assert {"twoloop/py.typed", "twoloop/__init__.py", "twoloop/kernels/data/common.py"} <= names
    shipped = {"twoloop", "references", "studies"}
    assert {name.split("/")[0] for name in names} == {*shipped, f"twoloop-{_version()}.dist-info"}
    assert {"twoloop/rows/archive.jsonl.gz", "studies/templates/compare.md.j2"} <= names
    assert not [name for name in names if name.endswith((".nbi", ".nbc", ".pyc"))]


def _version():
    return re.search(r'__version__ = "(.*)"', (ROOT / "twoloop/__init__.py").read_text())[1]


@pytest.mark.parametrize("requirement", PROJECT["dependencies"])
def test_least_versions_are_those_that_are_tested(requirement):
    name, least = requirement.split(",<")[0].split(">=")
    oldest = numbers(pins("requirements-oldest.txt")[name])
    assert oldest[: len(numbers(least))] == numbers(least)
    assert not any(oldest[len(numbers(least)) :])  # 1.24 is 1.24.0
    assert oldest < numbers(pins("requirements.lock")[name])


def test_what_the_makefile_compiles_is_there():
    """While packages are installed, an import that fails would not be seen."""
    text = (ROOT / "Makefile").read_text().replace("\\\n", "")
    found = re.findall(r"from ((?:twoloop|studies)[\w.]*) import ([\w, \t]+)", text)
    names = [f"{package}.{name.strip()}" for package, listed in found for name in listed.split(",")]
    names += re.findall(r"\btests\.[\w.]+", text)
    assert len(names) > 30
    assert [name for name in names if not (ROOT / f"{name.replace('.', '/')}.py").is_file()] == []


# --- private parts of numba: in one folder, of versions that are known, and put back after each compilation
def test_other_versions_of_numba_are_refused_with_what_to_install():
    for known in ("0.61.0", "0.68.1", "0.68.0rc1"):
        check_version(known)
    for unknown in ("0.60.0", "0.69.0", "1.0.0"):
        with pytest.raises(ImportError, match=r"numba .* is installed: pip install 'numba>=0\.61,<0\.69'"):
            check_version(unknown)


def test_numba_is_its_own_after_kernels_were_compiled_or_read():
    from twoloop.kernels import advance

    assert advance.advance.overloads and arrayobj.fix_integer_index.__module__ == "numba.np.arrayobj"
    assert "get_call_type" not in vars(Function) and Function.get_call_type is BaseFunction.get_call_type
