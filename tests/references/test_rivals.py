"""Solvers of other projects that take expressions: what they refuse, and how they fail."""

import numpy as np
import pytest

from references.casadi.integrators import solve_collocation
from references.sundials.cvode_c import solve_cvode_c
from twoloop import ConstrainedSystem, callback
from twoloop.mechanisms import four_bar
from twoloop.run.record import Status

PROBLEM = four_bar()


def test_systems_without_expressions_are_refused():
    pytest.importorskip("sksundae")
    plain = ConstrainedSystem.from_python(
        n_q=2,
        n_c=1,
        mass=np.eye(2),
        force=lambda t, q, v: np.array([0.0, -9.81]),
        constraint=lambda t, q: np.array([0.5 * (q @ q - 1.0)]),
        jacobian=lambda t, q: q[None, :],
        gamma=lambda t, q, v: np.array([-(v @ v)]),
    )
    with pytest.raises(ValueError, match="are Python functions, not compiled ones"):
        solve_cvode_c(plain, (0.0, 1.0), [1.0, 0.0], [0.0, 0.0])


def test_wrong_arguments_are_named():
    start = PROBLEM.system, (0.0, 1.0), PROBLEM.q0, PROBLEM.v0
    with pytest.raises(ValueError, match="n_steps"):
        solve_collocation(*start, 0)


@callback("mass")
def mass(t, q, p, M):
    M[0, 0] = M[1, 1] = 1.0


@callback("force")
def endless(t, q, v, p, Q):
    Q[1] = -9.81 / (1.0 - t) ** 2


@callback("force")
def branching(t, q, v, p, Q):
    Q[1] = -9.81 if t < 1.0 else -4.9


@callback("constraint")
def constraint(t, q, p, C):
    C[0] = 0.5 * (q[0] * q[0] + q[1] * q[1] - 1.0)


@callback("jacobian")
def jacobian(t, q, p, Cq):
    Cq[0, 0], Cq[0, 1] = q[0], q[1]


@callback("gamma")
def gamma(t, q, v, p, Qd):
    Qd[0] = -v[0] * v[0] - v[1] * v[1]


def pendulum(force):
    functions = {"mass": mass, "force": force, "constraint": constraint, "jacobian": jacobian, "gamma": gamma}
    return ConstrainedSystem(n_q=2, n_c=1, name="pendulum", **functions)


def test_a_failure_of_cvode_is_a_result_with_what_came_before_it():
    pytest.importorskip("sksundae")
    result = solve_cvode_c(pendulum(endless), (0.0, 2.0), [1.0, 0.0], [0.0, 0.0], t_eval=[0.0, 0.5, 1.5])
    assert result.status is Status.SOLVER_FAILED and "CVODE failed after t = " in result.message
    assert result.t.tolist() == [0.0, 0.5] and np.isfinite(result.q).all()


def test_callbacks_that_branch_are_refused():
    pytest.importorskip("sksundae")
    with pytest.raises(ValueError, match="force of 'pendulum': it branches on"):
        solve_cvode_c(pendulum(branching), (0.0, 2.0), [1.0, 0.0], [0.0, 0.0])
