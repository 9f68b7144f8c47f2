"""The step-size study: its sentences turn with the rows, and what must hold in the rows of a quick run."""

import numpy as np
import pandas as pd
import pytest

from studies import step_size
from studies.bench.solvers import IRK, NEWMARK, PRESETS, QUARTER
from studies.step_size import OTHERS, PAPER
from tests.studies.of_study import GOOD, QuickRun, found_of, line

STUDIED = step_size


def rows():
    """Medians of a full run, made up but like them."""
    good = GOOD | {"problem": "four-bar", "case": "four-bar", "t_end": 100.0}
    good |= {"error_q": 1e-3, "call_s": 1.0, "n_evaluations": 1e5, "n_steps": 1000, "h_median": 0.06, "h_low": 0.02}
    good |= {"h_high": 0.1, "share_time": 0.999, "retried": 0.4}
    good |= {"retried_switch": 0.5, "n_rejected_error": 400.0, "n_rejected_convergence": 50.0, "n_partitions": 101.0}
    good |= {"err_out": np.nan, "tol": np.nan}
    newmark = {"h_median": 3e-4, "n_steps": 300_000, "n_evaluations": 1e6, "retried": 1e-3, "retried_switch": 0.1}
    untold = ("n_partitions", "retried", "retried_switch", "n_rejected_error", "n_rejected_convergence")
    lines = [line(good, "paper", name, 1e-9, **({} if name == IRK else newmark)) for name in PAPER]
    lines += [line(good, "two-loop", name, 1e-5) for name in PRESETS]
    lines += [line(good, "others", name, 1e-5, **dict.fromkeys(untold)) for name in OTHERS]
    return pd.DataFrame(lines)


@pytest.fixture(scope="module")
def by_solver(made):
    return made.set_index("solver")


@pytest.mark.usefixtures("unsaved")
def test_findings_turn_with_the_rows(tmp_path):
    found, n = found_of(step_size, tmp_path, rows()), len(PRESETS) + 3
    assert found["holds"] and found["longer"] and found["ratios"] == pytest.approx([200.0, 200.0])
    assert found["switches"] == 100 and found["switches_per_period"] == pytest.approx(2.2, abs=0.1)
    assert (found["n_known"], found["n_worse_at_switch"]) == (n, n)

    made = rows()
    ours = made["group"] != "others"
    made.loc[made["solver"] == IRK, ["share_time", "h_median", "retried"]] = [0.3, 1e-4, 1e-4]
    made.loc[ours, "retried_switch"] = 0.0
    made.loc[made.index[-1], ["status", "message"]] = ["SOLVER_FAILED", "why"]
    found = found_of(step_size, tmp_path, made)
    assert not found["holds"] and not found["longer"] and (found["n_known"], found["n_worse_at_switch"]) == (n, 0)
    made.loc[made["solver"] == "Gauss6", "retried_switch"] = 0.9
    assert found_of(step_size, tmp_path, made)["n_worse_at_switch"] == 1
    made["retried_switch"] = np.nan
    assert found_of(step_size, tmp_path, made)["n_known"] == 0


def test_of_many_steps_the_extremes_are_drawn():
    t = np.linspace(0.0, 10.0, 5001)
    h = np.full(t.size, 1e-3)
    h[1234], h[4321] = 1e-5, 1e-1
    drawn = step_size._curve(t, h)
    assert drawn.shape[1] <= step_size.CURVE and drawn[1].min() == 1e-5 and drawn[1].max() == 1e-1
    assert np.array_equal(step_size._curve(t[:9], h[:9]), [t[:9], h[:9]])


def test_the_full_study_lists_its_runs_once():
    made = step_size.runs(False)
    assert len({run.key(0) for run in made}) == len(made) and "IDA, stabilised" in {run.solver.name for run in made}


class TestQuickRun(QuickRun):
    pictures = ("step_size",)


def test_runge_kutta_steps_are_mostly_longer_than_the_papers_002_s(by_solver):
    assert by_solver.loc[IRK, "share_time"] > 0.99 and 0.03 < by_solver.loc[IRK, "h_median"] < 0.1
    assert by_solver.loc[NEWMARK, "share_time"] == 0.0


def test_newmarks_steps_differ_by_the_cube_root_of_their_error_constants(by_solver):
    ratio = by_solver.loc[QUARTER, "h_median"] / by_solver.loc[NEWMARK, "h_median"]
    assert ratio == pytest.approx(4.0 ** (1.0 / 3.0), rel=0.05)


def test_rejections_are_shares_of_steps_and_known_for_ours(by_solver):
    ours = by_solver[by_solver["family"] == "two-loop"]
    assert ours["retried"].notna().all() and ours["retried"].between(0.0, 1.0).all()
    assert by_solver[by_solver["family"] != "two-loop"]["retried"].isna().all()
    irk = by_solver.loc[IRK]
    assert irk["retried"] > 10.0 * by_solver.loc[NEWMARK, "retried"] > 0.0
    assert irk["retried"] * irk["n_steps"] <= irk["n_rejected_error"] + irk["n_rejected_convergence"]


def test_curves_hold_the_marks_and_the_whole_run(out):
    with np.load(out / "step_size_series.npz") as series:
        whole, errors = (
            next(series[name] for name in series if IRK in name and name.endswith(kind)) for kind in ("whole", "error")
        )
    assert whole[0, 0] == 0.0 and 9.8 < whole[0, -1] < 10.0
    assert errors.shape[1] > 10 and np.isin(errors[1], whole[1]).all()
