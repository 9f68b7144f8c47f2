"""Drives whose C_t jumps: velocities change as by an impulse, by every method, or the run says why not."""

from functools import cache

import numpy as np
import pytest

from tests.bodies.runs import by_hand
from tests.problems import driven_cart, pendulum, quick, unconstrained
from twoloop import Status, solve_dae
from twoloop.methods.presets import PRESETS

# a cart on a driven path, two bars below it, the five coordinates coupled by the mass matrix
MIXED = np.random.default_rng(5).normal(size=(5, 5)) * 0.3
MASS = np.diag([1.0, 2.0, 2.0, 1.0, 1.0]) + MIXED @ MIXED.T
LOW_ORDER = ("TRBDF2", "ESDIRK4", "Newmark", "PaperNewmark", "PaperIRK")
# Taylor refuses callbacks that branch
METHODS = [name for name in PRESETS if name not in ("auto", "Taylor", "Gauss6", "Gauss10", "Gauss12", "Gauss14")]


def driven(place, speed, acceleration):
    def constraint(t, q):
        bars = (q[1] - q[0]) ** 2 + q[2] ** 2, (q[3] - q[1]) ** 2 + (q[4] - q[2]) ** 2
        return np.array([q[0] - place(t), 0.5 * (bars[0] - 1.0), 0.5 * (bars[1] - 1.0)])

    def jacobian(t, q):
        a, b, c, d = q[1] - q[0], q[2], q[3] - q[1], q[4] - q[2]
        return np.array([[1.0, 0, 0, 0, 0], [-a, a, b, 0, 0], [0, -c, -d, c, d]])

    def right(t, q, v):
        turns = (v[1] - v[0]) ** 2 + v[2] ** 2, (v[3] - v[1]) ** 2 + (v[4] - v[2]) ** 2
        return np.array([acceleration(t), -turns[0], -turns[1]])

    force = lambda t, q, v: np.array([0.0, 0.0, -19.62, 0.0, -9.81]) - 0.1 * v  # noqa: E731
    rate = lambda t, q: np.array([-speed(t), 0.0, 0.0])  # noqa: E731
    rows = {"constraint": constraint, "jacobian": jacobian, "constraint_rate": rate, "gamma": right}
    return unconstrained(force, 5, n_c=3, mass=MASS, **rows)


def shaken(jump=0.0, at=np.inf):
    """The path 0.2 sin 5t, and a ramp of slope `jump` from `at` on."""
    return driven(
        lambda t: 0.2 * np.sin(5.0 * t) + (jump * (t - at) if t >= at else 0.0),
        lambda t: np.cos(5.0 * t) + (jump if t >= at else 0.0),
        lambda t: -5.0 * np.sin(5.0 * t),
    )


START = np.array([0.0, np.sin(0.7), -np.cos(0.7), np.sin(0.7) + np.sin(0.2), -np.cos(0.7) - np.cos(0.2)])
END = 0.8


def impulse(system, t, q, v):
    """Velocities after the jump, by the Schur complement."""
    rows, inverse = system.jacobian(t, q), np.linalg.inv(system.mass(t, q))
    p = np.linalg.solve(rows @ inverse @ rows.T, rows @ v + system.constraint_rate(t, q))
    return v - inverse @ rows.T @ p


def velocities(system):
    return impulse(system, 0.0, START, np.zeros(5))


def through(pieces, v0):
    """State at the end of smooth pieces (from, to, system), with an impulse between them."""
    q, v = START, v0
    for begin, end, system in pieces:
        v = impulse(system, begin, q, v)
        result = solve_dae(system, (begin, end), q, v, "DOP853", 1e-11, 1e-11, check_derivatives=False)
        assert result.success
        q, v = result.q[:, -1], result.v[:, -1]
    return np.concatenate([q, v])


CASES = [(1.3, 0.5), (-3e-4, 0.437)]  # on the grid of constant steps, and a small one between
FAMILIES = ("auto", "Adams", "Gauss8", "RadauIIA9", "BDF", "Newmark", "ESDIRK4")


@cache
def end_after(jump, at):
    after = driven(
        lambda t: 0.2 * np.sin(5.0 * t) + jump * (t - at),
        lambda t: np.cos(5.0 * t) + jump,
        lambda t: -5.0 * np.sin(5.0 * t),
    )
    return through([(0.0, at, shaken()), (at, END, after)], velocities(shaken()))


def off(result, expected):
    return np.abs(np.concatenate([result.q[:, -1], result.v[:, -1]]) - expected).max()


@pytest.mark.parametrize(
    ("case", "method"),
    quick([(case, name) for name in ("auto", *METHODS) for case in CASES if case == CASES[0] or name in FAMILIES], 4),
)
def test_a_jump_is_an_impulse(case, method):
    jump, at = case
    tol = 1e-5 if method in LOW_ORDER else 1e-7  # the Newmark methods take thousands of steps
    system = shaken(jump, at)
    result = solve_dae(system, (0.0, END), START, velocities(system), method, tol, tol)
    assert result.success and off(result, end_after(jump, at)) < (3e3 if method in LOW_ORDER else 1e2) * tol
    assert f"At t = {at:.4g} C_t or b jumps" in result.message and np.abs(result.t - at).min() < 1e-14


@cache
def at_rest_until(at, speed, acceleration):
    """State at the end where a drive is still until a time."""
    rest = driven(lambda t: 0.0, lambda t: 0.0, lambda t: 0.0)
    moving = driven(
        lambda t: speed * (t - at) + 0.5 * acceleration * (t - at) ** 2,
        lambda t: speed + acceleration * (t - at),
        lambda t: acceleration,
    )
    return through([(0.0, at, rest), (at, END, moving)], np.zeros(5))


@pytest.mark.parametrize(("method", "tolerance"), quick([("TRBDF2", 1e-4), ("auto", 1e-6), ("Newmark", 1e-4)], 2))
@pytest.mark.parametrize("width", quick([1e-6, 1e-4, 1e-9]))
def test_a_ramp_between_the_ends_of_a_step(method, tolerance, width):
    """At both ends of a step as long as the ramp its acceleration is zero: such steps left the impulse of it out."""
    at, jump = 0.4371, 0.8
    system = driven(
        lambda t: jump * (0.5 * min(max(0.0, t - at), width) ** 2 / width + max(0.0, t - at - width)),
        lambda t: jump * min(max(0.0, t - at) / width, 1.0),
        lambda t: jump / width if at <= t < at + width else 0.0,
    )
    result = solve_dae(system, (0.0, END), START, np.zeros(5), method, tolerance, tolerance)
    assert result.success and off(result, at_rest_until(at, jump, 0.0)) < 50.0 * tolerance + 2.0 * width


@pytest.mark.parametrize("method", quick(["auto", "RadauIIA9", "BDF", "Adams", "PaperIRK"]))
def test_a_jump_of_the_acceleration_of_a_drive_is_none(method):
    at = 0.437
    system = driven(lambda t: 3 * max(0, t - at) ** 2, lambda t: 6 * max(0, t - at), lambda t: 6.0 if t > at else 0.0)
    result = solve_dae(system, (0.0, END), START, np.zeros(5), method, 1e-6, 1e-6)
    assert off(result, at_rest_until(at, 0.0, 6.0)) < 1e-3 and "jumps" not in result.message


def test_between_the_steps_no_polynomial_goes_through_the_jump():
    system = shaken(1.3, 0.437)
    t = np.concatenate([np.linspace(0.0, 0.43699, 60), np.linspace(0.43701, END, 60)])
    start = system, (0.0, END), START, velocities(system)
    exact = solve_dae(*start, "DOP853", 1e-11, 1e-11, t_eval=t, max_step=0.02)
    for method in ("DOP853", "Gauss8", "BDF"):
        state = solve_dae(*start, method, 1e-7, 1e-7, dense_output=True).sol(t)
        assert np.abs(state.q - exact.q).max() < 1e-5 and np.abs(state.v - exact.v).max() < 1e-5


def test_a_skate_whose_blade_is_driven_suddenly():
    """A v + b = 0 with a jump of b, and positions that are free."""
    system = unconstrained(
        lambda t, q, v: np.zeros(3),
        3,
        n_a=1,
        mass=np.array([[2.0, 0.5, 0.0], [0.5, 1.0, 0.2], [0.0, 0.2, 1.0]]),
        nonholonomic=lambda t, q: np.array([[1.0, -1.0, 0.5]]),
        nonholonomic_rate=lambda t, q: np.array([1.0 if t > 0.5 else 0.0]),
        nonholonomic_gamma=lambda t, q, v: np.zeros(1),
    )
    inverse, row = np.linalg.inv(system.mass(0.0, np.zeros(3))), np.array([1.0, -1.0, 0.5])
    expected = -inverse @ row / (row @ inverse @ row)
    for method in ("DOP853", "Gauss6", "RadauIIA5", "BDF"):
        result = solve_dae(system, (0.0, 1.0), np.zeros(3), np.zeros(3), method)
        assert np.abs(result.v[:, -1] - expected).max() < 1e-10
        assert np.abs(result.q[:, -1] - 0.5 * expected).max() < 1e-7


@pytest.mark.parametrize("method", quick(["auto", "RadauIIA9", "TRBDF2"]))
def test_a_rate_that_has_no_value_where_it_jumps_is_an_impulse(method):
    """C_t of 0.5 |t - 0.4|, written as a quotient, is 0 / 0 at the kink."""

    def half(t):
        with np.errstate(invalid="ignore"):
            return 0.5 * np.divide(t - 0.4, np.abs(t - 0.4))

    def ends(rate):
        system = driven_cart(
            lambda t: 0.5 * abs(t - 0.4),
            rate,
            jacobian=lambda t, q: np.array([[1.0, 0.0, 0.0], [q[0] - q[1], q[1] - q[0], q[2]]]),
            gamma=lambda t, q, v: np.array([0.0, -((v[1] - v[0]) ** 2) - v[2] ** 2]),
        )
        result = solve_dae(system, (0.0, 0.6), [0.2, 0.8, -0.8], [-0.5, -0.5, 0.0], method, 1e-8, 1e-8)
        assert result.success and "At t = 0.4 C_t or b jumps" in result.message
        return result.q[:, -1]

    assert np.abs(ends(half) - ends(lambda t: 0.5 * np.sign(t - 0.4))).max() < 1e-6


def hung(at, jump, after_too):
    """A pendulum below a pivot that turns back at a time; gamma is by differences, as the drive branches."""

    def speed(t):
        return jump if t > at or (after_too and t == at) else -jump

    return pendulum(
        gamma=False,
        constant_mass=True,
        constraint=lambda t, q: np.array([0.5 * ((q[0] - jump * abs(t - at)) ** 2 + q[1] ** 2 - 1.0)]),
        jacobian=lambda t, q: np.array([[q[0] - jump * abs(t - at), q[1]]]),
        constraint_rate=lambda t, q: np.array([-(q[0] - jump * abs(t - at)) * speed(t)]),
    )


@pytest.mark.parametrize("method", quick(["auto", "RadauIIA5", "Gauss6", "BDF", "Newmark", "TRBDF2"], 2))
@pytest.mark.parametrize("at", [0.0, 1.0])
def test_a_run_may_start_and_end_at_a_kink(method, at):
    speed = 0.6 if at == 0.0 else -0.6
    angle, rate = by_hand(lambda t, a, w: -9.81 * np.sin(a), [0.5, 0.3], [1.0])[:, -1]
    start = [0.6 * at + np.sin(0.5), -np.cos(0.5)], [speed + 0.3 * np.cos(0.5), 0.3 * np.sin(0.5)]
    result = solve_dae(hung(at, 0.6, at == 0.0), (0.0, 1.0), *start, method, rtol=1e-6, atol=1e-6)
    assert result.success and abs(result.q[:, -1] - [0.6 * (1.0 - at) + np.sin(angle), -np.cos(angle)]).max() < 1e-5
    along = np.array([np.cos(angle), np.sin(angle)])
    assert abs(result.v[:, -1] - [speed, 0.0] - rate * along).max() < 1e-5
    assert abs(along @ result.a[:, -1] + 9.81 * np.sin(angle)) < 1e-4


def test_drives_that_contradict_one_another_end_the_run():
    system = pendulum(
        n_c=2,
        constraint=lambda t, q: np.array([q[0] - max(0.0, t - 0.5), q[0]]),
        jacobian=lambda t, q: np.array([[1.0, 0.0], [1.0, 0.0]]),
        constraint_rate=lambda t, q: np.array([-1.0 if t > 0.5 else 0.0, 0.0]),
        gamma=lambda t, q, v: np.zeros(2),
    )
    with pytest.warns(UserWarning, match="rank 1 of 2"):
        result = solve_dae(system, (0.0, 1.0), np.zeros(2), np.zeros(2), "Gauss6", check_derivatives=False)
    assert result.status in (Status.RATE_JUMPS, Status.ROWS_CONTRADICT) and result.t[-1] < 0.51
