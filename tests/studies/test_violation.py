"""The violation study: quick run, redraw, and what must hold in its rows."""

import itertools

import numpy as np
import pytest

from studies import violation
from studies.report import load_rows
from studies.solvers import CATALOGUE, IRK, baumgarte
from studies.violation_report import grows


@pytest.fixture(scope="module")
def out(tmp_path_factory):
    folder = tmp_path_factory.mktemp("violation")
    violation.main(["--quick", "--out", str(folder)])
    return folder


@pytest.fixture(scope="module")
def rows(out):
    return load_rows(out / "violation.csv")[0]


@pytest.fixture(scope="module")
def line_up(rows):
    return rows[rows["group"] == "line-up"].set_index("solver")


def test_report_and_figures_can_be_drawn_again(out):
    text = (out / "violation.md").read_text()
    assert "Assumed geometry" in text and "Baumgarte" in text
    pictures = [out / f"violation{name}.png" for name in ("", "_closure", "_cost")]
    for picture in pictures:
        picture.unlink()
    violation.main(["--quick", "--out", str(out), "--redraw"])
    assert (out / "violation.md").read_text() == text
    assert all(picture.stat().st_size > 10_000 for picture in pictures)
    assert (out / "violation_series.npz").stat().st_size < 300_000


def test_tables_have_as_many_cells_as_columns(out):
    lines = (out / "violation.md").read_text().splitlines()
    for before, line in itertools.pairwise(lines):
        if before.startswith("|") and line.startswith("|"):
            assert before.count("|") == line.count("|")


def test_two_loop_procedures_keep_the_constraints_and_do_not_drift(line_up):
    ours = line_up[[CATALOGUE[name].two_loop for name in line_up.index]]
    assert len(ours) >= 8
    assert (ours["violation_q"] < 1e-13).all() and (ours["violation_v"] < 1e-13).all()
    assert (ours[["violation_35", "violation_36"]].max(axis=1) <= ours["violation_q"]).all()
    assert not any(grows(row, level) for _, row in ours.iterrows() for level in ("q", "v"))


def test_index_1_drifts_baumgarte_bounds_and_projection_keeps(line_up):
    plain, projected = line_up.loc["DOP853, index 1"], line_up.loc["DOP853, projected"]
    bounded = line_up.loc[baumgarte("DOP853", 10.0)]
    assert plain["violation_q"] > 1e3 * projected["violation_q"]
    assert plain["violation_q"] > 10.0 * bounded["violation_q"] > 1e3 * projected["violation_q"]
    assert grows(plain, "q") and grows(plain, "v")
    assert not grows(bounded, "q") and not grows(projected, "q")


def test_accelerations_by_eq_6_satisfy_their_constraints_and_others_do_not(line_up):
    own = line_up["own_a"] == True  # noqa: E712 (a column)
    assert (line_up[~own]["violation_a"] < 1e-11).all() and (line_up[own]["violation_a"] > 1e-8).all()
    assert own["GSTIFF stand-in, order 2"] and not own[IRK]


def test_index_3_and_index_2_forms_keep_only_their_own_level(line_up):
    third, second = line_up.loc["Exudyn, GeneralizedAlpha"], line_up.loc["Exudyn, TrapezoidalIndex2"]
    assert third["violation_q"] < 1e-12 < 1e-6 < third["violation_v"]
    assert second["violation_v"] < 1e-6 < second["violation_q"]


def test_loose_loops_leave_a_trace_only_together(rows):
    loops = rows[rows["group"] == "loops"].set_index(["err_in", "err_out"])["violation_q"]
    assert loops[1e-3, 1e-3] > 1e-10 > 1e-13 > loops[1e-3, 1e-9]


@pytest.mark.parametrize("power", [0.0, 1.0, 2.0])
def test_growth_is_the_exponent_of_time(power):
    t = np.linspace(0.0, 100.0, 4001)
    size = 1e-9 * t**power * (1.0 + 0.5 * np.sin(9.0 * t) ** 2)
    assert violation.growth(t, size) == pytest.approx(power, abs=0.05)
