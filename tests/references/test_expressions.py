"""Equations as expressions: the accelerations of every mechanism, the program that is made of them."""

import math
from functools import partial

import numpy as np
import pytest

from references.equations import expressions
from references.equations.expressions import Expressions, NotSymbolic, functions_of
from references.equations.least_norm import accelerations
from references.equations.straight_line import Program, Value, program_of, straight_line
from references.sundials.cvode_c import solve_cvode_c
from studies.validation.study import MAKE
from tests.compiled import PENDULUM
from tests.problems import pendulum as plain_pendulum
from twoloop import ConstrainedSystem, Status
from twoloop.kernels.compile.callbacks import callback
from twoloop.mechanisms import double_pendulum, four_bar, heavy_top, n_four_bar, very_flexible_beam

NUMBERS = functions_of(math)  # "expressions" that are numbers
HOLONOMIC = [make for make in (*MAKE, four_bar, very_flexible_beam) if make().system.n_a == 0]


def known(problem):
    """Accelerations at the start, from the whole matrix of eq. (6)."""
    states = np.concatenate([problem.q0, problem.v0])[:, None]
    return accelerations(problem.system, np.zeros(1), states)[0][:, 0]


@pytest.mark.parametrize("make", HOLONOMIC, ids=lambda make: make().name)
def test_accelerations_of_every_mechanism(make):
    problem = make()
    made = Expressions(problem.system, 0.0, problem.q0, problem.v0)
    a = made.accelerations(NUMBERS, 0.0, problem.q0.tolist(), problem.v0.tolist())
    truth = known(problem)
    assert np.abs(np.array(a, dtype=float) - truth).max() < 1e-9 * max(1.0, np.abs(truth).max())


def test_redundant_rows_are_left_out_and_a_singular_mass_is_made_definite():
    bricard, top = next(make() for make in MAKE if make().name == "A04 Bricard"), heavy_top()
    assert len(Expressions(bricard.system, 0.0, bricard.q0, bricard.v0).rows) == 59
    assert Expressions(top.system, 0.0, top.q0, top.v0).added == [0]  # e.e = 1
    pendulum = double_pendulum()
    assert Expressions(pendulum.system, 0.0, pendulum.q0, pendulum.v0).added == []


def test_elimination_fills_little():
    operations = []
    for n in (5, 10, 20):
        problem = n_four_bar(n)
        operations.append(len(program_of(Expressions(problem.system, 0.0, problem.q0, problem.v0))[0].names))
    assert operations[2] - operations[1] == pytest.approx(2 * (operations[1] - operations[0]), rel=0.02)  # linear in n


@pytest.mark.parametrize(("make", "most"), [(four_bar, 239), (heavy_top, 329)])
def test_other_solvers_get_accelerations_of_few_operations(make, most):
    problem = make()
    assert len(program_of(Expressions(problem.system, 0.0, problem.q0, problem.v0))[0].names) <= most


def test_a_mass_that_no_rows_make_definite_is_refused():
    with pytest.raises(NotSymbolic, match="stays singular"):
        expressions._rows_for_mass(np.diag([1.0, 0.0]), np.array([[1.0, 0.0]]))


def test_a_program_writes_each_operation_once():
    program = Program()
    x, y = Value(program, "x"), Value(program, "y")
    assert (x * y).name == (y * x).name and len(program.names) == 1 and (x - y).name != (y - x).name


@pytest.mark.parametrize("make", [four_bar, heavy_top, partial(n_four_bar, 2)])
def test_straight_line_code_is_the_right_hand_side(make):
    problem = make()
    n = problem.q0.size
    y, rate = np.concatenate([problem.q0, problem.v0]), np.full(2 * n, np.nan)
    straight_line(problem.system, 0.0, problem.q0.tobytes(), problem.v0.tobytes())(0.0, y, rate)
    assert np.array_equal(rate[:n], problem.v0)
    truth = known(problem)
    assert np.abs(rate[n:] - truth).max() < 1e-10 * max(1.0, np.abs(truth).max())


@callback("force")
def pushed(t, q, v, p, Q):  # type: ignore[no-untyped-def]
    Q[0] = -p[p.size - 1] * math.tanh(v[0] / 0.1) + math.exp(-(((t - 0.5) / 0.2) ** 2)) - math.atan(q[0]) ** 3
    Q[1] = -9.81 + np.log(1.0 + np.exp(q[1]))


def test_forces_of_exponentials_and_their_like_are_written_as_code():
    problem = four_bar()
    given = problem.system.given | {"force": pushed}
    n, p = problem.q0.size, np.append(problem.system.parameters, 2.0)
    system = ConstrainedSystem(n_q=n, n_c=problem.system.n_c, parameters=p, **given)
    y, rate = np.concatenate([problem.q0, problem.v0 + 0.3]), np.full(2 * n, np.nan)
    straight_line(system, 0.0, problem.q0.tobytes(), problem.v0.tobytes())(0.3, y, rate)
    truth = accelerations(system, np.array([0.3]), y[:, None])[0][:, 0]
    assert np.abs(rate[n:] - truth).max() < 1e-10 * np.abs(truth).max()


# --- what solvers of expressions refuse, and how they fail
def test_systems_without_expressions_are_refused():
    with pytest.raises(ValueError, match="are Python functions, not compiled ones"):
        solve_cvode_c(plain_pendulum(), (0.0, 1.0), [1.0, 0.0], [0.0, 0.0])


@callback("force")
def endless(t, q, v, p, Q):
    Q[1] = -9.81 / (1.0 - t) ** 2


@callback("force")
def branching(t, q, v, p, Q):
    Q[1] = -9.81 if t < 1.0 else -4.9


def test_a_failure_of_cvode_is_a_result_with_what_came_before_it():
    result = solve_cvode_c(
        ConstrainedSystem(**{**PENDULUM, "force": endless}), (0.0, 2.0), [1.0, 0.0], [0.0, 0.0], t_eval=[0.0, 0.5, 1.5]
    )
    assert result.status is Status.SOLVER_FAILED and "CVODE failed after t = " in result.message
    assert result.t.tolist() == [0.0, 0.5] and np.isfinite(result.q).all()


def test_callbacks_that_branch_are_refused():
    with pytest.raises(ValueError, match="force of 'pendulum': it branches on"):
        solve_cvode_c(ConstrainedSystem(**{**PENDULUM, "force": branching}), (0.0, 2.0), [1.0, 0.0], [0.0, 0.0])
