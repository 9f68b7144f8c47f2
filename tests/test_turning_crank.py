"""A crank that turns round and round: what symmetry does for a linkage that swings back it does not do here."""

import math
from functools import cache

import numpy as np
import pytest
from scipy.linalg import null_space

from studies.energy.drift import drift, windows
from tests.problems import quick
from twoloop import BDF, DOP853, Newmark, RungeKutta, solve_dae
from twoloop.mechanisms import four_bar
from twoloop.methods.tableaux import gauss

SPEED = 12.0  # rad/s of bar 3 at the start, enough for full turns
T_END, H = 60.0, 0.0045  # s


@cache
def crank():
    problem = four_bar(lengths=(1.0, 1.2, 0.5), ground=1.0, theta3=math.pi, branch=1)
    direction = null_space(problem.system.jacobian(0.0, problem.q0))[:, 0]
    return problem, direction / direction[8] * SPEED


@cache
def period():
    problem, v0 = crank()
    run = solve_dae(problem.system, (0.0, 2.0), problem.q0, v0, "Gauss12", 1e-10, 1e-10)
    turned = np.abs(run.q[8] - run.q[8, 0])
    assert np.all(np.diff(turned) > 0.0) and turned[-1] > 2.0 * math.pi
    return float(np.interp(2.0 * math.pi, turned, run.t))


@pytest.mark.parametrize(("variables", "drifts"), [("velocities", True), ("momenta", False)])
def test_gauss_drifts_on_velocities_and_not_on_momenta(variables, drifts):
    problem, v0 = crank()
    method = RungeKutta(gauss(3), variables=variables)
    run = solve_dae(problem.system, (0.0, T_END), problem.q0, v0, method, step_size=H)
    assert run.success and run.stats.n_partitions == 1
    error = problem.energy(run.t, run.q, run.v) - problem.energy(0.0, problem.q0, v0)
    seen = windows(run.t, error, period(), T_END)
    slope, uncertain = drift(seen["t"], seen["mean"])
    assert (abs(slope) > 10.0 * uncertain) == drifts
    assert (abs(slope) > 1e-8) == drifts  # J/s


METHODS = [RungeKutta(gauss(3)), RungeKutta(gauss(3), variables="momenta"), Newmark(), BDF(), DOP853()]


@pytest.mark.parametrize("turns", quick([10_000, 0]))
@pytest.mark.parametrize("method", METHODS, ids=lambda method: method.name)
def test_fixed_steps_converge_after_many_turns(method, turns):
    # the rounding of a large angle keeps the sweeps from converging as far as they do near zero
    problem, v0 = crank()
    q0 = problem.q0.copy()
    q0[8] += 2.0 * math.pi * turns
    run = solve_dae(problem.system, (0.0, 1.0), q0, v0, method, step_size=2e-3)
    assert run.success, run.message
