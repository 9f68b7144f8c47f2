"""The step-size study: its sentences turn with the rows, and what must hold in the rows of a quick run."""

import json

import numpy as np
import pandas as pd
import pytest

from studies import step_size
from studies.bench.cli import Call
from studies.bench.solvers import CATALOGUE, IRK, NEWMARK, PRESETS, QUARTER
from studies.bench.store import Output
from studies.step_size import OTHERS, PAPER


def rows():
    """Medians of a full run, made up but like them."""
    good = {
        "status": "REACHED_END",
        "message": "",
        "problem": "four-bar",
        "t_end": 100.0,
        "repeat": 0,
        "case": "four-bar",
    }
    good |= {"error_q": 1e-3, "call_s": 1.0, "n_evaluations": 1e5, "n_steps": 1000, "h_median": 0.06, "h_low": 0.02}
    good |= {"h_high": 0.1, "share_time": 0.999, "retried": 0.4}
    good |= {"retried_switch": 0.5, "n_rejected_error": 400.0, "n_rejected_convergence": 50.0, "n_partitions": 101.0}
    good |= {"err_out": np.nan, "tol": np.nan, "case": "four-bar"}
    newmark = {"h_median": 3e-4, "n_steps": 300_000, "n_evaluations": 1e6, "retried": 1e-3, "retried_switch": 0.1}
    told = {"n_partitions": None, "retried": None, "retried_switch": None}
    told |= {"n_rejected_error": None, "n_rejected_convergence": None}
    lines = []

    def add(group, name, value, **more):
        solver = CATALOGUE[name]
        line = {"family": solver.family, "keeps_constraints": solver.keeps_constraints, "solver": name, "group": group}
        lines.append({**good, **line, solver.setting: value, **more})

    for name in PAPER:
        add("paper", name, 1e-9, **({} if name == IRK else newmark))
    for name in PRESETS:
        add("two-loop", name, 1e-5)
    for name in OTHERS:
        add("others", name, 1e-5, **told)
    return pd.DataFrame(lines)


def found_of(folder, made, quick=False):
    """The findings, with which the report was written."""
    with Output(Call("step_size", quick, folder, False, "")) as output:
        step_size.STUDY.report(output, made, "stamp")
    return json.loads((folder / "step_size.json").read_text())


@pytest.mark.usefixtures("unsaved")
def test_findings_turn_with_the_rows(tmp_path):
    found, n = found_of(tmp_path, rows()), len(PRESETS) + 3
    assert found["holds"] and found["longer"]
    assert found["ratios"] == pytest.approx([200.0, 200.0])
    assert found["switches"] == 100 and found["switches_per_period"] == pytest.approx(2.2, abs=0.1)
    assert (found["n_known"], found["n_worse_at_switch"]) == (n, n)

    made = rows()
    ours = made["group"] != "others"
    made.loc[made["solver"] == IRK, ["share_time", "h_median", "retried"]] = [0.3, 1e-4, 1e-4]
    made.loc[ours, "retried_switch"] = 0.0
    made.loc[made.index[-1], ["status", "message"]] = ["SOLVER_FAILED", "why"]
    found = found_of(tmp_path, made)
    assert not found["holds"] and not found["longer"]
    assert (found["n_known"], found["n_worse_at_switch"]) == (n, 0)
    made.loc[made["solver"] == "Gauss6", "retried_switch"] = 0.9
    assert found_of(tmp_path, made)["n_worse_at_switch"] == 1
    made["retried_switch"] = np.nan
    assert found_of(tmp_path, made)["n_known"] == 0


def test_of_many_steps_the_extremes_are_drawn():
    t = np.linspace(0.0, 10.0, 5001)
    h = np.full(t.size, 1e-3)
    h[1234], h[4321] = 1e-5, 1e-1
    drawn = step_size._curve(t, h)
    assert drawn.shape[1] <= step_size.CURVE
    assert drawn[1].min() == 1e-5 and drawn[1].max() == 1e-1
    assert np.array_equal(step_size._curve(t[:9], h[:9]), [t[:9], h[:9]])


def test_the_full_study_lists_its_runs_once():
    made = step_size.runs(False)
    assert len({run.key(0) for run in made}) == len(made)
    assert "IDA, stabilised" in {run.solver.name for run in made}


@pytest.fixture(scope="module")
def out(tmp_path_factory):
    folder = tmp_path_factory.mktemp("step_size")
    step_size.main(["--quick", "--out", str(folder)])
    return folder


@pytest.fixture(scope="module")
def made(out):
    return pd.read_csv(out / "step_size.csv", comment="#").set_index("solver")


def test_report_and_figures_can_be_drawn_again(out):
    text = (out / "step_size.md").read_text()
    pictures = [out / f"step_size.{suffix}" for suffix in ("png", "svg")]
    for picture in pictures:
        picture.unlink()
    step_size.main(["--quick", "--out", str(out), "--redraw"])
    assert (out / "step_size.md").read_text() == text
    assert all(picture.stat().st_size > 10_000 for picture in pictures)
    assert (out / "step_size_series.npz").stat().st_size < 300_000


def test_runge_kutta_steps_are_mostly_longer_than_the_papers_002_s(made):
    assert made.loc[IRK, "share_time"] > 0.99
    assert 0.03 < made.loc[IRK, "h_median"] < 0.1
    assert made.loc[NEWMARK, "share_time"] == 0.0


def test_newmarks_steps_differ_by_the_cube_root_of_their_error_constants(made):
    ratio = made.loc[QUARTER, "h_median"] / made.loc[NEWMARK, "h_median"]
    assert ratio == pytest.approx(4.0 ** (1.0 / 3.0), rel=0.05)


def test_rejections_are_shares_of_steps_and_known_for_ours(made):
    ours = made[made["family"] == "two-loop"]
    assert ours["retried"].notna().all() and ours["retried"].between(0.0, 1.0).all()
    assert made[made["family"] != "two-loop"]["retried"].isna().all()
    irk = made.loc[IRK]
    assert irk["retried"] > 10.0 * made.loc[NEWMARK, "retried"] > 0.0
    assert irk["retried"] * irk["n_steps"] <= irk["n_rejected_error"] + irk["n_rejected_convergence"]


def test_curves_hold_the_marks_and_the_whole_run(out):
    with np.load(out / "step_size_series.npz") as series:
        whole, errors = (
            next(series[name] for name in series if IRK in name and name.endswith(kind)) for kind in ("whole", "error")
        )
    assert whole[0, 0] == 0.0 and 9.8 < whole[0, -1] < 10.0
    assert errors.shape[1] > 10 and np.isin(errors[1], whole[1]).all()
