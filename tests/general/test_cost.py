"""Long chains: links, energy and counts. How programs of elimination grow: tests/kernels/test_factors.py."""

import numpy as np
import pytest

from tests.chains import chain
from twoloop import solve_dae


def run_chain(n, steps=10):
    """A few steps of constant size, far below the shortest period, which is of the order of 1/n."""
    problem, h = chain(n, False), 0.02 / n
    options = {"method": "DOP853", "step_size": h, "check_derivatives": False}
    return solve_dae(problem.system, (0.0, steps * h), problem.q0, problem.v0, **options)


@pytest.mark.parametrize("n", [50, 200])
def test_a_chain_keeps_its_links_and_its_energy(n):
    result = run_chain(n, steps=20)
    assert result.success, result.message
    x, y, v = result.q[0::2], result.q[1::2], result.v
    links = np.hypot(np.diff(x, axis=0, prepend=0.0), np.diff(y, axis=0, prepend=0.0))
    assert np.abs(n * links - 1.0).max() < 1e-11
    assert np.ptp((0.5 * (v * v).sum(axis=0) + 9.81 * y.sum(axis=0)) / n) < 1e-11


def test_as_many_evaluations_whatever_the_length():
    """Same steps, same loops: what is counted does not depend on the length."""
    short, long = run_chain(50).stats, run_chain(200).stats
    assert long.n_evaluations == short.n_evaluations
    assert long.n_factorizations <= 1.1 * short.n_factorizations  # those of a few iterations more
