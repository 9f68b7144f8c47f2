"""Test stops: impacts, rest in contact, release and Coulomb friction, against closed forms and their conditions."""

import pickle
import re

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.marks import slow
from tests.problems import unconstrained
from twoloop import ConstrainedSystem, ConstraintWarning, Status, Stop, load, solve_with_stops
from twoloop.bodies import PlanarModel, SpatialModel
from twoloop.impacts.contact import Undetermined
from twoloop.impacts.forces import Tangents, coulomb_forces, impulses

GRAVITY = 9.81
TIGHT = {"rtol": 1e-10, "atol": 1e-10}


def ball(y=1.0, **motion):
    model = PlanarModel(name="ball")
    model.body("ball", mass=2.0, inertia=0.1, position=(0.0, y), **motion)
    return model


def moved(model, t1, stops=None, **options):
    problem = model.problem((0.0, t1))
    result = solve_with_stops(
        problem.system, problem.t_span, problem.q0, problem.v0, stops or list(problem.stops), **TIGHT | options
    )
    assert result.success, result.message
    return problem, result


def test_a_ball_bounces_to_rest(tmp_path):
    e, drop = 0.7, np.sqrt(2.0 / GRAVITY)
    model = ball(velocity=(0.3, 0.0), angular_velocity=1.0)
    model.stop("ball", (0.0, 1.0), "ground", (5.0, 0.0), normal=(0.0, 3.0), restitution=e, name="floor")
    problem, result = moved(model, 4.0)
    times = np.array([impact.t for impact in result.impacts])
    flights = 2.0 * e ** np.arange(1, len(times)) * GRAVITY * drop / GRAVITY
    np.testing.assert_allclose(times, drop + np.append(0.0, np.cumsum(flights)), atol=1e-10)
    assert 20 < len(times) < 60 and abs(times[-1] - drop * (1.0 + e) / (1.0 - e)) < 1e-5
    assert result.impacts[0].stops == ("floor",)
    assert result.impacts[0].impulses == pytest.approx(2.0 * (1.0 + e) * GRAVITY * drop)
    np.testing.assert_allclose(result.q[:, -1], [1.2, 0.0, 4.0], atol=1e-9)
    np.testing.assert_allclose(-result.arcs[-1].lam[0], 2.0 * GRAVITY)
    assert result.lam.shape == (0, len(result.t)) and result.t.shape == result.energy.shape
    first = times[0]
    np.testing.assert_allclose(result.sol(0.5 * first).q[1], 1.0 - 0.5 * GRAVITY * (0.5 * first) ** 2, atol=1e-9)
    assert result.sol(first).v[1] == pytest.approx(e * GRAVITY * drop) and (result.sol([3.9, 0.0]).q[1] == [0, 1]).all()
    result.save(tmp_path / "run.npz")
    loaded = load(tmp_path / "run.npz", problem.system)
    assert (loaded.q == result.q).all() and loaded.changes == result.changes
    for copied in (result, loaded, pickle.loads(pickle.dumps(result))):
        with pytest.raises(ValueError, match="impacts"):
            copied.certify()
    assert result.arcs[0].certify().passed


@pytest.mark.slow
@pytest.mark.parametrize("restitution", [0.5, 0.0])
def test_a_box_rocks_to_rest_on_two_corners(restitution):
    model = PlanarModel()
    box = model.box("box", (1.0, 0.4), mass=1.0, position=(0.0, 0.6), angle=0.3)
    for corner in ((0.5, 0.2), (0.5, -0.2), (-0.5, 0.2), (-0.5, -0.2)):
        model.stop(box, box.point(*corner), "ground", (0.0, 0.0), normal=(0.0, 1.0), restitution=restitution)
    problem, result = moved(model, 5.0, law="moreau")
    np.testing.assert_allclose(result.q[1:, -1], [0.2, 0.0], atol=1e-9)
    assert (np.diff(result.energy) < 1e-9).all()
    assert min(stop.gap(0.0, q) for q in result.q.T for stop in problem.stops) > -1e-10
    np.testing.assert_allclose(-result.arcs[-1].lam[:, -1], [0.5 * GRAVITY] * 2)


def test_a_plane_and_space_agree():
    """A pendulum on a slide that runs against its limits, and a bob against a wall that the slide carries."""

    def model(spatial):
        def at(x, y):
            return (x, 0.0, y) if spatial else (x, y)

        made = SpatialModel() if spatial else PlanarModel()
        across = {"axis": (0.0, -1.0, 0.0)} if spatial else {}
        inertia = (0.1, 0.1, 0.1) if spatial else 0.1
        sledge = made.body("sledge", mass=1.0, inertia=inertia, position=at(0.0, 0.0), velocity=at(1.0, 0.0))
        bob = made.body("bob", mass=0.5, inertia=inertia, position=at(0.3, -0.6))
        guide = made.prismatic("ground", sledge, at=at(0.0, 0.0), axis=at(2.0, 0.0))
        made.limit(guide, lower=-0.2, upper=0.5, restitution=0.8)
        made.revolute(sledge, bob, at=at(0.0, 0.0), **across)
        made.stop(bob, at(0.3, -0.6), sledge, at(-0.1, 0.0), normal=at(1.0, 0.0), restitution=0.4)
        return made

    plane, space = (moved(model(spatial), 6.0, compiled=False)[1] for spatial in (False, True))
    assert len(plane.impacts) > 5 and {len(set(i.stops)) for i in plane.impacts} == {1}
    np.testing.assert_allclose([i.t for i in space.impacts], [i.t for i in plane.impacts], atol=1e-8)
    np.testing.assert_allclose(space.q[[7, 9], -1], plane.q[[3, 4], -1], atol=1e-7)


def test_plain_functions_and_redundant_rows():
    def constraint(t, q):
        return np.array([0.5 * (q @ q - 1.0), q @ q - 1.0])

    system = ConstrainedSystem.from_python(
        n_q=2, n_c=2, mass=np.eye(2), force=lambda t, q, v: np.array([0.0, -GRAVITY]), constraint=constraint
    )
    with pytest.warns(match="have rank 1 of 2"):
        result = solve_with_stops(system, (0.0, 1.5), [1.0, 0.0], [0.0, 0.0], Stop(lambda t, q: q[0], 0.0), **TIGHT)
    # at the bottom, where gravity does not hold it: one impact takes all of its speed
    assert len(result.impacts) == 1 and np.abs(result.q[:, -1] - [0.0, -1.0]).max() < 1e-9
    assert result.impacts[0].impulses == pytest.approx(np.sqrt(2.0 * GRAVITY))


def test_the_first_touch_of_a_shaking_table_is_found(size=5e-3, rate=300.0):
    """A body that comes slowly, in steps longer than the table takes to shake."""
    model = PlanarModel(gravity=(0.0, 0.0))
    model.body("ball", mass=1.0, inertia=0.1, position=(0.0, 0.2), velocity=(0.0, -0.1), angular_velocity=0.3)
    problem = model.problem((0.0, 5.0))
    stop = Stop(lambda t, q: q[1] - size * np.sin(rate * t), 0.5)
    result = solve_with_stops(problem.system, problem.t_span, problem.q0, problem.v0, stop)
    times = np.linspace(0.0, 5.0, 500_001)
    first = times[np.flatnonzero(0.2 - 0.1 * times < size * np.sin(rate * times))[0]]
    assert result.impacts[0].t == pytest.approx(first, abs=1.1e-5)


@pytest.mark.parametrize(
    ("above", "method"), [(1e-6, "auto"), (-1e-8, "auto"), slow(1e-8, "RadauIIA5"), slow(1e-8, "BDF")]
)
def test_a_ball_that_grazes_a_ceiling_between_two_looks_hits_it(above, method):
    """The gap is closed for 0.1 ms to 9 ms, or not at all, and looked at every 0.5 ms or more rarely."""
    height, e, end = 0.437, 0.5, 1.0
    system = unconstrained(lambda t, q, v: np.array([-GRAVITY]))
    speed, hit = np.sqrt(2.0 * GRAVITY * (height + above)), np.sqrt(2.0 * GRAVITY * max(0.0, above))
    ceiling = Stop(lambda t, q: height - q[0], e, "ceiling")
    result = solve_with_stops(system, (0.0, end), [0.0], [speed], ceiling, method, **TIGHT)
    assert result.success and len(result.impacts) == (above > 0.0)
    reached, rest = (e * hit, end - (speed - hit) / GRAVITY) if above > 0.0 else (-speed, end)
    assert abs(result.v[0, -1] + reached + GRAVITY * rest) < 1e-4 * hit + 1e-6


def test_two_stops_on_one_side_of_which_one_moves():
    """The stop whose rebound is the faster one hits, also where the other closes at another rate."""
    stops = [Stop(lambda t, q: -q[0] + 0.5 * t, 1.0, "moving"), Stop(lambda t, q: -q[0], 0.5, "fixed")]
    free = unconstrained(lambda t, q, v: np.zeros(1))
    result = solve_with_stops(free, (0.0, 1.0), [0.0], [1.0], stops, law="moreau")
    assert result.success and [impact.stops for impact in result.impacts] == [("fixed",)]
    np.testing.assert_allclose(result.q[0, -1], -0.5)
    with pytest.warns(match="close at once, in an order within the tolerance"):
        assert "depends on the law" in solve_with_stops(free, (0.0, 1.0), [0.0], [1.0], stops).message


def test_two_stops_that_close_on_a_body_end_the_run():
    """The wall on the right leaves the body on the floor on the left, and comes back."""
    stops = [Stop(lambda t, q: q[0], name="left"), Stop(lambda t, q: -q[0] - 0.1 * t * (t - 0.2), name="right")]
    pushed = unconstrained(lambda t, q, v: -np.ones(1))
    result = solve_with_stops(pushed, (0.0, 1.0), [0.0], [0.0], stops, time_limit=20.0)
    assert result.status == Status.STAGNATED and "push against each other" in result.message
    np.testing.assert_allclose(result.t[-1], 0.2)


def test_parallel_stops_let_go_at_once():
    """Both hold the same coordinate; none takes over the force of the other, which is zero but for rounding."""
    mass, k, lift, rate, phase = np.random.default_rng(0).uniform([1, 1, 12, 2, 0], [3, 9, 20, 4, 1])
    force = lambda t, q, v: np.array([-10.0 + lift * np.sin(rate * t + phase) - k * (q[0] - 0.1)])  # noqa: E731
    lifted = unconstrained(force, mass=np.diag([mass]))
    stops = [Stop(lambda t, q: q[0], name="one"), Stop(lambda t, q: 3.0 * q[0], name="other")]
    parallel, single = (solve_with_stops(lifted, (0.0, 0.9), [0.0], [0.0], chosen) for chosen in (stops, stops[0]))
    assert parallel.success, parallel.message
    np.testing.assert_allclose(parallel.q[:, -1], single.q[:, -1], atol=1e-8)


@pytest.mark.slow
def test_rebounds_from_a_wall_towards_which_another_turns_the_load_die_out():
    """Without the wall on the left, the load would lift the body off the slope."""
    pressed = unconstrained(lambda t, q, v: np.array([-6.0, -1.0]), 2)
    groove = [Stop(lambda t, q: q[0], name="wall"), Stop(lambda t, q: 0.8 * q[1] - 0.6 * q[0], 0.5, "slope")]
    result = solve_with_stops(pressed, (0.0, 3.0), [0.0, 0.1], [0.0, 0.0], groove, law="moreau")
    assert result.success and np.abs(result.q[:, -1]).max() < 1e-9, result.message
    times = [impact.t for impact in result.impacts]
    assert len(times) < 40 and times[-1] == pytest.approx(np.sqrt(0.2) * (1.0 + 0.5) / (1.0 - 0.5), abs=1e-4)


def line(masses, restitutions, wall=False):
    """Balls on a line, and a wall on their left."""
    n, first = len(masses), [Stop(lambda t, q: q[0], restitutions[0], "wall")] * wall
    between = [Stop(lambda t, q, k=k: q[k + 1] - q[k], restitutions[k + wall], f"{k}-{k + 1}") for k in range(n - 1)]
    return unconstrained(lambda t, q, v: np.zeros(n), n, mass=np.diag(masses)), first + between


def one_by_one(masses, restitutions, x, v, t1, wall):
    """Positions at t1, impact by impact."""
    x, v, left = np.append([0.0] * wall, x), np.append([0.0] * wall, v), t1
    inverse = np.append([0.0] * wall, 1.0 / np.array(masses))
    while True:
        gaps, rates = np.maximum(np.diff(x), 0.0), np.diff(v)
        times = np.where(rates < -1e-14, gaps / np.maximum(-rates, 1e-300), np.inf)
        k = int(times.argmin())
        if times[k] > left:
            return (x + left * v)[wall:]
        x, left = x + times[k] * v, left - times[k]
        impulse = -(1.0 + restitutions[k]) * rates[k] / (inverse[k] + inverse[k + 1])
        v[k : k + 2] += impulse * np.array([-1.0, 1.0]) * inverse[k : k + 2]


LINES = [([1.2, 0.015, 0.9], [0.45, 0.55], [0.0, 0.9, 1.6], [0.8, 0.1, -1.1], False)]
LINES += [([0.07, 1.4], [0.4, 0.6], [0.4, 1.3], [0.2, -0.9], True)]
LINES += [([2.0, 0.1], [0.9, 0.7], [1.0, 1.5], [-1.0, 0.3], True)]
# a gap that opens so slowly that it changes by rounding at first
LINES += [([1.0, 0.99, 0.087, 1.08], [0.37, 0.39, 0.53], [1.0, 1.78, 2.52, 2.82], [0.94, -0.3, -0.79, -1.25], False)]


@pytest.mark.filterwarnings("ignore:.*in an order within the tolerance")  # at 1e-5, rounding decides whether it is
@pytest.mark.parametrize("tolerance", [1e-8, slow(1e-5), slow(1e-11)])
@pytest.mark.parametrize(("masses", "restitutions", "x", "v", "wall"), LINES)
def test_impacts_that_follow_ever_faster_come_one_by_one(masses, restitutions, x, v, wall, tolerance):
    """A light ball between two others, or between a wall and a heavy one, collapses after infinitely many impacts."""
    system, stops = line(masses, restitutions, wall)
    options = {"rtol": tolerance, "atol": tolerance}
    result = solve_with_stops(system, (0.0, 2.5), np.array(x), np.array(v, dtype=float), stops, **options)
    expected = one_by_one(masses, restitutions, x, v, 2.5, wall)
    assert result.success and np.abs(result.q[:, -1] - expected).max() < 10.0 * tolerance, result.message


def test_rounding_of_coordinates_that_are_zero_does_not_end_a_motion():
    """A light ball between two others, on rails through y = 0, where a violation has nothing to be compared with."""
    masses, x, speeds, restitutions = [1.0, 0.0106, 1.06], [0.5, 1.2, 1.9], [0.39, 0.56, -0.41], [0.33, 0.55]
    model = PlanarModel()
    for k in range(3):
        ball = model.disc(f"{k}", 0.1, mass=masses[k], position=(x[k], 0.0), velocity=(speeds[k], 0.0))
        model.prismatic("ground", ball, at=(x[k], 0.0), axis=(1.0, 0.0))
    for k in range(2):
        model.stop(f"{k + 1}", (x[k + 1], 0.0), f"{k}", (x[k], 0.0), normal=(1.0, 0.0), restitution=restitutions[k])
    _, result = moved(model, 2.5, rtol=1e-6, atol=1e-6)
    expected = one_by_one(masses, restitutions, x, speeds, 2.5, False)
    np.testing.assert_allclose(result.q[::3, -1], expected, atol=1e-5)


@pytest.mark.parametrize("across", [0.0, 1e3])
def test_a_velocity_along_the_floor_does_not_end_the_rebounds(across):
    falling, floor = unconstrained(lambda t, q, v: np.array([0.0, -1e-6]), 2), Stop(lambda t, q: q[1], 0.5)
    result = solve_with_stops(falling, (0.0, 14.0), [0.0, 1e-6], [across, 0.0], floor, atol=1e-12)
    assert result.success and len(result.impacts) == 14, result.message


@pytest.mark.parametrize("start", [0.0, 1.7e9])
def test_impacts_at_the_time_of_a_clock_and_just_before_the_end(start):
    falling, drop = unconstrained(lambda t, q, v: np.array([-GRAVITY])), np.sqrt(2.0 / GRAVITY)
    for end in (start + 1.0, *(start + drop + k * np.spacing(start + drop) for k in (-3, 0, 3, 20))):
        result = solve_with_stops(falling, (start, end), [1.0], [0.0], Stop(lambda t, q: q[0], 1.0))
        late = result.t[-1] - start - drop
        assert (
            result.success and abs(result.q[0, -1] - max(0.0, GRAVITY * drop * late - 0.5 * GRAVITY * late**2)) < 2e-5
        )


@pytest.mark.parametrize(("size", "time"), [(1e-9, 1e3), (1.0, 1e-9), (1e6, 1.0)])
def test_impacts_do_not_depend_on_units(size, time):
    falling, floor = unconstrained(lambda t, q, v: np.array([-GRAVITY * size / time**2])), Stop(lambda t, q: q[0], 0.5)
    atol = 1e-8 * min(size, size / time)
    result = solve_with_stops(falling, (0.0, 1.2 * time), [size], [0.0], floor, atol=atol)
    drop = np.sqrt(2.0 / GRAVITY)
    late, rate = 1.2 - 2.5 * drop, 0.25 * GRAVITY * drop  # since the third impact, with half the rate of the second
    assert result.success and len(result.impacts) == 3, result.message
    assert abs(result.q[0, -1] / size - (0.5 * rate * late - 0.5 * GRAVITY * late**2)) < 1e-7


@pytest.mark.parametrize("heavy", [1.0, 1e5])
def test_a_light_body_beside_a_heavy_one_has_an_impact_of_its_own(heavy):
    model = PlanarModel(gravity=(0.0, -GRAVITY))
    model.body("carriage", mass=heavy, inertia=heavy, position=(5.0, 1.0))
    model.prismatic("ground", "carriage", at=(5.0, 1.0), axis=(1.0, 0.0))
    latch = model.body("latch", mass=1e-3, inertia=1e-7 / 12.0, position=(0.0, 0.05), angle=0.7)
    model.stop(latch, latch.point(-0.005, 0.0), "ground", (0.0, 0.0), normal=(0.0, 1.0), restitution=0.8)
    _, result = moved(model, 0.11)
    arm, rate = -0.005 * np.cos(0.7), result.impacts[0].v_before[4]
    impulse = -1.8 * rate / (1e3 + arm**2 * 12e7)
    np.testing.assert_allclose(result.impacts[0].v_after[4:], [rate + 1e3 * impulse, 12e7 * arm * impulse], rtol=1e-9)


@pytest.mark.parametrize("rotation", [0.0, 1e-6, np.pi])
def test_an_impact_on_a_chain_in_space_keeps_its_joints(rotation):
    model = SpatialModel((0.0, 0.0, -GRAVITY), name="chain")
    for k, name in enumerate("ab"):
        turned = Rotation.from_rotvec([rotation, 0.0, 0.0]).as_matrix()
        model.body(name, mass=1.0, inertia=(0.1, 0.2, 0.3), position=(0.5 + k, 0.0, 0.1), rotation=turned)
    hinge = model.revolute("ground", "a", at=(0.0, 0.0, 0.1), axis=(0.0, 1.0, 0.0))
    model.drive(hinge, lambda t: 0.2 * t)
    model.spherical("a", "b", at=(1.0, 0.0, 0.1))
    model.stop("b", (1.7, 0.2, 0.1), "ground", (0.0, 0.0, 0.0), normal=(0.0, 0.0, 1.0), restitution=0.5)
    problem, result = moved(model, 0.3)
    hit = result.impacts[0]
    q = result.sol(hit.t).q
    assert np.abs(problem.system.velocity_constraint(hit.t, q, hit.v_after)).max() < 1e-9


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_an_impact_on_a_body_turned_by_half_a_turn(axis):
    """An Euler parameter is zero to rounding there, with no inertia."""
    turned, J = Rotation.from_rotvec(np.pi * np.eye(3)[axis]).as_matrix(), np.array([0.1, 0.07, 0.09])
    model = SpatialModel((0.0, 0.0, 0.0))
    model.body("box", mass=1.0, inertia=J, position=(0.0, 0.0, 0.4), rotation=turned, velocity=(0.3, 0.1, -1.0))
    model.stop("box", (0.5, -0.3, 0.01), "ground", (0.0, 0.0, 0.0), normal=(0.0, 0.0, 1.0), restitution=0.5)
    _, result = moved(model, 0.02)
    lever = turned.T @ np.cross((0.5, -0.3, -0.39), (0.0, 0.0, 1.0))  # in body axes
    impulse = 1.5 / (1.0 + lever @ (lever / J))
    np.testing.assert_allclose(result.impacts[0].v_after[:3], [0.3, 0.1, -1.0 + impulse], rtol=1e-9)


def test_a_linkage_with_a_redundant_row_comes_to_rest_at_a_stop():
    model = PlanarModel(gravity=(0.0, 0.0))
    model.rod("bar", (0.6, 0.8), (2.6, 0.8), mass=2.0)
    for k in range(3):
        model.rod(str(k), (k, 0.0), (k + 0.6, 0.8), mass=1.0, angular_velocity=-1.0)
        model.revolute("ground", str(k), at=(k, 0.0))
        model.revolute(str(k), "bar", at=(k + 0.6, 0.8))
    model.stop("bar", (2.6, 0.8), "ground", (2.75, 0.0), normal=(-1.0, 0.0), restitution=0.0)
    with pytest.warns(ConstraintWarning, match="depend on the others"):
        p = model.problem((0.0, 0.8))
        result = solve_with_stops(p.system, p.t_span, p.q0, p.v0, p.stops)
    assert result.success and len(result.impacts) == 1, result.message
    assert np.abs(result.v[:, -1]).max() < 1e-9


EQUAL, UNEQUAL = ([1.0] * 4, [1.0] * 3), ([1.0, 2.0, 1.5, 0.5], [0.3, 0.8, 0.2])  # masses and restitutions
BALLS = [("sequential", EQUAL, [0, 0, 0, 1.0]), ("moreau", EQUAL, [-0.5, 0.5, 0.5, 0.5])]


@pytest.mark.parametrize(("law", "balls", "after"), [*BALLS, ("poisson", UNEQUAL, [-0.04, 0.16, 0.36, 0.36])])
def test_touching_balls_act_by_the_law(law, balls, after):
    system, stops = line(*balls)
    start = np.array([0.0, 1.0, 1.0, 1.0]), np.array([1.0, 0.0, 0.0, 0.0])
    result = solve_with_stops(system, (0.0, 2.0), *start, stops, law=law)
    np.testing.assert_allclose(result.v[:, -1], after, atol=1e-12)
    with pytest.warns(match="small gap between the bodies or set law="):
        default = solve_with_stops(system, (0.0, 2.0), *start, stops)
    assert "depends on the law" in default.message and (law != "moreau" or abs(default.v[3, -1] - 0.5) < 1e-12)


def test_a_stop_that_opens_is_hit_when_the_impact_at_another_turns_the_body_back():
    """The impact at the wall sends the body towards the floor, which it was leaving."""
    free = unconstrained(lambda t, q, v: np.array([0.0, -1e-3]), 2)
    corner = [Stop(lambda t, q: q[1], 0.8, "floor")]
    corner.append(Stop(lambda t, q: np.sqrt(0.75) * q[0] - 0.5 * q[1], 0.8, "wall"))
    result = solve_with_stops(free, (0.0, 0.1), [0.0, 0.0], [-0.5, 0.5], corner)
    assert result.success and [impact.stops for impact in result.impacts] == [("wall",), ("floor",)]
    jumps = sum(impact.v_after - impact.v_before for impact in result.impacts)
    np.testing.assert_allclose(result.v[:, -1], jumps + np.array([-0.5, 0.5 - 1e-4]), atol=1e-9)


@pytest.mark.parametrize("options", [{"method": "Taylor"}, slow({"compiled": True})], ids=str)
def test_what_needs_traced_callbacks_takes_others_while_a_stop_is_closed(options):
    model = PlanarModel()
    rod = model.rod("rod", (0.0, 0.0), (1.0, 0.0), mass=2.0)
    model.revolute("ground", rod, at=(0.0, 0.0))
    model.stop(rod, (1.0, 0.0), "ground", (0.0, -0.3), normal=(0.0, 1.0))
    _, known = moved(model, 1.0)
    _, result = moved(model, 1.0, **options)
    assert len(result.arcs) == 2 and result.arcs[1].method == "auto" and result.method == options.get("method", "auto")
    assert result.impacts[0].t == pytest.approx(known.impacts[0].t, abs=1e-9)
    np.testing.assert_allclose(result.q[:, -1], known.q[:, -1], atol=1e-9)


MORE_SLOPES = [(1.0, 0.0), (1.0, 0.2), (-1.0, 0.2), (0.0, 0.4)]  # and speeds


def slid(problem, t1, method="auto", **options):
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


@pytest.mark.parametrize(("speed", "slope"), [(1.0, 0.4), *(slow(*each) for each in MORE_SLOPES)])
def test_a_block_slides_sticks_and_slides_back(speed, slope):
    friction, t1 = 0.3, 1.0
    result = slid(block(friction, speed, slope), t1)
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


# without restitution a motion in contact follows, which takes twenty times as long as the impact
IMPACTS = [(0.5, 0.05, 2.0), (0.5, 2.0, -0.1), (0.5, 2.0, -3.0)]
MORE_IMPACTS = [(e, friction, speed) for e in (0.0, 0.5) for friction in (0.05, 2.0) for speed in (2.0, -0.1, -3.0)]


@pytest.mark.parametrize(
    ("restitution", "friction", "speed"), [*IMPACTS, *(slow(*each) for each in MORE_IMPACTS if each not in IMPACTS)]
)
def test_the_impact_of_a_rod(restitution, friction, speed):
    """Two impulses by hand: the end stops along the floor, or slides on and has all of its friction."""
    angle, m, J = 0.6, 2.0, 1.0 / 6.0
    motion = {"velocity": (speed, -2.0), "angular_velocity": 0.7}
    impact = slid(rod(angle, friction, restitution, **motion), 1e-3).impacts[0]
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


@pytest.mark.slow
def test_a_thrown_box_comes_to_rest():
    """Each impact and each arc loses energy, and unlike methods find the same end."""
    model = PlanarModel()
    box = model.box("box", (0.5, 0.3), mass=1.0, position=(0.0, 0.6), velocity=(1.5, 0.0), angular_velocity=-2.0)
    for x in (-0.25, 0.25):
        for y in (-0.15, 0.15):
            given = {"normal": (0.0, 1.0), "restitution": 0.4, "friction": 0.4}
            model.stop(box, box.point(x, y), "ground", (0.0, 0.0), **given)
    ends, problem = [], model.problem()
    for method in ("auto", "DOP853"):
        result = slid(problem, 2.0, method, rtol=1e-8, atol=1e-8, law="moreau")
        assert result.success, result.message
        energies = problem.energy(result.t, result.q, result.v)
        assert np.diff(energies).max() < 1e-9 * energies[0]
        assert len(result.impacts) > 5 and np.abs(result.v[:, -1]).max() == 0.0
        assert result.arcs[-1].system.name.count("sticks") == 2
        ends.append(np.append(result.q[:, -1], [impact.t for impact in result.impacts[:8]]))
    np.testing.assert_allclose(*ends, atol=1e-6)


@pytest.mark.parametrize(("n", "speed", "coefficient", "restitution"), [(2, 2.0, 0.3, 0.0), (3, 0.7, 0.1, 0.4)])
def test_hinged_boxes_that_land_flat_slide_and_stop_as_one(n, speed, coefficient, restitution):
    """Their 2 n stops share the weight in any proportion; impacts and sliding slow them by mu times its impulse."""
    model = PlanarModel(name="train")
    for k in range(n):
        model.box(f"box {k}", (0.4, 0.2), mass=1.0 + k, position=(0.4 * k, 0.2), velocity=(speed, 0.0))
        if k:
            model.revolute(f"box {k - 1}", f"box {k}", at=(0.4 * k - 0.2, 0.2))
        for side in (-0.18, 0.18):
            given = {"normal": (0.0, 1.0), "restitution": restitution, "friction": coefficient}
            model.stop(f"box {k}", (0.4 * k + side, 0.1), "ground", (0.0, 0.0), **given)
    result = slid(model.problem(), 1.0, law="moreau")
    fall = np.sqrt(2.0 * 0.1 * GRAVITY)  # speed of the first impact, m/s
    x, v, t, u = 0.0, speed, fall / GRAVITY, fall
    x += v * t
    while u > 1e-9:
        v, u = max(0.0, v - coefficient * (1.0 + restitution) * u), restitution * u
        x, t = x + v * 2.0 * u / GRAVITY, t + 2.0 * u / GRAVITY
    rest = min(1.0 - t, v / (coefficient * GRAVITY))
    x, v = x + rest * (v - 0.5 * coefficient * GRAVITY * rest), v - coefficient * GRAVITY * rest
    assert result.success, result.message
    np.testing.assert_allclose(result.q[0, -1], x, atol=1e-6)
    np.testing.assert_allclose(result.v[:, -1].reshape(n, 3), [[v, 0.0, 0.0]] * n, atol=1e-6)


@pytest.mark.parametrize(
    ("floor", "face", "velocities"),
    [
        ([(0, 0.15, -0.15, 1.0)], (0.15, -0.15), [0.7, 0.0, 0.0, 0.7, 0.0, 0.0]),
        ([(1, 0.15, -0.15, 1.0), (1, 0.0, 0.15, -1.0)], (-0.15,), [1.12, 0.0, -2.8, 0.28, 0.0, 2.8]),
    ],
)
def test_boxes_that_meet_flush_do_not_rub(floor, face, velocities):
    """Without a rate along the face, there is no friction; rounding is no such rate. By momentum: x' = 1.4 m/s."""
    model = PlanarModel(gravity=(0.0, 0.0))
    for k, speed in ((0, 1.4), (1, 0.0)):
        model.box(f"box {k}", (0.3, 0.3), mass=1.0, position=(0.3 * k, 0.15), velocity=(speed, 0.0))
    for k, x, y, side in floor:
        at = (0.3 * k + x, 0.15 + y)
        model.stop(f"box {k}", at, "ground", (0.0, at[1]), normal=(0.0, side), friction=0.3)
    for y in face:
        model.stop("box 1", (0.15, 0.15 + y), "box 0", (0.15, 0.15), normal=(1.0, 0.0), friction=0.4)
    result = slid(model.problem(), 0.01, law="moreau")
    assert result.success, result.message
    np.testing.assert_allclose(result.v[:, -1], velocities, atol=1e-12)
    (impact,) = result.impacts
    assert np.abs(impact.friction).max() < 1e-14


def test_forces_at_stops_with_friction_keep_coulombs_conditions():
    """Up to four stops, many with dependent displacements or without any rate, of which some end as not determined."""
    numbers, n_solved = np.random.default_rng(6), 0
    for _ in range(300):
        n, size = int(numbers.integers(1, 5)), int(numbers.integers(1, 5))
        W = np.round(numbers.normal(size=(2 * n, size)))
        D, c, mu = W @ W.T, W @ np.round(numbers.normal(size=size)), numbers.uniform(0.1, 1.0, n)
        try:
            x, slides = coulomb_forces(D, c, np.zeros(0), Tangents(np.arange(n), mu, np.zeros(n, dtype=np.int64)))
        except Undetermined:
            continue
        n_solved += 1
        after, close = D @ x + c, 1e-9 * (1.0 + np.abs(x).max())
        N, T = x[:n], x[n:]
        assert (N >= 0.0).all() and (after[:n] >= -close).all() and (N * after[:n] <= close * (1.0 + N)).all()
        assert (np.abs(T) <= mu * N + close).all()
        np.testing.assert_allclose(T[slides != 0], (-slides * mu * N)[slides != 0], atol=close)
        assert (np.abs(after[n:])[slides == 0] <= close).all()
    assert n_solved > 200


def test_loads_that_stops_share_in_any_proportion_with_different_friction_are_not_determined():
    """Either of two stops at one place may carry the weight; how fast the body slows depends on which."""
    D = np.array([[1.0, 1.0, 0.0, 0.0], [1.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 1.0], [0.0, 0.0, 1.0, 1.0]])
    tangents = Tangents(np.array([0, 1]), np.array([0.1, 0.3]), np.array([1, 1]))
    with pytest.raises(Undetermined, match="the motion depends on it"):
        coulomb_forces(D, np.array([-9.81, -9.81, 0.0, 0.0]), np.zeros(0), tangents)


def test_a_jam_is_said():
    """P. Painlevé's rod: pushed ahead of its foot on a rough floor, no force of the floor is admissible."""
    with pytest.raises(Undetermined, match="they may jam"):
        slid(rod(-0.5, 3.0, velocity=(1.0, 0.0)), 0.1)


def test_an_impact_that_would_add_energy_is_refused():
    """T. R. Kane: Newton's restitution and friction that turns the sliding round."""
    D, u = np.array([[1.0, 0.5], [0.5, 1.0]]), np.array([-1.0, -0.5])
    tangents = Tangents(np.array([0]), np.array([1.0]), np.array([0]))
    with pytest.raises(Undetermined, match="would add energy"):
        impulses(D, u, np.array([0.9]), tangents)
    assert impulses(D, u, np.array([0.3]), tangents)[0] > 0.0


NO_TANGENTS = Tangents(np.zeros(0, dtype=np.int64), np.zeros(0), np.zeros(0, dtype=np.int64))


def test_a_drive_that_moves_a_body_into_a_stop_is_named():
    model = PlanarModel(gravity=(0.0, 0.0))
    model.body("slider", mass=1.0, inertia=1.0, position=(0.0, 0.0))
    guide = model.prismatic("ground", "slider", at=(0.0, 0.0), axis=(1.0, 0.0))
    model.drive(guide, lambda t: 0.3 * t)
    model.stop("slider", (0.0, 0.0), "ground", (0.1, 0.0), normal=(-1.0, 0.0), restitution=0.5)
    p = model.problem((0.0, 1.0))
    result = solve_with_stops(p.system, p.t_span, p.q0, p.v0, p.stops)
    assert not result.success and "move a body into a stop" in result.message
    assert result.t[-1] == pytest.approx(1.0 / 3.0, abs=1e-8)


@pytest.mark.parametrize("law", [None, "moreau"])
def test_a_light_and_a_heavy_body_hit_stops_together(law):
    system = unconstrained(lambda t, q, v: np.zeros(4), 4, mass=np.diag([1e6, 1e6, 1e-12, 1e-12]))
    stops = [Stop(lambda t, q, k=k: q[k], 0.5, "stop", 0.2, lambda t, q, k=k: q[k + 1]) for k in (0, 2)]
    result = solve_with_stops(system, (0.0, 1.0), [0.5, 0.0] * 2, [-1.0, 0.6] * 2, stops, law=law)
    assert result.success, result.message
    np.testing.assert_allclose(result.v[:, -1], [0.5, 0.6 - 0.2 * 1.5] * 2, atol=1e-9)


def test_friction_near_the_coefficient_at_which_a_stop_jams():
    D, c = np.array([[0.714, -2.224], [-2.224, 6.968]]), np.array([-0.920, -2.062])
    x, slides = coulomb_forces(D, c, np.zeros(0), Tangents(np.array([0]), np.array([0.3]), np.array([0])))
    load = 0.920 / (0.714 - 0.3 * 2.224)  # the stop pushes, and slides: 0.714 load - 2.224 (0.3 load) = 0.920
    np.testing.assert_allclose(x, [load, 0.3 * load], rtol=1e-9)
    assert slides == [-1]


@pytest.mark.parametrize("joints", [0, 2])
def test_stops_that_depend_on_one_another_keep_their_conditions(joints):
    """Up to four stops in two directions, whose rates need not fit together, with joints that friction holds."""
    numbers, n_solved = np.random.default_rng(3), 0
    for _ in range(200):
        n = int(numbers.integers(1, 5))
        W = np.vstack([numbers.normal(size=(n, 2)) @ np.eye(2, 4), numbers.normal(size=(joints, 4))])
        D, c = W @ W.T, numbers.normal(size=n + joints)
        limit = numbers.uniform(0.1, 2.0, joints)
        try:
            x, _ = coulomb_forces(D, c, limit, NO_TANGENTS)
        except Undetermined:
            continue
        n_solved += 1
        opens, close = D @ x + c, 1e-7 * (1.0 + np.abs(x).max())
        assert (x[:n] >= 0.0).all() and (opens[:n] >= -close).all()
        assert (x[:n] * opens[:n] <= close * (1.0 + x[:n])).all()
        assert (np.abs(x[n:]) <= limit * (1.0 + 1e-9)).all()
        slides = np.abs(opens[n:]) > close
        np.testing.assert_allclose(x[n:][slides], (-np.sign(opens[n:]) * limit)[slides], rtol=1e-6)
    assert n_solved > 100


def test_a_light_ball_that_collapses_between_two_others_ends_with_their_velocity():
    """At 1e-11, rounding hid the gap of a stop that was closing again: it shared an impact, and bounced once more."""
    model, masses = PlanarModel((0.0, 0.0)), (0.47776244890564024, 0.00577433267140068, 1.7046949024050737)
    places = 0.44213526128533326, 1.3571069468442092, 2.1239941769481088
    rates, restitutions = (
        (0.1975431553859459, 0.4844152942234403, -0.9068865266179088),
        (0.6810991843322441, 0.7818419880526322),
    )
    for j, (mass, x, rate) in enumerate(zip(masses, places, rates, strict=True)):
        model.body(f"ball {j}", mass=mass, inertia=1.0, position=(x, 0.0), velocity=(rate, 0.0))
        model.prismatic("ground", f"ball {j}", at=(x, 0.0), axis=(1.0, 0.0))
        if j:
            feet, given = ((x, 0.0), f"ball {j - 1}", (places[j - 1], 0.0)), {"restitution": restitutions[j - 1]}
            model.stop(f"ball {j}", *feet, normal=(1.0, 0.0), **given)
    _, result = moved(model, 3.0, rtol=1e-11, atol=1e-11)
    np.testing.assert_allclose(result.v[::3, -1], np.dot(masses, rates) / sum(masses), rtol=1e-8)


@pytest.mark.filterwarnings("ignore::twoloop.ConstraintWarning")
@pytest.mark.parametrize("above", [1e-6, 0.0])
def test_rebounds_beside_a_singular_position_end_the_run_by_name_if_at_all(above):
    """A parallelogram falls onto its ground line, or nearly: in the middle of a run, an error named a wrong start."""
    model, cosine, height = PlanarModel(gravity=(0.0, -9.81)), np.cos(0.9), np.sin(0.9)
    model.rod("bar", (cosine, height), (1.0 + cosine, height), mass=2.0)
    for i in range(2):
        model.rod(f"leg {i}", (i, 0.0), (i + cosine, height), mass=1.0)
        model.revolute("ground", f"leg {i}", at=(i, 0.0))
        model.revolute(f"leg {i}", "bar", at=(i + cosine, height))
    model.stop("bar", (cosine, height), "ground", (0.0, above), normal=(0.0, 1.0), restitution=0.5)
    problem = model.problem((0.0, 1.5))
    result = solve_with_stops(problem.system, problem.t_span, problem.q0, problem.v0, problem.stops, law="moreau")
    assert result.t[-1] > 0.47
    assert abs(result.q[5, -1] - above) < 1e-5
    assert result.success or re.search("rank|no motion can begin there|in a singular position", result.message)
