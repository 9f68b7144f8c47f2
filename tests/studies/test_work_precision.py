"""The comparison of all mechanisms: what the default costs, a quick run."""

import pandas as pd
import pytest

from studies.bench import cases
from studies.bench.solvers import IDA_C_BANDED as BANDED
from studies.bench.solvers import IDA_C_ORDER_2 as DENSE
from studies.bench.solvers import RIVALS
from studies.work_precision import study as work_precision


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


def test_banded_matrices_are_compared_at_the_same_tolerances():
    times = {(BANDED, 1e-2): 3.0, (DENSE, 1e-2): 2.0, (BANDED, 1e-4): 1.0, (DENSE, 1e-4): 2.0, (DENSE, 1e-6): 9.0}
    rows = pd.DataFrame([{"case": "b", "solver": s, "tol": tol, "call_s": t} for (s, tol), t in times.items()])
    assert work_precision.banded_over_dense(rows) == {"n": 2, "least": 0.5, "median": 1.0, "most": 1.5}
    assert work_precision.banded_over_dense(rows[rows["solver"] == DENSE]) is None
