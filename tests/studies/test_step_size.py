"""The step-size study: quick run, redraw, and what must hold in its rows."""

import numpy as np
import pytest

from studies import step_size
from studies.report import load_rows, load_series
from studies.solvers import IRK, NEWMARK, QUARTER


@pytest.fixture(scope="module")
def out(tmp_path_factory):
    folder = tmp_path_factory.mktemp("step_size")
    step_size.main(["--quick", "--out", str(folder)])
    return folder


@pytest.fixture(scope="module")
def rows(out):
    return load_rows(out / "step_size.csv")[0].set_index("solver")


def test_report_and_figures_can_be_drawn_again(out):
    text = (out / "step_size.md").read_text()
    assert "Assumed geometry" in text and "99." in text
    pictures = [out / name for name in ("step_size.png", "step_size_others.png")]
    for picture in pictures:
        picture.unlink()
    step_size.main(["--quick", "--out", str(out), "--redraw"])
    assert (out / "step_size.md").read_text() == text
    assert all(picture.stat().st_size > 10_000 for picture in pictures)
    assert (out / "step_size_series.npz").stat().st_size < 300_000


def test_runge_kutta_steps_are_mostly_longer_than_the_papers_002_s(rows):
    assert rows.loc[IRK, "share_time"] > 0.99 and rows.loc[IRK, "share_steps"] > 0.95
    assert 0.03 < rows.loc[IRK, "h_median"] < 0.1
    assert rows.loc[NEWMARK, "share_steps"] == 0.0


def test_newmarks_steps_differ_by_the_cube_root_of_their_error_constants(rows):
    ratio = rows.loc[QUARTER, "h_median"] / rows.loc[NEWMARK, "h_median"]
    assert ratio == pytest.approx(4.0 ** (1.0 / 3.0), rel=0.05)


def test_rejections_are_shares_of_steps_and_known_for_ours(rows):
    assert rows["retried"].notna().all() and rows["retried"].between(0.0, 1.0).all()
    irk = rows.loc[IRK]
    assert irk["retried"] > 10.0 * rows.loc[NEWMARK, "retried"] > 0.0
    assert irk["retried"] * irk["n_steps"] <= irk["n_rejected_error"] + irk["n_rejected_convergence"]


def test_curves_hold_the_marks_and_the_whole_run(out):
    series = load_series(out / "step_size_series.npz")
    whole = next(x for name, x in series.items() if name.startswith(IRK) and name.endswith("whole"))
    errors = next(x for name, x in series.items() if name.startswith(IRK) and name.endswith("error"))
    assert whole[0, 0] == 0.0 and 9.8 < whole[0, -1] < 10.0
    assert errors.shape[1] > 10 and np.isin(errors[1], whole[1]).all()


def test_of_many_steps_the_extremes_are_drawn():
    t = np.linspace(0.0, 10.0, 5001)
    h = np.full(t.size, 1e-3)
    h[1234], h[4321] = 1e-5, 1e-1
    drawn = step_size._curve(t, h)
    assert drawn.shape[1] <= step_size.CURVE
    assert drawn[1].min() == 1e-5 and drawn[1].max() == 1e-1
    assert np.array_equal(step_size._curve(t[:9], h[:9]), [t[:9], h[:9]])
