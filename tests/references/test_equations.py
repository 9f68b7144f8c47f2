"""Test compiled accelerations and multipliers, and equations as expressions."""

import math
from functools import partial

import numpy as np
import pytest

from references.equations.accelerations import SINGULAR, Equations, cholesky, saddle_solve
from references.equations.expressions import Expressions, functions_of
from references.equations.rows import accelerations as least_norm
from references.equations.straight_line import straight_line
from references.scipy.index1 import solve_index1
from references.sundials.cvode_c import solve_cvode_c
from studies.validation.study import MAKE as PUBLISHED
from tests.compiled import PENDULUM
from tests.general.systems import SPRING, massless_coordinate
from tests.marks import slow, slow_but
from tests.mechanisms.make_references import solution
from tests.problems import pendulum, worst
from tests.problems import pendulum as plain_pendulum
from twoloop import ConstrainedSystem, Status, mechanisms, solve_dae
from twoloop.kernels.compile.callbacks import callback
from twoloop.mechanisms import (
    double_pendulum,
    four_bar,
    governor,
    heavy_top,
    knife_edge,
    n_four_bar,
    rolling_disc,
    spatial_four_bar,
    spatial_slider_crank,
    very_flexible_beam,
)


def accelerations(system, t, q, v):
    return Equations(system, t[0], np.array(q)[:, 0]).at_points(np.array(t), np.concatenate([q, v]))


@pytest.mark.slow
def test_singular_matrices():
    a, lam = accelerations(pendulum(), [0.0, 0.0], [[0.0, 1.0], [0.0, 0.0]], np.zeros((2, 2)))
    assert np.isnan(a[:, 0]).all() and np.isnan(lam[:, 0]).all()
    assert worst(a[:, 1], [0.0, -9.81]) == 0.0 and lam[0, 1] == 0.0
    with pytest.raises(ValueError, match="mass of 'pendulum' must be positive definite"):
        accelerations(pendulum(mass=lambda t, q: np.diag([1.0, 0.0])), [0.0], [[1.0], [0.0]], np.zeros((2, 1)))


@pytest.mark.parametrize(
    "make", [slow(each) for each in (four_bar, heavy_top, spatial_slider_crank, spatial_four_bar, governor)]
)
def test_a_mass_that_is_constant_or_singular_alone(make):
    problem = make()
    system, (t0, q, v) = problem.system, (0.0, problem.q0, problem.v0)
    a, lam = accelerations(system, [t0], q[:, None], v[:, None])
    known = solution(system, t0, q, v)
    size = max(1.0, *(np.abs(each).max() for each in known))
    assert worst(a[:, 0], known[0]) < 1e-11 * size and worst(lam[:, 0], known[1]) < 1e-11 * size


@pytest.mark.parametrize("seed", [slow(0), slow(3)])
def test_saddle_points_of_indefinite_matrices(seed):
    rng = np.random.default_rng(seed)
    M, Cq, Q, Qd = rng.normal(size=(6, 6)), rng.normal(size=(4, 6)), rng.normal(size=6), rng.normal(size=4)
    M += M.T
    M[seed] = M[:, seed] = 0.0
    a, lam = Q.copy(), Qd.copy()
    assert not cholesky(M.copy(), SINGULAR) and saddle_solve(M, Cq, a, lam)
    assert worst(M @ a + Cq.T @ lam, Q) < 1e-10 and worst(Cq @ a, Qd) < 1e-10
    Cq[3] = Cq[0] - Cq[1]  # dependent
    assert not saddle_solve(M, Cq, Q.copy(), Qd.copy())
    M[0, 0] = np.nan
    assert not saddle_solve(M, Cq, Q.copy(), Qd.copy())


def test_rounding_is_not_taken_for_mass():
    assert cholesky(np.diag([1e-9, 1.0, 1e9]), SINGULAR) and not cholesky(np.diag([1.0, 0.0]), SINGULAR)
    e = np.array([0.1, 0.7, 0.3])
    assert not cholesky(np.eye(3) * (e @ e) - np.outer(e, e), SINGULAR)  # its last pivot is some 1e-17


@pytest.mark.slow
@pytest.mark.parametrize("constant", [True, False])
def test_a_massless_coordinate_that_a_constraint_holds(constant):
    m = massless_coordinate()
    system = m.system() if constant else m.system(mass=lambda t, q: np.diag([1.0, 1.0, 0.0]))
    result = solve_index1(system, (0.0, 1.0), *m.start, rtol=1e-10, atol=1e-10, stabilisation="projection")
    assert result.success, result.message
    q, v = result.q[:, -1], result.v[:, -1]
    assert abs(m.energy(q, v) - m.energy(*m.start)) < 1e-8 and abs(result.lam[1, -1] + SPRING * q[2]) < 1e-11
    assert worst(system.constraint(1.0, q), 0.0) < 1e-14 and worst(system.jacobian(1.0, q) @ v, 0.0) < 1e-13


@pytest.mark.filterwarnings("ignore::twoloop.checks.consistency.ConstraintWarning")
@pytest.mark.parametrize("make", [mechanisms.double_pendulum, mechanisms.redundant_slider_crank])
def test_accelerations_and_multipliers_are_those_of_least_norm(make):
    problem = make()
    system, n = problem.system, problem.system.n_q
    motion = solve_dae(system, (0.0, 0.5), problem.q0, problem.v0)
    states = np.concatenate([motion.q, motion.v])
    states[0, 3] = np.nan
    found = np.concatenate(least_norm(system, motion.t, states))
    for k in (0, 2, -1):
        known = np.concatenate(solution(system, motion.t[k], states[:n, k], states[n:, k]))
        assert found[:, k] == pytest.approx(known, rel=1e-9, abs=1e-9)
    assert np.isnan(found[:, 3]).all()


NUMBERS = functions_of(math)  # "expressions" that are numbers
HOLONOMIC = [make for make in (*PUBLISHED, four_bar, very_flexible_beam) if make not in (knife_edge, rolling_disc)]


def known(problem):
    """Accelerations at the start, from the whole matrix of eq. (6)."""
    states = np.concatenate([problem.q0, problem.v0])[:, None]
    return least_norm(problem.system, np.zeros(1), states)[0][:, 0]


@pytest.mark.parametrize(
    "make",
    slow_but(HOLONOMIC[::3], HOLONOMIC),
    ids=lambda make: getattr(make, "__name__", str(getattr(make, "args", ""))),
)
def test_accelerations_of_every_mechanism(make):
    problem = make()
    made = Expressions(problem.system, 0.0, problem.q0, problem.v0)
    a = made.accelerations(NUMBERS, 0.0, problem.q0.tolist(), problem.v0.tolist())
    truth = known(problem)
    assert np.abs(np.array(a, dtype=float) - truth).max() < 1e-9 * max(1.0, np.abs(truth).max())


def test_redundant_rows_are_left_out_and_a_singular_mass_is_made_definite():
    bricard, top = next(make() for make in PUBLISHED if make().name == "A04 Bricard"), heavy_top()
    assert len(Expressions(bricard.system, 0.0, bricard.q0, bricard.v0).rows) == 59
    assert Expressions(top.system, 0.0, top.q0, top.v0).added == [0]  # e.e = 1
    pendulum = double_pendulum()
    assert Expressions(pendulum.system, 0.0, pendulum.q0, pendulum.v0).added == []


@pytest.mark.parametrize("make", [heavy_top, slow(four_bar), slow(partial(n_four_bar, 2))])
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
    truth = least_norm(system, np.array([0.3]), y[:, None])[0][:, 0]
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
