"""Errors, violations, digits and multipliers of a run, against numbers made by hand."""

from dataclasses import replace

import numpy as np
import pytest

from studies.bench import metrics
from studies.bench.collector import Case
from studies.bench.reference_motion import ReferenceMotion
from tests.problems import held_twice, pendulum, pendulum_problem, pendulum_state
from twoloop import solve_dae

T_END = 1.0
INSTANTS = np.linspace(0.0, T_END, 41)[1:]
MOTION = ReferenceMotion(lambda t: pendulum_state(t)[:2], 1e-13, "elliptic functions")


@pytest.fixture(scope="module")
def problem():
    return pendulum_problem(T_END)


@pytest.fixture(scope="module")
def good(problem):
    return solve_dae(problem.system, (0.0, T_END), problem.q0, problem.v0, rtol=1e-10, atol=1e-10)


def measured(problem, result, watched=None, conserved=True):
    told = {"n_instants": INSTANTS.size, "watched": watched, "conserved": conserved}
    return metrics.measure(Case("pendulum", problem, T_END, lambda: MOTION, **told), result)


def test_a_good_run(problem, good):
    row = measured(problem, good)
    assert row["error_q"] < 1e-8 and row["error_v"] < 1e-7 and abs(row["energy"]) < 1e-8 and row["scd"] > 8.0
    assert row["violation_q"] < 1e-13 and row["violation_v"] < 1e-13 and row["violation_a"] < 1e-12
    assert row["error_lam"] < 1e-6 and not row["lost"] and not row["astray"]


def test_each_measure_sees_its_own_fault_only(problem, good):
    base = measured(problem, good)
    row = measured(problem, replace(good, q=good.q + 0.01 * (good.t > 0.9)))
    assert row["error_q"] == pytest.approx(0.01, rel=0.1) and row["error_end"] == pytest.approx(0.01, rel=1e-6)
    assert row["violation_late"] > 1e-3 > base["violation_late"] and row["violation_early"] == base["violation_early"]
    assert row["error_v"] == base["error_v"] and row["error_lam"] == base["error_lam"]
    assert measured(problem, replace(good, lam=good.lam + 0.5))["error_lam"] == pytest.approx(0.5, rel=1e-3)
    assert measured(problem, replace(good, a=good.a + 1.0))["violation_a"] > 0.1


def test_lost_and_out_of_phase(problem, good):
    scale = metrics.Scale(problem, MOTION, INSTANTS, conserved=True)
    faster = replace(good, v=good.v * np.sqrt(1.0 + 2.0 * metrics.LOST))
    assert measured(problem, faster)["lost"] and not measured(problem, faster)["astray"]
    q = good.q.copy()
    q[0] += 1.5 * metrics.ASTRAY * scale.ranges[0]
    assert measured(problem, replace(good, q=q))["astray"]
    assert not measured(problem, replace(good, q=q), watched=(1,))["astray"]


def test_a_run_that_ended_early_has_no_error_and_is_lost(problem, good):
    cut = {name: getattr(good, name)[..., :4] for name in ("t", "q", "v", "a", "lam")}
    row = measured(problem, replace(good, **cut))
    assert row["error_q"] is None and row["lost"] and row["violation_q"] < 1e-13
    nothing = {name: getattr(good, name)[..., :0] for name in ("t", "q", "v", "a", "lam")}
    assert measured(problem, replace(good, **nothing)) == metrics.COLUMNS


def test_energy_is_judged_only_where_it_is_conserved(problem, good):
    row = measured(problem, good, conserved=False)
    assert row["energy"] is None and not row["lost"]


def test_interpolating_the_deviation_agrees_with_the_dense_solution(problem):
    """By either the error at common instants is that of the steps: no solver gains or loses by the sampling."""
    options = {"method": "Gauss8", "rtol": 1e-5, "atol": 1e-5}
    start = (problem.system, (0.0, T_END), problem.q0, problem.v0)
    free, dense = solve_dae(*start, **options), solve_dae(*start, **options, t_eval=np.append(0.0, INSTANTS))
    at_own_steps = np.abs(free.q - pendulum_state(free.t)[0]).max()
    assert 0.5 * at_own_steps < np.abs(metrics.deviation(free, MOTION, INSTANTS)[0]).max() < 1.5 * at_own_steps
    assert np.abs(dense.q - pendulum_state(dense.t)[0]).max() < 1.5 * at_own_steps


def test_correct_digits():
    deviation, truth = np.array([1e-6, 1e-3, 1.0]), np.array([1.0, 1e3, 0.0])
    assert metrics.correct_digits(deviation, truth) == pytest.approx(6.0)  # the zero has no relative error
    assert metrics.correct_digits(np.zeros(3), truth) == pytest.approx(17.0)


def test_multipliers_that_are_not_unique_are_not_compared():
    assert metrics.multipliers(held_twice(), 0.0, np.array([1.0, 0.0]), np.zeros(2)) is None
    one = metrics.multipliers(pendulum(), 0.0, *pendulum_state(0.0)[:2])
    assert one == pytest.approx(pendulum_state(0.0)[2])
