"""Test motions of models against equations by hand in least coordinates, and of published mechanisms with loops."""

import numpy as np
import pytest

from tests.bodies.runs import by_hand, moved
from tests.marks import slow
from twoloop import solve_dae
from twoloop.bodies import PlanarModel, SpatialModel

TIMES = np.linspace(0.0, 3.0, 7)
GRAVITY = 9.81
pytestmark = pytest.mark.filterwarnings("ignore::twoloop.ConstraintWarning")  # planar loops in space


def run_of(model, method="auto", times=TIMES):
    problem = model.problem((0.0, times[-1]))
    return problem, moved(problem, method, t_eval=times)


def cart(model, force, dashpot):
    """A cart on a rail with a pendulum, held by a spring and pushed by a motor."""
    sledge = model.body("cart", mass=2.0, inertia=0.1, position=(0.0, 0.0), velocity=(0.7, 0.0))
    rod = model.body("rod", mass=0.5, inertia=0.02, position=(0.0, -0.6), angle=-0.5 * np.pi, angular_velocity=2.0)
    rail = model.prismatic("ground", sledge, at=(0.0, 0.0), axis=(3.0, 0.0))
    model.revolute(sledge, rod, at=(0.0, 0.0))
    model.spring("ground", (-1.0, 0.3), sledge, (0.0, 0.3), stiffness=20.0, damping=dashpot, length=0.8)
    model.motor(rail, force)
    return model


def test_a_cart_with_a_pendulum_spring_and_a_motor_that_feeds_back():
    def of_state(t, q, v):
        return 3.0 * np.cos(2.0 * t) - 1.5 * v[0] - 0.2 * q[5] ** 2

    problem, result = run_of(cart(PlanarModel(), of_state, 0.4))
    M, m, L, J = 2.0, 0.5, 0.6, 0.02

    def acceleration(t, z, rate):
        x, turn = z  # of the pendulum from the vertical
        push = 3.0 * np.cos(2.0 * t) - 1.5 * rate[0] - 0.2 * (turn - 0.5 * np.pi) ** 2
        push -= 20.0 * (x + 1.0 - 0.8) + 0.4 * rate[0]
        A = np.array([[M + m, m * L * np.cos(turn)], [m * L * np.cos(turn), J + m * L**2]])
        b = np.array([push + m * L * rate[1] ** 2 * np.sin(turn), -m * GRAVITY * L * np.sin(turn)])
        return np.linalg.solve(A, b)

    known = by_hand(acceleration, [0.0, 0.0, 0.7, 2.0], TIMES)
    np.testing.assert_allclose(result.q[0], known[0], atol=1e-8)
    np.testing.assert_allclose(result.q[5] + 0.5 * np.pi, known[1], atol=1e-8)
    assert problem.freedom.degrees == 2


def test_a_pendulum_on_a_driven_arm_in_space():
    """theta'' = w^2 sin cos - g/l sin for a bob on a hinge that a vertical axis carries round; w follows the drive."""
    m, l, small = 1.0, 0.5, 1e-5
    model = SpatialModel()
    shaft = model.body("shaft", mass=1.0, inertia=(0.1, 0.1, 0.1), position=(0.0, 0.0, 0.0))
    bob = model.body("bob", mass=m, inertia=(small, small, small), position=(l * np.sin(0.5), 0.0, -l * np.cos(0.5)))
    axis = model.revolute("ground", shaft, at=(0.0, 0.0, 0.0), axis=(0.0, 0.0, 1.0))
    model.revolute(shaft, bob, at=(0.0, 0.0, 0.0), axis=(0.0, -1.0, 0.0))
    model.drive(axis, lambda t: 6.0 * t + 0.5 * np.sin(t))
    problem, result = run_of(model)

    def acceleration(t, theta, rate):
        pull = m * l**2 * (6.0 + 0.5 * np.cos(t)) ** 2 * np.sin(theta) * np.cos(theta) - m * GRAVITY * l * np.sin(theta)
        return pull / (m * l**2 + small)

    known = by_hand(acceleration, [0.5, 0.0], TIMES)
    np.testing.assert_allclose(-result.q[9] / l, np.cos(known[0]), atol=1e-8)
    assert problem.freedom.degrees == 1 and problem.v0[8] == pytest.approx(6.5 * l * np.sin(0.5))
    # the torque of the drive is the rate of the angular momentum about the axis
    torque = result.reactions("drive of revolute shaft-ground").torque[2]
    sine, w = np.sin(known[0]), 6.0 + 0.5 * np.cos(TIMES)
    faster = -0.5 * np.sin(TIMES)
    expected = (m * l**2 * sine**2 + small + 0.1) * faster + 2.0 * m * l**2 * sine * np.cos(known[0]) * known[1] * w
    np.testing.assert_allclose(torque, expected, atol=1e-6)


@pytest.mark.slow
def test_functions_that_branch_are_called_in_python_and_do_the_same():
    def smooth(t):
        return 3.0 * np.cos(2.0 * t)

    branching = lambda t: 3.0 * float(np.cos(2.0 * t)) if t < 1e9 else 0.0  # noqa: E731
    traced, called = (run_of(cart(PlanarModel(), f, 0.4), "DOP853") for f in (smooth, branching))
    assert called[0].system.called_in_python and not traced[0].system.called_in_python
    assert "called in Python" in called[0].note and "converts to a number" in called[0].note
    np.testing.assert_allclose(called[1].q, traced[1].q, atol=1e-9)
    with pytest.raises(
        ValueError,
        match=r"'Taylor' needs .*: f of 'motor of prismatic cart-ground': .* converts to a number.*if t < 1e9",
    ):
        run_of(cart(PlanarModel(), branching, 0.4), "Taylor")
    model = cart(PlanarModel(), branching, 0.4)
    model.drive("revolute cart-rod", lambda t: 2.0 * t + 0.1 * t**2)  # is traced all the same
    problem, result = run_of(model, "DOP853")
    np.testing.assert_allclose(result.q[5] - result.q[5, 0], 2.0 * TIMES + 0.1 * TIMES**2, atol=1e-9)
    assert problem.system.constraint_rate(1.0, problem.q0)[-1] == pytest.approx(-2.2)


@pytest.mark.parametrize("method", ["auto", *(slow(name) for name in ("DOP853", "TRBDF2"))])
def test_a_torsion_spring_in_space_does_not_jump_after_a_turn(method):
    """Its torque changed from one end to the other: a run went on, and said nothing."""
    model = SpatialModel(gravity=(0.0, 0.0, 0.0))
    wheel = model.body("wheel", mass=1.0, inertia=(1.0, 1.0, 1.0), position=(0.0, 0.0, 0.0), angular_velocity=(0, 0, 4))
    hinge = model.revolute("ground", wheel, at=(0.0, 0.0, 0.0), axis=(0.0, 0.0, 1.0))
    spring = model.torsion_spring(hinge, stiffness=0.05, damping=0.01)
    problem = model.problem((0.0, 10.0))
    result = solve_dae(problem.system, problem.t_span, problem.q0, problem.v0, method, rtol=1e-4, atol=1e-4)
    assert not result.success and 0.85 < np.arctan2(result.q[6, -1], result.q[3, -1]) / np.pi <= 0.95
    damped = problem.with_parameters({f"stiffness of {spring.name}": 0.0})  # a damper may turn on
    result = solve_dae(damped.system, damped.t_span, damped.q0, damped.v0, method, rtol=1e-6, atol=1e-6)
    rate = 2.0 * (result.q[3, -1] * result.v[6, -1] - result.q[6, -1] * result.v[3, -1])
    assert result.success and rate == pytest.approx(4.0 * np.exp(-0.1), rel=1e-3)


@pytest.mark.parametrize("model", [PlanarModel, SpatialModel])
@pytest.mark.slow
def test_a_function_that_is_called_in_python_is_not_called_on_symbols(model):
    seen, model = set(), model()
    axis = {} if model.dimension == 2 else {"axis": (0.0, 1.0, 0.0)}
    more = {"inertia": 0.1} if model.dimension == 2 else {"inertia": (0.1, 0.1, 0.1)}
    bar = model.body("bar", mass=1.0, position=(1.0, 0.0, 0.0)[: model.dimension], **more)
    pin = model.revolute("ground", bar, at=(0.0, 0.0, 0.0)[: model.dimension], **axis)
    model.motor(pin, lambda t: seen.add(type(t)) or (1.0 if t < 0.1 else 0.5))
    problem = model.problem((0.0, 0.2))
    with pytest.raises(ValueError, match="f of 'motor of"):
        solve_dae(problem.system, problem.t_span, problem.q0, problem.v0, compiled=True)
    assert solve_dae(problem.system, problem.t_span, problem.q0, problem.v0).success and seen == {float}
