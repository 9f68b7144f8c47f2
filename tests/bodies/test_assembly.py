"""Test how models are put together: rough poses, velocities, degrees of freedom, parameters, names."""

import pickle

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from studies.bench.large import grid, in_space, ladder
from tests.bad_input.bodies import rough
from tests.marks import slow
from twoloop import solve_dae
from twoloop.bodies import PlanarModel, SpatialModel, assembly

pytestmark = pytest.mark.filterwarnings("ignore::twoloop.ConstraintWarning")
BARS = {"crank": 1.0, "rod": 2.0, "rocker": 1.5}


def four_bar(rough=0.0, keep=(), ground=2.3, **velocities):
    """Pins on the bars, with poses that are off by `rough`."""
    random = np.random.default_rng(5)
    model = PlanarModel(name="four-bar")
    poses = {"crank": (0.0, 0.5, 0.5 * np.pi), "rod": (0.99, 1.15, 0.15), "rocker": (2.2, 0.7, 1.45)}
    for name, length in BARS.items():
        x, y, angle = np.array(poses[name]) + random.uniform(-rough, rough, 3) * (name not in keep)
        pose = {"position": (x, y), "angle": angle, **velocities.get(name, {})}
        model.body(name, mass=length, inertia=length**3 / 12.0, **pose)
    base, (crank, rod, rocker) = model.ground, model.bodies
    lengths = zip(model.bodies, BARS.values(), strict=True)
    ends = {body: (body.point(-0.5 * L, 0), body.point(0.5 * L, 0)) for body, L in lengths}
    model.revolute(base, crank, at=(base.point(0.0, 0.0), ends[crank][0]))
    model.revolute(crank, rod, at=(ends[crank][1], ends[rod][0]))
    model.revolute(rod, rocker, at=(ends[rod][1], ends[rocker][1]))
    model.revolute(rocker, base, at=(ends[rocker][0], base.point(ground, 0.0)))
    return model


def violation(problem):
    system, t = problem.system, problem.t_span[0]
    rate = system.velocity_constraint(t, problem.q0, problem.v0)
    return max(np.abs(system.constraint(t, problem.q0)).max(), np.abs(rate).max())


def test_rough_poses_are_put_together_and_bodies_that_are_kept_stay(off=0.15):
    problem = four_bar(off).problem()
    assert violation(problem) < 1e-13 and np.abs(problem.q0 - four_bar().problem().q0).max() < 2.0 * off + 1e-12
    problem = four_bar(0.1, keep=("crank",)).problem(keep=["crank"])
    assert (problem.q0[:3] == [0.0, 0.5, 0.5 * np.pi]).all() and violation(problem) < 1e-13
    again = problem.with_parameters({"x of revolute crank-rod on rod": -1.05})
    assert (again.q0[:3] == problem.q0[:3]).all() and violation(again) < 1e-13


def test_poses_from_which_two_assemblies_can_be_meant_need_a_limit_or_a_position():
    model = rough(1.7, bend=0.0)  # straight: the elbow may go up or down
    elbow = model.joints[1]
    with pytest.raises(ValueError, match="may mean two assemblies"):
        model.problem()
    bent, angle = 2.0 * np.arccos(0.85), model.joint_coordinate(elbow)
    assert angle.position(model.problem(positions={elbow: -bent}).q0) == pytest.approx(-bent)
    model.limit(elbow, lower=-0.1, upper=0.4)  # nothing closes within these
    with pytest.raises(ValueError, match=f"with the angle of '{elbow.name}' at a limit"):
        model.problem()
    model.limit(elbow, lower=0.2)
    model.limits.pop(1)
    assert angle.position(model.problem().q0) == pytest.approx(bent)


def test_a_crank_a_rod_on_balls_and_a_rocker_close_on_the_side_where_they_are_roughly():
    random, model = np.random.default_rng(0), SpatialModel()
    pins = np.array([[0.0, 0.0, 0.0], [0.0, 0.5, 0.2], [1.3, 0.5, 0.9], [1.5, 0.0, 0.0]])
    bars = [model.rod(f"bar {k}", *pins[k : k + 2], radius=0.1, mass=1.0) for k in range(3)]
    model.revolute("ground", bars[0], at=pins[0], axis=(1.0, 0.0, 0.0))
    model.spherical(bars[0], bars[1], at=pins[1])
    model.spherical(bars[1], bars[2], at=pins[2])
    model.revolute(bars[2], "ground", at=pins[3], axis=(0.0, 1.0, 0.0))
    for bar in bars:
        bar.position[:] += random.uniform(-0.3, 0.3, 3)
        bar.rotation[:] = Rotation.from_rotvec(random.uniform(-0.3, 0.3, 3)).as_matrix() @ bar.rotation
    problem = model.problem()
    assert (
        violation(problem) < 1e-13 and np.abs(problem.q0[14:17] - 0.5 * (pins[2] + pins[3])).max() < 0.2
    )  # the rocker


def test_velocities_that_are_given_stay_and_the_others_follow():
    problem = four_bar(crank={"angular_velocity": 3.0}).problem()
    assert problem.v0[2] == pytest.approx(3.0, abs=1e-13) and violation(problem) < 1e-12
    rough = four_bar(crank={"angular_velocity": 3.0}, rod={"velocity": problem.v0[3:5] * 1.02}).problem()
    assert violation(rough) < 1e-12 and np.abs(rough.v0 - problem.v0).max() < 0.1


def test_a_drive_moves_the_bodies_to_where_it_begins_far_away():
    model = four_bar()
    model.drive("revolute crank-ground", lambda t: 2.1 + t)
    problem = model.problem((0.1, 1.0))
    assert problem.q0[2] - 0.5 * np.pi == pytest.approx(2.2, abs=1e-12) and violation(problem) < 1e-12
    assert problem.v0[2] == pytest.approx(1.0) and problem.freedom.degrees == 0
    rocker = four_bar()
    rocker.drive("revolute rocker-ground", lambda t: 3.0 + t)  # which rocks, and does not turn
    with pytest.raises(ValueError, match="that the joints do not permit"):
        rocker.problem()


def test_degrees_of_freedom_and_rows_that_follow_from_others():
    """A parallelogram with a third crank; at rest on one line the bars have a freedom more."""

    def parallelogram(angle, third):
        model = PlanarModel()
        up = np.array([np.cos(angle), np.sin(angle)])
        rod = model.body("rod", mass=1.0, inertia=0.1, position=np.add(up, (1.0, 0.0)))
        for k, x in enumerate((0.0, 1.0, 2.0) if third else (0.0, 2.0)):
            crank = model.body(f"crank {k}", mass=1.0, inertia=0.1, position=0.5 * up + (x, 0.0), angle=angle)
            model.revolute("ground", crank, at=(x, 0.0))
            model.revolute(crank, rod, at=np.add(up, (x, 0.0)))
        return model.problem()

    free, held = parallelogram(1.0, False), parallelogram(1.0, True)
    assert free.freedom.degrees == held.freedom.degrees == 1
    assert free.freedom.redundant == () and len(held.freedom.redundant) == 1
    assert set(held.freedom.redundant[0]) == {joint.name for joint in held.joints}
    assert "redundant" in held.tags and "are dependent" in held.note
    flat = parallelogram(0.0, False)
    assert flat.freedom.singular == 1 and "singular" in flat.tags and flat.freedom.degrees == 1


def test_parameters_by_name():
    problem = four_bar().problem()
    names = list(problem.parameters)
    values = [problem.parameters[name] for name in names]
    assert names[1:4] == ["gravity along y (m/s^2)", "mass of crank (kg)", "moment of inertia of crank (kg m^2)"]
    np.testing.assert_array_equal(problem.system.parameters[: len(names)], values)
    assert problem.place("mass of rod") == problem.place("mass of rod (kg)") == names.index("mass of rod (kg)")
    heavier = problem.with_parameters({"mass of rod": 4.0, "gravity along y": -1.62})
    assert heavier.parameters["mass of rod (kg)"] == 4.0 and heavier.system.mass(0.0, problem.q0)[3, 3] == 4.0
    weight = 1.62 * (problem.q0[1] + 4.0 * problem.q0[4] + 1.5 * problem.q0[7])
    assert heavier.energy(0.0, problem.q0, 0.0 * problem.q0) == pytest.approx(weight)
    np.testing.assert_array_equal(heavier.q0, problem.q0)
    longer = problem.with_parameters({"x of revolute rod-rocker on rod (m)": 1.1})
    assert violation(longer) < 1e-12 and np.abs(longer.q0 - problem.q0).max() > 0.01
    joint = next(each for each in longer.joints if each.name == "revolute rod-rocker")
    assert joint.point == pytest.approx((1.1, 0.0))


def test_names_units_and_tags():
    problem = four_bar().problem()
    assert problem.names[:3] == ("x of crank", "y of crank", "angle of crank")
    assert problem.units[:3] == ("m", "m", "rad") and problem.tags == ("closed chain", "rigid", "planar")
    assert problem.name == "four-bar" and four_bar().problem(name="other").system.name == "other"
    model = four_bar()
    assert [model.revolute("rod", "crank", at=(0, 1)).name[-9:] for _ in range(2)] == ["rod-crank", "d-crank 2"]
    assert model.bodies[1].coordinates == (3, 4, 5)


@pytest.mark.parametrize("scale", [1e6, slow(1e-6)])
def test_sizes_do_not_matter(scale):
    """Lengths in other units, at the same angles: times go with the root of the length under gravity."""
    ends = []
    for unit in (1.0, scale):
        model = PlanarModel()
        points = unit * np.array([[0.0, 0.0], [0.0, 1.0], [2.0, 1.5], [2.5, 0.0]])
        for k in range(3):
            model.rod(f"bar {k}", points[k], points[k + 1], mass=1.0)
        for k in range(4):
            a, b = ("ground", *(body.name for body in model.bodies), "ground")[k : k + 2]
            model.revolute(a, b, at=points[k])
        problem = model.problem((0.0, np.sqrt(unit)))
        assert problem.freedom.degrees == 1 and problem.freedom.singular == 0
        atol = np.tile([unit, unit, 1.0], 3) * 1e-10
        result = solve_dae(problem.system, problem.t_span, problem.q0, problem.v0, "DOP853", rtol=1e-10, atol=atol)
        assert result.success
        ends.append(result.q[:, -1] / np.tile([unit, unit, 1.0], 3))
    np.testing.assert_allclose(ends[1], ends[0], atol=1e-7)


def test_a_problem_travels_to_another_process():
    model = four_bar()
    model.spring("crank", (0.0, 1.0), "ground", (3.0, 0.0), stiffness=2.0)
    problem = model.problem((0.0, 0.2))
    again = pickle.loads(pickle.dumps(problem))
    np.testing.assert_array_equal(problem.q0, again.q0)
    assert again.energy(0.0, again.q0, again.v0) == problem.energy(0.0, problem.q0, problem.v0)
    model.motor("revolute crank-ground", lambda t: 1.0 + t)
    without = pickle.loads(pickle.dumps(model.problem()))  # the system travels, a lambda does not
    assert without.system.force(0.0, without.q0, without.v0)[2] == pytest.approx(1.0, abs=2.0)
    with pytest.raises(ValueError, match="without its model"):
        without.with_parameters({})


def test_a_spring_without_length_has_force_where_its_ends_meet():
    model = PlanarModel(gravity=(0.0, 0.0))
    model.body("bob", mass=2.0, inertia=1.0, position=(0.0, 0.0), velocity=(3.0, 0.0))
    model.spring("ground", (0.0, 0.0), "bob", (0.0, 0.0), stiffness=8.0)
    problem = model.problem((0.0, 2.0))
    result = solve_dae(problem.system, problem.t_span, problem.q0, problem.v0, rtol=1e-10, atol=1e-10)
    np.testing.assert_allclose(result.q[0], 1.5 * np.sin(2.0 * result.t), atol=1e-8)
    assert problem.freedom.degrees == 3 and problem.conserved
    np.testing.assert_allclose(problem.energy(result.t, result.q, result.v), 9.0, atol=1e-8)


def test_bodies_that_are_given_at_rest_on_one_that_is_driven(on=("belt", "belt", "ground")):
    """What is left of zero velocities is the rounding of the speed of the drive."""
    model = PlanarModel((0.0, 0.0))
    model.body("belt", mass=1.0, inertia=1.0, position=(0.0, -1.0))
    model.drive(model.prismatic("ground", "belt", at=(0.0, -1.0), axis=(1.0, 0.0)), lambda t: 0.3 * t)
    for k, name in enumerate(on):
        model.body(f"block {k}", mass=1.5, inertia=1.0, position=(0.0, float(k)), velocity=(0.0, 0.0))
        model.prismatic(name, f"block {k}", at=(0.0, float(k)), axis=(1.0, 0.0))
    v0 = model.problem().v0
    np.testing.assert_allclose(v0, 0.3 * np.eye(len(v0))[0], atol=1e-15)


@pytest.mark.parametrize("made", [slow(lambda: in_space(ladder(30), 0.0)), lambda: in_space(grid(30), 0.3)])
def test_the_freedom_of_large_models_is_that_by_full_matrices(made, monkeypatch):
    def by_full_matrices(system, t, q, rows):
        raise AssertionError("full matrices")

    with monkeypatch.context() as sparse:
        sparse.setattr(assembly, "_rank", by_full_matrices)
        found = made().bodies.freedom
    monkeypatch.setattr(assembly, "dependence", lambda *_: None)
    assert made().bodies.freedom == found


def test_velocities_of_light_bodies_tied_to_a_heavy_one_have_least_energy():
    points, masses = np.array([(0.0, 0.0), (1.0, 0.0), (2.0, 0.5), (2.2, -0.3)]), (1e-6, 1e6, 1e-6)
    model = PlanarModel(gravity=(0.0, 0.0))
    for k, mass in enumerate(masses):
        velocity = {"velocity": (0.0, 1.5)} if k == 0 else {}
        model.body(str(k), mass=mass, inertia=0.1 * mass, position=points[k : k + 2].mean(axis=0), **velocity)
        model.revolute(str(k - 1) if k else "ground", str(k), at=points[k])
    rates = model.problem((0.0, 1.0)).v0[2::3]
    pin = np.zeros(2)  # velocity of the pin at the start of a rod
    for k, expected in enumerate((3.0, None, None)):
        x, y = r = np.diff(points, axis=0)[k] / 2.0
        # as the mass of the next rod is 1e-12 times as large or its motion is given, each rod turns for itself
        rate = expected or -np.dot((-y, x), pin) / (0.1 + r @ r)
        assert rates[k] == pytest.approx(rate, rel=1e-9)
        pin = pin + rate * 2.0 * np.array((-y, x))


def test_velocities_of_light_bodies_do_not_depend_on_a_heavy_one_beside_them():
    def start(heavy):
        model = PlanarModel()
        model.body("carriage", mass=heavy, inertia=heavy, position=(5.0, 1.0), velocity=(0.1, 0.0))
        model.prismatic("ground", "carriage", at=(5.0, 1.0), axis=(1.0, 0.0))
        places = [(0.0, 0.0), (0.01, 0.0), (0.02, 0.005), (0.02, 0.0)]
        for name, begin, end in zip("abc", places, places[1:], strict=False):
            spin = {"angular_velocity": 3.0} if name == "a" else {}
            model.rod(name, begin, end, mass=1e-3, **spin)
            model.revolute("ground" if name == "a" else chr(ord(name) - 1), name, at=begin)
        return model.problem((0.0, 1.0)).v0

    np.testing.assert_allclose(start(1e8), start(1.0), rtol=1e-9, atol=1e-9)


def test_given_velocities_that_are_rounding_errors_are_rest():
    model = PlanarModel()
    model.body("slider", mass=1.0, inertia=1.0, position=(1.0, 0.0), velocity=(0.0, 3e-17))
    model.prismatic("ground", "slider", at=(1.0, 0.0), axis=(1.0, 0.0))
    np.testing.assert_array_equal(model.problem((0.0, 1.0)).v0, 0.0)
