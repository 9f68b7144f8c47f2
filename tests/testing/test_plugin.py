"""Test the plugin of pytest: a test for each problem and property, known failures, reports."""

import os
import subprocess
import sys
from pathlib import Path
from xml.etree import ElementTree

import pytest

from tests.testing.planted import EXAMPLES

ROOT = Path(__file__).parents[2]
QUICK = ["--simulator-steps", "200,400", "--simulator-order", "4"]
FAULTY = """
import numpy as np
def simulate(problem, times, step):
    return np.tile(problem.q0, (times.size, 1))
"""
OWN = """
def test_my_own(reference_motion):
    motion = reference_motion("four_bar")
    assert motion.q.shape == (101, 9) and motion.digits["q"].min() > 12.0
"""


def run_pytest(folder, *arguments):
    """pytest in a folder that knows nothing of this project but its packages."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "PYTEST_ADDOPTS": ""}
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-p", "twoloop.testing.plugin"]
    return subprocess.run(
        [*command, *arguments], env=environment, cwd=folder, capture_output=True, text=True, timeout=300
    )


def test_a_sound_integrator_a_fixture_and_a_report(tmp_path):
    (tmp_path / "test_own.py").write_text(OWN, encoding="utf-8")
    simulator = ["--simulator", f"{EXAMPLES / 'runge_kutta.py'}:simulate", "--simulator-problems", "pendulum"]
    done = run_pytest(tmp_path, *simulator, *QUICK, "--simulator-report", "check.md", "--junitxml", "check.xml", "-v")
    assert done.returncode == 0, done.stdout + done.stderr
    assert "14 passed" in done.stdout
    text = (tmp_path / "check.md").read_text(encoding="utf-8")
    assert text.startswith("# Simulator check: all hold") and "| pendulum | order of q | 3." in text
    cases = ElementTree.parse(tmp_path / "check.xml").iter("testcase")
    told = {case.get("name"): [part.get("name") for part in case.iter("property")] for case in cases}
    assert "measured" in told["order of q"]


@pytest.mark.slow
def test_a_faulty_one_and_known_failures(tmp_path):
    (tmp_path / "still.py").write_text(FAULTY, encoding="utf-8")
    known = "[pytest]\nsimulator_known_failures = out_of_reach: says that it ends\n"
    (tmp_path / "pytest.ini").write_text(known, encoding="utf-8")
    simulator = ["--simulator", "still:simulate", "--simulator-problems", "pendulum,out_of_reach"]
    done = run_pytest(tmp_path, *simulator, *QUICK)
    assert done.returncode == 1 and "pendulum: error of q: 2, allowed 0.3\nNothing moves" in done.stdout
    assert "pendulum: limit of q" not in done.stdout  # the motion is wrong: its limit is not asked for
    assert "1 failed" in done.stdout and "1 xfailed" in done.stdout
    sound = ["--simulator", f"{EXAMPLES / 'runge_kutta.py'}:simulate", "--simulator-problems", "out_of_reach"]
    done = run_pytest(tmp_path, *sound, *QUICK)
    assert done.returncode == 1 and "XPASS(strict)" in done.stdout  # what was known to fail does not


@pytest.mark.slow
def test_one_that_hangs_fails(tmp_path):
    text = "def simulate(problem, times, step):\n    while True:\n        pass\n"
    (tmp_path / "hangs.py").write_text(text, encoding="utf-8")
    simulator = ["--simulator", "hangs.py:simulate", "--simulator-problems", "pendulum,out_of_reach"]
    done = run_pytest(tmp_path, *simulator, *QUICK, "--simulator-time-limit", "0.2")
    assert done.returncode == 1 and "2 failed" in done.stdout
    assert "pendulum: runs: did not end within 0.2 s" in done.stdout
    assert "out_of_reach: says that it ends: did not end within 0.2 s" in done.stdout
