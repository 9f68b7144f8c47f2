"""A repeated call costs little beside its steps, and what is kept between calls changes nothing."""

import cProfile
import pstats

import numpy as np
import pytest

from tests.problems import pendulum
from twoloop import mechanisms, solve_dae
from twoloop.generate.exact_derivatives import exact_derivatives, generic_states
from twoloop.methods.plans_for import MOST

MANY = 4000  # calls of functions; 2400 of the default


def run(problem, rtol=1e-6, **options):
    return solve_dae(problem.system, (0.0, 1.0), problem.q0, problem.v0, rtol=rtol, atol=rtol, **options)


@pytest.mark.parametrize("options", [{}, {"compiled": True}, {"method": "DOP853"}, {"method": "RadauIIA5"}], ids=str)
def test_a_repeated_call_takes_few_calls_of_functions(options):
    problem = mechanisms.four_bar()
    run(problem, **options)
    profile = cProfile.Profile()
    profile.enable()
    run(problem, **options)
    profile.disable()
    assert pstats.Stats(profile).total_calls < MANY


@pytest.mark.parametrize("method", ["auto", "Taylor", "DOP853", "Adams", "RadauIIA5", "TRBDF2"])
def test_a_second_run_is_the_first_and_leaves_its_dense_output(method):
    problem, t = mechanisms.four_bar(), np.linspace(0.0, 1.0, 50)
    first = run(problem, method=method, dense_output=True)
    between = first.sol(t).q
    run(problem, rtol=1e-4, method=method, dense_output=True).sol(t)
    second = run(problem, method=method, dense_output=True)
    assert np.array_equal(first.q, second.q) and first.stats.n_evaluations == second.stats.n_evaluations
    assert np.array_equal(first.sol(t).q, between) and np.array_equal(second.sol(t).q, between)


def test_plans_are_kept_for_few_tolerances():
    problem = mechanisms.pendulum()
    for k in range(2 * MOST):
        run(problem, rtol=1e-6 * (1.0 + k))
    assert len(problem.system.made["plans"]) == MOST


STATE = (0.3, np.array([0.6, -0.8]), np.array([0.8, 0.6]))


def test_right_derivatives_are_those_of_what_was_traced():
    problem = mechanisms.spatial_slider_crank()
    exact = exact_derivatives(problem.system)
    states = generic_states([(0.0, problem.q0, problem.v0), (0.4, 1.01 * problem.q0, problem.v0)])
    assert exact.wrong(problem.system, states) is None


WRONG = {
    "jacobian": lambda t, q: (q + np.array([1e-4 * t * t, 0.0])).reshape((1, 2)),
    "constraint_rate": lambda t, q: np.array([1e-4 * t * t]),
    "gamma": lambda t, q, v: np.array([-(1.0 + 1e-4 * t * t) * (v[0] * v[0] + v[1] * v[1])]),
}


@pytest.mark.parametrize("kind", list(WRONG))
def test_an_error_that_is_nothing_at_the_start_is_seen_later(kind):
    system = pendulum(**{kind: WRONG[kind]})
    exact = exact_derivatives(system)
    assert exact.wrong(system, generic_states([(0.0, *STATE[1:])])) is None
    assert exact_derivatives(pendulum()).wrong(pendulum(), generic_states([STATE])) is None
    assert f"{kind} of" in exact.wrong(system, generic_states([STATE]))
    result = solve_dae(system, (0.0, 1.0), [0.6, -0.8], [0.0, 0.0], rtol=1e-6, atol=1e-6)
    assert result.status.name == "WRONG_DERIVATIVE" and f"{kind} of" in result.message
