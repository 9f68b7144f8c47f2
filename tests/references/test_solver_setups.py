"""Test that other solvers are set up, timed and stopped as their users would do it, and found by their files."""

import math
import sys

import numpy as np
import pytest

import references
from references import lines as lines_module
from references.driver import TimeLimit
from references.equations.straight_line import exact_jacobian, straight_line
from references.lines import Line, lines
from references.scipy import fully_implicit, index1
from references.sundials import cvode_c
from references.sundials.cvode_c import solve_cvode_c
from studies.bench.collector import Case, Run, attempt
from studies.bench.solvers import CATALOGUE
from studies.validation.study import MAKE
from tests.marks import slow, slow_but
from tests.problems import pendulum
from twoloop import ConstrainedSystem, callback, mechanisms
from twoloop.mechanisms import double_pendulum, projection_pendulum, spatial_slider_crank
from twoloop.problem.callbacks import callbacks_in

PENDULUM = projection_pendulum()
DOUBLE = double_pendulum()
SPATIAL = spatial_slider_crank()


def run(solve, problem, *arguments, t_end=None, **options):
    end = problem.reference.t if t_end is None else t_end
    result = solve(problem.system, (0.0, end), problem.q0, problem.v0, *arguments, t_eval=[0.0, end], **options)
    assert result.success, result.message
    return result


@callback("mass")
def mass(t, q, p, M):
    M[0, 0] = 1.0 + 0.1 * math.exp(-q[0] * q[0])
    M[1, 1] = 2.0 + math.sinh(0.1 * q[1]) ** 2
    M[0, 1] = M[1, 0] = 0.2 * math.sin(q[1])  # none of q[2], which the constraint carries along


@callback("force")
def force(t, q, v, p, Q):
    Q[0] = -p[0] * math.sqrt(1.0 + v[0] * v[0]) * math.tanh(v[0]) / (1.0 + q[1] * q[1]) + math.log(3.0 + q[2])
    Q[1] = -math.hypot(q[0], v[2] + 2.0) - 0.3 * v[1] ** 3
    Q[2] = math.tan(0.3 * q[2]) * math.cos(t) - math.atan(v[2]) - 2.0 / (3.0 + v[0])


@callback("constraint")
def constraint(t, q, p, C):
    C[0] = q[0] * q[1] - math.sin(q[2]) + 0.5 * t
    C[1] = 2.0 * C[0]  # redundant


@callback("jacobian")
def jacobian(t, q, p, Cq):
    Cq[0, 0], Cq[0, 1], Cq[0, 2] = q[1], q[0], -math.cos(q[2])
    for j in range(3):
        Cq[1, j] = 2.0 * Cq[0, j]


@callback("constraint_rate")
def constraint_rate(t, q, p, Ct):
    Ct[0], Ct[1] = 0.5, 1.0


@callback("gamma")
def gamma(t, q, v, p, Qd):
    Qd[0] = -2.0 * v[0] * v[1] - math.sin(q[2]) * v[2] * v[2]
    Qd[1] = 2.0 * Qd[0]


DRIVEN = ConstrainedSystem(n_q=3, n_c=2, **callbacks_in(globals()), parameters=[0.7], name="singular mass")
STATES = {
    "singular mass": (DRIVEN, np.array([0.5, 0.4, 0.2]), np.array([0.3, -0.2, 0.1])),
    "double pendulum": (DOUBLE.system, DOUBLE.q0, DOUBLE.v0),
    "pendulum": (PENDULUM.system, PENDULUM.q0, PENDULUM.v0),
    "spatial slider-crank": (SPATIAL.system, SPATIAL.q0, SPATIAL.v0),  # too long for straight-line code
}


@pytest.mark.parametrize("name", slow_but(["singular mass"], STATES))
def test_the_jacobian_of_the_accelerations_is_their_derivative(name):
    system, q, v = STATES[name]
    rate, derivatives = (make(system, 0.0, q.tobytes(), v.tobytes()) for make in (straight_line, exact_jacobian))
    y = np.concatenate([q, v]) + 0.02 * np.random.default_rng(1).standard_normal(2 * system.n_q)
    columns, differences = np.zeros((y.size, y.size)), np.empty((y.size, y.size))
    derivatives(0.3, y, columns)
    for k in range(y.size):
        ahead, behind, moved = np.empty(y.size), np.empty(y.size), np.zeros(y.size)
        moved[k] = 1e-6
        rate(0.3, y + moved, ahead)
        rate(0.3, y - moved, behind)
        differences[k] = (ahead - behind) / 2e-6
    assert np.abs(differences).max() > 0.5 and np.abs(columns - differences).max() < 1e-5 * np.abs(differences).max()


def test_cvode_takes_the_analytic_jacobian(monkeypatch):
    exact = run(solve_cvode_c, PENDULUM, "BDF", 1e-9, 1e-9, t_end=2.0)
    monkeypatch.setattr(cvode_c, "_jacobian", lambda *_: None)
    differenced = run(solve_cvode_c, PENDULUM, "BDF", 1e-9, 1e-9, t_end=2.0)
    for result in (exact, differenced):
        assert 1e-13 < np.abs(result.q[:, -1] - PENDULUM.q0).max() < 1e-5 and result.stats.n_jacobians > 1
    more = [each.stats.n_evaluations - each.stats.n_outer for each in (exact, differenced)]
    assert more[0] < exact.stats.n_jacobians and more[1] >= 4 * differenced.stats.n_jacobians  # one for each unknown


def start(problem, t_end):
    return problem.system, (0.0, t_end), problem.q0, problem.v0


# --- solve_dae
@pytest.mark.parametrize("tolerance", [1e-8, slow(3e-8), slow(1e-9)])
def test_solve_dae_starts_from_rest_with_a_step_that_rounding_does_not_spoil(tolerance):
    """With its own first step, of 1e-6 of the span, it fails there at these tolerances."""
    result = fully_implicit.solve_fully_implicit(*start(mechanisms.pendulum(), 0.5), "Radau", tolerance, tolerance)
    assert result.success, result.message


# --- mass matrices that are singular without the constraints, as with Euler parameters
SOLVERS = (
    "DOP853, projected",
    "DOP853, index 1",
    "Pr9, index 1",
    "LSODA, index 1",
    "Radau, index 1",
    "CVODE, Adams",
    "IDA from C, stabilised",
)
EULER = ("heavy top", "spatial slider-crank", "spatial four-bar", "A05 governor")


@pytest.mark.slow
@pytest.mark.parametrize("name", EULER)
def test_every_solver_is_put_to_mechanisms_with_euler_parameters(name):
    problem = next(problem for problem in (make() for make in MAKE) if problem.name == name)
    known = problem.reference
    for solver in SOLVERS:
        errors = []
        for tol in (1e-5, 1e-9):
            case = Case(name, problem, known.t, n_instants=1, time_limit=60.0)
            result, status, message, _ = attempt(Run(case, CATALOGUE[solver], tol), 0)
            if status == "NOT_AVAILABLE":
                break
            assert status == "REACHED_END", (solver, message)
            errors.append(np.nanmax(np.abs(result.q[:, -1] - known.q)))
        assert not errors or errors[1] < min(1e-5, 0.1 * errors[0]), (solver, errors)


# --- Jacobians
@pytest.mark.slow  # compiles right-hand sides and their Jacobian for seconds
def test_a_jacobian_is_given_only_where_it_is_that_of_the_equations():
    system, q, v = PENDULUM.system, PENDULUM.q0, PENDULUM.v0
    y = np.concatenate([q, v])
    plain = index1.RightHandSide(system, 0.0, q, 0.0)
    jacobian, function = plain.jacobian(0.0, y), plain.function(TimeLimit(None))
    differences = [(function(0.0, y + e) - function(0.0, y - e)) / 2e-6 for e in 1e-6 * np.eye(y.size)]
    assert np.abs(jacobian(0.0, y) - np.transpose(differences)).max() < 1e-6 * np.abs(differences).max()
    assert index1.RightHandSide(system, 0.0, q, 10.0).jacobian(0.0, y) is None  # of other equations
    assert index1.RightHandSide(pendulum(), 0.0, np.array([1.0, 0.0]), 0.0).jacobian(0.0, np.eye(4)[0]) is None


FILE = """
from references.driver import adapter
from references.lines import Line


@adapter(derivatives=False)
def solve(task, rtol=1e-8, atol=1e-8):
    raise NotImplementedError


LINES = (Line("newcomer", "numpy", "numpy", solve),)
"""


def test_a_file_in_the_folder_is_enough(tmp_path, monkeypatch):
    (tmp_path / "newcomer.py").write_text(FILE)
    monkeypatch.setattr(lines_module, "__file__", str(tmp_path / "lines.py"))
    monkeypatch.setattr(references, "__path__", [*references.__path__, str(tmp_path)])
    found = lines.__wrapped__()
    monkeypatch.delitem(sys.modules, "references.newcomer")
    assert [line.name for line in found] == ["newcomer"] and isinstance(found[0], Line)
