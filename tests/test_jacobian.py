"""C_q by differences of C, where a system gives none."""

import math

import numpy as np
import pytest

from tests.compiled import PENDULUM, unit_mass, weight
from tests.problems import functions_of, moving_pivot, moving_pivot_state, pendulum, pendulum_state, swing, worst
from twoloop import ConstrainedSystem, callback, solve_dae
from twoloop.mechanisms import four_bar, very_flexible_beam


def without_jacobian(problem):
    system = problem.system
    given = {kind: function for kind, function in system.given.items() if kind not in ("jacobian", "kinematics")}
    return ConstrainedSystem(
        n_q=system.n_q, n_c=system.n_c, **given, parameters=system.parameters, constant_mass=True, name="differenced"
    )


@pytest.mark.parametrize("problem", [four_bar(), very_flexible_beam()], ids=lambda problem: problem.name)
def test_it_agrees_with_the_formula(problem):
    system = without_jacobian(problem)
    for q in problem.q0 + np.random.default_rng(0).normal(size=(10, problem.q0.size)):
        assert worst(system.jacobian(0.3, q), problem.system.jacobian(0.3, q)) < 2e-13


@pytest.mark.parametrize("root", [False, True], ids=["square", "root"])
@pytest.mark.parametrize(
    ("length", "offset"), [(1.0, 0.0), (1e-3, 0.0), (1e-6, 0.0), (1e6, 0.0), (1.0, 3e5), (1e-3, 1e3)]
)
def test_each_coordinate_has_a_displacement_of_its_own(root, length, offset):
    # a pendulum about (offset, 0); with the root its constraint bends on the scale of the length
    def constraint(t, q):
        squares = (q[0] - offset) ** 2 + q[1] ** 2
        return np.array([math.sqrt(squares) - length if root else 0.5 * (squares - length**2)])

    q = np.array([offset + 0.6 * length, 0.8 * length])
    arm = np.array([q[0] - offset, q[1]])
    expected = arm / np.hypot(*arm) if root else arm
    system = pendulum(constraint=constraint, jacobian=None, gamma=False)
    assert worst(system.jacobian(0.0, q), expected) < 5e-11 * np.abs(expected).max()


@pytest.mark.parametrize("angle", [0.0, 1e-3, 1.0, 1e3, 1e5])
def test_angles_of_any_size(angle):
    system = ConstrainedSystem.from_python(
        n_q=1, n_c=1, mass=np.eye(1), force=lambda t, q, v: np.zeros(1), constraint=lambda t, q: np.sin(3.0 * q + 0.3)
    )
    assert worst(system.jacobian(0.0, [angle]), 3.0 * np.cos(3.0 * angle + 0.3)) < 1e-12


def test_its_cost_is_what_the_documentation_says():
    calls = [0]
    original = pendulum()

    def constraint(t, q):
        calls[0] += 1
        return original.constraint(t, q)

    system = pendulum(constraint=constraint, jacobian=None)
    calls[0] = 0
    system.jacobian(0.0, [0.6, -0.8])
    assert calls[0] == 8 * system.n_q
    assert "8 n_q calls of constraint" in ConstrainedSystem.from_python.__doc__.replace("\n            ", " ")


def compiled_pendulum(jacobian):
    return ConstrainedSystem(**PENDULUM | {"jacobian": jacobian})


@pytest.mark.parametrize("make", [pendulum, compiled_pendulum])
def test_a_run_without_jacobian_is_as_good(make):
    result = swing(system=make(jacobian=None), rtol=1e-10, atol=1e-10)
    q, v, lam = pendulum_state(result.t)
    assert result.success and worst(result.q, q) < 1e-8 and worst(result.v, v) < 1e-8 and worst(result.lam, lam) < 1e-6


def test_differences_of_differences_lose_digits_as_documented():
    q, v = moving_pivot_state(0.0)
    full = moving_pivot()
    system = ConstrainedSystem.from_python(n_q=2, n_c=1, **functions_of(full) | {"jacobian": None, "gamma": None})
    runs = [solve_dae(each, (0.0, 0.01), q, v, rtol=1e-9, atol=1e-9) for each in (full, system)]
    assert all(run.success for run in runs) and 1e-13 < worst(runs[0].lam[:, 0], runs[1].lam[:, 0]) < 1e-8


def test_a_constraint_that_goes_out_of_bounds_is_still_found():
    @callback("constraint")
    def constraint(t, q, p, C):
        C[0] = q[0] - q[10**7]

    system = ConstrainedSystem(n_q=2, n_c=1, mass=unit_mass, force=weight, constraint=constraint, name="far")
    with pytest.raises(ValueError, match=r"jacobian of 'far' goes out of bounds.*q\[10\*\*7\]"):
        system.jacobian(0.0, [0.0, 1.0])
