"""Motions of models against equations written by hand in least coordinates, and integrated by SciPy."""

import numpy as np
import pytest

from tests.bodies.runs import by_hand, moved
from twoloop import ensemble, solve_dae
from twoloop.bodies import PlanarModel, SpatialModel

TIMES = np.linspace(0.0, 3.0, 7)
GRAVITY = 9.81
pytestmark = pytest.mark.filterwarnings("ignore::twoloop.ConstraintWarning")  # planar loops in space


def run_of(model, method="auto", times=TIMES):
    problem = model.problem((0.0, times[-1]))
    return problem, moved(problem, method, t_eval=times)


def test_a_damped_pendulum_with_torsion_spring_and_motor():
    m, L, J, k, c, rest = 1.3, 0.7, 0.05, 2.0, 0.3, 0.4
    model = PlanarModel()
    bar = model.body("bar", mass=m, inertia=J, position=(L, 0.0), angle=0.2, angular_velocity=1.5)
    pin = model.revolute("ground", bar, at=(0.0, 0.0))
    model.torsion_spring(pin, stiffness=k, damping=c, angle=rest)
    model.motor(pin, lambda t: 2.0 * np.sin(3.0 * t))
    problem, result = run_of(model)

    def acceleration(t, x, v):
        torque = -k * (x - rest) - c * v + 2.0 * np.sin(3.0 * t) - m * GRAVITY * L * np.cos(x)
        return torque / (J + m * L**2)

    known = by_hand(acceleration, [0.0, 1.5], TIMES)  # the angle from where the bar is given
    np.testing.assert_allclose(result.q[2] - 0.2, known[0], atol=1e-8)
    np.testing.assert_allclose(result.v[2], known[1], atol=1e-8)
    assert problem.conserved is False


def cart(model, force, dashpot):
    """A cart on a rail with a pendulum, held by a spring and pushed by a motor."""
    sledge = model.body("cart", mass=2.0, inertia=0.1, position=(0.0, 0.0), velocity=(0.7, 0.0))
    rod = model.body("rod", mass=0.5, inertia=0.02, position=(0.0, -0.6), angle=-0.5 * np.pi, angular_velocity=2.0)
    rail = model.prismatic("ground", sledge, at=(0.0, 0.0), axis=(3.0, 0.0))
    model.revolute(sledge, rod, at=(0.0, 0.0))
    model.spring("ground", (-1.0, 0.3), sledge, (0.0, 0.3), stiffness=20.0, damping=dashpot, length=0.8)
    model.motor(rail, force)
    return model


@pytest.mark.parametrize("feedback", [False, True])
def test_a_cart_with_a_pendulum_spring_and_motor(feedback):
    def of_time(t):
        return 3.0 * np.cos(2.0 * t)

    def of_state(t, q, v):
        return 3.0 * np.cos(2.0 * t) - 1.5 * v[0] - 0.2 * q[5] ** 2

    problem, result = run_of(cart(PlanarModel(), of_state if feedback else of_time, 0.4))
    M, m, L, J = 2.0, 0.5, 0.6, 0.02

    def acceleration(t, z, rate):
        x, turn = z  # of the pendulum from the vertical
        push = of_time(t) - (1.5 * rate[0] + 0.2 * (turn - 0.5 * np.pi) ** 2 if feedback else 0.0)
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


def test_a_driven_slide_in_space_carries_a_spring_mass():
    model = SpatialModel(gravity=(0.0, 0.0, 0.0))
    along = np.array([1.0, 2.0, 2.0]) / 3.0
    table = model.body("table", mass=1.0, inertia=(1.0, 1.0, 1.0), position=(0.0, 0.0, 0.0))
    mass = model.body("mass", mass=0.5, inertia=(1.0, 1.0, 1.0), position=along)
    slide = model.prismatic("ground", table, at=(0.0, 0.0, 0.0), axis=along)
    model.drive(slide, lambda t: 0.2 * np.sin(5.0 * t))
    second = model.prismatic(table, mass, at=(0.0, 0.0, 0.0), axis=along)
    model.spring(table, (0.0, 0.0, 0.0), mass, along, stiffness=30.0, damping=0.2, length=0.9)
    model.motor(second, 0.3)
    _, result = run_of(model)

    def acceleration(t, x, v):
        s, rate = 0.2 * np.sin(5.0 * t), np.cos(5.0 * t)
        return (-30.0 * (x - s - 0.9) - 0.2 * (v - rate) + 0.3) / 0.5

    known = by_hand(acceleration, [1.0, 0.0], TIMES)
    place = along @ result.q[7:10]
    rest = by_hand(acceleration, [1.0, along @ result.v[7:10, 0]], TIMES)
    assert np.abs(rest[0] - place).max() < 1e-8 and known.shape == rest.shape


def test_functions_that_branch_are_called_in_python_and_do_the_same():
    def smooth(t):
        return 3.0 * np.cos(2.0 * t)

    def branching(t):
        return 3.0 * float(np.cos(2.0 * t)) if t < 1e9 else 0.0

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


def test_a_function_that_remembers_is_called_in_python():
    calls = []

    def counting(t):
        calls.append(t)
        return 0.1 * len(calls)

    problem = cart(PlanarModel(), counting, 0.4).problem()
    assert problem.system.called_in_python and "when it was traced" in problem.note


def test_many_runs_with_parameters_by_name():
    problem = cart(PlanarModel(), lambda t: 3.0 * np.cos(2.0 * t), 0.4).problem((0.0, 1.0))
    P = np.tile(problem.system.parameters, (3, 1))
    P[:, problem.place("stiffness of spring cart-ground")] = (10.0, 20.0, 33.3)
    P[:, problem.place("mass of rod")] = (0.5, 0.7, 1.1)
    runs = ensemble(problem.system, problem.t_span, problem.q0, problem.v0, parameters=P, rtol=1e-10, atol=1e-10)
    assert runs.success.all()
    for k in (0, 2):
        changed = {"stiffness of spring cart-ground (N/m)": P[k, problem.place("stiffness of spring cart-ground")]}
        again = problem.with_parameters({**changed, "mass of rod": P[k, problem.place("mass of rod")]})
        np.testing.assert_allclose(again.system.parameters, P[k])
        np.testing.assert_allclose(runs.q[k, :, -1], moved(again).q[:, -1], atol=1e-8)


def loop(turn, move, spatial):
    """A four-bar with a slider, springs, a force that turns with space, and a drive; turned and moved as a whole."""

    def at(x, y):
        place = move + turn @ np.array([x, y, 0.0])
        return place if spatial else place[:2]

    def along(x, y):
        return turn @ np.array([x, y, 0.0]) if spatial else (turn @ np.array([x, y, 0.0]))[:2]

    axis = {"axis": turn[:, 2]} if spatial else {}
    model = SpatialModel(along(0.0, -GRAVITY)) if spatial else PlanarModel(along(0.0, -GRAVITY))
    angle = np.arctan2(turn[1, 0], turn[0, 0])

    def body(name, mass, x, y):
        pose = {"inertia": (0.3, 0.2, 0.1), "rotation": turn} if spatial else {"inertia": 0.1, "angle": angle}
        return model.body(name, mass=mass, position=at(x, y), **pose)

    crank, rod, rocker, block = body("a", 1.0, 0.0, 0.5), body("b", 2.0, 1.0, 1.1), body("c", 1.5, 2.0, 0.7), None
    block = body("d", 0.4, 1.0, 1.1)
    first = model.revolute("ground", crank, at=at(0.0, 0.0), **axis)
    model.revolute(crank, rod, at=at(0.0, 1.0), **axis)
    model.revolute(rod, rocker, at=at(2.0, 1.2), **axis)
    model.revolute(rocker, "ground", at=at(2.2, 0.0), **axis)
    slide = model.prismatic(rod, block, at=at(1.0, 1.1), axis=along(2.0, 0.2))
    model.spring(rod, at(0.0, 1.0), block, at(1.0, 1.1), stiffness=50.0, damping=1.0, length=0.9)
    model.torsion_spring(first, stiffness=1.0, angle=0.3)
    model.motor(first, lambda t: 4.0 * np.sin(t))
    model.motor(slide, 0.5)
    force = along(1.0, 2.0)
    model.force(rocker, at(2.0, 0.5), lambda t: force * t)
    return model


@pytest.mark.parametrize("spatial", [False, True])
def test_a_model_turned_and_moved_as_a_whole_moves_alike(spatial):
    c, s = np.cos(0.7), np.sin(0.7)
    turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    if spatial:
        turn = turn @ np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])
    move, times = np.array([3.0, -4.0, 5.0 * spatial]), np.linspace(0.0, 1.5, 4)
    one, other = (run_of(loop(*place, spatial), "DOP853", times) for place in ((np.eye(3), np.zeros(3)), (turn, move)))
    n, width = (2, 3) if not spatial else (3, 7)
    there = np.einsum("ij,kjt->kit", turn[:n, :n], one[1].q.reshape(4, width, -1)[:, :n]) + move[:n, None]
    np.testing.assert_allclose(other[1].q.reshape(4, width, -1)[:, :n], there, atol=1e-8)
    energies = [problem.energy(result.t, result.q, result.v) for problem, result in (one, other)]
    np.testing.assert_allclose(*(each - each[0] for each in energies), atol=1e-7)
    if not spatial:  # where they are not unique
        force = [result.reactions("revolute c-ground").force for _, result in (one, other)]
        np.testing.assert_allclose(force[1], turn[:2, :2] @ force[0], atol=1e-6)


def test_a_plane_and_space_agree():
    times = np.linspace(0.0, 1.5, 4)
    one, other = (run_of(loop(np.eye(3), np.zeros(3), spatial), "DOP853", times) for spatial in (False, True))
    np.testing.assert_allclose(one[1].q.reshape(4, 3, -1)[:, :2], other[1].q.reshape(4, 7, -1)[:, :2], atol=1e-8)
    np.testing.assert_allclose(
        *(problem.energy(result.t, result.q, result.v) for problem, result in (one, other)), atol=1e-7
    )


def test_a_torsion_spring_in_space_counts_more_than_half_a_turn():
    model = SpatialModel(gravity=(0.0, 0.0, 0.0))
    wheel = model.body("wheel", mass=1.0, inertia=(1.0, 1.0, 2.0), position=(0.0, 0.0, 0.0), angular_velocity=(0, 0, 3))
    hinge = model.revolute("ground", wheel, at=(0.0, 0.0, 0.0), axis=(0.0, 0.0, 5.0))
    model.torsion_spring(hinge, stiffness=0.9)
    problem, result = run_of(model, times=np.linspace(0.0, 5.0, 11))
    frequency = np.sqrt(0.45)
    angle = 3.0 / frequency * np.sin(frequency * result.t)  # to 256 degrees
    np.testing.assert_allclose(result.q[6], np.sin(0.5 * angle), atol=1e-8)
    assert problem.conserved and np.ptp(problem.energy(result.t, result.q, result.v)) < 1e-8


@pytest.mark.parametrize("method", ["auto", "DOP853", "RadauIIA9", "TRBDF2"])
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


def test_docstrings_of_what_adds_to_a_model_are_whole():
    for model in (PlanarModel, SpatialModel):
        for name in ("body", "rod", "box", "revolute", "prismatic", "fixed", "distance", "spring", "motor", "limit"):
            text = getattr(model, name).__doc__
            parts = [text.index(f"{part}\n") for part in ("Parameters", "Returns", "Raises")]
            assert parts == sorted(parts), name
            assert all(text.count(f"{part}\n") == 1 for part in ("Parameters", "Returns", "Raises")), name
