"""What a solver is asked for ends where more is of no use: refusals, limits, failures, far behind; slow runs once."""

import pytest

from studies.bench import adaptive
from studies.bench.collector import Case, Run, Solver
from tests.studies.test_work_precision import Kept

VALUES = (1e-2, 1e-4, 1e-6, 1e-8, 1e-10)


def collected(makers, start=VALUES, families=None, setting="tol", repeats=5, all_asked=False, kept=None, **errors):
    """Rows of solvers, given name: make(value) -> status, error, seconds."""
    case, values = Case("crane", None, 10.0), VALUES if setting == "tol" else ()
    families = families or dict.fromkeys(makers, "any")
    solvers = [Solver(name, families[name], "compiled", True, setting, None, values) for name in makers]
    todo = [Run(case, solver, value, "", repeats) for solver in solvers for value in start]

    def row(run, repeat, built):
        status, error, seconds = makers[run.solver.name](run.value)
        line = {"solver": run.solver.name, "case": "crane", setting: run.value, "repeat": repeat, "status": status}
        return line | {"error_q": error, "call_s": seconds}

    return adaptive.collect(todo, Kept() if kept is None else kept, row, lambda run: all_asked, **errors)


def made(*solvers, repeats=2, **options):
    return collected(dict(solvers), repeats=repeats, **options)


def good(seconds):
    return lambda value: ("REACHED_END", value, seconds)


def first(rows, solver):
    return len(rows[(rows["solver"] == solver) & (rows["repeat"] == 0)])


@pytest.mark.parametrize("status", adaptive.ENDING)
def test_nothing_is_asked_after_a_refusal(status):
    assert len(made(("a", lambda value: (status, None, None)))) == 1


def test_failures_at_two_tolerances_running_end_it():
    failing = ("a", lambda value: ("SOLVER_FAILED", None, 0.1) if value in VALUES[1:3] else good(0.1)(value))
    assert first(made(failing), "a") == 3
    at_first = ("a", lambda value: ("SOLVER_FAILED", None, 0.1) if value in VALUES[:3] else good(0.1)(value))
    assert first(made(at_first), "a") == len(VALUES)  # loose ones may fail where tight ones do not
    once = ("a", lambda value: ("SOLVER_FAILED", None, 0.1) if value == VALUES[1] else good(0.1)(value))
    assert first(made(once), "a") == len(VALUES)


def test_far_behind_at_two_settings_running_ends_it_unless_all_is_asked():
    table = (("a", good(0.01)), ("b", good(0.3)), ("c", good(0.15)))
    rows = made(*table)
    assert [first(rows, name) for name in "abc"] == [5, 2, 5] and first(made(*table, all_asked=True), "b") == 5


def test_an_error_that_nothing_else_reaches_is_not_far_behind():
    better = ("b", lambda value: ("REACHED_END", 1e-3 * value**2, 1.0))
    assert first(made(("a", lambda value: ("REACHED_END", 1.0, 0.01)), better), "b") == 5


def test_what_is_outclassed_on_its_own_side_is_made_once():
    rows = made(("a", good(0.1)), ("b", good(0.9)), ("c", good(1.5)), repeats=3)
    assert rows.groupby("solver").size().to_dict() == {"a": 15, "b": 15, "c": 5}
    finer = ("c", lambda value: ("REACHED_END", 1e-3 * value**4, 1.5))
    assert len(made(("a", good(0.1)), finer, repeats=3)) == 30


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


def asked(make, errors=(1e-2, 1e-3, 1e-4, 1e-5, 1e-6, 1e-7, 1e-8, 1e-9), start=VALUES[:3], **others):
    """Tolerances of which a solver was asked, given make(value) -> status, error, seconds; others beside it."""
    rows = collected({**others, "a": make}, start, errors=errors)
    assert rows.groupby(["solver", "tol"]).size().isin([1, 5]).all()
    return rows[(rows["repeat"] == 0) & (rows["solver"] == "a")].sort_values("tol", ascending=False)


def test_a_solver_is_asked_between_settings_until_no_error_is_a_decade_from_the_next():
    made = asked(lambda value: ("REACHED_END", 0.1 * value**1.5, 1.0 / value))
    wanted = made[made["error_q"].between(1e-9, 1e-2)]["error_q"]
    assert (wanted / wanted.shift(-1)).dropna().max() <= adaptive.DECADE * 1.01


def test_a_solver_that_leaps_is_asked_on_both_sides_and_no_more():
    made = asked(lambda value: ("REACHED_END", 1e-2 if value > 2.5e-5 else 1.8e-7, 1.0))
    above, below = made[made["tol"] > 2.5e-5]["tol"].min(), made[made["tol"] < 2.5e-5]["tol"].max()
    assert above / below <= adaptive.NEAR and len(made) <= 3 + 8


def test_a_solver_is_asked_beyond_its_ends_where_accuracies_are_left_out():
    made = asked(lambda value: ("REACHED_END", 1e-3 * value, 1.0), start=(1e-3, 1e-4))
    assert made["tol"].max() == adaptive.LOOSEST and made["error_q"].min() <= 1e-9


def test_what_is_far_behind_is_not_asked_between_its_settings():
    fast = lambda value: ("REACHED_END", 1e-3 * value, 1e-3)  # noqa: E731
    assert len(asked(lambda value: ("REACHED_END", value, 6e-3), fast=fast)) == 3


def test_ours_are_far_behind_by_the_fastest_of_ours_and_the_default_is_asked_in_any_case():
    """The call of ours may cost what others' does not: beside these all of ours would be asked for next to nothing."""
    fast, slow = (lambda value, time=time: ("REACHED_END", 1e-3 * value, time) for time in (1e-3, 0.1))
    slower = lambda value: ("REACHED_END", value, 1.0)  # noqa: E731
    families = {"fast": "theirs", "slow": "two-loop", "slower": "two-loop", "auto": "two-loop"}
    makers = {"fast": fast, "slow": slow, "slower": slower, "auto": slower}
    rows = collected(makers, VALUES[:3], families, errors=(1e-2, 1e-4, 1e-6, 1e-8))
    asked = rows[rows["repeat"] == 0].groupby("solver").size()
    assert asked["slow"] > 3 and asked["slower"] == 3 and asked["auto"] > 3


def limited(values):
    return lambda value: ("TIME_LIMIT", None, 1.0) if value in values else good(0.1)(value)


def test_a_limit_at_a_loose_setting_moves_to_the_next_and_two_running_end_it():
    assert first(made(("a", limited(VALUES[:1]))), "a") == len(VALUES)
    assert first(made(("a", limited(VALUES[1:3]))), "a") == 3


def asked_steps(make, **others):
    """Numbers of steps that a solver of fixed steps was asked for, given make(n) -> status, error, seconds."""
    makers = {name: lambda h, make=make: make(10.0 / h) for name, make in {**others, "a": make}.items()}
    rows = collected(makers, [10.0 / n for n in (300, 1000)], setting="h", errors=(1e-3, 1e-5, 1e-7))
    numbers = sorted({10.0 / h for h in rows[rows["solver"] == "a"]["h"]})
    assert [round(n) for n in numbers] == pytest.approx(numbers)  # the motion takes a whole number of each
    return [round(n) for n in numbers]


def test_fixed_steps_are_asked_for_beyond_both_ends():
    second_order = lambda n: ("REACHED_END", 1.0 / n**2, 1e-6 * n)  # noqa: E731
    numbers = asked_steps(second_order)
    assert 1.0 / numbers[0] ** 2 > 1e-4 and 1.0 / numbers[-1] ** 2 <= 1e-7
    fast = lambda n: ("REACHED_END", 1e-3 / n**2, 1e-8 * n)  # noqa: E731
    assert asked_steps(second_order, fast=fast) == [300, 1000]  # far behind: not asked on


def test_between_steps_that_fail_and_those_that_do_not_the_longest_is_sought():
    numbers = asked_steps(lambda n: ("SOLVER_FAILED", None, 0.1) if n < 500 else ("REACHED_END", 1.0 / n**2, 1e-6 * n))
    assert [n for n in numbers if 300 < n < 1000] == [548]
