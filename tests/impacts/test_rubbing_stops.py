"""Coulomb friction of stops: sliding, sticking and impacts, against closed forms and equations in least coordinates."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from twoloop import Stop, solve_with_stops
from twoloop.bodies import PlanarModel
from twoloop.impacts.laws import Rubs, Undetermined, impulses

GRAVITY = 9.81
MORE_SLOPES = [(1.0, 0.0), (-1.0, 0.2), (0.0, 0.4)]  # and speeds


def moved(problem, t1, method="auto", **options):
    options = {"rtol": 1e-11, "atol": 1e-11, **options}
    return solve_with_stops(problem.system, (0.0, t1), problem.q0, problem.v0, problem.stops, method, **options)


def block(friction, speed, slope, restitution=0.0):
    """A block on two corners on a slope, whose axes are those of space."""
    model = PlanarModel(GRAVITY * np.array([-np.sin(slope), -np.cos(slope)]))
    box = model.box("block", (0.4, 0.2), mass=2.0, position=(0.0, 0.1), velocity=(speed, 0.0))
    for x in (-0.2, 0.2):
        given = {"normal": (0.0, 1.0), "restitution": restitution, "friction": friction}
        model.stop(box, box.point(x, -0.1), "ground", (0.0, 0.0), **given)
    return model.problem()


@pytest.mark.parametrize(
    ("speed", "slope"),
    [(1.0, 0.2), (1.0, 0.4), (0.0, 0.2), *(pytest.param(*each, marks=pytest.mark.slow) for each in MORE_SLOPES)],
)
def test_a_block_slides_sticks_and_slides_back(speed, slope):
    friction, t1 = 0.3, 1.0
    result = moved(block(friction, speed, slope), t1)
    brake = GRAVITY * (np.sin(slope) + np.sign(speed) * friction * np.cos(slope))
    stops = speed / brake if 0.0 < speed / brake < t1 else t1 * (speed != 0.0)
    back = GRAVITY * max(np.sin(slope) - friction * np.cos(slope), 0.0)
    rest = t1 - stops
    x = speed * stops - 0.5 * brake * stops**2 - 0.5 * back * rest**2
    assert result.success and not result.impacts
    np.testing.assert_allclose(result.q[:, -1], [x, 0.1, 0.0], atol=1e-11)
    np.testing.assert_allclose([arc.t[0] for arc in result.arcs], [0.0, stops][: 1 + (0.0 < stops < t1)], atol=1e-11)
    assert ("sticks" in result.arcs[-1].system.name) == (rest > 0.0 and back == 0.0)


def rod(angle, friction, restitution=0.0, **motion):
    """A rod of 1 m and 2 kg whose lower end, at the origin, is on a floor; the angle is from upright."""
    model = PlanarModel()
    half = 0.5 * np.array([np.sin(angle), np.cos(angle)])
    bar = model.body("rod", mass=2.0, inertia=1.0 / 6.0, position=half, **motion)
    given = {"restitution": restitution, "friction": friction}
    model.stop(bar, (0.0, 0.0), "ground", (0.0, 0.0), normal=(0.0, 1.0), **given)
    return model.problem()


def falling(angle, friction, t1):
    """Times of the first slip and of the end of it, and the end: a rod in its angle, then in place and angle."""
    m, half, J = 2.0, 0.5, 1.0 / 6.0

    def forces(y):
        s, c = np.sin(y[0]), np.cos(y[0])
        a = m * GRAVITY * half * s / (J + m * half**2)
        return m * half * (a * c - y[1] ** 2 * s), m * (GRAVITY - half * (a * s + y[1] ** 2 * c)), a

    def holds(t, y):
        along, up, _ = forces(y)
        return friction * up - abs(along)

    def slides(t, y, sign):
        s, c = np.sin(y[0]), np.cos(y[0])
        lever, weight = half * (s + sign * friction * c), m * (GRAVITY - half * c * y[1] ** 2)
        a = weight * lever / (J + m * half * s * lever)
        up = weight - m * half * s * a
        return [y[1], a, y[3], -sign * friction * up / m]

    holds.terminal = True
    options = {"method": "DOP853", "rtol": 1e-12, "atol": 1e-13}
    first = solve_ivp(lambda t, y: [y[1], forces(y)[2]], (0.0, t1), [angle, 0.0], events=holds, **options)
    t, (turned, rate) = first.t[-1], first.y[:, -1]
    sign = -np.sign(forces(first.y[:, -1])[0])
    centre = [turned, rate, half * np.sin(turned), half * np.cos(turned) * rate]

    def rests(t, y):
        return sign * (y[3] - half * np.cos(y[0]) * y[1])

    second = solve_ivp(lambda t, y: slides(t, y, sign), (t, t1), centre, events=rests, **options)
    assert not (second.t_events[0] > t + 1e-6).any()
    return t, second.y[:, -1], sign


@pytest.mark.parametrize(("friction", "t1", "slips", "method"), [(0.3, 0.45, -1.0, "DOP853"), (0.5, 0.75, 1.0, "auto")])
def test_a_rod_falls_over_sticks_and_slips(friction, t1, slips, method):
    """Its foot slips backwards on a smooth floor, and forwards on a rough one."""
    known, end, sign = falling(0.3, friction, t1)
    assert sign == slips
    result = moved(rod(0.3, friction), t1, method)
    assert result.success and len(result.arcs) == 2
    np.testing.assert_allclose(result.arcs[1].t[0], known, atol=1e-9)
    q = [end[2], 0.5 * np.cos(end[0]), 0.3 - end[0]]
    np.testing.assert_allclose(result.q[:, -1], q, atol=1e-9)


# without restitution a motion in contact follows, which takes twenty times as long as the impact
IMPACTS = [(0.5, friction, speed) for friction in (0.05, 2.0) for speed in (2.0, -0.1, -3.0)]
IMPACTS += [(0.0, 0.05, 2.0), (0.0, 2.0, -0.1)]
MORE_IMPACTS = [
    (e, friction, speed) for e in (0.0, 0.5) for friction in (0.05, 0.2, 2.0) for speed in (2.0, -0.1, -3.0)
]


@pytest.mark.parametrize(
    ("restitution", "friction", "speed"),
    [
        *IMPACTS,
        *(pytest.param(*each, marks=pytest.mark.slow) for each in MORE_IMPACTS if each not in IMPACTS),
    ],
)
def test_the_impact_of_a_rod(restitution, friction, speed):
    """Two impulses by hand: the end stops along the floor, or slides on and has all of its friction."""
    angle, m, J = 0.6, 2.0, 1.0 / 6.0
    motion = {"velocity": (speed, -2.0), "angular_velocity": 0.7}
    impact = moved(rod(angle, friction, restitution, **motion), 1e-3).impacts[0]
    x, y = -0.5 * np.sin(angle), -0.5 * np.cos(angle)
    D = np.array([[1 / m + x * x / J, -x * y / J], [-x * y / J, 1 / m + y * y / J]])
    u = np.array([-2.0 + 0.7 * x, speed - 0.7 * y])
    P = np.linalg.solve(D, [-(1.0 + restitution) * u[0], -u[1]])
    if abs(P[1]) > friction * P[0]:
        for sign in (1.0, -1.0):
            normal = -(1.0 + restitution) * u[0] / (D[0, 0] - sign * friction * D[0, 1])
            P = normal * np.array([1.0, -sign * friction])
            if sign * (u + D @ P)[1] > 0.0:
                break
    np.testing.assert_allclose([impact.impulses[0], impact.friction[0]], P, rtol=1e-12)
    after = [speed + P[1] / m, -2.0 + P[0] / m, 0.7 + (x * P[0] - y * P[1]) / J]
    np.testing.assert_allclose(impact.v_after, after, atol=1e-12)


def test_a_thrown_box_comes_to_rest():
    """Each impact and each arc loses energy, and unlike methods find the same end."""
    model = PlanarModel()
    box = model.box("box", (0.5, 0.3), mass=1.0, position=(0.0, 0.6), velocity=(1.5, 0.0), angular_velocity=-2.0)
    for x in (-0.25, 0.25):
        for y in (-0.15, 0.15):
            given = {"normal": (0.0, 1.0), "restitution": 0.4, "friction": 0.4}
            model.stop(box, box.point(x, y), "ground", (0.0, 0.0), **given)
    ends, problem = [], model.problem()
    for method in ("auto", "RadauIIA9"):
        result = moved(problem, 2.0, method, rtol=1e-8, atol=1e-8)
        assert result.success, result.message
        energies = problem.energy(result.t, result.q, result.v)
        assert np.diff(energies).max() < 1e-9 * energies[0]
        assert len(result.impacts) > 5 and np.abs(result.v[:, -1]).max() == 0.0
        assert result.arcs[-1].system.name.count("sticks") == 2
        ends.append(np.append(result.q[:, -1], [impact.t for impact in result.impacts[:8]]))
    np.testing.assert_allclose(*ends, atol=1e-6)


def test_a_jam_is_said():
    """P. Painlevé's rod: pushed ahead of its foot on a rough floor, no force of the floor is admissible."""
    with pytest.raises(Undetermined, match="they may jam"):
        moved(rod(-0.5, 3.0, velocity=(1.0, 0.0)), 0.1)


def test_an_impact_that_would_add_energy_is_refused():
    """T. R. Kane: Newton's restitution and friction that turns the sliding round."""
    D, u = np.array([[1.0, 0.5], [0.5, 1.0]]), np.array([-1.0, -0.5])
    rubs = Rubs(np.array([0]), np.array([1.0]), np.array([0]))
    with pytest.raises(Undetermined, match="would add energy"):
        impulses(D, u, np.array([0.9]), rubs)
    assert impulses(D, u, np.array([0.3]), rubs)[0] > 0.0


def test_a_stop_of_ones_own_rubs_along_its_slide():
    problem = block(0.0, 1.0, 0.0)
    stops = [
        Stop(lambda t, q, x=x: q[1] - 0.1 * np.cos(q[2]) + x * np.sin(q[2]), 0.0, f"{x}", 0.3, lambda t, q: q[0])
        for x in (-0.2, 0.2)
    ]
    result = solve_with_stops(problem.system, (0.0, 0.2), problem.q0, problem.v0, stops)
    np.testing.assert_allclose(result.q[0, -1], 0.2 - 0.5 * 0.3 * GRAVITY * 0.04, atol=1e-9)
