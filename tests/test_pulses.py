"""Pulses of a force, again and again in a long run: none is passed over, or the run says so."""

from itertools import pairwise

import numpy as np
import pytest
from scipy.linalg import expm

import twoloop.solve
from tests import problems
from twoloop import ConstrainedSystem, ConstraintWarning, Integrator, Status, ensemble, solve_dae

MASS, STIFFNESS, DAMPING = 1.04, 4.0, 0.3
TABLE_AT = np.linspace(0.0, 60.0, 121)
TABLE = np.sin(0.7 * TABLE_AT) + 0.3 * np.sin(2.1 * TABLE_AT)


def pulsed(t, q, v, p):
    push = 5.0 if (t - p[2]) % p[0] < p[1] else 0.0
    return np.array([push - STIFFNESS * q[0] - DAMPING * v[0]])


def slide(period, width, begin=0.0, compile=True):
    given = {"n_q": 1, "n_c": 0, "mass": np.array([[MASS]]), "parameters": [period, width, begin]}
    return ConstrainedSystem.from_python(force=pulsed, compile=compile, **given)


def end(period, width, begin, t_end):
    """Position and velocity at the end, from rest, from one edge of a pulse to the next."""
    edges = np.add.outer(begin + period * np.arange(-1, t_end // period + 1), [0.0, width]).ravel()
    edges = np.concatenate([[0.0], edges[(edges > 0.0) & (edges < t_end)], [t_end]])
    state = np.zeros(2)
    for t0, t1 in pairwise(edges.tolist()):
        push = 5.0 if (0.5 * (t0 + t1) - begin) % period < width else 0.0
        rest = np.array([push / STIFFNESS, 0.0])
        matrix = np.array([[0.0, 1.0], [-STIFFNESS / MASS, -DAMPING / MASS]])
        state = rest + expm(matrix * (t1 - t0)) @ (state - rest)
    return state


def off(result, *pulses):
    """Errors at the end over the tolerance."""
    state = np.array([result.q[0, -1], result.v[0, -1]])
    return np.abs(state - end(*pulses, result.t[-1])).max() / result.rtol


@pytest.mark.parametrize("method", ["auto", "DOP853", "Adams", "RadauIIA5", "TRBDF2"])
@pytest.mark.parametrize(("width", "t_end", "tolerance"), [(0.1, 200.0, 1e-5), (0.02, 50.0, 1e-5)])
def test_pulses_shorter_than_steps_are_not_passed_over(method, width, t_end, tolerance):
    result = solve_dae(slide(1.0, width), (0.0, t_end), [0.0], [0.0], method, tolerance, tolerance)
    assert result.success and off(result, 1.0, width, 0.0) < 100.0


def test_nor_by_functions_in_python():
    result = solve_dae(slide(1.0, 0.02, 0.3, compile=False), (0.0, 30.0), [0.0], [0.0], rtol=1e-5, atol=1e-5)
    assert result.success and off(result, 1.0, 0.02, 0.3) < 100.0


def test_a_run_that_may_have_missed_some_says_so():
    """The first pulse falls into the short steps at the start, and no other is met."""
    run = slide(100.0, 2e-3, 3e-3), (0.0, 3000.0), [0.1], [0.0], "DOP853", 1e-6, 1e-6
    for _ in range(4):  # also by the arrays of the call before
        with pytest.warns(ConstraintWarning, match=r"change suddenly for 0\.002 s.*max_step, at most 0\.002"):
            result = solve_dae(*run)
        assert result.success and "Give max_step" in result.message


def test_repeated_calls_see_what_the_first_has_seen():
    system = slide(1.0, 0.02)
    results = [solve_dae(system, (0.0, 50.0), [0.0], [0.0], rtol=1e-5, atol=1e-5, t_eval=[50.0]) for _ in range(4)]
    assert off(results[0], 1.0, 0.02, 0.0) < 100.0
    for result in results[1:]:
        assert (result.q == results[0].q).all() and result.stats.n_accepted == results[0].stats.n_accepted


def test_a_run_is_made_again_up_to_an_event():
    at_end = problems.njit(lambda t, q, v: t - 40.5)
    at_end.terminal = True
    pulses = 1.0, 0.02, 0.0
    result = solve_dae(slide(*pulses), (0.0, 80.0), [0.0], [0.0], rtol=1e-5, atol=1e-5, events=at_end)
    assert result.status is Status.EVENT and result.t_events[0].size == 1 and off(result, *pulses) < 100.0


SMOOTH = {
    "steep": lambda t, q, v: np.array([np.tanh(5.0 * np.sin(3.0 * t)), -9.81]),
    "bent": lambda t, q, v: np.array([abs(np.sin(3.0 * t)), -9.81]),
    "table": lambda t, q, v: np.array([np.interp(t, TABLE_AT, TABLE), -9.81]),
    "gust": lambda t, q, v: np.array([20.0 * np.exp(-(((t - 5.0) / 0.3) ** 2)), -9.81]),
    "switch": lambda t, q, v: np.array([2.0 if t > 3.3 else 0.0, -9.81]),
    "square": lambda t, q, v: np.array([1.0 if np.sin(3.0 * t) > 0.0 else -1.0, -9.81]),
}


EACH = ("auto", "Adams", "RadauIIA5")
FAST = problems.some_of(SMOOTH, EACH, 2)


@pytest.mark.parametrize(
    ("name", "method"),
    [
        pytest.param(name, method, marks=[pytest.mark.slow] * ((name, method) not in FAST))
        for name in SMOOTH
        for method in EACH
    ],
)
def test_no_run_is_made_again_without_need(name, method, monkeypatch):
    made = []
    monkeypatch.setattr(twoloop.solve, "closer", made.append)
    system = problems.pendulum(force=SMOOTH[name], compile=True)
    for tolerance in (1e-4, 1e-8):
        assert solve_dae(system, (0.0, 60.0), [0.8, -0.6], [0.0, 0.0], method, tolerance, tolerance).success
    assert not made


def test_looks_are_eight_calls_of_the_force_a_step():
    calls = []

    def force(t, q, v):
        calls.append(t)
        return np.array([np.exp(-t), -9.81])

    result = solve_dae(problems.pendulum(force=force), (0.0, 10.0), [0.8, -0.6], [0.0, 0.0], "Adams")
    looks = len(calls) - result.stats.n_evaluations
    assert result.success and looks < 9 * len(result.h) + 2300  # and along the way


GUSTY = "period", "width", "begin", "method", "tolerance"  # of gusts 5 exp(-(t / width)^2)
MET_BY_SHORT_STEPS = [
    (5.0, 2e-3, 0.01, "Adams", 1e-6),
    (5.0, 2e-3, 0.01, "DOP853", 1e-7),
    (2.5, 1e-3, 0.003, "DOP853", 1e-6),
    (2.5, 1e-3, 0.003, "auto", 1e-7),
]


def gusts(t, q, v, p):
    since = (t - p[2] + 0.5 * p[0]) % p[0] - 0.5 * p[0]
    return np.array([5.0 * np.exp(-((since / p[1]) ** 2)) - STIFFNESS * q[0] - DAMPING * v[0]])


def gusty(period, width, begin, compile=True):
    given = {"n_q": 1, "n_c": 0, "mass": np.array([[MASS]]), "parameters": [period, width, begin]}
    return ConstrainedSystem.from_python(force=gusts, compile=compile, **given)


def after_gusts(period, width, begin, t_end, n=100):
    """Position and velocity at the end: each gust leaves a vibration, as the integral of its force has it."""
    rate = np.roots([MASS, DAMPING, STIFFNESS])[0]
    left = t_end - np.arange(begin, t_end, period)[:n]
    each = 5.0 * width * np.sqrt(np.pi) * np.exp(rate * left + (0.5 * rate * width) ** 2)
    known = each.sum() / (MASS * rate.imag)
    return np.array([known.imag, (rate * known).imag])


@pytest.mark.parametrize(GUSTY, MET_BY_SHORT_STEPS)
def test_gusts_that_short_steps_met_are_not_passed_over_later(period, width, begin, method, tolerance):
    """To closer looks these are smooth, and so none of their flanks was found, nor were the gusts that followed."""
    result = solve_dae(gusty(period, width, begin), (0.0, 49.0), [0.0], [0.0], method, tolerance, tolerance)
    known = after_gusts(period, width, begin, 49.0)
    assert result.success and np.abs([result.q[0, -1], result.v[0, -1]] - known).max() < 1e3 * tolerance


N_GUSTS = 5


def some_gusts(t, q, v, p):
    push = 0.0
    for k in range(N_GUSTS):
        push = push + 5.0 * np.exp(-(((t - p[2] - k * p[0]) / p[1]) ** 2))
    return np.array([push - STIFFNESS * q[0] - DAMPING * v[0]])


def many_runs(P, method, compile=True):
    """Of runs over 60 s, their errors over the tolerances, too."""
    given = {"n_q": 1, "n_c": 0, "mass": np.array([[MASS]]), "parameters": P[0]}
    system = ConstrainedSystem.from_python(force=some_gusts, compile=compile, **given)
    runs = ensemble(system, (0.0, 60.0), [0.0], [0.0], parameters=P, rtol=1e-7, atol=1e-7, method=method)
    assert runs.success.all()
    known = np.array([after_gusts(*p, 60.0, N_GUSTS) for p in P])
    return runs, np.abs(np.column_stack([runs.q[:, 0, -1], runs.v[:, 0, -1]]) - known).max() / 1e-7


# functions in Python are called as those that are compiled, by whichever method
@pytest.mark.parametrize(
    ("compile", "method"),
    [
        *((True, method) for method in ("auto", "Taylor", "DOP853")),
        (False, "auto"),
        *(pytest.param(False, method, marks=pytest.mark.slow) for method in ("Taylor", "DOP853")),
    ],
)
def test_runs_in_lanes_that_meet_short_gusts_are_made_singly(compile, method):
    P = np.array([[9.0, 0.1, 2.0], [9.0, 0.02, 2.01], [10.0, 0.01, 3.01], [9.0, 0.1, 2.1], [11.0, 0.003, 3.0]])
    runs, off = many_runs(P, method, compile)
    assert off < 1e3 and runs.singly.tolist() == [True, True, True, False, True]
    assert all("so short a time" in runs.reasons[k] for k in (1, 2, 4))


def test_lanes_keep_gusts_that_last_longer_than_two_looks():
    runs, off = many_runs(np.array([[9.0, width, 5.0] for width in (0.2, 0.3, 0.1, 0.07, 0.15)]), "auto")
    assert off < 1e2 and runs.singly.tolist() == [True, False, False, False, False]


@pytest.mark.filterwarnings("ignore:.*change suddenly for 0.02 s:twoloop.ConstraintWarning")  # by the steps of Adams
@pytest.mark.parametrize("method", ["auto", "DOP853", "Adams"])
def test_samples_that_meet_pulses_are_made_again(method):
    integrator = Integrator(slide(1.0, 0.02, 0.3), method, 1e-6, 1e-6)
    integrator.start(0.0, [0.0], [0.0])
    for _ in range(150):
        state = integrator.step(1.0)
    known = end(1.0, 0.02, 0.3, state.t)
    assert np.abs([state.q[0], state.v[0]] - known).max() < 1e-4
    assert (np.diff(integrator.result().t) == 1.0).all()


def test_samples_that_may_have_missed_pulses_say_so():
    """What is short is met in the second sample; the first had looks that are as far apart."""
    integrator = Integrator(slide(100.0, 3e-3, 19.99), "DOP853", 1e-6, 1e-6)
    integrator.start(0.0, [0.1], [0.0])
    integrator.step(10.0)
    with pytest.warns(ConstraintWarning, match=r"change suddenly for 0\.003 s") as said:
        integrator.step(10.0)
    assert said[0].filename == __file__


def two_pulses(t, q, v, p):
    push = p[1] if p[0] <= t < p[0] + 2e-3 else 0.0
    push += p[2] if p[0] + 6e-3 <= t < p[0] + 8e-3 else 0.0
    return np.array([push - STIFFNESS * q[0] - DAMPING * v[0]])


@pytest.mark.parametrize("method", ["auto", "Adams", "BDF", "TRBDF2", "RadauIIA5"])
def test_a_pulse_is_found_ahead_of_a_much_larger_one(method):
    """Beside the large one the small one was no sudden change, and steps went from before it to between both."""
    given = {"n_q": 1, "n_c": 0, "mass": np.array([[MASS]]), "parameters": [1.0, 20.0, -300.0]}
    system = ConstrainedSystem.from_python(force=two_pulses, compile=True, **given)
    matrix = np.array([[0.0, 1.0], [-STIFFNESS / MASS, -DAMPING / MASS]])
    for begin in np.linspace(1.0, 1.1, 15):
        result = solve_dae(system.with_parameters([begin, 20.0, -300.0]), (0.0, 3.0), [0.0], [0.0], method, 1e-6, 1e-6)
        state = np.zeros(2)
        for push, span in ((20.0, 2e-3), (0.0, 4e-3), (-300.0, 2e-3), (0.0, 3.0 - begin - 8e-3)):
            rest = np.array([push / STIFFNESS, 0.0])
            state = rest + expm(matrix * span) @ (state - rest)
        assert result.success and np.abs([result.q[0, -1], result.v[0, -1]] - state).max() < 1e-3
