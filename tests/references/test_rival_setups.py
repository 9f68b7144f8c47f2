"""Rivals as their authors would set them up: what the error test sees, exact Jacobians, CVODE's own projection."""

import numpy as np
import pytest

from references.casadi_integrators import solve_cvodes, solve_idas
from references.ida_c import solve_ida_c
from twoloop.mechanisms import four_bar, projection_pendulum

FOUR_BAR = four_bar()
PENDULUM = projection_pendulum()


def run(solve, problem, *arguments, t_end=None, **options):
    end = problem.reference.t if t_end is None else t_end
    result = solve(problem.system, (0.0, end), problem.q0, problem.v0, *arguments, t_eval=[0.0, end], **options)
    assert result.success, result.message
    return result


def error(problem, result):
    return np.abs(result.q[:, -1] - problem.reference.q).max()


def test_ida_tests_positions_and_velocities_without_the_integrals_of_the_multipliers():
    pytest.importorskip("sksundae")
    made = {test: run(solve_ida_c, FOUR_BAR, 1e-7, 1e-7, error_test=test) for test in ("all", "states", "positions")}
    errors = {test: error(FOUR_BAR, result) for test, result in made.items()}
    assert 1e-12 < errors["states"] < 1e-3, errors
    steps = {test: result.stats.n_accepted for test, result in made.items()}
    assert steps["positions"] < steps["states"] < steps["all"], steps


def test_cvodes_of_casadi_is_cvodes_and_right():
    pytest.importorskip("casadi")
    result = run(solve_cvodes, PENDULUM, 1e-9, 1e-9, t_end=2.0)
    assert 1e-13 < np.abs(result.q[:, -1] - PENDULUM.q0).max() < 1e-5
    assert result.message.startswith("CVODES of CasADi reached the end")
    assert result.stats.cpu_time > 0.0
    assert result.stats.n_accepted != run(solve_idas, PENDULUM, 1e-9, 1e-9, t_end=2.0).stats.n_accepted
