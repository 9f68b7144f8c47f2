"""Dry friction that sticks: motions in closed form, and what is asked wrongly."""

import numpy as np
import pytest

from twoloop import solve_with_friction
from twoloop.bodies import PlanarModel, SpatialModel

TIGHT = {"rtol": 1e-11, "atol": 1e-11}


def changes(result):
    """Times at which joints begin to slide or to stick."""
    assert result.success, result.message
    return np.array([arc.t[0] for arc in result.arcs[1:]])


def incline(f, speed, angle=0.0, spatial=False):
    """A block of 2 kg that is pushed up a slope; all is turned by an angle."""
    total = 0.5 + angle
    along, g = np.array([np.cos(total), np.sin(total)]), 9.81 * np.array([np.sin(angle), -np.cos(angle)])
    if spatial:
        model = SpatialModel((*g, 0.0))
        up = np.array([*along, 0.0])
        model.body("block", mass=2.0, inertia=(0.1, 0.1, 0.1), position=(0.3, 0.2, 0.0), velocity=speed * up)
    else:
        model, up = PlanarModel(g), along
        model.body("block", mass=2.0, inertia=0.1, position=(0.3, 0.2), velocity=speed * up)
    guide = model.prismatic("ground", "block", at=(0.3, 0.2, 0.0)[: len(up)], axis=up)
    model.dry_friction(guide, f)
    return model.problem((0.0, 2.0)), up


@pytest.mark.parametrize("spatial", [False, True])
@pytest.mark.parametrize("angle", [0.0, 1.9])
def test_a_block_on_a_slope_stops_and_sticks(spatial, angle):
    problem, up = incline(12.0, 3.0, angle=angle, spatial=spatial)
    result = solve_with_friction(problem, **TIGHT)
    pull = 9.81 * np.sin(0.5)
    end = 3.0 / (pull + 6.0)
    np.testing.assert_allclose(changes(result), [end], atol=1e-9)
    place = problem.q0[: len(up)] + 4.5 / (pull + 6.0) * up
    np.testing.assert_allclose(result.q[: len(up), -1], place, atol=1e-9)
    assert "dry friction of prismatic block-ground sticks" in result.arcs[-1].system.name


def test_a_block_on_a_slope_turns_round():
    problem, up = incline(5.0, 3.0)
    result = solve_with_friction(problem, t_eval=[0.0, 1.0, 2.0], **TIGHT)
    pull = 9.81 * np.sin(0.5)
    end = 3.0 / (pull + 2.5)
    np.testing.assert_allclose(changes(result), [end], atol=1e-9)
    back = 4.5 / (pull + 2.5) - 0.5 * (pull - 2.5) * (2.0 - end) ** 2
    np.testing.assert_allclose(result.q[:2, -1], problem.q0[:2] + back * up, atol=1e-9)
    assert result.t.tolist() == [0.0, 1.0, 2.0] and result.lam.shape == (2, 3)


@pytest.mark.parametrize("spatial", [False, True])
def test_a_rotor_on_a_torsion_spring_loses_as_much_in_every_half_turn(spatial):
    J, k, f, start = 0.4, 3.0, 0.25, 2.5
    pose = {"mass": 1.0, "position": (0.0, 0.0, 0.0)}
    if spatial:
        model = SpatialModel()
        rotor = model.body("rotor", inertia=(J, J, J), **pose)
        hinge = model.revolute("ground", rotor, at=(0, 0, 0), axis=(0.0, 0.0, 1.0))
    else:
        model = PlanarModel()
        rotor = model.body("rotor", inertia=J, mass=1.0, position=(0.0, 0.0))
        hinge = model.revolute(rotor, "ground", at=(0, 0))  # the ground turns on it
    model.torsion_spring(hinge, stiffness=k, angle=-start if rotor is hinge.b else start)
    model.dry_friction(hinge, f)
    result = solve_with_friction(model.problem((0.0, 20.0)), **TIGHT)
    half = np.pi / np.sqrt(k / J)
    n = int(np.ceil((start - f / k) / (2.0 * f / k)))  # half turns until the spring cannot overcome the friction
    np.testing.assert_allclose(changes(result), half * np.arange(1, n + 1), atol=1e-9)
    left = start - 2.0 * n * f / k  # of the deflection, its sign changing
    angle = 2.0 * np.arctan2(result.q[6, -1], result.q[3, -1]) if spatial else result.q[2, -1]
    assert angle == pytest.approx(-start + left * (-1) ** n, abs=1e-9)
    assert abs(left) <= f / k and np.abs(result.v[:, -1]).max() < 1e-12


def test_a_block_on_a_belt_sticks_and_slips():
    m, k, speed, kinetic, static = 1.5, 40.0, 0.3, 4.0, 6.0
    model = PlanarModel()
    model.body("belt", mass=1.0, inertia=1.0, position=(0.0, -0.1))
    block = model.body("block", mass=m, inertia=0.1, position=(0.0, 0.0))
    drum = model.prismatic("ground", "belt", at=(0.0, -0.1), axis=(1.0, 0.0))
    face = model.prismatic("belt", block, at=(0.0, 0.0), axis=(1.0, 0.0))
    model.drive(drum, lambda t: speed * t)
    model.dry_friction(face, kinetic, static=static)
    model.spring("ground", (-2.0, 0.0), block, (0.0, 0.0), stiffness=k)
    problem = model.problem((0.0, 4.0))
    assert problem.v0[3] == 0.0  # at rest: it slides at first
    result = solve_with_friction(problem, **TIGHT)
    w, x0, x1 = np.sqrt(k / m), kinetic / k, static / k
    caught = np.arcsin(speed / (w * x0)) / w  # from rest: x = x0 (1 - cos wt) is as fast as the belt then
    slip = 2.0 * (np.pi - np.arctan((x1 - x0) * w / speed)) / w
    hold = (x1 - (x0 - (x1 - x0))) / speed  # it is caught at 2 x0 - x1, the mirror image of where it was released
    first = caught + (x1 - x0 * (1.0 - np.cos(w * caught))) / speed
    expected = [caught, *(first + k * (slip + hold) + shift for k in range(9) for shift in (0.0, slip))]
    found = changes(result)
    np.testing.assert_allclose(found, expected[: len(found)], atol=1e-9)
    assert len(found) >= 6


def test_two_blocks_of_which_one_holds_the_other():
    """A pushes B by a spring: A slides until it stops, then both hold, each with friction that depends on the other."""
    model = PlanarModel()
    for name, x, v in (("A", 0.0, 1.2), ("B", 1.0, 0.0)):
        model.body(name, mass=1.0, inertia=0.1, position=(x, 0.0), velocity=(v, 0.0))
        model.dry_friction(model.prismatic("ground", name, at=(x, 0.0), axis=(1.0, 0.0)), 3.0, static=3.5)
    model.spring("A", (0.0, 0.0), "B", (1.0, 0.0), stiffness=20.0)
    result = solve_with_friction(model.problem((0.0, 3.0)), **TIGHT)
    w = np.sqrt(20.0)  # x_A = -(3/20) (1 - cos wt) + 1.2 / w sin wt, while B sticks
    slide = np.arctan2(1.2 / w, 3.0 / 20.0) / w
    most = -0.15 + np.hypot(0.15, 1.2 / w)
    assert 20.0 * most < 3.5  # B is never overcome
    np.testing.assert_allclose(changes(result)[0], slide, atol=1e-9)
    assert result.q[0, -1] == pytest.approx(most, abs=1e-9) and result.q[3, -1] == pytest.approx(1.0, abs=1e-12)


def rotor(torque, **friction):
    """A rotor without weight under a torque."""
    model = PlanarModel((0.0, 0.0))
    model.body("rotor", mass=1.0, inertia=0.5, position=(0.0, 0.0))
    hinge = model.revolute("ground", "rotor", at=(0.0, 0.0))
    model.dry_friction(hinge, 1.0, **friction)
    model.motor(hinge, torque)
    return model.problem((0.0, 4.0))


def test_static_friction_is_overcome_and_one_in_balance_holds():
    released = solve_with_friction(rotor(lambda t: t, static=1.5), **TIGHT)
    np.testing.assert_allclose(changes(released), [1.5], atol=1e-9)
    assert released.v[2, -1] == pytest.approx((16.0 - 2.25) - 2.0 * 2.5, abs=1e-9)
    held = solve_with_friction(rotor(1.0), **TIGHT)
    assert len(held.arcs) == 1 and not held.v.any()
    at_once = solve_with_friction(rotor(lambda t: 1.0 + t), **TIGHT)  # friction is at its most from the start
    assert at_once.v[2, -1] == pytest.approx(16.0, abs=1e-7)


def test_a_block_on_a_cart_is_caught_and_both_stop():
    model = PlanarModel()
    model.body("cart", mass=2.0, inertia=1.0, position=(0.0, 0.0))
    model.body("block", mass=1.0, inertia=1.0, position=(0.0, 0.2), velocity=(2.0, 0.0))
    model.dry_friction(model.prismatic("ground", "cart", at=(0.0, 0.0), axis=(1.0, 0.0)), 2.0)
    model.dry_friction(model.prismatic("cart", "block", at=(0.0, 0.2), axis=(1.0, 0.0)), 5.0)
    problem = model.problem((0.0, 5.0))
    problem.v0[:] = [0.0, 0.0, 0.0, 2.0, 0.0, 0.0]
    result = solve_with_friction(problem, **TIGHT)
    caught, speed = 2.0 / 6.5, 3.0 / 6.5  # decelerations -5 and (5 - 2) / 2, then 2 / 3 together
    np.testing.assert_allclose(changes(result), [caught, caught + 1.5 * speed], atol=1e-9)
    assert result.q[0, -1] == pytest.approx(0.75 * caught**2 + 0.75 * speed**2, abs=1e-9)
    lighter = solve_with_friction(problem.with_parameters({"mass of block": 0.5}), **TIGHT)
    assert lighter.success and lighter.q[0, -1] < result.q[0, -1]


def double_pendulum(kind):
    points = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0]])
    flat = kind is PlanarModel
    model = kind((0.0, -9.81) if flat else (0.0, -9.81, 0.0))
    axis = {} if flat else {"axis": (0.0, 0.0, 1.0)}
    for k, name in enumerate("ab"):
        one, other = points[k], points[k + 1]
        if flat:
            model.body(name, mass=1.0, inertia=0.1, position=0.5 * (one + other))
        else:
            model.body(name, mass=1.0, inertia=(0.1, 0.1, 0.1), position=np.append(0.5 * (one + other), 0.0))
        joint = model.revolute("ab"[k - 1] if k else "ground", name, at=one if flat else np.append(one, 0.0), **axis)
        model.dry_friction(joint, (1.0, 0.5)[k], static=(1.6, 0.5)[k])
    return model.problem((0.0, 1.6))


def test_a_double_pendulum_by_unlike_methods_in_a_plane_and_in_space():
    problem = double_pendulum(PlanarModel)
    known = solve_with_friction(problem, method="DOP853", **TIGHT)
    assert len(changes(known)) >= 5
    assert np.diff(problem.energy(known.t, known.q, known.v)).max() < 1e-12  # friction takes energy only
    for other, method in ((problem, "RadauIIA9"), (double_pendulum(SpatialModel), "DOP853")):
        result = solve_with_friction(other, method=method, **TIGHT)
        np.testing.assert_allclose(changes(result), changes(known), atol=1e-9)


def test_wheels_that_mesh_come_to_rest():
    """What rounding leaves of their rates is no motion."""
    model = PlanarModel((0.0, 0.0))
    model.disc("small", 0.1, mass=1.0, position=(0.0, 0.0), angular_velocity=5.0)
    model.disc("large", 0.2, mass=1.0, position=(0.3, 0.0))
    pins = [model.revolute("ground", name, at=(x, 0.0)) for name, x in (("small", 0.0), ("large", 0.3))]
    model.gear(*pins, ratio=-0.5)
    model.dry_friction(pins[0], 0.1)
    result = solve_with_friction(model.problem((0.0, 2.0)), **TIGHT)
    np.testing.assert_allclose(changes(result), [5.0 * (0.005 + 0.25 * 0.02) / 0.1], atol=1e-9)
    assert not result.v[:, -1].any()


def test_what_the_problem_says_of_dry_friction():
    problem = rotor(1.0)
    assert "solve_with_friction handles its dry friction" in problem.note and not problem.conserved
    assert not any("friction" in name for name in problem.parameters)


def test_a_short_push_releases_a_joint_that_sticks():
    """For a two-hundredth of the run friction is exceeded, by little, while nothing else moves."""
    model = PlanarModel((0.0, 0.0))
    model.body("block", mass=1.0, inertia=1.0, position=(0.0, 0.0))
    guide = model.prismatic("ground", "block", at=(0.0, 0.0), axis=(1.0, 0.0))
    model.dry_friction(guide, 1.0)
    model.motor(guide, lambda t: 0.5 + 0.6 * np.exp(-(((t - 5.0) / 0.05) ** 2)))
    result = solve_with_friction(model.problem((0.0, 10.0)), **TIGHT)
    start = 5.0 - 0.05 * np.sqrt(np.log(1.2))
    assert result.success and changes(result)[0] == pytest.approx(start, abs=1e-8)
    assert result.q[0, -1] == pytest.approx(1.0476e-4, rel=1e-4)
