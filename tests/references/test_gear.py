"""Test fixed-step BDF on the index-3 form: order, constraints, the start, failures."""

import numpy as np
import pytest

from references.paper.four_bar_minimal import MinimalFourBar
from references.paper.gear import HIGHEST, STARTS, _formulas, solve_gear
from tests.problems import force_residual, violations, worst
from twoloop.mechanisms import four_bar

PROBLEM = four_bar()


def run(t_end, step, order, **options):
    return solve_gear(PROBLEM.system, (0.0, t_end), PROBLEM.q0, PROBLEM.v0, step, order, **options)


def slopes(order, steps, **options):
    """Observed orders of q and v at 0.6 s."""
    q, v = MinimalFourBar.from_parameters(PROBLEM.parameters).states([0.6])
    ends = [run(0.6, step, order, **options) for step in steps]
    errors = np.array([[worst(r.q[:, -1], q[:, 0]), worst(r.v[:, -1], v[:, 0])] for r in ends])
    return np.log(errors[0] / errors[-1]) / np.log(steps[0] / steps[-1])


@pytest.mark.parametrize("order", range(1, HIGHEST + 1))
def test_formulas_are_exact_for_polynomials_of_their_order(order):
    b, alpha, weights = np.split(_formulas()[order - 1], [1, 1 + HIGHEST])
    nodes = -np.arange(1.0, HIGHEST + 1.0)
    for power in range(order + 1):
        at_0, rate_at_0 = float(power == 0), float(power == 1)
        assert b[0] * rate_at_0 + alpha @ nodes**power == pytest.approx(at_0, abs=1e-12)
        if power < order:
            assert weights @ nodes**power == pytest.approx(at_0, abs=1e-12)
    assert not alpha[order:].any() and not weights[order:].any()


@pytest.mark.parametrize("order", [1, 2, 3, 4, 5])
@pytest.mark.slow
def test_order_with_an_accurate_start(order):
    assert np.abs(slopes(order, (4e-3, 2e-3), start="accurate") - order).max() < 0.3


@pytest.mark.parametrize("start", STARTS)
@pytest.mark.parametrize("order", range(1, HIGHEST + 1))
@pytest.mark.slow
def test_positions_keep_the_constraints_and_velocities_nearly(order, start):
    coarse, fine = (run(2.0, step, order, start=start) for step in (0.01, 0.005))
    assert violations(PROBLEM.system, coarse)[0] < 1e-12 and violations(PROBLEM.system, fine)[0] < 1e-12
    before, after = (violations(PROBLEM.system, result)[1] for result in (coarse, fine))
    assert 1e-6 < after < before / 1.5  # asked for by nothing, an error of the formula
    assert force_residual(PROBLEM.system, fine) < 1e-8
