"""The energy study: what its rows say of drift, how they come to say it, and other solvers."""

import math
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from references.casadi.integrators import solve_sundials
from studies import energy
from studies.bench.cli import Call
from studies.bench.collector import REPEATS, attempt
from studies.bench.figures import STYLES
from studies.bench.solvers import CVODE_C, CVODES, CYRK, DEFAULT, DIFFRAX, HEYOKA, IDA_C, IRK, OWN_EXPLICIT
from studies.bench.store import Output
from tests.studies import of_study

REPORTS = Path(__file__).parents[2] / "reports"
PERIOD = 2.2489859198


@pytest.fixture(scope="module")
def loaded():
    """The committed rows."""
    return Output(Call("energy", False, REPORTS, False, "")).load_rows(curves=True)[0]


@pytest.fixture
def rows(loaded):
    return energy.judged(loaded)


@pytest.fixture
def quick(out):
    return energy.judged(Output(Call("energy", True, out, False, "")).load_rows(curves=True)[0])


@pytest.mark.slow  # as that of step_size
class TestQuickRun(of_study.QuickRun):
    pictures = ("energy_long", "energy_cost")


@pytest.mark.slow  # the quick study
def test_other_solvers_have_rows_near_the_true_motion(quick):
    others = quick[quick["group"] == "other"]
    assert set(others["solver"]) >= {DEFAULT, OWN_EXPLICIT, IDA_C, "LSODA, index 1", "DOP853, projected"}
    assert others[others["tol"] < 1e-6]["error_q"].max() < 0.1


def test_the_committed_rows_say_which_methods_drift(rows):
    sun = energy.pick(rows, energy.ONE, energy.SUN)
    assert abs(sun["slope"]) > 100.0 * sun["slope_error"]
    gauss = energy.pick(rows, energy.ONE, energy.GAUSS)
    least = abs(sun["slope"]) / (abs(gauss["slope"]) + 3.0 * gauss["slope_error"])
    assert gauss["verdict"] == energy.NO_DRIFT and least > 100.0
    assert (
        energy.pick(rows, energy.ONE, energy.RADAU)["verdict"] == energy.DRIFTS
        and energy.pick(rows, energy.ONE, energy.NEWMARK)["verdict"] == energy.NO_DRIFT
    )
    assert energy.pick(rows, energy.SWITCHING, energy.NEWMARK)["verdict"] in (energy.DRIFTS, energy.IS_LOST)
    paper = energy.pick(rows, energy.ONE, IRK, group="controlled")
    assert paper["verdict"] == energy.DRIFTS and abs(paper["slope"]) > 10.0 * paper["slope_error"]


def test_runs_have_keys_and_those_that_set_the_price_are_repeated():
    listed = list(energy.runs(False))
    assert len({run.key(0) for run in listed}) == len(listed) < 125 and {run.case.t_end for run in listed} == {
        energy.LONG
    }
    assert {run.repeats for run in listed if run.case.name == energy.ONE} == {1}
    assert {run.solver.name for run in listed if run.repeats == REPEATS} == set(energy.REPEATED)
    assert all(run.repeats == 1 for run in energy.runs(True))


def test_a_run_that_does_not_converge_is_a_row():
    run = next(
        run
        for run in energy.runs(True)
        if run.solver.name == energy.GAUSS and run.case.name == energy.SWITCHING and run.value == energy.H
    )
    run = type(run)(run.case, run.solver, 0.05)
    result, status, _, _ = attempt(run, 0)
    found = energy.measure(run, result)
    assert status == "NOT_CONVERGED" and found["slope"] is None and 0.0 < found["t_reached"] < 75.0


def row_of(**changes):
    numbers = {"status": "REACHED_END", "lost": False, "kinetic": 10.0, "t_end": 1e4, "n_steps": 1_000_000}
    return pd.Series(numbers | {"slope": 1e-9, "slope_error": 1e-11, "swing": 1e-6, "t_reached": 1e4} | changes)


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({}, energy.DRIFTS),
        ({"slope": -1e-9}, energy.DRIFTS),
        ({"swing": 1e-4}, energy.SLOWLY),
        ({"slope_error": 1e-9}, energy.IRREGULAR),
        ({"slope_error": 1e-9, "swing": 1e-4}, energy.NO_DRIFT),
        ({"slope": 0.0, "slope_error": 1e-11}, energy.NO_DRIFT),
        ({"slope": 0.0, "slope_error": 1e-10}, energy.IRREGULAR),  # no net slope, but 3e-6 J may hide in the scatter
        ({"slope": 1e-13, "slope_error": 1e-15}, energy.ROUNDS),  # 1e-9 J; one rounding a step makes 2e-9 J
        ({"lost": True}, energy.IS_LOST),
        ({"status": "NOT_CONVERGED", "t_reached": 12.5}, "not converged at 12.5 s"),
        ({"status": "NOT_AVAILABLE", "t_reached": math.nan}, "not available"),
    ],
)
def test_verdict(changes, expected):
    assert energy.verdict(row_of(**changes)) == expected


def test_drift_finds_a_slope_under_an_oscillation():
    t = np.arange(100.0)
    slope, error = energy.drift(t, 1e-3 * t + np.sin(2.4 * t))
    assert abs(slope - 1e-3) < 3.0 * error < 0.05


def test_a_random_walk_is_seldom_called_a_drift():
    generator = np.random.default_rng(1)
    t = np.arange(100.0)
    called = 0
    for _ in range(300):
        slope, error = energy.drift(t, np.cumsum(generator.standard_normal(100)))
        called += abs(slope) > 3.0 * error
    assert called < 0.05 * 300  # expected 1.5 %
    with pytest.raises(ValueError, match="needs 20 windows or more; given 19"):
        energy.drift(t[:19], t[:19])


def test_what_wanders_and_comes_back_is_not_free_of_drift():
    t = np.linspace(0.0, 1e4, 100)
    for size, expected in ((1e-7, energy.NO_DRIFT), (1e-4, energy.IRREGULAR)):
        slope, error = energy.drift(t, size * np.sin(2.0 * np.pi * t / 1e4))
        row = row_of(slope=0.0, slope_error=error)
        assert abs(slope) < 3.0 * error and energy.verdict(row) == expected


def test_windows_are_whole_periods():
    t = np.linspace(0.0, 100.0, 200_001)
    seen = energy.windows(t, 1e-3 * t + np.sin(2.0 * np.pi * t / PERIOD), PERIOD, 100.0)
    assert seen["t"].size == 44
    np.testing.assert_allclose(seen["mean"], 1e-3 * seen["t"], atol=1e-3)
    np.testing.assert_allclose(seen["range"], 2.0, atol=1e-2)


@pytest.mark.parametrize("h", [0.01, 0.02, 0.04, None])
@pytest.mark.parametrize("motion", [energy.ONE, energy.SWITCHING])
def test_long_runs_are_sampled_evenly_over_the_phases(h, motion):
    case, period = energy.case_of(motion, energy.LONG), energy.linkage(motion)[1].period
    times = energy.instants(case, h) if h else case.instants
    assert energy.LONG - period < times[-2] < times[-1] == energy.LONG
    if h:
        np.testing.assert_allclose(times / h, np.round(times / h), atol=1e-6)
        assert energy.instants(energy.case_of(motion, energy.QUICK), h) is None
    for first in (0, 3000):
        phases = np.sort(times[first : first + 200] / period % 1.0)
        assert np.diff(phases, append=phases[0] + 1.0).max() < 0.05


def test_a_run_counts_as_good_as_the_worst_of_the_tighter_ones():
    made = pd.DataFrame(
        {
            "name": ["a"] * 4 + ["b"] * 2,
            "tol": [1e-6, 1e-7, 1e-8, np.nan, 1e-6, 1e-8],
            "h": [np.nan] * 3 + [0.1, np.nan, np.nan],
            "energy": [1e-4, -1e-2, 1e-5, 1e-9, 1e-3, np.nan],
            "status": ["REACHED_END"] * 5 + ["SOLVER_FAILED"],
            "lost": [False] * 5 + [None],
        }
    )
    assert energy.settled(made).tolist() == [1e-2, 1e-2, 1e-5, 1e-9, np.inf, np.inf]


PACKAGES = {HEYOKA: "heyoka", CYRK: "CyRK", CVODE_C: "sksundae", CVODES: "casadi", DIFFRAX: "diffrax"}


def test_the_other_solvers_are_among_the_runs():
    full, quick = ({run.solver.name for run in energy.runs(short)} for short in (False, True))
    assert set(PACKAGES) <= full and quick == full - set(energy.NOT_QUICK) and set(PACKAGES) <= set(STYLES)


def start(case):
    return case.problem.q0, case.problem.v0


def test_a_long_run_may_take_as_many_steps_as_it_needs():
    """The limit of the other studies, which have no clock in it, would end a long run."""
    pytest.importorskip("casadi")
    case = energy.case_of(energy.SWITCHING, energy.QUICK)
    assert energy.OTHERS[CVODES][1](case, 1e-8, 0).stats.n_accepted > 1000
    span = (0.0, case.t_end)
    few = solve_sundials(case.problem.system, span, *start(case), "BDF", 1e-4, 1e-4, most_steps=100)
    assert not few.success and few.t.size == 0
    run = next(run for run in energy.runs(False) if run.solver.name == CVODES)
    assert energy.measure(type(run)(case, run.solver, 1e-4, "other", 1), few)["t_reached"] == 0.0  # a row, all the same
    with pytest.raises(ValueError, match="most_steps"):
        solve_sundials(case.problem.system, span, *start(case), most_steps=0)
