"""The beam study: its measures, its sentences on changed rows, the quick run."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from studies.beam import runs as beam_runs
from studies.beam import study
from studies.beam.limits import (
    CHANGES,
    GAUSS_SEIDEL,
    JACOBI,
    MESH,
    START,
    STOPPED_AT,
    frequencies,
    gauss_seidel_limit,
    jacobi_limit,
)
from studies.beam.runs import DIFFERENCES, EXUDYN, NEWTON, PAPER, cases, measure, runs
from studies.beam.study import TARGETS, findings_of
from studies.bench import index
from studies.bench.cases import load
from studies.bench.cases.beam import MAKE, SOFT, STIFF
from studies.bench.cli import StudyError
from studies.bench.collector import Run, attempt
from studies.bench.solvers import IDA_C, IDA_C_ORDER_2, NEWMARK, OWN_EXPLICIT, PAPER_TOL, QUARTER, OTHER_SOLVERS
from studies.bench.tables import UNASKED
from tests.studies.of_study import GOOD, QuickRun, found_of
from twoloop import solve_dae
from twoloop.methods.tableaux import gauss, sun_radau_iib

STUDIED = study
W_MAX = {SOFT: 3358.5, STIFF: 33585.0}


def rows(t_end=2.0):
    """Rows like those of a full run, made up: medians of three solvers' runs and of all else."""
    common = GOOD | {"group": "run", "t_end": t_end, "floor": 1e-9}
    common |= {"called_from": "compiled", "keeps_constraints": True, "violation_q": 1e-17, "violation_v": 1e-17}
    common |= {"energy": np.nan, "n_rejected": 100.0, "n_rejected_convergence": 80.0, "tol": np.nan, "h": np.nan}
    times = {PAPER: 5.0, NEWMARK: 2.0, QUARTER: 1.0, "BDF": 0.3, NEWTON: 0.05, OWN_EXPLICIT: 0.2, IDA_C: 0.4}
    times |= {IDA_C_ORDER_2: 0.1, DIFFERENCES: 0.06, EXUDYN: 0.5}
    families = {IDA_C: "SUNDIALS", IDA_C_ORDER_2: "SUNDIALS", EXUDYN: "Exudyn"}
    made = []
    for case, factor in ((SOFT, 1.0), (STIFF, 10.0)):
        for solver, seconds in times.items():
            for k, error in enumerate((4e-2, 5e-3, 5e-4, 5e-5)):
                line = {"case": case, "solver": solver, "family": families.get(solver, "two-loop"), "error_q": error}
                line |= {"error_tip": error, "call_s": factor * seconds * (k + 1), "n_evaluations": factor * 1e5}
                line |= {"n_steps": factor * 1e3, "h_median": 1.0 / W_MAX[case]}
                made.append({**common, **line, "tol": PAPER_TOL if solver == PAPER and k == 3 else 10.0**-k})
    for solver, theory in ((GAUSS_SEIDEL, 3.221), (JACOBI, 4.64)):
        made.append({"group": "limit", "solver": solver, "theory": theory, "w_max": W_MAX[SOFT]})
    for tol, measured in zip(STOPPED_AT, (0.9, 0.45, 0.11), strict=True):
        made.append({"group": "growth test", "solver": GAUSS_SEIDEL, "tol": tol, "measured": measured})
    for case, w_max in W_MAX.items():
        for k, measured in enumerate((0.03, 0.9, 1.1, 1.5)):
            made.append({"group": "along", "case": case, "measured": measured, "straight": w_max, "t_end": 0.1 * k})
        for change in CHANGES:
            largest = {MESH: 0.4 if case == SOFT else 0.03, START: 0.4 if case == SOFT else 3e-4}.get(change, 1e-3)
            made.append({"group": "sensitivity", "case": case, "solver": change, "before": largest, "largest": largest})
    return pd.DataFrame(made)


@pytest.mark.usefixtures("unsaved")
def test_the_advice_turns_with_the_rows(tmp_path):
    found = found_of(study, tmp_path, rows())["cases"][1]
    assert [at["error"] for at in found["at"]] == [1e-2, 1e-3, 1e-4, 1e-5] == [*TARGETS, study.FINER]
    assert found["at"][0]["best"]["solver"] == NEWTON
    assert found["at"][0]["ours"]["call_s"] == pytest.approx(0.79, abs=0.01)
    assert found["at"][0]["others"]["call_s"] == pytest.approx(1.59, abs=0.02)
    made = rows()
    made.loc[made["solver"] == IDA_C_ORDER_2, "call_s"] /= 100.0
    made.loc[made["solver"] == PAPER, "call_s"] /= 100.0
    found = found_of(study, tmp_path, made)["cases"][1]
    assert found["at"][0]["best"]["solver"] == IDA_C_ORDER_2 and not found["at"][0]["best"]["ours"]
    made = rows()
    made.loc[(made["solver"] == IDA_C_ORDER_2) & (made["error_tip"] == 5e-3), "call_s"] = 1e-3
    found = found_of(study, tmp_path, made)["cases"][1]
    assert [at["best"]["solver"] for at in found["at"][:3]] == [IDA_C_ORDER_2, IDA_C_ORDER_2, NEWTON]


def test_of_a_solver_with_runs_it_is_not_said_that_it_was_not_asked():
    runs = pd.DataFrame({"error_tip": [1e-5, 1e-6, np.nan], "tol": [1e-1, 1e-3, 1e-2]})
    assert study._cell(runs, UNASKED) == "> 1e-6 m (1e-3)"
    assert study._cell(runs, "≤ 1.1") == "≤ 1.1" and study._cell(runs[2:], UNASKED) == UNASKED


@pytest.mark.usefixtures("unsaved")
def test_how_far_solvers_were_asked_that_come_within_no_target(tmp_path):
    assert [case["asked_to"] for case in found_of(study, tmp_path, rows())["cases"]] == [{}, {}]
    assert "tightest tolerance asked is" not in (tmp_path / "beam.md").read_text()
    made = rows()
    coarse = (made["case"] == SOFT) & made["solver"].isin((IDA_C, "BDF", OWN_EXPLICIT)) & (made["error_tip"] < 5e-4)
    made = made[~coarse]
    made.loc[(made["case"] == SOFT) & (made["solver"] == "BDF") & (made["tol"] == 1e-2), "tol"] = 1e-5
    stopped = (made["case"] == SOFT) & (made["solver"] == OWN_EXPLICIT) & (made["tol"] == 1e-2)
    made.loc[stopped, ["status", "error_q", "error_tip"]] = [
        "TIME_LIMIT",
        np.nan,
        np.nan,
    ]
    found = found_of(study, tmp_path, made)["cases"]
    assert [case["asked_to"] for case in found] == [{"1e-2": [IDA_C], "1e-5": ["BDF"]}, {}]
    text = (tmp_path / "beam.md").read_text()
    assert f'the tightest tolerance asked is 1e-2 of `{IDA_C}`, 1e-5 of `method="BDF"`.' in text


@pytest.mark.usefixtures("unsaved")
def test_what_the_mesh_changes_is_found_for_each_beam(tmp_path):
    def below(made):
        return [case["below_mesh"] for case in found_of(study, tmp_path, made)["cases"]]

    assert below(rows()) == [list(TARGETS)] * 2
    made = rows()
    sensitivity = made["group"] == "sensitivity"
    made.loc[sensitivity & (made["solver"] == MESH) & (made["case"] == SOFT), "largest"] = 5e-5
    made.loc[sensitivity & (made["solver"] == MESH) & (made["case"] == STIFF), "largest"] = 9e-4
    assert below(made) == [[], [1e-4]]
    made.loc[sensitivity & (made["solver"] == MESH) & (made["case"] == STIFF), "largest"] = 1.0
    assert below(made) == [[], list(TARGETS)]


@pytest.mark.usefixtures("unsaved")
def test_the_step_limit_is_reconciled_by_numbers_or_not(tmp_path):
    found = found_of(study, tmp_path, rows())
    assert found["reconciled"] and found["test_no_limit"]
    assert found["test_limits"] == [0.9, 0.45, 0.11] and found["test_tols"] == [1e-1, 1e-2, 1e-8]
    made = rows()
    made.loc[(made["group"] == "along"), "measured"] = 0.2  # shorter than the accepted steps
    assert not found_of(study, tmp_path, made)["reconciled"]
    made = rows()
    made.loc[made["group"] == "growth test", "measured"] = 0.457
    found = found_of(study, tmp_path, made)
    assert not found["reconciled"] and not found["test_no_limit"]


@pytest.mark.usefixtures("unsaved")
def test_growth_turns_with_the_rows(tmp_path):
    assert found_of(study, tmp_path, rows())["growth_as_frequency"]
    made = rows()
    made.loc[(made["case"] == STIFF) & (made["solver"] == PAPER), "n_evaluations"] *= 10.0
    assert not found_of(study, tmp_path, made)["growth_as_frequency"]


@pytest.mark.usefixtures("unsaved")
def test_failures_and_what_is_not_there_are_told(tmp_path):
    made = rows()
    peer = made[made["solver"] == IDA_C].iloc[:1].assign(status="NOT_AVAILABLE", message="it is not installed")
    without = made[made["solver"] != IDA_C]
    numbers = ["error_q", "error_tip", "call_s", "n_evaluations", "n_steps", "h_median"]
    peer = peer.assign(**dict.fromkeys(numbers, np.nan))
    assert found_of(study, tmp_path, pd.concat([peer, without], ignore_index=True))["cases"][0]["failed"] == 1
    assert found_of(study, tmp_path, made)["cases"][0]["failed"] == 0
    with pytest.raises(StudyError, match="lack those of group 'along'"):
        findings_of(made[made["group"] != "along"])


@pytest.mark.usefixtures("unsaved")
def test_exudyn_is_judged_by_its_own_motion_and_not_ranked(tmp_path):
    made = rows()
    made.loc[made["solver"] == EXUDYN, "call_s"] = 1e-6
    found = found_of(study, tmp_path, made)
    assert found["cases"][0]["at"][0]["best"]["solver"] != EXUDYN and found["exudyn"]
    assert not found_of(study, tmp_path, made[made["solver"] != EXUDYN])["exudyn"]


@pytest.mark.usefixtures("unsaved")
def test_whether_vibrations_are_stepped_over_is_read_from_the_steps(tmp_path):
    assert [case["steps_over"] for case in found_of(study, tmp_path, rows())["cases"]] == [False, False]
    made = rows()
    made.loc[(made["case"] == STIFF) & (made["solver"] == NEWTON), "h_median"] = 200.0 / W_MAX[STIFF]
    cases_ = found_of(study, tmp_path, made)["cases"]
    assert [case["steps_over"] for case in cases_] == [False, True] and cases_[1]["longest"]["solver"] == NEWTON


def test_the_study_lists_all_cells_once():
    made = list(runs(cases(False), False))
    assert len({run.key(0) for run in made}) == len(made)
    names = {run.solver.name for run in made}
    assert {PAPER, NEWTON, DIFFERENCES, "BDF", OWN_EXPLICIT, IDA_C, IDA_C_ORDER_2, EXUDYN} <= names
    assert {name for name in OTHER_SOLVERS if not name.startswith("Exudyn")} <= names
    own = next(run for run in made if run.solver.name == PAPER and run.value == PAPER_TOL)
    assert own.settings == {"tol": PAPER_TOL} and own.group == "run"
    assert sum(run.repeats for run in runs(cases(True), True)) < 40


def test_the_cases_are_on_the_bench():
    found = {case.name: case for case in load(True)}
    assert found["very flexible beam"].tags == ("stiff", "vibrations wanted")
    assert found["moderately stiff beam"].tags == ("stiff", "vibrations irrelevant")
    assert not found["very flexible beam"].conserved  # the base does work


@pytest.fixture(scope="module")
def quick_cases():
    return cases(True)


def test_errors_are_those_of_the_tip_and_a_run_that_ends_early_has_none(quick_cases):
    case = quick_cases[SOFT]
    problem, span = case.problem, (0.0, case.t_end)
    run = Run(case, beam_runs.solvers()[NEWTON], 1e-8, "run")
    result = solve_dae(problem.system, span, problem.q0, problem.v0, method=NEWTON, rtol=1e-8, atol=1e-8)
    assert measure(run, result)["error_tip"] < 1e-8 and case.reference.floor < 1e-8
    result.q[-5, -1] += 1e-3
    assert abs(measure(run, result)["error_tip"] - 1e-3) < 1e-8
    early = solve_dae(problem.system, span, problem.q0, problem.v0, method=NEWTON, max_steps=3)
    row = measure(run, early)
    assert row["error_tip"] is None and row["astray"]


def test_the_reference_is_that_of_three_ways(quick_cases):
    case = quick_cases[SOFT]
    assert "Gauss12 differs by" in case.reference.source and "without constraints" in case.reference.source
    q, v = case.reference.states(np.array([0.0]))
    np.testing.assert_array_equal(q[:, 0], case.problem.q0)
    np.testing.assert_array_equal(v[:, 0], case.problem.v0)


def test_newton_by_differences_is_the_same_run_but_for_its_jacobians(quick_cases):
    case = quick_cases[STIFF]
    own, other = (attempt(Run(case, beam_runs.solvers()[name], 1e-1), 0)[0] for name in (NEWTON, DIFFERENCES))
    assert own.success and other.success
    more = other.stats.n_evaluations - own.stats.n_evaluations
    assert more > case.problem.q0.size * own.stats.n_jacobians / 4  # differences by groups of columns
    assert abs(own.stats.n_accepted - other.stats.n_accepted) < 0.3 * own.stats.n_accepted


@pytest.mark.slow
def test_exudyn_is_measured_against_itself():
    pytest.importorskip("exudyn")
    case = cases(True)[STIFF]
    run = Run(case, beam_runs.solvers()[EXUDYN], case.t_end / 50_000, "run")
    result, status, _, _ = attempt(run, 0)
    row = measure(run, result)
    assert status == "REACHED_END" and row["floor"] <= row["error_tip"] < 1e-3


def test_theory_of_fixed_point_iteration():
    sun = sun_radau_iib(3)
    assert abs(jacobi_limit(sun) - 1.0 / 0.215314) < 1e-4 and abs(jacobi_limit(gauss(2)) - 2.0 * np.sqrt(3.0)) < 1e-12
    assert abs(gauss_seidel_limit(sun) - 3.2211) < 1e-4
    # of one stage there are no others, whose latest could be used
    assert abs(gauss_seidel_limit(gauss(1)) - jacobi_limit(gauss(1))) < 1e-9


def test_frequencies_are_those_of_the_published_case():
    assert abs(frequencies(MAKE[SOFT]())[-1] - 3358.5) < 0.05


@pytest.mark.slow  # as that of step_size
class TestQuickRun(QuickRun):
    pictures = ("beam_very_flexible", "beam_moderately_stiff")


@pytest.mark.slow  # the quick study
def test_a_quick_report_does_not_compare_with_the_paper(out):
    text = (out / "beam.md").read_text()
    assert "6278" not in text and "56.2" not in text  # the paper's seconds are not for so short a motion
    assert study.__doc__.split(":")[0] in index.first_screen(out, True)


@pytest.mark.slow  # the quick study
def test_quick_runs_follow_the_reference_and_newton_needs_far_fewer_evaluations(made):
    made = made[made["group"] == "run"]
    assert (made["status"] == "REACHED_END").all() and made["error_tip"].max() < 0.02
    counts = made[made["case"] == STIFF].groupby("solver")["n_evaluations"].min()
    assert counts[PAPER] > 100.0 * counts[NEWTON]
    steps = made[made["solver"] == PAPER].set_index("case")["h_median"]
    assert 1e-4 < steps[SOFT] < 3e-3 and 1e-5 < steps[STIFF] < 1e-4


@pytest.mark.slow  # the quick study
def test_the_papers_growth_test_is_no_limit_of_the_iteration(made):
    limits = made[made["group"] == "limit"].set_index("solver")["theory"]
    tests = made[made["group"] == "growth test"].set_index("tol")["measured"]
    assert limits[GAUSS_SEIDEL] > tests[1e-1] > tests[1e-2] > 2.0 * tests[1e-8] > 0.0


def test_a_case_names_its_own_tolerances():
    soft = next(case for case in load(True) if case.name == "very flexible beam")
    assert beam_runs.solvers()["BDF"].grid(soft) == soft.tolerances
    assert beam_runs.solvers()["BDF"].grid(replace(soft, tolerances=None)) == beam_runs.solvers()["BDF"].values
