"""Medians, cost at equal error, rankings, from rows made by hand."""

import numpy as np
import pandas as pd
import pytest

from studies.bench import tables
from tests.studies.of_study import median


def rows(*lines, floor=1e-12):
    """Rows of (solver, error, seconds), one repetition each."""
    return pd.DataFrame([median(*line, floor=floor, n_evaluations=1e3 * line[2]) for line in lines])


def test_medians_keep_the_repetition_of_median_error():
    made = rows(("a", 3.0, 1.0), ("a", 1.0, 5.0), ("a", 2.0, 2.0), ("b", 1.0, 9.0)).assign(repeat=[0, 1, 2, 0])
    middle = tables.medians(made)
    assert middle["error_q"].tolist() == [2.0, 1.0] and middle["call_s"].tolist() == [2.0, 9.0]
    assert middle["times"][0] == (1.0, 5.0, 2.0) and middle["repeats"].tolist() == [3, 1]


@pytest.mark.parametrize(("n_failed", "status"), [(1, "REACHED_END"), (2, "STEP_TOO_SMALL")])
def test_a_run_that_mostly_fails_is_shown_as_failed(n_failed, status):
    made = rows(*[("a", 1.0, 1.0)] * 3).assign(repeat=[0, 1, 2])
    made.loc[: n_failed - 1, ["error_q", "status"]] = [np.nan, "STEP_TOO_SMALL"]
    assert tables.medians(made)["status"].tolist() == [status]


def test_cost_at_an_error_lies_on_the_line_between_two_runs():
    made = rows(("a", 1e-2, 1.0), ("a", 1e-3, 4.0))
    assert tables.time_for(made, 10.0**-2.5) == pytest.approx(2.0)
    assert tables.time_for(made, 1e-2) == 1.0 and tables.time_for(made, 1e-3) == 4.0
    assert np.isnan(tables.time_for(made, 1e-4))


def test_nothing_is_interpolated_over_more_than_a_decade_or_between_methods():
    made = rows(("a", 1.1e-2, 1.0), ("a", 1.8e-7, 4.0))
    assert np.isnan(tables.time_for(made, 1e-4))  # no run within a decade: not asked
    assert tables.time_for(made, 1e-6) == 4.0
    near = made.assign(tol=[1e-4, 6e-5])  # asked on both sides: the solver leaps, and its price is that of the leap
    assert tables.time_for(near, 1e-4) == 4.0
    # errors need not fall with the setting: next to the target by error stands a run of quite another setting
    back = rows(("a", 1.1e-2, 1.0), ("a", 1.2e-2, 2.0), ("a", 1.8e-7, 4.0), ("a", 3e-7, 5.0))
    assert tables.time_for(back.assign(tol=[1e-2, 1e-4, 6e-5, 1e-6]), 1e-4) == 4.0
    assert np.isnan(tables.time_for(back.assign(tol=[1e-2, 1e-4, 1e-6, 1e-8]), 1e-4))
    changed = rows(("a", 1e-2, 1.0), ("a", 2e-3, 4.0)).assign(used=["Newton", "explicit"])
    assert tables.time_for(changed, 5e-3) == 4.0 > tables.time_for(changed.assign(used=""), 5e-3)
    assert tables.time_for(changed.assign(used=np.nan), 5e-3) < 4.0  # as a file has it where nothing is chosen
    assert tables.time_for(changed.assign(used="", solver="heyoka"), 5e-3) == 4.0  # whose order the tolerance sets


def test_what_no_looser_setting_makes_cheaper_counts_at_every_error():
    made = rows(("a", 1e-6, 2.0), ("a", 1e-9, 3.0))
    assert np.isnan(tables.time_for(made.assign(tol=[1e-3, 1e-5]), 1e-2))
    assert tables.time_for(made.assign(tol=[1e-1, 1e-3]), 1e-2) == 2.0
    failed = pd.concat([made.assign(tol=[1e-3, 1e-5]), rows(("a", np.nan, 1.0)).assign(tol=1e-2)])
    assert tables.time_for(failed, 1e-2) == 2.0


def test_nothing_is_claimed_below_what_the_reference_resolves():
    made = rows(("a", 1e-2, 1.0), ("a", 1e-9, 4.0), floor=1e-6)
    assert np.isnan(tables.time_for(made, 1e-7)) and tables.time_for(made, 1e-6) == pytest.approx(4.0)


def test_a_ranking_turns_with_the_rows():
    made = rows(("a", 1e-4, 1.0), ("b", 1e-4, 2.0), ("c", 1e-2, 0.1)).assign(tol=[1e-6, 1e-7, 1e-6])
    ranked = tables.ranking(made, 1e-3)
    assert ranked["solver"].tolist() == ["a", "b"] and ranked["setting"].tolist() == ["tol 1e-6", "tol 1e-7"]
    made.loc[0, "call_s"] = 3.0
    assert tables.ranking(made, 1e-3)["solver"].tolist() == ["b", "a"] and tables.ranking(made, 1e-9).empty


def test_a_cell_has_a_time_or_nothing():
    made = rows(("a", 1e-4, 1.0)).assign(tol=1e-5)
    assert tables.work_precision(made, [1e-3, 1e-5]) == [["a", "compiled", "1.0", "–"]]
    nothing = rows(("x", np.nan, np.nan)).assign(status="NOT_APPLICABLE", message="needs a model of its own")
    assert tables.work_precision(nothing, [1e-5])[0][2] == "–"
    assert tables.failures(nothing) == [["x", "all", "not applicable", "needs a model of its own"]]


def repeated(ours, others):
    """Medians of one solver of ours and one other, of these times."""
    made = [
        rows(*((name, 1e-4, time) for time in times)).assign(repeat=range(len(times)), family=family)
        for name, family, times in (("auto", "two-loop", ours), ("heyoka", "heyoka", others))
    ]
    return tables.medians(pd.concat(made, ignore_index=True))


@pytest.mark.parametrize(
    ("ours", "others", "verdict"),
    [
        ([1.0, 1.1, 0.9, 1.0, 1.05], [2.0, 2.2, 1.9, 2.0, 2.1], "ahead"),
        ([2.0, 2.2, 1.9, 2.0, 2.1], [1.0, 1.1, 0.9, 1.0, 1.05], "behind"),
        ([1.0, 3.0, 0.9, 2.0, 1.2], [1.1, 0.8, 2.5, 1.0, 2.9], "undecided"),
        ([1.0] * 5, [1.01] * 5, "undecided"),  # a lead of 1 % is none, however well it repeats
        ([1.01] * 5, [1.0] * 5, "undecided"),
        ([1.0] * 5, [1.06] * 5, "ahead"),
        ([1.06] * 5, [1.0] * 5, "behind"),
        ([1.0], [5.0], "undecided"),  # one repetition decides nothing
        ([1.0, 1.1, 0.9, 1.0, 1.05], [1.0, 1.1, 0.9, 1.0, 1.05], "undecided"),
    ],
)
def test_a_pair_is_decided_where_all_of_the_range_of_the_ratio_is_a_least_effect_from_one(ours, others, verdict):
    costs = tables.costs_at(repeated(ours, others), 1e-3)
    found = tables.compared({"auto": costs["auto"]}, {"heyoka": costs["heyoka"]})
    assert found["verdict"] == verdict and found["ratio"] == pytest.approx(np.median(others) / np.median(ours))
    if len(ours) > 1:
        low, high = found["interval"]
        assert low <= found["ratio"] <= high and (verdict == "undecided") == (
            low <= tables.LEAST and high >= 1.0 / tables.LEAST
        )
    else:
        assert found["interval"] is None
    again = tables.compared({"auto": costs["auto"]}, {"heyoka": costs["heyoka"]})
    assert again == found  # the draws are the same


def test_runs_made_once_as_they_are_far_behind_undo_no_verdict():
    """Of another solver of ours, and of the same one at a finer setting; where the cheapest was run once, they do."""
    times = [1.0, 1.1, 0.9, 1.0, 1.05]
    far = rows(("slow", 1e-4, 30.0), ("auto", 1e-6, 40.0)).assign(times=[(30.0,), (40.0,)])
    for factor, verdict in ((5.0, "ahead"), (0.2, "behind")):
        made = repeated(times, [factor * time for time in times])
        theirs = tables.costs_at(made[made["solver"] == "heyoka"], 1e-3)
        ours = tables.costs_at(pd.concat([made[made["solver"] == "auto"], far], ignore_index=True), 1e-3)
        assert set(ours) == {"auto", "slow"} and tables.compared(ours, theirs)["verdict"] == verdict
    once = made[made["solver"] == "auto"].assign(times=[(1.0,)])
    assert tables.compared(tables.costs_at(once, 1e-3), theirs)["verdict"] == "undecided"


def test_no_solver_is_ahead_of_another_for_want_of_a_run():
    made = rows(("heyoka", 1e-1, 1.0), ("heyoka", 1e-9, 50.0)).assign(tol=[1e-1, 1e-9])
    assert np.isnan(tables.time_for(made, 1e-5))  # nothing is told of its cost there ...
    assert tables.costs_at(made, 1e-5)["heyoka"][0] == 50.0  # ... but what the better run takes
    (time, _) = tables.costs_at(made, 1e-5, doubt=True)["heyoka"]
    assert time == 1.0  # none is ahead of it that takes more than its looser run
    assert tables.costs_at(made, 1e-10, doubt=True) == {}


def test_who_alone_gets_there_and_who_misses_is_told():
    costs = tables.costs_at(repeated([1.0] * 3, [2.0] * 3), 1e-3)
    verdicts = [tables.compared(*pair)["verdict"] for pair in ((costs, {}), ({}, costs), ({}, {}))]
    assert verdicts == ["alone", "missed", "none"]


def test_repetitions_that_timed_something_else_do_not_count():
    times, errors = np.array([1.0, 1.1, 9.0, 1.2, 0.9]), np.full(5, 1e-6)
    assert tables.alike(times, errors).tolist() == [True, True, False, True, True]
    assert tables.alike(times, np.array([1e-6, 1e-6, 1e-6, 2e-5, np.inf])).tolist() == [True] * 5  # too few are left
    stopped = np.array([1e-6, 1e-6, 1e-6, 1e-6, np.inf])
    assert tables.alike(np.ones(5), stopped).tolist() == [True] * 4 + [False]
    off = np.array([1e-6, 1e-6, 1e-6, 1e-6, 1e-3])
    assert tables.alike(np.ones(5), off).tolist() == [True] * 4 + [False]
    assert tables.alike(np.array([1.0, 9.0]), np.full(2, 1e-6)).all()  # of two it is not known which
    made = [rows(("a", 1e-6, time)).assign(repeat=k) for k, time in enumerate(times)]
    found = tables.medians(pd.concat(made, ignore_index=True))
    assert found["times"][0] == (1.0, 1.1, 1.2, 0.9)
    assert found["call_s"].tolist() == [pytest.approx(1.05)] and found["repeats"].tolist() == [5]


def test_the_price_is_the_cheapest_run_that_is_good_enough_however_good():
    """A looser error never costs more than a tighter one."""
    made = rows(("a", 8e-5, 8.7), ("a", 2e-5, 8.5), ("a", 1e-7, 9.0), ("a", 1e-13, 7.7))
    made = made.assign(tol=[1e-4, 1e-5, 1e-7, 1e-12])
    for error in (1e-4, 1e-6, 1e-12):
        assert tables.time_for(made, error) == 7.7 and tables.costs_at(made, error)["a"][0] == 7.7
