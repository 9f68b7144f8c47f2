"""Test trees in engines, and IDA's sparse solver: accelerations and motions are those of twoloop."""

import numpy as np
import pytest

from references.engines.trees import ENGINES, end_by_pinocchio
from references.sundials.ida_sparse import solve_ida_sparse
from studies.bench.large import open_chain, tree
from twoloop import solve_dae


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("build", [open_chain, tree])
def test_accelerations_of_trees(engine, build):
    pytest.importorskip({"MuJoCo": "mujoco", "Pinocchio": "pinocchio"}[engine])
    made, n = build(24), 24
    result = solve_dae(made.system, (0.0, 0.05), made.q, 0.0 * made.q, rtol=1e-10, atol=1e-10)
    q, v, a = (each[2::3, -1] for each in (result.q, result.v, result.a))
    dynamics = ENGINES[engine](made.bodies, q, v)
    dynamics.evaluate()
    assert np.abs(dynamics.angular() - a).max() < 1e-8 * np.abs(a).max() and a.shape == (n,)


def test_the_end_of_a_motion_by_pinocchio():
    pytest.importorskip("pinocchio")
    made = tree(12)
    ours = solve_dae(made.system, (0.0, 0.2), made.q, 0.0 * made.q, rtol=1e-11, atol=1e-11).q[:, -1]
    assert np.abs(end_by_pinocchio(made.bodies, made.q[2::3], 0.2, 1e-11) - ours).max() < 1e-8


@pytest.mark.slow
def test_ida_with_its_sparse_solver():
    made = open_chain(40)
    start = made.system, (0.0, 0.05), made.q, 0.0 * made.q
    ours = solve_dae(*start, rtol=1e-10, atol=1e-10)
    other = solve_ida_sparse(*start, rtol=1e-8, atol=1e-8)
    assert other.success and np.abs(other.q[:, -1] - ours.q[:, -1]).max() < 1e-5
    assert np.abs(other.lam[:, 0] - ours.lam[:, 0]).max() < 1e-9 * np.abs(ours.lam[:, 0]).max()
    small = open_chain(4)
    with pytest.raises(ValueError, match="must have jacobian_values"):
        solve_ida_sparse(small.system, (0.0, 0.05), small.q, 0.0 * small.q)
