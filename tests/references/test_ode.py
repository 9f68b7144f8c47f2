"""What the adapters of solvers of y' = f(t, y) add to the states: accelerations and multipliers."""

import numpy as np
import pytest

from references.equations.ode import ode_result
from twoloop import mechanisms, solve_dae
from twoloop.run.record import Statistics


@pytest.mark.filterwarnings("ignore::twoloop.checks.consistency.ConstraintWarning")
@pytest.mark.parametrize("make", [mechanisms.double_pendulum, mechanisms.redundant_slider_crank])
def test_accelerations_and_multipliers_are_those_of_least_norm(make):
    problem = make()
    system, n = problem.system, problem.system.n_q
    motion = solve_dae(system, (0.0, 0.5), problem.q0, problem.v0)
    states = np.concatenate([motion.q, motion.v])
    states[0, 3] = np.nan

    found = ode_result(system, motion.t, states, "", "reached the end", Statistics())

    for k in (0, 7, -1):
        t, q, v = motion.t[k], states[:n, k], states[n:, k]
        Cq = system.jacobian(t, q)
        matrix = np.block([[system.mass(t, q), Cq.T], [Cq, np.zeros((len(Cq), len(Cq)))]])
        right = np.concatenate([system.force(t, q, v), system.gamma(t, q, v)])
        truth = np.linalg.lstsq(matrix, right, rcond=None)[0]
        assert np.concatenate([found.a[:, k], found.lam[:, k]]) == pytest.approx(truth, rel=1e-9, abs=1e-9)
    assert np.isnan(found.a[:, 3]).all() and np.isnan(found.lam[:, 3]).all()
