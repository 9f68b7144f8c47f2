"""Compiled accelerations and multipliers: eq. (6) itself, differenced Q_d, Baumgarte's terms, what is singular."""

import numpy as np
import pytest

from references.accelerations import Equations, accelerations, compiled_gamma
from references.four_bar_minimal import MinimalFourBar
from tests.problems import moving_pivot, moving_pivot_state, oblique_pendulum, oblique_start, pendulum, worst
from twoloop.mechanisms import four_bar


def unbalanced(system, t, q, v, a, lam):
    """Largest residual of M a + C_q^T lam = Q."""
    return worst(system.mass(t, q) @ a + system.jacobian(t, q).T @ lam, system.force(t, q, v))


def test_constant_mass():
    problem = four_bar()
    system = problem.system
    q, v = MinimalFourBar.from_parameters(problem.parameters).states([0.3, 1.7])
    a, lam = accelerations(system, [0.3, 1.7], q, v)
    assert a.shape == (9, 2) and lam.shape == (8, 2)
    for k in range(2):
        assert unbalanced(system, 0.0, q[:, k], v[:, k], a[:, k], lam[:, k]) < 1e-12
        assert worst(system.jacobian(0.0, q[:, k]) @ a[:, k], system.gamma(0.0, q[:, k], v[:, k])) < 1e-12


def test_full_mass_that_varies_and_baumgarte_terms_off_the_constraints():
    system = oblique_pendulum()
    q, v = (np.array(x, dtype=float) for x in oblique_start())
    times, states = np.array([0.0, 0.7]), np.array([[*q, *v], [*(q + 0.2), *(v - 0.3)]]).T
    gamma = compiled_gamma(system)
    for alpha in (0.0, 3.0):
        a, lam = Equations(system, 0.0, q).at_points(times, states, alpha)
        for k, t in enumerate(times):
            q, v = np.split(states[:, k].copy(), 2)
            right = np.zeros(1)
            gamma(t, q, v, system.functions.p, right)
            right -= 2.0 * alpha * system.velocity_constraint(t, q, v) + alpha**2 * system.constraint(t, q)
            assert unbalanced(system, t, q, v, a[:, k], lam[:, k]) < 1e-12
            assert worst(system.jacobian(t, q) @ a[:, k], right) < 1e-12


def test_gamma_is_the_callback_or_differences():
    given, differenced = moving_pivot(), moving_pivot(gamma=False)
    times = np.array([0.2, 1.9])
    q, v = moving_pivot_state(times)
    for k, t in enumerate(times):
        by_differences = np.zeros(1)
        compiled_gamma(differenced)(t, q[:, k].copy(), v[:, k].copy(), differenced.functions.p, by_differences)
        assert worst(by_differences, given.gamma(t, q[:, k], v[:, k])) < 1e-8
    assert compiled_gamma(given) is given.functions.gamma
    for a, b in zip(accelerations(given, times, q, v), accelerations(differenced, times, q, v), strict=True):
        assert worst(a, b) < 1e-8


def test_closures_are_made_once_for_a_set_of_callbacks():
    system = moving_pivot(gamma=False)
    assert compiled_gamma(system) is compiled_gamma(system)
    q = np.array([0.0, -1.0])
    assert Equations(system, 0.0, q).accelerate is Equations(system, 1.0, q).accelerate
    assert Equations(system, 0.0, q).accelerate is not Equations(pendulum(), 0.0, q).accelerate


def test_singular_matrices():
    a, lam = accelerations(pendulum(), [0.0, 0.0], [[0.0, 1.0], [0.0, 0.0]], np.zeros((2, 2)))
    assert np.isnan(a[:, 0]).all() and np.isnan(lam[:, 0]).all()
    assert worst(a[:, 1], [0.0, -9.81]) == 0.0 and lam[0, 1] == 0.0
    with pytest.raises(ValueError, match="mass of 'pendulum' must be positive definite"):
        accelerations(pendulum(mass=lambda t, q: np.diag([1.0, 0.0])), [0.0], [[1.0], [0.0]], np.zeros((2, 1)))


def test_wrong_arguments_are_named():
    with pytest.raises(TypeError, match=r"give problem\.system"):
        accelerations(four_bar(), [0.0], np.zeros((9, 1)), np.zeros((9, 1)))
    with pytest.raises(ValueError, match="a column of 2 for each of the 1 times"):
        accelerations(pendulum(), [0.0], np.zeros(2), np.zeros(2))
    with pytest.raises(TypeError, match="q must be an array of real numbers"):
        accelerations(pendulum(), [0.0], "q", np.zeros((2, 1)))
