"""Test `auto`: stiffness is found and left, and the choice costs little."""

import numpy as np
import pytest

from tests.compiled import SPRUNG_START, pull, sprung_pair
from tests.marks import slow
from tests.problems import worst
from twoloop import callback, solve_dae
from twoloop.bodies import PlanarModel
from twoloop.mechanisms import four_bar, governor, moderately_stiff_beam
from twoloop.mechanisms.ancf_beam import tip_height


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


def test_stiffness_of_the_governor_is_found_at_once_and_at_a_tight_tolerance():
    """Its fastest rate does not show in its motion; stability would limit explicit steps for 30,000 evaluations."""
    problem = governor()
    start = problem.q0, problem.v0
    one, other = (
        solve_dae(problem.system, (0.0, problem.reference.t), *start, method, 1e-9, 1e-9)
        for method in ("auto", "DOP853")
    )
    assert one.stats.n_jacobians > 5 and one.stats.n_evaluations < 0.1 * other.stats.n_evaluations
    assert worst(one.q[:, -1], other.q[:, -1]) < 1e-7
    result = solve_dae(problem.system, (0.0, problem.reference.t), *start, "auto", 1e-6, 1e-6)
    assert result.success and result.stats.n_evaluations < 2000  # 1530; with 100 explicit steps before: 2700
    short = solve_dae(problem.system, (0.0, 0.01), *start, "auto", 1e-6, 1e-6)
    assert short.success and short.stats.n_jacobians == 0  # there a trial would cost more than the run


def test_what_is_chosen_does_not_depend_on_where_time_begins():
    """A trial that is due at the first look is priced from the start of the run."""
    system, options = sprung_pair(1e6, 2e-3), {"check_derivatives": False, "compiled": False}
    runs = [
        solve_dae(system, (t0, t0 + 0.5), *SPRUNG_START, "auto", 1e-3, 1e-3, **options)
        for t0 in (0.0, -5.0, -0.02, 1000.0)
    ]
    counts = [run.stats.n_jacobians for run in runs]  # t is rounded otherwise, and a few steps with it
    assert min(counts) > 1 and max(counts) - min(counts) < 4


@pytest.mark.parametrize(("tol", "compiled"), [(1e-7, True), slow(1e-3, False)])
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


def creeping(speed, push):
    """A block of 1 kg that is pushed against dry friction of 10 N, regularised by a speed."""
    model = PlanarModel(gravity=(0.0, 0.0))
    block = model.box("block", (0.1, 0.1), mass=1.0, position=(0.0, 0.0))
    model.friction(model.prismatic("ground", block, at=(0.0, 0.0), axis=(1.0, 0.0)), 10.0, speed=speed)
    model.force(block, (0.0, 0.0), np.array([push, 0.0]))
    return model.problem((0.0, 0.5))


@pytest.mark.parametrize(
    ("speed", "push", "tol", "most"),
    [
        (1e-4, 3.0, 1e-7, 10_000),  # a decay limits the series: 117,000 evaluations with series alone
        (1e-5, 1.0, 1e-5, 100_000),  # explicit steps oscillate about the creeping speed: 2 million without a trial
        (1e-3, 1.0, 1e-4, 5_000),  # what moves is within the tolerances: 74,000 without a trial
        slow(1e-4, 1.0, 1e-5, 5_000),
    ],
)
def test_stiffness_of_a_creeping_block_is_found(speed, push, tol, most):
    problem = creeping(speed, push)
    result = solve_dae(problem.system, problem.t_span, problem.q0, problem.v0, "auto", tol, tol)
    assert result.success and result.stats.n_evaluations < most
    assert abs(result.q[0, -1] - 0.5 * speed * np.arctanh(0.1 * push)) < 10.0 * tol  # the closed form
