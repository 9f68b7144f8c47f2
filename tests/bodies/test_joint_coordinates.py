"""Test angles, displacements and rates of joints: as starts, as read-outs, in forces and events, and in tables."""

import pickle
from dataclasses import replace

import numpy as np
import pytest

from tests.bad_input.bodies import loop
from tests.bodies.runs import by_hand, moved
from twoloop import solve_with_stops
from twoloop.bodies import PlanarModel, SpatialModel

KINDS = ("revolute", "prismatic", "cylindrical", "revolute")


def chain(rng):
    """Four rods in space on joints of several kinds with random axes."""
    model, ends = SpatialModel(), np.cumsum(rng.normal(size=(5, 3)), axis=0)
    for k, kind in enumerate(KINDS):
        model.rod(f"rod {k}", ends[k], ends[k + 1], radius=0.05, mass=1.0)
        getattr(model, kind)(f"rod {k - 1}" if k else "ground", f"rod {k}", at=ends[k], axis=rng.normal(size=3))
    return model


@pytest.mark.parametrize("seed", range(2))
def test_an_open_chain_starts_as_given_and_its_other_joints_stand(seed):
    rng = np.random.default_rng(seed)
    model = chain(rng)
    keys = [(each.joint, each.which) for each in model.problem().joint_coordinates]
    wanted = [{key: rng.uniform(-5.0, 5.0) for key in keys if rng.random() < 0.7} for _ in range(2)]
    problem = model.problem(positions=wanted[0], rates=wanted[1])
    q, v, h = problem.q0, problem.v0, 1e-6
    for key in keys:
        coordinate = problem.joint_coordinate(*key)
        assert coordinate.position(q) == pytest.approx(wanted[0].get(key, 0.0), abs=1e-13)
        assert coordinate.rate(q, v) == pytest.approx(wanted[1].get(key, 0.0), abs=1e-12)
        sides = coordinate.position(np.array([q - h * v, q + h * v]).T)
        assert np.diff(sides)[0] / (2.0 * h) == pytest.approx(coordinate.rate(q, v), abs=1e-6)
    assert np.abs(problem.system.constraint(0.0, q)).max() < 1e-13
    again = problem.with_parameters({"mass of rod 1": 2.0})
    np.testing.assert_allclose([again.q0, again.v0], [q, v], atol=1e-12)


def angles_of_pins(crank, a=0.3, b=1.0, c=0.8, d=0.9):
    """Angles of the pins of crank, coupler and rocker, which stand above the frame, at an angle of the crank."""
    x, y = a * np.cos(crank) - d, a * np.sin(crank)
    far = np.hypot(x, y)
    rocker = np.arctan2(y, x) - np.arccos((far**2 + c**2 - b**2) / (2.0 * far * c))
    coupler = np.arctan2(c * np.sin(rocker) - y, c * np.cos(rocker) - x)
    return np.array([crank, coupler - crank, rocker - coupler, -rocker])


@pytest.mark.parametrize("crank", [-9.0, 2.9])
def test_a_loop_follows_its_crank_over_turns(crank):
    start, (*_, rocker) = angles_of_pins(0.4), -angles_of_pins(0.4)
    ends = [0.3 * np.exp(0.4j), 0.9 + 0.8 * np.exp(1j * rocker)]
    model = loop((0.0, 0.0), *((z.real, z.imag) for z in ends), (0.9, 0.0))
    angles = lambda crank: angles_of_pins(0.4 + crank) - start  # noqa: E731
    problem = model.problem(positions={"A": crank}, rates={model.joints[0]: 2.0})
    found = [problem.joint_coordinate(joint) for joint in model.joints]
    away = np.array([each.position(problem.q0) for each in found]) - angles(crank)
    np.testing.assert_allclose(np.exp(1j * away), 1.0, atol=1e-12)  # but for turns: angles() is not continuous
    slopes = (angles(crank + 1e-6) - angles(crank - 1e-6)) / 1e-6
    np.testing.assert_allclose([each.rate(problem.q0, problem.v0) for each in found], slopes, atol=1e-8)
    full = {each.joint: each.position(problem.q0) for each in found}  # more than needed, but they agree
    np.testing.assert_allclose(model.problem(positions=full).q0, problem.q0, atol=1e-9)


def ball_on_a_hinge():
    """A ball that turns about a skew axis through its centre, with a moment of inertia of 0.1 kg m^2, and its angle."""
    model = SpatialModel(name="ball")
    ball = model.body("ball", mass=1.0, inertia=(0.1, 0.1, 0.1), position=(0.1, 0.2, 0.3))
    hinge = model.revolute("ground", ball, at=(0.1, 0.2, 0.3), axis=(1.0, 2.0, -1.0), name="hinge")
    return model, hinge, model.joint_coordinate(hinge)


def test_a_wheel_in_space_is_counted_over_turns():
    """Between the stored times of the table it turns up to three times."""
    model, hinge, angle = ball_on_a_hinge()
    model.motor(hinge, lambda t, q, v: 0.5 * np.cos(t) - 0.01 * angle.rate(q, v))
    problem = model.problem((0.0, 3.0), positions={hinge: -0.5}, rates={"hinge": 60.0})
    result = moved(problem, t_eval=np.linspace(0.0, 3.0, 10))
    known = by_hand(lambda t, x, u: 5.0 * np.cos(t) - 0.1 * u, [-0.5, 60.0], result.t)
    assert np.diff(known[0]).max() > 18.0
    table = result.to_dataframe()
    np.testing.assert_allclose(table["angle of hinge (rad)"], known[0], atol=1e-7)
    np.testing.assert_allclose(table["angle of hinge, rate (rad/s)"], known[1], atol=1e-7)
    assert len(result.plot().axes) == 5  # m, Euler parameters, joints (rad), energy, violation
    assert np.isnan(angle.history(replace(result, v=1.2 * result.v))).any()  # what no motion is
    fine = moved(problem, t_eval=np.linspace(0.0, 3.0, 90))
    assert angle.position(fine.q)[-1] == pytest.approx(known[0, -1], abs=1e-7)


def test_a_motor_and_an_event_read_an_angle():
    model, hinge, angle = ball_on_a_hinge()
    model.motor(hinge, lambda t, q, v: -1.6 * (angle.position(q) - 0.3) + 0.0 * t)
    problem = pickle.loads(pickle.dumps(model.problem((0.0, 2.0), positions={hinge: 5.3})))
    assert problem.note == "1 degree of freedom."  # it is traced
    angle = problem.joint_coordinate("hinge")
    result = moved(problem, events=lambda t, q, v: angle.position(q) - 0.3)
    assert angle.position(result.q[:, -1]) == pytest.approx(0.3 + 5.0 * np.cos(8.0), abs=1e-9)
    np.testing.assert_allclose(result.t_events[0], (np.arange(3) + 0.5) * np.pi / 4.0, atol=1e-9)


def geared_discs(base, ratio):
    """Two discs that are hinged to a body and geared; the body is the ground, or free."""
    model = PlanarModel(name="gear", gravity=(0.0, 0.0))
    if base != "ground":
        model.body(base, mass=2.0, inertia=0.1, position=(0.0, 0.0))
    for name, x in (("one", 0.2), ("other", 0.5)):
        model.disc(f"disc {name}", 0.1, mass=1.0, position=(x, 0.0))
        model.revolute(base, f"disc {name}", at=(x, 0.0), name=name)
    model.gear("one", "other", ratio=ratio)
    return model


@pytest.mark.parametrize(("base", "angle"), [("satellite", 0.7), ("ground", -420.0)])
def test_gears_follow_a_given_position_and_rate_on_a_free_body_and_over_turns(base, angle):
    """On a free body, all bodies together may still move in any way when the gears do not."""
    problem = geared_discs(base, -1.7).problem(positions={"one": angle}, rates={"one": 2.0})
    angles = [problem.joint_coordinate(name) for name in ("one", "other")]
    np.testing.assert_allclose([each.position(problem.q0) for each in angles], [angle, -1.7 * angle], rtol=1e-9)
    np.testing.assert_allclose([each.rate(problem.q0, problem.v0) for each in angles], [2.0, -3.4], rtol=1e-9)
    assert np.abs(problem.v0).max() < 4.0


@pytest.mark.parametrize("tolerance", [1e-6, 1e-10])
def test_a_geared_motor_takes_no_shorter_steps_after_many_turns(tolerance):
    """The carrier, the sun and the planet turn with constant accelerations, in the end by thousands of rad."""
    model = PlanarModel(name="planetary gear", gravity=(0.0, 0.0))
    model.rod("carrier", (0.0, 0.0), (0.3, 0.0), mass=2.0)
    model.disc("sun", 0.1, mass=1.5, position=(0.0, 0.0))
    model.disc("planet", 0.2, mass=0.7, position=(0.3, 0.0))
    model.revolute("ground", "carrier", at=(0.0, 0.0))
    planet = model.revolute("carrier", "planet", at=(0.3, 0.0))
    sun = model.revolute("carrier", "sun", at=(0.0, 0.0))
    model.gear(sun, planet, ratio=-0.5)
    model.motor(sun, 5.0)
    problem = model.problem((0.0, 8.0), rates={sun: 20.0})
    result = moved(problem, "auto", tolerance)
    t, angles = result.t[-1], [2, 5, 8]
    expected = (problem.q0 + t * problem.v0 + 0.5 * t * t * result.a[:, 0])[angles]
    assert np.abs(expected).max() > 5000.0
    np.testing.assert_allclose(result.q[angles, -1], expected, rtol=10.0 * tolerance)
    assert result.stats.n_partitions < 10


@pytest.mark.parametrize("start", [-1.2, 3.0, 33.0])
def test_a_drive_moves_its_own_joint_to_its_start(start):
    arms = []
    for model, turned in ((PlanarModel(name="plane"), {}), (SpatialModel(name="space"), {"axis": (0.0, 1.0, 0.0)})):
        points = np.array([[0.0, 0.0, 0.0], [0.4, 0.0, 0.0], [0.8, 0.0, 0.0]])[:, : model.dimension]
        thick = {"radius": 0.02} if turned else {}
        model.rod("upper", points[0], points[1], mass=1.0, **thick)
        model.rod("lower", points[1], points[2], mass=0.7, **thick)
        shoulder = model.revolute("ground", "upper", at=points[0], name="shoulder", **turned)
        model.revolute("upper", "lower", at=points[1], name="elbow", **({"axis": (0.0, 0.0, 1.0)} if turned else {}))
        model.drive(shoulder, lambda t: start + 0.5 * t)
        arms.append(model.problem())
    for problem in arms:
        at = {name: problem.joint_coordinate(name).position(problem.q0) for name in ("shoulder", "elbow")}
        assert abs(at["elbow"]) < 1e-12
        np.testing.assert_allclose(np.exp(1j * at["shoulder"]), np.exp(1j * start), atol=1e-12)
        moved(problem)


def test_gears_in_space_start_beyond_half_a_turn():
    model = SpatialModel(name="gear")
    for name, x in (("one", 0.0), ("other", 1.0)):
        model.body(f"wheel {name}", mass=1.0, inertia=(0.1, 0.1, 0.2), position=(x, 0.0, 0.0))
        model.revolute("ground", f"wheel {name}", at=(x, 0.0, 0.0), axis=(0.0, 0.0, 1.0), name=name)
    model.gear("one", "other", ratio=1.5)
    q = model.problem(positions={"one": 4.5}).q0
    np.testing.assert_allclose(2.0 * np.arctan2(q[[6, 13]], q[[3, 10]]) % (2.0 * np.pi), [4.5, 6.75 - 2.0 * np.pi])


def test_a_step_beyond_the_limits_of_a_hinge_in_space_ends_at_them():
    """Beyond 0.95 of a turn the angle has no value."""
    model, speed, e = SpatialModel(name="hinge", gravity=(0.0, 0.0, 0.0)), 200.0, 0.9
    wheel = model.body("wheel", mass=1.0, inertia=(0.1, 0.1, 0.2), position=(0.0, 0.0, 0.0))
    hinge = model.revolute("ground", wheel, at=(0.0, 0.0, 0.0), axis=(0.0, 0.0, 1.0), name="hinge")
    model.limit(hinge, lower=-5.5, upper=5.5, restitution=e)
    problem = model.problem((0.0, 10.0), rates={hinge: speed})
    result = solve_with_stops(problem.system, problem.t_span, problem.q0, problem.v0, problem.stops)
    times = np.cumsum([5.5 / speed, *(11.0 / (speed * e**k) for k in range(1, 60))])
    times = times[times < 10.0]
    assert result.success
    np.testing.assert_allclose([impact.t for impact in result.impacts], times, rtol=1e-6)
    rate = problem.joint_coordinate("hinge").rate(result.q[:, -1], result.v[:, -1])
    assert rate == pytest.approx((-e) ** len(times) * speed, rel=1e-6)
