"""The motion study: its sentences turn with the rows, and what must hold in the rows of a quick run."""

import numpy as np
import pandas as pd
import pytest

from studies import motion
from studies.cli import Call
from studies.motion import GRIDS, VISIBLE, find
from studies.render import number_of_words
from studies.solvers import CANONICAL, CATALOGUE, GEAR_ORDERS, IRK, LINE_UP, NEWMARK, gear
from studies.store import Output
from studies.study import key


def rows():
    """Medians of a full run, made up but like them."""
    good = {"status": "REACHED_END", "message": "", "problem": "four-bar", "t_end": 100.0, "floor": 1e-11, "repeat": 0}
    good |= {
        "error_q": 1e-6,
        "cpu_s": 1.0,
        "n_evaluations": 1e4,
        "kinetic": 22.5,
        "range_y3": 0.726,
        "err_out": np.nan,
        "case": "four-bar",
    }
    good |= {"error_y3": 5e-3, "error_y3_short": 1e-6, "top": 0.0, "top_late": -1e-4, "energy": -1e-3, "growth": 2.0}
    good |= {"good_until": 100.0, "lost": False, "astray": False, "h": np.nan, "tol": np.nan, "case": "four-bar"}
    lines = []

    def add(group, name, value, **more):
        solver = CATALOGUE[name]
        told = {"family": solver.family, "called_from": solver.called_from, "solver": name, "group": group}
        told |= {"keeps_constraints": solver.keeps_constraints, solver.setting: value}
        lines.append({**good, **told, **more})

    for name, value in LINE_UP.items():
        add("line-up", name, value, growth=1.0 if name == CANONICAL else 2.0)
    for order in GEAR_ORDERS:
        for step in (0.02, 0.01, 0.005):
            short = 0.2 * (50.0 * step) ** order / 4.0 ** (order - 1)
            add("GSTIFF stand-in", gear(order), step, error_y3_short=short, error_y3=10.0 * short)
    return pd.DataFrame(lines)


def text_of(folder, made, quick=False):
    series = {key(row, name): 1e-9 + grid**2 for _, row in made.iterrows() for name, grid in GRIDS.items()}
    with Output(Call("motion", quick, folder, False, "")) as output:
        motion.STUDY.report(output, made, series, "stamp")
    return (folder / "motion.md").read_text()


def test_the_report_is_short_and_whole(tmp_path):
    text = text_of(tmp_path, rows())
    assert number_of_words(text) < 1000
    for name in ("short", "long", "error"):
        assert all((tmp_path / f"motion_{name}.{suffix}").stat().st_size > 10_000 for suffix in ("png", "svg"))
    assert "[motion.csv](motion.csv)" in text and "Runs that did not" not in text


def test_sentences_turn_with_the_rows(tmp_path):
    text = text_of(tmp_path, rows())
    assert "As the paper says, both procedures reach and do not pass y3 = 0" in text
    assert "h = 0.02 s, over 2 s: visibly wrong at order 1, 2 and 3 of 6 orders" in text
    assert "With h = 0.01 s it is visibly wrong at order 1 and 2." in text
    assert "Both statements hold for order 3 (with any limit of the visible from 1.6e-3 to 0.013 m)." in text
    assert "visibly wrong at order 1, 2 and 3, not at all orders. The paper: obviously wrong." in text
    assert "| 2 | **0.050** | **0.01" in text and "| 6 | 2e-4 |" in text and "Neither two-loop procedure is." in text
    assert "but p = 1.0 with the canonical form" in text

    made = rows()
    stand_in, long = made["group"] == "GSTIFF stand-in", made["h"] == 0.02
    made.loc[made["solver"] == NEWMARK, ["top", "error_y3", "error_y3_short"]] = [0.01, 0.5, 0.02]
    made.loc[stand_in, ["error_y3", "error_y3_short"]] = [0.5, 1e-3]
    made.loc[stand_in & long, "error_y3_short"] = 0.5
    made.loc[made["solver"] == CANONICAL, "growth"] = 2.5
    made.loc[made.index[-1], ["status", "message", "error_y3"]] = ["SOLVER_FAILED", "why", np.nan]
    text = text_of(tmp_path, made)
    assert f"this does not hold for `{NEWMARK}`." in text
    assert "visibly wrong at every order, as the paper says of Gstiff" in text
    assert "With h = 0.01 s it is visibly wrong at no order, as the paper says of Gstiff." in text
    assert "the stand-in is visibly wrong at every order. The paper: obviously wrong." in text
    assert "Not both two-loop procedures follow the true motion over 2 s" in text
    assert "is no exception with p = 2.5" in text and "| solver failed |" in text

    made.loc[stand_in, ["error_y3", "error_y3_short"]] = 1e-3
    text = text_of(tmp_path, made)
    assert "visibly wrong at no order. The paper says that Gstiff differs" in text
    assert "There is no order at which both statements hold" in text
    assert "visibly wrong at no order. The paper: obviously wrong." in text
    assert "obviously wrong" not in text_of(tmp_path, made, quick=True)  # which is not of 100 s


def test_the_full_study_lists_its_runs_once():
    made = motion.runs(False)
    assert len({run.key(0) for run in made}) == len(made)
    assert {run.solver.name for run in made} >= {*motion.LISTED, *(gear(order) for order in GEAR_ORDERS)}
    assert len(motion.runs(True)) < 40


@pytest.fixture(scope="module")
def out(tmp_path_factory):
    folder = tmp_path_factory.mktemp("motion")
    motion.main(["--quick", "--out", str(folder)])
    return folder


@pytest.fixture(scope="module")
def made(out):
    return pd.read_csv(out / "motion.csv", comment="#")


def at(made, order, step):
    return find(made, gear(order), step)


def test_report_and_figures_can_be_drawn_again(out):
    text = (out / "motion.md").read_text()
    pictures = [out / f"motion_{name}.{suffix}" for name in ("short", "long", "error") for suffix in ("png", "svg")]
    for picture in pictures:
        picture.unlink()
    motion.main(["--quick", "--out", str(out), "--redraw"])
    assert (out / "motion.md").read_text() == text
    assert all(picture.stat().st_size > 10_000 for picture in pictures)
    assert (out / "motion_series.npz").stat().st_size < 300_000


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
    assert failed["status"] == "SOLVER_FAILED" and np.isnan(failed["error_y3"])
    assert failed["error_y3_short"] > 0.0


def test_errors_between_the_steps_are_those_at_the_steps(made):
    """The errors of y3 every 2 ms, from interpolated deviations, are no other than those at the common instants."""
    both = made[(made["group"] == "line-up") & made["error_y3"].notna()]
    assert (both["error_y3"] <= 1.5 * both["error_q"]).all()
    fresh = both.set_index("solver").loc["Gauss12"]
    assert fresh["error_y3"] < 1e-8  # with steps of some hundredths of a second
