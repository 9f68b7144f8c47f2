"""Test gears, racks, wheels that roll and points on curves, against equations in least coordinates."""

import numpy as np
import pytest

from tests.bodies.runs import by_hand, moved
from tests.marks import slow
from twoloop import mechanisms, solve_dae
from twoloop.bodies import PlanarModel, SpatialModel

GRAVITY = 9.81
TIMES = np.linspace(0.0, 1.0, 6)


def run_of(model, method="DOP853"):
    problem = model.problem((0.0, TIMES[-1]))
    return problem, moved(problem, method, t_eval=TIMES)


@pytest.mark.parametrize("method", ["RadauIIA9", slow("auto")])
def test_a_train_of_gears(method):
    model = PlanarModel()
    model.disc("small", 0.1, mass=2.0, position=(0.0, 0.0), angle=0.3, angular_velocity=4.0)
    model.body("large", mass=3.0, inertia=0.05, position=(0.35, 0.05))
    one, other = model.revolute("ground", "small", at=(0.0, 0.0)), model.revolute("ground", "large", at=(0.3, 0.0))
    gear = model.gear(one, other, ratio=-0.5)
    model.motor(one, lambda t: np.cos(t))
    problem, result = run_of(model, method)
    at, away = np.arctan2(0.05, 0.05), np.hypot(0.05, 0.05)
    inertia = 0.01 + 0.25 * (0.05 + 3.0 * away**2)

    def acceleration(t, turned, rate):
        return (np.cos(t) + 0.5 * 3.0 * GRAVITY * away * np.cos(at - 0.5 * turned)) / inertia

    known = by_hand(acceleration, [0.0, 4.0], TIMES)
    np.testing.assert_allclose(result.q[2] - 0.3, known[0], atol=1e-9)
    np.testing.assert_allclose(result.q[5], -0.5 * known[0], atol=1e-9)
    assert problem.freedom.degrees == 1
    torque = result.reactions(gear.name).torque  # on the large wheel
    weight = 3.0 * GRAVITY * away * np.cos(at - 0.5 * known[0])
    alpha = np.array([acceleration(t, *state) for t, state in zip(TIMES, known.T, strict=True)])
    np.testing.assert_allclose(torque, -0.5 * alpha * (0.05 + 3.0 * away**2) + weight, atol=1e-7)


def bevel(ratio, axis, **motion):
    """Two wheels in space on axes of their own, the second with its weight beside its axis; and their hinges."""
    model = SpatialModel()
    model.body("one", mass=1.0, inertia=(0.1, 0.1, 0.2), position=(0.0, 0.0, 0.0), **motion)
    model.body("two", mass=2.0, inertia=(0.5, 0.4, 0.3), position=(1.0, 0.2, 0.1))
    hinges = (
        model.revolute("ground", "one", at=(0.0, 0.0, 0.0), axis=(0.0, 0.0, 1.0)),
        model.revolute("two", "ground", at=(1.0, 0.0, 0.0), axis=-np.array(axis)),  # the ground second: same sense
    )
    return model, hinges, model.gear(*hinges, ratio=ratio)


@pytest.mark.parametrize(("ratio", "method"), [(-17.0 / 43.0, "DOP853"), slow(2.0, "RadauIIA9")])
def test_bevel_gears(ratio, method):
    """Through many turns, of which Euler parameters know nothing."""
    axis = np.array([0.6, 0.0, 0.8])
    model, (one, _), gear = bevel(ratio, axis, angular_velocity=(0.0, 0.0, 20.0))
    model.motor(one, lambda t: 5.0 * np.cos(t))
    problem, result = run_of(model, method)
    arm, J = np.array([0.0, 0.2, 0.1]), np.diag([0.5, 0.4, 0.3])
    across = arm - axis * (axis @ arm)
    inertia = axis @ J @ axis + 2.0 * across @ across

    def load(turned):  # torque of the weight about the axis, against that of the gear
        here = np.cos(turned) * across + np.sin(turned) * np.cross(axis, across)
        return 2.0 * GRAVITY * (axis @ np.cross(here + axis * (axis @ arm), (0.0, 0.0, 1.0)))

    def acceleration(t, turned, rate):
        return (5.0 * np.cos(t) - ratio * load(ratio * turned)) / (0.2 + ratio**2 * inertia)

    known = by_hand(acceleration, [0.0, 20.0], TIMES)
    assert known[0, -1] > 3.0 * np.pi
    np.testing.assert_allclose(result.q[[3, 6]], [np.cos(0.5 * known[0]), np.sin(0.5 * known[0])], atol=2e-8)
    half = 0.5 * ratio * known[0]
    np.testing.assert_allclose(result.q[10:14], [np.cos(half), *np.outer(axis, np.sin(half))], atol=2e-8)
    assert problem.freedom.degrees == 1 and not problem.freedom.redundant
    torque = result.reactions(gear.name).torque[:, 0] @ axis  # on the second wheel
    alpha = ratio * acceleration(0.0, 0.0, 20.0)
    np.testing.assert_allclose(torque, inertia * alpha + load(0.0), atol=1e-6)


def test_a_gear_in_space_stays_at_its_tooth_when_bodies_are_assembled():
    model, (one, _), _ = bevel(-200.0 / 201.0, (0.0, 0.6, 0.8))
    model.drive(one, lambda t: 0.8 + 3.0 * t)
    problem = model.problem()
    half = -0.4 * 200.0 / 201.0
    np.testing.assert_allclose(problem.q0[10:14], [np.cos(half), 0.0, *np.array([0.6, 0.8]) * np.sin(half)], atol=1e-12)
    other = problem.q0.copy()  # at the next tooth
    half += np.pi / 201.0
    other[10:14] = np.cos(half), 0.0, 0.6 * np.sin(half), 0.8 * np.sin(half)
    with pytest.raises(ValueError, match=r"does not mesh at t = 0 as in the position given: .* is 0.03125"):
        model._check_branches(0.0, other)


def test_a_wheel_that_rolls_down_a_slope_that_slides():
    m, M, r, tilt = 1.0, 2.0, 0.1, 0.5
    along, up = np.array([np.cos(tilt), np.sin(tilt)]), np.array([-np.sin(tilt), np.cos(tilt)])
    model = PlanarModel()
    model.body("wedge", mass=M, inertia=1.0, position=(0.0, 0.0))
    model.disc("wheel", r, mass=m, position=0.5 * along + r * up)
    model.prismatic("ground", "wedge", at=(0.0, 0.0), axis=(1.0, 0.0))
    joint = model.rolling("wedge", "wheel", radius=r, axis=along)
    problem, result = run_of(model)
    c = np.cos(tilt)
    s, x = np.linalg.solve(np.array([[1.5 * m, m * c], [m * c, m + M]]), [-m * GRAVITY * np.sin(tilt), 0.0])
    np.testing.assert_allclose(result.q[0], 0.5 * x * TIMES**2, atol=1e-9)
    np.testing.assert_allclose(result.q[5], -0.5 * s / r * TIMES**2, atol=1e-8)
    assert problem.freedom.degrees == 2 and problem.conserved and np.ptp(result.energy) < 1e-9
    force = result.reactions(joint.name).force  # on the wedge; the opposite and its weight move the wheel
    np.testing.assert_allclose(-force[1] - m * GRAVITY, m * result.a[4], atol=1e-7)


def test_a_bead_on_a_cycloid_is_isochronous():
    """C. Huygens: the period is that of small oscillations, 4 pi sqrt(r / g), whatever the amplitude."""
    r = 0.2
    model = PlanarModel()

    def cycloid(x, y):  # the branch about the bottom at the origin
        turn = np.arctan(np.sqrt(y / (2.0 * r - y)))
        return x * x - (2.0 * r * (turn + np.sin(turn) * np.cos(turn))) ** 2

    half = 0.9  # of the parameter: the height is 2 r sin(half)^2
    place = (2.0 * r * (half + np.sin(half) * np.cos(half)), 2.0 * r * np.sin(half) ** 2)
    model.point_on_curve("ground", model.body("bead", mass=1.0, inertia=1.0, position=place), at=place, curve=cycloid)
    problem = model.problem()
    quarter = np.pi * np.sqrt(r / GRAVITY)
    result = solve_dae(problem.system, (0.0, 0.9 * quarter), problem.q0, problem.v0, rtol=1e-10, atol=1e-10)
    arc = 4.0 * r * np.sin(half) * np.cos(0.5 * np.sqrt(GRAVITY / r) * 0.9 * quarter)  # from the bottom, of its end
    turn = np.arcsin(arc / (4.0 * r))
    np.testing.assert_allclose(result.q[0, -1], 2.0 * r * (turn + np.sin(turn) * np.cos(turn)), atol=1e-8)
    assert problem.freedom.degrees == 2  # along the curve, and turning


def test_a_rolling_disc_in_space():
    known = mechanisms.rolling_disc()
    p = known.parameters
    yaw, lean, _ = p["angles"]
    m, r = p["mass"], p["radius"]
    c, s = np.cos(lean), np.sin(lean)
    ahead, axle = np.array([np.cos(yaw), np.sin(yaw), 0.0]), np.array([np.sin(yaw) * c, -np.cos(yaw) * c, -s])
    turn, fall, spin = known.v0[3:]
    w = turn * np.array([0.0, 0.0, 1.0]) + fall * ahead + spin * axle
    model = SpatialModel(gravity=(0.0, 0.0, -p["gravity"]))
    R = np.column_stack([ahead, axle, np.cross(ahead, axle)])
    pose = {"position": known.q0[:3], "rotation": R, "velocity": known.v0[:3], "angular_velocity": w}
    wheel = model.body("wheel", mass=m, inertia=m * r * r * np.array([0.25, 0.5, 0.25]), **pose)
    joint = model.rolling(wheel, radius=r, axis=axle)
    problem = model.problem((0.0, 2.0))
    found, theirs = (moved(each, "auto", 1e-10) for each in (problem, known))
    np.testing.assert_allclose(found.q[:3, -1], theirs.q[:3, -1], atol=1e-7)
    assert problem.conserved and np.ptp(found.energy) < 1e-7
    force = found.reactions(joint.name).force
    np.testing.assert_allclose(force - [[0.0], [0.0], [m * p["gravity"]]], m * found.a[:3], atol=1e-6)


def test_a_skate_on_a_slope():
    """The blade turns evenly, and its speed is what the slope makes of its direction."""
    model, spin = PlanarModel(gravity=(0.0, -3.0)), 1.7
    blade = model.body("blade", mass=2.0, inertia=0.3, position=(0.0, 0.0), angular_velocity=spin)
    joint = model.skate(blade, at=(0.0, 0.0), axis=(1.0, 0.0))
    problem, result = run_of(model)
    phase, scale = spin * TIMES, 3.0 / spin**2
    x, y = 0.5 * phase + 0.25 * np.sin(2.0 * phase) - np.sin(phase), 0.5 * np.sin(phase) ** 2 + np.cos(phase) - 1.0
    np.testing.assert_allclose(result.q[:2], scale * np.array([x, y]), atol=1e-9)
    np.testing.assert_allclose(result.q[2], phase, atol=1e-9)
    assert problem.system.n_a == 1 and problem.conserved and np.ptp(result.energy) < 1e-9
    np.testing.assert_allclose(result.reactions(joint.name).force - [[0.0], [6.0]], 2.0 * result.a[:2], atol=1e-8)
