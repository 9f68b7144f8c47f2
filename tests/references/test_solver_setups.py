"""Rivals as their authors would set them up: what the error test sees, exact Jacobians, CVODE's own projection."""

import math
from contextlib import ExitStack

import numpy as np
import pytest

from references.equations import straight_line as code
from references.equations.expressions import expressions_at
from references.equations.straight_line import exact_jacobian, straight_line
from references.sundials import cvode_c
from references.sundials import library as sundials
from references.sundials.cvode_c import solve_cvode_c
from references.sundials.cvode_projection import projection_for_cvode
from references.sundials.ida_c import solve_ida_c
from studies.bench.figures import STYLES
from studies.bench.solvers import CATALOGUE, CVODE_C_PROJECTED, IDA_C_STATES, OTHER_SOLVERS
from twoloop import ConstrainedSystem, callback
from twoloop.mechanisms import double_pendulum, four_bar, projection_pendulum, spatial_slider_crank
from twoloop.problem.given import callbacks_in

FOUR_BAR = four_bar()
PENDULUM = projection_pendulum()
DOUBLE = double_pendulum()
SPATIAL = spatial_slider_crank()


def run(solve, problem, *arguments, t_end=None, **options):
    end = problem.reference.t if t_end is None else t_end
    result = solve(problem.system, (0.0, end), problem.q0, problem.v0, *arguments, t_eval=[0.0, end], **options)
    assert result.success, result.message
    return result


def error(problem, result):
    return np.abs(result.q[:, -1] - problem.reference.q).max()


def test_ida_tests_positions_and_velocities_without_the_integrals_of_the_multipliers():
    made = {test: run(solve_ida_c, FOUR_BAR, 1e-7, 1e-7, error_test=test) for test in ("states", "positions")}
    assert 1e-9 < error(FOUR_BAR, made["states"]) < 2e-4
    assert made["positions"].stats.n_accepted < 0.8 * made["states"].stats.n_accepted


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


@pytest.mark.parametrize("name", STATES)
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


@pytest.mark.parametrize(
    "name", ["singular mass", *(pytest.param(each, marks=pytest.mark.slow) for each in ("double pendulum", "pendulum"))]
)
def test_a_jacobian_in_loops_is_that_of_straight_line_code(name):
    system, q, v = STATES[name]
    equations = expressions_at(system, 0.0, q.tobytes(), v.tobytes())
    columns = np.zeros((2, 2 * system.n_q, 2 * system.n_q))
    for make, into in zip((code._straight_line_jacobian, code._jacobian_in_loops), columns, strict=True):
        make(equations)(0.3, np.concatenate([q, v]), into)
    assert np.abs(columns[0]).max() > 0.5 and np.abs(columns[0] - columns[1]).max() < 1e-12 * np.abs(columns[0]).max()


def kept(system, t, q, v):
    """The largest residual of the constraints on positions, and on velocities."""
    rates = system.jacobian(t, q) @ v + system.constraint_rate(t, q)
    return np.abs(system.constraint(t, q)).max(), np.abs(rates).max()


def test_cvode_keeps_the_constraints_that_it_projects_onto():
    problem = PENDULUM
    free, made = (run(solve_cvode_c, problem, "BDF", 1e-8, 1e-8, projected=each) for each in (False, True))
    assert 1e-14 < error(problem, made) < 6e-5
    end = problem.reference.t
    assert max(kept(problem.system, end, made.q[:, -1].copy(), made.v[:, -1].copy())) < 1e-13
    assert max(kept(problem.system, end, free.q[:, -1].copy(), free.v[:, -1].copy())) > 1e-11


def test_the_projection_is_the_shortest_one_and_projects_the_error():
    rng, t, f = np.random.default_rng(2), 0.3, DRIVEN.functions
    projection, size = projection_for_cvode(*f[2:5], 3, 2, 1)
    data = np.zeros(size)
    data[:3] = 0.7, 1e-12, 1e-12
    y, corr, err = 0.5 + 0.1 * rng.standard_normal(6), np.empty(6), rng.standard_normal(6)
    given, estimate = y.copy(), err.copy()
    with ExitStack() as stack:
        own = sundials.context(stack)
        vectors = [
            sundials.made(stack, "N_VMake_Serial", sundials.library().N_VDestroy, 6, each.ctypes.data, own).value
            for each in (y, corr, err)
        ]
        call = projection.ctypes
        assert call(t, *vectors[:2], 0.1, 0, data.ctypes.data) == 0
        alone = corr.copy()
        assert call(t, *vectors[:2], 0.1, vectors[2], data.ctypes.data) == 0
        assert np.array_equal(alone, corr) and np.array_equal(y, given)
        y[0] = np.nan
        assert call(t, *vectors[:2], 0.1, 0, data.ctypes.data) > 0
    q, v = np.split(given + alone, 2)
    Cq = DRIVEN.jacobian(t, q)
    assert max(kept(DRIVEN, t, q, v)) < 1e-14 and np.abs(alone).max() > 0.05
    free = np.eye(3) - np.linalg.pinv(Cq) @ Cq
    assert np.abs(free @ alone[3:]).max() < 1e-14
    assert np.allclose(err, np.concatenate([free @ estimate[:3], free @ estimate[3:]]), rtol=0.0, atol=1e-13)


def test_each_set_up_is_run_beside_the_others_and_drawn_as_itself():
    added = {IDA_C_STATES: True, CVODE_C_PROJECTED: True, "CVODES, CasADi": False}
    assert {name: CATALOGUE[name].keeps_constraints for name in added} == added
    assert set(added) <= set(OTHER_SOLVERS) and len(set(OTHER_SOLVERS)) == len(OTHER_SOLVERS)
    assert [list(STYLES.values()).count(STYLES[name]) for name in added] == [1, 1, 1]
