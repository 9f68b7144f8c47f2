"""Newmark: prices of its adaptive steps, by which a wrong prediction, stop or estimate shows."""

import pytest

from tests.problems import run
from twoloop import Newmark

# bounds are about 1.1 times what was counted when they were written
PRICES = {
    ("default_four_bar", 1e-4): (800, 2400),
    ("default_four_bar", 1e-6): (7900, 17_500),
    ("collinear_four_bar", 1e-4): (880, 2700),
    ("collinear_four_bar", 1e-6): (8700, 21_000),
}


@pytest.mark.parametrize(("linkage", "tol"), PRICES)
def test_price_of_five_seconds(linkage, tol, request):
    stats = run(request.getfixturevalue(linkage), 5.0, method="Newmark", rtol=tol, atol=tol).stats
    steps, iterations = PRICES[linkage, tol]
    assert 0.7 * steps < stats.n_accepted < steps
    assert stats.n_outer < iterations
    assert stats.n_rejected_error < 0.05 * stats.n_accepted
    assert stats.n_rejected_convergence == 0


def test_price_with_the_error_tolerance_of_the_paper(default_four_bar):
    stats = run(default_four_bar, 5.0, method=Newmark(error_tol=1e-5)).stats
    assert 500 < stats.n_accepted < 660
    assert stats.n_outer < 2800
