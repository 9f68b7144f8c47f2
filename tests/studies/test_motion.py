"""The motion study: its sentences turn with the rows, and what must hold in the rows of a quick run."""

from itertools import product

import numpy as np
import pandas as pd
import pytest

from studies import motion
from studies.bench.solvers import CANONICAL, GEAR_ORDERS, IRK, LINE_UP, NEWMARK, gear
from studies.motion import VISIBLE, find
from tests.studies.of_study import GOOD, QuickRun, found_of, line

STUDIED = motion


def rows():
    """Medians of a full run, made up but like them."""
    good = GOOD | {"problem": "four-bar", "case": "four-bar", "t_end": 100.0, "floor": 1e-11, "error_q": 1e-6}
    good |= {"call_s": 1.0, "n_evaluations": 1e4, "kinetic": 22.5, "range_y3": 0.726, "err_out": np.nan}
    good |= {"error_y3": 5e-3, "error_y3_short": 1e-6, "top": 0.0, "top_late": -1e-4, "energy": -1e-3, "growth": 2.0}
    good |= {"good_until": 100.0, "lost": False, "astray": False, "h": np.nan, "tol": np.nan}
    growth = {name: 1.0 if name == CANONICAL else 2.0 for name in LINE_UP}
    lines = [line(good, "line-up", name, value, growth=growth[name]) for name, value in LINE_UP.items()]
    for order, step in product(GEAR_ORDERS, (0.02, 0.01, 0.005)):
        short = 0.2 * (50.0 * step) ** order / 4.0 ** (order - 1)
        lines.append(line(good, "GSTIFF stand-in", gear(order), step, error_y3_short=short, error_y3=10.0 * short))
    return pd.DataFrame(lines)


@pytest.mark.usefixtures("unsaved")
def test_findings_turn_with_the_rows(tmp_path):
    found = found_of(motion, tmp_path, rows())
    gear_found = found["gear"]
    assert found["procedures_hold"] and found["agree"] and found["agree_long"]
    assert (gear_found["n"], gear_found["off_coarse"], gear_found["off_fine"]) == (6, [1, 2, 3], [1, 2])
    assert gear_found["off_long"] == [1, 2, 3] and [one["order"] for one in gear_found["both"]] == [3]
    assert gear_found["both"][0]["limits"] == pytest.approx([1.6e-3, 0.0125], rel=0.03)
    assert found["canonical_growth"] == 1.0 and found["growth"] == [2.0, 2.0]
    assert found["others_growth"] == {"False": [2.0, 2.0], "True": [2.0, 2.0]}  # that let constraints drift, and others

    made = rows()
    stand_in, long = made["group"] == "GSTIFF stand-in", made["h"] == 0.02
    made.loc[made["solver"] == NEWMARK, ["top", "error_y3", "error_y3_short"]] = [0.01, 0.5, 0.02]
    made.loc[stand_in, ["error_y3", "error_y3_short"]] = [0.5, 1e-3]
    made.loc[stand_in & long, "error_y3_short"] = 0.5
    made.loc[made["solver"] == CANONICAL, "growth"] = 2.5
    made.loc[made.index[-1], ["status", "message", "error_y3"]] = ["SOLVER_FAILED", "why", np.nan]
    found = found_of(motion, tmp_path, made)
    assert {one["solver"]: one["holds"] for one in found["procedures"]} == {IRK: True, NEWMARK: False}
    assert not found["procedures_hold"] and not found["agree"] and found["canonical_growth"] == 2.5
    assert len(found["gear"]["off_coarse"]) == 6 and found["gear"]["off_fine"] == []

    made.loc[stand_in, ["error_y3", "error_y3_short"]] = 1e-3
    found = found_of(motion, tmp_path, made)["gear"]
    assert found["off_coarse"] == found["off_long"] == found["both"] == []
    found_of(motion, tmp_path, made, quick=True)


def test_the_full_study_lists_its_runs_once():
    made = motion.runs(False)
    assert len({run.key(0) for run in made}) == len(made)
    assert {run.solver.name for run in made} >= {*motion.LISTED, *(gear(order) for order in GEAR_ORDERS)}
    assert len(motion.runs(True)) < 40


def at(made, order, step):
    return find(made, gear(order), step)


@pytest.mark.slow  # as that of step_size
class TestQuickRun(QuickRun):
    pictures = ("motion_short", "motion_long", "motion_error")


def test_the_stand_in_of_order_2_is_visibly_wrong_at_a_long_step_only(made):
    assert at(made, 2, 0.02)["error_y3_short"] > 3.0 * VISIBLE
    assert at(made, 2, 0.01)["error_y3_short"] < VISIBLE < at(made, 2, 0.01)["error_y3"]
    assert at(made, 2, 0.01)["energy"] < -0.5  # damped


def test_its_error_falls_with_the_step_as_its_order_says(made):
    for order, least in ((2, 1.8), (5, 4.0)):
        fall = at(made, order, 0.01)["error_y3_short"] / at(made, order, 0.005)["error_y3_short"]
        assert np.log2(fall) > least


def test_the_papers_procedures_reach_and_do_not_pass_zero(made):
    ours = made[made["solver"].isin((IRK, NEWMARK))]
    assert len(ours) == 2 and (ours["error_y3_short"] < 1e-5).all() and (ours["top"] < 1e-6).all()
    assert (ours["top_late"] > -1e-4).all()


def test_a_run_that_fails_is_a_row_with_what_it_reached(made):
    failed = made[made["solver"] == "Exudyn, GeneralizedAlpha 1"].iloc[0]
    assert failed["status"] == "SOLVER_FAILED" and np.isnan(failed["error_y3"]) and failed["error_y3_short"] > 0.0


def test_errors_between_the_steps_are_those_at_the_steps(made):
    """The errors of y3 every 2 ms, from interpolated deviations, are no other than those at the common instants."""
    both = made[(made["group"] == "line-up") & made["error_y3"].notna()]
    assert (both["error_y3"] <= 1.5 * both["error_q"]).all()
    fresh = both.set_index("solver").loc["Gauss12"]
    assert fresh["error_y3"] < 1e-8  # with steps of some hundredths of a second
