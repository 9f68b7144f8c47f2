"""The study of size: powers and ratios turn with the rows; assemblies and Exudyn's models of them agree."""

import numpy as np
import pandas as pd
import pytest

from studies import scale
from studies.bench.large import PLANAR, SPATIAL, open_chain
from studies.bench.render import render

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


def said(*parts):
    rows = pd.concat(parts, ignore_index=True)
    found = scale.findings_of(rows)
    return found, render("scale", found, {}, stamp="stamp", quick=False, rows=rows)


def test_powers_and_ratios_follow_the_rows():
    found, text = said(evaluations(), chains())
    (kind,), (chain,) = found["kinds"], found["chains"]
    assert kind["slope"] == pytest.approx(1.0) and not kind["bends"] and "|200|1.00|" in text
    assert chain["fastest"]["1e-4"] == {"solver": EXUDYN, "ratio": pytest.approx(50.0)}
    assert chain["call_s"][scale.DEFAULT]["1e-4"] == pytest.approx(0.1, rel=1e-2)
    assert found["answer"].endswith("power 1.00; on 20 bodies Exudyn takes 50 times as long (1e-4).")
    assert f"**Answer**: {found['answer']}" in text and "With 20 bodies" not in text
    found, text = said(evaluations(2.0), chains(ours=1.0, exudyn=0.5))
    assert found["kinds"][0]["slope"] == pytest.approx(2.0) and "power 2.00; on 20" in found["answer"]
    assert "With 20 bodies, Exudyn, GeneralizedAlpha takes 0.50 times" in text


def test_a_cost_is_of_a_run_that_is_good_enough():
    rows = chains()
    rows = rows[(rows["solver"] != EXUDYN) | rows["error_q"].isin((1e-2, 1e-6))]
    rows.loc[(rows["solver"] == EXUDYN) & (rows["error_q"] == 1e-2), "call_s"] /= 5.0
    assert said(evaluations(), rows)[0]["chains"][0]["fastest"]["1e-3"]["ratio"] == pytest.approx(50.0)
    rows = rows[(rows["solver"] != EXUDYN) | (rows["error_q"] == 1e-2)]
    found = said(evaluations(), rows)[0]
    assert found["chains"][0]["fastest"] == {} and found["answer"].endswith("power 1.00.")


def test_a_power_that_changes_with_the_size_is_said_to_change():
    rows = evaluations()
    rows.loc[rows["n"] == 1000, "evaluation_us"] *= 5.0
    found, text = said(rows, chains())
    assert found["kinds"][0]["bends"] and "One power does not describe the open chain" in text


def test_sizes_whose_stages_are_projected_are_named():
    rows = evaluations(passes=2.0)
    assert "singular position" not in said(rows, chains())[1]
    rows.loc[rows["n"] == 100, "passes"] = 12.0
    assert "The open chain of 100 is near a singular position" in said(rows, chains())[1]


def test_a_failed_size_is_named_and_in_no_fit():
    failed = evaluations().assign(status="FAILED", message="lost rank", evaluation_us=None)
    found, text = said(evaluations(), failed[failed["n"] == 1000].assign(case="star"), chains())
    assert [line["slope"] is None for line in found["kinds"]] == [False, True] and "star of 1000" in text


def test_cvode_is_run_for_all_tolerances_of_the_default():
    assert scale.solvers(20)[scale.OTHERS[20][0]] == scale.solvers(20)[scale.DEFAULT]


@pytest.mark.parametrize("build", [*PLANAR, *SPATIAL])
def test_assemblies_start_on_their_constraints(build):
    made = build(12)
    assert np.abs(made.system.constraint(0.0, made.q)).max() < 1e-14
    assert made.system.n_q == 12 * (7 if build in SPATIAL else 3)
    redundant = 3 if build.__name__ == "closed_chain_of_hinges" else 0
    assert np.linalg.matrix_rank(made.system.jacobian(0.0, made.q), 1e-8) == made.system.n_c - redundant


@pytest.mark.slow
def test_exudyns_bodies_move_as_those_of_twoloop():
    pytest.importorskip("exudyn")
    from references.exudyn.mechanisms import solve_pinned
    from twoloop import solve_dae

    made = open_chain(5)
    problem = scale.problem_of(made, 0.2)
    ends = [solve_pinned(problem, made.bodies, steps).q[:, -1] for steps in (100, 200)]
    ours = solve_dae(problem.system, problem.t_span, problem.q0, problem.v0, rtol=1e-9, atol=1e-9).q[:, -1]
    errors = [np.abs(end - ours).max() for end in ends]
    assert errors[1] < 1e-3 and errors[0] / errors[1] == pytest.approx(4.0, rel=0.2)


def test_engines_follow_the_rows():
    beside = [
        {"group": scale.TREE, "case": "open chain", "solver": name, "n": n, "evaluation_us": us * n, "start_s": 1.0}
        for name, us in (("MuJoCo", 0.5), ("Pinocchio", 0.25))
        for n in (10, 30, 600)
    ]
    rows = pd.DataFrame(beside).assign(status="REACHED_END", repeat=0)
    found, text = said(evaluations(), chains(), rows)
    assert found["trees"]["open chain, Pinocchio"] == {10: 2.5, 30: 7.5, 600: 150.0}
    assert "|open chain, MuJoCo|15|300|" in text


@pytest.mark.slow
def test_the_quick_run(tmp_path):
    scale.STUDY.main(["--quick", "--out", str(tmp_path)])
    text = (tmp_path / "scale.md").read_text()
    assert "Quick run" in text and "|open chain|" in text and (tmp_path / "scale_chains.png").is_file()
