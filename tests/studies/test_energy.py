"""The energy study: what its rows say of drift, how they come to say it, and that its sentences turn with them."""

import json
import math
from functools import partial
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from studies.bench.cli import Call
from studies.bench.collector import REPEATS, attempt
from studies.bench.render import render
from studies.bench.solvers import CVODE_C, CVODES, CYRK, DEFAULT, DIFFRAX, HEYOKA, IDA_C, IRK, OWN_EXPLICIT
from studies.bench.store import Output
from studies.energy import study as energy
from studies.energy.drift import DRIFTS, IRREGULAR, IS_LOST, NO_DRIFT, ROUNDS, SLOWLY, drift, verdict, windows
from studies.energy.runs import (
    BASIC,
    EVEN,
    GAUSS,
    LONG,
    MIDPOINT,
    MOMENTA,
    MOMENTA_EVEN,
    NEWMARK,
    ONE,
    QUICK,
    RADAU,
    REPEATED,
    SUN,
    SWITCHING,
    H,
    case_of,
    instants,
    linkage,
    measure,
    runs,
)
from studies.energy.study import pick
from tests.studies import of_study

STUDIED = energy
REPORTS = Path(__file__).parents[2] / "reports"
RIVALS = (HEYOKA, CVODE_C, CVODES, DIFFRAX)
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


@pytest.fixture
def found_of(tmp_path, unsaved):
    return partial(of_study.found_of, energy, tmp_path, quick=True)


def changed(rows, where, **values):
    place = rows.index[rows.eval(where, engine="python")]
    assert len(place), where
    for column, value in values.items():
        rows.loc[place, column] = value
    return rows


@pytest.mark.slow  # the quick study
def test_only_the_report_is_left(out):
    names = {"README.md", "energy.md", "energy.csv", "energy.json", "energy_series.npz", ".lock"}
    names |= {f"energy_{what}.{suffix}" for what in ("long", "cost") for suffix in ("png", "svg")}
    assert {path.name for path in out.iterdir()} == names


@pytest.mark.slow  # as that of step_size
class TestQuickRun(of_study.QuickRun):
    pictures = ("energy_long", "energy_cost")


def test_findings_answer_the_first_screen():
    found = json.loads((REPORTS / "energy.json").read_text())["long"]
    ours = found["no_drift"]["ours"]
    assert ours["calm"] and ours["keeps"] and ours["call_s"] > 0.0
    assert [at["share"] for at in found["at"]] == [1e-3, 1e-5, 1e-7]
    assert {IDA_C, "LSODA, index 1", "Exudyn, GeneralizedAlpha"} <= {run["solver"] for run in found["alternatives"]}


def test_the_full_report_is_short_with_all_rivals(rows):
    """The words of the longest verdict in each line of a rival; the quick rows lack those that are slow to compile."""
    wordy = {"slope": -1e-13, "slope_error": 1e-15, "swing": 1e-6, "n_steps": 10**6, "energy": 1.1e-9, "t_end": 1e4}
    more = rows[rows["solver"] == IDA_C].assign(**wordy)
    rows = pd.concat([rows, *(more.assign(solver=name, name=name) for name in RIVALS)], ignore_index=True)
    found = energy.findings_of(rows)
    text = render("energy", found, {"failed": ""}, stamp="stamp; of a commit; of a processor, 2 cores", quick=False)
    assert all(f"`{name}, tol" in text for name in RIVALS) and "(rounding)" in text
    prose = [line for line in text.splitlines() if not line.startswith(("|", "!["))]
    assert len(" ".join(prose).split()) < 700


@pytest.mark.slow  # the quick study
def test_other_solvers_have_rows_near_the_true_motion(quick):
    others = quick[quick["group"] == "other"]
    assert set(others["solver"]) >= {DEFAULT, OWN_EXPLICIT, IDA_C, "LSODA, index 1", "DOP853, projected"}
    assert others[others["tol"] < 1e-6]["error_q"].max() < 0.1


def test_sun_on_velocities_drifts_a_hundred_times_more(rows):
    sun = pick(rows, ONE, SUN)
    assert abs(sun["slope"]) > 100.0 * sun["slope_error"]
    for solver, variant in ((SUN, MOMENTA), (GAUSS, BASIC)):
        row = pick(rows, ONE, solver, variant)
        least = abs(sun["slope"]) / (abs(row["slope"]) + 3.0 * row["slope_error"])
        assert row["verdict"] == NO_DRIFT and least > 100.0


def test_what_is_neither_symmetric_nor_symplectic_drifts(rows):
    assert pick(rows, ONE, RADAU)["verdict"] == DRIFTS


@pytest.mark.slow  # the quick study
def test_across_changes_of_partition_only_symmetry_helps(quick):
    for solver in (GAUSS, SUN):
        assert pick(quick, SWITCHING, solver)["verdict"] == DRIFTS
    for variant in (EVEN, MOMENTA_EVEN):
        assert pick(quick, SWITCHING, SUN, variant)["verdict"] == SLOWLY
        assert pick(quick, SWITCHING, GAUSS, variant)["verdict"] == NO_DRIFT
    assert pick(quick, SWITCHING, MIDPOINT, EVEN)["verdict"] == NO_DRIFT


def test_newmark_does_not_drift_on_one_partition_and_does_across_changes(rows):
    assert pick(rows, ONE, NEWMARK)["verdict"] == NO_DRIFT
    assert pick(rows, SWITCHING, NEWMARK)["verdict"] in (DRIFTS, IS_LOST)


def test_variable_steps_drift(rows):
    for solver, variant in ((IRK, BASIC), (SUN, MOMENTA)):  # that of Gauss hardly shows in so short a run
        row = pick(rows, ONE, solver, variant, "controlled")
        assert row["verdict"] == DRIFTS and abs(row["slope"]) > 10.0 * row["slope_error"]


FIXED = "group == 'fixed' and case == "
ON_ONE = f"{FIXED}'{ONE}' and partition == 'lasting' and solver == "
TURNING = {  # finding: rows, what is changed in them; the finding is there before and not after
    "sun drifts": (lambda f: f["sun"]["drifts"], f"{ON_ONE}'{SUN}' and variables == 'velocities'", 0.0),
    "momenta do not": (lambda f: f["canonical"]["calm"], f"{ON_ONE}'{SUN}' and variables == 'momenta'", 1.0),
    "nor symmetry": (lambda f: f["gauss"]["calm"], f"{ON_ONE}'{GAUSS}' and variables == 'velocities'", 1.0),
    "none is calm": (lambda f: f["n_calm"]["lasting"] == 0, f"{FIXED}'{SWITCHING}' and solver == '{GAUSS}'", 0.0),
    "but the symmetric": (
        lambda f: f["n_calm"]["even"] == f["n"]["even"],
        f"{FIXED}'{SWITCHING}' and partition == 'symmetric'",
        1.0,
    ),
    "sun is not": (
        lambda f: f["n_calm"]["uneven"] == 0,
        f"{FIXED}'{SWITCHING}' and solver == '{SUN}' and partition == 'symmetric'",
        0.0,
    ),
    "the paper's drifts": (lambda f: f["paper"]["one"]["drifts"], f"solver == '{IRK}'", 0.0),
}


@pytest.mark.parametrize(("finding", "where", "slope"), TURNING.values(), ids=TURNING)
def test_findings_turn_with_the_rows(finding, where, slope, rows, found_of):
    assert finding(energy.findings_of(rows))
    assert not finding(found_of(changed(rows, where, slope_error=0.0, slope=slope)))


def test_all_controlled_runs_drift_or_not(rows, found_of):
    found = found_of(changed(rows.copy(), "group == 'controlled'", slope=1.0, slope_error=0.0))
    assert found["controlled_steady"] == [] and found["n_controlled"] > 0
    found = found_of(changed(rows, "group == 'controlled'", slope=0.0, slope_error=0.0))
    assert len(found["controlled_steady"]) == found["n_controlled"]
    assert found["paper"]["one"]["calm"] and found["paper"]["switching"]["calm"]


def repeated(rows, seconds=None):
    """The rows with five repetitions each, of times that scatter by half a percent."""
    rows = rows if seconds is None else rows.assign(call_s=seconds)
    times = [tuple(call_s * (1.0 + 1e-3 * k) for k in range(5)) for call_s in rows["call_s"]]
    return rows.assign(times=pd.Series(times, rows.index, dtype=object), repeats=5)


def long_found(rows):
    return energy.findings_of(rows)["long"]


def test_freedom_from_drift_pays_where_it_is_cheaper(rows):
    where = f"case == '{SWITCHING}'"
    rows = changed(rows, where, slope=1.0, slope_error=0.0, call_s=1.0, energy=1e-9)
    even = f"{FIXED}'{SWITCHING}' and solver == '{GAUSS}' and partition == 'symmetric'"
    pays = changed(rows.copy(), even, slope=0.0, call_s=0.1)
    found = long_found(repeated(pays))
    assert found["n_pays"] == len(found["at"]) == 3 and found["no_drift"]["others"] is None
    for cpu, undecided in ((0.98, 3), (1.02, 3), (10.0, 0)):
        found = long_found(repeated(changed(pays, even, call_s=cpu)))
        assert (found["n_pays"], found["n_undecided"]) == (0, undecided)
    assert long_found(repeated(changed(pays, where, slope=1.0)))["no_drift"]["ours"] is None


def test_times_of_energy_are_ranked_by_the_rule_of_the_other_comparisons(rows):
    """Five repetitions, beyond 5 %, also against runs whose error is a little too large; a single run ranks nothing."""
    here = rows["case"] == SWITCHING
    rows = changed(rows, f"case == '{SWITCHING}'", energy=1e-9, slope=1.0, slope_error=0.0)
    ours = rows["family"] == "two-loop"
    for seconds, ranked in ((1.0, "ahead"), (3.0, "behind"), (2.0, "undecided")):
        made = rows.assign(call_s=np.where(ours, seconds, 2.0))
        assert {at["verdict"] for at in long_found(repeated(made))["at"]} == {ranked}
        assert {at["verdict"] for at in long_found(made.assign(repeats=1))["at"]} == {"undecided"}
    level = 1e-5 * float(rows.loc[here, "kinetic"].iloc[0])
    near = rows.index[here & ~ours & (rows["solver"] == IDA_C)][:1]
    made = repeated(made.assign(call_s=np.where(ours, 1.0, 2.0)))
    made.loc[near, "energy"], made.loc[near, "call_s"] = 1.1 * level, 1.0
    made.at[near[0], "times"] = (1.0,) * 5
    verdicts = [at["verdict"] for at in long_found(made)["at"]]
    assert verdicts == ["undecided", "undecided", "ahead"]  # it is good enough, nearly good enough, and not


def test_what_sets_the_price_is_repeated():
    listed = list(runs(False))
    assert {run.repeats for run in listed if run.case.name == ONE} == {1}
    assert {run.solver.name for run in listed if run.repeats == REPEATS} == set(REPEATED)
    assert all(run.repeats == 1 for run in runs(True))


def test_failed_and_lost_runs_are_found(rows, found_of):
    rows = rows[~rows["solver"].isin((HEYOKA, CYRK))]  # which are not installed everywhere
    before = found_of(rows)["failed"]
    gone = {"status": "NOT_CONVERGED", "t_reached": 0.1, "slope": math.nan, "slope_error": math.nan}
    rows = changed(rows, f"{ON_ONE}'{RADAU}'", energy=math.nan, swing=math.nan, **gone)
    found = found_of(changed(rows, "solver == 'LSODA, index 1'", lost=True))
    assert found["failed"] == before + 1 and found["radau"]["status"] == "NOT_CONVERGED"
    lost = next(run for run in found["long"]["alternatives"] if run["solver"] == "LSODA, index 1")
    assert lost["verdict"] == IS_LOST and not lost["calm"]


def test_the_run_of_least_error_stands_for_a_solver(rows):
    more = rows[rows["solver"] == OWN_EXPLICIT].assign(tol=1e-7, energy=1e-12)
    found = energy.findings_of(pd.concat([rows, more], ignore_index=True))["long"]["alternatives"]
    assert [run["label"] for run in found if run["solver"] == OWN_EXPLICIT] == ["DOP853, compiled=False, tol 1e-7"]


def test_a_run_that_does_not_converge_is_a_row():
    run = next(run for run in runs(True) if run.solver.name == GAUSS and run.case.name == SWITCHING and run.value == H)
    run = type(run)(run.case, run.solver, 0.05)
    result, status, _, _ = attempt(run, 0)
    found = measure(run, result)
    assert status == "NOT_CONVERGED" and found["slope"] is None and 0.0 < found["t_reached"] < 75.0


def row_of(**changes):
    numbers = {"status": "REACHED_END", "lost": False, "kinetic": 10.0, "t_end": 1e4, "n_steps": 1_000_000}
    return pd.Series(numbers | {"slope": 1e-9, "slope_error": 1e-11, "swing": 1e-6, "t_reached": 1e4} | changes)


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({}, DRIFTS),
        ({"slope": -1e-9}, DRIFTS),
        ({"swing": 1e-4}, SLOWLY),
        ({"slope_error": 1e-9}, IRREGULAR),
        ({"slope_error": 1e-9, "swing": 1e-4}, NO_DRIFT),
        ({"slope": 0.0, "slope_error": 1e-11}, NO_DRIFT),
        ({"slope": 0.0, "slope_error": 1e-10}, IRREGULAR),  # no net slope, but 3e-6 J may hide in the scatter
        ({"slope": 1e-13, "slope_error": 1e-15}, ROUNDS),  # 1e-9 J; one rounding a step makes 2e-9 J
        ({"lost": True}, IS_LOST),
        ({"status": "NOT_CONVERGED", "t_reached": 12.5}, "not converged at 12.5 s"),
        ({"status": "NOT_AVAILABLE", "t_reached": math.nan}, "not available"),
    ],
)
def test_verdict(changes, expected):
    assert verdict(row_of(**changes)) == expected


def test_drift_finds_a_slope_under_an_oscillation():
    t = np.arange(100.0)
    slope, error = drift(t, 1e-3 * t + np.sin(2.4 * t))
    assert abs(slope - 1e-3) < 3.0 * error < 0.05


def test_a_random_walk_is_seldom_called_a_drift():
    generator = np.random.default_rng(1)
    t = np.arange(100.0)
    called = 0
    for _ in range(300):
        slope, error = drift(t, np.cumsum(generator.standard_normal(100)))
        called += abs(slope) > 3.0 * error
    assert called < 0.05 * 300  # expected 1.5 %


def test_a_slope_needs_windows():
    with pytest.raises(ValueError, match="needs 20 windows or more; given 19"):
        drift(np.arange(19.0), np.arange(19.0))


def test_what_wanders_and_comes_back_is_not_free_of_drift():
    t = np.linspace(0.0, 1e4, 100)
    for size, expected in ((1e-7, NO_DRIFT), (1e-4, IRREGULAR)):
        slope, error = drift(t, size * np.sin(2.0 * np.pi * t / 1e4))
        row = row_of(slope=0.0, slope_error=error)
        assert abs(slope) < 3.0 * error and verdict(row) == expected


def test_cheaper_runs_that_drift_are_told_beside_those_that_do_not(rows, found_of, tmp_path):
    own = f"case == '{SWITCHING}' and family == 'two-loop'"
    rows = changed(rows, own, slope=1.0, slope_error=0.0, call_s=9.0, energy=1e-9)
    even = f"{FIXED}'{SWITCHING}' and solver == '{GAUSS}' and partition == 'symmetric' and variables == 'velocities'"
    rows = changed(rows, even, slope=0.0, call_s=6.0)
    rows = changed(rows, f"case == '{SWITCHING}' and solver == '{OWN_EXPLICIT}'", call_s=2.0)
    found = found_of(rows)["long"]["calm_ours"]
    assert found["fixed"] and found["drifting_explicit"] and found["over_drifting"] == [3.0, 3.0]
    said = "have fixed steps, and take 3.0 times as long as explicit methods of ours whose energy drifts"
    assert said in (tmp_path / "energy.md").read_text()
    assert found_of(changed(rows, own, slope=1.0))["long"]["calm_ours"]["labels"] == []
    assert "None of ours is without drift." in (tmp_path / "energy.md").read_text()


def test_windows_are_whole_periods():
    t = np.linspace(0.0, 100.0, 200_001)
    seen = windows(t, 1e-3 * t + np.sin(2.0 * np.pi * t / PERIOD), PERIOD, 100.0)
    assert seen["t"].size == 44
    np.testing.assert_allclose(seen["mean"], 1e-3 * seen["t"], atol=1e-3)
    np.testing.assert_allclose(seen["range"], 2.0, atol=1e-2)


@pytest.mark.parametrize("h", [0.01, 0.02, 0.04, None])
@pytest.mark.parametrize("motion", [ONE, SWITCHING])
def test_long_runs_are_sampled_evenly_over_the_phases(h, motion):
    case, period = case_of(motion, LONG), linkage(motion)[1].period
    times = instants(case, h) if h else case.instants
    assert LONG - period < times[-2] < times[-1] == LONG
    if h:
        np.testing.assert_allclose(times / h, np.round(times / h), atol=1e-6)
    for first in (0, 3000):
        phases = np.sort(times[first : first + 200] / period % 1.0)
        assert np.diff(phases, append=phases[0] + 1.0).max() < 0.05


def test_short_runs_are_seen_at_every_step():
    assert instants(case_of(ONE, QUICK), 0.02) is None


def test_every_run_of_the_full_study_has_a_key_of_its_own():
    listed = list(runs(False))
    assert len({run.key(0) for run in listed}) == len(listed) < 125 and {run.case.t_end for run in listed} == {LONG}


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
