"""Test Adams: its nodes, the evaluations of a step, and what holds for each method of variable steps."""

import numpy as np
import pytest

from tests.kernels.adaptive import AdaptiveMethod, shared_run
from tests.problems import swing
from twoloop.kernels.steps import adams_step as adams


class TestAdams(AdaptiveMethod):
    method = "Adams"
    tolerances = (1e-4, 1e-6, 1e-8, 1e-10, 1e-12)
    far, gain = 3e2, 0.2
    counter, prices = "n_accepted", ((1e-4, 560), (1e-8, 1480), (1e-12, 2990))
    drift, kept = ((1e-2, 1e-8), (1e-8, 1e-8)), (1e-14, 3e-12)
    pivot_kept = 1e-11


def test_the_nodes_integrate_what_they_must():
    s, w = adams.NODES, adams.WEIGHTS
    for power in range(2 * len(s)):
        assert abs(w @ s**power - 1.0 / (power + 1)) < 1e-15
    np.testing.assert_allclose(adams.POSITION_WEIGHTS, w * (1.0 - s), rtol=1e-15)


@pytest.mark.parametrize("tol", [1e-6, 1e-10])
def test_a_step_is_two_evaluations_and_few_are_refused(tol):
    stats = shared_run("Adams", tol)[0].stats
    attempts = stats.n_accepted + stats.n_rejected_error
    assert stats.n_rejected_error < 0.03 * stats.n_accepted
    # one more where the projection takes a second pass
    assert 2 * stats.n_accepted <= stats.n_evaluations <= 3 * attempts + 1 and stats.n_rejected_convergence == 0


def test_it_says_that_it_cannot_keep_a_constant_step():
    with pytest.raises(ValueError, match=r"method='Adams' .* leave step_size out"):
        swing(method="Adams", step_size=0.01)
