"""Test coordinate partitioning: the rank that full pivoting sees, and runs that one partition cannot make."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from references.paper.four_bar_minimal import MinimalFourBar
from tests.marks import slow
from tests.problems import called, worst
from twoloop import RungeKutta, solve_dae
from twoloop.kernels.evaluation.partition import full_pivoting, scale_rows
from twoloop.methods.tableaux import gauss, lobatto_iiie, sun_radau_iib

seeds = st.integers(0, 2**32 - 1)


def pivoted(A):
    order, row_order = np.arange(A.shape[1]), np.arange(A.shape[0])
    scaled = A.copy()
    called(scale_rows, scaled)
    return called(full_pivoting, scaled, order, row_order, np.zeros(len(A)), 0, len(A), len(A)), order


@given(st.integers(2, 8), st.integers(0, 6), seeds, st.data())
def test_rank_is_seen(n_c, n_free, seed, data):
    rng = np.random.default_rng(seed)
    rank = data.draw(st.integers(1, n_c - 1))
    A = rng.normal(size=(n_c, rank)) @ rng.normal(size=(rank, n_c + n_free))
    assert pivoted(A)[0] == rank


def test_bars_in_line_force_another_partition_and_nothing_jumps(collinear_four_bar):
    problem = collinear_four_bar
    times = np.linspace(0.0, 10.0, 101)
    options = {"rtol": 1e-10, "atol": 1e-10, "compiled": False}  # generated code has no partition
    result = solve_dae(problem.system, (0.0, 10.0), problem.q0, problem.v0, max_steps=20_000, **options)
    assert result.success
    theta1, theta2 = result.q[2], result.q[5]
    assert (np.diff(np.sign(np.sin(theta2 - theta1))) != 0).sum() >= 5  # bars 1 and 2 pass through one line
    assert result.stats.n_partitions > 1
    energy = problem.energy(result.t, result.q, result.v)
    assert np.abs(np.diff(energy)).max() < 1e-8  # no jump at a switch
    assert worst(energy, energy[0]) < 1e-8
    # the state is carried over: positions move no farther in a step than their velocities allow
    reach = np.maximum(np.abs(result.v[:, 1:]), np.abs(result.v[:, :-1])) * result.h + 50.0 * result.h**2
    assert (np.abs(np.diff(result.q, axis=1)) <= reach).all()
    landed = solve_dae(problem.system, (0.0, 10.0), problem.q0, problem.v0, t_eval=times, **options)
    assert worst(landed.q, MinimalFourBar.from_parameters(problem.parameters).states(times)[0]) < 1e-9


@pytest.mark.parametrize(
    ("tableau", "reversible", "options"),
    [
        (gauss(3), True, {"outer": "auto"}),
        (sun_radau_iib(3), False, {}),
        *(slow(tableau, True, {"outer": "newton", "outer_tol": 1e-14}) for tableau in (gauss(3), lobatto_iiie(4))),
    ],
)
def test_symmetric_tableau_and_partition_go_back_where_they_came_from(collinear_four_bar, options, tableau, reversible):
    # across partition changes; 12 s there, velocities turned round, 12 s back
    problem, h = collinear_four_bar, 0.02
    span = (0.0, 12.0)
    back = {}
    for partition in ("symmetric", "lasting"):
        method = RungeKutta(tableau, partition=partition, **options)
        there = solve_dae(problem.system, span, problem.q0, problem.v0, method, step_size=h)
        assert there.success and there.stats.n_partitions > 5
        home = solve_dae(problem.system, span, there.q[:, -1], -there.v[:, -1], method, step_size=h)
        back[partition] = worst(home.q[:, -1], problem.q0)
    assert (back["symmetric"] < 1e-9) == reversible and back["lasting"] > 1e-7
