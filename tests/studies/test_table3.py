"""Table 3: its numbers turn with the rows, and the causes are computed."""

import itertools
from functools import cache
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest

from studies import table3
from studies.bench import four_bar
from studies.bench.solvers import IDA_C, IRK, IRK_LINE, NEWMARK, QUARTER
from studies.table3 import FAMILIES, PAPER_IRK, PAPER_NEWMARK, PRINTED, READINGS, TOLERANCES, causes, cells, fit, main
from tests.studies.of_study import GOOD, found_of

SHORT = SimpleNamespace(STUDY=table3.study_of())
PROBLEMS = ("four-bar 1, 2, 1.5 m on 3 m", "four-bar 0.8, 1.2, 1 m on 2 m")


@cache
def kept_rows(machine=10.0, step=0.0, t_end=100.0):
    """Rows in which the paper's code is `machine` times slower, and costs `step` more evaluations an attempted step."""
    common = GOOD | {"family": "two-loop", "called_from": "compiled", "keeps_constraints": True}
    common |= {"floor": 1e-11, "error_v": 0.1, "error_end": 0.01, "energy": 0.0, "t_end": t_end}
    common |= {"violation_q": 1e-15, "violation_v": 1e-15, "violation_early": 1e-16, "violation_late": 1e-16}
    common |= {"lost": False, "astray": False, "start_up_s": 1.0, "kinetic": 20.0, "n_rejected": 0.0}
    common |= {"assumed": True, "err_in": np.nan, "err_out": np.nan, "tol": np.nan, "h": np.nan, "n_inner": 1.0}
    lines = []
    for problem in PROBLEMS:
        for group, solver in FAMILIES.items():
            for (i, e_in), (j, e_out) in itertools.product(enumerate(TOLERANCES), repeat=2):
                paper = PRINTED[group][i][j] or 1.0
                steps = 1600.0 if solver == IRK else 1e3 * 10.0**j
                cpu = paper / machine - 1e-6 * step * steps
                line = {"problem": problem, "group": group, "solver": solver, "err_in": e_in, "err_out": e_out}
                line |= {"call_s": cpu, "n_evaluations": cpu / 1e-6, "n_steps": steps, "error_q": 1.0}
                lines.append({**common, **line, "lost": solver == NEWMARK and j == 0})
        for name, each in (("lasting", 0.0), ("symmetric", 2.0)):
            line = {"problem": problem, "group": "partition", "solver": f"fixed step, {name}", "n_steps": 1e4}
            line |= {"n_evaluations": 1e5, "call_s": 1e-6 * (1e5 + each * 1e4), "error_q": 1e-3, "h": 0.01}
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


def rows(**numbers):
    """Return rows that a test may change."""
    return kept_rows(**numbers).copy()


def first(made):
    """Return the rows of the short study: the first geometry's cells and what stands beside them."""
    own = made[(made["problem"] == PROBLEMS[0]) & made["group"].isin((*FAMILIES, "comparison"))]
    return own.replace({"group": {"comparison": "beside"}})


@pytest.mark.usefixtures("unsaved")
def test_the_cells_stand_beside_the_printed_times(tmp_path, capsys):
    found = found_of(SHORT, tmp_path, first(rows()))
    text = (tmp_path / "table3.md").read_text()
    assert "|1e-9|0.34|0.35|0.35|0.36|" in text and "|1e-9|3.370|3.460|3.550|3.600|" in text
    assert "| 1e-9 | 0.34 | 0.35 | 0.35 | 0.36 |" in capsys.readouterr().out
    assert found["irk_over"] == pytest.approx([10.0, 10.0])
    assert (found["newmark_lost"], found["irk_lost"], found["failed"]) == (["1e-3"], [], 0)
    assert found["answer"] in text
    assert text.index(f"|{IDA_C}|tol 1.0|0.50|0.50|") < text.index(f"|{IDA_C}|tol 0.10|1.0|1e-3|")


@pytest.mark.usefixtures("unsaved")
def test_runs_that_are_lost_or_fail_are_told(tmp_path):
    made = first(rows())
    made["lost"] = made["solver"] == IRK
    made.loc[made["solver"] == NEWMARK, "astray"] = True
    made.loc[made.index[made["solver"] == IDA_C][-1], ["status", "error_q"]] = ["STEP_TOO_SMALL", np.nan]
    found = found_of(SHORT, tmp_path, made)
    assert found["newmark_lost"] == [] and found["irk_lost"][0] == "1e-3" and found["failed"] == 1
    assert found["newmark_only_astray"] == ["1e-3", "1e-5", "1e-7", "1e-9"] and not found["irk_over"]
    found_of(SHORT, tmp_path, first(rows(t_end=10.0)), quick=True)
    assert "3.600" not in (tmp_path / "table3.md").read_text()  # a shorter run is not compared with the paper's


def test_another_geometry_needs_all_four_lengths_and_must_assemble(tmp_path):
    for words in (
        ["--lengths", "1", "2", "1.5"],
        ["--lengths", "1", "2", "1.5", "--ground", "30"],
        ["--lengths", "1", "2", "1.5", "--ground", "3", "--full"],
    ):
        with pytest.raises(SystemExit, match="error: "):
            main([*words, "--out", str(tmp_path)])


def test_the_study_lists_all_cells_once():
    runs = table3.short_runs(four_bar.cases(False)[0], False)
    assert sum(run.group in FAMILIES for run in runs) == 32 and len({run.key(0) for run in runs}) == len(runs)
    assert {run.solver.family for run in runs} >= {"SUNDIALS", "Exudyn"}
    every = table3.runs(*four_bar.cases(False), False)
    assert len({run.key(0) for run in every}) == len(every)


@pytest.mark.slow  # the quick study, 40 runs
def test_the_quick_study_has_all_cells_and_is_drawn_again_as_it_was(tmp_path):
    main(["--quick", "--out", str(tmp_path)])
    text = (tmp_path / "table3.md").read_text()
    main(["--quick", "--out", str(tmp_path), "--redraw"])
    assert (tmp_path / "table3.md").read_text() == text
    made = pd.read_csv(tmp_path / "table3.csv", comment="#")
    found = made[made["group"].isin(FAMILIES)]
    assert len(found) == 32 and (made["status"] == "REACHED_END").all()
    newmark = found[(found["solver"] == NEWMARK) & (found["err_in"] == 1e-9)].set_index("err_out")
    for finer, coarser in ((1e-7, 1e-5), (1e-9, 1e-7)):  # the cube root of 100, 4.64, less what the iterations save
        assert 3.5 < newmark["n_evaluations"][finer] / newmark["n_evaluations"][coarser] < 5.0
    irk = found[(found["solver"] == IRK) & (found["err_in"] == 1e-9)].set_index("err_out")
    assert newmark["n_evaluations"][1e-9] > 5.0 * irk["n_evaluations"][1e-9]


@pytest.mark.slow
@pytest.mark.usefixtures("unsaved")
def test_one_machine_constant_is_told_from_more(tmp_path):
    found = found_of(table3, tmp_path, rows())
    assert found["one_constant"] and found["span_time"] == pytest.approx(1.0)
    assert not found_of(table3, tmp_path, rows(step=2.0))["one_constant"]
    found = causes(rows(step=2.0).query("problem == @PROBLEMS[0]"))
    assert found["span_time"] > 1.5 and not found["one_constant"] and found["partition_us"] == pytest.approx(2.0)
    assert found["span_partition"] == pytest.approx(1.0, abs=0.01) and found["partition_explains"]
    assert fit(cells(rows(step=2.0).query("problem == @PROBLEMS[0]")))["attempt"] == pytest.approx(2.0, rel=0.1)
    made = rows(step=2.0)
    made.loc[made["solver"] == "fixed step, symmetric", "call_s"] = 0.09  # too cheap to be measured
    found = found_of(table3, tmp_path, made)
    assert found["partition_us"] <= 0.0 and not found["partition_explains"]


@pytest.mark.usefixtures("unsaved")
def test_solvers_are_compared_at_equal_error(tmp_path):
    found = found_of(table3, tmp_path, rows())
    assert found["newmark_over_irk"] == pytest.approx([3.0, 4.0]) and not found["times_unequal"]
    assert {at["solver"] for at in found["cheapest"]} == {"Gauss12"}
    made = rows()
    made.loc[made["solver"] == QUARTER, "call_s"] = 0.1
    made.loc[made["solver"] == IDA_C, "call_s"] = 0.01
    failing = made.index[made["solver"] == IDA_C][-1]
    made.loc[failing, ["status", "error_q"]] = ["STEP_TOO_SMALL", np.nan]
    found = found_of(table3, tmp_path, made)
    assert found["newmark_over_irk"][0] < 1.0 and (found["failed"], found["failed_two_loop"]) == (1, 0)
    assert (found["cheapest"][0]["solver"], found["cheapest"][0]["ours"]) == (IDA_C, False)


@pytest.mark.usefixtures("unsaved")
def test_both_readings_of_the_stopping_test_are_compared_with_the_printed_row(tmp_path):
    found = found_of(table3, tmp_path, rows())["readings"]
    assert {line["over"]: line["astray"] for line in found} == {"all of z": False, "y_i only": True}
    every, independent = found
    assert independent["rms"] == pytest.approx(0.0, abs=1e-12) and every["rms"] > 0.1
    made = rows()
    made.loc[made["solver"].str.contains("y_i only"), "status"] = "RAISED"
    assert len(found_of(table3, tmp_path, made)["readings"]) == 1


def test_printed_times_are_the_papers():
    assert PAPER_IRK[3] == (3.37, 3.46, 3.55, 3.60) and PAPER_NEWMARK[3][1:] == (3.09, 13.40, 50.93)
    exchanged = cells(rows(), exchanged=True)
    assert exchanged["paper"].tolist()[1] == PAPER_IRK[1][0]  # (1e-3, 1e-5) of ours beside (1e-5, 1e-3) of the paper's
