"""Table 3: its sentences turn with the rows, and the causes are computed."""

import itertools
import json

import numpy as np
import pandas as pd
import pytest

from studies import table3
from studies.cli import Call
from studies.render import number_of_words
from studies.solvers import IDA_C, IRK, IRK_LINE, NEWMARK, QUARTER
from studies.store import Output
from studies.table3_causes import (
    FAMILIES,
    PAPER_IRK,
    PAPER_NEWMARK,
    READINGS,
    TOLERANCES,
    causes,
    cells,
    fit,
    printed,
    readings,
)

PROBLEMS = ("four-bar 1, 2, 1.5 m on 3 m", "four-bar 0.8, 1.2, 1 m on 2 m")


def rows(machine=10.0, step=0.0, t_end=100.0):
    """Rows in which the paper's code is `machine` times slower, and costs `step` more evaluations an attempted step."""
    common = {"family": "two-loop", "called_from": "compiled", "keeps_constraints": True, "status": "REACHED_END"}
    common |= {"message": "", "floor": 1e-11, "error_v": 0.1, "error_end": 0.01, "energy": 0.0, "t_end": t_end}
    common |= {"violation_q": 1e-15, "violation_v": 1e-15, "violation_early": 1e-16, "violation_late": 1e-16}
    common |= {"lost": False, "astray": False, "repeat": 0, "start_up_s": 1.0, "kinetic": 20.0, "n_rejected": 0.0}
    common |= {"err_in": np.nan, "err_out": np.nan, "tol": np.nan, "h": np.nan, "n_inner": 1.0}
    lines = []
    for problem in PROBLEMS:
        for group, solver in FAMILIES.items():
            for (i, e_in), (j, e_out) in itertools.product(enumerate(TOLERANCES), repeat=2):
                paper = printed(group)[i][j] or 1.0
                steps = 1600.0 if solver == IRK else 1e3 * 10.0**j
                cpu = paper / machine - 1e-6 * step * steps
                line = {"problem": problem, "group": group, "solver": solver, "err_in": e_in, "err_out": e_out}
                line |= {"cpu_s": cpu, "n_evaluations": cpu / 1e-6, "n_steps": steps, "error_q": 1.0}
                lines.append({**common, **line, "lost": solver == NEWMARK and j == 0})
        for name, each in (("lasting", 0.0), ("symmetric", 2.0)):
            line = {"problem": problem, "group": "partition", "solver": f"fixed step, {name}", "n_steps": 1e4}
            evaluations = 1e5
            line |= {
                "n_evaluations": evaluations,
                "cpu_s": 1e-6 * (evaluations + each * 1e4),
                "error_q": 1e-3,
                "h": 0.01,
            }
            lines.append({**common, **line})
        for solver, cpu in ((NEWMARK, 4.0), (QUARTER, 3.0), (IRK_LINE, 1.0), (IDA_C, 0.5), ("Gauss12", 0.2)):
            for k, error in enumerate((0.5, 1e-3, 1e-6)):
                line = {"problem": problem, "group": "comparison", "solver": solver, "tol": 10.0**-k, "error_q": error}
                line |= {"cpu_s": cpu * (k + 1), "n_evaluations": 1e4, "n_steps": 1e3}
                family = "SUNDIALS" if solver == IDA_C else "two-loop"
                lines.append({**common, **line, "family": family})
    for reading, what in READINGS.items():  # "all of z" as the paper's err_in column, "y_i only" as its err_out column
        for e_in, e_out in itertools.product(TOLERANCES, repeat=2):
            if TOLERANCES[-1] not in (e_in, e_out):
                continue
            paper = [row[3] for row in PAPER_IRK] if reading == "all" else PAPER_IRK[3]
            line = {"problem": PROBLEMS[0], "group": "reading", "solver": f"{IRK}, (32) on {what}", "err_in": e_in}
            line |= {"n_evaluations": 1e4 * paper[TOLERANCES.index(e_out)], "n_steps": 1600.0, "error_q": 0.01}
            line |= {"err_out": e_out, "cpu_s": 0.1, "astray": reading == "independent" and e_out == 1e-3}
            lines.append({**common, **line})
    return pd.DataFrame(lines)


def text_of(tmp_path, made, quick=False):
    with Output(Call("table3", quick, tmp_path, False, "")) as output:
        table3.report(output, made, "stamp")
    return (tmp_path / "table3.md").read_text()


def test_the_report_is_short_and_whole(tmp_path):
    text = text_of(tmp_path, rows())
    assert number_of_words(text) < 1100
    assert (tmp_path / "table3.png").exists() and (tmp_path / "table3.svg").exists()
    assert json.loads((tmp_path / "table3.json").read_text())["one_constant"] is True
    assert "0.36 / 3.60 ×10" in text and "★ / ★" in text  # paper time over ours in every cell


def test_one_machine_constant_is_told_from_more(tmp_path):
    assert "Yes: the paper's time over ours varies by a factor of 1.0" in text_of(tmp_path, rows())
    text = text_of(tmp_path, rows(step=2.0))
    assert "No. The paper's time over ours is" in text
    found = causes(rows(step=2.0).query("problem == @PROBLEMS[0]"))
    assert found["span_time"] > 1.5 and not found["one_constant"]
    assert found["partition_evaluations"] == pytest.approx(2.0) and found["partition_us"] == pytest.approx(2.0)
    assert found["span_partition"] == pytest.approx(1.0, abs=0.01) and found["partition_explains"]
    assert "with one added to each attempted step the factor is 1.0: this explains the pattern" in text
    assert fit(cells(rows(step=2.0).query("problem == @PROBLEMS[0]")))["attempt"] == pytest.approx(2.0, rel=0.1)


def test_a_partition_too_cheap_to_be_measured_is_said_to_be_so(tmp_path):
    made = rows(step=2.0)
    made.loc[made["solver"] == "fixed step, symmetric", "cpu_s"] = 0.09
    assert "costs less than the noise of the times measured" in text_of(tmp_path, made)


def test_sentences_turn_with_the_rows(tmp_path):
    text = text_of(tmp_path, rows())
    assert "As in the paper, Newmark loses the solution with err_out = 1e-3 and only there." in text
    assert "Newmark takes longer at every error compared: 3.0 to 4.0 times" in text
    assert "All runs reached the end" in text
    assert "`Gauss12` is cheapest" in text and "times.\n- At equal error" in text
    made = rows()
    made["lost"] = made["solver"] == IRK
    made.loc[made["solver"] == QUARTER, "cpu_s"] = 0.1
    made.loc[made["solver"] == IDA_C, "cpu_s"] = 0.01
    failing = made.index[made["solver"] == IDA_C][-1]
    made.loc[failing, ["status", "error_q"]] = ["STEP_TOO_SMALL", np.nan]
    text = text_of(tmp_path, made)
    assert "Newmark loses the solution nowhere" in text and "Runge–Kutta loses it with err_out = 1e-3" in text
    assert "Newmark does not always take longer" in text
    assert f"Did not reach the end: {IDA_C} (tol 1e-2); no two-loop method among them" in text
    assert f"`{IDA_C}` is cheapest, 0.010 s (not ours)" in text


def test_the_readings_of_the_stopping_test_are_compared_with_both_columns(tmp_path):
    text = text_of(tmp_path, rows())
    assert (
        "As labelled the reading on y_i only follows the paper's column better, with the labels exchanged that on all"
        in text
    )
    assert "With err_out = 1e-3 that on all of z stays in phase, that on y_i only leaves the phase" in text
    first = rows().query("problem == @PROBLEMS[0]")
    every, independent = readings(first)
    assert every["rms_in"] == pytest.approx(0.0, abs=1e-12) and independent["rms_out"] == pytest.approx(0.0, abs=1e-12)
    assert every["relative"] == pytest.approx([1.0, 2.31 / 2.08, 2.99 / 2.08, 3.60 / 2.08])
    made = rows()
    made.loc[made["solver"].str.contains("all of z"), "n_evaluations"] = 1e4  # flatter than the printed err_out column
    made["astray"] = False
    text = text_of(tmp_path, made)
    assert "The reading on y_i only follows the paper's column better, as labelled and with the labels" in text
    assert "that on y_i only stays in phase" in text
    made.loc[made["solver"].str.contains("y_i only"), "status"] = "RAISED"
    assert "Not decided: one of the readings was not run to the end." in text_of(tmp_path, made)


def test_the_exchanged_labels_are_said_to_fit_only_where_they_do(tmp_path):
    assert "With the labels exchanged they fit no better." in text_of(tmp_path, rows(step=2.0))
    made = rows()
    cells_ = made["group"] == "Table 3: IRK"
    paper = [PAPER_IRK[TOLERANCES.index(o)][TOLERANCES.index(i)] for i, o in made[cells_][["err_in", "err_out"]].values]
    made.loc[cells_, "n_evaluations"] = 1e5 * np.array(paper)
    text = text_of(tmp_path, made)
    assert "With the labels exchanged they fit better and would explain it" in text
    assert "nothing here is exchanged" in text


def test_a_quick_report_compares_nothing_with_the_paper(tmp_path):
    made = rows(t_end=10.0)
    text = text_of(tmp_path, made, quick=True)
    assert "Quick run" in text and "3.60" not in text and "machine constant" not in text and "reading" not in text
    assert b"quick run" in (tmp_path / "table3.svg").read_bytes()


def test_printed_times_are_the_papers():
    assert PAPER_IRK[3] == (3.37, 3.46, 3.55, 3.60) and PAPER_NEWMARK[3][1:] == (3.09, 13.40, 50.93)
    exchanged = cells(rows(), exchanged=True)
    assert exchanged["paper"].tolist()[1] == PAPER_IRK[1][0]  # (1e-3, 1e-5) of ours beside (1e-5, 1e-3) of the paper's


def test_the_study_lists_all_cells_once():
    from studies.cases import four_bar

    runs = table3.runs(*four_bar.cases(False), False)
    cells_ = [run for run in runs if run.group in FAMILIES and run.case.name == "four-bar"]
    assert len(cells_) == 32 and all(run.repeats == 3 for run in cells_)
    assert len({run.key(0) for run in runs}) == len(runs)
    assert sum(run.repeats for run in table3.runs(*four_bar.cases(True), True)) < 100


def test_the_quick_study_runs_and_is_drawn_again(tmp_path):
    words = ["--quick", "--out", str(tmp_path)]
    table3.main(words)
    text = (tmp_path / "table3.md").read_text()
    made = pd.read_csv(tmp_path / "table3.csv", comment="#")
    found = made[made["group"].isin(FAMILIES) & (made["case"] == "four-bar")]
    assert len(found) == 32 and (found["status"] == "REACHED_END").all()
    newmark = found[(found["solver"] == NEWMARK) & (found["err_in"] == 1e-9)].set_index("err_out")
    for finer, coarser in ((1e-7, 1e-5), (1e-9, 1e-7)):  # the cube root of 100, 4.64, less what the iterations save
        assert 3.5 < newmark["n_evaluations"][finer] / newmark["n_evaluations"][coarser] < 5.0
    irk = found[(found["solver"] == IRK) & (found["err_in"] == 1e-9)].set_index("err_out")
    assert newmark["n_evaluations"][1e-9] > 5.0 * irk["n_evaluations"][1e-9]
    (tmp_path / "table3.png").unlink()
    table3.main([*words, "--redraw"])
    assert (tmp_path / "table3.md").read_text() == text and (tmp_path / "table3.png").exists()
    assert not list(tmp_path.glob("*.partial.jsonl"))
