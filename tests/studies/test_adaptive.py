"""What a solver is asked for ends where more is of no use: refusals, limits, failures, far behind; slow runs once."""

import pytest

from studies import adaptive
from studies.bench import Case, Run, Solver
from tests.studies.test_rivals import Kept

VALUES = (1e-2, 1e-4, 1e-6, 1e-8, 1e-10)


def made(*solvers, repeats=2, all_asked=False, kept=None):
    """Tolerances of the rows of each solver, given (name, make(value) -> status, error, seconds)."""
    case = Case("crane", None, 1.0)
    makers = dict(solvers)
    todo = [
        Run(case, Solver(name, "any", "compiled", True, "tol", None, VALUES), value, "", repeats)
        for name in makers
        for value in VALUES
    ]

    def make(run, repeat, built):
        status, error, seconds = makers[run.solver.name](run.value)
        return {"solver": run.solver.name, "tol": run.value, "repeat": repeat, "status": status, "error_q": error} | {
            "case": run.case.name,
            "call_s": seconds,
        }

    return adaptive.collect(todo, Kept() if kept is None else kept, make, lambda run: all_asked)


def good(seconds):
    return lambda value: ("REACHED_END", value, seconds)


def first(rows, solver):
    chosen = rows[(rows["solver"] == solver) & (rows["repeat"] == 0)]
    return len(chosen)


@pytest.mark.parametrize("status", adaptive.ENDING)
def test_nothing_is_asked_after_a_refusal_or_the_limit(status):
    assert len(made(("a", lambda value: (status, None, None)))) == 1


def test_failures_at_two_tolerances_running_end_it():
    failing = ("a", lambda value: ("SOLVER_FAILED", None, 0.1) if value in VALUES[1:3] else good(0.1)(value))
    assert first(made(failing), "a") == 3
    once = ("a", lambda value: ("SOLVER_FAILED", None, 0.1) if value == VALUES[1] else good(0.1)(value))
    assert first(made(once), "a") == len(VALUES)


def test_far_behind_at_two_settings_running_ends_it_unless_all_is_asked():
    table = (("a", good(0.01)), ("b", good(0.3)), ("c", good(0.15)))
    rows = made(*table)
    assert [first(rows, name) for name in "abc"] == [5, 2, 5]
    assert first(made(*table, all_asked=True), "b") == 5


def test_an_error_that_nothing_else_reaches_is_not_far_behind():
    better = ("b", lambda value: ("REACHED_END", 1e-3 * value**2, 1.0))
    assert first(made(("a", lambda value: ("REACHED_END", 1.0, 0.01)), better), "b") == 5


def test_failed_runs_are_made_once_and_slow_ones_as_often_as_all():
    def make(value):
        return ("SOLVER_FAILED", None, 0.1) if value == VALUES[1] else ("REACHED_END", value, 0.9)

    rows = made(("a", make), repeats=3)
    assert rows.groupby("tol").size().to_dict() == {value: 1 if value == VALUES[1] else 3 for value in VALUES}
    assert (rows["repeat"].diff().fillna(-1) <= 0).sum() == len(VALUES)  # one run below the other, for the medians


def test_a_run_goes_on_from_what_is_kept():
    kept = Kept()
    before = made(("a", good(0.01)), ("b", good(0.3)), kept=kept)
    assert made(("a", None), ("b", None), kept=kept).equals(before)  # neither is called again
