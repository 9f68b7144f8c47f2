"""Many runs in one call: every way ends where the equation in one coordinate does; sentences follow the rows."""

import numpy as np
import pandas as pd
import pytest

from references.equations.many_at_once import by_diffrax, by_heyoka
from studies import ensembles
from studies.bench.cli import StudyError
from studies.ensembles import CVODE, CYRK, DIFFRAX, ENSEMBLE, ERRORS, HEYOKA, PROPAGATE, SINGLE, TOLERANCES
from tests.studies.of_study import said
from twoloop.mechanisms import double_pendulum

T_END = 1.0
PACKAGES = {HEYOKA: "heyoka", PROPAGATE: "heyoka", CYRK: "CyRK", CVODE: "sksundae", DIFFRAX: "diffrax"}


@pytest.fixture(scope="module")
def few():
    return ensembles.linkages_of(9, T_END)  # not a multiple of the width of a vector


@pytest.mark.parametrize(
    "name",
    [
        *(ENSEMBLE, SINGLE, HEYOKA, PROPAGATE),
        *(pytest.param(each, marks=pytest.mark.slow) for each in (CYRK, CVODE, DIFFRAX)),
    ],
)  # CyRK and CVODE compile for each linkage, diffrax for ten seconds
def test_every_way_ends_where_each_linkage_does(name, few, monkeypatch):
    if name in PACKAGES:
        pytest.importorskip(PACKAGES[name])
    monkeypatch.setattr(ensembles, "N_SINGLE", 99)
    solve = ensembles.ways(few)[name]()
    for _ in range(2):  # nothing is left of the call before
        np.testing.assert_allclose(solve(1e-9), few.true, rtol=0.0, atol=1e-6 if name != CVODE else 1e-4)


@pytest.mark.slow
def test_other_mechanisms_are_refused(few):
    for make, package in ((by_heyoka, "heyoka"), (by_diffrax, "diffrax")):
        pytest.importorskip(package)
        with pytest.raises(ValueError, match=r"must have the callbacks of the first.*given 'double pendulum'"):
            make([few.problems[0], double_pendulum()], T_END)


def test_runs_that_differ_by_their_starts_have_ends_that_two_methods_agree_on(monkeypatch):
    made = ensembles.of_starts("andrews", 3, 0.01)
    np.testing.assert_allclose(ensembles.in_lanes(made.problems, 0.01)(1e-9), made.true, rtol=0.0, atol=1e-6)
    assert np.ptp(made.true, axis=0).max() > 1e-3
    monkeypatch.setattr(ensembles, "AGREE", 0.0)
    with pytest.raises(StudyError, match=r"by DOP853 and by Taylor are .* apart"):
        ensembles.of_starts("andrews", 2, 0.01)


def rows(error=lambda way, tol: tol, **seconds):
    """Five equal repetitions at each tolerance. `seconds`: of a loosest run; each tighter tolerance doubles them."""
    head = {"group": ensembles.GROUP, "case": "linkages", "n_runs": 4, "t_end": 6.0, "n_failed": 0}
    made = [
        head
        | {"way": way, "tol": tol, "repeat": repeat}
        | {"run_s": run_s * 2.0**k, "error_median": 0.1 * tol, "error_worst": error(way, tol)}
        for way, run_s in seconds.items()
        for k, tol in enumerate(TOLERANCES)
        for repeat in range(5)
    ]
    whole = {"group": ensembles.VARIED, "n_runs": 1e6, "n_threads": 2, "wall": 30.0, "cpu": 1.0, "n_failed": 0}
    drawn = {"group": ensembles.DRAWN, "n_runs": 99, "n_assembled": 90, "wall": 1.0, "n_failed": 0}
    drawn |= {name: 1e-6 for name in ("energy_median", "energy_error", "end_error_hard", "end_error_any")}
    return pd.DataFrame([*made, whole | {"n_singly": 1}, drawn | {"n_singly": 0}])


def test_the_answer_follows_the_rows():
    found, text = said(ensembles, rows(**{ENSEMBLE: 0.01, SINGLE: 0.1, HEYOKA: 0.05}))
    n = len(ERRORS)
    assert (found["compared"], found["ahead"], found["ratios"]) == (n, n, [pytest.approx(5.0)] * 2)
    assert found["million"] == {
        **{"n_runs": 1e6, "n_threads": 2.0, "wall": 30.0, "cpu": 1.0, "n_failed": 0.0, "n_singly": 1.0, "t_end": 6.0}
    }
    assert found["answer"].startswith("A million four-bar linkages over 6 s take 30 s on 2 cores; at equal error the f")
    assert f"**Answer**: {found['answer']}" in text and len(found["answer"].split()) <= 30 and "is faster" not in text
    found, text = said(ensembles, rows(**{ENSEMBLE: 0.1, SINGLE: 0.01, HEYOKA: 0.05, CYRK: 0.07}))
    assert found["ahead"] == 0 and len(found["not_ahead"]) == n and "heyoka, batches is faster on linkages at" in text


def test_ways_are_compared_at_equal_error_and_not_at_equal_tolerance():
    """At each tolerance heyoka takes less, for each error more: it is a thousand times less accurate."""
    found = ensembles.findings_of(
        rows(lambda way, tol: 1e3 * tol if way == HEYOKA else tol, **{ENSEMBLE: 0.02, HEYOKA: 0.01})
    )
    at = {line["error"]: line for line in found["cases"][0]["at"]}
    assert at[1e-6]["verdict"] == "ahead" and at[1e-6]["ratio"] == pytest.approx(8.0)  # no line between orders


def test_a_way_with_failed_runs_is_not_the_cheapest():
    table = rows(**{ENSEMBLE: 0.02, HEYOKA: 0.0005})
    table.loc[table["way"] == HEYOKA, "n_failed"] = 1
    found, text = said(ensembles, table)
    assert found["compared"] == 0 and found["ratios"] is None and "only `ensemble` reaches 1e-8" in text


def test_calls_after_the_first_are_repeated_in_turn(monkeypatch):
    monkeypatch.setattr(ensembles, "TOLERANCES", (1e-4, 1e-6))
    monkeypatch.setattr(ensembles, "BETWEEN", (1e-5,))
    made = list(ensembles.rows_of(ensembles.linkages_of(2, 0.1), (ENSEMBLE, SINGLE), False))
    order = [(row["tol"], row["repeat"], row["way"]) for row in made]
    asked = {1e-4: (ENSEMBLE, SINGLE), 1e-5: (ENSEMBLE,), 1e-6: (ENSEMBLE, SINGLE)}
    assert order == [(tol, k, way) for tol, ways in asked.items() for k in range(5) for way in ways]
    assert all(row["n_failed"] == 0 and row["error_worst"] < 1e-2 for row in made)


def test_a_package_that_is_not_there_is_a_row(monkeypatch, few):
    def missing(*arguments):
        raise RuntimeError("heyoka is not installed: make peers")

    monkeypatch.setattr(ensembles, "by_heyoka", missing)
    (row,) = ensembles.rows_of(few, (HEYOKA,), True)
    assert row["way"] == HEYOKA and "not installed" in row["message"]


def test_linkages_are_put_together_and_run():
    row = ensembles.varied_row(20, block=12)
    assert row["n_runs"] == 20 and row["n_failed"] == 0 and row["wall"] > 0.0


def test_draws_are_always_the_same_and_within_their_ranges():
    one, more = ensembles.drawn(5), ensembles.drawn(9)
    assert one == more[:5] and {each["branch"] for each in more} == {-1, 1}
    assert all(low <= each[name] <= high for each in more for name, (low, high) in ensembles.RANGES.items())


def test_linkages_by_the_hundred_are_assembled_as_one_is():
    given, q0 = ensembles.assembled(60)
    assert len(given) == len(q0) < 60 and (given[:15] == ensembles.assembled(20)[0][:15]).all()
    made = [ensembles.linkage(*each[:5], int(each[5])).q0 for each in given]
    assert np.abs(made - q0).max() < 1e-14


@pytest.mark.slow
def test_the_quick_run(tmp_path):
    ensembles.STUDY.main(["--quick", "--out", str(tmp_path)])
    text = (tmp_path / "ensembles.md").read_text()
    assert "Quick run" in text and "|twoloop, ensemble|" in text and (tmp_path / "ensembles.png").is_file()
