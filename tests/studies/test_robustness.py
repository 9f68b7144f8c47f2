"""The robustness study: its truth, its rule, its sentences, and short and long forms of its runs."""

from dataclasses import replace
from functools import partial

import numpy as np
import pandas as pd
import pytest

from references.paper.four_bar_minimal import MinimalFourBar
from studies.bench.apart import apart
from studies.bench.random_linkages import GRASHOF, KINDS, NEAR, draw, end_of, end_of_scaled, four_lengths, scaled
from studies.robustness import study as robustness
from studies.robustness.sharp_runs import within_thousand
from tests.studies.of_study import said
from twoloop.mechanisms import four_bar


@pytest.fixture(scope="module")
def drawn():
    generator, found = np.random.default_rng(3), {}
    for kind in KINDS:
        while kind not in found:
            if (one := draw(kind, generator, 1.0)) is not None:
                found[kind] = one
    return found


def excess(s):
    s = np.sort(s)
    return s[1] + s[2] - s[0] - s[3]


def test_kinds_of_lengths():
    generator = np.random.default_rng(1)
    for kind in KINDS:
        for _ in range(20):
            got = excess(four_lengths(kind, generator))
            assert abs(got) < 0.0101 if kind == NEAR else (got > 0.0) == (kind == GRASHOF)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("method", ["SunRadau5", "DOP853", "BDF"])
def test_random_linkages_are_right(drawn, kind, method):
    one = drawn[kind]
    allowed = robustness.LOOSENESS * robustness.TOLERANCE * max(1.0, one.sensitivity)
    row = robustness.measured(one.problem, method, 1.0, one.q, np.ones(9), allowed)
    assert row["outcome"] == robustness.RIGHT, row


def test_the_other_assembly_is_wrong_and_silent(drawn):
    one = drawn[NEAR]
    p = one.problem.parameters
    other = four_bar((p["L1"], p["L2"], p["L3"]), p["L"], p["theta3"], -p["branch"])
    row = robustness.measured(other, "DOP853", 1.0, one.q, np.ones(9), 1e-5)
    assert row["outcome"] == robustness.SILENT


def test_what_is_refused_is_said():
    problem = four_bar()
    row = robustness.measured(replace(problem, q0=problem.q0 + 1.0), "BDF", 1.0, problem.q0, np.ones(9), 1e-5)
    assert (row["status"], row["outcome"]) == ("RAISED", robustness.SAID) and "q0 is not consistent" in row["message"]


@pytest.mark.parametrize("size", [1e-6, 1e3])
@pytest.mark.parametrize("density", [1e-5, 1e5])
def test_sizes_and_masses(size, density):
    problem, t_end = scaled(size, (density,) * 3), 0.5 * np.sqrt(size)
    unit = np.where(np.arange(9) % 3 == 2, 1.0, size)
    truth = end_of_scaled(size, (1.0,) * 3, t_end)
    assert robustness.measured(problem, "DOP853", t_end, truth, unit, 1e-5)["outcome"] == robustness.RIGHT


def test_the_minimal_coordinate_takes_a_density_for_each_bar():
    problem, one = four_bar(), end_of(four_bar(), 0.3)
    bars = tuple(problem.parameters[name] for name in ("L1", "L2", "L3"))
    rest = (problem.parameters["L"], 0.0, -1)
    same = MinimalFourBar(bars, *rest, (1.0, 1.0, 1.0), 9.81).states([0.3])[0][:, 0]
    heavy = MinimalFourBar(bars, *rest, (1.0, 5.0, 1.0), 9.81).states([0.3])[0][:, 0]
    assert np.abs(same - one).max() < 1e-12 and np.abs(heavy - one).max() > 1e-4
    with pytest.raises(ValueError, match="density must be positive"):
        MinimalFourBar(bars, *rest, (1.0, -5.0, 1.0), 9.81)


def check_long(row, n_steps):
    assert row["status"] == "REACHED_END" and row["n_steps"] >= n_steps
    for level in "qv":
        assert row[f"last_{level}"] <= robustness.GROWS * row[f"first_{level}"] < 1e-12


def test_a_run_of_ten_thousand_steps():
    check_long(robustness.long_run("DOP853", 10_000), 10_000)


@pytest.mark.slow
@pytest.mark.parametrize("method", robustness.METHODS)
def test_a_run_of_a_million_steps(method):
    row = apart(partial(robustness.long_run, method, 1_000_000))
    check_long(row, 1_000_000)
    assert row["bytes_a_step"] < 200  # sizes and counts of the steps; a state would take 280


def rows_of(outcome, last=1e-16):
    about = {"status": "REACHED_END", "message": "", "n_redrawn": 1, "sensitivity": 2.0, "allowed": 1e-5}
    lines = [
        {"group": group, "what": group, "value": value, "method": "BDF", "error": 1e-9, "outcome": "right"} | about
        for group in ("linkage", "size", "density", "ratio")
        for value in (1e-6, 1.0, 1e3)
    ]
    lines[0] |= {"outcome": outcome}
    lines[3] |= {"outcome": outcome}
    long = {"group": "long", "what": "long", "method": "BDF", "outcome": "right", "n_steps": 10, "bytes_a_step": 50.0}
    long |= {"first_q": 1e-16, "last_q": last, "first_v": 1e-16, "last_v": 1e-16, "energy": 1e-9}
    sharp = {"group": "sharp", "what": "drag", "name": "pendulum", "method": "auto", "outcome": outcome, "value": 0.0}
    sharp |= {"message": "REACHED_END", "tol": 1e-4, "error": 0.02, "allowed": 0.5}
    return pd.DataFrame([*lines, long | {"value": 1.0}, long | {"value": 10.0}, sharp])


def test_sentences_turn_with_the_rows():
    _, good = said(robustness, rows_of("right"))
    assert "None on the linkages, at any size or mass, is silently wrong." in good
    assert "with all methods together, none of 1 runs is silently wrong. At a tolerance of" in good
    text = "On 1 random mechanisms under sharp forces, each run at one tolerance from 1e-4 to 1e-4, the error of the "
    text += "default is 200 tolerances in the median and 200 at most (0 report failure)"
    assert text + "; no other project's solver was run." in good
    assert "so up to 1e-5 m or rad are allowed." in good
    assert "| error allowed, largest | 0.50 |" in good and "| BDF | 1e-6 … 1e3 | 1e-6 … 1e3 | 1e-6 … 1e3 |" in good
    assert "1 runs that count as right have errors above 1e-2." in good
    assert "All methods are right from 1e-6 to 1e3 m" in good and "The violation does not grow" in good
    _, bad = said(robustness, rows_of(robustness.SILENT, last=1e-12))
    assert "On the linkages, of all sizes and masses, 2 runs are silently wrong:" in bad
    assert "with all methods together, 1 of 1 runs is silently wrong (the default, drag)." in bad
    assert "; 1 is silently wrong by the sensitivity of the motion, at worst with drag: error 0.020 at 1e-4." in bad
    more = pd.concat([rows_of(robustness.SILENT), rows_of(robustness.SILENT).tail(1).assign(error=0.3, value=1.0)])
    _, text = said(robustness, more.reset_index(drop=True))
    assert "at most (0 report failure, 1 silently exceeds 1000" in text
    assert "; 2 are silently wrong by the sensitivity of the motion, at worst with drag: error 0.30 at 1e-4." in text
    assert (
        "(the default, drag in 2 runs)" in text and "All methods are right from" in bad and "from 1e0 to 1e3 m" in bad
    )
    assert "The violation grows in runs of 10 steps and more with BDF" in bad


def test_the_thousand_tolerances_do_not_grow_with_the_sensitivity():
    made = pd.DataFrame([[1e-6, 9e-4, "right"], [1e-6, 2e-3, "right"], [1e-8, np.nan, robustness.SAID]])
    found = within_thousand(made.set_axis(["tol", "error", "outcome"], axis=1))
    sizes = {"median": pytest.approx(1450.0), "most": pytest.approx(2000.0)}
    assert found == {"tolerances": 1000.0, "n": 3, "within": 1, "failed": 1, "beyond": 1} | sizes
