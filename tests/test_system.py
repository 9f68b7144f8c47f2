"""ConstrainedSystem and consistent_state."""

import copy

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.problems import moving_pivot, oblique_pendulum, pendulum, pendulum_state, row_errors, worst
from twoloop import ConstrainedSystem, consistent_state, solve_dae
from twoloop.mechanisms import four_bar

numbers = st.floats(-2.0, 2.0)
vectors = st.tuples(numbers, numbers).map(np.array)
SYSTEMS = {"moving pivot": moving_pivot(), "oblique": oblique_pendulum(), "pendulum": pendulum()}


@pytest.mark.parametrize("name", SYSTEMS)
@given(t=numbers, q=vectors, v=vectors)
def test_derivatives_of_the_shared_problems(name, t, q, v):
    by_q, by_t, gamma = row_errors(SYSTEMS[name], t, q, v)
    assert by_q < 1e-8 and by_t < 1e-8 and gamma < 1e-7


def test_a_mass_array_is_constant_and_copied():
    matrix = np.eye(2)
    system = pendulum(mass=matrix)
    matrix[:] = 0.0
    assert system.constant_mass and (system.mass(0.0, np.zeros(2)) == np.eye(2)).all()


def test_a_constant_mass_need_not_be_diagonal():
    full = np.array([[2.0, 0.5], [0.5, 1.0]])
    options = {"step_size": 0.01, "method": "Gauss6"}
    runs = [
        solve_dae(pendulum(mass=mass), (0.0, 1.0), [-1.0, 0.0], [0.0, 0.0], **options)
        for mass in (full, lambda t, q: full)
    ]
    assert worst(runs[0].q, runs[1].q) < 1e-11
    q, a, lam = runs[0].q, runs[0].a, runs[0].lam
    assert worst(full @ a + q * lam, [[0.0], [-9.81]]) < 1e-11


# --- consistent_state
@given(st.lists(st.floats(-0.1, 0.1), min_size=9, max_size=9), st.lists(st.floats(-3, 3), min_size=9, max_size=9))
def test_a_guess_is_projected_and_can_be_started_from(shift, speeds):
    problem = four_bar()
    q, v = consistent_state(problem.system, 0.0, problem.q0 + shift, speeds)
    assert np.abs(problem.system.constraint(0.0, q)).max() < 1e-13
    assert np.abs(problem.system.velocity_constraint(0.0, q, v)).max() < 1e-12 and worst(q, problem.q0) < 1.0
    assert solve_dae(problem.system, (0.0, 0.01), q, v).success


def test_what_cannot_be_projected_says_how_far_it_is():
    empty = pendulum(
        constraint=lambda t, q: np.array([q @ q + 1.0]), jacobian=lambda t, q: 2.0 * q[None, :]
    )  # no real position at all
    with pytest.raises(ValueError, match=r"q cannot be projected.*'pendulum'.*max\|C\| is .*nearer"):
        consistent_state(empty, 0.0, [1.0, 1.0], [0.0, 0.0])


def bead(**changed):
    """A bead of mass p[0] on a circle of radius p[1]."""
    functions = {
        "mass": lambda t, q, p: np.array([[p[0], 0.0], [0.0, p[0]]]),
        "force": lambda t, q, v, p: np.array([0.0, -9.81 * p[0]]),
        "constraint": lambda t, q, p: np.array([0.5 * (q[0] * q[0] + q[1] * q[1] - p[1] * p[1])]),
    }
    return pendulum(**{"gamma": False, "parameters": [2.0, 1.0], **functions, **changed})


@pytest.mark.parametrize("compile", [False, pytest.param(True, marks=pytest.mark.slow)])  # those of ensembles do, too
def test_plain_functions_take_parameters_last(compile):
    system = bead(compile=compile)
    other = system.with_parameters([2.0, 0.5])
    assert system.parameters.tolist() == [2.0, 1.0] and other.parameters.tolist() == [2.0, 0.5]
    for each, radius in ((system, 1.0), (other, 0.5), (copy.deepcopy(other), 0.5)):
        result = solve_dae(each, (0.0, 1.0), [radius, 0.0], [0.0, 0.0], rtol=1e-9, atol=1e-9)
        expected = pendulum_state(np.sqrt(1.0 / radius), angle=0.5 * np.pi)[0]
        assert result.success and np.allclose(result.q[:, -1], radius * expected, atol=1e-7) and result.system is each
    assert other.functions[:3] == system.functions[:3]  # nothing is compiled again


def test_parameters_are_taken_where_they_are_asked_for():
    length = 3.0
    system = bead(
        force=lambda t, q, v, length=length: np.array([0.0, -length])
    )  # an argument with a default is its own
    assert system.force(0.0, [1.0, 0.0], [0.0, 0.0]).tolist() == [0.0, -3.0]
    assert bead(force=lambda *arguments: arguments[-1]).force(0.0, [1.0, 0.0], [0.0, 0.0]).tolist() == [2.0, 1.0]
    with pytest.raises(
        TypeError, match=r"force is called as force\(t, q, v, p\); the function given takes \(p, t, q, v\)"
    ):
        bead(force=lambda p, t, q, v: p)
    with pytest.raises(ValueError, match="parameters are given, but none of the functions"):
        ConstrainedSystem.from_python(n_q=1, n_c=0, mass=np.eye(1), force=lambda t, q, v: -q, parameters=[1.0])


def test_functions_cannot_change_the_parameters():
    def force(t, q, v, p):
        p[0] = 5.0
        return np.array([0.0, -9.81 * p[0]])

    system = bead(force=force)
    assert system.force(0.0, [1.0, 0.0], [0.0, 0.0])[1] == -9.81 * 5.0 and system.mass(0.0, [1.0, 0.0])[0, 0] == 2.0
