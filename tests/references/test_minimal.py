"""Minimal coordinates: starts, motions and energies are those of the problems, whose kernels they do not share."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from references.minimal import solvers as minimal_solvers
from references.minimal.equations import NoMinimalCoordinates, minimal
from references.paper.four_bar_minimal import MinimalFourBar
from studies.bench.cases.four_bar import SECOND
from twoloop import mechanisms

MAKE = {
    "four-bar": mechanisms.four_bar,
    "pendulum": mechanisms.pendulum,
    "pendulum, right": lambda: mechanisms.pendulum(1.0),
    "projection pendulum": mechanisms.projection_pendulum,
    "double pendulum": mechanisms.double_pendulum,
    "slider-crank": mechanisms.sundials_slider_crank,
    "A02 by tips": mechanisms.n_four_bar,
    "A02 by bodies": lambda: mechanisms.n_four_bar(3, "bodies"),
}
SOLVERS = {
    "heyoka": ("heyoka", lambda *given, **more: minimal_solvers.solve_heyoka_minimal(*given, 1e-11, **more), 1e-12),
    "CyRK, Vern8": (
        "CyRK",
        lambda *given, **more: minimal_solvers.solve_cyrk_minimal(*given, 1e-11, 1e-11, method="Vern8", **more),
        1e-8,
    ),
    "CVODE": (
        "sksundae",
        lambda *given, **more: minimal_solvers.solve_cvode_minimal(*given, 1e-10, 1e-10, **more),
        1e-7,
    ),
}


def motion(problem, t_end):
    own = minimal(problem)
    rates = own.equations(math)
    made = solve_ivp(lambda t, y: rates(y), (0.0, t_end), own.start, "DOP853", rtol=1e-13, atol=1e-14)
    return made.t, *own.states(made.y)


@pytest.mark.parametrize("name", MAKE)
def test_the_motion_is_the_problems(name):
    problem = MAKE[name]()
    t, q, v = motion(problem, problem.reference.t)
    assert np.abs(q[:, 0] - problem.q0).max() < 1e-14 and np.abs(v[:, 0] - problem.v0).max() < 1e-14
    assert np.abs(q[:, -1] - problem.reference.q).max() < 1e-10 and np.abs(v[:, -1] - problem.reference.v).max() < 1e-9
    for k in range(0, t.size, 20):  # on the constraints, by positions and by velocities
        q_k, v_k = np.ascontiguousarray(q[:, k]), np.ascontiguousarray(v[:, k])
        assert np.abs(problem.system.constraint(t[k], q_k)).max() < 1e-13
        assert np.abs(problem.system.jacobian(t[k], q_k) @ v_k).max() < 1e-12
    if problem.conserved:
        energy = problem.energy(t, q, v)
        assert np.ptp(energy) < 1e-9 * max(1.0, np.abs(energy).max())


@pytest.mark.parametrize(
    ("given", "far"),
    [
        ({}, 1e-10),
        (SECOND, 1e-10),
        ({"lengths": (0.5, 2.0, 1.5), "ground": 2.2, "theta3": -0.9}, 1e-9),
        # bars that turn by more than half
        ({"lengths": (1.61, 1.476, 1.41), "ground": 0.585, "theta3": -0.423}, 1e-9),
        ({"lengths": (1.534, 1.25, 0.616), "ground": 1.72, "theta3": -1.72, "branch": 1}, 1e-9),
        ({"lengths": (0.64, 1.4, 0.89), "ground": 1.16, "theta3": -1.27, "branch": 1}, 1e-9),
    ],
)
def test_any_four_bar_with_an_angle_clear_of_its_dead_centres(given, far):
    problem = mechanisms.four_bar(**given)
    t, q, v = motion(problem, 5.0)  # more than two periods
    known = MinimalFourBar.from_parameters(problem.parameters).states(t)
    assert np.abs(q - known[0]).max() < far and np.abs(v - known[1]).max() < 10.0 * far


@pytest.mark.parametrize("name", ["pendulum, right", "double pendulum", "slider-crank", "four-bar", "A02 by bodies"])
def test_a_start_in_motion(name):
    """From a state in the middle of the motion, the same motion goes on."""
    problem = MAKE[name]()
    t, q, v = motion(problem, problem.reference.t)
    middle = t.size // 3
    later = replace(problem, q0=q[:, middle].copy(), v0=v[:, middle].copy())
    assert np.abs(motion(later, problem.reference.t - t[middle])[1][:, -1] - problem.reference.q).max() < 1e-8


@pytest.mark.parametrize("which", SOLVERS)
@pytest.mark.parametrize("name", ["four-bar", "double pendulum", "slider-crank", "pendulum"])
def test_both_solvers_end_at_the_reference(which, name):
    package, solve, far = SOLVERS[which]
    pytest.importorskip(package)
    problem = MAKE[name]()
    times = [0.5 * problem.reference.t, problem.reference.t]
    result = solve(problem, problem.reference.t, t_eval=times)
    assert result.success and result.t.tolist() == times and result.stats.cpu_time > 0.0
    assert np.abs(result.q[:, -1] - problem.reference.q).max() < far
    if problem.reference.lam is not None:
        assert result.lam[:, -1] == pytest.approx(problem.reference.lam, abs=1e3 * far)
    assert np.abs(solve(problem, problem.reference.t, t_eval=times).q - result.q).max() < far


@pytest.mark.parametrize("which", SOLVERS)
def test_no_time_left_is_said(which):
    package, solve, _ = SOLVERS[which]
    pytest.importorskip(package)
    result = solve(mechanisms.sundials_slider_crank(), 1e5, t_eval=[0.0, 0.1], time_limit=1e-9)
    assert not result.success and "time_limit" in result.message


def test_other_mechanisms_are_refused():
    with pytest.raises(NoMinimalCoordinates, match="Andrews"):
        minimal(mechanisms.andrews())
    with pytest.raises(TypeError, match="Problem"):
        minimal_solvers.solve_cvode_minimal(mechanisms.four_bar().system, 1.0)


def test_a_four_bar_all_of_whose_angles_come_to_dead_centres_is_refused():
    with pytest.raises(NoMinimalCoordinates, match="dead centre"):
        minimal(mechanisms.four_bar((0.894, 1.13, 0.659), 2.08, -0.717))


@pytest.mark.parametrize(("beside", "right"), [(0.0, False), (0.01, True)])
def test_heyoka_at_order_8_has_no_last_terms_of_a_pendulum_released_horizontally(beside, right):
    """There the angle has powers 2, 6, 10, ... of t alone, and its rate 1, 5, 9, ...: reports/work_precision.md."""
    heyoka = pytest.importorskip("heyoka")
    angle, rate = heyoka.make_vars("angle", "rate")
    start = [0.5 * math.pi + beside, 0.0]
    integrator = heyoka.taylor_adaptive([(angle, rate), (rate, -9.81 * heyoka.sin(angle))], start, tol=1e-6)
    integrator.propagate_until(10.0)
    known = solve_ivp(lambda t, y: (y[1], -9.81 * math.sin(y[0])), (0.0, 10.0), start, "DOP853", rtol=1e-12, atol=1e-12)
    assert integrator.order == 8 and (float(np.abs(integrator.state - known.y[:, -1]).max()) < 1e-4) is right
