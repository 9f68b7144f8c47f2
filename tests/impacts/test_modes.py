"""Stops and dry friction in one motion, in closed form."""

import numpy as np
import pytest

from twoloop import solve_with_friction
from twoloop.bodies import PlanarModel, SpatialModel

TIGHT = {"rtol": 1e-11, "atol": 1e-11}
WEIGHT = 9.81


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
    model.limit(guide, **limits)
    return model, up


def along(result, up):
    """How far the block is up the slope, and how fast."""
    n = 3 if len(result.q) == 7 else 2
    return up[:n] @ result.q[:n], up[:n] @ result.v[:n]


@pytest.mark.parametrize("spatial", [False, True])
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


def test_a_block_rests_on_a_limit_until_it_is_pulled_away_against_friction():
    """The limit carries the push; when that turns into a pull, friction holds until it is overcome."""
    model, _ = block(0.0, 3.0, -1.0, lower=-0.05)
    model.motor("prismatic block-ground", lambda t: 4.0 * (t - 1.0))
    result = solve_with_friction(model.problem((0.0, 2.5)), **TIGHT)
    assert result.success, result.message
    known = [1.0, 1.75]  # the push ends, and the pull is 3 N
    np.testing.assert_allclose([arc.t[0] for arc in result.arcs[-2:]], known, atol=1e-9)
    u = 2.5 - 1.75  # 2 v' = 4 (t - 1.75)
    assert result.v[0, -1] == pytest.approx(u**2, abs=1e-9)
    assert result.q[0, -1] == pytest.approx(-0.05 + u**3 / 3.0, abs=1e-9)


def test_an_impact_releases_a_joint_that_sticks():
    """A cart that sticks is hit by a mass on it, whose guide has a limit: both slide, and stop one after the other."""
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


def test_two_blocks_that_touch_hold_with_the_friction_of_both():
    """A block pushes another ever harder: they slide when the frictions of both are overcome, however they share."""
    model = PlanarModel(name="blocks")
    for name, x, f in (("A", 0.0, 2.0), ("B", 0.3, 1.4)):
        model.body(name, mass=1.0, inertia=1.0, position=(x, 0.0))
        model.dry_friction(model.prismatic("ground", name, at=(x, 0.0), axis=(1.0, 0.0)), f)
    model.stop("B", (0.3, 0.0), "A", (0.3, 0.0), normal=(1.0, 0.0))
    model.force("A", (0.0, 0.0), lambda t: np.array([2.0 * t, 0.0]))
    model.force("B", (0.3, 0.0), lambda t: np.array([-0.1 * t, 0.0]))  # so that they touch from the start
    result = solve_with_friction(model.problem((0.0, 3.0)), **TIGHT)
    assert result.success, result.message
    begins = 3.4 / 1.9
    assert result.t[(np.abs(result.v[0]) > 1e-9)].min() > begins - 1e-6 and len(result.arcs) < 100
    u = 3.0 - begins  # 2 v' = 1.9 (t - begins)
    np.testing.assert_allclose(result.v[[0, 3], -1], 0.475 * u**2, atol=1e-7)
    np.testing.assert_allclose(result.q[[0, 3], -1], [0.475 * u**3 / 3.0, 0.3 + 0.475 * u**3 / 3.0], atol=1e-7)


def test_a_joint_at_rest_without_load_stays_at_rest():
    """The rounding of what acts on it counts for nothing."""
    model, _ = block(0.0, 2.0, 0.0, upper=0.0)
    result = solve_with_friction(model.problem((0.0, 1.0)), **TIGHT)
    assert result.success and len(result.arcs) == 1 and np.abs(result.q[0]).max() < 1e-12
