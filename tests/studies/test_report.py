"""Reports are written from rows, and can be written again from the saved ones."""

import math

import pandas as pd
import pytest

from studies import linkage
from studies.report import load_rows, markdown_table, number, save_rows


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


def test_linkage(tmp_path):
    linkage.main(["--out", str(tmp_path)])
    assert (tmp_path / "linkage.png").stat().st_size > 10_000
