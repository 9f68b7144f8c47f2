"""The one-degree-of-freedom truth against the published state, energy conservation and an equation in one angle."""

import math
from functools import cache

import numpy as np
import pytest

from references.paper import four_bar_minimal
from references.paper.four_bar_minimal import MinimalFourBar, trajectory
from twoloop.mechanisms import four_bar

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


def test_velocities_are_the_rates_of_the_positions(case):
    _, minimal = case
    times = np.linspace(0.0, minimal.period, 41)
    e = 1e-3
    far, near = (minimal.states(times + k * e)[0] - minimal.states(times - k * e)[0] for k in (2, 1))
    assert np.abs((8.0 * near - far) / (12.0 * e) - minimal.states(times)[1]).max() < 1e-7


def test_folds_times_of_any_sign_and_order():
    minimal = minimal_form(1)
    times = np.array([40.0, 0.3, -0.3, 7.0])
    q, v = minimal.states(times)
    assert np.allclose(q[:, 1], q[:, 2], atol=1e-15) and np.allclose(v[:, 1], -v[:, 2], atol=1e-15)
    again = trajectory(PROBLEMS[1].parameters, times + 3 * minimal.period)
    assert np.abs(q - again[0]).max() < 1e-12 and np.abs(v - again[1]).max() < 1e-11


def test_second_geometry_passes_positions_where_bars_are_in_line():
    q, _ = minimal_form(1).states(np.linspace(0.0, 1.0, 1001))
    bend = np.sin(q[5] - q[2])
    assert bend.min() < 0.0 < bend.max()


@pytest.mark.parametrize(
    ("changed", "error", "words"),
    [
        ({"lengths": (1.0, 2.0)}, ValueError, "lengths must have shape"),
        ({"lengths": (1.0, -2.0, 1.5)}, ValueError, "lengths must be positive"),
        ({"lengths": (1.0, np.nan, 1.5)}, ValueError, "lengths must be finite"),
        ({"ground": 0.0}, ValueError, "ground must be positive"),
        ({"density": 0.0}, ValueError, "density must be positive"),
        ({"theta3": np.nan}, ValueError, "theta3 must be finite"),
        ({"gravity": np.inf}, ValueError, "gravity must be finite"),
        ({"gravity": "9.81"}, TypeError, "gravity must be a number"),
        ({"branch": 0}, ValueError, "branch must be 1 or -1; given 0"),
        ({"lengths": (1.0, 1.0, 1.0), "ground": 4.0}, ValueError, "cannot reach joint 2-3"),
        ({"gravity": 0.0}, ValueError, "equilibrium"),
        ({"gravity": 1e200}, ValueError, "equation of motion cannot be integrated: Required step size"),
        ({"gravity": 1e-6}, ValueError, "does not come to rest within 1000 s"),
    ],
)
def test_wrong_arguments_are_named(changed, error, words):
    given = {"lengths": (1.0, 2.0, 1.5), "ground": 3.0, "theta3": 0.0, "branch": -1, "density": 1.0, "gravity": 9.81}
    with np.errstate(all="ignore"), pytest.raises(error, match=words):
        MinimalFourBar(**{**given, **changed})


def test_the_search_for_the_period_and_the_integration_end(monkeypatch):
    for most in (100, 2000):  # the search takes fewer than 2000, the integration more
        monkeypatch.setattr(four_bar_minimal, "MOST_EVALUATIONS", most)
        four_bar_minimal._linkage.cache_clear()
        with pytest.raises(ValueError, match=f"not come to rest after {most} evaluations"):
            MinimalFourBar.from_parameters(PROBLEMS[0].parameters)


def test_an_equation_of_motion_that_is_not_finite_is_an_error(monkeypatch):
    form = minimal_form(0)
    monkeypatch.setattr(four_bar_minimal, "_rate", lambda *_: np.full(4, np.nan))
    rate = four_bar_minimal._counted(form.rate)
    with pytest.raises(ValueError, match=r"gives values that are not finite at t = 0\.5 s"):
        rate(0.5, np.array([0.1, 0.2, 0.3, 1.0]))
