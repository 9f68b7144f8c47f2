"""Rivals are put, timed and stopped as their users would do it: what is built, counted, limited, and said of them."""

import numpy as np
import pytest

from references import casadi_integrators, diffrax_dopri8
from references.casadi_integrators import FLAGS, PLAIN, solve_collocation, solve_cvodes, solve_idas
from references.four_bar_minimal import trajectory
from studies.bench import Case, Run, attempt
from studies.solvers import CATALOGUE, RIVALS
from studies.validation import MAKE
from twoloop.mechanisms import four_bar, projection_pendulum
from twoloop.result import Status

FOUR_BAR, PENDULUM = four_bar(), projection_pendulum()


def start(problem, t_end):
    return problem.system, (0.0, t_end), problem.q0, problem.v0


# --- CasADi


def test_idas_takes_the_steps_that_a_tight_tolerance_needs():
    pytest.importorskip("casadi")
    result = solve_idas(*start(PENDULUM, 120.0), 1e-13, 1e-13, t_eval=[120.0])
    assert result.success and result.stats.n_accepted > 100_000, result.message


def test_adams_of_cvodes_is_another_method_and_right():
    pytest.importorskip("casadi")
    bdf, adams = (solve_cvodes(*start(PENDULUM, 2.0), 1e-9, 1e-9, method=each) for each in ("BDF", "Adams"))
    assert adams.success and 1e-13 < np.abs(adams.q[:, -1] - PENDULUM.q0).max() < 1e-5
    assert adams.stats.n_accepted < 0.8 * bdf.stats.n_accepted
    name = "CVODES, CasADi, Adams"
    made, status, *_ = attempt(Run(Case("pendulum", PENDULUM, 2.0, n_instants=5), CATALOGUE[name], 1e-9), 0)
    assert status == "REACHED_END" and made.stats.n_accepted == adams.stats.n_accepted and name in RIVALS
    with pytest.raises(ValueError, match="method must be one of BDF, Adams; given 'adams'"):
        solve_cvodes(*start(PENDULUM, 2.0), method="adams")


def test_collocation_is_that_of_gauss():
    """At Radau's points the same steps have twelve times the error."""
    pytest.importorskip("casadi")
    result = solve_collocation(*start(FOUR_BAR, FOUR_BAR.reference.t), 200)
    assert 1e-9 < np.abs(result.q[:, -1] - FOUR_BAR.reference.q).max() < 8e-7


def test_one_output_before_the_end_is_the_state_then():
    pytest.importorskip("casadi")
    result = solve_idas(*start(FOUR_BAR, 1.0), 1e-9, 1e-9, t_eval=[0.5])
    assert result.t.tolist() == [0.5]
    assert np.abs(result.q - trajectory(FOUR_BAR.parameters, [0.5])[0]).max() < 1e-5


@pytest.mark.parametrize(("compiler", "flags"), [("cc", FLAGS), ("false", PLAIN)])
def test_the_compiler_is_asked_what_it_takes(compiler, flags):
    casadi_integrators._flags.cache_clear()
    assert casadi_integrators._flags(compiler) == flags
    casadi_integrators._flags.cache_clear()


@pytest.mark.parametrize("name", [name for name in CATALOGUE if name.endswith(("CasADi", "CasADi, Adams"))])
def test_the_alarm_within_casadi_is_a_time_limit(name):
    pytest.importorskip("casadi")
    solver = CATALOGUE[name]
    case = Case("four-bar", FOUR_BAR, 2e4, n_instants=1, time_limit=0.05)
    assert solver.builds_each and solver.builds_span
    result, status, message, _ = attempt(Run(case, solver, 1e-10 if solver.setting == "tol" else 0.1), 0, 60.0)
    assert status == "TIME_LIMIT" and "0.05 s" in message and result is None


# --- diffrax


@pytest.mark.slow  # compiles for ten seconds
def test_diffrax_looks_at_the_clock_before_the_second_run_and_takes_many_steps():
    pytest.importorskip("diffrax")
    assert diffrax_dopri8.MOST_STEPS == 10**7 and "order 8" in diffrax_dopri8.solve_diffrax.__doc__
    late = diffrax_dopri8.solve_diffrax(*start(PENDULUM, 10.0), 1e-9, 1e-9, time_limit=1e-9)
    assert late.status is Status.SOLVER_FAILED and "time_limit" in late.message and late.t.size == 0
    result = diffrax_dopri8.solve_diffrax(*start(PENDULUM, 30.0), 1e-9, 1e-9)
    assert result.success and result.stats.n_accepted > 100


# --- mass matrices that are singular without the constraints, as with Euler parameters

BY_ACCELERATIONS = ("DOP853, index 1", "DOP853, projected", "LSODA, index 1", "Pr9, index 1", "CVODE, Adams")
EULER = {"heavy top": (*BY_ACCELERATIONS, "Radau, index 1", "IDA from C, stabilised")}
LARGE = ("spatial slider-crank", "spatial four-bar", "A05 governor")


@pytest.mark.parametrize("name", ["heavy top", *(pytest.param(each, marks=pytest.mark.slow) for each in LARGE)])
def test_every_rival_is_put_to_mechanisms_with_euler_parameters(name):
    problem = next(problem for problem in (make() for make in MAKE) if problem.name == name)
    known = problem.reference
    for solver in EULER.get(name, (*BY_ACCELERATIONS, "IDA from C, stabilised")):
        errors = []
        for tol in (1e-5, 1e-9):
            case = Case(name, problem, known.t, n_instants=1, time_limit=60.0)
            result, status, message, _ = attempt(Run(case, CATALOGUE[solver], tol), 0)
            if status == "NOT_AVAILABLE":
                break
            assert status == "REACHED_END", (solver, message)
            difference = np.abs(result.q[:, -1] - known.q)
            errors.append(np.nanmax(difference))
        assert not errors or errors[1] < min(1e-5, 0.1 * errors[0]), (solver, errors)
