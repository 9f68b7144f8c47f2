"""The beam study: quick run, redraw, what must hold in its rows, and its measures by themselves."""

import numpy as np
import pandas as pd
import pytest

from studies import beam
from studies.beam_limits import PAPER_SWEEPS, bisect, free_limit, frequencies, gauss_seidel_rate, jacobi_rate
from studies.beam_report import goals
from studies.beam_runs import (
    BDF,
    CASES,
    NEWTON,
    PAPER,
    SOFT,
    STIFF,
    BeamJob,
    collect,
    measure,
    thinned,
    true_motion,
)
from studies.beam_tables import cheapest, cpu_for
from studies.report import load_rows, load_series, save_rows
from twoloop import solve_dae
from twoloop.mechanisms import ancf_beam, four_bar
from twoloop.tableaux import gauss, sun_radau_iib


@pytest.fixture(scope="module")
def out(tmp_path_factory):
    folder = tmp_path_factory.mktemp("beam")
    beam.main(["--quick", "--out", str(folder)])
    return folder


@pytest.fixture(scope="module")
def rows(out):
    return load_rows(out / "beam.csv")[0]


def pick(rows, **equal):
    for column, value in equal.items():
        rows = rows[rows[column] == value]
    return rows


def test_report_and_figures_can_be_drawn_again(out):
    text = (out / "beam.md").read_text()
    assert "The start is assumed" in text and "nan" not in text
    pictures = [out / f"beam_{name}.png" for name in ("motion", "cost", "sensitivity", "growth")]
    for picture in pictures:
        picture.unlink()
    beam.main(["--quick", "--out", str(out), "--redraw"])
    assert (out / "beam.md").read_text() == text
    assert all(picture.stat().st_size > 10_000 for picture in pictures)
    assert (out / "beam_series.npz").stat().st_size < 300_000


def test_a_failed_run_is_a_row_of_the_report(out, rows, tmp_path):
    for name in ("beam.csv", "beam_series.npz"):
        (tmp_path / name).write_bytes((out / name).read_bytes())
    failed = rows.copy()
    what = pick(rows, group="run", solver=BDF, case=STIFF).index[0]
    failed.loc[what, ["error_tip", "error_middle", "error_energy"]] = np.nan
    failed.loc[what, ["status", "t_reached"]] = ["NOT_CONVERGED", 0.05]
    save_rows(tmp_path / "beam.csv", failed, "changed by a test")
    beam.main(["--quick", "--out", str(tmp_path), "--redraw"])
    assert "| not converged at 0.05 s |" in (tmp_path / "beam.md").read_text()


def test_every_quick_run_follows_the_reference(rows):
    runs = pick(rows, group="run")
    assert (runs["status"] == "REACHED_END").all()
    assert runs["error_tip"].max() < 1e-3
    assert pick(rows, group="truth")["error_tip"].max() < 1e-8


def test_newton_takes_far_fewer_evaluations_in_the_stiff_case(rows):
    counts = {
        solver: pick(rows, group="run", case=STIFF, solver=solver)["n_evaluations"].min() for solver in (PAPER, NEWTON)
    }
    assert counts[PAPER] > 300.0 * counts[NEWTON]


def test_the_papers_steps_are_of_its_orders_of_magnitude(rows):
    steps = {case: pick(rows, group="run", case=case, solver=PAPER)["h_median"].iloc[0] for case in CASES}
    assert 1e-4 < steps[SOFT] < 3e-3
    assert 1e-5 < steps[STIFF] < 1e-4


def test_sweeps_have_the_rates_and_limits_of_theory(rows):
    limits = pick(rows, group="limit").set_index("solver")
    others = limits.drop(index=PAPER_SWEEPS)
    np.testing.assert_allclose(others["rate"], others["rate_theory"], rtol=0.06)
    assert (limits["measured"] < 1.001 * limits["theory"]).all()
    for beta, limit in ((0.25, 2.0), (0.5, np.sqrt(2.0))):
        row = limits.loc[f"Newmark, beta = {beta:g}"]
        assert abs(row["theory"] - limit) < 1e-9 and row["measured"] > 0.93 * limit
    assert abs(limits.loc[PAPER_SWEEPS, "free"] / limits.loc[PAPER_SWEEPS, "theory"] - 1.0) < 3e-3


def test_theory_of_the_sweeps():
    sun = sun_radau_iib(3)
    assert abs(jacobi_rate(sun, 1.0 / 0.215314) - 1.0) < 1e-5
    assert abs(jacobi_rate(gauss(2), 2.0 * np.sqrt(3.0)) - 1.0) < 1e-12
    assert abs(bisect(lambda x: gauss_seidel_rate(sun, x) < 1.0, 0.1, 20.0, 50) - 3.2211) < 1e-4
    # of one stage there are no others, whose latest could be used
    assert abs(gauss_seidel_rate(gauss(1), 1.3) ** 2 - jacobi_rate(gauss(1), 1.3)) < 1e-12
    problem = ancf_beam(1, youngs_modulus=2e6, amplitude=1e-3, angular_frequency=1.0, gravity=0.0)
    assert abs(free_limit(problem, sun, latest=False) / 4.64437 - 1.0) < 5e-3


def test_frequencies_are_those_of_the_published_case():
    assert abs(frequencies(CASES[SOFT]())[-1] - 3358.5) < 0.05


def test_what_stiffness_does_to_newton_and_to_sweeps(rows):
    modulus = pick(rows, group="modulus")
    grown = {}
    for solver, tol in ((NEWTON, 1e-2), (PAPER, 1e-5)):
        line = pick(modulus, solver=solver, tol=tol).sort_values("modulus")
        each = (line["n_evaluations"] / line["t_end"]).to_numpy()
        grown[solver] = each[-1] / each[0]
    assert grown[PAPER] > 2.5  # sqrt(10), as the frequencies
    assert grown[NEWTON] < 2.0


def test_the_soft_beam_feels_its_mesh_and_its_start_most(out):
    series = load_series(out / "beam_series.npz")
    assert series["sensitivity: t"][-1] == np.float32(0.2)

    def largest(case, name):
        return np.abs(series[f"sensitivity: {case}, {name}"]).max()

    for name in ("8 elements", "start of the whole beam"):
        assert largest(SOFT, name) > 3.0 * largest(STIFF, name) > 0.0
        assert largest(SOFT, name) > 10.0 * largest(SOFT, "g + 0.1 %") > 0.0


def test_errors_are_those_of_the_tip_and_a_run_that_ends_early_has_none():
    problem = CASES[SOFT]()
    job = BeamJob(SOFT, NEWTON, 1e-3, 0.1)
    truth = true_motion(problem, 0.1)
    result = solve_dae(problem.system, (0.0, 0.1), problem.q0, problem.v0, "RadauIIA5", 1e-8, 1e-8, t_eval=job.times)
    row = measure(job, result, problem, truth)
    assert row["error_tip"] < 1e-9 and row["error_energy"] < 1e-6
    result.q[-5, -1] += 1e-3
    assert abs(measure(job, result, problem, truth)["error_tip"] - 1e-3) < 1e-8
    early = solve_dae(
        problem.system, (0.0, 0.1), problem.q0, problem.v0, "RadauIIA5", 1e-8, 1e-8, t_eval=job.times, max_steps=3
    )
    row = measure(job, early, problem, truth)
    assert row["status"] == "MAX_STEPS" and np.isnan(row["error_tip"])


def test_a_solver_that_is_not_there_is_a_row(monkeypatch):
    def absent(problem, tol, times):
        raise RuntimeError("no such library")

    monkeypatch.setitem(beam.collect.__globals__["SOLVERS"], NEWTON, absent)
    made, _ = collect([BeamJob(SOFT, NEWTON, 1e-3, 0.1)], {SOFT: true_motion(CASES[SOFT](), 0.1)})
    assert made[0]["status"] == "SOLVER_FAILED" and made[0]["message"] == "no such library"


def run_row(solver, error, cpu, case=SOFT):
    return {"group": "run", "case": case, "solver": solver, "error_tip": error, "cpu_s": cpu, "tol": error}


def test_cost_at_the_target_lies_between_two_runs():
    rows = pd.DataFrame([run_row(NEWTON, 1e-3, 1.0), run_row(NEWTON, 1e-5, 100.0), run_row(PAPER, 1e-9, 7.0)])
    assert abs(cpu_for(rows, SOFT, NEWTON) - 10.0) < 1e-9
    assert cpu_for(rows, SOFT, PAPER) == 7.0  # the loosest run there is
    assert np.isnan(cpu_for(rows, SOFT, BDF)) and np.isnan(cpu_for(rows, STIFF, NEWTON))
    assert cheapest(rows, SOFT, NEWTON)["cpu_s"] == 100.0 and cheapest(rows, SOFT, BDF) is None


def test_goals_follow_the_rows(rows):
    def reached(changed):
        return {line[0]: line[2] for line in goals(changed)}

    changed = rows.copy()
    slow = (changed["group"] == "run") & (changed["solver"] == PAPER)
    changed.loc[slow, "cpu_s"] = 1e5
    before, after = reached(rows), reached(changed)
    asked = [goal for goal in before if goal.startswith("the paper's procedure")]
    assert len(asked) == 2 and all(before[goal] == "yes" and after[goal] == "no" for goal in asked)
    asked = [goal for goal in before if goal.startswith("Newton's method, ")]
    assert all(after[goal] == "yes" for goal in asked)
    for words in ("faster than IDA", "4 to 64 elements", "E = 2e10"):  # none of these in the quick run
        assert {before[goal] for goal in before if words in goal} == {"not measured"}


def test_thinned_steps_keep_the_extremes():
    h = np.full(5000, 1e-3)
    h[[7, 4000]] = 1e-6, 1e-1
    curve = thinned(h)
    assert curve.shape[0] == 4 and curve.shape[1] <= 400
    assert curve[1].min() == 1e-6 and curve[3].max() == 1e-1 and abs(curve[0, 1] - 0.012) < 2e-3
    few = thinned(np.array([1.0, 2.0]))
    np.testing.assert_array_equal(few, [[0.0, 1.0], [1.0, 2.0], [1.0, 2.0], [1.0, 2.0]])


def test_other_mechanisms_have_no_reference_here():
    with pytest.raises(ValueError, match="problem must be a beam of ancf_beam"):
        true_motion(four_bar(), 0.1)
