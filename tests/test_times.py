"""Times are floating-point numbers: far from zero, on spans of any length, on motions of any time scale."""

import numpy as np
import pytest
from scipy.linalg import null_space

from tests.compiled import pendulum_under
from tests.problems import START, SWING, G, pendulum_state, quick, swing, unconstrained, worst
from twoloop import BDF, DOP853, Newmark, RungeKutta, Status, solve_dae
from twoloop.mechanisms import four_bar
from twoloop.methods.tableaux import gauss

METHODS = ["Adams", "Gauss12", "RadauIIA5", "SunRadau5", "Newmark", "BDF", "DOP853"]


@pytest.mark.parametrize("method", quick(["auto", *METHODS], 3))
def test_a_start_at_the_time_of_a_clock_costs_no_digits(method):
    tolerance = 1e-6 if method == "Newmark" else 1e-8  # times near 1.7e9 s have spacings of 2.4e-7 s
    options = {"method": method, "rtol": tolerance, "atol": tolerance}
    far = solve_dae(SWING, (1.7e9, 1.7e9 + 2.0), *START, dense_output=True, **options)
    near = swing(2.0, **options)
    error_far, error_near = (worst(each.q, pendulum_state(each.t - t0)[0]) for each, t0 in ((far, 1.7e9), (near, 0.0)))
    assert far.t[-1] == 1.7e9 + 2.0
    assert all((np.diff(each.t) == each.h).all() for each in (far, near))  # a step is the difference of two times
    assert error_far < 2.0 * error_near + 0.2 * tolerance
    between = far.t[:-1] + 0.5 * far.h
    assert worst(far.sol(between).q, pendulum_state(between - 1.7e9)[0]) < max(4.0 * error_far, tolerance)
    brief = solve_dae(SWING, (1e3, 1e3 + 1e-6), *START, dense_output=True, first_step=6e-13, **options).sol
    assert np.isfinite(brief(np.nextafter(1e3, 2e3)).q).all()  # in a step of a few spacings of times
    for span in 10.0 ** np.arange(-9.0, -7.0, 0.2):  # the longest step allowed need not end at one of these times
        assert solve_dae(SWING, (0.1, 0.1 + span), *START, **options).success
    soon = 1.7e9 + 2e-5  # 84 spacings of times
    assert solve_dae(SWING, (1.7e9, soon), *START, **options).success
    free = solve_dae(unconstrained(lambda t, q, v: np.array([-G])), (1.7e9, 1.7e9 + 1.0), [0.0], [3.0], **options)
    assert free.success and abs(free.q[0, -1] - (3.0 - 0.5 * G)) < 10.0 * tolerance
    if method != "auto":
        assert (
            "max_step = 1e-07 is at most" in solve_dae(SWING, (1.7e9, soon), *START, max_step=1e-7, **options).message
        )


@pytest.mark.parametrize("end", quick([1e15, 1e12]))
@pytest.mark.parametrize("method", quick(METHODS, 3))
def test_the_step_is_compared_with_the_time_reached_not_with_the_end(method, end):
    result = swing(end, method=method, rtol=1e-6, atol=1e-6, max_steps=100)
    assert result.status is Status.MAX_STEPS and worst(result.q, pendulum_state(result.t)[0]) < 1e-3


@pytest.mark.parametrize("scale", quick([1e9, 1e-6, 1e3, 1e-3], 2))
@pytest.mark.parametrize("method", quick(METHODS, 3))
def test_the_first_step_follows_the_time_scale_of_the_motion(method, scale):
    result = swing(scale, pendulum_under(G / scale**2), method=method, rtol=1e-5, atol=1e-5)
    assert result.success, result.message
    assert worst(result.q, pendulum_state(result.t / scale)[0]) < 2e-2
    # the steps of the same motion at a scale of one
    assert result.stats.n_rejected_error + result.stats.n_rejected_convergence < 20 and 1e-6 < result.h[0] / scale < 0.1


@pytest.mark.parametrize("t0", [1e5, -1e7, 1e9])
@pytest.mark.parametrize("method", quick(["auto", "Taylor", *METHODS], 3))
def test_a_drive_starts_at_zero_far_from_the_time_zero(method, t0):
    """Coordinates that are zero have no scale for a first step, which was shorter than the spacing of times."""
    tolerance = {1e5: 1e-8, -1e7: 1e-6, 1e9: 1e-4}[t0] if method not in ("Newmark", "BDF") else 1e-4
    system = unconstrained(
        lambda t, q, v: np.array([0.0, -4.0 * (q[1] - q[0])]),
        **{"n_q": 2, "n_c": 1},
        constraint=lambda t, q: np.array([q[0] - np.sin(3.0 * (t - t0))]),
        jacobian=lambda t, q: np.array([[1.0, 0.0]]),
        constraint_rate=lambda t, q: np.array([-3.0 * np.cos(3.0 * (t - t0))]),
    )
    options = {"method": method, "rtol": tolerance, "atol": tolerance}
    result = solve_dae(system, (t0, t0 + 5.0), [0.0, 0.0], [3.0, 0.0], **options)
    x = result.t - t0
    assert result.success, result.message
    assert worst(result.q, [np.sin(3.0 * x), 1.2 * np.sin(2.0 * x) - 0.8 * np.sin(3.0 * x)]) < 100.0 * tolerance


@pytest.mark.parametrize("rtol", quick([1e-300, 1e-20]))
@pytest.mark.parametrize("method", quick(METHODS, 3))
def test_an_absolute_tolerance_alone(method, rtol):
    atol = 1e-5 if method == "Newmark" else 1e-8
    result = swing(1.0, method=method, rtol=rtol, atol=atol)
    assert result.success, result.message
    assert worst(result.q, pendulum_state(result.t)[0]) < 1e3 * atol


@pytest.mark.parametrize("method", quick(METHODS, 3))
def test_an_absolute_tolerance_for_each_coordinate(method):
    # what x and y may err by is the same; a loose tolerance for both is as loose as one number for all
    tight, same = (swing(1.0, method=method, rtol=1e-4, atol=atol) for atol in (np.array([1e-4, 1e-4]), 1e-4))
    small = 1e-7 if method in ("Newmark", "BDF") else 1e-11  # that asks for more steps of high order, too
    end = 1.0 if method in ("Newmark", "BDF") else 20.0  # a hundredth of it is no limit of steps
    mixed, loose = (swing(end, method=method, rtol=1e-9, atol=atol) for atol in (np.array([1e-3, small]), 1e-3))
    assert (tight.q == same.q).all() and mixed.stats.n_evaluations > loose.stats.n_evaluations


OBJECTS = [RungeKutta(gauss(3)), Newmark(), BDF(), DOP853()]


@pytest.mark.parametrize("turns", quick([10_000, 0]))
@pytest.mark.parametrize("method", OBJECTS, ids=lambda method: method.name)
def test_fixed_steps_of_a_crank_converge_after_many_turns(method, turns):
    """The rounding of a large angle keeps the sweeps from converging as far as they do near zero."""
    problem = four_bar(lengths=(1.0, 1.2, 0.5), ground=1.0, theta3=np.pi, branch=1)
    direction = null_space(problem.system.jacobian(0.0, problem.q0))[:, 0]
    q0 = problem.q0.copy()
    q0[8] += 2.0 * np.pi * turns
    run = solve_dae(problem.system, (0.0, 1.0), q0, direction / direction[8] * 12.0, method, step_size=2e-3)
    assert run.success, run.message
