"""A force that jumps within a step, and errors of velocities that last: estimates that were too small there."""

import numpy as np
import pytest

from tests.problems import unconstrained, worst
from twoloop import mechanisms, solve_dae

TOL = 1e-8
W, PUSH, END = 3.0, 10.0, 1.0  # rad/s, m/s^2, s
TIMES = np.linspace(0.21, 0.79, 8) ** 1.1  # s, on no grid of steps


def pushed(at):
    """A mass on a spring, pushed from a time on."""
    return unconstrained(lambda t, q, v: np.array([(PUSH if t > at else 0.0) - W * W * q[0]]))


def errors(method):
    """Of position and velocity at the end, over the tolerance, for each time of the jump."""
    found = []
    for at in TIMES:
        result = solve_dae(pushed(at), (0.0, END), [1.0], [0.0], method, TOL, TOL, check_derivatives=False)
        phase, since = W * END, W * (END - at)
        q = np.cos(phase) + PUSH / W**2 * (1.0 - np.cos(since))
        v = -W * np.sin(phase) + PUSH / W * np.sin(since)
        assert result.success, result.message
        found.append(max(abs(result.q[0, -1] - q), abs(result.v[0, -1] - v)) / TOL)
    return found


@pytest.mark.parametrize(
    ("method", "limit"), [("DOP853", 10.0), ("Gauss4", 30.0), ("Gauss8", 20.0), ("ESDIRK4", 30.0), ("PaperIRK", 300.0)]
)
def test_a_jump_of_the_force_is_passed_within_the_tolerance(method, limit):
    """The weights of ESDIRK4 and of its embedded formula agree within 4 %: its estimate was 1/300 of the error."""
    assert max(errors(method)) < limit


def test_errors_of_velocities_count_for_as_long_as_the_motion_lasts():
    """They turn back no faster than the mechanism moves, and those of many steps add up."""
    problem = mechanisms.andrews()
    span = (0.0, 0.05)
    fine = solve_dae(problem.system, span, problem.q0, problem.v0, "DOP853", 1e-12, 1e-12)
    result = solve_dae(problem.system, span, problem.q0, problem.v0, "ESDIRK4", TOL, TOL)
    assert worst(result.q[:, -1], fine.q[:, -1]) < 800.0 * TOL


@pytest.mark.parametrize("at", [0.0, -3.0])
def test_times_before_zero_are_like_others(at):
    """What is refused at one place does not hold steps short at another."""
    problem = mechanisms.pendulum()
    result = solve_dae(problem.system, (at, at + 1.0), problem.q0, problem.v0, "ESDIRK4", 1e-6, 1e-6)
    assert result.stats.n_accepted < 130
