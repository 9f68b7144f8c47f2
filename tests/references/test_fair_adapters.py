"""Rivals are put, timed and stopped as their users would do it: what is built, counted, limited, and said of them."""

import numpy as np
import pytest

from references.casadi import integrators as casadi_integrators
from references.casadi.integrators import FLAGS, PLAIN, solve_cvodes, solve_idas
from references.diffrax import dopri8 as diffrax_dopri8
from references.driver import Task, TimeLimit, user_call
from references.scipy import fully_implicit, index1
from references.scipy.index1 import solve_index1
from references.sundials.cvode import solve_cvode
from studies.bench.collector import Case, Run, attempt
from studies.bench.solvers import CATALOGUE, OTHER_SOLVERS
from studies.validation.study import MAKE
from tests.problems import pendulum
from twoloop import mechanisms
from twoloop.mechanisms import four_bar, projection_pendulum
from twoloop.run.record import Status

FOUR_BAR, PENDULUM = four_bar(), projection_pendulum()


def start(problem, t_end):
    return problem.system, (0.0, t_end), problem.q0, problem.v0


# --- solve_dae
@pytest.mark.parametrize("tolerance", [3e-8, 1e-8, 1e-9])
def test_solve_dae_starts_from_rest_with_a_step_that_rounding_does_not_spoil(tolerance):
    """With its own first step, of 1e-6 of the span, it fails there at these tolerances."""
    result = fully_implicit.solve_fully_implicit(*start(mechanisms.pendulum(), 0.5), "Radau", tolerance, tolerance)
    assert result.success, result.message


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
    assert status == "REACHED_END" and made.stats.n_accepted == adams.stats.n_accepted and name in OTHER_SOLVERS
    with pytest.raises(ValueError, match="method must be 'BDF' or 'Adams'; given 'adams'"):
        solve_cvodes(*start(PENDULUM, 2.0), method="adams")


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
    assert diffrax_dopri8.MOST_STEPS == 10**6 and "order 8" in diffrax_dopri8.solve_diffrax.__doc__
    late = diffrax_dopri8.solve_diffrax(*start(PENDULUM, 10.0), 1e-9, 1e-9, time_limit=1e-9)
    assert late.status is Status.SOLVER_FAILED and "time_limit" in late.message and late.t.size == 0
    result = diffrax_dopri8.solve_diffrax(*start(PENDULUM, 30.0), 1e-9, 1e-9)
    assert result.success and result.stats.n_accepted > 100


# --- mass matrices that are singular without the constraints, as with Euler parameters
QUICK = ("DOP853, projected",)
OTHERS = (
    "DOP853, index 1",
    "Pr9, index 1",
    "LSODA, index 1",
    "Radau, index 1",
    "CVODE, Adams",
    "IDA from C, stabilised",
)
EULER = ("heavy top", "spatial slider-crank", "spatial four-bar", "A05 governor")
SLOW = [pytest.param(name, (*QUICK, *OTHERS), marks=pytest.mark.slow) for name in EULER]


@pytest.mark.parametrize(("name", "solvers"), [("heavy top", QUICK), *SLOW])
def test_every_solver_is_put_to_mechanisms_with_euler_parameters(name, solvers):
    problem = next(problem for problem in (make() for make in MAKE) if problem.name == name)
    known = problem.reference
    for solver in solvers:
        errors = []
        for tol in (1e-5, 1e-9):
            case = Case(name, problem, known.t, n_instants=1, time_limit=60.0)
            result, status, message, _ = attempt(Run(case, CATALOGUE[solver], tol), 0)
            if status == "NOT_AVAILABLE":
                break
            assert status == "REACHED_END", (solver, message)
            errors.append(np.nanmax(np.abs(result.q[:, -1] - known.q)))
        assert not errors or errors[1] < min(1e-5, 0.1 * errors[0]), (solver, errors)


def test_a_step_of_scipy_that_is_timed_makes_no_interpolant(monkeypatch):
    made = []
    before = index1.METHODS["DOP853"]

    class Watched(before):
        def dense_output(self):
            made.append(user_call.so_far())
            return super().dense_output()

    monkeypatch.setitem(index1.METHODS, "DOP853", Watched)
    assert solve_index1(*start(PENDULUM, 2.0), t_eval=np.linspace(0.0, 2.0, 201)).success
    assert made and not any(made)  # outside of the user's call


# --- Jacobians
def test_implicit_solvers_get_the_analytic_jacobian(monkeypatch):
    """Without it as many evaluations more as there are unknowns, for every Jacobian; the motion is the same."""
    at = start(PENDULUM, 2.0)
    solvers = {
        "Radau": lambda: solve_index1(*at, "Radau", 1e-7, 1e-7),
        "CVODE": lambda: solve_cvode(*at, 1e-7, 1e-7),
    }
    exact = {name: solve() for name, solve in solvers.items()}
    monkeypatch.setattr(index1.RightHandSide, "jacobian", lambda *_: None)
    differenced = {name: solve() for name, solve in solvers.items()}
    for name in solvers:
        assert exact[name].success and exact[name].stats.n_evaluations < differenced[name].stats.n_evaluations, name
        assert np.abs(exact[name].q[:, -1] - differenced[name].q[:, -1]).max() < 1e-4


def test_a_jacobian_is_given_only_where_it_is_that_of_the_equations():
    system, q, v = PENDULUM.system, PENDULUM.q0, PENDULUM.v0
    y = np.concatenate([q, v])
    plain = index1.RightHandSide(system, 0.0, q, 0.0)
    jacobian, function = plain.jacobian(0.0, y), plain.function(TimeLimit(None))
    differences = [(function(0.0, y + e) - function(0.0, y - e)) / 2e-6 for e in 1e-6 * np.eye(y.size)]
    assert np.abs(jacobian(0.0, y) - np.transpose(differences)).max() < 1e-6 * np.abs(differences).max()
    assert index1.RightHandSide(system, 0.0, q, 10.0).jacobian(0.0, y) is None  # of other equations
    assert index1.RightHandSide(pendulum(), 0.0, np.array([1.0, 0.0]), 0.0).jacobian(0.0, np.eye(4)[0]) is None


def test_solve_dae_differences_once_a_jacobian_and_is_told_the_rest():
    system, q, v = PENDULUM.system, PENDULUM.q0 + 0.1, PENDULUM.v0 + 0.2
    functions = fully_implicit.Functions(Task(system, system.n_c, 0.0, 1.0, q, v, None))
    y, yp = np.concatenate([q, v, np.zeros(2 * system.n_c)]), np.linspace(-1.0, 1.0, 2 * (system.n_q + system.n_c))
    known, calls = [np.zeros((y.size, y.size)) for _ in range(2)], []
    matrix = functions.matrix
    for cj, into in zip((0.0, 1.0), known, strict=True):
        matrix(0.3, cj, y, yp, *functions.form.space, into.T)
    functions.matrix = lambda *given: calls.append(given[1]) or matrix(*given)
    by_y, by_yp = functions.jacobians(0.3, y, yp)
    assert calls == [0.0] and np.array_equal(by_y, known[0]) and np.count_nonzero(by_yp) > y.size / 2
    assert np.abs(known[1] - known[0] - by_yp).max() < 1e-6
