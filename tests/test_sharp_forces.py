"""Forces that are sharp in time or in velocity: no method passes over them, and no estimate is too small there."""

from functools import cache

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from tests import problems
from tests.problems import unconstrained, worst
from twoloop import DOP853, ConstrainedSystem, ensemble, mechanisms, solve_dae
from twoloop.mechanisms import four_bar

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


def stop(t, q, v):
    depth = 1000.0 * (q[0] - 0.5)  # softplus, of a stop at x = 0.5
    return np.array([-8.0 * np.log(1.0 + np.exp(depth)) / 10.0, -9.81])


def switching(t, q, v):
    return np.array([4.0 * np.tanh(50.0 * np.sin(20.0 * t)), -9.81])


def pendulum(force):
    return problems.pendulum(compile=True, constant_mass=True, force=force)


def position(angle):
    return np.array([np.sin(angle), -np.cos(angle)])


def start_of(state):
    angle, rate = state
    return position(angle), rate * np.array([np.cos(angle), np.sin(angle)])


@cache
def reference(force, state):
    """The end position from the equation of the angle alone, by SciPy with steps too short to pass over anything."""

    def rates(t, y):
        q, along = position(y[0]), np.array([np.cos(y[0]), np.sin(y[0])])
        return [y[1], along @ force(t, q, y[1] * along)]

    run = solve_ivp(rates, (0.0, T_END), state, method="DOP853", rtol=1e-12, atol=1e-12, max_step=T_END / 600.0)
    return position(run.y[0, -1])


# forces as they are given, so that references are made once
FORCES = {
    "gust of 30 ms on a pendulum at rest": (gust(0.03), AT_REST),
    "gust of 50 ms, going down": (gust(0.05, 1.1, -7.0), START),
    "drag through zero speed": (drag, START),
    "brake": (brake(0.01), START),
    "stop": (stop, START),
    "switching": (switching, AT_REST),
}
MISSED = 3e3  # tolerances that an end may be off after 3 s


@cache
def system_of(name):
    return pendulum(FORCES[name][0])


def off(name, **options):
    force, state = FORCES[name]
    result = solve_dae(system_of(name), (0.0, T_END), *start_of(state), **options)
    assert result.success, result.message
    return result, np.abs(result.q[:, -1] - reference(force, state)).max()


@pytest.mark.parametrize("compiled", [False, True], ids=["general", "compiled"])
@pytest.mark.parametrize("name", FORCES)
def test_a_series_sees_what_it_cannot_foresee(name, compiled):
    for tolerance in (1e-5, 1e-8, 1e-11):
        result, error = off(name, method="Taylor", compiled=compiled, rtol=tolerance, atol=tolerance)
        assert error < MISSED * max(tolerance, 1e-12) and 0.0 <= result.defect < 10.0
        assert result.widest_gap <= 0.01 * T_END * (1.0 + 1e-9)


@pytest.mark.parametrize("method", ["auto", "DOP853", "Adams", "Gauss8", "RadauIIA9", "RadauIIA13", "SunRadau5"])
@pytest.mark.parametrize("name", ["gust of 30 ms on a pendulum at rest", "drag through zero speed"])
def test_no_method_passes_over_a_hundredth_of_the_run(name, method):
    for tolerance in (1e-4, 1e-9):
        result, error = off(name, method=method, rtol=tolerance, atol=tolerance)
        assert error < MISSED * tolerance and result.widest_gap <= 0.01 * T_END * (1.0 + 1e-9)


@pytest.mark.parametrize("name", ["brake", "switching"])
@pytest.mark.parametrize(("method", "tolerances"), [("TRBDF2", (1e-4, 1e-7)), ("ESDIRK4", (1e-6, 1e-8))])
def test_few_digits_and_many_are_what_was_asked_for(name, method, tolerances):
    for tolerance in tolerances:
        _, error = off(name, method=method, rtol=tolerance, atol=tolerance, max_step=0.01 * T_END)
        assert error < 300.0 * tolerance


def test_other_methods_do_not_say_a_defect():
    result, _ = off("brake", method="DOP853")
    assert result.defect is None and result.widest_gap == pytest.approx(result.h.max())


def falling_off(t, q, v):
    return -0.1 * q / (1.0 + q**2)


@pytest.mark.parametrize(
    ("force", "narrow"),
    [
        (lambda t, q, v: -0.1 * q, False),
        (lambda t, q, v: -0.1 * np.sin(q) * t - 1e-3 * v**3, False),
        (lambda t, q, v: -0.1 * np.sin(q) * np.cos(t), True),
        (lambda t, q, v: -0.1 * np.sin(8.0 * q), True),
        (lambda t, q, v: -0.1 * np.sin((q + v) * (q - 8.0 * v)), True),
        (lambda t, q, v: -0.1 * np.sin(q * v), False),
        (falling_off, True),
        (lambda t, q, v: -0.1 * q / np.sqrt(1.0 + q**2), True),
        (lambda t, q, v: -0.1 * np.arctan(q), True),
        (lambda t, q, v: -0.1 * np.tanh(q), True),
        (lambda t, q, v: -0.1 * q if t < 1e9 else q, True),
    ],
)
def test_steps_are_longer_than_a_hundredth_where_nothing_is_narrow(force, narrow):
    """4/15 of a step is the longest part without a stage: the equations are still evaluated in each hundredth."""
    system = unconstrained(force, compile=True)
    result = solve_dae(system, (0.0, 1.0), [1.0], [0.0], "DOP853", 1e-3, 1e-3)
    assert result.h.max() == pytest.approx(0.01 if narrow else 0.0375, rel=1e-9)
    assert result.widest_gap == pytest.approx(0.01, rel=1e-9)


HILL = {"n_q": 2, "n_c": 1, "mass": np.eye(2), "force": lambda t, q, v: np.array([0.1, -1.0])}
NARROW = {
    "mass": {
        "mass": lambda t, q: np.diag(np.array([1.0 - 0.999 * np.exp(-(((t - 0.5) / 0.002) ** 2)), 1.0])),
        "n_c": 0,
    },
    "constraint": {"constraint": lambda t, q: np.array([q[1] - 0.1 / (1.0 + q[0] ** 2)])},
    "jacobian": {
        "constraint": lambda t, q: np.array([q[1] - 0.1 / (1.0 + q[0] ** 2)]),
        "jacobian": lambda t, q: np.array([[0.2 * q[0] / (1.0 + q[0] ** 2) ** 2, 1.0]]),
    },
    "nonholonomic": {"n_c": 0, "n_a": 1, "nonholonomic": lambda t, q: np.array([[1.0 / (1.0 + q[0] ** 2), -1.0]])},
}


@pytest.mark.parametrize("callback", NARROW)
def test_what_is_narrow_is_seen_in_every_callback(callback):
    """A jacobian that is not given, rows of A and a mass that varies with time were not looked at."""
    system = ConstrainedSystem.from_python(**{**HILL, **NARROW[callback], "compile": True})
    q, v = ([0.0, 0.1], [0.0, 0.0]) if system.n_c else ([0.0, 0.0], [0.0, 0.0])
    result = solve_dae(system, (0.0, 1.0), q, v, "DOP853", 1e-3, 1e-3)
    assert result.success and result.h.max() <= 0.01 * (1.0 + 1e-9)


def test_implicit_steps_of_a_hundredth_are_their_own_widest_gap():
    """Those beyond it by rounding, too, are not told as 4/15 of a step, as steps of DOP853 are."""
    stiff = lambda t, q, v: np.array([-1e6 * (q[0] - 0.1 * q[1]) - 2e3 * v[0], -0.1 * q[1]])  # noqa: E731
    system = unconstrained(stiff, 2, compile=True)
    result = solve_dae(system, (1.3, 4.3), [0.1, 1.0], [0.0, 0.0], rtol=1e-5, atol=1e-5)
    assert (result.h > 0.0299).sum() > 20 and result.widest_gap == pytest.approx(0.03, rel=1e-6)


@pytest.mark.parametrize(("force", "narrow"), [(lambda t, q, v: -0.1 * q, False), (falling_off, True)])
def test_steps_in_lanes_are_as_long_as_in_single_runs(force, narrow):
    system = unconstrained(force, compile=True)
    starts = np.linspace(0.5, 1.5, 8)[:, None]
    runs = ensemble(system, (0.0, 1.0), starts, 0.0 * starts, method="DOP853", rtol=1e-3, atol=1e-3)
    assert not runs.singly[1:].any()  # the first one checks the system
    single = solve_dae(system, (0.0, 1.0), starts[3], [0.0], "DOP853", 1e-3, 1e-3)
    assert (runs.n_steps >= 100).all() if narrow else (runs.n_steps < 50).all()
    assert abs(runs.n_steps[3] - single.h.size) <= 5


@pytest.mark.parametrize("method", ["RadauIIA9", "Adams", "Newmark", DOP853("restored")], ids=str)
def test_steps_of_other_methods_are_not(method):
    system = unconstrained(lambda t, q, v: -0.1 * q, compile=True)
    result = solve_dae(system, (0.0, 1.0), [1.0], [0.0], method, 1e-3, 1e-3)
    assert result.h.max() <= 0.01 * (1.0 + 1e-9) and result.widest_gap <= 0.01 * (1.0 + 1e-9)


def test_the_default_takes_them_from_the_start_at_loose_tolerances():
    problem = mechanisms.double_pendulum()
    for compiled in (True, False):
        given = {"rtol": 1e-3, "atol": 1e-3, "compiled": compiled}
        default, alone = (
            solve_dae(problem.system, (0.0, 5.0), problem.q0, problem.v0, method, **given)
            for method in ("auto", "DOP853")
        )
        assert default.h.max() > 0.05 * (1.0 + 1e-9)
        assert default.stats.n_evaluations < 1.2 * alone.stats.n_evaluations


def test_constant_steps_say_how_wide_they_are():
    problem = four_bar()
    result = solve_dae(problem.system, (0.0, 0.5), problem.q0, problem.v0, method="Gauss8", step_size=0.02)
    assert result.defect is None and result.widest_gap == pytest.approx(0.02)


def test_smooth_motion_costs_a_look_at_each_hundredth_of_the_run():
    problem = four_bar()
    run = {}
    for t_end in (2.0, 20.0):
        start = problem.system, (0.0, t_end), problem.q0, problem.v0
        run[t_end] = solve_dae(*start, "Taylor", rtol=1e-8, atol=1e-8, compiled=False)
        assert run[t_end].stats.n_rejected_error <= 1
    # the looks within steps are a hundred, and one more a step, however long the run is
    evaluations = [each.stats.n_evaluations / each.stats.n_accepted for each in run.values()]
    assert evaluations[1] < evaluations[0] < evaluations[1] + 100.0 / run[2.0].stats.n_accepted + 2.0


SQUARE = {
    "drag from rest": drag,
    "root of the time": lambda t, q, v: np.array([np.sqrt(t), -9.81]),
    "tanh of large numbers": lambda t, q, v: np.array([2.0 * np.tanh((t - 1.0) / 0.001), -9.81]),
    "decay within a thousandth": lambda t, q, v: np.array([5.0 * np.exp(-t / 1e-3), -9.81]),
    "a high power of a negative number": lambda t, q, v: np.array([3.0 * ((q[0] - 0.9) / 1.6) ** 65, -9.81]),
}


@pytest.mark.parametrize("compiled", [False, True], ids=["general", "compiled"])
@pytest.mark.parametrize("name", SQUARE)
def test_auto_goes_on_where_a_series_is_not_finite(name, compiled):
    force, state = SQUARE[name], (0.7, 0.0)
    system = pendulum(force)
    expected = reference(force, state)
    for tolerance in (1e-7, 1e-10):
        result = solve_dae(
            system, (0.0, T_END), *start_of(state), rtol=tolerance, atol=tolerance, compiled=compiled, dense_output=True
        )
        assert result.success, result.message
        assert np.abs(result.q[:, -1] - expected).max() < MISSED * tolerance
        assert np.abs(np.sum(result.sol(0.5 * (result.t[1:] + result.t[:-1])).q ** 2, axis=0) - 1.0).max() < 1e-12


@pytest.mark.parametrize("compiled", [False, True])
def test_a_series_that_is_not_finite_says_so(compiled):
    start = pendulum(drag), (0.0, 1.0), *start_of((0.7, 0.0))
    result = solve_dae(*start, "Taylor", rtol=1e-8, atol=1e-8, compiled=compiled)
    assert result.status.name == "NOT_FINITE" and "no derivatives" in result.message and "DOP853" in result.message


# --- forces that jump within a step, and errors of velocities that last
TOL = 1e-8
W, PUSH, END = 3.0, 10.0, 1.0  # rad/s, m/s^2, s
TIMES = np.linspace(0.21, 0.79, 8) ** 1.1  # s, on no grid of steps


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
    for at, push in np.random.default_rng(3).uniform((0.1, -1.0), (0.9, 2.0), (40, 2)):
        result = solve_dae(system.with_parameters([at, 10.0**push]), (0.0, END), [1.0], [0.0], "Adams", TOL, TOL)
        v = -W * np.sin(W * END) + 10.0**push / W * np.sin(W * (END - at))
        assert abs(result.v[0, -1] - v) < 10.0 * TOL * (1.0 + abs(v))


def test_errors_of_velocities_count_for_as_long_as_the_motion_lasts():
    """They turn back no faster than the mechanism moves, and those of many steps add up."""
    problem = mechanisms.andrews()
    span = (0.0, 0.05)
    fine = solve_dae(problem.system, span, problem.q0, problem.v0, "DOP853", 1e-12, 1e-12)
    result = solve_dae(problem.system, span, problem.q0, problem.v0, "ESDIRK4", TOL, TOL)
    assert worst(result.q[:, -1], fine.q[:, -1]) < 800.0 * TOL


@pytest.mark.parametrize("at", [0.0, -3.0])
def test_times_before_zero_are_like_others(at):
    """What is refused at one place does not hold steps short at another."""
    problem = mechanisms.pendulum()
    result = solve_dae(problem.system, (at, at + 1.0), problem.q0, problem.v0, "ESDIRK4", 1e-6, 1e-6)
    assert result.stats.n_accepted < 130
