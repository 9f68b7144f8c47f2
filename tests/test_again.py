"""A run by the arrays of the run before it equals that of the long way, which is taken where it cannot be made so."""

import copy
from concurrent.futures import ThreadPoolExecutor
from dataclasses import fields

import numpy as np
import pytest

from tests.compiled import PENDULUM
from tests.problems import some_of
from twoloop import ConstrainedSystem, ConstraintWarning, callback, mechanisms, solve, solve_dae
from twoloop.generate.exact_derivatives import Territory
from twoloop.result.result import Result
from twoloop.run import again

METHODS = ["auto", "DOP853", "Adams", "Gauss8", "RadauIIA5", "TRBDF2", "BDF"]
NAMES = [
    "four_bar",
    "andrews",
    "redundant_slider_crank",
    "rolling_disc",
    "heavy_top",
    "driven_slider_crank",
    "governor",
]


@callback("jacobian")
def wrong_above(t, q, p, Cq):
    Cq[0, 0] = q[0] if q[1] < 0.5 else 1.0001 * q[0]
    Cq[0, 1] = q[1]


def swing(system, angle, speed):
    q0, v0 = [np.sin(angle), -np.cos(angle)], [speed * np.cos(angle), speed * np.sin(angle)]
    return solve_dae(system, (0.0, 1.0), q0, v0, rtol=1e-6, atol=1e-6)


def starts(problem, span, n):
    solution = solve_dae(problem.system, (0.0, 1e-2 * span), problem.q0, problem.v0, dense_output=True).sol
    return [solution(t) for t in np.linspace(0.0, 1e-2 * span, n)]


def repeated(states):
    """With the same start in a row: at first a run of it is kept, then it begins by that, also after another."""
    return [*states, *4 * states[3:4], states[5], *3 * states[3:4]]


def runs(problem, states, span, **options):
    return [
        solve_dae(problem.system, (float(s.t), float(s.t) + span), s.q, s.v, rtol=1e-6, atol=1e-6, **options)
        for s in states
    ]


def assert_same(one: Result, other: Result):
    for name in [each.name for each in fields(Result) if each.name not in ("stats", "system")]:
        a, b = getattr(one, name), getattr(other, name)
        assert np.array_equal(a, b) if isinstance(a, np.ndarray) else a == b, name
        assert type(a) is type(b), name
    counted = [{k: v for k, v in vars(each.stats).items() if k != "cpu_time"} for each in (one, other)]
    assert counted[0] == counted[1] and one.stats.cpu_time > 0.0
    assert vars(one).keys() == vars(other).keys()


@pytest.mark.parametrize(("name", "method"), some_of(NAMES, METHODS))
@pytest.mark.filterwarnings("ignore::twoloop.ConstraintWarning")
def test_it_is_the_run_of_the_long_way_to_the_bit(name, method, taken, monkeypatch):
    problem, other = getattr(mechanisms, name)(), getattr(mechanisms, name)()
    span = 3e-3 if name == "andrews" else 0.1
    states = repeated(starts(problem, span, 7))
    by_arrays = runs(problem, states, span, method=method, time_limit=60.0)  # looked at after a chunk alone
    assert all(taken[-6:-1])
    monkeypatch.setattr(solve, "record_again", lambda *asked: None)
    for one, long in zip(by_arrays, runs(other, states, span, method=method), strict=True):
        assert_same(one, long)


@pytest.mark.parametrize("method", ["auto", "RadauIIA5", "PaperIRK"])
@pytest.mark.parametrize("at", [(1,), (0, 1), (0,)])
def test_states_at_the_ends_are_those_of_the_long_way_to_the_bit(method, at, taken, monkeypatch):
    def at_ends(problem):
        ends = [np.array([float(s.t), float(s.t) + 0.1])[list(at)] for s in states]
        return [runs(problem, [s], 0.1, method=method, t_eval=t)[0] for s, t in zip(states, ends, strict=True)]

    problem, other = mechanisms.four_bar(), mechanisms.four_bar()
    states = repeated(starts(problem, 0.1, 7))
    by_arrays = at_ends(problem)
    assert all(taken[-6:-1])
    monkeypatch.setattr(solve, "record_again", lambda *asked: None)
    for one, long in zip(by_arrays, at_ends(other), strict=True):
        assert_same(one, long)


@pytest.mark.parametrize(("name", "method"), some_of(NAMES, METHODS, 2))
@pytest.mark.filterwarnings("ignore::twoloop.ConstraintWarning")
def test_the_solution_between_the_steps_is_that_of_the_long_way_to_the_bit(name, method, taken, monkeypatch):
    problem, other = getattr(mechanisms, name)(), getattr(mechanisms, name)()
    span = 3e-3 if name == "andrews" else 0.1
    states = repeated(starts(problem, span, 7))
    by_arrays = [each.sol for each in runs(problem, states, span, method=method, dense_output=True)]
    assert all(taken[-6:-1])
    monkeypatch.setattr(solve, "record_again", lambda *asked: None)
    for one, long in zip(by_arrays, runs(other, states, span, method=method, dense_output=True), strict=True):
        times = np.random.default_rng(2).uniform(one.t_min, one.t_max, 9)
        assert (one.t_min, one.t_max) == (long.sol.t_min, long.sol.t_max)
        for kind in ("q", "v", "a", "lam"):
            assert np.array_equal(getattr(one(times), kind), getattr(long.sol(times), kind)), kind


@pytest.mark.parametrize("name", ["redundant_slider_crank", "heavy_top"])
@pytest.mark.filterwarnings("ignore::twoloop.ConstraintWarning")
def test_starts_that_ask_for_other_code_keep_no_arrays_out(name, taken, monkeypatch):
    problem, other = getattr(mechanisms, name)(), getattr(mechanisms, name)()
    span = 0.3 * (problem.t_span[1] - problem.t_span[0])
    solution = solve_dae(problem.system, (0.0, span), problem.q0, problem.v0, dense_output=True).sol
    states = [solution(t) for t in np.random.default_rng(3).uniform(0.0, span, 60)]
    by_arrays = runs(problem, states, 0.1)
    *_, kept = problem.system.made["runs"][1].values()
    assert len({id(each.code) for each in kept}) > 1 and sum(taken) > 30
    monkeypatch.setattr(solve, "record_again", lambda *asked: None)
    for one, long in zip(by_arrays, runs(other, states, 0.1), strict=True):
        assert_same(one, long)


def test_where_series_give_way_to_another_method(taken, monkeypatch):
    problem, other = mechanisms.four_bar(), mechanisms.four_bar()
    states = repeated(starts(problem, 1e-6, 7))
    by_arrays = runs(problem, states, 10.0)
    assert all(taken[-6:-1])
    changed = runs(problem, states, 10.0, method="Taylor")[-1].h.size
    monkeypatch.setattr(solve, "record_again", lambda *asked: None)
    for one, long in zip(by_arrays, runs(other, states, 10.0), strict=True):
        assert_same(one, long)
        assert one.h.size != changed


def test_what_a_compiled_callback_raises_comes_through(taken):
    @callback("force")
    def force(t, q, v, p, Q):
        if q[0] > 0.9:
            raise ValueError("out of range")
        Q[1] = -9.81

    system = ConstrainedSystem(**PENDULUM | {"force": force})
    for k in range(7):
        assert swing(system, 0.3 + 0.01 * k, 0.0).success
    assert taken[-1]
    with pytest.raises(ValueError, match="out of range"):
        swing(system, 0.3, 5.0)


def test_results_do_not_share_arrays(taken):
    problem = mechanisms.four_bar()
    results = runs(problem, starts(problem, 1.0, 8), 1.0)
    kept = [each.q.copy() for each in results]
    runs(problem, starts(problem, 0.5, 8), 2.0)
    assert sum(taken) >= 6
    assert all((each.q == q).all() for each, q in zip(results, kept, strict=True))
    results[-1].atol[0] = 7.0
    assert runs(problem, starts(problem, 1.0, 1), 1.0)[0].atol[0] == 1e-6


def test_threads_have_arrays_of_their_own(taken):
    problem = mechanisms.four_bar()
    states = starts(problem, 1.0, 40)
    alone = runs(problem, states, 1.0)
    with ThreadPoolExecutor(4) as pool:
        together = list(pool.map(lambda state: runs(problem, [state], 1.0)[0], states))
    assert sum(taken) > 60
    for one, other in zip(alone, together, strict=True):
        assert (one.q == other.q).all() and (one.lam == other.lam).all()


@pytest.mark.parametrize("options", [{"method": "DOP853"}, {"method": "Adams"}, {}], ids=str)
def test_a_run_of_several_chunks_is_that_of_the_long_way(options, taken, monkeypatch):
    """It is looked at after as many attempts, so that the message is the same, too."""
    problem, other = mechanisms.four_bar(), mechanisms.four_bar()
    options = {"max_step": 0.01, "t_eval": [0.5, 7.3, 25.0]} | options
    states = starts(problem, 1.0, 8)
    monkeypatch.setattr(again, "LONGEST", np.inf)
    by_arrays = runs(problem, states, 30.0, **options)
    assert min(each.h.size for each in by_arrays) >= 3000 and sum(taken) >= 3, taken
    monkeypatch.setattr(solve, "record_again", lambda *asked: None)
    for one, long in zip(by_arrays, runs(other, states, 30.0, **options), strict=True):
        assert_same(one, long)


def test_a_run_that_takes_too_long_or_has_no_room_goes_the_long_way(taken, monkeypatch):
    problem = mechanisms.four_bar()
    states, options = starts(problem, 1.0, 6), {"method": "DOP853", "max_step": 0.01}
    monkeypatch.setattr(again, "LONGEST", -1.0)
    assert all(each.success for each in runs(problem, states, 30.0, **options)) and not any(taken)
    monkeypatch.setattr(again, "LONGEST", np.inf)
    monkeypatch.setattr(again, "LARGEST", 2000 * len(states[0].q) * 4)
    assert all(each.success for each in runs(mechanisms.four_bar(), states, 30.0, **options)) and not any(taken)


def test_what_is_wrong_at_a_start_is_said_as_ever(taken):
    problem = mechanisms.four_bar()
    states = starts(problem, 1.0, 6)
    runs(problem, states, 1.0)
    q0 = states[0].q + np.eye(len(states[0].q))[2] * 1e-3
    with pytest.raises(ValueError, match=r"q0.*C\(t, q\)"):
        solve_dae(problem.system, (0.0, 1.0), q0, states[0].v, rtol=1e-6, atol=1e-6)
    v0 = states[0].v + np.eye(len(q0))[1]
    with pytest.raises(ValueError, match="v0"):
        solve_dae(problem.system, (0.0, 1.0), states[0].q, v0, rtol=1e-6, atol=1e-6)
    runs(problem, states, 1.0)
    assert taken[-1]


def test_a_callback_that_is_wrong_where_no_run_was_is_found(taken):
    """Within the box of states that were compared nothing is compared again, beyond it all that is new."""

    system = ConstrainedSystem(**PENDULUM | {"jacobian": wrong_above})
    assert all(swing(system, 0.3 + 0.01 * k, 0.0).success for k in range(7))
    assert taken[-1]
    assert not swing(system, 0.3, 6.5).success


@pytest.mark.parametrize("name", ["redundant_slider_crank", "bricard"])
@pytest.mark.filterwarnings("ignore::twoloop.ConstraintWarning")
def test_redundant_rows_are_named(name, taken):
    problem = getattr(mechanisms, name)()
    states = starts(problem, 1e-6, 7)
    for state in states:
        with pytest.warns(ConstraintWarning, match="left out of the solution") as said:
            result = runs(problem, [state], 0.05)[0]
        assert f"row(s) {result.redundant.tolist()}" in str(said[0].message) and said[0].filename == __file__
    assert sum(taken) >= 2


@pytest.mark.filterwarnings("ignore::twoloop.ConstraintWarning")
def test_the_redundant_rows_told_are_those_of_this_start(taken, monkeypatch):
    """The words on them are those of the first start at which they were redundant."""
    problem, other = mechanisms.redundant_slider_crank(), mechanisms.redundant_slider_crank()
    states = repeated(starts(problem, 10.0, 7))

    def said(system):
        with pytest.warns(ConstraintWarning) as warned:
            runs(system, states, 0.05)
        return [str(each.message).partition("row(s) ")[2].partition(" depend")[0] for each in warned]

    by_arrays = said(problem)
    assert sum(taken) >= 4
    monkeypatch.setattr(solve, "record_again", lambda *asked: None)
    assert by_arrays == said(other) and all(by_arrays)


def test_a_result_has_the_system_of_the_call(taken):
    """Also where another stands for it, or was solved before it was copied."""
    system = ConstrainedSystem(**PENDULUM | {"jacobian": None, "gamma": None})
    for each in (system, copy.copy(system), copy.deepcopy(system)):
        results = [swing(each, 0.3 + 0.01 * k, 0.0) for k in range(7)]
        assert taken[-1]
        assert all(result.system is each for result in results)


def test_a_run_in_which_something_is_wrong_counts_once(taken, monkeypatch):
    """So that it is the 2nd, 4th, 8th, ... that is compared as a whole."""
    counted, count = [], Territory.count
    monkeypatch.setattr(Territory, "count", lambda each: counted.append(each) or count(each))
    system = ConstrainedSystem(**PENDULUM | {"jacobian": wrong_above})
    assert all(swing(system, 0.3 + 0.01 * k, 0.0).success for k in range(6))
    assert any(taken)
    assert not swing(system, 0.3, 6.5).success
    assert len(counted) == 7
