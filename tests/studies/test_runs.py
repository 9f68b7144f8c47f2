"""Rows say what a run was: errors against the truth, lost or out of phase, failures as rows."""

from dataclasses import replace
from functools import partial

import numpy as np
import pandas as pd
import pytest

from references.exudyn_four_bar import solve_exudyn
from studies.runs import ASTRAY, LOST, Job, Truth, collect, time_for
from twoloop import paper_irk, solve_dae
from twoloop.mechanisms import four_bar

T_END = 2.0


@pytest.fixture(scope="module")
def problem():
    return four_bar()


@pytest.fixture(scope="module")
def truths(problem):
    return {problem.name: Truth(problem)}


def job(problem, change=lambda result: result, **options):
    def run(k):
        return change(solve_dae(problem.system, (0.0, T_END), problem.q0, problem.v0, **options))

    return Job("test", "ours", problem, run, {"tol": 1e-8}, repeats=1)


def row(problem, truths, *args, **options):
    return collect([job(problem, *args, **options)], truths, T_END).iloc[0]


def test_a_good_run_is_neither_lost_nor_astray(problem, truths):
    good = row(problem, truths)
    assert good["error_q"] < 1e-7 and good["error_v"] < 1e-6 and good["energy"] < 1e-6
    assert good["violation_q"] < 1e-13 and good["violation_v"] < 1e-13
    assert not good["lost"] and not good["astray"]
    assert good["n_evaluations"] > 0 and good["cpu_s"] > 0.0


def test_energy_and_phase_criteria_are_computed_from_the_trajectory(problem, truths):
    truth = truths[problem.name]

    def faster(result):  # kinetic energy up by more than the limit
        return replace(result, v=result.v * np.sqrt(1.0 + 2.0 * LOST))

    def higher(result):  # y3 off by more than the limit: astray, and potential energy off too
        q = result.q.copy()
        q[7] += 1.5 * ASTRAY * truth.range_y3
        return replace(result, q=q)

    lost, astray = row(problem, truths, faster), row(problem, truths, higher)
    assert lost["lost"] and not lost["astray"]
    assert astray["astray"] and not astray["lost"]
    assert astray["error_q"] == pytest.approx(1.5 * ASTRAY * truth.range_y3, rel=1e-4)


def test_a_failed_run_is_a_row(problem, truths):
    failed = row(problem, truths, max_steps=3)
    assert failed["status"] == "MAX_STEPS" and failed["lost"] and np.isnan(failed["error_q"])
    run = partial(lambda k, h: solve_exudyn(problem, T_END, round(T_END / h)), h=0.1)
    foreign = collect([Job("test", "Exudyn", problem, run, {"h": 0.1}, 1)], truths, T_END).iloc[0]
    assert foreign["status"] == "SOLVER_FAILED" and foreign["lost"] and foreign["message"]


def rows_of(**columns):
    return pd.DataFrame(columns, dtype=float)


def test_time_for_an_error_lies_on_the_line_between_two_runs():
    rows = rows_of(error_q=[1e-2, 1e-4, 1e-6], cpu_s=[1.0, 10.0, 100.0])
    assert time_for(rows, 1e-3) == pytest.approx(10.0**0.5)
    assert time_for(rows, 1e-6) == pytest.approx(100.0)
    assert time_for(rows, 1.0) == 1.0  # better than asked: the cheapest run, nothing extrapolated
    assert np.isnan(time_for(rows, 1e-7))


def test_time_for_an_error_takes_the_cheapest_that_is_good_and_leaves_failures_out():
    rows = rows_of(error_q=[1e-2, 1e-4, 1e-6, np.nan], cpu_s=[1.0, 10.0, 2.0, 0.1])
    assert time_for(rows, 1e-4) == 2.0
    assert np.isnan(time_for(rows_of(error_q=[np.nan], cpu_s=[1.0]), 1.0))


def test_a_solver_that_is_not_there_is_a_row(problem, truths):
    def run(k):
        raise RuntimeError("no such library")

    missing = collect([Job("test", "foreign", problem, run, {"tol": 1e-8}, 1)], truths, T_END).iloc[0]
    assert missing["status"] == "SOLVER_FAILED" and missing["message"] == "no such library" and missing["lost"]


def test_a_study_adds_columns_of_its_own(problem, truths):
    def measure(job, result, truth):
        return {"last": result.t[-1], "period": truth.minimal.period, "steps": result.h}

    rows = collect([job(problem)], truths, T_END, measure)
    assert rows["last"][0] == T_END and rows["period"][0] == truths[problem.name].minimal.period
    assert rows["steps"][0].sum() == pytest.approx(T_END)


def test_cost_for_an_error_can_be_a_count():
    rows = rows_of(error_q=[1e-2, 1e-4], cpu_s=[1.0, 10.0], n_evaluations=[100.0, 10000.0])
    assert time_for(rows, 1e-3, "n_evaluations") == pytest.approx(1000.0)


def test_repeats_give_the_same_counts(problem, truths):
    runs = [row(problem, truths, method=paper_irk(), rtol=1e-5, atol=1e-5) for _ in range(2)]
    for key in ("n_steps", "n_evaluations", "n_inner", "n_outer", "error_q"):
        assert runs[0][key] == runs[1][key]


def test_truth_describes_the_motion(truths, problem):
    truth = truths[problem.name]
    assert truth.minimal.period == pytest.approx(problem.reference.period, abs=1e-12)
    assert truth.in_line == {"θ1": 2, "θ2": 0, "θ3": 2}
    at_rest = problem.energy(0.0, problem.q0, problem.v0)
    assert 0.0 < truth.kinetic < at_rest + 9.81 * 4.5 * 1.5  # no more than all bars hanging straight down
