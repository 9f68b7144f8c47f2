"""Runs whose end is the very instant at which the constraints lose rank: velocities there are not determined."""

import warnings

import pytest

from tests.problems import worst
from twoloop import ConstraintWarning, solve_dae
from twoloop.mechanisms import n_four_bar

INSTANTS = {1: 0.7084500088357589, 2: 0.7143555292929623}  # s, by the closed form


@pytest.mark.parametrize("n", INSTANTS)
@pytest.mark.parametrize("method", ["auto", "DOP853", "RadauIIA5"])
@pytest.mark.parametrize("tol", [1e-6, 1e-10])
def test_the_end_is_right_or_the_run_says_so(n, method, tol):
    problem, end = n_four_bar(n), INSTANTS[n]
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always", ConstraintWarning)
        result = solve_dae(problem.system, (0.0, end), problem.q0, problem.v0, method, tol, tol)
    if result.success:
        assert worst(result.q[:, -1], problem.motion(end)[0]) < 1e3 * tol
        assert worst(result.v[:, -1], problem.motion(end)[1]) < 1e3 * tol or len(said) == 1
        assert ("The run ends where the constraints lose rank" in result.message) is bool(said)
    else:
        assert "s ahead: end a little before that position, or beyond." in result.message
