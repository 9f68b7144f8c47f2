"""The first call, and from which run building pays, from rows made by hand."""

from contextlib import nullcontext
from dataclasses import replace

import pandas as pd
import pytest

from references import driver
from references.driver import user_call
from studies.bench.render import render
from studies.bench.solvers import CATALOGUE
from studies.work_precision import first_calls


def rows(*lines):
    """Rows of (solver, first call, later call) on one mechanism."""
    made = [
        {"solver": solver, "first_call_s": first, "call_s": later, "call_q1": later, "call_q3": later}
        for solver, first, later in lines
    ]
    return pd.DataFrame(made).assign(case="crane", tol=1e-8, status="REACHED_END")


@pytest.mark.parametrize(
    ("first", "later", "pays"), [(1.05, 0.1, 11.0), (0.05, 0.1, 1.0), (1.0, 0.2, None), (1.0, 0.3, None)]
)
def test_building_pays_from_the_run_in_which_all_runs_together_take_less(first, later, pays):
    line = {"first_call_s": first, "call_s": later, "call_q3": later}
    default = {"first_call_s": 0.1, "call_s": 0.2, "call_q1": 0.2}
    assert first_calls.pays_from(line, default) == pays

    def total(side, n):
        return side["first_call_s"] + (n - 1) * side["call_s"]

    ahead = [n for n in range(1, 100) if total(line, n) < total(default, n)]
    assert (ahead[0] if ahead else None) == pays


def test_what_is_cheaper_by_less_than_its_scatter_pays_never():
    default = {"first_call_s": 0.1, "call_s": 0.2, "call_q1": 0.18}
    for first in (1.0, 0.05):
        assert first_calls.pays_from({"first_call_s": first, "call_s": 0.19, "call_q3": 0.21}, default) is None


def test_a_line_a_solver_and_never_where_its_calls_are_no_cheaper():
    made = rows(("auto", 0.1, 0.2), ("auto, compiled", 1.0, 0.1), ("heyoka", 3.0, 0.4))
    failed = rows(("auto, compiled", None, None)).assign(case="hoist", status="RAISED")
    found = {line["solver"]: line for line in first_calls.findings_of(pd.concat([made, failed]))}
    assert found["auto, compiled"]["pays"] == [11.0] and found["auto, compiled"]["n"] == 1
    assert found["heyoka"]["never"] == 1 and found["auto"]["pays"] == [] and found["auto"]["never"] == 0
    text = render("first_calls", {"first_calls": list(found.values())}, {})
    assert "| `compiled=True` | 1.0 | 100 | 11 |" in text and "| never on 1 |\n" in text


@pytest.mark.slow
def test_the_first_call_builds_where_the_next_finds_all_built():
    row = first_calls.in_process(first_calls.__name__, "four-bar", "auto, compiled")
    assert row["status"] == "REACHED_END" and {"first_call_s", "call_s", "elsewhere_s"} <= row.keys()


@pytest.mark.parametrize(("marks", "spent"), [(True, 7.0), (False, 107.0)])
def test_the_first_call_ends_where_that_of_a_user_ends(marks, spent, monkeypatch):
    """A second run for the output, which builds once more, is ours; an adapter that marks nothing is timed whole."""
    ours, clock = CATALOGUE["DOP853 (twoloop)"], [0.0]

    def run(case, value, repeat):
        clock[0] += 5.0  # builds
        with user_call if marks else nullcontext():
            clock[0] += 2.0
        clock[0] += 60.0  # builds for the output
        with user_call if marks else nullcontext():
            clock[0] += 40.0
        return ours.run(case, value, repeat)

    for module in (driver, first_calls):
        monkeypatch.setattr(module, "cpu_time", lambda: clock[0])
    monkeypatch.setattr(first_calls, "_compiled_anew", lambda modules: modules[-1])  # other tests hold its functions
    monkeypatch.setitem(CATALOGUE, "twice", replace(ours, name="twice", run=run))
    row = first_calls.times_of("heavy top", "twice")
    assert row["status"] == "REACHED_END" and row["first_call_s"] == spent
