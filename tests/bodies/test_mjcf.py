"""Test models from MJCF and back: the same start, accelerations and motion as those written by hand."""

import warnings

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.bodies.random_models import Both
from tests.bodies.runs import moved
from tests.marks import slow
from twoloop.bodies import IgnoredWarning, SpatialModel, from_mjcf
from twoloop.bodies.file_parts import geom_lump, text_of

pytestmark = pytest.mark.filterwarnings("ignore::twoloop.ConstraintWarning")
LEG = """<mujoco model="leg"><compiler angle="degree" eulerseq="XYZ"/><option gravity="0 0 -9.81" timestep="0.002"/>
  <default><joint damping="0.05"/><geom contype="0" conaffinity="0" density="500"/>
    <default class="stiff"><joint stiffness="3" springref="20"/></default></default>
  <worldbody>
    <light pos="0 0 3"/>
    <body name="hip" pos="0 0 1" euler="0 30 0">
      <joint name="hip" axis="0 1 0"/>
      <geom type="capsule" fromto="0 0 0 0 0 -0.4" size="0.04"/>
      <body name="plate" pos="0 0 -0.2" quat="1 1 1 1"><geom type="box" size="0.05 0.02 0.03" mass="0.2"/></body>
     <body name="shin" pos="0 0 -0.4" axisangle="0 1 0 300"><joint name="knee" class="stiff" axis="0 2 0" damping=".1"/>
        <inertial pos="0 0 -0.2" mass="0.8" diaginertia="0.02 0.021 0.004" zaxis="1 0 1"/><geom size="0.1"/></body>
    </body>
    <body name="bob" pos="1 0 0.5"><freejoint/><geom type="ellipsoid" size="0.1 0.2 0.3"/></body>
  </worldbody>
</mujoco>"""


def read(text, folder, **options):
    path = folder / "model.xml"
    path.write_text(text)
    return from_mjcf(path, **options)


def end(model, end=0.5):
    problem = model.problem((0.0, end))
    return problem, moved(problem).q[:, -1].reshape(-1, 7)


def about_y(degrees):
    return Rotation.from_euler("y", degrees, degrees=True).as_matrix()


def test_a_leg_by_hand_and_from_a_file(tmp_path):
    read_model = read(LEG, tmp_path)
    hand = SpatialModel()
    r, h, density = 0.04, 0.2, 500.0
    pipe, ball = density * np.pi * r**2 * 2.0 * h, density * 4.0 / 3.0 * np.pi * r**3
    across = pipe * (h**2 / 3.0 + r**2 / 4.0) + ball * (0.4 * r**2 + h**2 + 0.75 * h * r)
    thigh = np.diag([across, across, 0.5 * pipe * r**2 + 0.4 * ball * r**2])
    edges = np.array([0.03, 0.05, 0.02]) ** 2  # turned by 120 degrees, that is x to y to z
    thigh += 0.2 * np.diag(edges.sum() - edges) / 3.0  # both have their centres at -0.2
    R, S = about_y(30.0), about_y(-30.0)
    top, knee = np.array([0.0, 0.0, 1.0]), np.array([0.0, 0.0, 1.0]) + R @ [0.0, 0.0, -0.4]
    one = hand.body("hip", mass=pipe + ball + 0.2, inertia=thigh, position=top + R @ [0.0, 0.0, -0.2], rotation=R)
    J = about_y(45.0) @ np.diag([0.02, 0.021, 0.004]) @ about_y(45.0).T
    two = hand.body("shin", mass=0.8, inertia=J, position=knee + S @ [0.0, 0.0, -0.2], rotation=S)
    hip = hand.revolute("ground", one, at=top, axis=(0.0, 1.0, 0.0))
    bend = hand.revolute(one, two, at=knee, axis=(0.0, 1.0, 0.0))
    hand.torsion_spring(hip, stiffness=0.0, damping=0.05)
    hand.torsion_spring(bend, stiffness=3.0, damping=0.1, angle=np.radians(20.0))
    squares = np.array([0.1, 0.2, 0.3]) ** 2
    mass = density * 4.0 / 3.0 * np.pi * 0.006
    hand.body("bob", mass=mass, inertia=mass * (squares.sum() - squares) / 5.0, position=(1.0, 0.0, 0.5))
    (made, one), (_, other) = end(read_model), end(hand)
    np.testing.assert_allclose(one, other, atol=1e-9)
    assert read_model.name == "leg" and made.freedom.degrees == 8 and read_model.ignored == ()
    assert [joint.name for joint in read_model.joints] == ["joint hip", "knee"]  # as a body is called hip


@pytest.mark.parametrize("seed", [0, *(slow(k) for k in (1, 2, 3))])
def test_random_models_written_and_read_again_move_alike(seed, tmp_path):
    both = Both(seed, False, n=6)
    kinds = ("revolute", "universal", "cylindrical", "table", "prismatic", "spherical", "fixed")
    joints = {}
    for k in range(6):
        kind = kinds[(k + 2 * seed) % 7]
        i, j = (None if k == 0 else k - 1, k) if (k + seed) % 3 else (k, None if k == 0 else k - 1)
        joints[kind] = (i, j, getattr(both, kind)(i, j))
    both.spring(0, 3)
    both.spring(None, 5)
    for kind in ("revolute", "prismatic"):
        if kind in joints:
            joint = joints[kind][2][0]
            spring = both.model.torsion_spring if kind == "revolute" else both.model.axial_spring
            spring(joint, stiffness=2.0, damping=0.1, **{"angle" if kind == "revolute" else "length": 0.4})
    both.model.to_mjcf(tmp_path / "written.xml")
    again = from_mjcf(tmp_path / "written.xml")
    (made, one), (other_made, other) = end(both.model, 0.3), end(again, 0.3)
    assert made.freedom.degrees == other_made.freedom.degrees
    welded = joints["fixed"][:2] if "fixed" in joints else ()  # are one body when they are read
    for k, body in enumerate(again.bodies):
        number = next(each.number for each in both.handles if each.name == body.name)
        if number not in welded:
            np.testing.assert_allclose(other[k, :3], one[number, :3], atol=1e-8)


def four_bar():
    model = SpatialModel(name="loop")
    points = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 1.0], [2.0, 0.3, 1.5], [2.5, 0.3, 0.0]])
    for k in range(3):
        model.rod(f"bar {k}", points[k], points[k + 1], radius=0.03, mass=1.0 + k)
    y = (0.0, 1.0, 0.0)
    model.revolute("ground", "bar 0", at=points[0], axis=y)
    model.spherical("bar 0", "bar 1", at=points[1])
    model.spherical("bar 1", "bar 2", at=points[2])
    model.revolute("bar 2", "ground", at=points[3], axis=y)
    return model


def test_loops_are_closed_again(tmp_path):
    model = four_bar()
    model.to_mjcf(tmp_path / "loop.xml")
    text = (tmp_path / "loop.xml").read_text()
    assert text.count("<connect") == 1 and text.count('type="hinge"') == 2 and text.count('type="ball"') == 1
    (_, one), (made, other) = end(model), end(from_mjcf(tmp_path / "loop.xml"))
    order = [int(name[-1]) for name in made.names[::7]]
    np.testing.assert_allclose(other[:, :3], one[order, :3], atol=1e-8)
    model.motor(model.joints[0], 1.0)
    model.drive(model.joints[3], lambda t: t)
    model.stop(model.bodies[0], (0.0, 0.0, 0.0), "ground", (0.0, 0.0, -9.0), normal=(0.0, 0.0, 1.0), name="floor")
    with pytest.warns(IgnoredWarning, match="without drive of .*; floor; motor of "):
        model.to_mjcf(tmp_path / "out.xml")


@pytest.mark.parametrize(
    ("body", "message"),
    [
        ('<joint/><freejoint/><geom size="1"/>', "must have no other joint beside its free one"),
        ("<joint/>", "has joints but no mass"),
        ('<joint axis="0 0 0"/><geom size="1"/>', "must have a direction"),
        ('<joint/><geom type="capsule" size="1"/>', "must be 2 positive numbers"),
        ('<joint/><inertial mass="1"/>', "diaginertia of .* must be 3 finite numbers"),
        ('<joint class="none"/><geom size="1"/>', "of the class 'none', which no default has"),
        ('<composite/><geom size="1"/>', "<composite> is not read"),
        ('<joint type="slide"/><joint type="slide"/><joint axis="1 0 0"/><geom size="1"/>', "axes that do not"),
        ('<joint pos="1 x 2"/><geom size="1"/>', "pos of joint 'joint of b' must be 3 finite numbers"),
    ],
)
def test_what_cannot_be_read_is_said(body, message, tmp_path):
    with pytest.raises(ValueError, match=message):
        read(f'<mujoco><worldbody><body name="b">{body}</body></worldbody></mujoco>', tmp_path)


def test_files_that_are_none(tmp_path):
    for text, message in (("<robot/>", "must begin with <mujoco>"), ("<mujoco>", "is not XML")):
        with pytest.raises(ValueError, match=message):
            read(text, tmp_path)
    with pytest.raises(FileNotFoundError, match=r"includes 'other.xml'"):
        read('<mujoco><include file="other.xml"/></mujoco>', tmp_path)
    text = "\n<?xml version='1.0'?><mujoco model='a & b'><!-- -- --><worldbody x:y='1'/></mujoco>"  # MuJoCo takes it
    assert read(text, tmp_path).name == "a & b"
    model = four_bar()
    model.distance("bar 0", (0.0, 0.0, 0.5), "ground", (1.0, 0.0, 0.0))
    with pytest.raises(ValueError, match="no counterpart of 'distance bar 0-ground'"):
        model.to_mjcf(tmp_path / "out.xml")


def test_activations_of_constant_commands_in_closed_form(tmp_path):
    law = 'joint="x" gainprm="3" dynprm="0.5"'
    text = f"""<mujoco><option gravity="0 0 0"/><worldbody><body><joint name="x" type="slide"/><geom size="1"/></body>
      </worldbody><actuator><general {law} dyntype="filter"/><general {law} dyntype="integrator" actrange="0 0.4"/>
      </actuator><keyframe><key ctrl="2 1" act="0.6 0.1"/></keyframe></mujoco>"""
    problem, t = read(text, tmp_path, key=0).problem(), np.array([0.0, 0.2, 0.9])
    forces = [problem.system.force(each, problem.q0, problem.v0)[2] for each in t]
    np.testing.assert_allclose(forces, 3.0 * (2.0 - 1.4 * np.exp(-t / 0.5) + [0.1, 0.3, 0.4]), atol=1e-6)


def test_meshes_of_concave_polygons_that_are_mirrored(tmp_path):
    """An L of two blocks."""
    corners = [(0, 0), (3, 0), (3, 1), (1, 1), (1, 4), (0, 4)]
    lines = [f"v {x} {y} {z}" for z in (0, 1) for x, y in corners] + ["f 6 5 4 3 2 1", "f 7/1 8/1 9/1 10/1 11/1 12/1"]
    lines += [f"f {k + 1} {(k + 1) % 6 + 1} {(k + 1) % 6 + 7} {k + 7}" for k in range(6)]
    (tmp_path / "m.obj").write_text("\n".join(lines))
    (body,) = read(
        """<mujoco><asset><mesh file="m.obj" scale="-1 1 2" inertia="exact"/></asset><worldbody><body>
      <freejoint/><geom type="mesh" mesh="m" density="3"/></body></worldbody></mujoco>""",
        tmp_path,
    ).bodies
    np.testing.assert_allclose(np.r_[body.inertia[0], body.position], [36.0, -1.0, 1.5, 1.0])


def test_defaults_of_tendons_and_what_else_was_passed_over(tmp_path):
    text = """<mujoco><default><tendon stiffness="7" damping="2"/><equality active="false"/></default><worldbody>
      <site name="a"/><body name="bob" pos="0 0 1"><freejoint/><geom size="0.1"/><site name="b"/></body></worldbody>
      <tendon><spatial frictionloss="1"><site site="a"/><site site="b"/></spatial></tendon>
      <equality><connect body1="bob" anchor="0 0 0"/></equality></mujoco>"""
    with pytest.warns(IgnoredWarning, match="frictionloss of spatial"):
        model = read(text, tmp_path)
    parameters = model.problem().parameters.items()
    assert [x for name, x in parameters if "spring" in name][-3:] == [7.0, 2.0, 1.0] and not model.joints


@pytest.mark.filterwarnings("ignore::twoloop.bodies.IgnoredWarning")
@pytest.mark.parametrize(
    ("flag", "loops", "springs", "dampers"),
    [("", 1, 1, 1), ("constraint", 0, 1, 1), ("spring", 1, 0, 1), ("damper", 1, 1, 0), ("passive", 1, 0, 0)],
)
def test_what_flags_disable_is_not_there(flag, loops, springs, dampers, tmp_path):
    geom = "<geom fromto='0 0 0 1 0 0' size='0.1' type='capsule'/>"
    body = f"<body name='{{}}'><joint stiffness='3' damping='2'/>{geom}</body>"
    option = f"<option><flag {flag}='disable'/></option>" if flag else ""
    option = f"<option><flag gravity='disable'/></option>{option}<option><flag gravity='enable'/></option>"
    equality = "<equality><connect body1='a' body2='b' anchor='1 0 0'/></equality>"
    bodies = body.format("a") + body.format("b")
    model = read(f"<mujoco>{option}<worldbody>{bodies}</worldbody>{equality}</mujoco>", tmp_path)
    assert sum(joint.kind == "spherical" for joint in model.joints) == loops and model.gravity[2] == -9.81
    values = [force.more.values[:2] for force in model.forces] or [(0.0, 0.0)]
    assert values[0] == (3.0 * springs, 2.0 * dampers)


@pytest.mark.parametrize("kind", ["mesh", "box' size='0.1 0.1 0.1' mesh='stone"])  # a box that is fitted to a mesh
def test_the_mass_of_a_mesh_is_missed_where_it_counts_only(kind, tmp_path):
    geom = f"<geom type='{kind}' contype='0' conaffinity='0'{{}}/>"
    inertial = "<inertial pos='0 0 1' mass='2' diaginertia='1 1 1'/>"
    for more, weighed in (("", True), (" mass='0'", False), (" density='0'", False)):
        own = f"<body><joint/>{geom.format(more)}<geom size='0.1'/></body>"
        with warnings.catch_warnings(action="ignore", category=IgnoredWarning):
            model = read(f"<mujoco><worldbody>{own}</worldbody></mujoco>", tmp_path)
        assert any("the mass of" in each for each in model.ignored) == weighed
    body = f"<body><joint/>{geom.format('')}{inertial}</body>"
    model = read(f"<mujoco><worldbody>{body}</worldbody></mujoco>", tmp_path)
    assert model.ignored == () and model.bodies[0].inertia[0] == 2.0


def test_what_defaults_leave_to_an_element(tmp_path):
    """Several sections add up, one way to turn replaces another, and sizes that are not given stay."""
    text = """<mujoco>
      <default><geom type="box" size="0.1 0.2 0.3" quat="0.5 0.1 0.8 0" density="300" contype="0"
        conaffinity="0"/></default>
      <default><joint damping="0.5"/><default class="long"><geom size="0.4" euler="0 0 90"/></default></default>
      <worldbody><body name="a"><joint axis="0 1 0"/><geom size="0.5" euler="90 0 0"/></body>
        <body name="b" pos="3 0 0"><joint axis="0 1 0"/><geom class="long"/></body></worldbody></mujoco>"""
    model = read(text, tmp_path)
    (a, b), spring = model.bodies, model.forces[0]
    mass = 300.0 * 8.0 * 0.5 * 0.2 * 0.3
    moments = mass / 3.0 * np.array([0.2**2 + 0.3**2, 0.5**2 + 0.2**2, 0.5**2 + 0.3**2])  # y and z change places
    np.testing.assert_allclose(a.inertia[:4], [mass, *moments])
    assert spring.more.values[1] == 0.5
    mass = 300.0 * 8.0 * 0.4 * 0.2 * 0.3
    moments = mass / 3.0 * np.array([0.4**2 + 0.3**2, 0.2**2 + 0.3**2, 0.2**2 + 0.4**2])
    np.testing.assert_allclose(b.inertia[:4], [mass, *moments])


def test_sites_between_two_points_and_springs_whose_length_is_elsewhere(tmp_path):
    text = """<mujoco><worldbody><site name="w" pos="1 1 1"/><body name="a"><joint axis="0 1 0" {0}/>
      <geom size="0.1" pos="1 0 0"/>
      <site name="s" type="capsule" fromto="0.1 0 0 0.5 0.2 0" size="0.01"/></body></worldbody>
      <tendon><spatial stiffness="{1}" {2}><site site="s"/><site site="w"/></spatial></tendon></mujoco>"""
    (spring,) = read(text.format("", "30", 'springlength="0.3"'), tmp_path).forces
    np.testing.assert_allclose(spring.on_first.values, [0.3 - 1.0, 0.1, 0.0])
    (spring,) = read(text.format('ref="30"', "30", ""), tmp_path).forces
    turned = about_y(-30.0) @ [0.3, 0.1, 0.0]  # where the joint is at its springref
    np.testing.assert_allclose(spring.more.values[2], np.linalg.norm(turned - 1.0))
    problem = read(text.format("", "30 2 5", 'springlength="0.3" damping="1 2"'), tmp_path).problem()
    points, x = np.array([[0.3, 0.1, 0.0], [1.0, 1.0, 1.0]]), np.linalg.norm([0.7, 0.9, 1.0]) - 0.3
    along, v = (points[1] - points[0]) / (x + 0.3), np.zeros(7)
    v[3:] = 0.5 * np.array([0.0, 0.0, 2.0, 0.0])  # 2 rad/s about y
    rate = -along @ np.cross([0.0, 2.0, 0.0], points[0] - [1.0, 0.0, 0.0])
    tension = 30.0 * x + 2.0 * x**2 + 5.0 * x**3 + rate + 2.0 * abs(rate) * rate
    force, gravity = (problem.system.force(0.0, problem.q0, each)[:3] for each in (v, 0.0 * v))
    still = 30.0 * x + 2.0 * x**2 + 5.0 * x**3
    np.testing.assert_allclose(force - gravity, (tension - still) * along, atol=1e-9)
    np.testing.assert_allclose(gravity - problem.model.bodies[0].inertia[0] * np.array([0, 0, -9.81]), still * along)
    unloaded = read(text.format("", "0", 'springlength="0.3"'), tmp_path).problem()
    stored = problem.energy(0.0, problem.q0, 0.0 * v) - unloaded.energy(0.0, problem.q0, 0.0 * v)
    assert stored == pytest.approx(15.0 * x**2 + 2.0 / 3.0 * x**3 + 1.25 * x**4, rel=1e-12)


def test_springs_of_tendons_and_balls_count_in_the_energy(tmp_path):
    """Nothing damps: what is not kinetic, of gravity or of springs would show as a drift."""
    geom = '<geom type="box" size="0.1 0.2 0.3" pos="0.2 0 -0.3"/>'
    text = f"""<mujoco><default><geom density="50" contype="0" conaffinity="0"/></default><worldbody><site name="w"
        pos="1 0 0"/><body><joint name="a" axis="0 1 0"/>{geom}<site name="s" pos="0.5 0.1 0"/><body pos="0 0 -0.6">
        <joint type="ball" stiffness="3"/>{geom}<body pos="0 0.3 -0.3"><joint name="b" axis="1 0 0"/>{geom}
        <site name="t" pos="0.3 0 0"/></body></body></body></worldbody><tendon><fixed stiffness="9"
        springlength="-0.1 0.1"><joint joint="a" coef="2"/><joint joint="b" coef="-1"/></fixed>
        <spatial stiffness="20" springlength="0.3"><site site="w"/><site site="s"/><pulley divisor="2"/>
        <site site="s"/><site site="t"/></spatial></tendon></mujoco>"""
    model = read(text, tmp_path)
    result = moved(model.problem((0.0, 1.0)))
    energy, kinetic = result.energy, 0.5 * model.bodies[0].inertia[0] * (result.v[:3] ** 2).sum(axis=0)
    assert np.ptp(energy) < 1e-6 < 0.01 < np.ptp(kinetic)


def test_an_attached_model_is_the_same_as_one_written_out(tmp_path):
    """Its angles, defaults and settings are its own; of what acts on it, that within the part comes along."""
    inertial = '<inertial pos="0.1 0 0" mass="2" diaginertia="0.1 0.2 0.25"/>'
    arm = f"""<body name="{{0}}arm" pos="0 0 1" {{1}}><joint name="{{0}}hinge" axis="0 1 0" {{2}}/>{inertial}
      <body name="{{0}}tip" pos="0.3 0 0"><joint name="{{0}}rail" type="slide" {{3}}/>{inertial}</body></body>"""
    acting = """<actuator><motor name="{0}push" joint="{0}rail" gear="3"/></actuator>
      <equality><joint name="{0}gear" joint1="{0}hinge" joint2="{0}rail"/></equality>"""
    bent = 'class="bent" springref="0.5" stiffness="2"'
    child = f"""<mujoco model="kid"><compiler angle="radian" eulerseq="ZYX" boundmass="3"/><option density="9"/>
      <default><joint damping="0.5"/><default class="bent"><joint ref="0.3"/></default></default><worldbody>
      {arm.format("", 'euler="0.2 0.1 0.3"', bent, "")}<body name="rest"><joint name="other"/>{inertial}</body>
      </worldbody>{acting.format("")}<tendon><fixed stiffness="1"><joint joint="hinge"/><joint joint="other"/></fixed>
      </tendon></mujoco>"""
    (tmp_path / "kid").mkdir()
    (tmp_path / "kid" / "kid.xml").write_text(child)
    own, bent = 'damping="0.5" armature="0"', f'ref="{np.degrees(0.3)}" springref="{np.degrees(0.5)}" stiffness="2"'
    axes = Rotation.from_euler("zyx", [0.2, 0.1, 0.3]).as_matrix()[:, :2].T.ravel()
    turn = f'xyaxes="{" ".join(map(repr, axes.tolist()))}"'
    written = arm.format("k/", turn, f"{own} {bent}", own).replace('mass="2"', 'mass="3"')
    problems = []
    for asset, part, after in (
        ('<model file="kid/kid.xml"/>', '<attach model="kid" body="arm" prefix="k/"/>', ""),
        ("", written, acting.format("k/")),
    ):
        text = f"""<mujoco><compiler angle="degree"/><default><joint armature="0.1"/></default><asset>{asset}</asset>
          <worldbody><body name="base" pos="1 0 0"><joint name="hinge"/>{inertial}{part}</body></worldbody>
          {after}</mujoco>"""
        problems.append(read(text, tmp_path).problem(positions={"k/rail": 0.4}))
    one, other = problems
    np.testing.assert_allclose(one.q0, other.q0, atol=1e-12)
    assert one.parameters.keys() == other.parameters.keys() and "value of k/push (N)" in one.parameters
    assert one.parameters == pytest.approx(other.parameters, abs=1e-12)
    with pytest.raises(ValueError, match="the attached body 'tail' is not in its model"):
        read(text.replace(written, '<attach prefix="" body="tail"/>'), tmp_path)


@pytest.mark.parametrize("kind", ["sphere", "capsule", "cylinder", "box"])
def test_the_inertia_of_a_shell_is_that_of_a_thin_layer(kind):
    """Volume and moments of the solid, differentiated by the thickness of a layer around it."""
    sizes, grows = np.array([0.3, 0.5, 0.4]), np.array([1.0, float(kind != "capsule"), 1.0])
    given = {"type": kind, "density": "1", "quat": "1 2 3 4"}

    def solid(thickness):
        lump = geom_lump({**given, "size": text_of(sizes + thickness * grows)}, "", True, "xyz")
        return np.r_[lump.mass, lump.J.ravel()]

    shell = geom_lump({**given, "size": text_of(sizes), "shellinertia": "true"}, "", True, "xyz")
    layer = (solid(1e-4) - solid(-1e-4)) / 2e-4
    np.testing.assert_allclose(np.r_[shell.mass, shell.J.ravel()], layer, rtol=1e-6, atol=1e-6)


def test_what_mujoco_makes_of_replicates_and_missing_numbers(tmp_path):
    """The angles of replicates are multiplied; c_1 of an equality is 1; inertials stay where no geom has mass."""
    inertial, step = '<inertial pos="0 0 1" mass="2" diaginertia="0.1 0.2 0.25"/>', np.array([1.0, 0.0, 0.1])
    text = f"""<mujoco><compiler inertiafromgeom="true"/><default><equality active="false"/></default><worldbody>
      <replicate count="3" offset="{text_of(step)}" euler="10 20 0"><body name="r" gravcomp="-1"><joint name="j"/>
      <geom size="1" mass="0"/>{inertial}</body></replicate></worldbody><equality>
      <joint joint1="j0" joint2="j1" polycoef="0.3" active="true"/><joint joint1="j2"/></equality></mujoco>"""
    with warnings.catch_warnings(action="ignore", category=IgnoredWarning):
        model = read(text, tmp_path)
    turns = [Rotation.from_euler("XYZ", [10.0 * k, 20.0 * k, 0.0], degrees=True).as_matrix() for k in range(3)]
    place = step + turns[1] @ step
    np.testing.assert_allclose(model.bodies[2].rotation, turns[2], atol=1e-12)
    np.testing.assert_allclose(model.bodies[2].position, place + turns[2][:, 2], atol=1e-12)
    problem = model.problem(positions={"j1": 0.2})
    assert problem.joint_coordinate("j0").position(problem.q0) == pytest.approx(0.5, abs=1e-12)
    assert [body.inertia[0] for body in model.bodies] == [2.0] * 3 and len(model.joints) == 4 and not model.forces
