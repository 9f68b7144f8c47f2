"""Test the fused callback `kinematics`: checked against the separate ones, and the motion is the same."""

import numpy as np
import pytest

from tests.compiled import PENDULUM
from tests.marks import slow
from tests.problems import pendulum_state
from twoloop import ConstrainedSystem, callback, solve_dae

START = pendulum_state(0.3)[:2]  # off the axes, and moving


def fused(constraint=1.0, jacobian=1.0, rate=0.0, gamma=1.0):
    """All four in one callback, with a factor before what some give, and a rate where there is none."""

    @callback("kinematics")
    def kinematics(t, q, v, p, C, Cq, Ct, Qd):
        C[0] = constraint * 0.5 * (q[0] * q[0] + q[1] * q[1] - 1.0)
        Cq[0, 0], Cq[0, 1] = q[0], jacobian * q[1]
        Ct[0] = rate
        Qd[0] = -gamma * (v[0] * v[0] + v[1] * v[1])

    return {"kinematics": kinematics}


@pytest.mark.parametrize("method", ["RadauIIA5", slow("DOP853"), slow("BDF"), slow("Newmark")])
def test_the_motion_is_that_of_the_separate_callbacks(method):
    options = {"method": method, "rtol": 1e-7, "atol": 1e-7, "t_eval": np.linspace(0.1, 1.0, 10)}
    systems = ConstrainedSystem(**PENDULUM, **fused()), ConstrainedSystem(**PENDULUM)
    result, separate = (solve_dae(system, (0.0, 1.0), *START, **options) for system in systems)
    assert result.success and result.stats.n_evaluations == pytest.approx(separate.stats.n_evaluations, rel=0.05)
    assert np.abs(result.q - separate.q).max() < 1e-8  # a Jacobian of a position off by less may serve again


@pytest.mark.parametrize(
    ("kind", "wrong"),
    [("jacobian", {"jacobian": 2.0}), slow("constraint", {"constraint": 2.0}), slow("gamma", {"gamma": -1.0})],
)
def test_a_fused_callback_that_says_something_else_is_refused(kind, wrong):
    with pytest.raises(ValueError, match=f"(?s)kinematics of 'pendulum'.*{kind}"):
        solve_dae(ConstrainedSystem(**PENDULUM, **fused(**wrong)), (0.0, 1.0), *START)
