"""Test steps across singular positions: their coefficients, and that runs find across by them."""

import numpy as np
import pytest

from studies.bench.closed_loops import parallelogram, parallelogram_motion
from tests.general.mechanisms import error, mechanism
from tests.marks import slow
from twoloop import solve_dae
from twoloop.kernels.steps import crossing_step
from twoloop.methods.tableaux import gauss

S = crossing_step.S


def test_the_tables_are_exact_for_polynomials():
    tableau = gauss(S)
    options = crossing_step.options_array(tableau.A, tableau.b, tableau.c, 0.0, 0.0)[crossing_step.N_SCALARS :]
    _, twice, legendre = options[: 3 * S * S].reshape(3, S, S)
    _, end_twice, c = options[3 * S * S :].reshape(3, S)
    for degree in range(S - 1):
        values, product = c**degree, (degree + 1) * (degree + 2)
        np.testing.assert_allclose(twice @ values, c ** (degree + 2) / product, rtol=0, atol=1e-13)
        np.testing.assert_allclose(end_twice @ values, 1.0 / product, rtol=0, atol=1e-13)
    for degree in range(S):
        expected = np.zeros(S)
        expected[degree] = 1.0
        series = np.polynomial.legendre.legval(2.0 * c - 1.0, expected)
        np.testing.assert_allclose(legendre @ series, expected, rtol=0, atol=1e-12)


@pytest.mark.parametrize(
    ("n", "options"), [(1, {}), (2, {}), slow(2, {"method": "DOP853"}), slow(2, {"compiled": False})]
)
def test_runs_find_across_at_tight_tolerances(n, options):
    """Three passages in 5 s: rounding stopped steps, or changed velocities by a hundred tolerances in one of them."""
    m = mechanism(f"A02, N = {n}")
    for tolerance in (1e-8, 1e-9, 1e-10, 1e-11):
        result = solve_dae(m.system(), (0.0, 5.0), *m.start, rtol=tolerance, atol=tolerance, **options)
        assert result.success and error(m, result) < 1e3 * tolerance, result.message


@pytest.mark.parametrize("tolerance", [1e-4, 1e-6])
def test_few_steps_lead_across_and_the_method_goes_on_behind(tolerance):
    """Five positions in 2 s. With another method behind the first position, it took 82 steps and 3,900 projections."""
    problem = parallelogram()
    (exact,) = parallelogram_motion(np.array([problem.t_span[1]]))[0].T
    result = solve_dae(problem.system, problem.t_span, problem.q0, problem.v0, rtol=tolerance, atol=tolerance)
    assert result.success and np.abs(result.q[:, -1] - exact).max() < 100.0 * tolerance
    assert len(result.h) < 75 and result.stats.n_inner < 2500
    for end in result.t[-9:-3] + 0.01:  # an earlier run that ended within such a step changed the next one
        np.testing.assert_array_equal(*(solve_dae(problem.system, (0.0, end), problem.q0, problem.v0).t for _ in "ab"))
