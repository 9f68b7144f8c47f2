"""The catalogue of solvers: every entry runs on the four-bar linkage and follows the truth."""

import numpy as np
import pytest

from references.paper.four_bar_minimal import MinimalFourBar
from references.scipy.index1 import baumgarte
from studies.bench.collector import Case
from studies.bench.headline import OWN_CODE
from studies.bench.metrics import violations
from studies.bench.solvers import CATALOGUE, DEFAULT, EXUDYN, GIVEN, IRK, LINE_UP, TOLERANCES, gear
from studies.reproduction import step_size, violation
from studies.validation import study as validation
from tests.marks import slow
from twoloop import solve_dae
from twoloop.mechanisms import four_bar

T_END = 0.2
# seconds each, and tested by the studies that show them
COMPILING = "IDA", "LSODA", "DOP853", "RK45", "Radau,", "Radau9,", "BDF,", "heyoka", "CyRK", "CVODE", "Dopri8", "Pr9"
COMPILING += ("collocation",)


def setting(name):
    return LINE_UP.get(name, {"tol": 1e-6, "h": 1e-3, "err_out": 1e-8}[CATALOGUE[name].setting])


@pytest.mark.parametrize(
    "name",
    [
        slow(name) if name.startswith("GSTIFF") else name  # its kernel takes six seconds to compile
        for name in CATALOGUE
        if CATALOGUE[name].family == "two-loop" or not name.startswith(COMPILING)
    ],
)
def test_every_solver_runs_at_one_setting(name):
    problem = four_bar()
    result = CATALOGUE[name].run(Case("four-bar", problem, T_END), setting(name), 0)
    assert result.success and result.t[-1] == pytest.approx(T_END)
    bound = 0.02 if ", order 1" in name else 1e-3  # implicit Euler
    assert np.abs(result.q - MinimalFourBar.from_parameters(problem.parameters).states(result.t)[0]).max() < bound


@pytest.mark.parametrize("name", [f"Exudyn, {solver}" for solver in EXUDYN])
def test_a_solver_in_coarse_steps_keeps_the_constraints_if_its_flag_says_so(name):
    pytest.importorskip("exudyn")
    problem = four_bar()
    result = CATALOGUE[name].run(Case("four-bar", problem, 1.0), 0.02, 0)
    largest = violations(problem.system, result)[1]["q"].max()
    assert result.success and (largest < 1e-9) == CATALOGUE[name].keeps_constraints


def test_a_solver_carries_what_its_rows_need():
    assert CATALOGUE[IRK].fixed == {"err_in": 1e-9, "tol": 1e-5} and CATALOGUE[IRK].setting == "err_out"
    assert CATALOGUE[gear(3, "ramp")].fixed == {"order": 3} and CATALOGUE[gear(3, "ramp")].setting == "h"
    assert CATALOGUE[baumgarte("DOP853", 10.0)].fixed == {"alpha": 10.0}


def test_all_tolerances_are_the_same_down_to_1e_13():
    grids = {solver.values for solver in CATALOGUE.values() if solver.setting == "tol"}
    assert grids == {TOLERANCES} and min(TOLERANCES) == 1e-13


def test_the_default_is_what_a_call_without_options_takes():
    case = Case("four-bar", four_bar(), T_END)
    result, without_code = (CATALOGUE[name].run(case, 1e-8, 0) for name in (GIVEN, DEFAULT))
    plain = solve_dae(*case.start, rtol=1e-8, atol=1e-8)
    assert np.array_equal(result.q, plain.q) and not np.array_equal(result.q, without_code.q)


@pytest.mark.parametrize("study", [step_size, violation, validation])
@pytest.mark.parametrize("quick", [False, True])
def test_the_studies_of_one_line_a_method_run_the_default(study, quick):
    names = {run.solver.name for run in study.runs(quick)}
    assert GIVEN in names and not names & {DEFAULT, OWN_CODE}


def test_names_and_flags_agree():
    assert set(LINE_UP) <= set(CATALOGUE) and all(solver.name == name for name, solver in CATALOGUE.items())
    assert CATALOGUE["SunRadau5"].family == "two-loop" and CATALOGUE["IDA, index1"].family == "SUNDIALS"


@pytest.mark.slow
def test_long_runs_of_fixed_steps_are_thinned_and_end_at_the_end():
    result = CATALOGUE[gear(2)].run(Case("four-bar", four_bar(), 0.7), 5e-5, 0)
    assert result.stats.n_accepted == 14000 and result.t.size == 7001 and result.t[-1] == 0.7
