"""How runs end early: interrupted, at a standstill, out of time, by values that are not finite."""

import threading
import time

import numpy as np
import pytest

from tests.problems import event, pendulum, violations
from twoloop import Status, solve_dae
from twoloop.mechanisms import four_bar

START = ([-1.0, 0.0], [0.0, 0.0])


# --- beside other threads; Ctrl-C: tests/test_results_stay.py
def test_other_threads_run_beside_the_compiled_integrator():
    problem = four_bar()
    solve_dae(problem.system, (0.0, 0.1), problem.q0, problem.v0)
    ended = threading.Event()
    runs = []

    def integrate():
        runs.append(solve_dae(problem.system, (0.0, 300.0), problem.q0, problem.v0, "Gauss12", t_eval=[300.0]))
        ended.set()

    counted = 0
    thread = threading.Thread(target=integrate)
    thread.start()
    while not ended.is_set():
        counted += 1
        time.sleep(0.0)
    thread.join()
    # with the lock held, this thread would run between chunks only, a few dozen times
    assert runs[0].success and counted > 1000


# --- time limit
def test_a_time_limit_keeps_what_there_is():
    result = solve_dae(pendulum(), (0.0, 1e9), *START, time_limit=0.2)
    assert result.status is Status.TIME_LIMIT and "time_limit" in result.message
    assert result.t.size == result.stats.n_accepted + 1 > 5
    assert solve_dae(pendulum(), (0.0, 0.1), *START, time_limit=60.0).success


# --- standstill
def stiffening_pendulum(stiffness):
    """A pendulum whose rod is met by a stiff spring after 0.5 s: an explicit method then needs tiny steps."""

    def force(t, q, v):
        push = stiffness * max(t - 0.5, 0.0) * np.array([q[1], -q[0]]) * q[0]
        return np.array([0.0, -9.81]) + push

    return pendulum(force=force, constant_mass=True, compile=True)


def test_a_standstill_is_a_status():
    result = solve_dae(stiffening_pendulum(1e16), (0.0, 100.0), *START, "DOP853", 1e-6, 1e-6)
    assert result.status is Status.STAGNATED and 0.5 < result.t[-1] < 1.0
    assert "steps were" in result.message and "steps of up to" in result.message and "max_steps" in result.message
    assert result.stats.n_accepted < 100_000


TOO_FAST = ([-1.0, 0.0], [0.0, 1e12])


@pytest.mark.parametrize("compiled", [False, True])
@pytest.mark.parametrize("method", ["auto", "DOP853", "Taylor", "Adams"])
def test_a_motion_that_is_too_fast_for_the_run_ends(method, compiled):
    result = solve_dae(pendulum(compile=True), (0.0, 10.0), *TOO_FAST, method, compiled=compiled)
    assert result.status is Status.STAGNATED and result.t[-1] < 1e-5, result.message
    assert 20_000 <= result.stats.n_accepted < 50_000
    assert "steps of up to" not in result.message and "units" in result.message and "max_steps" in result.message


@pytest.mark.parametrize("method", ["Gauss8", "RadauIIA5", "TRBDF2", "BDF", "Newmark", "PaperNewmark"])
def test_so_it_does_with_an_implicit_method(method):
    result = solve_dae(pendulum(compile=True), (0.0, 10.0), *TOO_FAST, method, 1e-4, 1e-4, t_eval=[10.0])
    assert result.status is Status.STAGNATED and result.stats.n_accepted < 50_000, result.message


def test_a_step_that_is_too_small_for_the_run_ends():
    result = solve_dae(pendulum(compile=True), (0.0, 10.0), *START, "DOP853", step_size=1e-12)
    assert result.status is Status.STAGNATED and "larger step_size" in result.message


def test_what_ends_before_the_end_may_be_far_from_it():
    far, start = (0.0, 1e11), ([-1.0, 0.0], [0.0, 0.0])
    ended = solve_dae(pendulum(compile=True), far, *start, "DOP853", time_limit=0.5, compiled=False)
    assert ended.status is Status.TIME_LIMIT
    late = event(lambda t, q, v: t - 1e3, terminal=True)
    assert solve_dae(pendulum(compile=True), far, *start, "DOP853", max_step=0.02, events=late).status is Status.EVENT


def test_short_steps_for_a_while_are_no_standstill():
    # 50 thousand steps of even length, and a phase of much shorter ones that the rest of the run can afford
    even = solve_dae(pendulum(compile=True), (0.0, 50.0), *START, "DOP853", max_step=1e-3)
    assert even.success and even.stats.n_accepted >= 50_000
    kicked = solve_dae(stiffening_pendulum(1e9), (0.0, 0.52), *START, "DOP853", 1e-4, 1e-4)
    assert kicked.success, kicked.message


def test_a_parallelogram_is_left_or_ends_with_a_status_soon():
    problem = four_bar((1.5423, 1.7303, 1.5423), 1.7303, 0.39914, 1)
    for method in ("DOP853", "SunRadau5", "Gauss12", "BDF"):
        result = solve_dae(problem.system, (0.0, 2.0), problem.q0, problem.v0, method, 1e-10, 1e-10)
        # a standstill is seen after 20,000 such steps, or nearly twice as many
        assert result.stats.n_accepted < 65_000
        if not result.success:
            assert "close to losing rank" in result.message and "singular" in result.message


# --- values that are not finite
KINDS = ("mass", "force", "constraint", "jacobian", "gamma")
METHODS = ("Gauss12", "SunRadau5", "PaperIRK", "Newmark", "BDF", "DOP853", "Adams", "RadauIIA5")


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(("method", "bad"), [*((method, np.nan) for method in METHODS), ("Gauss12", np.inf)])
def test_the_callback_is_named_with_the_time_of_the_evaluation(kind, method, bad):
    good = pendulum()

    def ending(t, *state):
        value = getattr(good, kind)(t, *state)
        return value if t < 0.3 else np.full_like(value, bad)

    result = solve_dae(pendulum(**{kind: ending}), (0.0, 1.0), *START, method, 1e-5, 1e-5)
    assert result.status is Status.NOT_FINITE and not result.success, result.message
    assert f"{kind} of 'pendulum' returned a value that is not finite at t = 0.3" in result.message
    assert f"t = {result.t[-1]:.10g}" in result.message
    assert 0.2 < result.t[-1] <= 0.3 and result.t.size == result.stats.n_accepted + 1 > 3
    assert np.isfinite(result.q).all() and violations(good, result)[0] < 1e-9


@pytest.mark.parametrize(("kind", "method"), [("force", "auto"), ("constraint", "Gauss12")])
def test_a_value_that_depends_on_the_position_is_named_too(kind, method):
    """At the start of the last step it is finite: only the evaluation itself knows."""
    good = pendulum()

    def ending(t, q, *v):
        return getattr(good, kind)(t, q, *v) * (1.0 if q[1] > -0.5 else np.nan)

    result = solve_dae(pendulum(**{kind: ending}), (0.0, 2.0), *START, method, 1e-6, 1e-6)
    assert result.status is Status.NOT_FINITE
    assert f"{kind} of 'pendulum' returned a value that is not finite at t = 0." in result.message


def test_a_message_names_no_cause_that_was_not_seen():
    # every callback returns finite numbers: it is the state that becomes too large
    system = pendulum(
        force=lambda t, q, v: np.array([0.0, 1e300 if t > 0.1 else 0.0]),
        constraint=lambda t, q: np.array([q[0]]),
        jacobian=lambda t, q: np.array([[1.0, 0.0]]),
        gamma=False,
    )
    result = solve_dae(system, (0.0, 1e6), [0.0, 0.0], [0.0, 0.0], "DOP853", 1e-3, 1e-3, max_steps=10_000)
    assert not result.success and " of 'pendulum' returned" not in result.message
