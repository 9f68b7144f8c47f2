"""Many linkages in one call: every way ends where the equation in one coordinate does; sentences follow the rows."""

import numpy as np
import pandas as pd
import pytest

from references.four_bar_minimal import MinimalFourBar
from references.many_at_once import by_diffrax, by_heyoka
from studies import many_runs
from studies.many_runs import DIFFRAX, HEYOKA, SINGLE, SWEEP, TOLERANCES
from studies.render import render
from studies.sweep_linkages import drawn, linkage
from tests.studies.test_sweep_linkages import made_up  # type: ignore[import-not-found, unused-ignore]
from twoloop.mechanisms import double_pendulum

T_END = 1.0
GIVEN = many_runs.assembled(linkage, drawn(40), 9)  # not a multiple of the width of a vector
PROBLEMS = [linkage(**one) for one in GIVEN]
PACKAGES = {HEYOKA: "heyoka", DIFFRAX: "diffrax"}


@pytest.fixture(scope="module")
def true():
    known = [MinimalFourBar.from_parameters(problem.parameters) for problem in PROBLEMS]
    return np.array([each.states(np.array([T_END]))[0][:, 0] for each in known])


@pytest.mark.parametrize(
    "name", [SWEEP, SINGLE, HEYOKA, pytest.param(DIFFRAX, marks=pytest.mark.slow)]
)  # the last compiles for ten seconds
def test_every_way_ends_where_each_linkage_does(name, true):
    if name in PACKAGES:
        pytest.importorskip(PACKAGES[name])
    solve = many_runs.ways(linkage, GIVEN, T_END)[name]()
    for _ in range(2):  # nothing is left of the call before
        np.testing.assert_allclose(solve(1e-9), true, rtol=0.0, atol=1e-6)


def test_other_mechanisms_are_refused():
    for make, package in ((by_heyoka, "heyoka"), (by_diffrax, "diffrax")):
        pytest.importorskip(package)
        with pytest.raises(ValueError, match=r"must have the callbacks of the first.*given 'double pendulum'"):
            make([PROBLEMS[0], double_pendulum()], T_END)


def rows(**seconds):
    made = [
        {"group": many_runs.GROUP, "way": way, "tol": tol, "n_runs": 4, "run_s": run_s, "first_s": 1.0, "n_failed": 0}
        for way, run_s in seconds.items()
        for tol in TOLERANCES
    ]
    return pd.DataFrame(made).assign(error_median=1e-9, error_worst=1e-8)


def said(times):
    from studies import sweep_linkages as study

    found = study.findings_of(pd.concat([made_up(), rows(**times)], ignore_index=True))
    return render("sweep_linkages", found, {"scaling": "", "many": ""}, stamp="stamp", quick=False)


def test_sentences_follow_the_rows():
    assert "a run by heyoka, batches takes 40 times less" in said({SWEEP: 0.02, SINGLE: 0.01, HEYOKA: 0.0005})
    assert "nothing takes less time a run than ours" in said({SWEEP: 0.02, SINGLE: 0.01, HEYOKA: 0.5})
    assert "Beside rivals" not in said({HEYOKA: 0.5})


def test_a_way_with_failed_runs_is_not_the_cheapest():
    table = rows(**{SWEEP: 0.02, HEYOKA: 0.0005})
    table.loc[table["way"] == HEYOKA, "n_failed"] = 1
    assert many_runs.findings_of(table)["best"] == SWEEP


def test_a_package_that_is_not_there_is_a_row(monkeypatch):
    def missing(*arguments):
        raise ImportError("No module named 'heyoka'")

    monkeypatch.setattr(many_runs, "by_heyoka", missing)
    (row,) = many_runs.rows_of(linkage, GIVEN[:1], T_END, (HEYOKA,))
    assert row["way"] == HEYOKA and "not installed" in row["message"]
