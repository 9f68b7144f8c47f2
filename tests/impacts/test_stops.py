"""Impacts with restitution, rest in contact and release, against closed forms and equations in least coordinates."""

import pickle

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

from twoloop import ConstrainedSystem, Status, Stop, load, solve_with_stops
from twoloop.bodies import PlanarModel, SpatialModel

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
    again = load(tmp_path / "run.npz", problem.system)
    assert (again.q == result.q).all() and again.changes == result.changes
    for each in (result, again, pickle.loads(pickle.dumps(result))):
        with pytest.raises(ValueError, match="impacts"):
            each.certify()
    assert result.arcs[0].certify().passed


def test_a_run_with_impacts_is_drawn(tmp_path):
    pytest.importorskip("matplotlib")
    model = ball(velocity=(0.3, 0.0))
    model.stop("ball", (0.0, 1.0), "ground", (5.0, 0.0), normal=(0.0, 3.0), restitution=0.7, name="floor")
    _, result = moved(model, 2.0)
    result.animate(tmp_path / "run.html")
    result.plot(tmp_path / "run.png")


def test_output_times():
    model = ball()
    model.stop("ball", (0.0, 1.0), "ground", (0.0, 0.0), normal=(0.0, 1.0), restitution=0.5)
    times = np.linspace(0.0, 2.0, 21)
    _, all_steps = moved(model, 2.0)
    _, result = moved(model, 2.0, t_eval=times)
    np.testing.assert_array_equal(result.t, times)
    np.testing.assert_array_equal(result.q, all_steps.sol(times).q)
    assert np.isfinite(result.a).all()


def test_a_rod_falls_on_a_stop_and_bounces():
    """The pin takes its share of the impulses."""
    model, e, m = PlanarModel(), 0.6, 2.0
    rod = model.rod("rod", (0.0, 0.0), (1.0, 0.0), mass=m)
    model.revolute("ground", rod, at=(0.0, 0.0))
    model.stop(rod, (1.0, 0.0), "ground", (0.0, -0.3), normal=(0.0, 1.0), restitution=e)
    problem, result = moved(model, 2.0)
    limit, t, y, known = -np.arcsin(0.3), 0.0, np.zeros(2), []

    def lands(t, y):
        return y[0] - limit

    lands.terminal, lands.direction = True, -1
    for _ in range(8):
        fall = solve_ivp(
            lambda t, y: [y[1], -1.5 * GRAVITY * np.cos(y[0])],
            *((t, t + 2.0), y, "DOP853"),
            **{"rtol": 1e-12, "atol": 1e-14, "events": lands, "first_step": 1e-3},
        )
        t, y = fall.t_events[0][0], np.array([limit, -e * fall.y_events[0][0][1]])
        known.append(t)
    np.testing.assert_allclose([impact.t for impact in result.impacts][:8], known, atol=1e-9)
    at_rest = result.arcs[-1]
    assert result.q[2, -1] == pytest.approx(limit) and at_rest.t[0] < 1.0
    np.testing.assert_allclose(-at_rest.lam[2], 0.5 * m * GRAVITY, rtol=1e-9)  # half its weight
    for impact in result.impacts:
        q = result.sol(impact.t).q
        assert np.abs(problem.system.velocity_constraint(impact.t, q, impact.v_after)).max() < 1e-12


def test_a_bar_bounces_on_its_ends_to_rest_and_keeps_its_velocity_along_the_floor():
    """Free flights are known; the shortest of them take microseconds."""
    m, length, e, along = 1.4, 0.8, 0.45, 0.2
    y, angle, v, spin, t, known = 0.37, 0.23, 0.0, 1.1, 0.0, []
    half = 0.5 * length * np.array([np.cos(angle), np.sin(angle)])
    model, middle = PlanarModel(name="bar"), np.array([0.0, y])
    bar = model.rod("bar", middle - half, middle + half, mass=m, velocity=(along, 0.0), angular_velocity=spin)
    for end in (-0.5, 0.5):
        model.stop(bar, bar.point(end * length, 0.0), "ground", (0.0, 0.0), normal=(0.0, 1.0), restitution=e)
    _, result = moved(model, 3.0)

    def gap(x, side):
        return y + v * x - 0.5 * GRAVITY * x * x + side * 0.5 * length * np.sin(angle + spin * x)

    later = np.linspace(1e-6, 0.5, 20001)
    while len(known) < 12:
        falls = []
        for side in (-1.0, 1.0):
            k = np.flatnonzero((gap(later, side)[:-1] > 0.0) & (gap(later, side)[1:] <= 0.0))
            falls += [(brentq(gap, later[k[0]], later[k[0] + 1], (side,), 1e-15), side)] if k.size else []
        x, side = min(falls)
        t, y, angle, v = t + x, y + v * x - 0.5 * GRAVITY * x * x, angle + spin * x, v - GRAVITY * x
        arm, J = side * 0.5 * length * np.cos(angle), m * length**2 / 12.0
        impulse = -(1.0 + e) * (v + arm * spin) / (1.0 / m + arm**2 / J)
        v, spin = v + impulse / m, spin + impulse * arm / J
        known.append(t)
    np.testing.assert_allclose([impact.t for impact in result.impacts][:12], known, atol=1e-10)
    assert np.ptp([impact.v_after[0] for impact in result.impacts]) < 1e-10  # no stop pushes along the floor
    np.testing.assert_allclose(result.q[:, -1], [along * 3.0, 0.0, 0.0], atol=3e-10)
    np.testing.assert_allclose(result.v[:, -1], [along, 0.0, 0.0], atol=1e-10)


def test_a_stop_lets_go_when_its_force_would_pull():
    model = PlanarModel()
    pin = model.revolute("ground", model.rod("rod", (0.0, 0.0), (1.0, 0.0), mass=2.0), at=(0.0, 0.0))
    model.motor(pin, lambda t: 12.0 * np.sin(t))
    (stop,) = model.limit(pin, lower=0.0, restitution=0.5)
    _, result = moved(model, 1.2)
    assert stop.name == "lower limit of revolute rod-ground" and result.impacts == () and len(result.arcs) == 2
    assert result.arcs[0].t[-1] == pytest.approx(np.arcsin(GRAVITY / 12.0), abs=1e-10)
    assert result.q[2].min() >= 0.0 and result.q[2, -1] > 1e-4


def test_a_plastic_ball_on_a_table_that_shakes():
    """It takes off where the table falls faster than it, lands where their paths meet, and stays again."""
    A, w = 0.01, 40.0

    def table(t):
        return A * np.sin(w * t), A * w * np.cos(w * t), A * w * w * np.sin(w * t)

    known, t = [], 0.0
    while t < 0.6:
        if table(t)[2] < GRAVITY:
            grid = t + np.arange(0.0, 0.3, 1e-4)
            s = grid[np.argmax(table(grid)[2] >= GRAVITY)]
            t = brentq(lambda s: table(s)[2] - GRAVITY, s - 1e-4, s, xtol=1e-14)
        known.append(t)
        y, rate, _ = table(t)
        grid = t + np.arange(1e-3, 0.3, 1e-4)

        def above(s, y=y, rate=rate, t=t):
            return y + rate * (s - t) - 0.5 * GRAVITY * (s - t) ** 2 - table(s)[0]

        s = grid[np.argmax(above(grid) <= 0.0)]
        t = brentq(above, s - 1e-4, s, xtol=1e-14)
        known.append(t)
    stop = Stop(lambda t, q: q[1] - A * np.sin(w * t), 0.0)
    _, result = moved(ball(0.0, velocity=(0.0, A * w)), 0.6, stop)
    ends = [arc.t[-1] for arc in result.arcs[:-1]]
    np.testing.assert_allclose(ends, known[: len(ends)], atol=1e-9)
    assert len(ends) >= 6


@pytest.mark.parametrize("restitution", [0.0, 0.5])
def test_a_box_rocks_to_rest_on_two_corners(restitution):
    model = PlanarModel()
    box = model.box("box", (1.0, 0.4), mass=1.0, position=(0.0, 0.6), angle=0.3)
    for corner in ((0.5, 0.2), (0.5, -0.2), (-0.5, 0.2), (-0.5, -0.2)):
        model.stop(box, box.point(*corner), "ground", (0.0, 0.0), normal=(0.0, 1.0), restitution=restitution)
    problem, result = moved(model, 5.0)
    np.testing.assert_allclose(result.q[1:, -1], [0.2, 0.0], atol=1e-9)
    assert (np.diff(result.energy) < 1e-9).all()
    assert min(stop.gap(0.0, q) for q in result.q.T for stop in problem.stops) > -1e-10
    np.testing.assert_allclose(-result.arcs[-1].lam[:, -1], [0.5 * GRAVITY] * 2)


@pytest.mark.slow
def test_a_ball_comes_to_rest_in_a_wedge_at_the_origin():
    model = ball()
    for side in (-1.0, 1.0):
        model.stop("ball", (0.0, 1.0), "ground", (0.0, 0.0), normal=(side * np.sin(0.7), np.cos(0.7)), restitution=0.2)
    model.force("ball", (0.0, 1.0), (0.1, 0.0))
    _, result = moved(model, 2.5)
    np.testing.assert_allclose(result.q[:, -1], 0.0, atol=1e-9)
    assert len(result.impacts) > 20


def test_balls_and_walls_without_loss():
    model = PlanarModel(gravity=(0.0, 0.0))
    for k, x in enumerate((0.0, 1.0, 2.0)):
        model.disc(f"disc {k}", 0.2, mass=1.0, position=(x, 0.0), velocity=(1.0 - min(k, 1), 0.0))
    for k in range(2):
        ends = model.bodies[k].point(0.2, 0.0), model.bodies[k + 1].point(-0.2, 0.0)
        model.stop(model.bodies[k + 1], ends[1], model.bodies[k], ends[0], normal=(1.0, 0.0), restitution=1.0)
    model.stop("disc 2", (2.2, 0.0), "ground", (3.2, 0.0), normal=(-1.0, 0.0), restitution=1.0)
    _, result = moved(model, 4.0)
    np.testing.assert_allclose([impact.t for impact in result.impacts], [0.6, 1.2, 2.2, 3.2, 3.8], atol=1e-12)
    assert np.ptp(result.energy) < 1e-12


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
        made.limit(
            made.prismatic("ground", sledge, at=at(0.0, 0.0), axis=at(2.0, 0.0)), lower=-0.2, upper=0.5, restitution=0.8
        )
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


def test_between_two_stops_that_leave_no_room():
    cramped = [Stop(lambda t, q: q[1], 0.5), Stop(lambda t, q: 1e-13 - q[1] + 0.0 * t, 0.5)]
    held = ball(0.0).problem()
    result = solve_with_stops(held.system, (0.0, 1.0), held.q0, held.v0, cramped)
    assert result.status in (Status.REACHED_END, Status.STAGNATED) and np.abs(result.q[1]).max() < 1e-9


def test_a_motion_that_begins_at_rest_on_a_stop_has_the_multipliers_of_its_system():
    model = PlanarModel()
    model.body("block", mass=1.0, inertia=1.0, position=(0.0, 0.0))
    model.prismatic("ground", "block", at=(0.0, 0.0), axis=(0.0, 1.0))
    model.stop("block", (0.0, 0.0), "ground", (0.0, 0.0), normal=(0.0, 1.0))
    model.force("block", (0.0, 0.0), lambda t: (3.0, 12.0 * t))  # lifts the block from t = 9.81 / 12 on
    problem = model.problem((0.0, 2.0))
    result = solve_with_stops(
        problem.system, problem.t_span, problem.q0, problem.v0, problem.stops, t_eval=[0.0, 0.5, 2.0], **TIGHT
    )
    assert result.lam.shape == (2, 3) and len(result.arcs) == 2
    t, t0 = 2.0, 9.81 / 12.0
    known = 2.0 * (t**3 - t0**3) - 6.0 * t0**2 * (t - t0) - 0.5 * 9.81 * (t - t0) ** 2
    assert result.q[1, -1] == pytest.approx(known, abs=1e-8)
    np.testing.assert_allclose(np.abs(result.lam[0]), 3.0, atol=1e-8)


@pytest.mark.parametrize(("size", "rate"), [(5e-3, 300.0), (5e-2, 20.0)])
def test_the_first_touch_of_a_shaking_table_is_found(size, rate):
    """A body that comes slowly, in steps longer than the table takes to shake."""
    model = PlanarModel(gravity=(0.0, 0.0))
    model.body("ball", mass=1.0, inertia=0.1, position=(0.0, 0.2), velocity=(0.0, -0.1), angular_velocity=0.3)
    problem = model.problem((0.0, 5.0))
    stop = Stop(lambda t, q: q[1] - size * np.sin(rate * t), 0.5)
    result = solve_with_stops(problem.system, problem.t_span, problem.q0, problem.v0, stop)
    times = np.linspace(0.0, 5.0, 500_001)
    first = times[np.flatnonzero(0.2 - 0.1 * times < size * np.sin(rate * times))[0]]
    assert result.impacts[0].t == pytest.approx(first, abs=1.1e-5)


@pytest.mark.parametrize("method", ["auto", "RadauIIA5", "BDF"])
@pytest.mark.parametrize("above", [1e-4, 1e-6, 1e-8])
def test_a_ball_that_grazes_a_ceiling_between_two_looks_hits_it(above, method):
    """The gap is closed for 0.1 ms to 9 ms, and looked at every 0.5 ms or more rarely."""
    height, e, end = 0.437, 0.5, 1.0
    system = ConstrainedSystem.from_python(n_q=1, n_c=0, mass=np.eye(1), force=lambda t, q, v: np.array([-GRAVITY]))
    speed, hit = np.sqrt(2.0 * GRAVITY * (height + above)), np.sqrt(2.0 * GRAVITY * above)
    ceiling = Stop(lambda t, q: height - q[0], e, "ceiling")
    result = solve_with_stops(system, (0.0, end), [0.0], [speed], ceiling, method, **TIGHT)
    assert len(result.impacts) == 1
    rest = end - (speed - hit) / GRAVITY
    assert abs(result.v[0, -1] + e * hit + GRAVITY * rest) < 1e-4 * hit + 1e-6


def test_a_ball_that_does_not_reach_a_ceiling_does_not_hit_it():
    system = ConstrainedSystem.from_python(n_q=1, n_c=0, mass=np.eye(1), force=lambda t, q, v: np.array([-GRAVITY]))
    speed = np.sqrt(2.0 * GRAVITY * (0.437 - 1e-8))
    result = solve_with_stops(system, (0.0, 1.0), [0.0], [speed], Stop(lambda t, q: 0.437 - q[0], 0.5), **TIGHT)
    assert result.success and not result.impacts and abs(result.v[0, -1] - speed + GRAVITY) < 1e-8


def test_two_stops_on_one_side_of_which_one_moves():
    """The stop whose rebound is the faster one hits, also where the other closes at another rate."""
    stops = [
        Stop(lambda t, q: -q[0] + 0.5 * t, restitution=1.0, name="moving"),
        Stop(lambda t, q: -q[0], restitution=0.5, name="fixed"),
    ]
    free = ConstrainedSystem.from_python(n_q=1, n_c=0, mass=np.eye(1), force=lambda t, q, v: np.zeros(1))
    result = solve_with_stops(free, (0.0, 1.0), [0.0], [1.0], stops)
    assert result.success and [impact.stops for impact in result.impacts] == [("fixed",)]
    np.testing.assert_allclose(result.q[0, -1], -0.5)


def test_two_stops_that_close_on_a_body_end_the_run():
    """The wall on the right leaves the body on the floor on the left, and comes back."""
    stops = [Stop(lambda t, q: q[0], name="left"), Stop(lambda t, q: -q[0] - 0.1 * t * (t - 0.2), name="right")]
    pushed = ConstrainedSystem.from_python(n_q=1, n_c=0, mass=np.eye(1), force=lambda t, q, v: -np.ones(1))
    result = solve_with_stops(pushed, (0.0, 1.0), [0.0], [0.0], stops, time_limit=20.0)
    assert result.status == Status.STAGNATED and "push against each other" in result.message
    np.testing.assert_allclose(result.t[-1], 0.2)


def test_parallel_stops_let_go_at_once():
    """Both hold the same coordinate; none takes over the force of the other, which is zero but for rounding."""
    for seed in range(3):
        mass, k, lift, rate, phase = np.random.default_rng(seed).uniform([1, 1, 12, 2, 0], [3, 9, 20, 4, 1])

        def force(t, q, v, k=k, lift=lift, rate=rate, phase=phase):
            return np.array([-10.0 + lift * np.sin(rate * t + phase) - k * (q[0] - 0.1)])

        lifted = ConstrainedSystem.from_python(n_q=1, n_c=0, mass=np.diag([mass]), force=force)
        stops = [Stop(lambda t, q: q[0], name="one"), Stop(lambda t, q: 3.0 * q[0], name="other")]
        result = solve_with_stops(lifted, (0.0, 0.9), [0.0], [0.0], stops)
        assert result.success, result.message
        alone = solve_with_stops(lifted, (0.0, 0.9), [0.0], [0.0], stops[0])
        np.testing.assert_allclose(result.q[:, -1], alone.q[:, -1], atol=1e-8)


def test_rebounds_from_a_wall_towards_which_another_turns_the_load_die_out():
    """Without the wall on the left, the load would lift the body off the slope."""
    pressed = ConstrainedSystem.from_python(n_q=2, n_c=0, mass=np.eye(2), force=lambda t, q, v: np.array([-6.0, -1.0]))
    groove = [
        Stop(lambda t, q: q[0], name="wall"),
        Stop(lambda t, q: 0.8 * q[1] - 0.6 * q[0], restitution=0.5, name="slope"),
    ]
    result = solve_with_stops(pressed, (0.0, 3.0), [0.0, 0.1], [0.0, 0.0], groove, time_limit=20.0)
    assert result.success and np.abs(result.q[:, -1]).max() < 1e-9, result.message
    times = [impact.t for impact in result.impacts]
    assert len(times) < 40 and times[-1] == pytest.approx(np.sqrt(0.2) * (1.0 + 0.5) / (1.0 - 0.5), abs=1e-4)


def test_a_stop_that_opens_is_hit_when_the_impact_at_another_turns_the_body_back():
    """The impact at the wall sends the body towards the floor, which it was leaving."""
    free = ConstrainedSystem.from_python(n_q=2, n_c=0, mass=np.eye(2), force=lambda t, q, v: np.array([0.0, -1e-3]))
    corner = [
        Stop(lambda t, q: q[1], restitution=0.8, name="floor"),
        Stop(lambda t, q: np.sqrt(0.75) * q[0] - 0.5 * q[1], restitution=0.8, name="wall"),
    ]
    result = solve_with_stops(free, (0.0, 0.1), [0.0, 0.0], [-0.5, 0.5], corner)
    assert result.success and [impact.stops for impact in result.impacts] == [("wall",), ("floor",)]
    jumps = sum(impact.v_after - impact.v_before for impact in result.impacts)
    np.testing.assert_allclose(result.v[:, -1], jumps + np.array([-0.5, 0.5 - 1e-4]), atol=1e-9)


@pytest.mark.parametrize("options", [{"method": "Taylor"}, {"compiled": True}], ids=str)
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
