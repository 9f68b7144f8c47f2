"""The motion study: quick run, redraw, and what must hold in its rows."""

import numpy as np
import pytest

from studies import motion
from studies.motion_report import VISIBLE, needed
from studies.report import load_rows, load_series
from studies.solvers import gear


@pytest.fixture(scope="module")
def out(tmp_path_factory):
    folder = tmp_path_factory.mktemp("motion")
    motion.main(["--quick", "--out", str(folder)])
    return folder


@pytest.fixture(scope="module")
def rows(out):
    return load_rows(out / "motion.csv")[0]


def at(rows, order, step, start="accurate"):
    return rows[(rows["solver"] == gear(order, start)) & (rows["h"] == step)].iloc[0]


def test_report_and_figures_can_be_drawn_again(out):
    text = (out / "motion.md").read_text()
    assert "Assumed geometry" in text and "stand-in for ADAMS GSTIFF" in text
    pictures = [out / f"motion_{name}.png" for name in ("short", "long", "error")]
    for picture in pictures:
        picture.unlink()
    motion.main(["--quick", "--out", str(out), "--redraw"])
    assert (out / "motion.md").read_text() == text
    assert all(picture.stat().st_size > 10_000 for picture in pictures)
    assert (out / "motion_series.npz").stat().st_size < 300_000


def test_the_stand_in_of_order_2_is_visibly_wrong_at_a_long_step_only(rows):
    assert at(rows, 2, 0.02)["error_y3_short"] > 3.0 * VISIBLE
    assert at(rows, 2, 0.01)["error_y3_short"] < VISIBLE < at(rows, 2, 0.01)["error_y3"]
    assert at(rows, 2, 0.01)["energy"] < -0.5  # damped


def test_its_error_falls_with_the_step_as_its_order_says_after_an_accurate_start_only(rows):
    for order, start, least in ((2, "accurate", 1.8), (5, "accurate", 4.0)):
        fall = at(rows, order, 0.01, start)["error_y3_short"] / at(rows, order, 0.005, start)["error_y3_short"]
        assert np.log2(fall) > least
    ramp = at(rows, 5, 0.01, "ramp")["error_y3_short"] / at(rows, 5, 0.005, "ramp")["error_y3_short"]
    assert np.log2(ramp) < 2.5


def test_the_papers_procedures_reach_and_do_not_pass_zero(rows):
    ours = rows[rows["solver"].isin(("PaperIRK", "PaperNewmark (beta = 1/2)"))]
    assert len(ours) == 2 and (ours["error_y3_short"] < 1e-5).all() and (ours["top"] < 1e-6).all()
    assert (ours["top_late"] > -1e-4).all()


def test_a_run_that_fails_is_a_row_with_what_it_reached(rows):
    failed = rows[rows["solver"] == "Exudyn, GeneralizedAlpha 1"].iloc[0]
    assert failed["status"] == "SOLVER_FAILED" and np.isnan(failed["error_y3"])
    assert failed["error_y3_short"] > 0.0 and 2.0 < failed["good_until"] < 10.0


def test_the_step_needed_lies_between_one_that_suffices_and_one_that_does_not(rows):
    step = needed(rows, gear(5))
    assert 0.01 < step < 0.02
    assert np.isnan(needed(rows, gear(2)))
    assert needed(rows, gear(5), 10.0) == 0.02  # the longest tried; nothing extrapolated


def test_curves_of_the_figures_follow_the_truth(out):
    series = load_series(out / "motion_series.npz")
    ours = next(x for name, x in series.items() if name.startswith("PaperIRK") and name.endswith("long"))
    assert np.abs(ours - series["truth long"]).max() < 5e-3  # a cubic between steps of 0.06 s
