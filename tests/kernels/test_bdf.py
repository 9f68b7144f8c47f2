"""Test BDF with variable step and order: cost, jumps of the force, and the tests of every method."""

import numpy as np
import pytest

from tests.kernels.adaptive import AdaptiveMethod, after_the_jump, four_bar_run, jumping, shared_run
from tests.marks import slow
from tests.problems import pendulum_state, swing, worst
from twoloop import BDF

TOLERANCES = (1e-6, 1e-8, 1e-10)


class TestBDF(AdaptiveMethod):
    method = "BDF"
    far, gain = 3e3, 0.1
    more_steps = 2.4  # the local error is of order 6: two decades of it cost 100^(1/6) = 2.15 times the steps
    partitions = 5
    prices = ((1e-4, 2900), (1e-6, 6100), (1e-8, 13_200))
    drift_end, drift, kept = 10.0, ((1e-4, 1e-8), (1e-8, 1e-8)), (1e-12, 1e-11)
    first_step, more_after, far_after, refused = 0.5, 1.2, 1e3, (0, 20)
    jump_end, jump = 3.0, tuple((tol, 1e3 * tol) for tol in (1e-6, 1e-8, 1e-10))
    pivot_tolerances, pivot_far = TOLERANCES, 1e4
    oblique_tol, oblique_far = 1e-9, (2e-7, 5e-7, 1e-5)


# --- accuracy and price
@pytest.mark.parametrize(("tol", "per_step", "steps"), [(1e-4, 2.8, 1120), (1e-6, 2.4, 2470), (1e-8, 2.2, 5330)])
def test_a_sweep_is_an_evaluation_and_a_step_takes_two_or_three(tol, per_step, steps):
    stats = shared_run("BDF", tol)[0].stats
    assert stats.n_rejected_error + stats.n_rejected_convergence <= 0.01 * stats.n_accepted
    assert stats.n_evaluations < per_step * stats.n_accepted
    assert stats.n_accepted < steps  # a twentieth more than it takes
    assert stats.n_evaluations == stats.n_outer + 1  # one more at the start


def test_every_order_pays():
    counts = [four_bar_run(BDF(order), 1e-6, 3.0)[0].stats.n_accepted for order in range(1, 6)]
    assert counts[0] > 5 * counts[1] > 10 * counts[2] and counts[2] > 1.3 * counts[3] > 1.3 * counts[4]


def test_the_first_step_is_small_enough_for_order_one():
    result = swing(method="BDF", rtol=1e-8, atol=1e-8)
    q, v, _ = pendulum_state(result.t[:20])
    assert worst(result.q[:, :20], q) < 1e-7 and worst(result.v[:, :20], v) < 1e-7
    assert result.h.max() > 100.0 * result.h[:10].min()


# --- other problems
@pytest.mark.parametrize("tol", [1e-6, slow(1e-10)])
def test_after_a_jump_of_the_force_the_order_rises_again(tol):
    result, smooth = swing(3.0, jumping(), method="BDF", rtol=tol, atol=tol), after_the_jump(3.0, "BDF", tol)
    assert result.h[result.t[1:] > 2.0].mean() > 0.8 * smooth.h[smooth.t[1:] > 2.0].mean()
    assert result.h[np.abs(result.t[1:] - 1.0) < 1e-3].min() < 1e-5


@pytest.mark.parametrize("tol", [1e-4, slow(1e-6)])
def test_steps_far_shorter_than_the_tolerance_asks_for_are_no_worse(tol):
    # the prediction alone is within the tolerance then, but a chain of predictions would explode
    _, error = four_bar_run("BDF", tol, 1.0)
    many, many_error = four_bar_run("BDF", tol, 1.0, max_step=1e-4)
    assert many_error < error and many.stats.n_evaluations >= 2 * many.stats.n_accepted
