"""Many runs in one call: every way ends where the equation in one coordinate does; sentences follow the rows."""

import ctypes
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
from matplotlib import pyplot as plt

from references.equations.many_at_once import by_diffrax, by_heyoka
from studies.bench import takes
from studies.bench.cli import StudyError, processor
from studies.ensembles import operations
from studies.ensembles import study as ensembles
from studies.ensembles.study import CVODE, CYRK, DIFFRAX, ENSEMBLE, ERRORS, HEYOKA, PROPAGATE, SINGLE, TOLERANCES
from tests.studies.of_study import said
from twoloop.mechanisms import double_pendulum

T_END = 1.0
PACKAGES = {HEYOKA: "heyoka", PROPAGATE: "heyoka", CYRK: "CyRK", CVODE: "sksundae", DIFFRAX: "diffrax"}


@pytest.fixture(scope="module")
def few():
    return ensembles.linkages(9, T_END)  # not a multiple of the width of a vector


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
    head = {"group": ensembles.GROUP, "case": "linkages", "n_runs": 4, "t_end": 6.0, "first_s": 1.0, "n_failed": 0}
    made = [
        head
        | {"way": way, "tol": tol, "repeat": repeat}
        | {"run_s": run_s * 2.0**k, "error_median": 0.1 * tol, "error_worst": error(way, tol)}
        for way, run_s in seconds.items()
        for k, tol in enumerate(TOLERANCES)
        for repeat in range(5)
    ]
    whole = {"group": ensembles.GEOMETRY, "n_runs": 10_000, "wall": 0.5, "cpu": 1.0, "n_failed": 0, "n_singly": 1}
    return pd.DataFrame([*made, whole])


def test_sentences_follow_the_rows():
    n = len(ERRORS)
    _, text = said(ensembles, rows(**{ENSEMBLE: 0.01, SINGLE: 0.1, HEYOKA: 0.05}))
    assert (
        f"`twoloop.ensemble` is ahead of the fastest of heyoka's batches in {n}, behind in 0 and undecided in 0 of {n} "
        "pairs of mechanism and error. The fastest rival takes 5.0 to 5.0 times as long." in text
    )
    assert "ahead on" not in text
    _, text = said(ensembles, rows(**{ENSEMBLE: 0.1, SINGLE: 0.01, HEYOKA: 0.05, CYRK: 0.07}))
    assert f"heyoka's batches and CyRK one run at a time in 0, behind in {n} and undecided in 0 of {n}" in text
    assert "`heyoka, batches` is ahead on" in text and "1 of the 1 mechanisms, at errors of 1e-4, 1e-6 and 1e-8" in text
    assert "with 0.50 of the time." in text and "10,000 four-bar linkages" in text and "none failed" in text


def test_ways_are_compared_at_equal_error_and_not_at_equal_tolerance():
    """At each tolerance heyoka takes less, for each error more: it is a thousand times less accurate."""
    found = ensembles.findings_of(
        rows(lambda way, tol: 1e3 * tol if way == HEYOKA else tol, **{ENSEMBLE: 0.02, HEYOKA: 0.01})
    )
    at = {line["error"]: line for line in found["cases"][0]["at"]}
    assert at[1e-6]["verdict"] == "ahead" and at[1e-6]["ratio"] == pytest.approx(8.0)  # no line between orders


def test_the_first_screen_says_who_is_the_cheapest():
    ahead, behind = "`ensemble` (ahead of all that ran", "`heyoka, batches` (ahead of `ensemble`"
    for times, way in (({ENSEMBLE: 0.01, HEYOKA: 0.05}, ahead), ({ENSEMBLE: 0.05, HEYOKA: 0.01}, behind)):
        (line,) = takes.takes({"ensembles": ensembles.findings_of(rows(**times))}, [])
        assert line == {
            "what": "many runs in one call",
            "take": f"{way} in 3, behind in 0 of 3 comparisons); {takes.NO_ANGLES}",
        }


def test_a_way_with_failed_runs_is_not_the_cheapest():
    table = rows(**{ENSEMBLE: 0.02, HEYOKA: 0.0005})
    table.loc[table["way"] == HEYOKA, "n_failed"] = 1
    assert {line["verdict"] for line in ensembles.findings_of(table)["cases"][0]["at"]} == {"alone"}


def test_calls_after_the_first_are_repeated_in_turn(monkeypatch):
    monkeypatch.setattr(ensembles, "TOLERANCES", (1e-4, 1e-6))
    monkeypatch.setattr(ensembles, "BETWEEN", (1e-5,))
    made = list(ensembles.rows_of(ensembles.linkages(2, 0.1), (ENSEMBLE, SINGLE), False))
    order = [(row["tol"], row["repeat"], row["way"]) for row in made]
    asked = {1e-4: (ENSEMBLE, SINGLE), 1e-5: (ENSEMBLE,), 1e-6: (ENSEMBLE, SINGLE)}
    assert order == [(tol, k, way) for tol, ways in asked.items() for k in range(5) for way in ways]
    assert all(row["n_failed"] == 0 and row["error_worst"] < 1e-2 for row in made)


def test_a_package_that_is_not_there_is_a_row(monkeypatch, few):
    def missing(*arguments):
        raise ImportError("No module named 'heyoka'")

    monkeypatch.setattr(ensembles, "by_heyoka", missing)
    (row,) = ensembles.rows_of(few, (HEYOKA,), True)
    assert row["way"] == HEYOKA and "not installed" in row["message"]


def test_rows_have_their_processor(monkeypatch):
    made = rows(**{ENSEMBLE: 0.01, HEYOKA: 0.05}).to_dict("records")
    monkeypatch.setattr(ensembles, "rows_of", lambda of, names, quick: made[:-1])
    monkeypatch.setattr(ensembles, "on_threads", lambda n, quick: [])
    monkeypatch.setattr(ensembles.lanes, "rows", lambda n, quick: [])
    monkeypatch.setattr(ensembles, "with_geometry", lambda n: made[-1])
    table = ensembles.make(SimpleNamespace(call=SimpleNamespace(quick=True)))
    assert (table["processor"] == processor()).all()
    assert ensembles.findings_of(table) == ensembles.findings_of(table.drop(columns="processor"))  # as rows of old


def test_lines_have_a_gap_where_nothing_was_run():
    made = rows(**{ENSEMBLE: 0.01, HEYOKA: 0.05})
    between = (made["way"] == HEYOKA) & made["tol"].isin((1e-6, 1e-7))
    made = made[~between].assign(error_worst=made["error_worst"] * 0.99)
    figure = ensembles.figures_of(made, ensembles.findings_of(made))["ensembles"]
    lines = {line.get_label(): np.asarray(line.get_xdata(), dtype=float) for line in figure.axes[0].lines}
    plt.close(figure)
    tight = [tol for tol in TOLERANCES if 0.99 * tol > 0.1 * ensembles.AGREE]  # the others are below the reference
    assert len(lines["ensemble"]) == len(TOLERANCES) and np.isfinite(lines["ensemble"]).sum() == len(tight)
    x = lines[HEYOKA]
    gap = int(np.flatnonzero(np.isnan(x))[0])
    assert x[gap - 1] == pytest.approx(0.99e-5) and x[gap + 1] == pytest.approx(0.99e-8)


def test_scaling_follows_the_rows():
    table = rows(**{ENSEMBLE: 0.01, HEYOKA: 0.05})
    threads = [
        {"group": ensembles.THREADS, "n_runs": 10, "n_threads": n, "repeat": k, "wall": wall * (1.0 + 0.1 * k)}
        for n, wall in ((1, 0.9), (2, 0.5))
        for k in range(3)
    ]
    of_lanes = [
        {"group": "lanes", "n_runs": 10, "n_lanes": 4, "message": "no compiler"},
        {"group": "lanes", "n_runs": 10, "n_lanes": 8, "run_s": 1e-4, "operations": 1e6, "most": 4e10},
    ]
    found, text = said(ensembles, pd.concat([table, pd.DataFrame([*threads, *of_lanes])], ignore_index=True))
    assert [round(each["gain"], 6) for each in found["threads"]] == [1.0, 1.8]
    assert found["lanes"][0] == {"n": 4, "message": "no compiler"}
    assert found["lanes"][1]["share"] == pytest.approx(0.25)
    assert "25 %" in text and "no compiler" in text and "1.8" in text


def test_threads_and_lanes_are_measured():
    made = list(ensembles.on_threads(300, True))
    assert [row["n_threads"] for row in made] == list(range(1, len(made) + 1)) and all(row["wall"] > 0 for row in made)
    (row,) = ensembles.lanes.rows(9, True)
    assert row["run_s"] > 0.0 and 1e5 < row["operations"] < 1e8 and row["operations"] < row["most"] * row["run_s"]


def test_operations_are_counted_block_by_block():
    """A loop of three operations on two numbers, of which one is fused: four on each, and one before it."""
    fma = "@llvm.fma.v2f64"
    text = f"""declare <2 x double> {fma}(<2 x double>, <2 x double>, <2 x double>)
define void @looped(i64 %n, double* %x) noinline {{
b0:
 %0 = bitcast double* %x to <2 x double>*
 %1 = load <2 x double>, <2 x double>* %0, align 8
 %2 = fmul contract <2 x double> %1, %1
 br label %b1
b1:
 %3 = phi i64 [0, %b0], [%5, %b1]
 %4 = phi <2 x double> [%2, %b0], [%8, %b1]
 %5 = add i64 %3, 1
 %6 = fsub <2 x double> %4, %1
 %7 = fdiv <2 x double> %6, %1
 %8 = call <2 x double> {fma}(<2 x double> %7, <2 x double> %1, <2 x double> %1)
 %9 = icmp slt i64 %5, %n
 br i1 %9, label %b1, label %b2
b2:
 store <2 x double> %8, <2 x double>* %0, align 8
 ret void
}}
"""
    made = operations.compiled(["looped", operations.COUNT], operations.counting(text))
    count, x = operations.count_of(made), np.array([1.0, 2.0])
    call = ctypes.CFUNCTYPE(None, ctypes.c_int64, ctypes.c_void_p)(made.addresses["looped"])
    for n in (1, 5):
        before = count()
        call(n, x.ctypes.data)
        assert count() - before == 2 + 8 * n


def test_linkages_are_put_together_and_run():
    row = ensembles.with_geometry(20)
    assert row["n_runs"] == 20 and row["n_failed"] == 0 and row["wall"] > 0.0
