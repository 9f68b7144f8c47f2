"""The study of size: slopes and ratios turn with the rows; assemblies and Exudyn's models of them agree."""

import numpy as np
import pandas as pd
import pytest
from matplotlib import pyplot as plt

from studies.bench.large import PLANAR, SPATIAL, open_chain
from studies.bench.render import render
from studies.scale import agreement, rivals, runs
from studies.scale import study as scale

EXUDYN = "Exudyn, GeneralizedAlpha"


def evaluations(power=1.0, **changed):
    made = [
        {
            "group": scale.EVALUATION,
            "case": "open chain",
            "n": n,
            "repeat": k,
            "evaluation_us": 0.1 * n**power * (1 + k),
        }
        for n in (10, 30, 100, 1000)
        for k in range(3)
    ]
    return pd.DataFrame(made).assign(step_us=1.0, start_s=0.5, status="REACHED_END", message="", **changed)


def chains(ours=0.1, exudyn=5.0):
    made = []
    for name, family, cost, setting in ((scale.DEFAULT, "two-loop", ours, "tol"), (EXUDYN, "Exudyn", exudyn, "h")):
        for error in (1e-2, 1e-3, 1e-4, 1e-5, 1e-6):
            for k in range(3):
                made.append({"solver": name, "family": family, setting: error, "error_q": error, "repeat": k})
                made[-1]["call_s"] = cost * (1.0 + 0.001 * k)
    about = {"group": scale.CHAIN, "case": "open chain of 20", "n": 20, "status": "REACHED_END", "floor": 1e-9}
    return pd.DataFrame(made).assign(called_from="compiled", keeps_constraints=True, n_evaluations=1000.0, **about)


def said(rows):
    found = scale.findings_of(rows)
    return found, render("scale", found, {}, stamp="stamp", quick=False, rows=rows)


def test_slopes_and_ratios_follow_the_rows():
    found, text = said(pd.concat([evaluations(), chains()], ignore_index=True))
    assert found["kinds"][0]["slope"] == pytest.approx([1.0] * 3)
    assert found["chains"][0]["fastest"][0] == {"error": 1e-3, "solver": EXUDYN, "over": pytest.approx([50.0, 50.0])}
    assert f"| 20 | 1.0 | 50 (1e-3), 50 (1e-4), 50 (1e-5) | `{EXUDYN}`: at least 50 |" in text
    assert [each["power"] for each in found["kinds"][0]["powers"]] == pytest.approx([1.0, 1.0])
    assert "| 200 | 1.00 (1.00–1.00) |\n" in text and "1000 bodies take 0.50 s." in text
    assert "One power does not describe" not in text
    found, text = said(pd.concat([evaluations(2.0), chains(ours=1.0, exudyn=0.5)], ignore_index=True))
    assert found["kinds"][0]["slope"][0] == pytest.approx(2.0)
    assert f"| 20 | 1.0 | 0.50 (1e-3), 0.50 (1e-4), 0.50 (1e-5) | `{EXUDYN}`: 0.50 |" in text


def test_lines_of_chains_have_a_gap_where_nothing_was_run():
    rows = pd.concat([evaluations(), chains()], ignore_index=True)
    rows = rows[(rows["solver"] != EXUDYN) | ~rows["error_q"].isin((1e-3, 1e-4))]
    made = scale.figures_of(rows, scale.findings_of(rows))
    lines = {line.get_label(): np.asarray(line.get_xdata(), dtype=float) for line in made["scale_chains"].axes[0].lines}
    for figure in made.values():
        plt.close(figure)
    assert np.isfinite(lines["compiled=False"]).all()
    assert lines[EXUDYN] == pytest.approx([1e-2, np.nan, 1e-5, 1e-6], nan_ok=True)


def test_a_power_that_changes_with_the_size_is_said_to_change():
    rows = evaluations()
    rows.loc[rows["n"] == 1000, "evaluation_us"] *= 5.0
    found, text = said(pd.concat([rows, chains()], ignore_index=True))
    assert found["kinds"][0]["powers"][-1]["power"] == pytest.approx(1.0 + np.log10(5.0))
    assert "One power does not describe the open chain" in text


def test_sizes_whose_stages_are_put_on_the_constraints_are_marked():
    rows = evaluations(passes=2.0)
    rows.loc[rows["n"] == 100, "passes"] = 12.0
    text = said(pd.concat([rows, chains()], ignore_index=True))[1]
    assert "| open chain | 6.0 | 20† | 200 | 1.00 (" in text and "†: near a singular position" in text
    assert "†" not in said(pd.concat([evaluations(passes=2.0), chains()], ignore_index=True))[1]


def test_a_rival_without_a_run_near_an_error_is_priced_from_both_sides():
    rows = chains()
    rows = rows[(rows["solver"] != EXUDYN) | rows["error_q"].isin((1e-2, 1e-6))].copy()
    rows.loc[(rows["solver"] == EXUDYN) & (rows["error_q"] == 1e-2), "call_s"] /= 5.0
    found, text = said(pd.concat([evaluations(), rows], ignore_index=True))
    assert found["chains"][0]["fastest"][0]["over"] == pytest.approx([10.0, 50.0], rel=1e-2)
    assert f"`{EXUDYN}`: at least 10 |" in text


def test_runs_without_repetitions_are_named():
    rows = chains()
    rows = rows[(rows["solver"] != EXUDYN) | (rows["error_q"] > 2e-6) | (rows["repeat"] == 0)]
    assert f"Run once: `{EXUDYN}` (finest steps)." in said(pd.concat([evaluations(), rows]))[1]


def test_a_chain_is_said_to_be_dearer_than_any_larger_one():
    made = evaluations()
    made.loc[made["n"] == 30, "evaluation_us"], made.loc[made["n"] == 100, "evaluation_us"] = 200.0, 500.0
    made.loc[made["n"] == 1000, "evaluation_us"] = 100.0
    found, text = said(pd.concat([made, chains()], ignore_index=True))
    assert found["kinds"][0]["dear"] == [30, 100] and "with 30 and 100 bodies than with a larger number" in text
    assert found["kinds"][0]["slope"] is None and "sparse form" not in text


def test_the_order_is_named_where_steps_cost_about_the_same():
    made = chains()
    ours = made[made["solver"] == scale.DEFAULT].assign(solver="DOP853 (twoloop)")
    found, text = said(pd.concat([evaluations(), made, ours], ignore_index=True))
    # 5 s of steps of 1e-6 s over 1 s; 12 evaluations of 0.1 s / 1000
    assert found["chains"][0]["step"] == pytest.approx({"exudyn": 5.005e-6, "ours": 1.2e-3}, rel=1e-2)
    assert "factor with 20 bodies comes from the order" in text
    cheap = pd.concat([evaluations(), made, ours.assign(call_s=1e-5)], ignore_index=True)
    assert "the order of its solvers" not in said(cheap)[1]


def test_cvode_is_asked_for_all_that_the_default_is_asked_for():
    assert runs.solvers(20)[runs.OTHERS[20][0]] == runs.solvers(20)[scale.DEFAULT]


def test_a_failed_size_is_named_and_in_no_fit():
    failed = evaluations().assign(status="FAILED", message="lost rank", evaluation_us=None)
    rows = pd.concat([evaluations(), failed[failed["n"] == 1000].assign(case="star"), chains()], ignore_index=True)
    found, text = said(rows)
    assert [line["case"] for line in found["kinds"]] == ["open chain"] and "star of 1000" in text


def test_random_assemblies_that_disagree_with_dense_algebra_are_said_to():
    made = [row() for _, row in agreement.agreements(True)]
    rows = pd.concat([pd.DataFrame(made), evaluations(), chains()], ignore_index=True)
    found, text = said(rows)
    assert [line["number"] for line in found["agreement"]] == [agreement.QUICK] * 2
    assert all(line["worst"] < 1e-9 and line["redundant"] > 0 for line in found["agreement"])
    assert text.count("all ranks right") == 2
    rows.loc[0, ["status", "message", "error_q"]] = ["FAILED", "rank 3 instead of 4", None]
    assert "1 failed: rank 3 instead of 4" in said(rows)[1]


@pytest.mark.parametrize("build", [*PLANAR, *SPATIAL])
def test_assemblies_start_on_their_constraints(build):
    made = build(12)
    assert np.abs(made.system.constraint(0.0, made.q)).max() < 1e-14
    assert made.system.n_q == 12 * (7 if build in SPATIAL else 3)
    redundant = 3 if build.__name__ == "closed_chain_of_hinges" else 0
    assert np.linalg.matrix_rank(made.system.jacobian(0.0, made.q), 1e-8) == made.system.n_c - redundant


def test_exudyns_bodies_move_as_ours():
    pytest.importorskip("exudyn")
    from references.exudyn.pinned import solve_pinned
    from twoloop import solve_dae

    made = open_chain(5)
    problem = runs.problem_of(made, 0.2)
    ends = [solve_pinned(problem, made.bodies, steps).q[:, -1] for steps in (100, 200)]
    ours = solve_dae(problem.system, problem.t_span, problem.q0, problem.v0, rtol=1e-9, atol=1e-9).q[:, -1]
    errors = [np.abs(end - ours).max() for end in ends]
    assert errors[1] < 1e-3 and errors[0] / errors[1] == pytest.approx(4.0, rel=0.2)


def test_engines_and_where_others_stop_follow_the_rows():
    beside = [
        {"group": rivals.TREE, "case": "open chain", "solver": name, "n": n, "evaluation_us": us * n, "start_s": 1.0}
        for name, us in (("MuJoCo", 0.5), ("Pinocchio", 0.25))
        for n in (10, 30, 600)
    ]
    grown = [
        {"group": rivals.UNTIL, "solver": "heyoka", "n": n, "build_s": 1.0, "call_s": 0.002, "error_q": 1e-7}
        for n in (5, 10)
    ]
    rows = pd.DataFrame([*beside, *grown]).assign(status="REACHED_END", repeat=0)
    stopped = {"group": rivals.UNTIL, "solver": "heyoka", "n": 20, "status": "TIME_LIMIT", "message": "not run: 17 s"}
    found, text = said(pd.concat([evaluations(), chains(), rows, pd.DataFrame([stopped])], ignore_index=True))
    assert "Accelerations of 30 bodies" in text and "| | MuJoCo | Pinocchio | ours |\n" in text
    assert "\n| open chain | 15 | 7.5 | 6.0 |\n" in text
    assert found["trees"][0]["engines"]["Pinocchio"] == {10: 2.5, 30: 7.5, 600: 150.0}
    assert "| heyoka | 1.0/2.0 |\n" in text and "at most 1e-7" in text
    assert "–: not run, heyoka from 20 bodies on." in text
    before = [40, rivals.BUDGET]
    assert rivals.until_row(80, "heyoka", before)["status"] == "TIME_LIMIT" and before[0] == 40
