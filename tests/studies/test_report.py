"""Reports are written from rows, and can be written again from the saved ones."""

import math

import pandas as pd
import pytest

from studies import linkage, table3
from studies.report import load_rows, markdown_table, number, save_rows
from studies.solvers import OWN_EXPLICIT


@pytest.mark.parametrize(
    ("value", "text"),
    [(0.0, "0"), (math.nan, "–"), (None, "–"), (0.01234, "0.0123"), (4.0, "4"), (123.4, "123.4"), (1.234e-9, "1.2e-9")],
)
def test_number(value, text):
    assert number(value) == text


def test_markdown_table():
    assert markdown_table(["a", "b"], [["1", "2"]]) == "| a | b |\n|---|--:|\n| 1 | 2 |"


def test_rows_survive_saving(tmp_path):
    rows = pd.DataFrame({"solver": ["x", "y"], "cpu_s": [0.1, math.nan]})
    save_rows(tmp_path / "rows.csv", rows, "stamp; with, commas")
    loaded, line = load_rows(tmp_path / "rows.csv")
    assert line == "stamp; with, commas"
    pd.testing.assert_frame_equal(loaded, rows)


def test_table3_quick_and_redraw(tmp_path):
    words = ["--quick", "--out", str(tmp_path)]
    table3.main(words)
    text = (tmp_path / "table3.md").read_text()
    assert "| err_in \\ err_out |" in text and "50.93" in text and "Assumed geometry" in text
    rows, _ = load_rows(tmp_path / "table3.csv")
    cells = rows[rows["group"].str.startswith("Table 3") & (rows["problem"] == rows["problem"].iloc[0])]
    assert len(cells) == 32 and (cells["status"] == "REACHED_END").all()
    newmark = cells[(cells["solver"].str.contains("Newmark")) & (cells["err_in"] == 1e-9)].set_index("err_out")
    for finer, coarser in ((1e-7, 1e-5), (1e-9, 1e-7)):  # the cube root of 100, 4.64, less what the sweeps save
        assert 3.5 < newmark["n_evaluations"][finer] / newmark["n_evaluations"][coarser] < 5.0
    irk = cells[(cells["solver"] == "PaperIRK") & (cells["err_in"] == 1e-9)].set_index("err_out")
    assert newmark["n_evaluations"][1e-9] > 5.0 * irk["n_evaluations"][1e-9]
    (tmp_path / "table3.png").unlink()
    table3.main([*words, "--redraw"])
    assert (tmp_path / "table3.md").read_text() == text
    assert (tmp_path / "table3.png").stat().st_size > 10_000
    # a solver that fails in every run, and one of our own cells, are rows like others
    failed = rows["solver"].str.startswith("Exudyn") | (rows.index == 0)
    rows.loc[failed, ["error_q", "error_v", "error_end", "energy", "violation_q", "n_steps"]] = math.nan
    rows.loc[failed, ["lost", "astray"]] = True
    rows.loc[failed, "status"] = "SOLVER_FAILED"
    save_rows(tmp_path / "table3.csv", rows, "changed by a test")
    table3.main([*words, "--redraw"])
    text = (tmp_path / "table3.md").read_text()
    ours = rows["solver"].str.startswith(("Paper", "Sun", "Gauss", "BDF", OWN_EXPLICIT)).sum()
    assert f"Runs that failed: 1 of {ours} two-loop runs, {int(failed.sum()) - 1} of the others." in text
    assert "solver failed ★" in text


def test_linkage(tmp_path):
    linkage.main(["--out", str(tmp_path)])
    assert (tmp_path / "linkage.png").stat().st_size > 10_000
