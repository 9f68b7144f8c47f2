"""Test fixed-step BDF on the index-3 form: order, constraints, the start, failures."""

import numpy as np
import pytest
from numba import njit

from references.paper import gear
from references.paper.four_bar_minimal import trajectory
from references.paper.gear import HIGHEST, STARTS, _formulas, solve_gear
from tests.problems import force_residual, moving_pivot, moving_pivot_state, pendulum, violations, worst
from twoloop.kernels.compile.caches import digests_of
from twoloop.mechanisms import four_bar
from twoloop.run.record import Status

PROBLEM = four_bar()


def run(t_end, step, order, **options):
    return solve_gear(PROBLEM.system, (0.0, t_end), PROBLEM.q0, PROBLEM.v0, step, order, **options)


def slopes(order, steps, **options):
    """Observed orders of q and v at 0.6 s."""
    q, v = trajectory(PROBLEM.parameters, [0.6])
    ends = [run(0.6, step, order, **options) for step in steps]
    errors = np.array([[worst(r.q[:, -1], q[:, 0]), worst(r.v[:, -1], v[:, 0])] for r in ends])
    return np.log(errors[0] / errors[-1]) / np.log(steps[0] / steps[-1])


@pytest.mark.parametrize("order", range(1, HIGHEST + 1))
def test_formulas_are_exact_for_polynomials_of_their_order(order):
    b, alpha, weights = np.split(_formulas()[order - 1], [1, 1 + HIGHEST])
    nodes = -np.arange(1.0, HIGHEST + 1.0)
    for power in range(order + 1):
        at_0, rate_at_0 = float(power == 0), float(power == 1)
        assert b[0] * rate_at_0 + alpha @ nodes**power == pytest.approx(at_0, abs=1e-12)
        if power < order:
            assert weights @ nodes**power == pytest.approx(at_0, abs=1e-12)
    assert not alpha[order:].any() and not weights[order:].any()


@pytest.mark.parametrize("order", [1, 2, 3, 4, 5])
@pytest.mark.slow
def test_order_with_an_accurate_start(order):
    assert np.abs(slopes(order, (4e-3, 2e-3), start="accurate") - order).max() < 0.3


@pytest.mark.parametrize("order", [2, 4, 6])
@pytest.mark.slow
def test_the_ramp_limits_the_order_to_two(order):
    assert np.abs(slopes(order, (4e-3, 2e-3)) - 2.0).max() < 0.1


@pytest.mark.parametrize("start", STARTS)
@pytest.mark.parametrize("order", range(1, HIGHEST + 1))
@pytest.mark.slow
def test_positions_keep_the_constraints_and_velocities_nearly(order, start):
    coarse, fine = (run(2.0, step, order, start=start) for step in (0.01, 0.005))
    assert violations(PROBLEM.system, coarse)[0] < 1e-12 and violations(PROBLEM.system, fine)[0] < 1e-12
    before, after = (violations(PROBLEM.system, result)[1] for result in (coarse, fine))
    assert 1e-6 < after < before / 1.5  # asked for by nothing, an error of the formula
    assert force_residual(PROBLEM.system, fine) < 1e-8


@pytest.mark.slow
def test_ramp_begins_with_half_of_the_centripetal_acceleration():
    """On a unit circle without gravity lam = v^2 = 4, at any step."""
    system = pendulum(force=lambda t, q, v: np.zeros(2))
    for step in (1e-2, 1e-3):
        ramp, accurate = (
            solve_gear(system, (0.0, 20 * step), [0.0, -1.0], [2.0, 0.0], step, 3, start=start).lam[0]
            for start in ("ramp", "accurate")
        )
        assert ramp[0] == pytest.approx(4.0) and ramp[1] == pytest.approx(2.0, rel=1e-3)
        assert worst(ramp[-5:], 4.0) < 0.01 and worst(accurate, 4.0) < 0.01


@pytest.mark.parametrize("order", [2, 3])
@pytest.mark.slow
def test_time_dependent_constraints(order):
    system = moving_pivot(gamma=False)
    q, v = moving_pivot_state(0.0)
    errors = []
    for step in (0.01, 0.005):
        result = solve_gear(system, (0.0, 1.0), q, v, step, order, start="accurate")
        errors.append(worst(result.q, moving_pivot_state(result.t)[0]))
    assert errors[0] < 3e-3 and abs(np.log2(errors[0] / errors[1]) - order) < 0.3


@pytest.mark.parametrize("start", STARTS)
@pytest.mark.slow
def test_stores_every_step_or_those_asked_for(start):
    full = run(0.5, 0.01, 3, start=start)
    assert full.t.size == 51 and full.h.size == full.stats.n_accepted == 50 and full.t[-1] == pytest.approx(0.5)
    assert full.q.shape == full.v.shape == full.a.shape == (9, 51) and full.lam.shape == (8, 51)
    assert np.array_equal(full.q[:, 0], PROBLEM.q0) and np.isfinite(full.a).all() and np.isfinite(full.lam).all()
    some = run(0.5, 0.01, 3, start=start, t_eval=[0.01, 0.2, 0.5])
    assert np.array_equal(some.q, full.q[:, [1, 20, 50]]) and np.array_equal(some.lam, full.lam[:, [1, 20, 50]])
    assert np.allclose(some.t, [0.01, 0.2, 0.5], rtol=0.0, atol=1e-12) and some.h.size == 50


@pytest.mark.slow
def test_machine_code_on_disk_follows_the_factorisations_that_it_holds(monkeypatch):
    before = digests_of(gear._integrate.py_func)
    assert before is not None and digests_of(gear._integrate.py_func) == before
    monkeypatch.setattr(gear, "lu_factor", njit(lambda A, pivots: True))
    assert digests_of(gear._integrate.py_func) != before


@pytest.mark.slow
def test_too_large_a_step_comes_back_as_a_row():
    result = run(10.0, 0.1, 3)
    assert result.status is Status.SOLVER_FAILED and not result.success
    assert "order 3 failed in the step to t = 1:" in result.message and "smaller step" in result.message
    assert result.t[-1] == pytest.approx(0.9) and result.stats.n_accepted == result.h.size == result.t.size - 1 == 9


@pytest.mark.slow
def test_failure_of_the_accurate_start_comes_back_as_a_row():
    system = pendulum(force=lambda t, q, v: np.array([0.0, -9.81 if t < 0.015 else np.nan]))
    result = solve_gear(system, (0.0, 2.0), [1.0, 0.0], [0.0, 0.0], 0.01, 4, start="accurate")
    assert result.status is Status.SOLVER_FAILED and "The accurate start failed. DOP853" in result.message
    assert np.array_equal(result.t, [0.0, 0.01])
