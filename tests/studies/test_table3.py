"""Table 3: its sentences turn with the rows, and the causes are computed."""

import itertools

import numpy as np
import pandas as pd
import pytest

from studies.bench.collector import REPEATS
from studies.bench.solvers import IDA_C, IRK, IRK_LINE, NEWMARK, QUARTER
from studies.table3 import study as table3
from studies.table3.causes import (
    FAMILIES,
    PAPER_IRK,
    PAPER_NEWMARK,
    READINGS,
    TOLERANCES,
    by_repetition,
    causes,
    cells,
    fit,
    printed,
)
from tests.studies.of_study import GOOD, QuickRun, found_of

STUDIED = table3
PROBLEMS = ("four-bar 1, 2, 1.5 m on 3 m", "four-bar 0.8, 1.2, 1 m on 2 m")


def rows(machine=10.0, step=0.0, t_end=100.0):
    """Rows in which the paper's code is `machine` times slower, and costs `step` more evaluations an attempted step."""
    common = GOOD | {"family": "two-loop", "called_from": "compiled", "keeps_constraints": True}
    common |= {"floor": 1e-11, "error_v": 0.1, "error_end": 0.01, "energy": 0.0, "t_end": t_end}
    common |= {"violation_q": 1e-15, "violation_v": 1e-15, "violation_early": 1e-16, "violation_late": 1e-16}
    common |= {"lost": False, "astray": False, "start_up_s": 1.0, "kinetic": 20.0, "n_rejected": 0.0}
    common |= {"err_in": np.nan, "err_out": np.nan, "tol": np.nan, "h": np.nan, "n_inner": 1.0}
    lines = []
    for problem in PROBLEMS:
        for group, solver in FAMILIES.items():
            for (i, e_in), (j, e_out) in itertools.product(enumerate(TOLERANCES), repeat=2):
                paper = printed(group)[i][j] or 1.0
                steps = 1600.0 if solver == IRK else 1e3 * 10.0**j
                cpu = paper / machine - 1e-6 * step * steps
                line = {"problem": problem, "group": group, "solver": solver, "err_in": e_in, "err_out": e_out}
                line |= {"call_s": cpu, "n_evaluations": cpu / 1e-6, "n_steps": steps, "error_q": 1.0}
                lines.append({**common, **line, "lost": solver == NEWMARK and j == 0})
        for name, each in (("lasting", 0.0), ("symmetric", 2.0)):
            line = {"problem": problem, "group": "partition", "solver": f"fixed step, {name}", "n_steps": 1e4}
            evaluations = 1e5
            line |= {
                "n_evaluations": evaluations,
                "call_s": 1e-6 * (evaluations + each * 1e4),
                "error_q": 1e-3,
                "h": 0.01,
            }
            lines.append({**common, **line})
        for solver, cpu in ((NEWMARK, 4.0), (QUARTER, 3.0), (IRK_LINE, 1.0), (IDA_C, 0.5), ("Gauss12", 0.2)):
            for k, error in enumerate((0.5, 1e-3, 1e-6)):
                line = {"problem": problem, "group": "comparison", "solver": solver, "tol": 10.0**-k, "error_q": error}
                line |= {"call_s": cpu * (k + 1), "n_evaluations": 1e4, "n_steps": 1e3}
                family = "SUNDIALS" if solver == IDA_C else "two-loop"
                lines.append({**common, **line, "family": family})
    for reading, what in READINGS.items():  # "all of z" as the paper's err_in column, "y_i only" as its err_out column
        for e_in, e_out in itertools.product(TOLERANCES, repeat=2):
            if TOLERANCES[-1] not in (e_in, e_out):
                continue
            paper = [row[3] for row in PAPER_IRK] if reading == "all" else PAPER_IRK[3]
            line = {"problem": PROBLEMS[0], "group": "reading", "solver": f"{IRK}, (32) on {what}", "err_in": e_in}
            line |= {"n_evaluations": 1e4 * paper[TOLERANCES.index(e_out)], "n_steps": 1600.0, "error_q": 0.01}
            line |= {"err_out": e_out, "call_s": 0.1, "astray": reading == "independent" and e_out == 1e-3}
            lines.append({**common, **line})
    return pd.DataFrame(lines)


@pytest.mark.usefixtures("unsaved")
def test_the_cells_are_our_time_beside_the_papers(tmp_path, capsys):
    assert found_of(table3, tmp_path, rows())["one_constant"] is True
    assert "| 0.36/3.60 |" in (tmp_path / "table3.md").read_text()
    assert "| 0.36/3.60 ×10 |" in capsys.readouterr().out  # paper time over ours in every cell


@pytest.mark.usefixtures("unsaved")
def test_one_machine_constant_is_told_from_more(tmp_path):
    found = found_of(table3, tmp_path, rows())
    assert found["one_constant"] and found["span_time"] == pytest.approx(1.0)
    assert not found_of(table3, tmp_path, rows(step=2.0))["one_constant"]
    found = causes(rows(step=2.0).query("problem == @PROBLEMS[0]"))
    assert found["span_time"] > 1.5 and not found["one_constant"] and found["partition_us"] == pytest.approx(2.0)
    assert found["span_partition"] == pytest.approx(1.0, abs=0.01) and found["partition_explains"]
    assert fit(cells(rows(step=2.0).query("problem == @PROBLEMS[0]")))["attempt"] == pytest.approx(2.0, rel=0.1)


@pytest.mark.usefixtures("unsaved")
def test_a_partition_too_cheap_to_be_measured_explains_nothing(tmp_path):
    made = rows(step=2.0)
    made.loc[made["solver"] == "fixed step, symmetric", "call_s"] = 0.09
    found = found_of(table3, tmp_path, made)
    assert found["partition_us"] <= 0.0 and not found["partition_explains"]


def test_ratios_of_times_show_their_scatter():
    slow, fast = (pd.Series({"times": times}) for times in ((1.0, 0.7, 0.9, 0.71), (0.1, 0.1, 0.1, 0.1)))
    assert by_repetition(slow, fast) == pytest.approx([7.0, 10.0])


@pytest.mark.usefixtures("unsaved")
def test_findings_turn_with_the_rows(tmp_path):
    found = found_of(table3, tmp_path, rows())
    assert (found["newmark_lost"], found["irk_lost"], found["failed"]) == (["1e-3"], [], 0)
    assert found["newmark_dearer_everywhere"] and found["newmark_over_irk"] == pytest.approx([3.0, 4.0])
    assert {at["solver"] for at in found["cheapest"]} == {"Gauss12"}
    made = rows()
    made["lost"] = made["solver"] == IRK
    made.loc[made["solver"] == QUARTER, "call_s"] = 0.1
    made.loc[made["solver"] == IDA_C, "call_s"] = 0.01
    failing = made.index[made["solver"] == IDA_C][-1]
    made.loc[failing, ["status", "error_q"]] = ["STEP_TOO_SMALL", np.nan]
    found = found_of(table3, tmp_path, made)
    assert found["newmark_lost"] == [] and found["irk_lost"][0] == "1e-3" and not found["newmark_dearer_everywhere"]
    assert (found["failed"], found["failed_two_loop"]) == (1, 0)
    assert (found["cheapest"][0]["solver"], found["cheapest"][0]["ours"]) == (IDA_C, False)


@pytest.mark.usefixtures("unsaved")
def test_the_growth_of_newmarks_cost_stands_beside_the_printed_one(tmp_path):
    made = rows()
    cells_ = (made["group"] == "Table 3: Newmark") & ~made["lost"]
    made.loc[cells_, "n_evaluations"] = made.loc[cells_, "err_out"] ** -0.25  # 10 ** 0.5 in two decades
    first, second = found_of(table3, tmp_path, made)["newmark_growth"]
    assert (first["from"], first["to"], second["to"]) == ("1e-5", "1e-7", "1e-9")  # the paper has a star at 1e-3
    assert first["printed"] == pytest.approx([12.68 / 3.10, 12.62 / 2.71])
    assert second["printed"] == pytest.approx([50.93 / 13.40, 49.68 / 12.36])
    assert first["time"] == pytest.approx(first["printed"]) and second["time"] == pytest.approx(second["printed"])
    assert first["evaluations"] == pytest.approx([10.0**0.5] * 2) == second["evaluations"]
    text = (tmp_path / "table3.md").read_text()
    assert "printed time by 4.1–4.7 and 3.8–4.0 (over all err_in), our time by 4.1–4.7 and 3.8–4.0 and our" in text
    assert "evaluations by 3.2 and 3.2; a local error of order h³ predicts 4.6." in text
    made.loc[cells_ & (made["err_out"] == 1e-7), "lost"] = True
    assert found_of(table3, tmp_path, made)["newmark_growth"] == []
    assert "Newmark's printed time" not in (tmp_path / "table3.md").read_text()


@pytest.mark.usefixtures("unsaved")
def test_both_readings_of_the_stopping_test_are_compared_with_the_printed_row(tmp_path):
    found = found_of(table3, tmp_path, rows())["readings"]
    assert {line["over"]: line["astray"] for line in found} == {"all of z": False, "y_i only": True}
    every, independent = found
    assert independent["rms"] == pytest.approx(0.0, abs=1e-12) and every["rms"] > 0.1
    text = (tmp_path / "table3.md").read_text()
    assert "the run on all of z stays in phase, the run on y_i only leaves the phase." in text
    made = rows()
    made.loc[made["solver"].str.contains("y_i only"), "status"] = "RAISED"
    assert len(found_of(table3, tmp_path, made)["readings"]) == 1
    assert "deviate (rms)" not in (tmp_path / "table3.md").read_text()


@pytest.mark.usefixtures("unsaved")
def test_the_exchanged_labels_fit_only_where_they_do(tmp_path):
    assert not found_of(table3, tmp_path, rows(step=2.0))["exchanged_fits_better"]
    made = rows()
    cells_ = made["group"] == "Table 3: IRK"
    paper = [PAPER_IRK[TOLERANCES.index(o)][TOLERANCES.index(i)] for i, o in made[cells_][["err_in", "err_out"]].values]
    made.loc[cells_, "n_evaluations"] = 1e5 * np.array(paper)
    found = found_of(table3, tmp_path, made)
    assert found["exchanged_fits_better"] and found["fits"]["exchanged"]["span"] <= found["flat"]


@pytest.mark.usefixtures("unsaved")
def test_a_quick_report_compares_nothing_with_the_paper(tmp_path):
    found_of(table3, tmp_path, rows(t_end=10.0), quick=True)
    assert "3.60" not in (tmp_path / "table3.md").read_text()


def test_printed_times_are_the_papers():
    assert PAPER_IRK[3] == (3.37, 3.46, 3.55, 3.60) and PAPER_NEWMARK[3][1:] == (3.09, 13.40, 50.93)
    exchanged = cells(rows(), exchanged=True)
    assert exchanged["paper"].tolist()[1] == PAPER_IRK[1][0]  # (1e-3, 1e-5) of ours beside (1e-5, 1e-3) of the paper's


def test_the_study_lists_all_cells_once():
    from studies.bench.cases import four_bar

    runs = table3.runs(*four_bar.cases(False), False)
    cells_ = [run for run in runs if run.group in FAMILIES and run.case.name == "four-bar"]
    assert len(cells_) == 32 and all(run.repeats == REPEATS for run in cells_)
    assert len({run.key(0) for run in runs}) == len(runs)
    assert sum(run.repeats for run in table3.runs(*four_bar.cases(True), True)) < 100


@pytest.mark.slow  # as that of step_size
class TestQuickRun(QuickRun):
    pictures = ("table3",)


@pytest.mark.slow  # the quick study
def test_the_quick_study_has_all_cells(made):
    found = made[made["group"].isin(FAMILIES) & (made["case"] == "four-bar")]
    assert len(found) == 32 and (found["status"] == "REACHED_END").all()
    newmark = found[(found["solver"] == NEWMARK) & (found["err_in"] == 1e-9)].set_index("err_out")
    for finer, coarser in ((1e-7, 1e-5), (1e-9, 1e-7)):  # the cube root of 100, 4.64, less what the iterations save
        assert 3.5 < newmark["n_evaluations"][finer] / newmark["n_evaluations"][coarser] < 5.0
    irk = found[(found["solver"] == IRK) & (found["err_in"] == 1e-9)].set_index("err_out")
    assert newmark["n_evaluations"][1e-9] > 5.0 * irk["n_evaluations"][1e-9]


def test_the_default_is_called_a_series_where_it_takes_the_steps_of_one():
    made = pd.DataFrame(
        [
            {"solver": solver, "tol": tol, "error_q": 1.1 * tol, "n_steps": 1e3, "used": used}
            for solver, used in (("auto", "explicit"), ("Taylor", np.nan))
            for tol in (1e-4, 1e-6, 1e-8)
        ]
    )
    assert table3._of_default(made) == {"series_from": 1e-4, "default_explicit": False}
    made.loc[0, "n_steps"] = 900.0
    assert table3._of_default(made) == {"series_from": 1e-6, "default_explicit": True}
    made.loc[2, "error_q"] = 1.0
    assert table3._of_default(made)["series_from"] is None


@pytest.mark.usefixtures("unsaved")
def test_times_that_scatter_with_the_same_counts_give_a_range_of_ratios(tmp_path):
    found = found_of(table3, tmp_path, rows())
    assert not found["times_unequal"] and "times as long, by repetition: " in (tmp_path / "table3.md").read_text()
    made = pd.concat([rows().assign(repeat=k) for k in range(5)]).sort_index(kind="stable").reset_index(drop=True)
    slow = (made["group"] == "Table 3: Newmark") & (made["err_out"] == 1e-9)
    made.loc[slow & made["repeat"].isin((1, 2, 4)), "call_s"] *= 1.3
    found = found_of(table3, tmp_path, made)
    text = (tmp_path / "table3.md").read_text()
    assert found["times_unequal"] and " times as long, by repetition: 6.6 and " in text
    assert "| 6.6 (5.1–6.6)/50.93 |" in text
