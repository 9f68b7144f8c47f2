"""Test models from URDF files: what is read, what is not, and the same models by hand."""

import warnings

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.bodies.runs import moved
from twoloop.bodies import IgnoredWarning, Loop, PlanarModel, SpatialModel, from_urdf
from twoloop.bodies.rotation import rotation_matrix

ARM = """<?xml version="1.0"?>
<robot name="arm"><material name="grey"><color rgba="0.5 0.5 0.5 1"/></material><link name="base"/>
  <link name="shoulder"><inertial><origin xyz="0.1 0 0.02" rpy="0.3 0 0"/><mass value="2"/>
    <inertia ixx="0.02" ixy="0.001" ixz="0" iyy="0.03" iyz="-0.002" izz="0.025"/></inertial>
    <collision><geometry><sphere radius="0.1"/></geometry></collision></link>
  <link name="upper"><inertial><origin xyz="0.25 0 0" rpy="0 0 0.4"/><mass value="1.5"/>
    <inertia ixx="0.01" ixy="0" ixz="0" iyy="0.04" iyz="0" izz="0.04"/></inertial>
    <collision><geometry><sphere radius="0.1"/></geometry></collision></link>
  <link name="weight"><inertial><origin xyz="0 0.05 0"/><mass value="0.7"/>
    <inertia ixx="0.001" ixy="0" ixz="0" iyy="0.001" iyz="0" izz="0.001"/></inertial></link>
  <link name="slide"><inertial><mass value="0.4"/>
    <inertia ixx="0.002" ixy="0" ixz="0" iyy="0.002" iyz="0" izz="0.003"/></inertial></link>
  <joint name="mount" type="fixed"><parent link="base"/><child link="pedestal"/>
    <origin xyz="0 0 0.5" rpy="0.2 -0.1 0.3"/></joint><link name="pedestal"/>
  <joint name="turn" type="continuous"><parent link="pedestal"/><child link="shoulder"/><origin xyz="0 0 0.1"/>
    <axis xyz="0 0 2"/><dynamics damping="0.3" friction="0.1"/></joint>
  <joint name="lift" type="revolute"><parent link="shoulder"/><child link="upper"/>
    <origin xyz="0.2 0 0.1" rpy="1.2 0 0.5"/><axis xyz="0 1 1"/>
    <limit lower="-1" upper="1" effort="10" velocity="3"/></joint>
  <joint name="hold" type="fixed"><parent link="upper"/><child link="weight"/>
    <origin xyz="0.4 0 0" quat_xyzw="0 0.3428978074554513 0 0.9393727128473789"/></joint>
  <joint name="push" type="prismatic"><parent link="weight"/><child link="slide"/><origin xyz="0 0 0.1" rpy="0 0 1"/>
    <axis xyz="1 0 0"/><limit lower="-1" upper="1" effort="10" velocity="3"/></joint>
  <transmission name="gears"/></robot>"""
POSITIONS = {"turn": 0.4, "lift": -0.3, "push": 0.05}


@pytest.fixture
def arm(tmp_path):
    path = tmp_path / "arm.urdf"
    path.write_text(ARM)
    return path


def read(path, **options):
    with warnings.catch_warnings(action="ignore", category=IgnoredWarning):
        return from_urdf(path, **options)


def turned(*angles):
    """About fixed axes: x, then y, then z."""
    return Rotation.from_euler("xyz", angles).as_matrix()


def about(axis, angle):
    return Rotation.from_rotvec(angle * np.array(axis) / np.linalg.norm(axis)).as_matrix()


def by_hand():
    """The arm, its frames multiplied out."""
    model = SpatialModel(name="arm")
    pedestal, place = turned(0.2, -0.1, 0.3), np.array([0.0, 0.0, 0.5])
    first, at = pedestal @ about((0, 0, 1), 0.4), place + pedestal @ (0, 0, 0.1)
    J = turned(0.3, 0, 0) @ [[0.02, 0.001, 0], [0.001, 0.03, -0.002], [0, -0.002, 0.025]] @ turned(0.3, 0, 0).T
    model.body("shoulder", mass=2.0, inertia=J, position=at + first @ (0.1, 0, 0.02), rotation=first)
    model.revolute("ground", "shoulder", at=at, axis=pedestal[:, 2], name="turn")
    model.torsion_spring("turn", stiffness=0.0, damping=0.3)
    frame, knee = first @ turned(1.2, 0, 0.5), at + first @ (0.2, 0, 0.1)
    second = frame @ about((0, 1, 1), -0.3)
    masses, centres = np.array([1.5, 0.7]), np.array([(0.25, 0, 0), (0.4, 0, 0) + turned(0, 0.7, 0) @ (0, 0.05, 0)])
    centre = masses @ centres / masses.sum()
    J = turned(0, 0, 0.4) @ np.diag([0.01, 0.04, 0.04]) @ turned(0, 0, 0.4).T + 0.001 * np.eye(3)
    for m, d in zip(masses, centres - centre, strict=True):
        J = J + m * (d @ d * np.eye(3) - np.outer(d, d))
    model.body("upper", mass=2.2, inertia=J, position=knee + second @ centre, rotation=second)
    model.revolute("shoulder", "upper", at=knee, axis=frame @ (0, 1, 1), name="lift")
    weight, there = second @ turned(0, 0.7, 0), knee + second @ (0.4, 0, 0)
    third, rail = weight @ turned(0, 0, 1), there + weight @ (0, 0, 0.1)
    model.body("slide", mass=0.4, inertia=(0.002, 0.002, 0.003), position=rail + third @ (0.05, 0, 0), rotation=third)
    model.prismatic("upper", "slide", at=rail, axis=third[:, 0], name="push")
    return model


def test_the_same_by_hand(arm):
    problems = [model.problem((0.0, 1.0)) for model in (read(arm, positions=POSITIONS), by_hand())]
    ends = [moved(problem).q[:, -1] for problem in problems]
    assert problems[0].freedom == problems[1].freedom and problems[0].freedom.degrees == 3
    np.testing.assert_allclose(problems[0].q0, problems[1].q0, atol=1e-14)
    np.testing.assert_allclose(ends[0], ends[1], atol=1e-11)


def test_what_is_ignored_is_told(arm):
    with pytest.warns(IgnoredWarning, match="ignored are friction of joint 'turn'"):
        model = from_urdf(arm)
    friction = "friction of joint 'turn' by solve_dae (solve_with_friction has it)"  # in the order of the effects
    limits = "limits of joint 'lift'", "limits of joint 'push'"
    assert model.ignored == (friction, *limits, "contacts between links", "transmission gears")
    with pytest.warns(IgnoredWarning):
        assert "limits of joint 'push'" not in from_urdf(arm, limits=True).ignored
    assert [body.name for body in model.bodies] == ["shoulder", "upper", "slide"]
    assert read(arm, free_base=False).problem().freedom.degrees == 3


ODD = """<robot name="odd" xmlns:x="http://x.org"><link name="base"/><link name="cross"/><link name="mount"/>
  <joint name="j" type="fixed"><parent link="base"/><child link="mount"/><origin xyz="0 0 1"/></joint><link name="tip"/>
  <joint name="one" type="continuous"><parent link="mount"/><child link="cross"/><axis xyz="0 1 0"/></joint>
  <joint name="two" type="continuous"><parent link="cross"/><child link="rod"/><axis xyz="1 0 0"/></joint>
  <joint name="last" type="continuous"><parent link="rod"/><child link="tip"/><axis xyz="1 0 0"/></joint>
  <joint name="ball" type="fixed"><parent link="rod"/><child link="bob"/><origin xyz="0 0 -1"/><axis xyz="0 0 0"/>
  </joint>{}{}</robot>"""


def test_massless_links_and_types_from_elsewhere(tmp_path):
    """A massless link between two hinges is the cross of a universal joint."""
    path = tmp_path / "odd.urdf"
    path.write_text(ODD.format(LINK.format("rod", 0.3, 2.0, 0.4), LINK.format("bob", 0.2, 1.0, 0.3)))
    side = tmp_path / "odd.yaml"
    side.write_text("joint_name: ['ball', 'none']  # not in the file\njoint_type: ['SPHERICAL', 'UJOINT_XY']\n")
    model = read(path, side_file=side)
    known = "type of joint 'none', which the file has not", "joint 'last', beyond which there is no mass"
    assert model.ignored == known
    hand = SpatialModel()
    hand.body("rod", mass=2.0, inertia=(0.01, 0.4, 0.5), position=(0.3, 0, 1))
    hand.body("bob", mass=1.0, inertia=(0.01, 0.3, 0.5), position=(0.2, 0, 0))
    hand.universal("ground", "rod", at=(0, 0, 1), axes=[(0, 1, 0), (1, 0, 0)])
    hand.spherical("rod", "bob", at=(0, 0, 0))
    problems = [each.problem((0.0, 0.7)) for each in (model, hand)]
    assert [problem.freedom.degrees for problem in problems] == [5, 5]
    ours, known = (moved(problem).q[:, -1].reshape(-1, 7)[-2:, :3] for problem in problems)  # of rod and bob
    np.testing.assert_allclose(ours, known, atol=1e-9)


LINKAGE = """<robot name="four-bar">{links}
  <joint name="pivot" type="revolute"><parent link="base"/><child link="crank"/><axis xyz="0 -1 0"/><limit/></joint>
  <joint name="elbow" type="continuous"><parent link="crank"/><child link="rod"/><origin xyz="1 0 0"/>
    <axis xyz="0 -1 0"/></joint><joint name="foot" type="continuous"><parent link="base"/><child link="rocker"/>
    <origin xyz="3 0 0"/><axis xyz="0 -1 0"/></joint></robot>"""
LINK = """<link name="{}"><inertial><origin xyz="{} 0 0"/><mass value="{}"/>
    <inertia ixx="0.01" ixy="0" ixz="0" iyy="{}" iyz="0" izz="0.5"/></inertial></link>"""
BARS = {"crank": 1.0, "rod": 2.0, "rocker": 1.5}


def test_a_loop_that_is_given_beside_the_file(tmp_path):
    links = "".join(LINK.format(name, 0.5 * L, L, L**3 / 12.0) for name, L in BARS.items())
    path = tmp_path / "four_bar.urdf"
    path.write_text(LINKAGE.format(links='<link name="base"/>' + links))
    loop = Loop("revolute", "rod", "rocker", at=(2, 0, 0), at_b=(1.5, 0, 0), axis=(0, 1, 0), name="knee")
    model = read(path, loops=[loop], positions={"pivot": 1.4, "elbow": -1.2, "foot": 1.9})
    plane = PlanarModel()
    with pytest.warns(match="have rank"):
        space = model.problem((0.0, 2.0))
        result = moved(space, tolerance=1e-10)
    for k, body in enumerate(model.bodies):
        name, L, q = body.name, BARS[body.name], space.q0[7 * k :]
        axis = rotation_matrix(q[3:7])[:, 0]
        plane.body(name, mass=L, inertia=L**3 / 12.0, position=q[[0, 2]], angle=float(np.arctan2(axis[2], axis[0])))
    points = {body.name: [body.point(x * BARS[body.name], 0.0) for x in (-0.5, 0.5)] for body in plane.bodies}
    base = plane.ground
    plane.revolute(base, "crank", at=(base.point(0.0, 0.0), points["crank"][0]))
    plane.revolute("crank", "rod", at=(points["crank"][1], points["rod"][0]))
    plane.revolute("rod", "rocker", at=(points["rod"][1], points["rocker"][1]))
    plane.revolute(base, "rocker", at=(base.point(3.0, 0.0), points["rocker"][0]))
    flat = plane.problem((0.0, 2.0))
    known = moved(flat, tolerance=1e-10)
    assert space.freedom.degrees == flat.freedom.degrees == 1
    ours, theirs = result.q.reshape(3, 7, -1)[:, [0, 2], -1], known.q.reshape(3, 3, -1)[:, :2, -1]
    np.testing.assert_allclose(ours, theirs, atol=1e-8)


def test_frames_that_a_side_file_joins(tmp_path):
    """A load on an arm, and one welded there or hung by a ball to a frame of its own."""
    path, side = tmp_path / "arm.urdf", tmp_path / "arm.yaml"
    load, mount = LINK.format("load", 0.3, 1.0, 0.4), '<origin xyz="1 0 0" rpy="0.3 0.2 0.1"/>'
    hinge = '<joint name="j" type="continuous"><parent link="base"/><child link="arm"/><axis xyz="0 1 0"/></joint>'
    joint = '<joint name="{0}" type="{1}"><parent link="{2}"/><child link="{3}"/>' + mount + "</joint>"
    links = '<link name="base"/><link name="tip"/>' + LINK.format("arm", 0.5, 2.0, 0.2) + load
    text = f'<robot name="r">{links}{hinge}{{}}</robot>'
    tip = joint.format("at", "fixed", "arm", "tip")
    path.write_text(text.format(tip + joint.format("k", "fixed", "arm", "load")))
    known = moved(read(path).problem((0.0, 0.5))).q[:2, -1]  # of the common centre
    path.write_text(text.format(tip + joint.format("free", "floating", "base", "load")))
    for kind, degrees in (("6d", 1), ("3D", 4)):
        side.write_text(f"closed_loop: [['load', 'at']]\ntype: ['{kind}']\nname_mot: ['j']\n")
        problem = read(path, side_file=side).problem((0.0, 0.5))
        assert problem.freedom.degrees == degrees
        if kind == "6d":
            q = moved(problem).q[:, -1].reshape(2, 7)
            np.testing.assert_allclose((2.0 * q[0, :2] + q[1, :2]) / 3.0, known, atol=1e-9)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("<robot", "<robots", "is not XML"),
        ('type="prismatic"', 'type="ball"', "type of joint 'push' must be one of"),
        ('<child link="slide"/>', '<child link="upper"/>', "has two parents"),
        ('<mass value="0.4"/>', "", "needs <mass> and <inertia>"),
        ('<child link="slide"/>', '<child link="other"/>', "child of joint 'push' must be a link of the file"),
        ('<axis xyz="1 0 0"/>', '<axis xyz="0 0 0"/>', "must have a direction"),
        ('ixx="', 'ixx="x', "inertia of link 'shoulder' must be 6 finite numbers"),
        ('damping="', 'damping="x', "damping of joint 'turn' must be a finite number"),
        ("</robot>", '<xacro:macro name="m"/></robot>', "is written in xacro: expand it first"),
        ("</robot>", '<link name="slide"/></robot>', "links must have different names; 'slide' occurs twice"),
    ],
)
def test_what_is_wrong_is_named(arm, old, new, message):
    arm.write_text(arm.read_text().replace(old, new, 1))
    with pytest.raises(ValueError, match=message):
        read(arm)


@pytest.mark.parametrize("given", [{}, {"leader": 2.0}, {"follower": 0.7}])
def test_a_joint_that_mimics_another_follows_it_from_the_start_and_over_turns(tmp_path, given):
    """The leader stays where it is; the follower is read before it."""
    link = '<link name="{}"><inertial><mass value="1"/><inertia ixx="0.01" iyy="0.01" izz="0.02"/></inertial></link>'
    joint = (
        '<joint name="{}" type="continuous"><parent link="base"/><child link="{}"/><origin xyz="0 {} 0"/>'
        '<axis xyz="0 0 1"/>{}</joint>'
    )
    mimic = '<mimic joint="leader" multiplier="-1.5" offset="0.25"/>'
    parts = (
        link.format("a"),
        link.format("b"),
        joint.format("follower", "b", 1, mimic),
        joint.format("leader", "a", 0, ""),
    )
    path = tmp_path / "pair.urdf"
    path.write_text(f'<robot name="pair"><link name="base"/>{"".join(parts)}</robot>', encoding="utf-8")
    problem = from_urdf(path, positions=given).problem((0.0, 2.0), rates={"leader": 5.0})
    assert problem.note == "1 degree of freedom."
    angle = given.get("leader", (given["follower"] - 0.25) / -1.5 if "follower" in given else 0.0)
    turned = {body.name: body.coordinates for body in problem.model.bodies}
    for name, expected in (("a", angle), ("b", 0.25 - 1.5 * angle)):
        e0, e3 = problem.q0[turned[name][3]], problem.q0[turned[name][6]]
        assert 2.0 * np.arctan2(e3, e0) == pytest.approx(expected, abs=1e-12)
    result = moved(problem)
    turns = {name: np.ptp(problem.joint_coordinate(name).history(result)) for name in ("leader", "follower")}
    assert turns == pytest.approx({"leader": 10.0, "follower": 15.0})
