"""Calls from other starts and with other parameters: what is kept between them hides no mistake."""

from contextlib import nullcontext

import numpy as np
import pytest

from tests.compiled import heavy
from tests.problems import pendulum
from tests.test_bounds import FAR
from twoloop import ConstrainedSystem, callback, consistent_state, mechanisms, solve_dae
from twoloop.checks.scales import scales_of
from twoloop.checks.violation import Violation, surely_consistent
from twoloop.generate.families import family_of


@pytest.mark.parametrize(
    "name", ["redundant_slider_crank", "driven_crank", "rolling_disc", "spatial_four_bar", "bricard", "n_four_bar"]
)
@pytest.mark.filterwarnings("ignore::twoloop.ConstraintWarning")
def test_what_is_accepted_without_singular_values_is_accepted_by_them(name):
    problem, random = getattr(mechanisms, name)(), np.random.default_rng(4)
    system, n_sure, state = problem.system, 0, _state(problem)
    for _ in range(120):
        q, v = (x * (1.0 + 10.0 ** random.uniform(-15, -6) * random.standard_normal(len(x))) for x in state)
        rows, C, rates = system.rows(0.0, q), system.constraint(0.0, q), system.rates(0.0, q)
        if not surely_consistent(system, 0.0, q, v, system.mass(0.0, q), system.force(0.0, q, v), rows, C, rates):
            continue
        n_sure += 1
        jacobian = system.jacobian(0.0, q)
        Violation.of_position(system, 0.0, q, jacobian, scales_of(system, 0.0, q, jacobian)).refuse("q0")
        Violation.of_velocity(system, 0.0, q, v, rows, scales_of(system, 0.0, q, rows)).refuse("v0")
    assert 10 < n_sure < 120


def _state(problem):
    end = solve_dae(problem.system, (0.0, 0.2), problem.q0, problem.v0)
    q, v = consistent_state(problem.system, 0.2, end.q[:, -1], end.v[:, -1])
    return (q, v) if problem.system.given.get("constraint_rate") is None else (problem.q0, problem.v0)


def test_starts_that_another_solver_left_off_by_rounding_are_accepted_without_singular_values(monkeypatch):
    problem = mechanisms.redundant_slider_crank()
    q0 = problem.q0 * (1.0 + 1e-12 * np.random.default_rng(5).standard_normal(9))
    monkeypatch.setattr("twoloop.checks.consistency.Violation", None)
    with pytest.warns(UserWarning, match="have rank"):
        assert solve_dae(problem.system, (0.0, 0.1), q0, problem.v0).success
    with pytest.raises(AttributeError):
        solve_dae(problem.system, (0.0, 0.1), problem.q0 + 1e-6, problem.v0)


@callback("force")
def as_far_as_it_is_told(t, q, v, p, Q):
    Q[int(p[1] * FAR)] = -9.81 * p[0]


@pytest.mark.parametrize("wrong", [2.0, 0.7])
def test_bounds_are_looked_at_where_parameters_are_places(wrong):
    given = pendulum(compile=True).given | {"force": as_far_as_it_is_told, "mass": heavy}
    system = ConstrainedSystem(n_q=2, n_c=1, parameters=[1.3, 0.1 / FAR], **given)
    q0, v0 = [0.6, -0.8], [0.0, 0.0]
    for _ in range(2):
        assert solve_dae(system, (0.0, 0.1), q0, v0).success
        assert solve_dae(system.with_parameters([1.4, 0.2 / FAR]), (0.0, 0.1), q0, v0).success
    with pytest.raises(ValueError, match="goes out of bounds: index"):
        solve_dae(system.with_parameters([1.4, wrong]), (0.0, 0.1), q0, v0)


def test_bounds_are_looked_at_once_for_a_family():
    problem = mechanisms.four_bar()
    solve_dae(problem.system, (0.0, 0.1), problem.q0, problem.v0)
    other = problem.system.with_parameters(problem.system.parameters)
    assert not other.within_bounds
    family = family_of(other)
    assert {"mass", "force", "constraint", "jacobian", "gamma"} <= family.within_bounds <= family.traced


@callback("constraint")
def ellipse(t, q, p, C):
    C[0] = 0.5 * (p[0] * q[0] ** 2 + q[1] ** 2 - 1.0)


@callback("jacobian")
def of_one_ellipse(t, q, p, Cq):
    Cq[0, 0], Cq[0, 1] = 1.3 * q[0], q[1]


@callback("gamma")
def of_any_ellipse(t, q, v, p, Qd):
    Qd[0] = -(p[0] * v[0] ** 2 + v[1] ** 2)


def test_a_derivative_that_is_right_for_some_parameters_is_refused_for_others():
    given = pendulum(compile=True).given | {"jacobian": of_one_ellipse, "gamma": of_any_ellipse, "constraint": ellipse}
    system = ConstrainedSystem(n_q=2, n_c=1, parameters=[1.3], **given)
    for p in (1.3, 1.3001, 1.3, 1.7):
        with pytest.raises(ValueError, match="jacobian of") if p != 1.3 else nullcontext():
            q0 = [0.6 / np.sqrt(p), -0.8]
            assert solve_dae(system.with_parameters([p]), (0.0, 0.1), q0, [0.0, 0.0]).success
