"""The comparison of all mechanisms: what is dominated, what the default costs, a quick run."""

import pandas as pd
import pytest

from studies.bench import cases
from studies.bench.solvers import RIVALS
from studies.work_precision import study as work_precision
from tests.studies.test_tables import rows


def made(*lines):
    return rows(*lines).assign(case="crane", astray=False)


def test_dominated_is_who_costs_more_at_every_error_on_every_case():
    table = made(("a", 1e-3, 1.0), ("b", 1e-3, 3.0), ("c", 1e-5, 9.0)).assign(tol=0.1)
    found = {line["solver"]: (line["by"], line["factor"]) for line in work_precision.dominated(table, (1e-2,))}
    assert found == {"b": ("a", pytest.approx(3.0)), "c": ("a", pytest.approx(9.0))}
    worst = work_precision.dominated(table, (1e-2,))[0]
    assert (worst["case"], worst["error"], worst["call_s"], worst["by_s"]) == ("crane", 1e-2, 3.0, 1.0)
    both = work_precision.dominated(table, (1e-2, 1e-4))
    assert [line["solver"] for line in both] == ["b"]  # c alone reaches 1e-4
    other = pd.concat([table, made(("a", 1e-3, 5.0), ("b", 1e-3, 4.0)).assign(case="robot")])
    assert "b" not in [line["solver"] for line in work_precision.dominated(other, (1e-2,))]


def test_the_default_is_judged_by_the_rows():
    table = made(("auto", 1e-5, 4.0), ("Gauss12", 1e-5, 1.0))
    assert work_precision.class_of(table, 1e-4)["default_over"] == pytest.approx(4.0)
    table.loc[1, "call_s"] = 8.0
    assert work_precision.class_of(table, 1e-4)["default_over"] == pytest.approx(1.0)
    nothing = work_precision.class_of(table, 1e-9)
    assert nothing["error"] == 1e-9 and all(nothing[key] is None for key in ("ours", "others", "ida", "default_over"))


def test_what_beats_the_default_beats_it_at_every_error_that_it_reaches():
    table = made(("auto", 1e-5, 4.0), ("Gauss12", 1e-5, 1.0), ("BDF", 1e-3, 0.5), ("LSODA", 1e-5, 2.0))
    table.loc[3, "family"] = "SciPy"
    at = [work_precision.class_of(table, error) for error in (1e-2, 1e-4, 1e-9)]
    assert work_precision.before_default(at, "ours") == ["Gauss12"]  # BDF does not reach 1e-4
    assert work_precision.before_default(at, "others") == ["LSODA"]
    assert work_precision.before_default(at[2:], "ours") == []


def test_of_each_solver_out_of_phase_the_finest_setting_is_found():
    table = made(("a", 0.5, 1.0), ("a", 0.3, 2.0), ("b", 1e-3, 1.0)).assign(tol=[1e-2, 1e-3, 1e-3], h=float("nan"))
    table["astray"] = [True, True, False]
    found = {"solver": "a", "setting": "tol", "value": 1e-3, "error_q": 0.3, "call_s": 2.0}
    assert work_precision.out_of_phase(table) == [found]


def test_cases_are_found_by_listing_the_folder():
    quick, full = cases.load(True), cases.load(False)
    assert {"four-bar", "four-bar, second"} <= {case.name for case in full}
    assert len({case.name for case in full}) == len(full)
    assert all(a.t_end <= b.t_end for a, b in zip(quick, full, strict=True))


def test_the_same_rivals_run_on_every_case_and_stiff_ones_have_solvers_of_their_own():
    for case in cases.load(False):
        made = work_precision.runs(case, False)
        names = {run.solver.name for run in made}
        assert names >= {*RIVALS, "auto", "auto, compiled"}
        assert (names >= set(work_precision.STIFF)) == ("stiff" in case.tags)
        assert len({run.key(0) for run in made}) == len(made) and {run.repeats for run in made} == {5}


@pytest.mark.slow
def test_the_quick_study_runs_and_is_drawn_again(tmp_path):
    words = ["--quick", "--out", str(tmp_path)]
    work_precision.main(words)
    text = (tmp_path / "work_precision.md").read_text()
    assert "Quick run" in text and (tmp_path / "work_precision_four_bar.png").exists()
    assert "four-bar" in (tmp_path / "README.md").read_text()
    work_precision.main([*words, "--redraw"])
    assert (tmp_path / "work_precision.md").read_text() == text
