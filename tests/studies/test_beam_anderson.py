"""The trial of Anderson's acceleration: its plain sweeps are those of the integrator, and depth saves some."""

import numpy as np
import pytest

from studies.beam_anderson import TABLEAU, TOLERANCE, sweeps
from twoloop import RungeKutta, solve_dae
from twoloop.mechanisms import four_bar, very_flexible_beam

pytestmark = pytest.mark.slow  # half a minute to compile


@pytest.mark.parametrize(("make", "h"), [(four_bar, 0.05), (very_flexible_beam, 5e-4)])
def test_plain_sweeps_are_those_of_the_integrator_and_depth_saves_some(make, h):
    problem = make()
    state = (0.0, problem.q0, problem.v0)
    plain = sweeps(problem, state, h, 0, TABLEAU)
    method = RungeKutta(TABLEAU, outer_tol=TOLERANCE)
    step = solve_dae(problem.system, (0.0, h), problem.q0, problem.v0, method, step_size=h)
    assert step.success and step.stats.n_outer == plain
    assert 2 < sweeps(problem, state, h, 2, TABLEAU) <= plain


def test_sweeps_that_fail_are_infinite():
    problem = very_flexible_beam()
    assert sweeps(problem, (0.0, problem.q0, problem.v0), 5e-3, 0, TABLEAU) == np.inf
