"""What is shipped, and with which versions of others."""

import re
import tomllib
import zipfile
from pathlib import Path

import pytest
from hatchling.build import build_wheel

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
    assert {"twoloop/py.typed", "twoloop/__init__.py", "twoloop/kernels/data/common.py"} <= names
    assert {name.split("/")[0] for name in names} == {"twoloop", f"twoloop-{_version()}.dist-info"}
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


def test_the_tools_of_both_test_runs_are_the_same():
    least = {requirement.split(">=")[0] for requirement in PROJECT["dependencies"]}
    tools = {name: version for name, version in pins("requirements-oldest.txt").items() if name not in least}
    locked = pins("requirements.lock")
    assert tools and all(locked[name] == version for name, version in tools.items())
