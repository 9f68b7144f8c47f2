"""Test angles, displacements and rates of joints: as starts, as read-outs, in forces and events, and in tables."""

import pickle
from dataclasses import replace

import numpy as np
import pytest

from tests.bad_input.bodies import loop
from tests.bodies.runs import by_hand, moved
from twoloop.bodies import SpatialModel

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
