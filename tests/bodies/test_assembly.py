"""How models are put together: rough poses, velocities, degrees of freedom, parameters, names."""

import pickle

import numpy as np
import pytest

from studies.bench.large import closed_chain_of_hinges, grid, in_space, ladder
from twoloop import DOP853, consistent_states, solve_dae
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
        model.body(
            name, mass=length, inertia=length**3 / 12.0, position=(x, y), angle=angle, **velocities.get(name, {})
        )
    crank, rod, rocker = model.bodies
    base, ends = (
        model.ground,
        {
            body: (body.point(-0.5 * L, 0), body.point(0.5 * L, 0))
            for body, L in zip(model.bodies, BARS.values(), strict=True)
        },
    )
    model.revolute(base, crank, at=(base.point(0.0, 0.0), ends[crank][0]))
    model.revolute(crank, rod, at=(ends[crank][1], ends[rod][0]))
    model.revolute(rod, rocker, at=(ends[rod][1], ends[rocker][1]))
    model.revolute(rocker, base, at=(ends[rocker][0], base.point(ground, 0.0)))
    return model


def violation(problem):
    system, t = problem.system, problem.t_span[0]
    rate = system.velocity_constraint(t, problem.q0, problem.v0)
    return max(np.abs(system.constraint(t, problem.q0)).max(), np.abs(rate).max())


@pytest.mark.parametrize("rough", [0.0, 0.05, 0.15])
def test_rough_poses_are_put_together(rough):
    problem = four_bar(rough).problem()
    assert violation(problem) < 1e-13 and np.abs(problem.q0 - four_bar().problem().q0).max() < 2.0 * rough + 1e-12
    assert solve_dae(problem.system, (0.0, 0.1), problem.q0, problem.v0).success


def test_poses_from_which_two_assemblies_can_be_meant_are_refused():
    model = PlanarModel(name="arms")
    ground = model.ground
    for name, x in (("one", 0.5), ("two", 1.4)):
        model.body(name, mass=1.0, inertia=0.1, position=(x, 0.0))  # straight: the elbow may go up or down
    one, two = model.bodies
    model.revolute(ground, one, at=(ground.point(0.0, 0.0), one.point(-0.5, 0.0)))
    model.revolute(one, two, at=(one.point(0.5, 0.0), two.point(-0.5, 0.0)))
    model.revolute(two, ground, at=(two.point(0.5, 0.0), ground.point(1.7, 0.0)))
    with pytest.raises(ValueError, match="cannot be assembled") as caught:
        model.problem()
    assert "coordinate " not in str(caught.value)


def test_bodies_that_are_kept_stay():
    problem = four_bar(0.1, keep=("crank",)).problem(keep=["crank"])
    assert (problem.q0[:3] == [0.0, 0.5, 0.5 * np.pi]).all() and violation(problem) < 1e-13
    again = problem.with_parameters({"x of revolute crank-rod on rod": -1.05})
    assert (again.q0[:3] == problem.q0[:3]).all() and violation(again) < 1e-13


def test_velocities_that_are_given_stay_and_the_others_follow():
    problem = four_bar(crank={"angular_velocity": 3.0}).problem()
    assert problem.v0[2] == pytest.approx(3.0, abs=1e-13) and violation(problem) < 1e-12
    assert (four_bar().problem().v0 == 0.0).all()
    rough = four_bar(crank={"angular_velocity": 3.0}, rod={"velocity": problem.v0[3:5] * 1.02}).problem()
    assert violation(rough) < 1e-12 and np.abs(rough.v0 - problem.v0).max() < 0.1


def test_velocities_that_are_free_are_those_of_least_kinetic_energy():
    model = PlanarModel()
    for k in range(2):
        motion = {"angular_velocity": 2.0} if k == 0 else {}
        model.body(f"bar {k}", mass=1.0, inertia=1.0 / 12.0, position=(k + 0.5, 0.0), **motion)
    model.revolute("ground", "bar 0", at=(0.0, 0.0))
    model.revolute("bar 0", "bar 1", at=(1.0, 0.0))
    v = model.problem().v0
    # 2 m/s of the pin, through which an impulse sets the second bar in motion: v / w of a free bar hit at its end
    np.testing.assert_allclose(v, [0.0, 1.0, 2.0, 0.0, 0.5, -3.0], atol=1e-12)


def test_a_drive_moves_the_bodies_to_where_it_begins():
    model = four_bar()
    model.drive("revolute crank-ground", lambda t: 0.3 + 2.0 * t)
    problem = model.problem((0.1, 1.0))
    assert problem.q0[2] - 0.5 * np.pi == pytest.approx(0.5, abs=1e-12)
    assert problem.v0[2] == pytest.approx(2.0) and problem.freedom.degrees == 0
    spatial = SpatialModel()
    wheel = spatial.body("wheel", mass=1.0, inertia=(1.0, 1.0, 1.0), position=(0.3, 0.0, 0.0))
    hinge = spatial.revolute(wheel, "ground", at=(0.0, 0.0, 0.0), axis=(0.0, 1.0, 0.0))
    spatial.drive(hinge, lambda t: 1.2 + 0.0 * t)
    place = spatial.problem().q0[:3]  # the ground turns on the wheel
    np.testing.assert_allclose(place, [0.3 * np.cos(1.2), 0.0, 0.3 * np.sin(1.2)], atol=1e-12)


def test_a_drive_that_begins_far_away_leaves_no_assembly():
    model = four_bar()
    model.drive("revolute crank-ground", lambda t: 2.2 + t)
    problem = model.problem()
    assert problem.q0[2] - 0.5 * np.pi == pytest.approx(2.2, abs=1e-12) and violation(problem) < 1e-12
    result = solve_dae(problem.system, (0.0, 2.0 * np.pi - 2.2), problem.q0, problem.v0, rtol=1e-10, atol=1e-10)
    known = four_bar().problem(keep="crank")  # a turn from where it was given it is there again
    np.testing.assert_allclose(result.q[[0, 1, 3, 4, 6, 7], -1], known.q0[[0, 1, 3, 4, 6, 7]], atol=1e-8)
    rocker = four_bar()
    rocker.drive("revolute rocker-ground", lambda t: 3.0 + t)  # which rocks, and does not turn
    with pytest.raises(ValueError, match="that the joints do not permit"):
        rocker.problem()


def test_a_drive_that_holds_still_conserves_the_energy_and_one_that_moves_does_not():
    for motion, conserved in ((lambda t: 0.0 * t, True), (lambda t: 0.4, True), (lambda t: 0.1 * t, False)):
        model = four_bar()
        model.drive("revolute crank-ground", motion)
        assert model.problem().conserved is conserved


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


def test_two_groups_of_redundant_joints_are_told_apart():
    model = SpatialModel()
    for k in range(2):
        door = model.body(f"door {k}", mass=1.0, inertia=(0.1, 0.1, 0.1), position=(k, 0.5, 0.0))
        for z in (0.0, 1.0):
            model.revolute("ground", door, at=(k, 0.0, z), axis=(0.0, 0.0, 1.0), name=f"hinge {k} {z}")
    model.body("free", mass=1.0, inertia=(0.1, 0.1, 0.1), position=(5.0, 0.0, 0.0))
    freedom = model.problem().freedom
    assert freedom.degrees == 2 + 6
    assert freedom.redundant == (("hinge 0 0.0", "hinge 0 1.0"), ("hinge 1 0.0", "hinge 1 1.0"))


def test_a_change_point_is_crossed():
    """A deltoid whose bars come to lie on one line: links and assembly stay as they were."""
    model = PlanarModel(gravity=(0.0, 0.0))
    crank = model.body("crank", mass=1.0, inertia=0.1, position=(0.0, 0.5), angle=0.5 * np.pi, angular_velocity=-2.0)
    rod = model.body("rod", mass=1.0, inertia=0.1, position=(1.0, 1.0))
    other = model.body("other", mass=1.0, inertia=0.1, position=(2.0, 0.5), angle=0.5 * np.pi)
    model.revolute("ground", crank, at=(0.0, 0.0))
    model.revolute(crank, rod, at=(0.0, 1.0))
    model.revolute(rod, other, at=(2.0, 1.0))
    model.revolute(other, "ground", at=(2.0, 0.0))
    problem = model.problem((0.0, 4.0))
    method = DOP853("restored")
    result = solve_dae(problem.system, problem.t_span, problem.q0, problem.v0, method, rtol=1e-10, atol=1e-10)
    assert result.success and result.q[2].min() < -4.0
    np.testing.assert_allclose(result.q[5], 0.0, atol=1e-7)  # the rod stays parallel
    np.testing.assert_allclose(result.v[2], -2.0, atol=1e-7)


def test_parameters_by_name():
    problem = four_bar().problem()
    names = list(problem.parameters)
    values = [problem.parameters[name] for name in names]
    assert names[:4] == [
        "gravity along x (m/s^2)",
        "gravity along y (m/s^2)",
        "mass of crank (kg)",
        "moment of inertia of crank (kg m^2)",
    ]
    np.testing.assert_array_equal(problem.system.parameters[: len(names)], values)
    assert problem.place("mass of rod") == problem.place("mass of rod (kg)") == names.index("mass of rod (kg)")
    heavier = problem.with_parameters({"mass of rod": 4.0, "gravity along y": -1.62})
    assert heavier.parameters["mass of rod (kg)"] == 4.0 and heavier.system.mass(0.0, problem.q0)[3, 3] == 4.0
    assert heavier.energy(0.0, problem.q0, 0.0 * problem.q0) == pytest.approx(
        1.62 * (problem.q0[1] + 4.0 * problem.q0[4] + 1.5 * problem.q0[7])
    )
    np.testing.assert_array_equal(heavier.q0, problem.q0)
    longer = problem.with_parameters({"x of revolute rod-rocker on rod (m)": 1.1})
    assert violation(longer) < 1e-12 and np.abs(longer.q0 - problem.q0).max() > 0.01
    points = longer.drawing.at(longer.q0)
    assert np.sort(np.linalg.norm([points[i] - points[j] for i, j in longer.drawing.bars], axis=1)) == pytest.approx(
        [1.0, 1.5, 2.1]
    )
    joint = next(each for each in longer.joints if each.name == "revolute rod-rocker")
    assert joint.point == pytest.approx((1.1, 0.0))


def test_other_parameters_without_another_start_are_refused_or_put_together():
    problem = four_bar().problem()
    p = problem.system.parameters.copy()
    p[problem.place("x of revolute rod-rocker on rod")] = 1.1
    with pytest.raises(ValueError, match="q0 is not consistent"):
        solve_dae(problem.system.with_parameters(p), (0.0, 0.1), problem.q0, problem.v0)
    q, _ = consistent_states(problem.system, 0.0, problem.q0, problem.v0, parameters=p[None])
    np.testing.assert_allclose(problem.system.with_parameters(p).constraint(0.0, q[0]), 0.0, atol=1e-12)
    p[-1 - len(p) // 3] += 1000.0  # not a number of the model, but of its tables
    with pytest.raises((ValueError, IndexError)):
        problem.system.with_parameters(p).constraint(0.0, problem.q0)


def test_names_units_tags_and_reactions():
    problem = four_bar().problem()
    assert problem.names[:3] == ("x of crank", "y of crank", "angle of crank")
    assert problem.units[:3] == ("m", "m", "rad") and problem.tags == ("closed chain", "rigid", "planar")
    assert problem.name == "four-bar" and four_bar().problem(name="other").system.name == "other"
    result = solve_dae(problem.system, (0.0, 0.5), problem.q0, problem.v0, rtol=1e-9, atol=1e-9)
    pins = [result.reactions(joint.name).force for joint in problem.joints[:2]]
    weight = np.array([0.0, -9.81])
    # on the crank act the ground and, by the second joint, the rod
    np.testing.assert_allclose(pins[0] + pins[1] + weight[:, None], result.a[:2], atol=1e-6)
    model = four_bar()
    assert model.revolute("rod", "crank", at=(0.0, 1.0)).name == "revolute rod-crank"
    assert model.revolute("rod", "crank", at=(0.0, 1.0)).name == "revolute rod-crank 2"
    assert model.bodies[1].coordinates == (3, 4, 5)


def test_a_damper_that_is_added_by_a_parameter_is_told():
    model = four_bar()
    model.spring("crank", (0.0, 1.0), "ground", (3.0, 0.0), stiffness=2.0)
    problem = model.problem()
    model.body("later", mass=1.0, inertia=1.0, position=(0.0, 0.0))  # does not belong to the problem
    assert problem.conserved and not problem.with_parameters({"damping of spring crank-ground": 0.1}).conserved
    assert problem.with_parameters({"stiffness of spring crank-ground": 0.1}).system.n_q == 9


def test_names_with_brackets():
    model = SpatialModel()
    model.body("arm (left)", mass=1.0, inertia=(1.0, 1.0, 1.0), position=(0.0, 0.0, 0.0))
    problem = model.problem()
    assert problem.names[3:5] == ("e0 of arm (left)", "e1 of arm (left)") and problem.units[2:4] == ("m", "")
    assert problem.place("mass of arm (left)") == 3


@pytest.mark.parametrize("scale", [1e-6, 1e-3, 1e3, 1e6])
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
    one, other = (solve_dae(each.system, each.t_span, each.q0, each.v0) for each in (problem, again))
    np.testing.assert_array_equal(one.q, other.q)
    assert again.energy(0.0, again.q0, again.v0) == problem.energy(0.0, problem.q0, problem.v0)
    assert again.with_parameters({"mass of rod": 3.0}).parameters["mass of rod (kg)"] == 3.0
    model.motor("revolute crank-ground", lambda t: 1.0 + t)
    without = pickle.loads(pickle.dumps(model.problem()))  # the system travels, a lambda does not
    assert without.system.force(0.0, without.q0, without.v0)[2] == pytest.approx(1.0, abs=2.0)
    with pytest.raises(ValueError, match="without its model"):
        without.with_parameters({})


def test_a_spring_is_without_force_where_it_is_given():
    model = four_bar()
    model.spring("crank", (0.0, 1.0), "ground", (3.0, 0.0), stiffness=2.0)
    assert model.problem().parameters["length of spring crank-ground (m)"] == pytest.approx(np.sqrt(10.0))


def test_a_spring_without_length_has_force_where_its_ends_meet():
    model = PlanarModel(gravity=(0.0, 0.0))
    model.body("bob", mass=2.0, inertia=1.0, position=(0.0, 0.0), velocity=(3.0, 0.0))
    model.spring("ground", (0.0, 0.0), "bob", (0.0, 0.0), stiffness=8.0)
    problem = model.problem((0.0, 2.0))
    result = solve_dae(problem.system, problem.t_span, problem.q0, problem.v0, rtol=1e-10, atol=1e-10)
    np.testing.assert_allclose(result.q[0], 1.5 * np.sin(2.0 * result.t), atol=1e-8)
    assert problem.freedom.degrees == 3 and problem.conserved
    np.testing.assert_allclose(problem.energy(result.t, result.q, result.v), 9.0, atol=1e-8)


@pytest.mark.parametrize("on", [("belt",) * 2, ("belt",) * 3, ("belt", "belt", "ground")])
def test_bodies_that_are_given_at_rest_on_one_that_is_driven(on):
    """What is left of zero velocities is the rounding of the speed of the drive."""
    model = PlanarModel((0.0, 0.0))
    model.body("belt", mass=1.0, inertia=1.0, position=(0.0, -1.0))
    model.drive(model.prismatic("ground", "belt", at=(0.0, -1.0), axis=(1.0, 0.0)), lambda t: 0.3 * t)
    for k, name in enumerate(on):
        model.body(f"block {k}", mass=1.5, inertia=1.0, position=(0.0, float(k)), velocity=(0.0, 0.0))
        model.prismatic(name, f"block {k}", at=(0.0, float(k)), axis=(1.0, 0.0))
    v0 = model.problem().v0
    np.testing.assert_allclose(v0, 0.3 * np.eye(len(v0))[0], atol=1e-15)


@pytest.mark.parametrize(
    "made",
    [
        lambda: closed_chain_of_hinges(20),
        lambda: in_space(ladder(30), 0.0),
        lambda: in_space(ladder(30), 0.3),
        lambda: in_space(grid(30), 0.3),
    ],
    ids=["closed chain", "ladder of parallel hinges", "ladder", "net"],
)
def test_the_freedom_of_large_models_is_that_by_full_matrices(made, monkeypatch):
    def by_full_matrices(system, t, q, rows):
        raise AssertionError("full matrices")

    with monkeypatch.context() as sparse:
        sparse.setattr(assembly, "_rank", by_full_matrices)
        found = made().bodies.freedom
    monkeypatch.setattr(assembly, "dependence", lambda *_: None)
    assert made().bodies.freedom == found
