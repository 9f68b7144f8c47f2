"""Forces that act for a thousandth of the run: steps end where something changes suddenly with time."""

import math
from functools import cache

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from tests import problems
from twoloop import ConstrainedSystem, Status, ensemble, solve_dae
from twoloop.generate.time_dependence import may_be_sudden
from twoloop.mechanisms import driven_slider_crank, four_bar

T_END, SIZE, WIDTH = 3.0, 200.0, 1e-3
PLACES = np.random.default_rng(12).uniform(0.4, 2.4, 12)
START = np.array([0.0, -1.0]), np.array([0.5, 0.0])


def gust(t, q, v, p):
    return np.array([SIZE * np.exp(-(((t - p[0]) / p[1]) ** 2)), -9.81])


def switched(t, q, v, p):
    return np.array([SIZE if abs(t - p[0]) < p[1] else 0.0, -9.81])


def not_a_number(t, q, v, p):
    return np.array([np.nan if abs(t - p[0]) < p[1] else 0.0, -9.81])


def infinite(t, q, v, p):
    return np.array([np.inf if abs(t - p[0]) < p[1] else 0.0, -9.81])


def outside_not_a_number(t, q, v, p):
    return np.array([0.0 if q[0] < 1.0 + 1e-6 else np.nan, -9.81])


def vibrating(t, q, v, p):
    return np.array([SIZE * np.sin(30.0 * t + p[0]) + p[1] * t * t, -9.81])


def ticking(t, q, v, p):
    return np.array([SIZE * np.cos(np.pi * (t - p[0]) / 6.0) ** 4096, -9.81])


def magnet(t, q, v, p):
    return np.array([SIZE if abs(q[0] - p[0]) < p[1] else 0.0, -9.81])


def smooth_magnet(t, q, v, p):
    return np.array([SIZE * np.exp(-(((q[0] - p[0]) / p[1]) ** 2)), -9.81])


def quotient(t, q, v, p):
    return np.array([SIZE * (1.0 / (1.0 + ((q[0] - p[0]) / p[1]) ** 2)) ** 8, -9.81])


def narrow_quotient(t, q, v, p):
    return np.array([SIZE * (1.0 / (1.0 + ((q[0] - p[0]) / p[1]) ** 2)) ** 2, -9.81])


def broad_quotient(t, q, v, p):
    return np.array([SIZE / (1.0 + ((q[0] - p[0]) / p[1]) ** 2), -9.81])


def damper(t, q, v, p):
    """Between the bob and a point, which keep their distance or not."""
    x, y = q[0] - p[0], q[1] - p[1]
    along = 1.0 / np.sqrt(x * x + y * y)
    return -(x * v[0] + y * v[1]) * along * along * np.array([x, y])


def teeth(t, q, v, p):
    return np.array([SIZE * np.cos((q[0] - p[0]) / p[1]) ** 4096, -9.81])


def cogs(t, q, v, p):
    return np.array([20.0 * np.cos((q[0] - p[0]) / p[1]) ** 32, -9.81])


def wave(t, q, v, p):
    return np.array([20.0 * np.cos((q[0] - p[0]) / p[1]) ** 6, -9.81])


def steady(t, q, v, p):
    return np.array([-p[1] * v[0], -9.81])


def pendulum(force, at=1.5, width=WIDTH, compile=True):
    return problems.pendulum(compile=compile, force=force, parameters=[at, width])


FORCES = {"gust": gust, "switched": switched, "smooth magnet": smooth_magnet, "quotient": quotient, "cogs": cogs}


@cache
def system_of(name):
    return pendulum(FORCES[name])


@cache
def end(force, at):
    """(x, y) at T_END by the angle, in steps that cannot pass over the gust."""

    def rate(t, state):
        return state[1], np.cos(state[0]) * force(t, None, None, (at, WIDTH))[0] - 9.81 * np.sin(state[0])

    state = np.array([0.0, 0.5])
    for t0, t1 in ((0.0, at - 8 * WIDTH), (at - 8 * WIDTH, at + 8 * WIDTH), (at + 8 * WIDTH, T_END)):
        longest = WIDTH / 20.0 if force is switched and t1 - t0 < 0.1 else max(WIDTH / 2.0, (t1 - t0) / 40.0)
        made = solve_ivp(rate, (t0, t1), state, method="DOP853", rtol=1e-11, atol=1e-11, max_step=longest)
        state = made.y[:, -1]
    return np.array([np.sin(state[0]), -np.cos(state[0])])


@pytest.mark.parametrize("options", [{}, {"compiled": False}, {"method": "Adams"}, {"method": "RadauIIA5"}], ids=str)
def test_no_gust_of_a_thousandth_of_the_run_is_passed_over(options):
    for at in PLACES:
        system = system_of("gust").with_parameters([at, WIDTH])
        result = solve_dae(system, (0.0, T_END), *START, rtol=1e-8, atol=1e-8, **options)
        assert result.success and np.abs(result.q[:, -1] - end(gust, at)).max() < 1e-5


@pytest.mark.parametrize("method", ["auto", "TRBDF2"])
def test_nor_is_a_force_that_is_switched_on_for_that_time(method):
    for at in PLACES[:4]:
        system = system_of("switched").with_parameters([at, WIDTH])
        result = solve_dae(system, (0.0, T_END), *START, method=method, rtol=1e-6, atol=1e-6)
        assert result.success and np.abs(result.q[:, -1] - end(switched, at)).max() < 1e-3


def end_behind_edges(at, width):
    """(x, y) at T_END by the angle under the magnet, begun anew at each of its edges."""

    def rate(t, y):
        return y[1], np.cos(y[0]) * magnet(t, [np.sin(y[0])], None, (at, width))[0] - 9.81 * np.sin(y[0])

    events = [lambda t, y, edge=edge: np.sin(y[0]) - edge for edge in (at - width, at + width)]
    for event in events:
        event.terminal = True
    t, y = 0.0, np.array([0.0, 3.0])
    while t < T_END:
        made = solve_ivp(rate, (t, T_END), y, method="DOP853", rtol=1e-10, atol=1e-10, max_step=2e-3, events=events)
        t, y = made.t[-1], made.y[:, -1]
        if made.status == 1:  # beyond the edge
            y, t = y + 1e-10 * np.array(rate(t, y)), t + 1e-10
    return np.array([np.sin(y[0]), -np.cos(y[0])])


def test_nor_is_what_acts_at_a_place_that_is_passed_in_that_time():
    at, width = 0.3, 3e-3
    expected = end_behind_edges(at, width)
    for compile in (True, False):
        system = pendulum(magnet, at, width, compile)
        for method in ("auto", "DOP853", "RadauIIA9"):
            result = solve_dae(system, (0.0, T_END), START[0], [3.0, 0.0], method, rtol=1e-6, atol=1e-6)
            assert result.success and np.abs(result.q[:, -1] - expected).max() < 1e-4


@pytest.mark.parametrize("method", ["Adams", "BDF"])
def test_nor_is_it_by_steps_shorter_than_a_170th_of_the_run(method):
    for at, width in ((-0.35, 3e-3), (0.15, 3e-3), (0.15, 5e-3), (0.45, 5e-3)):
        run = (0.0, T_END), START[0], [3.0, 0.0], method
        result = solve_dae(pendulum(magnet, at, width), *run, rtol=1e-6, atol=1e-6)
        assert result.success and np.abs(result.q[:, -1] - end_behind_edges(at, width)).max() < 1e-4


# places and widths, those of "quotient" twice as large
BEHIND = ((0.1, 5e-3), (0.3, 5e-3), (-0.2, 1e-2), (0.4, 1e-2))
UNITS = {"smooth magnet": 1.0, "quotient": 2.0}
WIDTHS = np.linspace(0.04, 0.09, 24)  # of "cogs", at 0.1
ANGLES = {  # at T_END, by `angle_behind_a_place`; with half its steps and a hundredth of its tolerance 1e-10 from it
    "smooth magnet": (0.8940700426, 0.9658623702, -0.0539605515, 1.3315628819),
    "quotient": (0.8132728397, 0.8724210829, 0.2639739749, 1.1740910367),
    "cogs": (
        *(0.5489668711, 0.9984142767, 1.1252816754, 0.7356910680, 0.6147421969, 1.0037921353),
        *(1.1688734996, 1.1193075582, 0.7639210604, 0.5560663257, 0.7074273204, 1.0007341382),
        *(1.2187527686, 1.3222209511, 0.8991678508, 0.8527660676, 0.8161683773, 0.7171711684),
        *(0.5751799883, 0.6458066233, 0.8080871428, 1.0043922710, 1.2009418208, 1.3408110044),
    ),
}


def behind_a_place(name):
    """(at, width) and (x, y) at T_END of each."""
    unit = UNITS.get(name)
    given = [(0.1, width) for width in WIDTHS.tolist()] if unit is None else [(at, unit * w) for at, w in BEHIND]
    return [(*each, np.array([np.sin(angle), -np.cos(angle)])) for each, angle in zip(given, ANGLES[name], strict=True)]


def angle_behind_a_place(name, at, width):
    """At T_END, in steps of a quarter of the time in which a force at a place is passed."""
    force, longest = FORCES[name], 0.035 * width if name == "cogs" else 5e-4

    def rate(t, state):
        along = math.cos(state[0]) * force(t, (math.sin(state[0]),), None, (at, width))[0]
        return state[1], along - 9.81 * math.sin(state[0])

    made = solve_ivp(rate, (0.0, T_END), (0.0, 3.0), method="DOP853", rtol=1e-11, atol=1e-11, max_step=longest)
    return made.y[0, -1]


@pytest.mark.slow  # numbers that do not change
@pytest.mark.parametrize("name", ANGLES)
def test_the_ends_behind_a_place_are_those_of_scipy(name):
    for at, width, end in behind_a_place(name):
        angle = angle_behind_a_place(name, at, width)
        assert np.abs(end - [np.sin(angle), -np.cos(angle)]).max() < 1e-9


@pytest.mark.parametrize("options", [{}, {"compiled": False}, {"method": "Taylor"}, {"method": "DOP853"}], ids=str)
@pytest.mark.parametrize("tolerance", [1e-6, 1e-8])
@pytest.mark.parametrize("name", UNITS)
def test_nor_is_a_smooth_force_at_such_a_place(name, options, tolerance):
    """It is passed at 3/s, a width in a two-thousandth of the run or more."""
    for at, width, expected in behind_a_place(name):
        system = system_of(name).with_parameters([at, width])
        run = (0.0, T_END), START[0], [3.0, 0.0]
        result = solve_dae(system, *run, rtol=tolerance, atol=tolerance, **options)
        assert result.success and np.abs(result.q[:, -1] - expected).max() < 1e3 * tolerance


@pytest.mark.parametrize("method", ["Adams", "BDF", "SunRadau5"])
def test_nor_is_a_force_that_is_not_finite(method):
    """For a 300th and a thousandth of the run; it hid later changes, too."""
    each = zip(PLACES, (300, 1000) * 6, (not_a_number, not_a_number, infinite, infinite) * 3, strict=True)
    for at, share, wrong in each:
        system = pendulum(wrong, at, 0.5 * T_END / share)
        result = solve_dae(system, (0.0, T_END), *START, method=method, rtol=1e-6, atol=1e-6)
        assert result.status is Status.NOT_FINITE and abs(result.t[-1] - at) < T_END / share, result


@pytest.mark.parametrize("method", ["DOP853", "RadauIIA5"])
def test_a_gust_far_ahead_does_not_stop_a_body_at_rest(method):
    """Its least values change by steps, and so do the accelerations and velocities that they give."""

    def far(t, q, v):
        return np.array([SIZE * np.exp(-(((t - 4.0) / 0.1) ** 2)) - q[0]])

    body = ConstrainedSystem.from_python(n_q=1, n_c=0, mass=np.eye(1), force=far)
    result = solve_dae(body, (0.0, 10.0), [0.0], [0.0], method, rtol=1e-8, atol=1e-8)
    exact = SIZE * 0.1 * np.sqrt(np.pi) * np.exp(-(0.1**2) / 4.0) * np.sin(6.0)
    assert result.success and abs(result.q[0, -1] - exact) < 1e-5
    assert len(result.h) < 1000  # Newton's method takes 330


@pytest.mark.parametrize("method", ["auto", "Adams"])
def test_what_is_not_finite_where_no_step_comes_ends_no_run(method):
    """x is at most 1, and its parabola goes beyond."""
    counts = []
    for force in (outside_not_a_number, lambda t, q, v, p: np.array([0.0 * t**0.5, -9.81])):
        result = solve_dae(pendulum(force, compile=False), (0.0, T_END), START[0], [6.2, 0.0], method)
        assert result.success and result.q[0].max() > 0.99
        counts.append(len(result.h))
    assert counts[0] < 2 * counts[1]


def test_a_force_that_raises_where_no_step_comes_is_looked_at_where_steps_begin():
    """x is at most 1, and its parabola goes beyond."""

    def force(t, q, v, p):
        return np.array([-math.sqrt(1.0 - q[0] * q[0]) if q[0] < 2.0 else 0.0, -9.81])

    result = solve_dae(pendulum(force, compile=False), (0.0, T_END), START[0], [6.2, 0.0])
    assert result.success and result.q[0].max() > 0.99


def test_nor_in_lanes():
    runs = ensemble(
        system_of("gust"), (0.0, T_END), *START, parameters=[[at, WIDTH] for at in PLACES], rtol=1e-8, atol=1e-8
    )
    assert runs.success.all()
    for q, at in zip(runs.q[:, :, -1], PLACES, strict=True):
        assert np.abs(q - end(gust, at)).max() < 1e-5


@pytest.mark.parametrize("tolerance", [1e-4, 1e-6])
def test_nor_are_pulses_of_a_high_power_of_a_cosine(tolerance):
    """Between these the force and its series are zero to rounding; each acts for a hundredth of the run."""
    given = {"parameters": [[0.1, width] for width in WIDTHS], "rtol": tolerance, "atol": tolerance}
    runs = ensemble(system_of("cogs"), (0.0, T_END), START[0], [3.0, 0.0], method="Taylor", t_eval=[T_END], **given)
    assert runs.success.all() and (~runs.singly).sum() > 12
    for q, (_, _, end) in zip(runs.q[:, :, -1], behind_a_place("cogs"), strict=True):
        assert np.abs(q - end).max() < 1e3 * tolerance


def test_what_may_act_for_a_short_time():
    assert all(
        may_be_sudden(each, False).by_time for each in (system_of("gust"), system_of("switched"), pendulum(ticking))
    )
    smooth = (
        *map(pendulum, (vibrating, steady, broad_quotient, damper, wave)),
        four_bar().system,
        driven_slider_crank().system,
    )
    assert not any(any(may_be_sudden(system, False)) for system in smooth)
    for system in (*map(system_of, ("smooth magnet", "quotient", "cogs")), *map(pendulum, (teeth, narrow_quotient))):
        assert may_be_sudden(system, False) == (False, True)


def test_forces_are_not_called_beyond_the_end_of_a_run():
    latest = []

    def force(t, q, v):
        latest.append(t)
        return np.array([1.0 if t > 0.5 else 0.0, -9.81])

    result = solve_dae(problems.pendulum(force=force), (0.0, 1.0), *START, t_eval=[0.3, 1.0], method="DOP853")
    assert result.success and max(latest) <= 1.0
