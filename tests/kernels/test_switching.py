"""`auto`: which method runs when, that stiffness is found and left, and what the choice costs."""

import numpy as np
import pytest

from tests.compiled import SPRUNG_START, pull, sprung_pair
from tests.problems import worst
from twoloop import callback, solve_dae
from twoloop.bodies import PlanarModel
from twoloop.mechanisms import closed_chain, four_bar, governor, moderately_stiff_beam
from twoloop.mechanisms.ancf_beam import tip_height


@pytest.mark.parametrize("tol", [1e-3, 1e-6, 1e-9])
def test_where_nothing_is_stiff_the_steps_are_those_of_the_explicit_method(tol):
    for problem, explicit in ((four_bar(), "DOP853" if tol >= 1e-6 else "Taylor"), (closed_chain(20), "Taylor")):
        one, other = (
            solve_dae(problem.system, (0.0, 2.0), problem.q0, problem.v0, method, tol, tol)
            for method in ("auto", explicit)
        )
        assert one.stats.n_jacobians < 30  # a trial at most
        assert one.stats.n_evaluations < 1.2 * other.stats.n_evaluations + 50
        assert worst(one.q[:, -1], other.q[:, -1]) < 100 * tol


def test_stiffness_is_found_and_costs_few_evaluations():
    problem = moderately_stiff_beam()
    runs = {
        tol: solve_dae(problem.system, (0.0, 1.0), problem.q0, problem.v0, "auto", tol, tol) for tol in (1e-3, 1e-5)
    }
    explicit = solve_dae(problem.system, (0.0, 0.1), problem.q0, problem.v0, "DOP853", 1e-3, 1e-3)
    for result in runs.values():
        assert result.success and result.stats.n_jacobians > 50
        assert result.stats.n_evaluations < explicit.stats.n_evaluations  # of a tenth of the time
    assert abs(np.subtract(*(tip_height(run.q)[-1] for run in runs.values()))) < 0.05


def test_stiffness_is_found_where_steps_are_shorter_than_stability_asks_for():
    """Of the governor, whose fastest rate does not show in its motion, at a tight tolerance."""
    problem = governor()
    one, other = (
        solve_dae(problem.system, (0.0, problem.reference.t), problem.q0, problem.v0, method, 1e-9, 1e-9)
        for method in ("auto", "DOP853")
    )
    assert one.stats.n_jacobians > 5 and one.stats.n_evaluations < 0.1 * other.stats.n_evaluations
    assert worst(one.q[:, -1], other.q[:, -1]) < 1e-7


@pytest.mark.parametrize(("tol", "most"), [(1e-3, 1000), (1e-6, 2000)])
def test_a_trial_comes_at_once_where_it_costs_little_beside_the_run_to_come(tol, most):
    """Of the governor, whose explicit steps would be limited by stability for 30,000 evaluations."""
    problem = governor()
    result = solve_dae(problem.system, (0.0, problem.reference.t), problem.q0, problem.v0, "auto", tol, tol)
    assert (
        result.success and result.stats.n_evaluations < most
    )  # 670 and 1530; with 100 explicit steps before: 1300, 2700
    short = solve_dae(problem.system, (0.0, 0.01), problem.q0, problem.v0, "auto", tol, tol)
    assert short.success and short.stats.n_jacobians == 0  # there it would cost more than the run


def test_what_is_chosen_does_not_depend_on_where_time_begins():
    """A trial that is due at the first look is priced from the start of the run."""
    system, options = sprung_pair(1e6, 2e-3), {"check_derivatives": False, "compiled": False}
    runs = [
        solve_dae(system, (t0, t0 + 0.5), *SPRUNG_START, "auto", 1e-3, 1e-3, **options)
        for t0 in (0.0, -5.0, -0.02, 1000.0)
    ]
    counts = [run.stats.n_jacobians for run in runs]  # t is rounded otherwise, and a few steps with it
    assert min(counts) > 1 and max(counts) - min(counts) < 4


def test_steps_that_are_explicit_again_are_not_divided_by_newtons_method():
    """As the solution between steps would take longer than the run."""
    problem = moderately_stiff_beam()
    result = solve_dae(problem.system, (0.0, 0.1), problem.q0, problem.v0, "auto", 1e-8, 1e-8, dense_output=True)
    assert result.stats.n_jacobians > 0
    n_divided = sum(len(t) for t, _ in result.sol.interpolator.interiors(result.sol.table))
    assert 0 < n_divided < 0.1 * result.h.size


@pytest.mark.parametrize("compiled", [False, True])
@pytest.mark.parametrize("tol", [1e-3, 1e-7])
def test_no_implicit_method_is_tried_where_nothing_is_stiff(tol, compiled):
    problem = four_bar()
    result = solve_dae(problem.system, (0.0, 40.0), problem.q0, problem.v0, "auto", tol, tol, compiled=compiled)
    assert result.success
    assert result.stats.n_evaluations > 5000  # several looks
    assert result.stats.n_jacobians == 0


@callback("force")
def stiff_for_a_while(t, q, v, p, Q):
    pull(q, v, p[0] if 1.0 < t < 3.0 else 20.0, p[1], Q)


def test_it_goes_both_ways_during_a_run():
    """A damped spring that is stiff between 1 s and 3 s only."""
    system = sprung_pair(1e7, 2e-3, stiff_for_a_while)
    result = solve_dae(system, (0.0, 8.0), *SPRUNG_START, "auto", 1e-5, 1e-5, max_step=0.2, compiled=False)
    assert result.success and result.stats.n_jacobians > 100
    by_time = [np.median(result.h[(result.t[1:] > a) & (result.t[1:] <= b)]) for a, b in ((1.5, 2.9), (5.0, 8.0))]
    assert min(by_time) > 4e-4  # explicit steps of the stiff part are 1.5e-4 at most
    first = np.searchsorted(result.t, 3.5)
    rest = solve_dae(system, (3.5, 8.0), result.q[:, first], result.v[:, first], "DOP853", 1e-9, 1e-9)
    end = (3.5, 8.0), result.q[:, first], result.v[:, first]
    again = solve_dae(system, *end, "auto", 1e-5, 1e-5, compiled=False)
    assert again.stats.n_jacobians < 30
    assert worst(again.q[:, -1], rest.q[:, -1]) < 0.1  # DOP853 alone: 5e-3; 0.005 to 0.03 by rounding


def test_constant_steps_are_those_of_the_symplectic_method():
    problem = four_bar()
    one, other = (
        solve_dae(problem.system, (0.0, 1.0), problem.q0, problem.v0, method, step_size=0.01)
        for method in ("auto", "SunRadau5")
    )
    assert np.array_equal(one.q, other.q)


def creeping(speed, push):
    """A block of 1 kg that is pushed against dry friction of 10 N, regularised by a speed."""
    model = PlanarModel(gravity=(0.0, 0.0))
    block = model.box("block", (0.1, 0.1), mass=1.0, position=(0.0, 0.0))
    model.friction(model.prismatic("ground", block, at=(0.0, 0.0), axis=(1.0, 0.0)), 10.0, speed=speed)
    model.force(block, (0.0, 0.0), np.array([push, 0.0]))
    return model.problem((0.0, 0.5))


@pytest.mark.parametrize(("tol", "compiled"), [(1e-7, True), (1e-8, "auto")])
def test_stiffness_is_found_where_a_decay_limits_a_series(tol, compiled):
    """Series of 14 to 22 terms are stable up to h rho of 0.44 to 0.47 times these."""
    problem = creeping(1e-4, 3.0)
    result = solve_dae(problem.system, problem.t_span, problem.q0, problem.v0, "auto", tol, tol, compiled=compiled)
    assert result.success and result.stats.n_evaluations < 10_000  # 2000; 117,000 with series alone
    assert abs(result.q[0, -1] - 0.5 * 1e-4 * np.arctanh(0.3)) < 1e-8  # of the creeping motion in closed form


@pytest.mark.parametrize("tol", [1e-5, 1e-7])
def test_a_trial_comes_in_long_runs_whatever_the_rates(tol):
    """Explicit steps oscillate about the creeping speed, mostly where the friction is constant."""
    problem = creeping(1e-5, 1.0)
    result = solve_dae(problem.system, problem.t_span, problem.q0, problem.v0, "auto", tol, tol)
    assert result.success and result.stats.n_evaluations < 100_000  # 4500; 2 million without such a trial
    assert abs(result.q[0, -1] - 0.5 * 1e-5 * np.arctanh(0.1)) < tol


@pytest.mark.parametrize(("speed", "tol"), [(1e-4, 1e-5), (1e-3, 1e-4)])
def test_what_creeps_to_within_the_tolerances_is_found_stiff(speed, tol):
    """At the limit of stability accelerations change as fast as they decay, but what they move is too little to see."""
    problem = creeping(speed, 1.0)
    result = solve_dae(problem.system, problem.t_span, problem.q0, problem.v0, "auto", tol, tol)
    assert result.success and result.stats.n_evaluations < 5_000  # over 2 s 360,304 and 73,960 without a trial
    assert abs(result.q[0, -1] - 0.5 * speed * np.arctanh(0.1)) < 10.0 * tol
