"""Repeated calls: equal to a new one to the bit, cheap beside their steps, and what is kept hides no mistake."""

import copy
import cProfile
import pickle
import pstats
import signal
from dataclasses import fields, replace
from functools import cache
from itertools import chain

import numpy as np
import pytest

import twoloop
from tests.compiled import PENDULUM
from tests.problems import assert_same, pendulum, quick, some_of
from twoloop import ConstrainedSystem, ConstraintWarning, Integrator, callback, mechanisms, solve_dae
from twoloop.checks.consistency import StartEvaluation, check_start
from twoloop.generate.derived_callbacks import exact_derivatives, generic_states
from twoloop.kernels.layout import _unused_workspaces
from twoloop.methods.tableaux import gauss, radau_iia
from twoloop.run import cached

METHODS = ["auto", "DOP853", "Adams", "Gauss8", "RadauIIA5", "TRBDF2", "BDF"]
NAMES = ["four_bar", "andrews", "redundant_slider_crank", "rolling_disc", "heavy_top", "driven_slider_crank"]


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


OUTPUTS = ({}, {"dense_output": True}, {"at": (0, 1)}, {"time_limit": 60.0}, {"at": (1,)})
CASES = [(*pair, OUTPUTS[k % 5]) for k, pair in enumerate(some_of(NAMES, METHODS, 4))]
IN_EVERY_RUN = [("four_bar", "auto", options) for options in OUTPUTS]
IN_EVERY_RUN += [("redundant_slider_crank", "DOP853", {}), ("rolling_disc", "RadauIIA5", OUTPUTS[1])]
CASES = quick([*IN_EVERY_RUN, *(case for case in CASES if case not in IN_EVERY_RUN)], len(IN_EVERY_RUN))


@pytest.mark.parametrize(("name", "method", "options"), CASES)
@pytest.mark.filterwarnings("ignore::twoloop.ConstraintWarning")
def test_a_repeated_call_equals_a_new_one_to_the_bit(name, method, options, taken, by_the_loop):
    """Every step, the solution between the steps, and states at the ends alone."""
    problem, other = getattr(mechanisms, name)(), getattr(mechanisms, name)()
    span = 3e-3 if name == "andrews" else 0.1
    states = repeated(starts(problem, span, 7))
    at = options.get("at")

    def all_runs(problem):
        if at is None:
            return runs(problem, states, span, method=method, **options)
        ends = [np.array([float(s.t), float(s.t) + span])[list(at)] for s in states]
        return [runs(problem, [s], span, method=method, t_eval=t)[0] for s, t in zip(states, ends, strict=True)]

    for work in chain.from_iterable(_unused_workspaces.values()):
        work.notes.base[:], work.counters.base[:] = np.nan, 10**6  # whatever a run has left
    by_arrays = all_runs(problem)
    assert all(taken[-6:-1])
    by_the_loop()
    for one, long in zip(by_arrays, all_runs(other), strict=True):
        assert_same(one, long)


@pytest.mark.parametrize("name", quick(["heavy_top", "redundant_slider_crank"]))
@pytest.mark.filterwarnings("ignore::twoloop.ConstraintWarning")
def test_starts_that_ask_for_other_code_keep_no_arrays_out(name, taken, by_the_loop):
    problem, other = getattr(mechanisms, name)(), getattr(mechanisms, name)()
    span = 0.3 * (problem.t_span[1] - problem.t_span[0])
    solution = solve_dae(problem.system, (0.0, span), problem.q0, problem.v0, dense_output=True).sol
    states = [solution(t) for t in np.random.default_rng(3).uniform(0.0, span, 60)]
    by_arrays = runs(problem, states, 0.1)
    *_, kept = problem.system.derived["runs"][1].values()
    assert len({id(each.code) for each in kept}) > 1 and sum(taken) > 30
    by_the_loop()
    for one, long in zip(by_arrays, runs(other, states, 0.1), strict=True):
        assert_same(one, long)


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


@pytest.mark.parametrize("options", quick([{}, {"method": "DOP853"}, {"method": "Adams"}]), ids=str)
def test_a_run_of_several_chunks_is_that_of_the_long_way(options, taken, by_the_loop):
    """The clock is read after as many attempts, so that the message is the same, too."""
    problem, other = mechanisms.four_bar(), mechanisms.four_bar()
    options = {"max_step": 0.01, "t_eval": [0.5, 7.3, 25.0]} | options
    states = starts(problem, 1.0, 8)
    by_arrays = runs(problem, states, 30.0, **options)
    assert min(each.h.size for each in by_arrays) >= 3000 and sum(taken) >= 3, taken
    by_the_loop()
    for one, long in zip(by_arrays, runs(other, states, 30.0, **options), strict=True):
        assert_same(one, long)


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


@pytest.mark.filterwarnings("ignore::twoloop.ConstraintWarning")
def test_the_redundant_rows_told_are_those_of_this_start(taken, by_the_loop):
    """The words on them are those of the first start at which they were redundant."""
    problem, other = mechanisms.redundant_slider_crank(), mechanisms.redundant_slider_crank()
    states = repeated(starts(problem, 10.0, 7))

    def said(system):
        with pytest.warns(ConstraintWarning) as warned:
            runs(system, states, 0.05)
        return [str(each.message).partition("row(s) ")[2].partition(" depend")[0] for each in warned]

    by_arrays = said(problem)
    assert sum(taken) >= 4
    by_the_loop()
    assert by_arrays == said(other) and all(by_arrays)


def test_a_result_has_the_system_of_the_call(taken):
    """Also where another stands for it, or was solved before it was copied."""
    system = ConstrainedSystem(**PENDULUM | {"jacobian": None, "gamma": None})
    for each in (system, copy.copy(system), copy.deepcopy(system)):
        results = [swing(each, 0.3 + 0.01 * k, 0.0) for k in range(7)]
        assert taken[-1]
        assert all(result.system is each for result in results)


# --- a repeated call costs little beside its steps: calls of functions are counted
# calls of functions in a second run, which compares callbacks again at four states, in a third, in a fifth and a sixth
MANY, THIRD, FEWEST = 500, 200, 40
# in a run from another start, and in one with other parameters; a twentieth more with the oldest versions
ANOTHER = {"four_bar": (55, 920), "redundant_slider_crank": (63, 1360), "heavy_top": (67, 740)}
ANOTHER |= {"spatial_four_bar": (67, 1450), "bricard": (63, 550)}


def run(problem, rtol=1e-6, **options):
    return solve_dae(problem.system, (0.0, 1.0), problem.q0, problem.v0, rtol=rtol, atol=rtol, **options)


OF_OBJECTS = 75  # calls more where the method is an object, which is compared with those before by its options
WAYS = {
    "name": (lambda problem: run(problem, method="RadauIIA5"), 0),
    "default": (run, 0),
    "object": (lambda problem: run(problem, method=twoloop.BDF(max_order=3)), OF_OBJECTS),
    "integrator": (lambda problem: integrator(problem.system).run((0.0, 1.0), problem.q0, problem.v0), 0),
}


@cache
def integrator(system):
    return Integrator(system, "auto", 1e-6, 1e-6)


@pytest.mark.parametrize("way", WAYS)
def test_a_repeated_call_takes_few_calls_of_functions(way):
    call, more = WAYS[way]
    problem, other = mechanisms.four_bar(), mechanisms.pendulum()
    for _ in range(3):
        run(other)  # a process looks up addresses of functions once
    calls = [calls_of(lambda: call(problem)) for _ in range(6)]
    if not more:
        assert calls[1] < MANY and calls[2] < THIRD, calls  # the first compiles, or checks derivatives
    assert max(calls[4:]) < FEWEST + more, calls


def test_a_method_of_other_options_makes_a_run_of_its_own():
    problem = mechanisms.four_bar()
    orders = [8, 12, 8, 12, 8, 12, 8, 12]
    ends = [run(problem, method=twoloop.Taylor(order=order)).q[:, -1].tolist() for order in orders]
    assert ends[0] != ends[1] and all(end == ends[k % 2] for k, end in enumerate(ends))


class Changing:
    """A method whose steps change."""

    name = "changing"

    def __init__(self):
        self.now = twoloop.DOP853()

    def plan(self, *given):
        return self.now.plan(*given)


def test_nothing_is_kept_for_a_method_that_may_change():
    problem, method = mechanisms.four_bar(), Changing()
    before = [run(problem, method=method).h.size for _ in range(4)]
    method.now = twoloop.RungeKutta(gauss(3))
    after = [run(problem, method=method).h.size for _ in range(4)]
    assert len({*before}) == len({*after}) == 1 and before[0] != after[0]


def test_a_tableau_that_was_written_to_makes_a_run_of_its_own():
    problem, tableau, other = mechanisms.four_bar(), gauss(3), radau_iia(3)
    before = [run(problem, method=twoloop.RungeKutta(tableau)).q[:, -1].tolist() for _ in range(4)]
    for name in ("A", "b", "c"):
        getattr(tableau, name)[...] = getattr(other, name)
    after = [run(problem, method=twoloop.RungeKutta(tableau)).q[:, -1].tolist() for _ in range(4)]
    again = [run(problem, method=twoloop.RungeKutta(gauss(3))).q[:, -1].tolist() for _ in range(2)]
    assert before[0] == before[-1] == again[0] == again[1] and after[0] == after[-1] != before[0]


def calls_of(function):
    profile = cProfile.Profile()
    profile.runcall(function)
    return pstats.Stats(profile).total_calls


@pytest.mark.parametrize("name", quick(ANOTHER))
@pytest.mark.filterwarnings("ignore::twoloop.ConstraintWarning")
def test_a_call_from_another_start_or_with_other_parameters_takes_few_calls_of_functions(name):
    """The median of calls: some compare callbacks once more."""
    problem, span = getattr(mechanisms, name)(), 0.2
    system = problem.system
    motion = solve_dae(system, (0.0, span), problem.q0, problem.v0, t_eval=np.linspace(0.0, span, 12))
    states = list(zip(motion.t.tolist(), motion.q.T.copy(), motion.v.T.copy(), strict=True))
    for _ in range(2):
        starts = [calls_of(lambda s=s: solve_dae(system, (s[0], s[0] + 0.5 * span), *s[1:])) for s in states]
    others = [system.with_parameters(system.parameters) for _ in range(5)]
    p = [calls_of(lambda s=s: solve_dae(s, (0.0, 0.5 * span), problem.q0, problem.v0)) for s in others]
    assert (np.median(starts) < ANOTHER[name][0]) and (np.median(p) < ANOTHER[name][1]), (starts, p)


@pytest.mark.parametrize("make", [mechanisms.spatial_four_bar, mechanisms.spatial_slider_crank, mechanisms.heavy_top])
def test_coordinates_that_are_zero_but_for_rounding_need_no_closer_look(make):
    """Another processor leaves 1e-50 in place of 0, and rows of such coordinates above the rounding of their terms."""
    problem, generic = make(), np.random.default_rng(6)
    evaluation = StartEvaluation(problem.system)
    off = generic.standard_normal(problem.system.n_q)
    for size, seen in ((0.0, True), (1e-50, True), (1e-35, True), (1e-12, False)):
        found = evaluation.evaluate(0.0, problem.q0 + size * off, problem.v0)
        assert bool(found & evaluation.flags.CONSISTENT) is seen


# --- what is kept between calls changes nothing, and lets nothing wrong pass
OFF_ROUNDING = ("bricard", "redundant_slider_crank", "closed_chain", "spatial_slider_crank", "spatial_four_bar")


@pytest.mark.parametrize("name", quick(OFF_ROUNDING, 2))
@pytest.mark.filterwarnings("ignore::twoloop.ConstraintWarning")
def test_what_starts_have_shown_lets_no_other_start_pass(name):
    """The size of coordinates that a start has shown spares the next a closer look, which would say the same."""
    problem = mechanisms.closed_chain(4) if name == "closed_chain" else getattr(mechanisms, name)()
    known, times = problem.system, [0.0, 1e-6, 0.1, 0.2]  # near some starts rows are short by their position
    motion = solve_dae(known, (0.0, 0.2), problem.q0, problem.v0, t_eval=times)
    for k in range(4):
        check_start(known, motion.t[k], motion.q[:, k], motion.v[:, k])
    generic, refused = np.random.default_rng(5), []
    for size in 10.0 ** np.arange(-17, -4):
        off = size * generic.standard_normal(known.n_q) * (generic.random(known.n_q) < 0.3)
        for k in range(4):
            said = []
            for system in (known, known.with_parameters(known.parameters)):
                try:
                    check_start(system, motion.t[k], motion.q[:, k] + off, motion.v[:, k], derivatives=False)
                    said.append("")
                except ValueError as error:
                    said.append(str(error))
            assert said[0] == said[1]
            refused.append(bool(said[0]))
    assert 0 < sum(refused) < len(refused)


@callback("mass")
def three_equal_masses(t, q, p, M):
    M[0, 0] = M[1, 1] = M[2, 2] = 1.0


@callback("force")
def no_force(t, q, v, p, Q):
    pass


@callback("constraint")
def of_a_small_crank(t, q, p, C):
    C[0], C[1] = q[0] - 1e-6 * np.cos(q[2] - 1e4), q[1] - np.sin(q[2] - 1e4)


@callback("jacobian")
def turned(t, q, p, Cq):
    Cq[0, 0], Cq[0, 2] = 1.0, 1e-6 * np.sin(q[2] - 1e4)
    Cq[1, 1], Cq[1, 2] = 1.0, -np.cos(q[2] - 1e4)


def test_what_is_shown_where_an_entry_vanishes_lets_no_start_pass_where_it_does_not():
    """At a dead centre C_q does not tell the micrometres of the first coordinate from the 1e4 rad of the last."""
    callbacks = {"constraint": of_a_small_crank, "jacobian": turned, "force": no_force, "mass": three_equal_masses}

    def refused(system, angle, off):
        start = np.array([1e-6 * np.cos(angle) * (1.0 + off), np.sin(angle), 1e4 + angle])
        try:
            check_start(system, 0.0, start, np.zeros(3))
        except ValueError:
            return True
        return False

    known = ConstrainedSystem(n_q=3, n_c=2, constant_mass=True, **callbacks)
    assert not refused(known, 1e-9, 1e-9)
    assert "sizes" in known.derived
    places = [(angle, off) for angle in (1e-9, 1e-3, 0.3, 1.0) for off in (1e-7, 1e-6, 1e-5, 1e-4)]
    assert all(refused(known, *place) for place in places)


@pytest.mark.parametrize(
    ("given", "options"), quick([((1,), {}), ((2, "bodies"), {"t_eval": [2.5, 8.0]}), ((1,), {"dense_output": True})])
)
@pytest.mark.filterwarnings("ignore::twoloop.ConstraintWarning")
def test_a_call_that_crosses_singular_positions_is_that_of_a_new_system(given, options):
    def call(system, state):
        return solve_dae(system, (float(state.t), 10.0), state.q, state.v, rtol=1e-7, atol=1e-7, **options)

    problem = mechanisms.n_four_bar(*given)
    solution = solve_dae(problem.system, (0.0, 1e-3), problem.q0, problem.v0, dense_output=True).sol
    states = [solution(t) for t in (0.0, 2e-4, 4e-4, 6e-4, 8e-4, 9e-4, 1e-3)]
    results = [call(problem.system, state) for state in states]  # later ones change none of these
    new = [call(mechanisms.n_four_bar(*given).system, state) for state in states]
    for one, other in zip(results, new, strict=True):
        assert_same(one, other)
    assert sum("singular value" in result.message for result in results) > 2
    last = call(problem.system, states[-1])  # its message is made when it is first read
    copies = copy.deepcopy(last), pickle.loads(pickle.dumps(last)), replace(last, changes="some")
    assert {each.message for each in copies} == {results[-1].message}


def test_fields_are_put_together_when_they_are_asked_for():
    problem = mechanisms.four_bar()
    *_, result = [run(problem) for _ in range(9)]
    assert vars(result).keys() == {"status", "later"}
    assert {each.name for each in fields(result)} <= set(dir(result)) and not hasattr(result, "nothing")
    assert result.q.shape == (9, result.t.size) and "h" not in vars(result)
    assert result.q is result.q and result.h is result.h
    others = pickle.loads(pickle.dumps(run(problem))), copy.copy(run(problem)), replace(run(problem), changes="some")
    assert all((each.a == result.a).all() and each.stats.n_inner == result.stats.n_inner for each in others)
    assert others[-1].changes == "some" and "later" not in vars(others[0])


def test_starts_are_taken_as_they_are_given(taken):
    """As columns of a table, as lists, and with numbers that are not finite, which compiled code refuses."""
    problem = mechanisms.four_bar()
    expected = [run(problem) for _ in range(8)][-1].q
    table = np.array([problem.q0, problem.v0]).T
    written = table.T.copy()
    written[0, 0] += 0.1
    with pytest.raises(ValueError, match="q0 is not consistent"):
        solve_dae(problem.system, (0.0, 1.0), *written, rtol=1e-6, atol=1e-6)
    written[0, 0] = problem.q0[0]  # in the arrays of the last call
    lists, backwards = written.tolist(), (written[0, ::-1].copy()[::-1], written[1])
    shifted = written + np.array([[1e-13], [0.0]])  # consistent by a closer look than that of the compiled call
    systems = problem.system, mechanisms.four_bar().system
    assert_same(*[solve_dae(each, (0.0, 1.0), *shifted, rtol=1e-6, atol=1e-6) for each in systems])
    for q0, v0 in (written, pickle.loads(pickle.dumps(written)), table.T, lists, backwards):
        assert (solve_dae(problem.system, (0.0, 1.0), q0, v0, rtol=1e-6, atol=1e-6).q == expected).all() and taken[-1]
    for name, values in (("q0", (np.full(9, np.inf), problem.v0)), ("v0", (problem.q0, np.full(9, np.nan)))):
        with pytest.raises(ValueError, match=f"{name} must be finite"):
            solve_dae(problem.system, (0.0, 1.0), *values, rtol=1e-6, atol=1e-6)
    assert (run(problem).q == expected).all() and taken[-1]


def test_ctrl_c_in_a_repeated_call_returns_a_result(interruptible, monkeypatch):
    """Also where no handler of ours stands in for Python's; one of the user's stays."""
    problem = mechanisms.four_bar()
    for _ in range(8):
        full = run(problem)
    made, heard = cached.partial, []

    def pressed(*given):
        signal.raise_signal(signal.SIGINT)
        return made(*given)

    with monkeypatch.context() as changed:
        changed.setattr(cached, "partial", pressed)
        assert run(problem).status.name == "INTERRUPTED"
        assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
        for _ in range(3):
            run(problem)
        signal.signal(signal.SIGINT, lambda number, frame: heard.append(number))
        assert run(problem).success and heard == [signal.SIGINT]
    assert (run(problem).q == full.q).all()


STATE = (0.3, np.array([0.6, -0.8]), np.array([0.8, 0.6]))


WRONG = {
    "jacobian": lambda t, q: (q + np.array([1e-4 * t * t, 0.0])).reshape((1, 2)),
    "constraint_rate": lambda t, q: np.array([1e-4 * t * t]),
    "gamma": lambda t, q, v: np.array([-(1.0 + 1e-4 * t * t) * (v[0] * v[0] + v[1] * v[1])]),
}


@pytest.mark.parametrize("kind", list(WRONG))
def test_an_error_that_is_nothing_at_the_start_is_seen_later(kind):
    system = pendulum(**{kind: WRONG[kind]})
    exact = exact_derivatives(system)
    assert exact.difference(system, generic_states([(0.0, *STATE[1:])])) is None
    assert exact_derivatives(pendulum()).difference(pendulum(), generic_states([STATE])) is None
    assert f"{kind} of" in exact.difference(system, generic_states([STATE]))
    result = solve_dae(system, (0.0, 1.0), [0.6, -0.8], [0.0, 0.0], rtol=1e-6, atol=1e-6)
    assert result.status.name == "WRONG_DERIVATIVE" and f"{kind} of" in result.message


def test_a_run_that_goes_where_none_was_is_compared_there():
    """A gamma that is wrong from 1 s on, which has no kink that could be seen before."""

    def gamma(t, q, v):
        return np.array([-(v[0] * v[0] + v[1] * v[1]) * (1.0 + 1e-5 * max(t - 1.0, 0.0) ** 3)])

    def end(t1):
        return solve_dae(system, (0.0, t1), [0.6, -0.8], [0.0, 0.0], "DOP853", 1e-8, 1e-8).status.name

    system = pendulum(compile=True, gamma=gamma)
    assert [end(0.9) for _ in range(4)] == ["REACHED_END"] * 4 and end(4.0) == "WRONG_DERIVATIVE"
    assert end(4.0) == "WRONG_DERIVATIVE"  # what was wrong is not taken in
