"""The report of the paper's figures: what it is made of, and what must hold in the rows of a quick run."""

import json

import numpy as np
import pandas as pd
import pytest

from references.scipy.index1 import baumgarte
from studies.bench import collector, solvers, tables
from studies.bench.collector import Run
from studies.bench.solvers import IRK, NEWMARK, QUARTER
from studies.reproduction import ablation, beam, motion, step_size, study, violation
from studies.reproduction.beam import MAKE, SOFT, STIFF
from twoloop import solve_dae
from twoloop.methods.tableaux import gauss, sun_radau_iib

BAUMGARTE = baumgarte("DOP853", 10.0)
DRIFTS = {"violation_q": 1e-7, "violation_v": 1e-8, "growth_q": 2.0, "early_q": 1e-9, "late_q": 1e-7}


def test_of_many_steps_the_extremes_are_drawn():
    t = np.linspace(0.0, 10.0, 5001)
    h = np.full(t.size, 1e-3)
    h[1234], h[4321] = 1e-5, 1e-1
    drawn = step_size.thinned(t, h)
    assert drawn.shape[1] <= step_size.CURVE and drawn[1].min() == 1e-5 and drawn[1].max() == 1e-1
    assert np.array_equal(step_size.thinned(t[:9], h[:9]), [t[:9], h[:9]])


@pytest.mark.parametrize("power", [0.0, 1.0, 2.0])
def test_growth_is_the_exponent_of_time(power):
    t = np.linspace(0.0, 100.0, 4001)
    assert violation.growth(t, 1e-9 * t**power * (1.0 + 0.5 * np.sin(9.0 * t) ** 2)) == pytest.approx(power, abs=0.05)


def test_a_violation_grows_only_if_its_end_does():
    assert violation.grows(pd.Series(DRIFTS)) and not violation.grows(pd.Series(DRIFTS | {"late_q": 1e-9}))


def test_every_part_lists_its_runs_once():
    for part in (motion, step_size, violation, ablation):
        listed = part.runs(False)
        assert len({run.key(0) for run in listed}) == len(listed)
    listed = list(beam.runs({name: beam.case_of(name, name, False) for name in (SOFT, STIFF)}, False))
    assert len({run.key(0) for run in listed}) == len(listed)
    names = {run.solver.name for run in listed}
    assert {name for name in solvers.OTHER_SOLVERS if not name.startswith("Exudyn")} <= names


@pytest.fixture(scope="module")
def quick(tmp_path_factory):
    """The folder of a quick run of all parts, and the rows of each."""
    folder = tmp_path_factory.mktemp("reproduction")
    with pytest.MonkeyPatch.context() as patch:
        # times may hold a build, for the sake of which each run is made twice
        patch.setattr(collector, "_may_hold_a_build", lambda *told: False)
        study.main(["--quick", "--out", str(folder)])
    return folder, {name: pd.read_csv(folder / f"{name}.csv", comment="#") for name in study.PARTS}


@pytest.mark.slow
def test_the_report_is_written_and_drawn_again_as_it_was(quick):
    folder, _ = quick
    text = (folder / "reproduction.md").read_text()
    assert "**Quick run**" in text and json.loads((folder / "reproduction.json").read_text())["answer"] in text
    for name in study.PARTS:
        assert f"]({name}.png)" in text and f"]({name}.csv)" in text
        assert all((folder / f"{name}.{suffix}").stat().st_size > 10_000 for suffix in ("png", "svg"))
    study.main(["--redraw", "--quick", "--out", str(folder)])
    assert (folder / "reproduction.md").read_text() == text and not list(folder.glob("*.partial.jsonl"))


def test_a_missing_part_is_named(tmp_path, capsys):
    with pytest.raises(SystemExit, match=r"there is no .*motion\.csv; run python -m studies\.reproduction motion"):
        study.main(["--redraw", "--quick", "--out", str(tmp_path)])
    with pytest.raises(SystemExit):
        study.main(["errata"])
    assert "errata: not a part; the parts are motion, step_size" in capsys.readouterr().err


@pytest.mark.slow
def test_the_procedures_reach_0_and_errors_between_the_steps_are_those_at_the_steps(quick):
    made = quick[1]["motion"]
    ours = made[made["group"] == "line-up"]
    assert len(ours) == 2 and (ours["error_y3_short"] < 1e-5).all() and (ours["top"] < 1e-6).all()
    assert (ours["top_late"] > -1e-4).all() and (ours["error_y3"] <= 1.5 * ours["error_q"]).all()


@pytest.mark.slow
def test_steps_are_as_long_as_their_error_constants_say(quick):
    made = quick[1]["step_size"].set_index("solver")
    assert made.loc[IRK, "share_time"] > 0.99 and made.loc[NEWMARK, "share_time"] == 0.0
    assert made.loc[QUARTER, "h_median"] / made.loc[NEWMARK, "h_median"] == pytest.approx(4.0 ** (1 / 3), rel=0.05)
    assert made["retried"].between(0.0, 1.0).all()


@pytest.mark.slow
def test_twoloop_keeps_the_constraints_and_forms_of_lower_index_their_own_level(quick):
    made = quick[1]["violation"]
    line_up = tables.where(made, group="line-up").set_index("solver")
    ours = line_up[line_up["family"] == "two-loop"]
    assert len(ours) >= 8 and (ours[["violation_q", "violation_v"]] < 1e-13).all(axis=None)
    assert (ours[["violation_35", "violation_36"]].max(axis=1) <= ours["violation_q"]).all()
    plain, bounded = (line_up.loc[name] for name in ("DOP853, index 1", BAUMGARTE))
    assert plain["violation_q"] > 10.0 * bounded["violation_q"] > 1e-12
    assert violation.grows(plain) and not violation.grows(bounded)
    assert line_up.loc["Exudyn, GeneralizedAlpha"]["violation_q"] < 1e-12
    assert tables.where(made, group="loops")["violation_q"].item() > 1e-10


def test_errors_are_those_of_the_tip_and_a_run_that_ends_early_has_none():
    case = beam.case_of(SOFT, SOFT, True)
    run, start = Run(case, beam.line_up()["RadauIIA5"], 1e-8, "run"), (case.problem.q0, case.problem.v0)
    result = solve_dae(case.problem.system, (0.0, case.t_end), *start, method="RadauIIA5", rtol=1e-8, atol=1e-8)
    assert beam.measure(run, result)["error_tip"] < 1e-8 and case.reference.floor < 1e-8
    result.q[-5, -1] += 1e-3
    assert abs(beam.measure(run, result)["error_tip"] - 1e-3) < 1e-8
    early = solve_dae(case.problem.system, (0.0, case.t_end), *start, method="RadauIIA5", max_steps=3)
    row = beam.measure(run, early)
    assert row["error_tip"] is None and row["astray"]


def test_theory_of_fixed_point_iteration():
    assert abs(beam.gauss_seidel_limit(sun_radau_iib(3)) - 3.2211) < 1e-4
    # with one stage there are no others, whose latest values could be used
    assert beam.gauss_seidel_limit(gauss(1)) == pytest.approx(2.0)
    assert abs(beam.frequencies(MAKE[SOFT]())[-1] - 3358.5) < 0.05
