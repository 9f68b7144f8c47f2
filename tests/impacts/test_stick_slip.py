"""Test dry friction that sticks, alone and with stops, in closed form."""

import numpy as np
import pytest

from tests.marks import slow
from twoloop import solve_with_friction
from twoloop.bodies import PlanarModel, SpatialModel

TIGHT = {"rtol": 1e-11, "atol": 1e-11}
WEIGHT = 9.81


def changes(result):
    """Times at which joints begin to slide or to stick."""
    assert result.success, result.message
    return np.array([arc.t[0] for arc in result.arcs[1:]])


def block(slope, f, speed, spatial=False, **limits):
    """A block of 2 kg on a slope, with dry friction and limits of its guide."""
    up = np.array([np.cos(slope), np.sin(slope), 0.0])
    if spatial:
        model = SpatialModel((0.0, -WEIGHT, 0.0), name="block")
        model.body("block", mass=2.0, inertia=(0.1, 0.1, 0.1), position=(0, 0, 0), velocity=speed * up)
        guide = model.prismatic("ground", "block", at=(0, 0, 0), axis=up)
    else:
        model = PlanarModel(name="block")
        model.body("block", mass=2.0, inertia=0.1, position=(0.0, 0.0), velocity=speed * up[:2])
        guide = model.prismatic("ground", "block", at=(0.0, 0.0), axis=up[:2])
    model.dry_friction(guide, f)
    if limits:
        model.limit(guide, **limits)
    return model, up


def along(result, up):
    """How far the block is up the slope, and how fast."""
    n = 3 if len(result.q) == 7 else 2
    return up[:n] @ result.q[:n], up[:n] @ result.v[:n]


@pytest.mark.parametrize(("f", "spatial"), [(12.0, True), (5.0, False)])
def test_a_block_on_a_slope_stops_and_sticks_or_turns_round(f, spatial):
    model, up = block(0.5, f, 3.0, spatial)
    result = solve_with_friction(model.problem((0.0, 2.0)), t_eval=[0.0, 1.0, 2.0], **TIGHT)
    pull = WEIGHT * np.sin(0.5)
    end = 3.0 / (pull + 0.5 * f)
    np.testing.assert_allclose(changes(result), [end], atol=1e-9)
    back = 0.5 * max(pull - 0.5 * f, 0.0) * (2.0 - end) ** 2
    assert along(result, up)[0][-1] == pytest.approx(4.5 / (pull + 0.5 * f) - back, abs=1e-9)
    sticks = "dry friction of prismatic block-ground sticks" in result.arcs[-1].system.name
    assert sticks == (f == 12.0) and result.t.tolist() == [0.0, 1.0, 2.0]


@pytest.mark.parametrize("spatial", [slow(True), False])
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


@pytest.mark.slow
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
    change_times = changes(result)
    np.testing.assert_allclose(change_times, expected[: len(change_times)], atol=1e-9)
    assert len(change_times) >= 6


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


@pytest.mark.slow
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


@pytest.mark.parametrize("spatial", [False, slow(True)])
def test_a_block_rebounds_and_sticks(spatial):
    """On a level guide: it slows down, rebounds from the limit, and stays where it stops."""
    speed, end, e, slows = 3.0, 0.7, 0.6, 2.5
    model, up = block(0.0, 5.0, speed, spatial, upper=end, restitution=e)
    result = solve_with_friction(model.problem((0.0, 3.0)), **TIGHT)
    assert result.success, result.message
    hit = np.sqrt(speed**2 - 2.0 * slows * end)
    first, stop = (speed - hit) / slows, e * hit / slows
    np.testing.assert_allclose([impact.t for impact in result.impacts], [first], atol=1e-9)
    np.testing.assert_allclose([arc.t[0] for arc in result.arcs], [0.0, first, first + stop], atol=1e-9)
    place, rate = along(result, up)
    assert place[-1] == pytest.approx(end - 0.5 * slows * stop**2, abs=1e-9) and abs(rate[-1]) < 1e-12
    assert "sticks" in result.arcs[-1].system.name and "1 impacts, 2 changes" in result.message


@pytest.mark.slow
def test_a_block_slides_down_bounces_and_rests_on_the_limit():
    """Its weight overcomes the friction: each rebound is lower by that, too, until the limit carries it."""
    slope, e, drop = 0.6, 0.3, 0.4
    pull, slows = WEIGHT * np.sin(slope), 1.5
    model, up = block(slope, 2.0 * slows, 0.0, lower=-drop, restitution=e)
    result = solve_with_friction(model.problem((0.0, 4.0)), **TIGHT)
    assert result.success, result.message
    t = np.sqrt(2.0 * drop / (pull - slows))
    speed, times = (pull - slows) * t, []
    for _ in range(len(result.impacts)):
        times.append(t)
        speed *= e
        height = speed**2 / (2.0 * (pull + slows))
        t += speed / (pull + slows) + np.sqrt(2.0 * height / (pull - slows))
        speed = np.sqrt(2.0 * height * (pull - slows))
    assert 6 < len(times) < 40
    np.testing.assert_allclose([impact.t for impact in result.impacts], times, atol=1e-9)
    place, _ = along(result, up)
    assert place[-1] == pytest.approx(-drop, abs=1e-10)
    assert "on lower limit" in result.arcs[-1].system.name and "sticks" not in result.arcs[-1].system.name
    np.testing.assert_allclose(-result.arcs[-1].lam[result.system.n_c, -1], 2.0 * pull, atol=1e-7)


@pytest.mark.slow
def test_an_impact_releases_a_joint_that_sticks():
    M, m, v, f, g = 2.0, 1.0, 3.0, 1.0, 0.4
    model = PlanarModel(name="cart")
    model.body("cart", mass=M, inertia=1.0, position=(0.0, 0.0))
    model.body("mass", mass=m, inertia=1.0, position=(0.0, 0.2), velocity=(v, 0.0))
    model.dry_friction(model.prismatic("ground", "cart", at=(0.0, 0.0), axis=(1.0, 0.0)), f)
    slot = model.prismatic("cart", "mass", at=(0.0, 0.2), axis=(1.0, 0.0))
    model.dry_friction(slot, g)
    model.limit(slot, upper=0.5, restitution=0.5)
    problem = model.problem((0.0, 10.0))
    problem.v0[:] = [0.0, 0.0, 0.0, v, 0.0, 0.0]
    result = solve_with_friction(problem, **TIGHT)
    assert result.success, result.message
    hit = np.sqrt(v**2 - 2.0 * (g / m) * 0.5)
    first = (v - hit) / (g / m)
    np.testing.assert_allclose(result.impacts[0].t, first, atol=1e-9)
    both, apart = m * hit / (M + m), 0.5 * hit
    cart, mass = both + m * apart / (M + m), both - M * apart / (M + m)
    np.testing.assert_allclose(result.impacts[0].v_after[[0, 3]], [cart, mass], atol=1e-9)
    # the cart slows by (f + g) / M, the mass, which is slower, gains g / m until both are as fast, then both slow by f
    t = first + (cart - mass) / ((f + g) / M + g / m)
    speed = mass + g / m * (t - first)
    assert speed > 0.0 and f / (M + m) * m < g
    np.testing.assert_allclose([arc.t[0] for arc in result.arcs], [0.0, first, t, t + speed * (M + m) / f], atol=1e-9)
    assert abs(result.v[:, -1]).max() < 1e-12


def test_a_joint_at_rest_without_load_stays_at_rest():
    """The rounding of what acts on it counts for nothing."""
    model, _ = block(0.0, 2.0, 0.0, upper=0.0)
    result = solve_with_friction(model.problem((0.0, 1.0)), **TIGHT)
    assert result.success and len(result.arcs) == 1 and np.abs(result.q[0]).max() < 1e-12
