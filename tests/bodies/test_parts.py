"""Test screws, ropes, particles, slots, rolling balls, couplings, limits and actuators against closed forms."""

import numpy as np
import pytest
from scipy.interpolate import CubicSpline

from tests.bad_input.bodies import loop
from tests.bodies.runs import by_hand, moved
from twoloop import solve_with_stops
from twoloop.bodies import PlanarModel, SpatialModel

G, ZERO, Z = 9.81, (0.0, 0.0, 0.0), (0.0, 0.0, 1.0)


def test_a_nut_runs_down_its_screw_over_many_turns_and_rebounds():
    """Of its motors, the one along the axis takes 5 N of its weight of 2 g, the other one turns it on."""
    model, lead = SpatialModel(), 0.5 / (2.0 * np.pi)
    model.body("nut", mass=2.0, inertia=(0.01, 0.02, 0.03), position=(0.1, 0.2, 0.0))
    model.screw("ground", "nut", at=(0.1, 0.2, 0.0), axis=Z, pitch=0.5, name="thread")
    model.motor("thread", 5.0, coordinate="displacement")
    model.motor("thread", -0.1)
    alpha = -(0.1 + (2.0 * G - 5.0) * lead) / (0.03 + 2.0 * lead**2)
    problem = model.problem((0.0, 3.0), rates={("thread", "displacement"): 0.5})
    end = moved(problem).q[:, -1]
    angle = 1.5 / lead + 4.5 * alpha
    assert angle < -100.0
    assert problem.joint_coordinate("thread").position(end) == pytest.approx(angle, abs=1e-8)
    assert end[2] == pytest.approx(lead * angle, abs=1e-9)
    model.limit("thread", lower=-2.0, coordinate="displacement", restitution=0.5)
    problem = model.problem((0.0, 3.0))
    run = solve_with_stops(problem.system, problem.t_span, problem.q0, problem.v0, problem.stops)
    fall = np.sqrt(-4.0 / (alpha * lead))
    assert [impact.t for impact in run.impacts][:2] == pytest.approx([fall, 2.0 * fall], abs=1e-6)


def test_a_sleeve_has_springs_motors_and_drives_on_both_coordinates():
    model = SpatialModel(ZERO)
    model.body("b", mass=2.0, inertia=(0.1, 0.1, 0.1), position=(0.1, 0.0, 0.0))
    sleeve = model.cylindrical("ground", "b", at=(0.1, 0.0, 0.0), axis=(1.0, 2.0, 2.0), name="sleeve")
    model.torsion_spring(sleeve, stiffness=0.4)
    model.axial_spring(sleeve, stiffness=8.0)
    model.motor(sleeve, lambda t: 0.1 * np.cos(t), coordinate="angle")
    turn, slide = (("sleeve", which) for which in ("angle", "displacement"))
    problem = model.problem((0.0, 2.0), positions={turn: 1.0, slide: 0.5})
    end = moved(problem).q[:, -1]
    known = by_hand(lambda t, x, _: -4.0 * x + np.cos(t), [1.0, 0.0], [2.0])[0, -1]
    assert problem.joint_coordinate(*turn).position(end) == pytest.approx(known, abs=1e-8)
    assert problem.joint_coordinate(*slide).position(end) == pytest.approx(0.5 * np.cos(4.0), abs=1e-9)
    model.drive(sleeve, lambda t: 0.2 + 0.3 * t, coordinate="displacement")
    problem = model.problem()
    assert problem.joint_coordinate(*slide).rate(problem.q0, problem.v0) == pytest.approx(0.3)
    assert problem.joint_coordinate(*slide).position(problem.q0) == pytest.approx(0.2)


def test_a_door_in_space_rebounds_from_its_limits():
    model = SpatialModel(ZERO)
    model.body("door", mass=1.0, inertia=(0.1, 0.1, 0.1), position=(0.5, 0.0, 0.0))
    hinge = model.revolute("ground", "door", at=ZERO, axis=Z, name="hinge")
    model.limit(hinge, lower=-1.0, upper=3.5, restitution=0.5)
    problem = model.problem((0.0, 8.0), rates={hinge: 2.0})
    run = solve_with_stops(problem.system, problem.t_span, problem.q0, problem.v0, problem.stops)
    assert [impact.t for impact in run.impacts] == pytest.approx([1.75, 6.25], abs=1e-6)
    assert run.to_dataframe()["angle of hinge (rad)"].iloc[-1] == pytest.approx(-1.0 + 0.5 * 1.75, abs=1e-6)


@pytest.mark.parametrize("model", [PlanarModel(), SpatialModel()], ids=["plane", "space"])
def test_ropes_of_an_atwood_machine_a_tackle_and_a_winch(model):
    """All in one model, beside each other: masses of 1 and 2 kg; 3 and 1 kg; 3 kg on a drum."""
    at = lambda x, y: (x, y) if model.dimension == 2 else (x, 0.0, y)  # noqa: E731
    masses = {"left": (1.0, -0.1), "right": (2.0, 0.1), "load": (3.0, 5.0), "weight": (1.0, 6.0), "pail": (3.0, 9.3)}
    for name, (mass, x) in masses.items():
        model.particle(name, mass=mass, position=at(x, -1.0))
    top = [("ground", at(x, 0.0)) for _, x in masses.values()]
    ends = {name: (name, at(x, -1.0)) for name, (_, x) in masses.items()}
    atwood = model.rope([ends["left"], *top[:2], ends["right"]])
    tackle = model.rope([top[2], ends["load"], top[2], top[3], ends["weight"]])
    if model.dimension == 2:
        model.disc("drum", 0.3, mass=5.0, position=(9.0, 0.0))
        drum = model.revolute("ground", "drum", at=(9.0, 0.0), name="drum pin")
    else:
        model.body("drum", mass=5.0, inertia=(0.2, 0.225, 0.2), position=(9.0, 0.0, 0.0))
        drum = model.revolute("ground", "drum", at=(9.0, 0.0, 0.0), axis=(0.0, 1.0, 0.0), name="drum pin")
    model.rope([top[4], ends["pail"]], winch=drum, radius=0.3)
    problem = model.problem((0.0, 0.4))
    result = moved(problem)
    heights = [model.bodies[k].coordinates[model.dimension - 1] for k in range(5)]
    a = np.array([G / 3.0, -G / 3.0, -G / 7.0, 2.0 * G / 7.0, -G * 0.27 / (0.225 + 0.27)])
    np.testing.assert_allclose(result.q[heights, -1], -1.0 + 0.08 * a, atol=1e-9)
    turned = problem.joint_coordinate(drum).position(result.q[:, -1])
    assert turned == pytest.approx(0.08 * a[4] / 0.3, abs=1e-8)
    for rope, tension in ((atwood, 4.0 / 3.0 * G), (tackle, 9.0 / 7.0 * G)):
        force = result.reactions(rope.name).force
        np.testing.assert_allclose(np.linalg.norm(force, axis=0), tension, atol=1e-7)
    assert problem.conserved and np.ptp(result.energy) < 1e-8 and len(problem.drawing.bars) > 8


def test_a_ball_rolls_down_a_slope_and_circles_on_a_turntable():
    model = SpatialModel((0.0, -3.0, -9.0))
    model.sphere("ball", 0.2, mass=2.0, position=(0.0, 0.0, 0.2), velocity=(1.0, 0.0, 0.0))
    contact = model.rolling_ball("ball", radius=0.2)
    result = moved(model.problem((0.0, 2.0)))
    np.testing.assert_allclose(result.q[:3, -1], [2.0, -30.0 / 7.0, 0.2], atol=1e-9)
    np.testing.assert_allclose(result.reactions(contact.name).force[:, 0], [0.0, 12.0 / 7.0, 18.0], atol=1e-9)
    model = SpatialModel()
    model.sphere("ball", 0.2, mass=2.0, position=(1.0, 0.0, 0.2), velocity=(0.0, 0.5, 0.0))
    model.body("table", mass=1.0, inertia=(1.0, 1.0, 1.0), position=(0.0, 0.0, -1.0))
    model.drive(model.revolute("ground", "table", at=(0.0, 0.0, -1.0), axis=Z), lambda t: 2.0 * t)
    model.rolling_ball("ball", radius=0.2, on="table")
    problem = model.problem((0.0, 3.0))
    result, pace = (
        moved(problem),
        4.0 / 7.0,
    )  # two sevenths of the table's: J. A. Burns, American J. of Physics 49 (1981)
    start, velocity = (complex(*each[:2]) for each in (problem.q0, problem.v0))
    known = start + velocity / (1j * pace) * (np.exp(1j * pace * result.t) - 1.0)
    np.testing.assert_allclose(result.q[0] + 1j * result.q[1], known, atol=1e-9)


def test_beads_on_a_helix_on_a_surface_and_in_a_slot_that_turns():
    model = SpatialModel()
    for k in range(2):
        model.particle(f"bead {k}", mass=1.0, position=(1.0, 0.0, 0.0), velocity=(0.0, k, 0.0) if k else None)
    model.point_on_curve("ground", "bead 0", at=(1.0, 0.0, 0.0), curve=lambda x, y, z: (x - np.cos(z), y - np.sin(z)))
    model.point_on_curve("ground", "bead 1", at=(1.0, 0.0, 0.0), curve=lambda x, y, z: x * x + y * y - 1.0)
    q = moved(model.problem((0.0, 1.0))).q[:, -1]
    np.testing.assert_allclose(q[[2, 7, 8, 9]], [-0.25 * G, np.cos(1.0), np.sin(1.0), -0.5 * G], atol=1e-9)
    model = SpatialModel(ZERO)
    model.particle("bead", mass=1.0, position=(1.0, 0.0, 0.0))
    model.body("wheel", mass=1.0, inertia=(1.0, 1.0, 1.0), position=ZERO)
    model.drive(model.revolute("ground", "wheel", at=ZERO, axis=Z), lambda t: 2.0 * t)
    model.point_on_line("wheel", "bead", at=(1.0, 0.0, 0.0), axis=(1.0, 0.0, 0.0))
    result = moved(model.problem((0.0, 1.0)))
    np.testing.assert_allclose(np.hypot(*result.q[:2]), np.cosh(2.0 * result.t), atol=1e-8)


@pytest.mark.parametrize("model", [PlanarModel((0.0, 0.0)), SpatialModel(ZERO)], ids=["plane", "space"])
def test_wheels_coupled_by_a_polynomial_and_by_a_tendon(model):
    zero, axis = np.zeros(model.dimension), {} if model.dimension == 2 else {"axis": Z}
    for k in range(2):
        model.body(f"wheel {k}", mass=1.0, inertia=0.1 if model.dimension == 2 else (0.1, 0.1, 0.1), position=zero)
        model.revolute("ground", f"wheel {k}", at=zero, **axis, name=f"pin {k}")
    model.coupling(["pin 0", model.tendon({"pin 1": 2.0})], lambda x, y: 0.5 * y - 0.5 * x - 0.3 * x**2)
    laws = {"stiffness": 0.4, "damping": 0.1, "length": 0.1, "force": lambda t: 0.2 * np.cos(t), "upper": 3.0}
    tendon = model.tendon({"pin 0": 0.5, "pin 1": -1.0}, **laws)
    problem = model.problem((0.0, 2.0), positions={"pin 0": 0.2}, rates={"pin 0": -1.0})
    end = moved(problem).q[:, -1]

    def acceleration(t, x, u):
        slope, length = 0.5 + 0.6 * x, -0.3 * x**2
        tension = 0.4 * (length - 0.1) + 0.1 * (0.5 - slope) * u + 0.2 * np.cos(t)
        return (-10.0 * tension * (0.5 - slope) - slope * 0.6 * u**2) / (1.0 + slope**2)

    known = by_hand(acceleration, [0.2, -1.0], [2.0])[0, -1]
    found = [problem.joint_coordinate(f"pin {k}").position(end) for k in range(2)]
    np.testing.assert_allclose(found, [known, 0.5 * known + 0.3 * known**2], atol=1e-8)
    assert tendon.position(end) == pytest.approx(-0.3 * known**2) == 3.0 - problem.stops[0].gap(0.0, end)


def linkage(driven):
    model = loop((0.0, 0.0), (0.0, 1.0), (2.0, 1.5), (2.5, 0.0))
    if driven:
        model.drive("D", lambda t: 0.2 * np.sin(t) ** 2)
    return model


def arm(driven):
    model = loop((0.0, 0.0), (1.0, 0.0), (1.0, 1.0))
    model.joints.pop()  # its tip is free
    if driven:
        model.drive_point("bar 1", (1.0, 1.0), axis=(1.0, 0.0), motion=lambda t: 0.2 * np.sin(t) ** 2)
        model.drive_point("bar 1", (1.0, 1.0), axis=(0.0, 2.0), motion=lambda t: -0.1 * t**2)
    return model


@pytest.mark.slow  # compiles for seconds
@pytest.mark.parametrize(("make", "actuators"), [(linkage, ["A"]), (arm, ["A", "B"])])
def test_actuators_make_the_motion_that_is_prescribed_elsewhere(make, actuators):
    problem, free = make(True).problem((0.0, 1.0)), make(False)
    wanted = moved(problem, t_eval=np.linspace(0.0, 1.0, 301))
    for joint, force in zip(actuators, problem.actuator_forces(wanted, actuators), strict=True):
        curve = CubicSpline(wanted.t, force)
        free.motor(joint, lambda t, curve=curve: float(curve(t)))
    np.testing.assert_allclose(moved(free.problem((0.0, 1.0))).q[:, -1], wanted.q[:, -1], atol=1e-8)
    with pytest.raises(ValueError, match="cannot make the motion that the drives of"):
        problem.actuator_forces(wanted, actuators[:0])
