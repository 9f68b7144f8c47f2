"""The method that CONTRIBUTING.md writes down as an example is one: its order, its tolerance, its constraints."""

import re
from pathlib import Path

import numpy as np
import pytest

from twoloop import solve_dae
from twoloop.mechanisms import four_bar, pendulum

TEXT = (Path(__file__).parents[1] / "CONTRIBUTING.md").read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def method():
    """An object of the class in the first block of Python under "Add a method"."""
    block = re.search(r"```python\n(.*?)```", TEXT.split("## Add a method")[1], re.DOTALL)[1]
    made = {"__name__": "example"}
    exec(block, made)
    return made["DormandPrince5"]()


def test_its_order_is_five(method):
    problem = pendulum()
    errors = []
    for h in (0.05, 0.025):
        end = solve_dae(problem.system, (0.0, 1.0), problem.q0, problem.v0, method, step_size=h).q[:, -1]
        known = solve_dae(problem.system, (0.0, 1.0), problem.q0, problem.v0, "DOP853", 1e-13, 1e-13).q[:, -1]
        errors.append(np.abs(end - known).max())
    assert 4.5 < np.log2(errors[0] / errors[1]) < 6.5


def test_it_keeps_tolerance_and_constraints(method):
    problem = four_bar()
    result = solve_dae(problem.system, (0.0, 10.0), problem.q0, problem.v0, method, 1e-8, 1e-8)
    assert result.success and result.method == "DormandPrince5"
    assert np.abs(result.q[:, -1] - problem.reference.q).max() < 1e-6
    assert max(np.abs(problem.system.constraint(t, q)).max() for t, q in zip(result.t, result.q.T, strict=True)) < 1e-13


def test_it_takes_fewer_than_a_hundred_and_twenty_lines():
    assert len(re.search(r"```python\n(.*?)```", TEXT.split("## Add a method")[1], re.DOTALL)[1].splitlines()) < 120
