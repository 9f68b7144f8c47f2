"""Times are floating-point numbers: far from zero, on spans of any length, on motions of any time scale."""

import numpy as np
import pytest

from tests.problems import G, pendulum, pendulum_state, worst
from twoloop import Status, solve_dae

START = ([-1.0, 0.0], [0.0, 0.0])
METHODS = ["SunRadau5", "Gauss12", "RadauIIA5", "Newmark", "BDF", "DOP853", "Adams"]


@pytest.mark.parametrize("method", METHODS)
def test_a_start_at_the_time_of_a_clock_costs_no_digits(method):
    # times near 1.7e9 s have spacings of 2.4e-7 s
    tolerance = 1e-6 if method == "Newmark" else 1e-8
    system, options = pendulum(constant_mass=True), {"method": method, "rtol": tolerance, "atol": tolerance}
    far = solve_dae(system, (1.7e9, 1.7e9 + 2.0), *START, **options)
    near = solve_dae(system, (0.0, 2.0), *START, **options)
    error_far = worst(far.q, pendulum_state(far.t - 1.7e9)[0])
    error_near = worst(near.q, pendulum_state(near.t)[0])
    assert far.t[-1] == 1.7e9 + 2.0
    assert (np.diff(far.t) == far.h).all()  # a step is the difference of two times
    assert error_far < 2.0 * error_near + 1e-9


def test_the_steps_are_differences_of_times_near_zero_too():
    result = solve_dae(pendulum(), (0.0, 3.0), *START, "DOP853")
    assert (np.diff(result.t) == result.h).all()


@pytest.mark.parametrize("end", [1e12, 1e15])
@pytest.mark.parametrize("method", METHODS)
def test_the_step_is_compared_with_the_time_reached_not_with_the_end(method, end):
    result = solve_dae(pendulum(), (0.0, end), *START, method, 1e-6, 1e-6, max_steps=100)
    assert result.status is Status.MAX_STEPS
    assert worst(result.q, pendulum_state(result.t)[0]) < 1e-3


def slow_pendulum(period):
    """A pendulum of 1 m whose gravity makes its time scale that of `period`."""
    return pendulum(force=lambda t, q, v: np.array([0.0, -G / period**2]), constant_mass=True)


@pytest.mark.parametrize("scale", [1e9, 1e3, 1e-3, 1e-6])
@pytest.mark.parametrize("method", METHODS)
def test_the_first_step_follows_the_time_scale_of_the_motion(method, scale):
    result = solve_dae(slow_pendulum(scale), (0.0, scale), *START, method, 1e-5, 1e-5)
    assert result.success, result.message
    assert worst(result.q, pendulum_state(result.t / scale)[0]) < 2e-2
    # the steps of the same motion at a scale of one
    assert result.stats.n_rejected_error + result.stats.n_rejected_convergence < 20
    assert 1e-6 < result.h[0] / scale < 0.1


@pytest.mark.parametrize("beside", [5e-9, 9e-9])
def test_two_output_times_beside_one_point_of_the_grid_do_not_shift_it(beside):
    times = [0.5, 0.5 + beside, 1.0]
    result = solve_dae(pendulum(), (0.0, 1.0), *START, "Gauss6", step_size=0.01, t_eval=times)
    assert (result.t == times).all()
    assert np.delete(result.h, 50) == pytest.approx(0.01, abs=1e-8)
    assert result.h[50] == pytest.approx(beside)


@pytest.mark.parametrize("rtol", [1e-300, 1e-20])
@pytest.mark.parametrize("method", METHODS)
def test_an_absolute_tolerance_alone(method, rtol):
    atol = 1e-5 if method == "Newmark" else 1e-8
    result = solve_dae(pendulum(), (0.0, 1.0), *START, method, rtol=rtol, atol=atol)
    assert result.success, result.message
    assert worst(result.q, pendulum_state(result.t)[0]) < 1e3 * atol


@pytest.mark.parametrize("method", METHODS)
def test_an_absolute_tolerance_for_each_coordinate(method):
    # what x and y may err by is the same; a loose tolerance for both is as loose as one number for all
    tight = solve_dae(pendulum(), (0.0, 1.0), *START, method, 1e-4, np.array([1e-4, 1e-4]))
    same = solve_dae(pendulum(), (0.0, 1.0), *START, method, 1e-4, 1e-4)
    small = 1e-7 if method in ("Newmark", "BDF") else 1e-11  # that asks for more steps of high order, too
    span = (0.0, 1.0 if method in ("Newmark", "BDF", "PaperIRK") else 20.0)  # a hundredth of it is no limit of steps
    mixed = solve_dae(pendulum(), span, *START, method, 1e-9, np.array([1e-3, small]))
    loose = solve_dae(pendulum(), span, *START, method, 1e-9, 1e-3)
    assert (tight.q == same.q).all()
    assert mixed.stats.n_evaluations > loose.stats.n_evaluations
