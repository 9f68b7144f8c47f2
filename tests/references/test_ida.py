"""IDA on any ConstrainedSystem: accuracy against the truth, the forms, failures, time-dependent constraints."""

from functools import cache

import numpy as np
import pytest

from references.paper.four_bar_minimal import MinimalFourBar
from references.sundials.ida import FORMS, solve_ida
from twoloop import ConstrainedSystem, consistent_state, solve_dae
from twoloop.mechanisms import four_bar
from twoloop.run.record import Status

PROBLEMS = {"default": four_bar(), "collinear": four_bar(lengths=(0.8, 1.2, 1.0), ground=2.0)}
TOLERANCES = (1e-5, 1e-7, 1e-9)
# position error at 10 s for these tolerances: three times the largest of 15 runs that differ in rounding, which alone
# moves IDA's error by a factor of 2 to 24
BOUNDS = {
    ("default", "index1"): (5e-2, 1e-3, 1.1e-5),
    ("default", "stabilised"): (8e-3, 1.5e-4, 3e-6),
    ("collinear", "index1"): (4e-1, 2.2e-3, 3.6e-5),
    ("collinear", "stabilised"): (3e-2, 9e-4, 2.3e-5),
}


@cache
def truth(name):
    return MinimalFourBar.from_parameters(PROBLEMS[name].parameters)


def pendulum(force=lambda t, q, v: np.array([0.0, -9.81]), gamma=lambda t, q, v: np.array([-(v @ v)])):
    return ConstrainedSystem.from_python(
        n_q=2,
        n_c=1,
        mass=np.eye(2),
        force=force,
        constraint=lambda t, q: np.array([0.5 * (q @ q - 1.0)]),
        jacobian=lambda t, q: q[None, :],
        gamma=gamma,
        name="pendulum",
    )


def moving_pivot():
    """A pendulum of 1 m and 1 kg whose pivot moves as 0.3 sin 4t along x; its mass matrix is not diagonal."""

    def pivot(t):
        return np.array([0.3 * np.sin(4.0 * t), 0.0])

    def pivot_rate(t):
        return np.array([1.2 * np.cos(4.0 * t), 0.0])

    return ConstrainedSystem.from_python(
        n_q=2,
        n_c=1,
        mass=lambda t, q: np.array([[1.0 + 0.1 * q[1] ** 2, 0.2], [0.2, 1.0]]),
        force=lambda t, q, v: np.array([-0.1 * v[0], -9.81]),
        constraint=lambda t, q: np.array([0.5 * ((q - pivot(t)) @ (q - pivot(t)) - 1.0)]),
        jacobian=lambda t, q: (q - pivot(t))[None, :],
        constraint_rate=lambda t, q: np.array([-(q - pivot(t)) @ pivot_rate(t)]),
        name="moving pivot",
    )


def violations(problem, result):
    system = problem.system
    columns = list(zip(result.t, result.q.T, result.v.T, strict=True))
    return (
        max(np.abs(system.constraint(t, q)).max() for t, q, _ in columns),
        max(np.abs(system.velocity_constraint(t, q, v)).max() for t, q, v in columns),
    )


@pytest.mark.parametrize(("name", "form"), BOUNDS)
def test_agrees_with_the_truth_and_follows_the_tolerance(name, form):
    problem = PROBLEMS[name]
    q, _ = truth(name).states([10.0])
    errors = np.empty((3, 3))
    for i, tolerance in enumerate(TOLERANCES):
        for j in range(3):
            rtol = tolerance * (1.0 + 1e-5 * j)
            result = solve_ida(problem.system, (0.0, 10.0), problem.q0, problem.v0, form, rtol, tolerance)
            assert result.status is Status.REACHED_END and result.t[-1] == 10.0
            errors[i, j] = np.abs(result.q[:, -1] - q[:, 0]).max()
    assert (errors.max(axis=1) < BOUNDS[name, form]).all(), errors
    loose, middle, tight = np.median(errors, axis=1)
    assert loose > 3.0 * middle and middle > 3.0 * tight and loose > 50.0 * tight, errors


def test_stabilised_form_keeps_both_constraints_and_index_1_drifts():
    problem = PROBLEMS["default"]
    kept, drifted = (
        violations(problem, solve_ida(problem.system, (0.0, 10.0), problem.q0, problem.v0, form, 1e-8, 1e-8))
        for form in ("stabilised", "index1")
    )
    assert kept[0] < 1e-7 and kept[1] < 2e-6
    assert drifted[0] > 20.0 * kept[0]


@pytest.mark.parametrize("form", FORMS)
def test_result_has_our_shapes_and_signs(form):
    problem = PROBLEMS["default"]
    result = solve_ida(problem.system, (0.0, 1.0), problem.q0, problem.v0, form, 1e-9, 1e-9)
    n = result.t.size
    assert result.q.shape == result.v.shape == result.a.shape == (9, n) and result.lam.shape == (8, n)
    assert np.array_equal(result.h, np.diff(result.t)) and result.stats.n_accepted == n - 1
    assert result.stats.n_evaluations >= n - 1 and 0 < result.stats.n_factorizations < n
    for k in (0, n // 2, n - 1):
        t, q, v = result.t[k], result.q[:, k], result.v[:, k]
        unbalanced = (
            problem.system.mass(t, q) @ result.a[:, k]
            + problem.system.jacobian(t, q).T @ result.lam[:, k]
            - problem.system.force(t, q, v)
        )
        assert np.abs(unbalanced).max() < 1e-4
    ours = solve_dae(problem.system, (0.0, 1.0), problem.q0, problem.v0, "Gauss6", 1e-10, 1e-10)
    for mine, theirs in ((ours.q, result.q), (ours.v, result.v), (ours.a, result.a), (ours.lam, result.lam)):
        assert np.abs(mine[:, -1] - theirs[:, -1]).max() < 1e-3


@pytest.mark.parametrize("form", FORMS)
def test_moving_pivot_in_plain_python_without_gamma(form):
    system = moving_pivot()
    q0, v0 = consistent_state(system, 0.0, [0.6, -0.8], [0.0, 0.0])
    ours = solve_dae(system, (0.0, 3.0), q0, v0, rtol=1e-10, atol=1e-10)
    loose, tight = (solve_ida(system, (0.0, 3.0), q0, v0, form, tol, tol) for tol in (1e-6, 1e-10))
    errors = [np.abs(run.q[:, -1] - ours.q[:, -1]).max() for run in (loose, tight)]
    assert errors[1] < 1e-6 and errors[0] > 10.0 * errors[1], errors
    for mine, theirs in ((ours.v, tight.v), (ours.a, tight.a), (ours.lam, tight.lam)):
        assert np.abs(mine[:, -1] - theirs[:, -1]).max() < 1e-4


def test_differenced_gamma_gives_the_same_motion():
    given, differenced = (
        solve_ida(pendulum(**kwargs), (0.0, 2.0), [1.0, 0.0], [0.0, 0.0], rtol=1e-9, atol=1e-9)
        for kwargs in ({}, {"gamma": None})
    )
    assert np.abs(given.q[:, -1] - differenced.q[:, -1]).max() < 1e-6
