"""Test DOP853 in the two loops: cost, constraints, stability (its numbers: test_tableaux.py; order: test_orders.py)."""

import numpy as np

from tests.kernels.adaptive import AdaptiveMethod, four_bar_run, shared_run
from tests.problems import LINKAGES, pendulum, violations, worst
from twoloop import DOP853, solve_dae
from twoloop.mechanisms import n_four_bar, very_flexible_beam

STAGES = 12
FOUR_BAR = LINKAGES["default"]


class TestDOP853(AdaptiveMethod):
    method = "DOP853"
    far, gain = 1e2, 0.5  # one step more or less halves an error
    more_steps = 1.9  # the estimate is of order 8: two decades of it cost 100^(1/8) = 1.78 times the steps
    prices = ((1e-4, 2050), (1e-6, 3600), (1e-8, 5600), (1e-10, 8500))
    # near where bars come into line multipliers of up to 40 N are off by 5e-8 of that
    drift, kept = ((1e-2, 1e-5), (1e-8, 1e-8)), (1e-14, 1e-13)
    # so long that a hundredth of it, which no step exceeds, is too large
    swing_end, more_after, far_after = 50.0, 1.2, 1e3


def test_a_step_is_twelve_evaluations_and_a_refused_one_eleven():
    for tol in (1e-8, 1e-10):
        stats = shared_run("DOP853", tol)[0].stats
        assert stats.n_rejected_convergence == 0 < stats.n_rejected_error < 0.4 * stats.n_accepted
        least = STAGES * stats.n_accepted + (STAGES - 1) * stats.n_rejected_error + 1
        assert least <= stats.n_evaluations <= least + 2 and stats.n_outer == stats.n_accepted + stats.n_rejected_error


def test_runs_through_singular_positions_err_by_what_an_ode_in_the_angle_does():
    """A02, where errors grow 180-fold: SciPy's DOP853 errs by up to 14,000 tolerances in the angle."""
    problem = n_four_bar(1)
    q0, v0 = problem.motion(0.37)
    q, v = problem.motion(10.37)
    errors = []
    for tol in np.logspace(-4.0, -6.0, 17):
        result = solve_dae(problem.system, (0.37, 10.37), q0, v0, "DOP853", tol, tol)
        if result.success:
            errors.append(max(np.abs(result.q[:, -1] - q).max(), np.abs(result.v[:, -1] - v).max()) / tol)
    assert len(errors) > 8 and sorted(errors)[-2] < 8e3


# --- constraints
def test_a_loose_inner_loop_costs_one_iteration_an_evaluation_and_few_digits():
    # the stages' predictions are so good that one iteration of Newton's method is nearly always enough
    loose, error = four_bar_run(DOP853("restored", inner_tol=1e-2), 1e-6)
    usual, usual_error = four_bar_run(DOP853("restored"), 1e-6)
    assert loose.stats.n_inner < 1.02 * loose.stats.n_evaluations < 0.6 * usual.stats.n_inner
    assert error < 3.0 * usual_error and violations(FOUR_BAR.system, loose)[0] < 1e-12


# --- other methods, other problems
def test_the_very_flexible_beam():
    problem, span = very_flexible_beam(), (0.0, 0.1)
    own = solve_dae(problem.system, span, problem.q0, problem.v0, "DOP853", 1e-8, 1e-8)
    other = solve_dae(problem.system, span, problem.q0, problem.v0, "RadauIIA5", 1e-9, 1e-9)
    assert worst(own.q[:, -1], other.q[:, -1]) < 1e-9
    loose = solve_dae(problem.system, span, problem.q0, problem.v0, "DOP853", 1e-3, 1e-3)
    assert loose.stats.n_evaluations < 2900


# --- stability


def test_step_size_control_stays_below_the_limit_when_nothing_else_asks_for_it():
    """Two masses on one line, x1 = 2 x0, on a spring of frequency w whose other end moves slowly."""
    w = 1000.0
    system = pendulum(
        force=lambda t, q, v: np.array([-5.0 * w * w * (q[0] - np.sin(t)), 0.0]),
        constraint=lambda t, q: np.array([q[1] - 2.0 * q[0]]),
        jacobian=lambda t, q: np.array([[-2.0, 1.0]]),
        gamma=lambda t, q, v: np.zeros(1),
        constant_mass=True,
    )
    result = solve_dae(system, (0.0, 2.0), [0.0, 0.0], [1.0, 2.0], "DOP853", 1e-4, 1e-4)
    assert result.success and worst(result.q[0], np.sin(result.t)) < 1e-3 and 2.5 < w * np.median(result.h) < 6.0
    assert result.stats.n_rejected_error < 0.3 * result.stats.n_accepted
