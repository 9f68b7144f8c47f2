"""Test SciPy's solvers on the index-1 ODE: accuracy, drift and its two cures, failures."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from references.scipy.index1 import STABILISATIONS, solve_index1
from tests.mechanisms.make_references import equations
from tests.problems import LINKAGES, force_residual, violations, worst


def run(name, t_end, *args, **options):
    problem = LINKAGES[name]
    return solve_index1(problem.system, (0.0, t_end), problem.q0, problem.v0, *args, **options)


@pytest.mark.slow
def test_takes_the_steps_of_solve_ivp_on_equations_written_apart():
    problem = LINKAGES["default"]
    system = problem.system

    def rate(t, y):
        q, v = y[:9], y[9:]
        return np.concatenate([v, np.linalg.solve(*equations(system, t, q, v))[:9]])

    theirs = solve_ivp(rate, (0.0, 1.0), np.append(problem.q0, problem.v0), "DOP853", rtol=1e-8, atol=1e-8)
    ours = run("default", 1.0)
    assert ours.t.size == theirs.t.size and worst(ours.t, theirs.t) < 1e-9
    assert worst(np.vstack([ours.q, ours.v]), theirs.y) < 1e-7  # rounding moves the times by 1e-10
    assert ours.stats.n_evaluations == theirs.nfev and ours.stats.n_accepted == ours.h.size == theirs.t.size - 1
    assert worst(ours.h, np.diff(ours.t)) == 0.0


@pytest.mark.slow
def test_drift_and_its_cures():
    """Over 100 s: growth without bound, a bound that the tolerance sets, nothing but rounding."""
    system = LINKAGES["default"].system
    position, early, velocity = {}, {}, {}
    for stabilisation in STABILISATIONS:
        result = run("default", 100.0, "DOP853", 1e-6, 1e-6, stabilisation=stabilisation)
        violation = np.array([worst(system.constraint(t, q), 0.0) for t, q in zip(result.t, result.q.T, strict=True)])
        position[stabilisation], early[stabilisation] = violation.max(), violation[result.t < 10.0].max()
        velocity[stabilisation] = violations(system, result)[1]
    assert position["none"] > 1e-3 and position["none"] > 30.0 * early["none"]  # with t^2
    assert 1e-9 < position["baumgarte"] < 1e-6 and position["baumgarte"] < 3.0 * early["baumgarte"]
    assert velocity["baumgarte"] < 1e-4 and position["projection"] < 1e-14 and velocity["projection"] < 1e-13


@pytest.mark.slow  # compiles the equations of index 1
@pytest.mark.parametrize("stabilisation", STABILISATIONS)
def test_accelerations_and_multipliers_are_those_of_the_equations_solved(stabilisation):
    system = LINKAGES["default"].system
    result = run("default", 2.0, rtol=1e-5, atol=1e-5, stabilisation=stabilisation)
    assert force_residual(system, result) < 1e-11
    alpha = 10.0 if stabilisation == "baumgarte" else 0.0
    for t, q, v, a in zip(result.t, result.q.T, result.v.T, result.a.T, strict=True):
        feedback = 2.0 * alpha * system.velocity_constraint(t, q, v) + alpha**2 * system.constraint(t, q)
        assert worst(system.jacobian(t, q) @ a, system.gamma(t, q, v) - feedback) < 1e-11
