"""Test mechanisms whose rows depend on one another with solvers that need independent rows."""

import numpy as np
import pytest

from references.equations.rows import independent_rows
from references.scipy.index1 import solve_index1
from tests.problems import held_twice, pendulum
from tests.references.adapters import ADAPTERS
from twoloop.mechanisms import bricard, redundant_slider_crank


@pytest.mark.slow
@pytest.mark.parametrize("name", ["DOP853, projected", "IDA from C, stabilised", "CVODE, Adams", "IDA, stabilised"])
def test_motion_and_multipliers_of_all_rows_are_those_of_the_reference(name):
    problem = redundant_slider_crank()
    known = problem.reference
    result = ADAPTERS[name](problem.system, (0.0, known.t), problem.q0, problem.v0, tol=1e-8)
    assert result.success and result.lam.shape == (problem.system.n_c, result.t.size)
    assert np.abs(result.q[:, -1] - known.q).max() < 1e-4
    assert np.abs(result.lam[:, -1] - known.lam).max() < 1e-3 * np.abs(known.lam).max()


@pytest.mark.slow
@pytest.mark.parametrize("name", ["DOP853, projected", "IDA from C, stabilised"])  # 238 unknowns: numpy frees arrays
def test_rows_that_are_redundant_by_geometry_are_found_at_the_start(name):
    problem = bricard()
    assert len(independent_rows(problem.system.jacobian(0.0, problem.q0))) == 59
    result = ADAPTERS[name](problem.system, (0.0, 0.1), problem.q0, problem.v0, tol=1e-8)
    assert result.success and np.abs(problem.system.constraint(0.1, result.q[:, -1])).max() < 1e-7


def test_the_rows_that_are_kept_span_all():
    some = np.random.default_rng(1).standard_normal((3, 6))
    rows = np.stack([some[0], 2.0 * some[0], some[1], some[0] - some[1], np.zeros(6), some[2]])
    assert independent_rows(rows) == (0, 2, 5)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["DOP853, projected", "IDA, stabilised"])
def test_rows_that_contradict_one_another_now_or_later_are_no_success(name):
    start = (0.0, 1.0), [1.0, 0.0], [0.0, 0.0]
    now = held_twice(constraint=lambda t, q: 0.5 * (q @ q - np.array([1.0, 1.1])), name="held twice")
    with pytest.raises(ValueError, match=r"q0 must satisfy all constraints of 'held twice': row\(s\) \[1\]"):
        ADAPTERS[name](now, *start)
    later = held_twice(
        constraint=lambda t, q: 0.5 * (q @ q - np.array([1.0, 1.0 + 0.1 * t * t])),
        constraint_rate=lambda t, q: np.array([0.0, -0.1 * t]),
        gamma=False,
    )
    result = ADAPTERS[name](later, *start)
    assert not result.success and "Row(s) [1] of C_q follow from others at t = 0, were left out" in result.message
    assert result.t[-1] == 1.0 and result.lam.shape == (2, result.t.size)  # what it has is kept


@pytest.mark.slow
def test_rows_that_part_at_a_position_where_rank_is_lost_only_for_a_moment_are_no_success():
    # the second row holds y at 0, where its gradient is that of the first
    system = pendulum(
        n_c=2,
        constraint=lambda t, q: np.array([q[0] - 1.0, (q[0] - 1.0) + q[1] ** 2]),
        jacobian=lambda t, q: np.array([[1.0, 0.0], [1.0, 2.0 * q[1]]]),
        gamma=False,
    )
    result = solve_index1(system, (0.0, 1.0), [1.0, 0.0], [0.0, 0.0], "DOP853", 1e-8, 1e-8)
    assert not result.success and "do not hold at the end" in result.message
