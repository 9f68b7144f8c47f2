"""Many linkages in one call: every way ends where the equation in one coordinate does; sentences follow the rows."""

import numpy as np
import pandas as pd
import pytest

from references.equations.many_at_once import by_diffrax, by_heyoka
from references.paper.four_bar_minimal import MinimalFourBar
from studies.bench.render import render
from studies.sweep_linkages import many_runs
from studies.sweep_linkages.many_runs import DIFFRAX, HEYOKA, SINGLE, SWEEP, TOLERANCES
from studies.sweep_linkages.study import drawn, linkage
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


def rows(error=lambda way, tol: tol, **seconds):
    """Five equal repetitions at all tolerances; a run takes `seconds` at the loosest and twice as long at each next."""
    made = [
        {"group": many_runs.GROUP, "way": way, "tol": tol, "repeat": repeat, "n_runs": 4, "first_s": 1.0, "n_failed": 0}
        | {"run_s": run_s * 2.0**k, "error_median": 0.1 * tol, "error_worst": error(way, tol)}
        for way, run_s in seconds.items()
        for k, tol in enumerate(TOLERANCES)
        for repeat in range(5)
    ]
    return pd.DataFrame(made)


def said(times, **more):
    from studies.sweep_linkages import study

    found = study.findings_of(pd.concat([made_up(), rows(**times, **more)], ignore_index=True))
    return render("sweep_linkages", found, {"scaling": "", "many": ""}, stamp="stamp", quick=False)


def test_sentences_follow_the_rows():
    text = said({SWEEP: 0.02, SINGLE: 0.01, HEYOKA: 0.0005})
    assert f"For a largest error of 1e-6 {HEYOKA} takes least: {SINGLE} takes 20 times as long a run." in text
    assert "`twoloop.sweep` takes 2.0 to 2.0 times as long a run as `solve_dae` in a loop" in text
    text = said({SWEEP: 0.02, SINGLE: 0.01, HEYOKA: 0.5})
    assert f"For a largest error of 1e-6 ours takes least: {HEYOKA} takes 50 times as long a run as {SINGLE}." in text
    assert "are not told apart" in said({SINGLE: 0.01, SWEEP: 0.02, HEYOKA: 0.0102})
    assert "Beside rivals" not in said({HEYOKA: 0.5})


def test_ways_are_compared_at_equal_error_and_not_at_equal_tolerance():
    """At each tolerance heyoka takes less, for each error more: it is a thousand times less accurate."""
    found = many_runs.findings_of(
        rows(lambda way, tol: 1e3 * tol if way == HEYOKA else tol, **{SWEEP: 0.02, HEYOKA: 0.01})
    )
    at = {line["error"]: line for line in found["at"]}
    assert at[1e-6]["verdict"] == "ahead" and at[1e-6]["ratio"] == pytest.approx(4.0, rel=1e-6)


def test_a_way_with_failed_runs_is_not_the_cheapest():
    table = rows(**{SWEEP: 0.02, HEYOKA: 0.0005})
    table.loc[table["way"] == HEYOKA, "n_failed"] = 1
    assert {line["verdict"] for line in many_runs.findings_of(table)["at"]} == {"alone"}


def test_calls_after_the_first_are_repeated_in_turn():
    made = list(many_runs.rows_of(linkage, GIVEN[:2], 0.1, (SWEEP, SINGLE), False))
    order = [(row["tol"], row["repeat"], row["way"]) for row in made]
    assert order == [(tol, k, way) for tol in TOLERANCES for k in range(5) for way in (SWEEP, SINGLE)]
    assert all(row["n_failed"] == 0 and row["error_worst"] < 1e-2 for row in made)


def test_a_package_that_is_not_there_is_a_row(monkeypatch):
    def missing(*arguments):
        raise ImportError("No module named 'heyoka'")

    monkeypatch.setattr(many_runs, "by_heyoka", missing)
    (row,) = many_runs.rows_of(linkage, GIVEN[:1], T_END, (HEYOKA,), True)
    assert row["way"] == HEYOKA and "not installed" in row["message"]
