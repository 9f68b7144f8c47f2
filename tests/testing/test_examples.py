"""Test the template of docs/examples outside the clone, on the wheel as it is installed, with numpy and pytest only."""

import os
import subprocess
import sysconfig
import venv
import zipfile
from pathlib import Path

import pytest
from hatchling.build import build_wheel

from tests.testing.planted import EXAMPLES

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def python(tmp_path_factory):
    """Of an environment with the wheel, and with what else this one has except numba and SciPy."""
    folder = tmp_path_factory.mktemp("installed")
    here = os.getcwd()
    os.chdir(ROOT)
    try:
        wheel = folder / build_wheel(str(folder))
    finally:
        os.chdir(here)
    venv.create(folder / "env", with_pip=False, symlinks=True)
    paths = {"base": str(folder / "env"), "platbase": str(folder / "env")}
    packages = Path(sysconfig.get_path("purelib", "venv", paths))
    with zipfile.ZipFile(wheel) as file:  # of a wheel of Python alone this is all that installing does
        file.extractall(packages)
    # a folder that a .pth file names is on the path, and its own .pth files, by which the clone is, are not read
    (packages / "others.pth").write_text(f"{sysconfig.get_path('purelib')}\n{sysconfig.get_path('platlib')}\n")
    for name in ("numba", "scipy", "llvmlite"):
        (packages / f"{name}.py").write_text("raise ImportError('not installed here')\n")
    return folder / "env" / "bin" / "python"


def outside(python, folder, *words):
    environment = {name: text for name, text in os.environ.items() if not name.startswith(("PYTHON", "PYTEST"))}
    command = [str(python), *words]
    return subprocess.run(command, env=environment, cwd=folder, capture_output=True, text=True, timeout=600)


@pytest.mark.slow
@pytest.mark.parametrize("smoke", ["redundant_slider_crank", "smoke"])
def test_the_template_runs_on_the_installed_wheel(python, tmp_path, smoke):
    pytest.importorskip("xdist")
    for path in EXAMPLES.glob("*.py"):
        text = path.read_text(encoding="utf-8")
        (tmp_path / path.name).write_text(text.replace('simulate, "smoke"', f'simulate, "{smoke}"'), encoding="utf-8")
    where = outside(python, tmp_path, "-c", "import twoloop; print(twoloop.__file__)").stdout
    assert Path(where.strip()).is_relative_to(python.parents[1])
    checked = ["--simulator", "runge_kutta.py:simulate", "--simulator-problems", "pendulum,out_of_reach"]
    checked += ["--simulator-steps", "100,200", "--simulator-order", "4", "--simulator-report", "check.md"]
    # two processes, to which the wheel's entry point gives the plugin, too
    done = outside(python, tmp_path, "-m", "pytest", "-q", "-n", "2", "--dist", "loadscope", *checked)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "18 passed" in done.stdout, done.stdout  # four suites, and the properties of two problems
    assert (tmp_path / "check.md").read_text(encoding="utf-8").startswith("# Simulator check: all hold")
