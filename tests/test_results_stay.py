"""A result is what the run was: its parameters stay, and what Ctrl-C or an early event leaves is a result, too."""

import signal
import sys
import warnings

import numba
import numpy as np
import pytest

from tests.compiled import unit_mass
from tests.problems import event, pendulum, run, worst
from tests.processes import run_python
from twoloop import ConstrainedSystem, Status, callback, consistent_state, solve_dae
from twoloop.mechanisms import four_bar
from twoloop.run.interrupts import CALLS_A_USER

pytestmark = pytest.mark.usefixtures("interruptible")
START = ([0.0, -1.0], [3.0, 0.0])
OTHER = [1.0, 2.0, 1.5, 2.9]  # lengths of the default four-bar, its ground a little shorter


# --- parameters
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


@pytest.mark.parametrize("compiled", [False, True])
def test_another_system_shares_the_callbacks_and_nothing_else(compiled):
    problem = four_bar()
    system = problem.system
    options = {"rtol": 1e-10, "atol": 1e-10, "compiled": compiled}
    first = solve_dae(system, (0.0, 0.2), problem.q0, problem.v0, **options)
    other = system.with_parameters(OTHER)
    assert other.functions.force is system.functions.force and system.parameters[3] == 3.0
    q, v = consistent_state(other, 0.0, problem.q0, problem.v0)
    second = solve_dae(other, (0.0, 0.2), q, v, **options)
    fresh = four_bar(OTHER[:3], OTHER[3]).system
    assert worst(second.q[:, -1], solve_dae(fresh, (0.0, 0.2), q, v, **options).q[:, -1]) < 1e-9
    again = solve_dae(system, (0.0, 0.2), problem.q0, problem.v0, **options)
    assert worst(again.q[:, -1], first.q[:, -1]) < 1e-12 < worst(second.q[:, -1], first.q[:, -1])


def test_the_energy_of_generated_equations_goes_along():
    sympy = pytest.importorskip("sympy")
    from twoloop.symbolic import from_lagrangian

    t, m, g = sympy.Symbol("t"), sympy.Symbol("m"), sympy.Symbol("g")
    q = x, y = [sympy.Function(name)(t) for name in "xy"]
    T = m * sum(each.diff(t) ** 2 for each in q) / 2
    made = from_lagrangian(T, m * g * y, [x**2 + y**2 - 1], q, parameters={m: 2.0, g: 10.0})
    system = made.problem([1.0, 0.0], [0.0, 0.0], (0.0, 0.1)).system.with_parameters([2.0, 5.0])
    assert worst(solve_dae(system, (0.0, 0.3), [0.6, 0.8], [0.0, 0.0]).energy, 2.0 * 5.0 * 0.8) < 1e-6


def test_a_helper_that_writes_to_parameters_is_refused():
    @numba.njit("void(f8[::1])")  # a type of its own, past which the compiler does not look
    def halve(p):
        p[0] *= 0.5

    @callback("force")
    def force(t, q, v, p, Q):
        halve(p)
        Q[0] = -p[0] * q[0]

    system = ConstrainedSystem(n_q=1, n_c=0, mass=unit_mass, force=force, parameters=[1.0], name="changing")
    with pytest.raises(
        ValueError, match=r"force of 'changing' must not change the arrays .*: it changes p. Copy first"
    ):
        solve_dae(system, (0.0, 1.0), [1.0], [0.0])


# --- an event before the first output
@pytest.mark.parametrize("options", [{}, {"dense_output": True}, {"method": "SunRadau5"}, {"step_size": 0.125}])
def test_an_event_before_the_first_output_ends_the_run(options):
    early = event(lambda t, q, v: t - 0.2, terminal=True)
    result = solve_dae(pendulum(), (0.0, 2.0), *START, t_eval=[0.5, 1.0], events=early, **options)
    assert result.status is Status.EVENT and abs(result.t_events[0][0] - 0.2) < 1e-12
    assert result.t.size == 0 and result.q.shape == (2, 0) and result.lam.shape == (1, 0)
    if result.sol is not None:
        assert abs(result.sol.t_max - 0.2) < 1e-12


# --- Ctrl-C
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
    ("method", "options"), [*(("auto", options) for options in OPTIONS), ("SunRadau5", "outputs and an end")]
)
def test_ctrl_c_in_any_function_at_any_call_returns_what_there_is(method, options):
    plain = {kind: COUNTED[kind] for kind in ("force", "jacobian", "gamma")}
    system = pendulum(**plain)

    def solve():
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return solve_dae(system, (0.0, END), *START, method, 1e-5, 1e-5, **OPTIONS[options])

    solve()  # derivatives are looked at once
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


@pytest.mark.parametrize("events", [None, lambda t, q, v: q[0] - 0.1])
def test_signals_at_any_instruction_end_the_run_with_its_result(events):
    """A tracing function raises them where no function of a user runs, too: in what boxes arguments, and between."""
    system = pendulum()
    solve_dae(system, (0.0, 0.1), *START, events=events)
    n = last_call = 0  # lines of Python in a run, and at its last call of a user's function

    def every_line(frame, event, argument):
        nonlocal n, last_call
        if signal.getsignal(signal.SIGINT) is not signal.default_int_handler:
            n += 1
            if frame.f_code in CALLS_A_USER:
                last_call = n
            if n == at:
                signal.raise_signal(signal.SIGINT)
        return every_line

    def solve():
        nonlocal n
        n, before = 0, sys.gettrace()
        sys.settrace(every_line)
        try:
            options = {"step_size": 0.01, "check_derivatives": False}  # few steps: each line of them is slow here
            return solve_dae(system, (0.0, 0.05), *START, "DOP853", events=events, **options)
        finally:
            sys.settrace(before)

    at = 0
    solve()  # what is done once in a process
    assert solve().success
    total, within = n, 0.95 * last_call  # the number of lines is not quite the same each time
    for at in [*np.linspace(1, within, 5).astype(int), *np.linspace(within, total, 5).astype(int)]:
        result = solve()
        assert result.status is Status.INTERRUPTED or (result.success and at > within), (at, result.message)
        assert worst_or_zero((result.q**2).sum(axis=0), 1.0) < 1e-9
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


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


@pytest.mark.skipif(sys.platform == "win32", reason="signals to oneself")
def test_real_signals_while_compiled_code_python_callbacks_and_events_run():
    run_python("""
        import os, signal, threading
        from tests.problems import pendulum
        from twoloop import solve_dae
        from twoloop.mechanisms import four_bar

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
    """)
