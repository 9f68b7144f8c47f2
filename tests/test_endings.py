"""How runs end early: interrupted, at a standstill, out of time, by values that are not finite."""

import re
import signal
import sys
import threading
import time
import warnings

import numpy as np
import pytest

from tests.problems import event, pendulum, quick, run, violations, worst
from tests.processes import run_python
from twoloop import DOP853, Integrator, Status, mechanisms, solve_dae, sweep
from twoloop.run.signals import SignalHandlers

HORIZONTAL = ([-1.0, 0.0], [0.0, 0.0])


def test_other_threads_run_beside_the_compiled_integrator():
    problem = mechanisms.four_bar()
    solve_dae(problem.system, (0.0, 0.1), problem.q0, problem.v0)
    ended = threading.Event()
    runs = []

    def integrate():
        runs.append(solve_dae(problem.system, (0.0, 100.0), problem.q0, problem.v0, "Gauss12", t_eval=[100.0]))
        ended.set()

    counted = 0
    thread = threading.Thread(target=integrate)
    thread.start()
    while not ended.is_set():
        counted += 1
        time.sleep(0.0)
    thread.join()
    # with the lock held, this thread would run between chunks only, about ten times; without it, thousands of times
    assert runs[0].success and counted > 100


def test_a_time_limit_keeps_what_there_is():
    result = solve_dae(pendulum(), (0.0, 1e9), *HORIZONTAL, time_limit=0.2)
    assert result.status is Status.TIME_LIMIT and "time_limit" in result.message
    assert result.t.size == result.stats.n_accepted + 1 > 5
    assert solve_dae(pendulum(), (0.0, 0.1), *HORIZONTAL, time_limit=60.0).success


def test_a_time_limit_ends_slow_steps():
    """A chunk has dozens of steps of eleven evaluations each; without a check within it all are made."""
    calls = []

    def force(t, q, v):
        calls.append(t)
        time.sleep(0.005)
        return np.array([0.0, -9.81])

    start = (0.0, 100.0), *HORIZONTAL
    result = solve_dae(pendulum(force=force), *start, "DOP853", time_limit=0.2, check_derivatives=False)
    assert result.status is Status.TIME_LIMIT and result.t.size == result.stats.n_accepted + 1
    assert len(calls) < 200


def stiffening_pendulum(stiffness):
    """A pendulum whose rod is met by a stiff spring after 0.5 s: an explicit method then needs tiny steps."""

    def force(t, q, v):
        push = stiffness * max(t - 0.5, 0.0) * np.array([q[1], -q[0]]) * q[0]
        return np.array([0.0, -9.81]) + push

    return pendulum(force=force, constant_mass=True, compile=True)


@pytest.mark.slow
def test_a_standstill_is_a_status():
    result = solve_dae(stiffening_pendulum(1e16), (0.0, 100.0), *HORIZONTAL, "DOP853", 1e-6, 1e-6)
    assert result.status is Status.STAGNATED and 0.5 < result.t[-1] < 1.0
    assert "steps were" in result.message and "steps of up to" in result.message and "max_steps" in result.message
    assert result.stats.n_accepted < 100_000


TOO_FAST = ([-1.0, 0.0], [0.0, 1e12])


@pytest.mark.parametrize("compiled", [False, True])
@pytest.mark.parametrize("method", quick(["auto", "DOP853", "Taylor", "Adams"]))
def test_a_motion_that_is_too_fast_for_the_run_ends(method, compiled):
    result = solve_dae(pendulum(compile=True), (0.0, 10.0), *TOO_FAST, method, compiled=compiled)
    assert result.status is Status.STAGNATED and result.t[-1] < 1e-5, result.message
    assert 20_000 <= result.stats.n_accepted < 50_000
    assert "steps of up to" not in result.message and "units" in result.message and "max_steps" in result.message


@pytest.mark.parametrize("method", quick(["RadauIIA5", "Gauss8", "TRBDF2", "BDF", "Newmark"]))
def test_so_it_does_with_an_implicit_method(method):
    result = solve_dae(pendulum(compile=True), (0.0, 10.0), *TOO_FAST, method, 1e-4, 1e-4, t_eval=[10.0])
    assert result.status is Status.STAGNATED and result.stats.n_accepted < 50_000, result.message


def test_a_step_that_is_too_small_for_the_run_ends():
    result = solve_dae(pendulum(compile=True), (0.0, 10.0), *HORIZONTAL, "DOP853", step_size=1e-12)
    assert result.status is Status.STAGNATED and "larger step_size" in result.message


KINDS = ("mass", "force", "constraint", "jacobian", "gamma")
METHODS = ("Gauss12", "SunRadau5", "PaperIRK", "Newmark", "BDF", "DOP853", "Adams", "RadauIIA5")


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(("method", "bad"), quick([("Gauss12", np.inf), *((method, np.nan) for method in METHODS)], 3))
def test_the_callback_is_named_with_the_time_of_the_evaluation(kind, method, bad):
    good = pendulum()

    def ending(t, *state):
        value = getattr(good, kind)(t, *state)
        return value if t < 0.3 else np.full_like(value, bad)

    result = solve_dae(pendulum(**{kind: ending}), (0.0, 1.0), *HORIZONTAL, method, 1e-5, 1e-5)
    assert result.status is Status.NOT_FINITE and not result.success, result.message
    assert f"{kind} of 'pendulum' returned a value that is not finite at t = 0.3" in result.message
    assert f"t = {result.t[-1]:.10g}" in result.message
    assert 0.2 < result.t[-1] <= 0.3 and result.t.size == result.stats.n_accepted + 1 > 3
    assert np.isfinite(result.q).all() and violations(good, result)[0] < 1e-9


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


# --- a result is what the run was: its parameters stay, and what Ctrl-C or an early event leaves is a result, too
pytestmark = pytest.mark.usefixtures("interruptible")
START = ([0.0, -1.0], [3.0, 0.0])
OTHER = [1.0, 2.0, 1.5, 2.9]  # lengths of the default four-bar, its ground a little shorter


def test_parameters_cannot_be_written_to(default_four_bar):
    result = run(default_four_bar, 0.5, dense_output=True)
    before, system = result.sol(0.31), default_four_bar.system
    known = (before.q.copy(), before.lam.copy())
    with pytest.raises(ValueError, match="read-only"):
        system.parameters[1] = 0.9
    with pytest.raises(ValueError, match="WRITEABLE"):
        system.parameters.setflags(write=True)
    with pytest.raises(AttributeError, match=r"cannot be changed, as results refer to them: .*with_parameters\(p\)"):
        system.parameters = OTHER
    system.with_parameters(OTHER)
    after = result.sol(0.31)
    assert (after.q == known[0]).all() and (after.lam == known[1]).all()


@pytest.mark.parametrize("options", quick([{}, {"dense_output": True}, {"method": "BDF"}, {"step_size": 0.125}], 2))
def test_an_event_before_the_first_output_ends_the_run(options):
    early = event(lambda t, q, v: t - 0.2, terminal=True)
    result = solve_dae(pendulum(), (0.0, 2.0), *START, t_eval=[0.5, 1.0], events=early, **options)
    assert result.status is Status.EVENT and abs(result.t_events[0][0] - 0.2) < 1e-12
    assert result.t.size == 0 and result.q.shape == (2, 0) and result.lam.shape == (1, 0)
    if result.sol is not None:
        assert abs(result.sol.t_max - 0.2) < 1e-12


class Counted:
    """A function that calls something at one of its calls, or at all from it on."""

    def __init__(self, function, **attributes):
        self.function, self.n, self.at, self.always, self.do = function, 0, np.inf, False, None
        vars(self).update(attributes)

    def set(self, at=np.inf, always=False, do=None):
        self.n, self.at, self.always, self.do = 0, at, always, do

    def __call__(self, *arguments):
        self.n += 1
        if self.n == self.at or (self.always and self.n > self.at):
            self.do()
        return self.function(*arguments)


def interrupt():
    raise KeyboardInterrupt


def pressed():
    signal.raise_signal(signal.SIGINT)


END = 0.4  # s
COUNTED = {
    "force": Counted(lambda t, q, v: np.array([0.0, -9.81])),
    "jacobian": Counted(lambda t, q: q.reshape((1, 2))),
    "gamma": Counted(lambda t, q, v: np.array([-(v @ v)])),
    "event": Counted(lambda t, q, v: q[0] - 0.5),
    "terminal": Counted(lambda t, q, v: q[0] - 1e3, terminal=True),
}
OPTIONS = {
    "steps": {},
    "outputs": {"t_eval": np.linspace(0.0, END, 6)},
    "events": {"events": [COUNTED["event"]], "dense_output": True},
    "outputs and an end": {"events": [COUNTED["event"], COUNTED["terminal"]], "t_eval": [0.02, 0.2, 0.36]},
}


def check_part(part, full):
    """A result of Ctrl-C is the beginning of the whole one, and of one length throughout."""
    n = part.t.size
    assert part.status is Status.INTERRUPTED and not part.success and "Interrupted" in part.message
    assert part.q.shape == part.v.shape == part.a.shape == (2, n) and part.lam.shape == (1, n)
    assert (part.t == full.t[:n]).all() and worst_or_zero(part.q, full.q[:, :n]) < 1e-6
    there = np.isfinite(part.a).all(axis=0)
    assert worst_or_zero(part.a[:, there], full.a[:, :n][:, there]) < 1e-4 and part.h.size == part.stats.n_accepted
    for found, known in zip(part.t_events or [], full.t_events or [], strict=True):
        assert worst_or_zero(found, known[: found.size]) < 1e-6
    if part.sol is not None and n:
        assert part.sol.t_max == part.t[-1]
        inside = (full.t_events[0] > 0.0) & (full.t_events[0] <= part.t[-1])
        assert (part.t_events[0] > 0.0).sum() == inside.sum()  # none is missing of the time that is told of


def worst_or_zero(a, b):
    return worst(a, b) if np.size(a) else 0.0


@pytest.mark.parametrize(
    ("method", "options"), quick([*(("auto", options) for options in OPTIONS), ("SunRadau5", "outputs and an end")])
)
def test_ctrl_c_in_any_function_at_any_call_returns_what_there_is(method, options):
    plain = {kind: COUNTED[kind] for kind in ("force", "jacobian", "gamma")}
    system = pendulum(**plain)

    def solve():
        with warnings.catch_warnings(action="ignore"):
            return solve_dae(system, (0.0, END), *START, method, 1e-5, 1e-5, **OPTIONS[options])

    solve()  # derivatives are checked once
    for each in COUNTED.values():
        each.set()
    full = solve()
    assert full.success and ("dense_output" not in OPTIONS[options] or full.t_events[0].size)
    calls = {name: each.n for name, each in COUNTED.items()}
    for k, (name, n) in enumerate(calls.items()):
        for at in {1, 2, n // 2, n - 20, n - 1, n}:
            for each in COUNTED.values():
                each.set()
            if not 1 <= at <= n:
                continue
            COUNTED[name].set(at, always=at % 2 == 0, do=(interrupt, pressed)[(k + at // 2) % 2])
            part = solve()
            for each in COUNTED.values():
                each.set()
            check_part(part, full)


def test_a_handler_of_the_users_own_stays():
    heard = []
    before = signal.signal(signal.SIGINT, lambda number, frame: heard.append(number))
    try:
        force = Counted(lambda t, q, v: np.array([0.0, -9.81]))
        force.set(50, do=pressed)
        result = solve_dae(pendulum(force=force), (0.0, 1.0), *START)
    finally:
        signal.signal(signal.SIGINT, before)
    assert result.success and heard == [signal.SIGINT]


class Alarm(ValueError): ...  # the errors of callbacks and of runs in sweeps are handled


# made beforehand, because checks of arguments convert errors, also those of handlers
NEW_PROBLEMS = [mechanisms.four_bar() for _ in range(60)]


def start(problem):
    Integrator(problem.system).start(0.0, problem.q0, problem.v0)


WORK = {
    "runs": lambda system: solve_dae(system, (0.0, 10.0), *START, "RadauIIA5", 1e-6, 1e-6),
    "samples": lambda system: [(sampled := Integrator(system)).start(0.0, *START), sampled.step(0.1)],
    "compiled": lambda system: run(mechanisms.four_bar(), 20.0),
    "starts": lambda system: start(NEW_PROBLEMS.pop() if NEW_PROBLEMS else mechanisms.four_bar()),
    "sweeps": lambda system: sweep(mechanisms.pendulum, [{"start": -1.0}] * 2, t_span=(0.0, 50.0), parallel="threads"),
    "dense": lambda system: solve_dae(system, (0.0, 1.0), *START, dense_output=True).sol(np.linspace(0.0, 1.0, 300)),
}


@pytest.mark.skipif(sys.platform == "win32", reason="no timers that send signals")
@pytest.mark.parametrize(("error", "after"), [(Alarm, 0.003), (KeyboardInterrupt, 0.0171), (Alarm, 0.0533)])
@pytest.mark.parametrize("work", WORK.values(), ids=WORK)
def test_an_exception_of_a_signal_handler_arrives_as_itself(work, error, after):
    """Handlers run at any instruction of Python, also at those of numba between pieces of machine code."""

    def ring(number, frame):
        raise error

    before, system = signal.signal(signal.SIGALRM, ring), pendulum()
    try:
        with pytest.raises(error):
            signal.setitimer(signal.ITIMER_REAL, after)
            while True:
                work(system)
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)  # a signal without a handler would end this process later
        signal.signal(signal.SIGALRM, before)


def test_a_handler_that_compilation_delays_is_called_although_others_were_never_restored():
    before = signal.signal(signal.SIGINT, lambda number, frame: 1 / 0)
    try:
        SignalHandlers()  # as an exception between two instructions may leave them
        with pytest.raises(ZeroDivisionError), SignalHandlers():
            exec("signal.raise_signal(signal.SIGINT)", {"__name__": "numba", "signal": signal})
    finally:
        signal.signal(signal.SIGINT, before)


def test_handlers_that_were_never_restored_delay_no_signals_after_their_function():
    def leave():
        SignalHandlers()

    before = signal.signal(signal.SIGINT, lambda number, frame: 1 / 0)
    try:
        leave()
        with pytest.raises(ZeroDivisionError):
            exec("signal.raise_signal(signal.SIGINT)", {"__name__": "numba", "signal": signal})
    finally:
        signal.signal(signal.SIGINT, before)


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="signals to oneself")
def test_real_signals_while_compiled_code_python_callbacks_and_events_run():
    run_python("""
        import os, signal, threading
        from tests.problems import pendulum
        from twoloop import solve_dae
        
        def interrupted(system, *start, after, **options):
            solve_dae(system, (0.0, 0.1), *start)
            threading.Timer(after, os.kill, (os.getpid(), signal.SIGINT)).start()
            result = solve_dae(system, (0.0, 1e9), *start, check_derivatives=False, time_limit=20.0, **options)
            assert result.status.name == "INTERRUPTED", result.message
            return result

        signal.signal(signal.SIGINT, signal.default_int_handler)
        linkage, system = four_bar(), pendulum()
        compiled = interrupted(linkage.system, linkage.q0, linkage.v0, after=0.3, t_eval=[1e9])
        assert compiled.stats.n_accepted > 100
        for k, events in enumerate((None, lambda t, q, v: q[0], None, lambda t, q, v: q[0])):
            interrupted(system, [0.0, -1.0], [3.0, 0.0], after=0.1 + 0.0137 * k, events=events)
        solution = solve_dae(system, (0.0, 1.0), [0.0, -1.0], [3.0, 0.0], dense_output=True).sol
        for k in range(5):
            threading.Timer(0.1 + 0.0137 * k, os.kill, (os.getpid(), signal.SIGINT)).start()
            try:
                while True:
                    solution([0.001 * i for i in range(1000)])
            except KeyboardInterrupt:
                pass
    """)


# --- runs whose steps stability limits say so; those whose steps accuracy limits do not
STIFF = "The problem looks stiff"
EXPLICIT = pytest.mark.parametrize("method", ["Adams", "DOP853"])


def run_of(problem, end, method, tol, **options):
    return solve_dae(problem.system, (0.0, end), problem.q0, problem.v0, method, tol, tol, **options)


BEAM, GOVERNOR = (mechanisms.moderately_stiff_beam, 1e-2, "vibrations of 3.*e.04 rad/s"), (mechanisms.governor, 1e-4)
STIFF_RUNS = [(*BEAM, 0.1, "Adams"), (*GOVERNOR, "a decay of .*e.03 1/s", 2.0, "DOP853")]
STIFF_RUNS += [(*BEAM, 0.3, "DOP853"), (*BEAM, 0.3, DOP853("restored")), (*GOVERNOR, "a decay", 2.0, "Adams")]


@pytest.mark.parametrize(("make", "tol", "what", "end", "method"), quick(STIFF_RUNS, 2))
def test_steps_at_the_limit_of_stability_are_said_to_be(make, end, tol, method, what):
    result = run_of(make(), end, method, tol)
    assert result.success and result.message.count(STIFF) == 1
    assert re.search(what, result.message), result.message
    for name in ("'auto'", "'RadauIIA9'", "'TRBDF2'"):
        assert name in result.message


SMOOTH = [(mechanisms.four_bar, 10.0), (mechanisms.double_pendulum, 10.0), (mechanisms.heavy_top, 2.0)]
SMOOTH += [(lambda: mechanisms.closed_chain(10), 2.0), (mechanisms.bricard, 10.0), (mechanisms.rolling_disc, 5.0)]
SMOOTH += [(mechanisms.spatial_four_bar, 5.0), (mechanisms.spatial_slider_crank, 5.0)]


@EXPLICIT
@pytest.mark.parametrize("tol", quick([1e-4, 1e-8, 1e-12]))
@pytest.mark.parametrize(("make", "end"), quick(SMOOTH, 3))
@pytest.mark.filterwarnings("ignore::twoloop.ConstraintWarning")
def test_smooth_motion_is_not_called_stiff(make, end, tol, method):
    never = event(lambda t, q, v: 1.0, terminal=True)  # has Python look at a run every 16 attempts
    result = run_of(make(), end, method, tol, events=never)
    assert result.success and STIFF not in result.message


def test_methods_for_stiff_motion_and_the_default_say_nothing():
    for method in ("auto", "TRBDF2", "RadauIIA5", "Gauss8"):
        assert STIFF not in run_of(mechanisms.moderately_stiff_beam(), 0.1, method, 1e-3).message


@pytest.mark.parametrize("method", quick(["DOP853", "Adams"]))
def test_a_stiff_spring_in_python_is_seen(method, monkeypatch):
    """A point on a circle, tied to its lowest position by a spring of 1e4 rad/s in which next to no motion is.

    What is said is the same on a machine that is too busy for long chunks of steps.
    """
    stiff = pendulum(
        n_q=3,
        mass=np.eye(3),
        force=lambda t, q, v: np.array([0.0, -9.81, -1e8 * (q[2] - np.sin(t)) - np.sin(t)]),
        jacobian=lambda t, q: np.array([[q[0], q[1], 0.0]]),
    )
    start = ([1.0, 0.0, 0.0], [0.0, 0.0, 1.0])
    messages = []
    for allowed in (0.0, np.inf):  # s of a chunk, from which on chunks do not grow
        monkeypatch.setattr("twoloop.run.loop.CHUNK_TIME", allowed)
        result = solve_dae(stiff, (0.0, 0.3), *start, method=method, rtol=1e-4, atol=1e-4)
        messages.append(result.message)
    found = re.search(r"vibrations of (\S+) rad/s", result.message)
    assert result.success and found and float(found[1]) == pytest.approx(1e4, rel=0.05) and messages[0] == messages[1]
