"""Test motions in minimal coordinates: of the four-bar, of other mechanisms and of the beam."""

import math
from copy import copy
from functools import cache

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from references.minimal import solvers as minimal_solvers
from references.minimal.solvers import NoMinimalCoordinates, minimal
from references.paper.four_bar_minimal import MinimalFourBar
from references.scipy.beam_reduced import reduced_motion
from studies.bench.four_bar import SECOND
from twoloop import mechanisms, solve_dae
from twoloop.mechanisms import four_bar, very_flexible_beam

PROBLEMS = [four_bar(), four_bar(lengths=(0.8, 1.2, 1.0), ground=2.0), four_bar((1.0, 1.2, 0.5), 1.0, math.pi, 1)]
IDS = [problem.name for problem in PROBLEMS]


@cache
def minimal_form(k):
    return MinimalFourBar.from_parameters(PROBLEMS[k].parameters)


@pytest.fixture(params=range(len(PROBLEMS)), ids=IDS)
def case(request):
    return PROBLEMS[request.param], minimal_form(request.param)


def test_published_state_and_period():
    problem, minimal = PROBLEMS[0], minimal_form(0)
    reference = problem.reference
    q, v = minimal.states([reference.t])
    assert np.abs(q[:, 0] - reference.q).max() < 1e-13 and np.abs(v[:, 0] - reference.v).max() < 1e-12
    assert abs(minimal.period - reference.period) < 1e-13


def test_starts_where_the_problem_does(case):
    problem, minimal = case
    q, v = minimal.states([0.0, minimal.period])
    assert np.abs(q - problem.q0[:, None]).max() < 1e-13 and np.abs(v).max() < 1e-12


def test_keeps_energy_and_constraints_for_100_s(case):
    problem, minimal = case
    times = np.linspace(0.0, 100.0, 1001)
    q, v = minimal.states(times)
    assert np.abs(problem.energy(times, q, v) - problem.energy(0.0, problem.q0, problem.v0)).max() < 1e-12
    for k in range(0, times.size, 10):
        assert np.abs(problem.system.constraint(times[k], q[:, k])).max() < 1e-13
        assert np.abs(problem.system.velocity_constraint(times[k], q[:, k], v[:, k])).max() < 1e-13


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
    solution = solve_ivp(lambda t, y: own.rates(math, y), (0.0, t_end), own.start, "DOP853", rtol=1e-13, atol=1e-14)
    return solution.t, *own.states(solution.y)


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
    expected = MinimalFourBar.from_parameters(problem.parameters).states(t)
    assert np.abs(q - expected[0]).max() < far and np.abs(v - expected[1]).max() < 10.0 * far


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


def test_a_four_bar_all_of_whose_angles_come_to_dead_centres_is_refused():
    with pytest.raises(NoMinimalCoordinates, match="dead centre"):
        minimal(mechanisms.four_bar((0.894, 1.13, 0.659), 2.08, -0.717))


TIMES = [0.0, 0.03, 0.05]


@pytest.fixture(scope="module")
def problem():
    return very_flexible_beam()


def test_the_constrained_beam_moves_alike(problem):
    q, v = reduced_motion(problem, TIMES, 1e-11)
    result = solve_dae(problem.system, (0.0, TIMES[-1]), problem.q0, problem.v0, "Gauss12", 1e-11, 1e-11, t_eval=TIMES)
    assert np.abs(result.q - q).max() < 1e-10 and np.abs(result.v - v).max() < 1e-6
    for k, t in enumerate(TIMES):
        assert np.abs(problem.system.constraint(t, q[:, k])).max() < 1e-16


def test_a_start_that_is_not_finite_is_an_error(problem):
    moving = copy(problem)
    object.__setattr__(moving, "v0", np.full(problem.v0.size, np.nan))  # which Problem itself refuses
    with pytest.raises(RuntimeError, match=r"DOP853 .* cannot start: the accelerations are not finite"):
        reduced_motion(moving, TIMES, 1e-8)
