"""Numbers, tables and templates."""

import jinja2
import numpy as np
import pytest

from studies.bench import render
from studies.bench.render import listed, number, percent, power, table

NUMBERS = [(0.0123, "0.012"), (0.5, "0.50"), (3.44, "3.4"), (123.4, "120"), (1234, "1234"), (123456, "1.2e5")]
NUMBERS += [(2.44e-5, "2.4e-5"), (2e-5, "2e-5"), (-2.44e-5, "−2.4e-5"), (-3.0, "−3.0"), (9.99e-4, "1e-3"), (0, "0")]
NUMBERS += [(0.0, "0"), (None, "–"), (float("nan"), "–"), (np.float64("nan"), "–"), (np.int64(12), "12")]


@pytest.mark.parametrize(("value", "text"), [*NUMBERS, (float("inf"), "∞")])
def test_numbers_have_two_digits_and_one_exponent_style(value, text):
    assert number(value) == text


def test_other_styles():
    assert number(3.4449, 3) == "3.44" and power(1e-9) == "1e-9" and power(0.01) == "1e-2" and percent(0.123) == "12 %"
    assert [listed(words) for words in ([], ["a"], ["a", "b"], ["a", "b", "c"])] == [
        "none",
        "a",
        "a and b",
        "a, b and c",
    ]


def test_a_table_wants_rows_of_its_width():
    assert table(["a", "b"], [["x|y", 0.5]]) == "| a | b |\n|---|--:|\n| x\\|y | 0.50 |"
    with pytest.raises(ValueError, match="1 cells under 2"):
        table(["a", "b"], [["x"]])


def test_a_template_that_uses_what_is_not_there_fails(tmp_path, monkeypatch):
    monkeypatch.setattr(render, "TEMPLATES", tmp_path)
    (tmp_path / "x.md.j2").write_text("{% if f.a %}\n{{ f.a|num }}\n{% endif %}\n\n\n\n{{ stamp }}\n")
    assert render.render("x", {"a": 0.5}, {}, stamp="s") == "0.50\n\ns\n"
    (tmp_path / "x.md.j2").write_text("a | b\n| {{ f.a }} | max(\\|q\\|, 1) |\n")
    assert render.render("x", {"a": "b c"}, {}) == "a | b\n|b c|max(\\|q\\|, 1)|\n"  # rows of tables alone
    with pytest.raises(jinja2.UndefinedError, match="a"):
        render.render("x", {}, {}, stamp="s")
