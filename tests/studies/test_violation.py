"""The violation study: its sentences turn with the rows, and what must hold in the rows of a quick run."""

import numpy as np
import pandas as pd
import pytest

from references.scipy.index1 import baumgarte
from studies import violation
from studies.bench.solvers import CATALOGUE, CVODE_C_PROJECTED, IDA_C, IRK, gear
from studies.violation import ALONG, LOOSE, PAIRS, TIGHT, grows, kind
from tests.studies.of_study import GOOD, QuickRun, found_of, told

STUDIED = violation
DRIFTS = {"violation_q": 1e-7, "violation_v": 1e-8, "growth_q": 2.0, "growth_v": 1.0, "early_q": 1e-9, "late_q": 1e-7}
BAUMGARTE = baumgarte("DOP853", 10.0)


def rows():
    """Medians of a full run, made up but like them."""
    good = GOOD | {"problem": "four-bar", "case": "four-bar", "t_end": 100.0, "floor": 1e-11, "tol": 1e-8}
    good |= {"error_q": 1e-6, "call_s": 1.0, "n_evaluations": 1e4, "energy": 0.0, "err_in": np.nan, "err_out": np.nan}
    good |= {"violation_q": 9e-16, "violation_v": 2e-15, "violation_a": 3e-13, "violation_35": 4e-16, "h": np.nan}
    good |= {"violation_36": 9e-16}
    good |= {
        f"{what}_{level}": x for level in "qva" for what, x in (("growth", 0.0), ("early", 9e-16), ("late", 9e-16))
    }
    lines = []

    def add(group, name, **more):
        lines.append({**good, **told(name), "group": group, **more})

    for name in (IRK, "Gauss12", "DOP853, projected"):
        add("line-up", name)
    for name in ("LSODA, index 1", "DOP853, index 1"):
        add("line-up", name, **DRIFTS)
    add("line-up", BAUMGARTE, violation_q=1e-9, violation_a=1e-7)
    for err_out, size in ((LOOSE, 3e-7), (TIGHT, 9e-16)):
        add("loops", IRK, err_in=LOOSE, err_out=err_out, violation_q=size, tol=np.nan)
    cost = {"IDA, stabilised": 4.0, "IDA, index1": 2.0, "DOP853, projected": 0.6, "Gauss12": 0.3}
    cost[CVODE_C_PROJECTED] = 0.7
    for name in (*ALONG, BAUMGARTE):
        drifts = {} if CATALOGUE[name].keeps_constraints else {"violation_q": 1e-6}
        for k, tol in enumerate((1e-3, 1e-5, 1e-7, 1e-9)):
            times = cost.get(name, 0.5) * (k + 1)
            add("tolerances", name, tol=tol, error_q=100.0 * tol, call_s=times, n_evaluations=1e4 * times, **drifts)
    return pd.DataFrame(lines)


@pytest.mark.usefixtures("unsaved")
def test_findings_turn_with_the_rows(tmp_path):
    found = found_of(violation, tmp_path, rows())
    assert not found["irk_grows"] and found["n_ours"] == 2 and found["ours_keep"] and not found["ours_growing"]
    assert found["others_growing"] == ["LSODA, index 1", "DOP853, index 1"] and found["growing_to"] == [1e-7, 1e-7]
    assert found["growing_unprojected"] and len(set(violation.LISTED)) == len(violation.LISTED)
    text = (tmp_path / "violation.md").read_text()
    assert "All 2 methods and settings of ours keep" in text
    assert "Of solvers given the accelerations of the paper's eq. (6) and not projected, it grows with" in text
    assert (found["baumgarte_n"], found["baumgarte_kept"]) == (4, 0) and found["n_kept_first"] == found["n_ranked"]
    assert found["inner_alone_kept"] and not found["both_kept"]
    assert [pair["dearer"] for pair in found["pairs"]] == [True, True, True]

    made = rows()
    line_up, along = made["group"] == "line-up", made["group"] == "tolerances"
    made.loc[line_up & (made["solver"] == IRK), list(DRIFTS)] = list(DRIFTS.values())
    made.loc[line_up & made["solver"].isin(("LSODA, index 1", "DOP853, index 1")), ["growth_q", "late_q"]] = [0.0, 1e-9]
    made.loc[along & (made["solver"] == BAUMGARTE), "violation_q"] = 1e-14
    made.loc[made["group"] == "loops", "violation_q"] = 1e-9
    made.loc[along & made["solver"].isin([kept for kept, _ in PAIRS]), "call_s"] /= 10.0
    made.loc[along & ~made["keeps_constraints"], "call_s"] /= 100.0
    made.loc[along & made["solver"].isin([drifting for _, drifting in PAIRS]), "call_s"] *= 200.0
    made.loc[made.index[-1], ["status", "message"]] = ["SOLVER_FAILED", "why"]
    found = found_of(violation, tmp_path, made)
    assert found["irk_grows"] and not found["ours_keep"] and found["ours_growing"] == [IRK]
    assert found["others_growing"] == [] and found["baumgarte_kept"] == 4
    assert (found["n_ranked"], found["n_kept_first"]) == (3, 0)
    assert not found["inner_alone_kept"] and not any(pair["dearer"] for pair in found["pairs"])


def test_a_run_is_kept_bounded_or_growing():
    plain = pd.Series(DRIFTS)
    assert kind(plain, "q") == "grows" and grows(plain, "q")
    assert kind(pd.Series(DRIFTS | {"late_q": 1e-9}), "q") == "bounded"
    assert kind(pd.Series(DRIFTS | {"violation_q": 1e-13}), "q") == "kept"


@pytest.mark.parametrize("power", [0.0, 1.0, 2.0])
def test_growth_is_the_exponent_of_time(power):
    t = np.linspace(0.0, 100.0, 4001)
    assert violation.growth(t, 1e-9 * t**power * (1.0 + 0.5 * np.sin(9.0 * t) ** 2)) == pytest.approx(power, abs=0.05)


def test_the_full_study_lists_its_runs_once():
    made = violation.runs(False)
    assert len({run.key(0) for run in made}) == len(made)
    along = {run.solver.name for run in made if run.group == "tolerances"}
    assert {IDA_C, "LSODA, index 1", "IDA, index1", "IDA, stabilised", "Gauss12"} <= along
    for name in along:  # equal grids for all, down to 1e-13
        assert [run.value for run in made if run.group == "tolerances" and run.solver.name == name][-1] == 1e-13
    assert sum(run.repeats for run in violation.runs(True)) < 50


@pytest.fixture(scope="module")
def line_up(made):
    return made[made["group"] == "line-up"].set_index("solver")


@pytest.mark.slow  # as that of step_size
class TestQuickRun(QuickRun):
    pictures = ("violation", "violation_cost")


def test_two_loop_procedures_keep_the_constraints_and_do_not_drift(line_up):
    ours = line_up[line_up["family"] == "two-loop"]
    assert len(ours) >= 8 and (ours["violation_q"] < 1e-13).all() and (ours["violation_v"] < 1e-13).all()
    assert (ours[["violation_35", "violation_36"]].max(axis=1) <= ours["violation_q"]).all()
    assert [name for name, row in ours.iterrows() for level in ("q", "v") if kind(row, level) == "grows"] == []


def test_index_1_drifts_baumgarte_bounds_and_projection_keeps(line_up):
    plain, projected, bounded = (line_up.loc[s] for s in ("DOP853, index 1", "DOP853, projected", BAUMGARTE))
    assert plain["violation_q"] > 10.0 * bounded["violation_q"] > 1e3 * projected["violation_q"]
    assert grows(plain, "q") and grows(plain, "v") and not grows(bounded, "q") and not grows(projected, "q")


def test_accelerations_by_eq_6_satisfy_their_constraints_and_others_do_not(line_up):
    own = pd.Series({name: CATALOGUE[name].own_accelerations for name in line_up.index})
    assert (line_up[~own]["violation_a"] < 1e-11).all() and (line_up[own]["violation_a"] > 1e-8).all()
    assert own[gear(2)] and not own[IRK]


def test_index_3_and_index_2_forms_keep_only_their_own_level(line_up):
    third, second = line_up.loc["Exudyn, GeneralizedAlpha"], line_up.loc["Exudyn, TrapezoidalIndex2"]
    assert third["violation_q"] < 1e-12 < 1e-6 < third["violation_v"]
    assert second["violation_v"] < 1e-6 < second["violation_q"]


def test_loose_loops_leave_a_trace_only_together(made):
    loops = made[made["group"] == "loops"].set_index(["err_in", "err_out"])["violation_q"]
    assert loops[1e-3, 1e-3] > 1e-10 > 1e-13 > loops[1e-3, 1e-9]
