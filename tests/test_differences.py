"""What a system does not give, by differences: C_q of C, Gamma of C_q and C_t, as accurate as the tolerance asks."""

import math

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from tests.derivative_cases import shaken_pendulum
from tests.problems import pendulum, quick, worst
from twoloop import ConstrainedSystem, Status, consistent_state, solve_dae
from twoloop.mechanisms import four_bar, very_flexible_beam


def without_jacobian(problem):
    system = problem.system
    given = {kind: function for kind, function in system.given.items() if kind not in ("jacobian", "kinematics")}
    return ConstrainedSystem(
        n_q=system.n_q, n_c=system.n_c, **given, parameters=system.parameters, constant_mass=True, name="differenced"
    )


@pytest.mark.parametrize("problem", [four_bar(), very_flexible_beam()], ids=lambda problem: problem.name)
def test_it_agrees_with_the_formula(problem):
    system = without_jacobian(problem)
    for q in problem.q0 + np.random.default_rng(0).normal(size=(10, problem.q0.size)):
        assert worst(system.jacobian(0.3, q), problem.system.jacobian(0.3, q)) < 2e-13


@pytest.mark.parametrize("root", [False, True], ids=["square", "root"])
@pytest.mark.parametrize(
    ("length", "offset"), [(1.0, 0.0), (1e-3, 0.0), (1e-6, 0.0), (1e6, 0.0), (1.0, 3e5), (1e-3, 1e3)]
)
def test_each_coordinate_has_a_displacement_of_its_own(root, length, offset):
    # a pendulum about (offset, 0); with the root its constraint bends on the scale of the length
    def constraint(t, q):
        squares = (q[0] - offset) ** 2 + q[1] ** 2
        return np.array([math.sqrt(squares) - length if root else 0.5 * (squares - length**2)])

    q = np.array([offset + 0.6 * length, 0.8 * length])
    arm = np.array([q[0] - offset, q[1]])
    expected = arm / np.hypot(*arm) if root else arm
    system = pendulum(constraint=constraint, jacobian=None, gamma=False)
    assert worst(system.jacobian(0.0, q), expected) < 5e-11 * np.abs(expected).max()


# --- Gamma
AMPLITUDE = 1e-3  # m


def opaque(x):
    """The same numbers; what cannot be traced, so that no derivative of it is known."""
    return np.maximum(x, -np.inf)


def shaken(speed, gamma=True, noise=0.0):
    """A pendulum of 1 m whose pivot is shaken horizontally with the angular frequency `speed`."""
    case = shaken_pendulum(1.0, omega=speed, amplitude=AMPLITUDE)
    changed = {
        "force": lambda t, q, v: np.array([0.0, -9.81]),
        "jacobian": lambda t, q: opaque(case.functions["jacobian"](t, q) + noise * np.sin(1e13 * (q[0] + t))),
    }
    return case.system(**changed if gamma else changed | {"gamma": None})


def start(system, speed):
    return consistent_state(system, 0.0, [-1.0, 0.0], [AMPLITUDE * speed, 0.0])


@pytest.mark.parametrize("method", quick(["DOP853", "Gauss12", "BDF"]))
@pytest.mark.parametrize("speed", [1.0, 1e3, 2.0 * np.pi * 16e3])
def test_a_fast_drive(speed, method):
    exact, differenced = shaken(speed), shaken(speed, gamma=False)
    span = (0.0, min(3.0, 30.0 / speed))
    q0, v0 = start(exact, speed)
    given = solve_dae(exact, span, q0, v0, method, 1e-8, 1e-8)
    run = solve_dae(differenced, span, q0, v0, method, 1e-8, 1e-8, t_eval=[span[1]])
    assert given.success and run.success, run.message
    # equal at the tolerance, relative to the largest value over the run
    assert worst(run.a[:, -1], given.a[:, -1]) < 1e-7 * np.abs(given.a).max()
    assert worst(run.lam[:, -1], given.lam[:, -1]) < 1e-7 * np.abs(given.lam).max()
    assert run.stats.n_accepted < 1.3 * given.stats.n_accepted + 5


def test_differences_are_not_lengthened_over_the_drive():
    # a drive that becomes fast long after the start
    def angle(t):
        return 50.0 * t**4

    system = pendulum(
        constant_mass=True,
        constraint=lambda t, q: np.array([q[0] - 0.01 * np.sin(angle(t))]),
        jacobian=lambda t, q: opaque(np.array([[1.0, 0.0]])) + 0.0 * opaque(q[0]),
        constraint_rate=lambda t, q: np.array([-0.01 * np.cos(angle(t)) * 200.0 * t**3]),
        gamma=False,
    )
    times = np.linspace(0.1, 2.0, 20)
    run = solve_dae(system, (0.0, 2.0), [0.0, 0.0], [0.0, 0.0], "DOP853", t_eval=times)
    true = 0.01 * (np.cos(angle(times)) * 600.0 * times**2 - np.sin(angle(times)) * (200.0 * times**3) ** 2)
    assert run.success, run.message
    assert worst(run.a[0], true) < 1e-7 * np.abs(true).max()


def test_what_cannot_reach_the_tolerance_is_a_status():
    system = shaken(10.0, gamma=False, noise=1e-9)
    q0, v0 = start(shaken(10.0), 10.0)
    run = solve_dae(system, (0.0, 1.0), q0, v0, check_derivatives=False)
    assert run.status is Status.NOT_CONVERGED
    assert "gamma by differences" in run.message and "Give gamma, or loosen rtol" in run.message and run.t[0] == 0.0


def test_differences_of_constraints_that_hardly_bend_are_judged_by_rounding():
    """Nothing turns and nothing pushes: gamma is zero, and what differences leave of it is rounding."""
    angle, radius = 0.7, 0.4
    wheel = ConstrainedSystem.from_python(
        n_q=4,
        n_c=1,
        n_a=2,
        mass=np.diag([1.0, 1.0, 0.2, 0.1]),
        force=lambda t, q, v: np.array([0.0, 0.0, 0.1 * np.sin(t), -v[3] if v[3] > 5.0 else 0.0]),
        constraint=lambda t, q: np.array([q[2] - np.interp(t, [1.0, 2.0], [angle, 1.0])]),
        jacobian=lambda t, q: np.array([[0.0, 0.0, 1.0, 0.0]]),
        constraint_rate=lambda t, q: np.array([angle - 1.0 if 1.0 <= t < 2.0 else 0.0]),
        nonholonomic=lambda t, q: np.array(
            [[1.0, 0.0, 0.0, -radius * np.cos(q[2])], [0.0, 1.0, 0.0, -radius * np.sin(q[2])]]
        ),
    )
    v0 = [3.0 * radius * np.cos(angle), 3.0 * radius * np.sin(angle), 0.0, 3.0]
    result = solve_dae(wheel, (0.0, 3.0), [0.0, 0.0, angle, 0.0], v0)
    assert result.success and abs(result.q[3, -1] - 9.0) < 1e-7


@pytest.mark.parametrize("t0", quick([1e6, 0.0, 1e5]))
def test_a_late_start_leaves_room_for_differences_on_one_side(t0):
    """A drive of a kilohertz, with lengths of differences that are a few spacings of time at a start as late."""
    size, rate, end = 1e-3, 6e3, 0.02
    system = ConstrainedSystem.from_python(
        n_q=2,
        n_c=1,
        mass=np.eye(2),
        force=lambda t, q, v: np.array([0.0, -9.81]),
        constraint=lambda t, q: np.array([0.5 * ((q[0] - place(t)) ** 2 + q[1] ** 2 - 1.0)]),
        jacobian=lambda t, q: np.array([[q[0] - place(t), q[1]]]),
        constraint_rate=lambda t, q: np.array([-(q[0] - place(t)) * size * rate * np.cos(rate * (t - t0))]),
    )

    def place(t):
        return size * np.sin(rate * (t - t0)) if t > -1.0 else 0.0

    start = [np.sin(0.5), -np.cos(0.5)], [size * rate, 0.0]
    result = solve_dae(system, (t0, t0 + end), *start, "RadauIIA5", rtol=1e-5, atol=1e-5)
    angle = solve_ivp(
        lambda t, y: [y[1], -9.81 * np.sin(y[0]) + size * rate * rate * np.sin(rate * t) * np.cos(y[0])],
        *((0.0, end), [0.5, 0.0], "DOP853"),
        rtol=1e-12,
        atol=1e-12,
    ).y[0, -1]
    assert result.success and abs(result.q[1, -1] + np.cos(angle)) < 1e-4
