"""Short and discontinuous forces: no method passes over them, and no estimate of the error is too small there."""

import warnings
from functools import cache
from itertools import pairwise

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import expm

from tests.problems import event, pendulum, quick, unconstrained
from twoloop import ConstrainedSystem, ConstraintWarning, Integrator, Status, ensemble, mechanisms, solve_dae
from twoloop.mechanisms import n_four_bar

T_END = 3.0
START = (0.9, 0.4)  # angle from below, rad, and its rate
AT_REST = (0.0, 0.0)


def gust(width, at=1.5, size=20.0):
    def force(t, q, v):
        return np.array([size * np.exp(-(((t - at) / width) ** 2)), -9.81])

    return force


def drag(t, q, v):
    speed = np.sqrt(v[0] * v[0] + v[1] * v[1])
    return np.array([-0.6 * speed * v[0], -9.81 - 0.6 * speed * v[1]])


def brake(width):
    def force(t, q, v):
        along = -3.0 * np.tanh((q[0] * v[1] - q[1] * v[0]) / width)
        return np.array([-along * q[1], -9.81 + along * q[0]])

    return force


def switching(t, q, v):
    return np.array([4.0 * np.tanh(50.0 * np.sin(20.0 * t)), -9.81])


def smooth(force):
    return pendulum(constant_mass=True, force=force)


def position(angle):
    return np.array([np.sin(angle), -np.cos(angle)])


def start_of(state):
    angle, rate = state
    return position(angle), rate * np.array([np.cos(angle), np.sin(angle)])


@cache
def reference(force, state, p=None, longest=T_END / 600.0, around=None):
    """Compute the end position from the equation of the angle, by SciPy in steps too short to pass over anything.

    With `around` steps are that much shorter close to the time p[0].
    """
    given = () if p is None else (p,)

    def rates(t, y):
        q, along = position(y[0]), np.array([np.cos(y[0]), np.sin(y[0])])
        return [y[1], along @ force(t, q, y[1] * along, *given)]

    edges = [0.0, T_END] if around is None else [0.0, p[0] - 8.0 * p[1], p[0] + 8.0 * p[1], T_END]
    for t0, t1 in pairwise(edges):
        steps = longest if around is None or t1 - t0 > 0.1 else around
        state = solve_ivp(rates, (t0, t1), state, method="DOP853", rtol=1e-11, atol=1e-11, max_step=steps).y[:, -1]
    return position(state[0])


# forces as they are given, so that references are made once
FORCES = {
    "gust of 30 ms on a pendulum at rest": (gust(0.03), AT_REST),
    "drag through zero speed": (drag, START),
    "brake": (brake(0.01), START),
    "switching": (switching, AT_REST),
}
MISSED = 3e3  # tolerances that an end may be off after 3 s


@cache
def system_of(name):
    return smooth(FORCES[name][0])


def off(name, **options):
    force, state = FORCES[name]
    result = solve_dae(system_of(name), (0.0, T_END), *start_of(state), **options)
    assert result.success, result.message
    return result, np.abs(result.q[:, -1] - reference(force, state)).max()


@pytest.mark.parametrize("compiled", quick([False, True]))
@pytest.mark.parametrize("name", FORCES)
def test_a_series_sees_what_it_cannot_foresee(name, compiled):
    for tolerance in (1e-5, 1e-11):
        result, error = off(name, method="Taylor", compiled=compiled, rtol=tolerance, atol=tolerance)
        assert error < MISSED * max(tolerance, 1e-12) and 0.0 <= result.defect < 10.0
        assert result.widest_gap <= 0.01 * T_END * (1.0 + 1e-9)


@pytest.mark.parametrize("method", quick(["auto", "RadauIIA9", "DOP853", "Adams", "Gauss8", "SunRadau5"], 2))
@pytest.mark.parametrize("name", ["gust of 30 ms on a pendulum at rest", "drag through zero speed"])
def test_no_method_passes_over_a_hundredth_of_the_run(name, method):
    for tolerance in (1e-4, 1e-9):
        result, error = off(name, method=method, rtol=tolerance, atol=tolerance)
        assert error < MISSED * tolerance and result.widest_gap <= 0.01 * T_END * (1.0 + 1e-9)


@pytest.mark.parametrize("name", ["brake", "switching"])
@pytest.mark.parametrize(("method", "tolerances"), quick([("TRBDF2", (1e-4, 1e-7)), ("ESDIRK4", (1e-6, 1e-8))]))
def test_few_digits_and_many_are_what_was_asked_for(name, method, tolerances):
    for tolerance in tolerances:
        _, error = off(name, method=method, rtol=tolerance, atol=tolerance, max_step=0.01 * T_END)
        assert error < 300.0 * tolerance


def falling_off(t, q, v):
    return -0.1 * q / (1.0 + q**2)


SLOWLY = [(lambda t, q, v: -0.1 * np.sin(q * v), False), (falling_off, True)]
SLOWLY += [(lambda t, q, v: -0.1 * q if t < 1e9 else q, True), (lambda t, q, v: -0.1 * q, False)]
SLOWLY += [(lambda t, q, v: -0.1 * np.sin(q) * np.cos(t), True), (lambda t, q, v: -0.1 * np.tanh(q), True)]
SLOWLY += [(lambda t, q, v: -0.1 * np.sin((q + v) * (q - 8.0 * v)), True)]


@pytest.mark.parametrize(("force", "short"), quick(SLOWLY, 2))
def test_steps_are_longer_than_a_hundredth_where_forces_change_slowly(force, short):
    """4/15 of a step is the longest part without a stage: the equations are still evaluated in each hundredth."""
    result = solve_dae(unconstrained(force, compile=True), (0.0, 1.0), [1.0], [0.0], "DOP853", 1e-3, 1e-3)
    assert result.h.max() == pytest.approx(0.01 if short else 0.0375, rel=1e-9)
    assert result.widest_gap == pytest.approx(0.01, rel=1e-9)


HEIGHT = {"constraint": lambda t, q: np.array([q[1] - 0.1 / (1.0 + q[0] ** 2)])}
HILL = {"n_q": 2, "n_c": 1, "mass": np.eye(2), "force": lambda t, q, v: np.array([0.1, -1.0])}
SHORT_CHANGES = {
    "mass": {"mass": lambda t, q: np.diag(np.array([1.0 - 0.999 * np.exp(-(((t - 0.5) / 2e-3) ** 2)), 1.0])), "n_c": 0},
    "constraint": HEIGHT,
    "jacobian": HEIGHT | {"jacobian": lambda t, q: np.array([[0.2 * q[0] / (1.0 + q[0] ** 2) ** 2, 1.0]])},
    "nonholonomic": {"n_c": 0, "n_a": 1, "nonholonomic": lambda t, q: np.array([[1.0 / (1.0 + q[0] ** 2), -1.0]])},
}


@pytest.mark.parametrize("callback", SHORT_CHANGES)
def test_short_changes_are_seen_in_every_callback(callback):
    """A jacobian that is not given, rows of A and a mass that varies with time were not checked for it."""
    system = ConstrainedSystem.from_python(**HILL | SHORT_CHANGES[callback])
    q, v = ([0.0, 0.1], [0.0, 0.0]) if system.n_c else ([0.0, 0.0], [0.0, 0.0])
    result = solve_dae(system, (0.0, 1.0), q, v, "DOP853", 1e-3, 1e-3)
    assert result.success and result.h.max() <= 0.01 * (1.0 + 1e-9)


SQUARE = {
    "drag from rest": drag,
    "root of the time": lambda t, q, v: np.array([np.sqrt(t), -9.81]),
    "tanh of large numbers": lambda t, q, v: np.array([2.0 * np.tanh((t - 1.0) / 0.001), -9.81]),
    "a high power of a negative number": lambda t, q, v: np.array([3.0 * ((q[0] - 0.9) / 1.6) ** 65, -9.81]),
}


@pytest.mark.parametrize("compiled", quick([False, True]))
@pytest.mark.parametrize("name", SQUARE)
def test_auto_goes_on_where_a_series_is_not_finite(name, compiled):
    force, state = SQUARE[name], (0.7, 0.0)
    system = smooth(force)
    expected = reference(force, state)
    for tolerance in (1e-7, 1e-10):
        result = solve_dae(
            system, (0.0, T_END), *start_of(state), rtol=tolerance, atol=tolerance, compiled=compiled, dense_output=True
        )
        assert result.success, result.message
        assert np.abs(result.q[:, -1] - expected).max() < MISSED * tolerance
        assert np.abs(np.sum(result.sol(0.5 * (result.t[1:] + result.t[:-1])).q ** 2, axis=0) - 1.0).max() < 1e-12


# --- forces that jump within a step, and errors of velocities that last
TOL = 1e-8
W, PUSH, END = 3.0, 10.0, 1.0  # rad/s, m/s^2, s
TIMES = np.linspace(0.21, 0.79, 5) ** 1.1  # s, on no grid of steps


def pushed(at):
    """A mass on a spring, pushed from a time on."""
    return unconstrained(lambda t, q, v: np.array([(PUSH if t > at else 0.0) - W * W * q[0]]))


def errors(method):
    """Of position and velocity at the end, over the tolerance, for each time of the jump."""
    found = []
    for at in TIMES:
        result = solve_dae(pushed(at), (0.0, END), [1.0], [0.0], method, TOL, TOL, check_derivatives=False)
        phase, since = W * END, W * (END - at)
        q = np.cos(phase) + PUSH / W**2 * (1.0 - np.cos(since))
        v = -W * np.sin(phase) + PUSH / W * np.sin(since)
        assert result.success, result.message
        found.append(max(abs(result.q[0, -1] - q), abs(result.v[0, -1] - v)) / TOL)
    return found


@pytest.mark.parametrize(
    ("method", "limit"), [("DOP853", 10.0), ("Gauss4", 30.0), ("Gauss8", 20.0), ("ESDIRK4", 30.0), ("PaperIRK", 300.0)]
)
def test_a_jump_of_the_force_is_passed_within_the_tolerance(method, limit):
    """The weights of ESDIRK4 and of its embedded formula agree within 4 %: its estimate was 1/300 of the error."""
    assert max(errors(method)) < limit


def test_a_short_step_of_adams_does_not_hide_a_jump():
    """Of a step much shorter than those before it the order's formula says an error of 1/1000 of that of the jump."""
    system = unconstrained(lambda t, q, v, p: np.array([(p[1] if t > p[0] else 0.0) - W * W * q[0]]), parameters=[0, 0])
    for at, push in np.random.default_rng(3).uniform((0.1, -1.0), (0.9, 2.0), (6, 2)):
        result = solve_dae(system.with_parameters([at, 10.0**push]), (0.0, END), [1.0], [0.0], "Adams", TOL, TOL)
        v = -W * np.sin(W * END) + 10.0**push / W * np.sin(W * (END - at))
        assert abs(result.v[0, -1] - v) < 10.0 * TOL * (1.0 + abs(v))


@pytest.mark.parametrize("at", [0.0, -3.0])
def test_times_before_zero_are_like_others(at):
    """What is refused at one place does not hold steps short at another."""
    problem = mechanisms.pendulum()
    result = solve_dae(problem.system, (at, at + 1.0), problem.q0, problem.v0, "ESDIRK4", 1e-6, 1e-6)
    assert result.stats.n_accepted < 130


# --- forces that act for a thousandth of the run, in time or at a place: steps end where they change suddenly
SIZE, WIDTH = 200.0, 1e-3
PLACES = np.random.default_rng(12).uniform(0.4, 2.4, 12)[::3]
SLOW, FAST = (0.0, 0.5), (0.0, 3.0)  # starts


def short_gust(t, q, v, p):
    return np.array([SIZE * np.exp(-(((t - p[0]) / p[1]) ** 2)), -9.81])


def switched(t, q, v, p):
    return np.array([SIZE if abs(t - p[0]) < p[1] else 0.0, -9.81])


def not_finite(t, q, v, p):
    return np.array([p[2] if abs(t - p[0]) < p[1] else 0.0, -9.81])


def outside_not_a_number(t, q, v, p):
    return np.array([0.0 if q[0] < 1.0 + 1e-6 else np.nan, -9.81])


def magnet(t, q, v, p):
    return np.array([SIZE if abs(q[0] - p[0]) < p[1] else 0.0, -9.81])


def smooth_magnet(t, q, v, p):
    return np.array([SIZE * np.exp(-(((q[0] - p[0]) / p[1]) ** 2)), -9.81])


def cogs(t, q, v, p):
    return np.array([20.0 * np.cos((q[0] - p[0]) / p[1]) ** 32, -9.81])


@cache
def pendulum_with(force, compile=True):
    return pendulum(compile=compile, force=force, parameters=[1.5, WIDTH])


def end_of(force, p, start, compile=True, **options):
    system = pendulum_with(force, compile).with_parameters(p)
    result = solve_dae(system, (0.0, T_END), *start_of(start), **options)
    assert result.success, result.message
    return result.q[:, -1]


def at_a_time(force, at):
    shortest = WIDTH / (20.0 if force is switched else 2.0)
    return reference(force, SLOW, (at, WIDTH), T_END / 40.0, shortest)


TIGHT = {"rtol": 1e-8, "atol": 1e-8}
LOOSE = {"rtol": 1e-6, "atol": 1e-6}


@pytest.mark.parametrize("options", quick([{}, {"compiled": False}, {"method": "Adams"}, {"method": "RadauIIA5"}]))
def test_no_gust_of_a_thousandth_of_the_run_is_passed_over(options):
    for at in PLACES:
        found = end_of(short_gust, (at, WIDTH), SLOW, **TIGHT, **options)
        assert np.abs(found - at_a_time(short_gust, at)).max() < 1e-5


@pytest.mark.parametrize("method", ["auto", "TRBDF2"])
def test_nor_is_a_force_that_is_switched_on_for_that_time(method):
    for at in PLACES[:2]:
        found = end_of(switched, (at, WIDTH), SLOW, method=method, **LOOSE)
        assert np.abs(found - at_a_time(switched, at)).max() < 1e-3


@pytest.mark.parametrize("compile", quick([False, True]))
def test_nor_is_what_acts_at_a_place_that_is_passed_in_that_time(compile, p=(0.3, 3e-3)):
    expected = reference(magnet, FAST, p, 5e-4)
    for method in ("auto", "DOP853", "RadauIIA9", "Adams", "BDF") if compile else ("auto",):
        assert np.abs(end_of(magnet, p, FAST, compile, method=method, **LOOSE) - expected).max() < 1e-4


@pytest.mark.parametrize("options", quick([{}, {"compiled": False}, {"method": "Taylor"}, {"method": "DOP853"}]))
def test_nor_is_a_smooth_force_at_such_a_place(options):
    """It is passed at 3/s, a width in a two-thousandth of the run or more."""
    p = 0.1, 5e-3
    expected = reference(smooth_magnet, FAST, p, 1e-3)
    assert np.abs(end_of(smooth_magnet, p, FAST, **TIGHT, **options) - expected).max() < 1e-5


@pytest.mark.parametrize("method", quick(["Adams", "BDF", "SunRadau5"]))
def test_nor_is_a_force_that_is_not_finite(method):
    """For a 300th and a thousandth of the run; it hid later changes, too."""
    for at, share, wrong in zip(PLACES, (300, 1000) * 2, (np.nan, np.nan, np.inf, np.inf), strict=True):
        p = at, 0.5 * T_END / share, wrong
        system = pendulum(force=lambda t, q, v, p=p: not_finite(t, q, v, p))
        result = solve_dae(system, (0.0, T_END), *start_of(SLOW), method=method, **LOOSE)
        assert result.status is Status.NOT_FINITE and abs(result.t[-1] - at) < T_END / share, result


@pytest.mark.parametrize("method", ["DOP853", "RadauIIA5"])
def test_a_gust_far_ahead_does_not_stop_a_body_at_rest(method):
    """Its least values change by steps, and so do the accelerations and velocities that they give."""
    body = unconstrained(lambda t, q, v: np.array([SIZE * np.exp(-(((t - 4.0) / 0.1) ** 2)) - q[0]]))
    result = solve_dae(body, (0.0, 10.0), [0.0], [0.0], method, rtol=1e-8, atol=1e-8)
    exact = SIZE * 0.1 * np.sqrt(np.pi) * np.exp(-(0.1**2) / 4.0) * np.sin(6.0)
    assert result.success and abs(result.q[0, -1] - exact) < 1e-5
    assert len(result.h) < 1000  # Newton's method takes 330


@pytest.mark.parametrize("method", ["auto", "Adams"])
def test_what_is_not_finite_where_no_step_comes_ends_no_run(method):
    """x is at most 1, and its parabola goes beyond."""
    counts = []
    for force in (outside_not_a_number, lambda t, q, v, p: np.array([0.0 * t**0.5, -9.81])):
        result = solve_dae(pendulum_with(force, False), (0.0, T_END), *start_of((0.0, 6.2)), method)
        assert result.success and result.q[0].max() > 0.99
        counts.append(len(result.h))
    assert counts[0] < 2 * counts[1]


def test_nor_are_gusts_in_lanes():
    given = {"parameters": [[at, WIDTH] for at in PLACES], **TIGHT}
    runs = ensemble(pendulum_with(short_gust), (0.0, T_END), *start_of(SLOW), **given)
    assert runs.success.all()
    for q, at in zip(runs.q[:, :, -1], PLACES, strict=True):
        assert np.abs(q - at_a_time(short_gust, at)).max() < 1e-5


@pytest.mark.slow
def test_nor_are_pulses_of_a_high_power_of_a_cosine():
    """Between these the force and its series are zero to rounding; each acts for a hundredth of the run."""
    widths = np.linspace(0.04, 0.09, 5).tolist()
    given = {"parameters": [[0.1, width] for width in widths], **LOOSE}
    runs = ensemble(pendulum_with(cogs), (0.0, T_END), *start_of(FAST), method="Taylor", t_eval=[T_END], **given)
    assert runs.success.all() and (~runs.singly).sum() > 2
    for q, width in zip(runs.q[:, :, -1], widths, strict=True):
        assert np.abs(q - reference(cogs, FAST, (0.1, width), 0.035 * width)).max() < 1e-3


# --- pulses of a force, again and again in a long run: none is passed over, or the run says so
MASS, STIFFNESS, DAMPING = 1.04, 4.0, 0.3


def pulsed(t, q, v, p):
    push = 5.0 if (t - p[2]) % p[0] < p[1] else 0.0
    return np.array([push - STIFFNESS * q[0] - DAMPING * v[0]])


def on_a_spring(force, *parameters, compile=True):
    given = {"n_q": 1, "n_c": 0, "mass": np.array([[MASS]]), "parameters": parameters}
    return ConstrainedSystem.from_python(force=force, compile=compile, **given)


def slide(period, width, begin=0.0):
    return on_a_spring(pulsed, period, width, begin)


def state_after(pushes):
    """Position and velocity from rest after pushes that last for some time each."""
    state = np.zeros(2)
    matrix = np.array([[0.0, 1.0], [-STIFFNESS / MASS, -DAMPING / MASS]])
    for push, span in pushes:
        rest = np.array([push / STIFFNESS, 0.0])
        state = rest + expm(matrix * span) @ (state - rest)
    return state


def end_of_pulses(period, width, begin, t_end):
    """Position and velocity at the end, from rest, from one edge of a pulse to the next."""
    edges = np.add.outer(begin + period * np.arange(-1, t_end // period + 1), [0.0, width]).ravel()
    edges = np.concatenate([[0.0], edges[(edges > 0.0) & (edges < t_end)], [t_end]])
    pieces = pairwise(edges.tolist())
    return state_after((5.0 if (0.5 * (a + b) - begin) % period < width else 0.0, b - a) for a, b in pieces)


def pulses_off(result, *pulses):
    """Errors at the end over the tolerance."""
    state = np.array([result.q[0, -1], result.v[0, -1]])
    return np.abs(state - end_of_pulses(*pulses, result.t[-1])).max() / result.rtol


@pytest.mark.parametrize("method", quick(["auto", "RadauIIA5", "DOP853", "Adams", "TRBDF2"], 2))
@pytest.mark.parametrize(("width", "t_end"), [(0.1, 200.0), (0.02, 50.0)])
def test_pulses_shorter_than_steps_are_not_passed_over(method, width, t_end, tolerance=1e-5):
    result = solve_dae(slide(1.0, width), (0.0, t_end), [0.0], [0.0], method, tolerance, tolerance)
    assert result.success and pulses_off(result, 1.0, width, 0.0) < 100.0


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
    assert pulses_off(results[0], 1.0, 0.02, 0.0) < 100.0
    for result in results[1:]:
        assert (result.q == results[0].q).all() and result.stats.n_accepted == results[0].stats.n_accepted


MET_BY_SHORT_STEPS = [((5.0, 2e-3, 0.01), "Adams", 1e-6), ((2.5, 1e-3, 0.003), "auto", 1e-7)]
MET_BY_SHORT_STEPS += [((5.0, 2e-3, 0.01), "DOP853", 1e-7), ((2.5, 1e-3, 0.003), "DOP853", 1e-6)]


def gusts(t, q, v, p):
    since = (t - p[2] + 0.5 * p[0]) % p[0] - 0.5 * p[0]
    return np.array([5.0 * np.exp(-((since / p[1]) ** 2)) - STIFFNESS * q[0] - DAMPING * v[0]])


def after_gusts(period, width, begin, t_end, n=100):
    """Position and velocity at the end: each gust leaves a vibration, as the integral of its force has it."""
    rate = np.roots([MASS, DAMPING, STIFFNESS])[0]
    left = t_end - np.arange(begin, t_end, period)[:n]
    each = 5.0 * width * np.sqrt(np.pi) * np.exp(rate * left + (0.5 * rate * width) ** 2)
    known = each.sum() / (MASS * rate.imag)
    return np.array([known.imag, (rate * known).imag])


@pytest.mark.parametrize(("gust", "method", "tolerance"), quick(MET_BY_SHORT_STEPS, 2))
def test_gusts_that_short_steps_met_are_not_passed_over_later(gust, method, tolerance):
    """To closer looks these are smooth, and so none of their flanks was found, nor were the gusts that followed."""
    result = solve_dae(on_a_spring(gusts, *gust), (0.0, 49.0), [0.0], [0.0], method, tolerance, tolerance)
    known = after_gusts(*gust, 49.0)
    assert result.success and np.abs([result.q[0, -1], result.v[0, -1]] - known).max() < 1e3 * tolerance


N_GUSTS = 5


def some_gusts(t, q, v, p):
    push = 0.0
    for k in range(N_GUSTS):
        push = push + 5.0 * np.exp(-(((t - p[2] - k * p[0]) / p[1]) ** 2))
    return np.array([push - STIFFNESS * q[0] - DAMPING * v[0]])


@pytest.mark.parametrize(
    ("compile", "method"), quick([(True, "auto"), (False, "auto"), (True, "Taylor"), (True, "DOP853")])
)
def test_runs_in_lanes_that_meet_short_gusts_are_made_singly(compile, method):
    P = np.array([[9.0, 0.1, 2.0], [9.0, 0.02, 2.01], [10.0, 0.01, 3.01], [9.0, 0.1, 2.1], [11.0, 0.003, 3.0]])
    system = on_a_spring(some_gusts, *P[0], compile=compile)
    runs = ensemble(system, (0.0, 60.0), [0.0], [0.0], parameters=P, rtol=1e-7, atol=1e-7, method=method)
    known = np.array([after_gusts(*p, 60.0, N_GUSTS) for p in P])
    assert runs.success.all() and np.abs(np.column_stack([runs.q[:, 0, -1], runs.v[:, 0, -1]]) - known).max() < 1e-4
    assert runs.singly.tolist() == [True, True, True, False, True]
    assert all("so short a time" in runs.reasons[k] for k in (1, 2, 4))


@pytest.mark.filterwarnings("ignore:.*change suddenly for 0.02 s:twoloop.ConstraintWarning")  # by the steps of Adams
@pytest.mark.parametrize("method", quick(["auto", "DOP853", "Adams"]))
def test_samples_that_meet_pulses_are_made_again(method):
    integrator = Integrator(slide(1.0, 0.02, 0.3), method, 1e-6, 1e-6)
    integrator.start(0.0, [0.0], [0.0])
    for _ in range(150):
        state = integrator.step(1.0)
    known = end_of_pulses(1.0, 0.02, 0.3, state.t)
    assert np.abs([state.q[0], state.v[0]] - known).max() < 1e-4
    assert (np.diff(integrator.result().t) == 1.0).all()


def two_pulses(t, q, v, p):
    push = p[1] if p[0] <= t < p[0] + 2e-3 else 0.0
    push += p[2] if p[0] + 6e-3 <= t < p[0] + 8e-3 else 0.0
    return np.array([push - STIFFNESS * q[0] - DAMPING * v[0]])


@pytest.mark.parametrize("method", quick(["auto", "Adams", "BDF", "TRBDF2", "RadauIIA5"]))
def test_a_pulse_is_found_ahead_of_a_much_larger_one(method):
    """Beside the large one the small one was no sudden change, and steps went from before it to between both."""
    system = on_a_spring(two_pulses, 1.0, 20.0, -300.0)
    for begin in np.linspace(1.0, 1.1, 5):
        result = solve_dae(system.with_parameters([begin, 20.0, -300.0]), (0.0, 3.0), [0.0], [0.0], method, 1e-6, 1e-6)
        state = state_after(((20.0, 2e-3), (0.0, 4e-3), (-300.0, 2e-3), (0.0, 3.0 - begin - 8e-3)))
        assert result.success and np.abs([result.q[0, -1], result.v[0, -1]] - state).max() < 1e-3


# --- between steps of very unequal lengths, beside singular positions and forces that jump: as good as at the steps
PARTS = (0.13, 0.3, 0.5, 0.75)


def inside(t):
    return np.sort(np.concatenate([t[:-1] + part * np.diff(t) for part in PARTS]))


def largest_errors(state, motion):
    """Largest error of positions, and of velocities."""
    pairs = [(state.q[:, k], state.v[:, k], *motion(t)) for k, t in enumerate(state.t)]
    return np.array([(np.abs(q - exact).max(), np.abs(v - rate).max()) for q, v, exact, rate in pairs]).max(axis=0)


def across(problem, end, tolerances, **options):
    """The first run that reaches its end: rounding decides whether there is a step across a singular position."""
    for tol in tolerances:
        result = solve_dae(problem.system, (0.0, end), problem.q0, problem.v0, "Adams", tol, tol, **options)
        if result.status != Status.STEP_TOO_SMALL:
            break
    return result


@pytest.mark.parametrize(
    ("windows", "tolerances", "end", "compiled"),
    quick([(2, (1e-7, 5e-8, 2e-7), 3.0, True), (3, (3e-9, 2e-9, 1e-8, 2e-8, 5e-8), 10.0, False)]),
)
def test_steps_across_singular_positions(windows, tolerances, end, compiled):
    problem = n_four_bar(windows)
    result = across(problem, end, tolerances, dense_output=True, compiled=compiled)
    assert result.success
    assert result.h.max() / result.h.min() > 100.0  # else there is nothing to see
    with warnings.catch_warnings(record=True, action="always") as said:
        state = result.sol(inside(result.t))
    # they were off by metres
    assert (largest_errors(state, problem.motion) < 20.0 * largest_errors(result, problem.motion)).all()
    rows = [problem.system.velocity_constraint(t, q, v) for t, q, v in zip(state.t, state.q.T, state.v.T, strict=True)]
    off = int((np.abs(rows).max(axis=1) >= 1e-10).sum())  # beside such a position rounding decides whether one is
    assert off == 0 or (off <= 3 and [each.category for each in said] == [ConstraintWarning])


def test_no_event_that_is_none_ends_a_run():
    problem = n_four_bar(3)
    far_away = event(lambda t, q, v: 9.0 - np.abs(q).max(), terminal=True)  # the bars reach 4 m
    t = np.linspace(0.0, 10.0, 5000)
    result = across(problem, 10.0, (3e-9, 2e-9, 1e-8, 2e-8, 5e-8), events=far_away, t_eval=t)
    assert result.status == Status.REACHED_END and result.t_events[0].size == 0
    assert largest_errors(result, problem.motion).max() < 1e-5


def swung_by(force):
    return pendulum(force=force, constant_mass=True)


SHORT_GUST = swung_by(lambda t, q, v: np.array([20.0 * np.exp(-(((t - 1.5) / 0.03) ** 2)), -9.81])), [0.0, -1.0]
RUBBING = swung_by(lambda t, q, v: np.array([0.0, -9.81]) - 3.0 * np.tanh(v / 0.01)), [1.0, 0.0]
BRAKING = swung_by(lambda t, q, v: np.array([0.0, -9.81]) - (3.0 * v if t > 1.0 else 0.0 * v)), [1.0, 0.0]


CASES = [(SHORT_GUST, "DOP853", 1e-10), (RUBBING, "BDF", 1e-8), (BRAKING, "Adams", 1e-10)]
CASES += [(RUBBING, "DOP853", 1e-7), (BRAKING, "Gauss8", 1e-10), (BRAKING, "RadauIIA9", 1e-8)]


@pytest.mark.parametrize(("case", "method", "tol"), quick(CASES, 2))
def test_between_steps_that_forces_make_short(case, method, tol):
    system, q0 = case
    span = (system, (0.0, 2.0), q0, [0.0, 0.0])
    result = solve_dae(*span, method, tol, tol, dense_output=True)
    assert result.success
    t = inside(result.t)
    pieces = [0.0, 1.0, 2.0] if case is BRAKING else [0.0, 2.0]
    exact = np.hstack([np.vstack([each.q, each.v]) for each in _exact(span, pieces, t)])
    state = result.sol(t)
    allowed = 30.0 * tol + 5.0 * np.abs(np.vstack([result.q, result.v])[:, -1] - exact[:, -1]).max()
    assert np.abs(np.vstack([state.q, state.v]) - exact).max() < allowed


def _exact(span, pieces, t):
    """States at t, piece by piece: what a force does at its jump belongs to no step."""
    system, _, q, v = span
    for begin, end in pairwise(pieces):
        here = t[(t >= begin) & (t < end)] if end < pieces[-1] else t[t >= begin]
        stops = np.append(here, end) if end < pieces[-1] else here
        made = solve_dae(system, (begin, end), q, v, "DOP853", 1e-12, 1e-12, max_step=0.005, dense_output=True)
        q, v = made.q[:, -1], made.v[:, -1]
        yield made.sol(stops[: len(here)])
