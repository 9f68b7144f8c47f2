"""Files of MJCF and the same models by hand: the same start, the same accelerations to rounding, the same motion."""

import numpy as np
import pytest

from tests.bodies.runs import moved
from twoloop.bodies import SpatialModel, from_mjcf
from twoloop.bodies.rotation import rotation_matrix

pytestmark = pytest.mark.filterwarnings("ignore::twoloop.ConstraintWarning")
HEAD = '<mujoco><compiler angle="radian"/><default><geom contype="0" conaffinity="0"/></default><worldbody>'
X, Y, Z = np.eye(3)
BALL = 0.4 * 1.0 * 0.1**2  # of 1 kg and 0.1 m


def ball(at="0 0 0"):
    return f'<geom type="sphere" size="0.1" mass="1" pos="{at}"/>'


def about(axis, angle):
    return rotation_matrix([np.cos(0.5 * angle), *(np.sin(0.5 * angle) * np.asarray(axis))])


def bodies(model, *places, rotations=None):
    """Balls of 1 kg."""
    for k, place in enumerate(places):
        R = np.eye(3) if rotations is None else rotations[k]
        model.body("abc"[k], mass=1.0, inertia=(BALL, BALL, BALL), position=place, rotation=R)
    return model


def slider_crank():
    """Two hinges and a slide, the loop closed by connect."""
    text = f"""<body name="a" pos="0 0 0"><joint name="A" axis="0 1 0" damping="0.1"/>{ball("0.3 0 0.4")}
      <body name="b" pos="0.6 0 0.8"><joint name="B" axis="0 1 0"/>{ball("0.6 0 -0.4")}</body></body>
      <body name="c" pos="1.8 0 0"><joint name="C" type="slide" axis="1 0 0" stiffness="20" springref="0.2"/>{ball()}
      </body></worldbody><equality><connect body1="b" body2="c" anchor="1.2 0 -0.8"/></equality></mujoco>"""
    hand = bodies(SpatialModel(), (0.3, 0, 0.4), (1.2, 0, 0.4), (1.8, 0, 0))
    hand.torsion_spring(hand.revolute("ground", "a", at=(0, 0, 0), axis=Y), stiffness=0.0, damping=0.1)
    hand.revolute("a", "b", at=(0.6, 0, 0.8), axis=Y)
    hand.axial_spring(hand.prismatic("ground", "c", at=(1.8, 0, 0), axis=X), stiffness=20.0, length=0.2)
    hand.spherical("b", "c", at=(1.8, 0, 0))
    return text, hand, 1


def chain_of_balls():
    """Balls from the ground to the ground, the last closed by connect to the world, from rotated frames."""
    R, S = about(Z, 0.5), about(Z, 0.5) @ about(X, -0.7)
    text = f"""<body name="a" pos="0 0 1" axisangle="0 0 1 0.5"><joint type="ball" pos="0 0 0"/>{ball("0.5 0 0")}
      <body name="b" pos="1 0 0" axisangle="1 0 0 -0.7"><joint type="ball"/>{ball("0.2 0.3 0.1")}</body></body>
      </worldbody><equality><connect body1="b" anchor="0.9 0.2 -0.3"/></equality></mujoco>"""
    top = np.array([0, 0, 1.0])
    knee = top + R @ X
    hand = bodies(SpatialModel(), top + 0.5 * R @ X, knee + S @ (0.2, 0.3, 0.1), rotations=(R, S))
    hand.spherical("ground", "a", at=top)
    hand.spherical("a", "b", at=knee)
    hand.spherical("ground", "b", at=knee + S @ (0.9, 0.2, -0.3))
    return text, hand, 3


def welded_branches():
    """Two branches whose ends are welded; one on a sleeve, one on a hinge and a ball: it still turns."""
    text = f"""<body name="a" pos="0 0 0"><joint type="slide" axis="0 0 2"/><joint axis="0 0 1"/>{ball("1 0 0")}</body>
      <body name="b" pos="2 0 0"><joint type="ball" pos="-2 0 0"/>{ball("0 0 0.5")}</body>
      </worldbody><equality><weld body1="a" body2="b"/></equality></mujoco>"""
    hand = bodies(SpatialModel((0.0, -9.81, 0.0)), (1.0, 0, 0), (2.0, 0, 0.5))
    hand.cylindrical("ground", "a", at=(0, 0, 0), axis=Z)
    hand.spherical("ground", "b", at=(0, 0, 0))
    hand.fixed("a", "b", at=(2.0, 0, 0))
    return text, hand, 1


def cross_and_table():
    """A cross on a table that slides and turns."""
    text = f"""<body name="a" pos="0 0 0.5"><joint type="slide" axis="1 0 0"/><joint type="slide" axis="0 1 0"/>
      <joint axis="0 0 1"/>{ball()}<body name="b" pos="0 0 0.3"><joint axis="1 0 0" pos="0 0 0.1"/>
      <joint axis="0 1 0" pos="0 0 0.1"/>{ball("0.2 0 0.6")}</body></body></worldbody></mujoco>"""
    hand = bodies(SpatialModel(), (0, 0, 0.5), (0.2, 0, 1.4))
    hand.planar("ground", "a", at=(0, 0, 0.5), axis=Z)
    hand.universal("a", "b", at=(0, 0, 0.9), axes=(X, Y))
    return text, hand, 5


def tendons():
    """A free body that hangs on two tendons from a hinged arm, with a damper."""
    text = f"""<site name="world" pos="2 0 2"/><body name="a" pos="0 0 2"><joint axis="0 1 0" stiffness="40"/>
      {ball("1 0 0")}<site name="tip" pos="1 0 0"/></body>
      <body name="b" pos="1.2 0.1 0.8"><freejoint/>{ball()}<site name="hook" pos="0.1 0 0"/></body>
      </worldbody><tendon><spatial stiffness="30" damping="0.5" springlength="0.9"><site site="tip"/><site site="hook"/>
      </spatial><spatial stiffness="10" springlength="1.1"><site site="world"/><site site="hook"/></spatial>
      </tendon></mujoco>"""
    hand = bodies(SpatialModel(), (1.0, 0, 2), (1.2, 0.1, 0.8))
    hand.torsion_spring(hand.revolute("ground", "a", at=(0, 0, 2), axis=Y), stiffness=40.0)
    hand.spring("a", (1.0, 0, 2), "b", (1.3, 0.1, 0.8), stiffness=30.0, damping=0.5, length=0.9)
    hand.spring("ground", (2.0, 0, 2), "b", (1.3, 0.1, 0.8), stiffness=10.0, length=1.1)
    return text, hand, 7


def rigid_parts():
    """A body without a joint is part of its parent: here of two balls, on an oblique hinge that turns backwards."""
    text = f"""<body name="a" pos="0.1 0.2 0.3" quat="0.8 0 0.6 0"><joint axis="1 -2 2" pos="0 0.1 0" damping="0.2"/>
      {ball("0.4 0 0")}<body name="part" pos="0 0 0.5">{ball()}</body></body></worldbody></mujoco>"""
    R, at = rotation_matrix([0.8, 0.0, 0.6, 0.0]), np.array([0.1, 0.2, 0.3])
    ends = np.array([[0.4, 0, 0], [0, 0, 0.5]]) - [0.2, 0, 0.25]
    J = 2.0 * BALL * np.eye(3) + sum((end @ end) * np.eye(3) - np.outer(end, end) for end in ends)
    hand = SpatialModel()
    hand.body("a", mass=2.0, inertia=J, position=at + R @ (0.2, 0, 0.25), rotation=R)
    hinge = hand.revolute("ground", "a", at=at + R @ (0, 0.1, 0), axis=R @ (1.0, -2, 2))
    hand.torsion_spring(hinge, stiffness=0.0, damping=0.2)
    return text, hand, 1


@pytest.mark.parametrize("make", [slider_crank, chain_of_balls, welded_branches, cross_and_table, tendons, rigid_parts])
def test_a_file_and_the_same_by_hand(make, tmp_path):
    text, hand, degrees = make()
    gravity = "{} {} {}".format(*hand.gravity)
    text = HEAD.replace("<worldbody>", f'<option gravity="{gravity}"/><worldbody>') + text
    (tmp_path / "model.xml").write_text(text)
    ends = []
    for model in (from_mjcf(tmp_path / "model.xml"), hand):
        problem = model.problem((0.0, 0.5))
        assert problem.freedom.degrees == degrees
        result = moved(problem, tolerance=1e-12)
        ends.append((problem.q0, result.a[:, 0], result.q[:, -1]))
    for one, other, digits in zip(*ends, (1e-14, 1e-12, 1e-10), strict=True):
        np.testing.assert_allclose(one, other, atol=digits * max(1.0, np.abs(one).max()))
    assert np.abs(ends[0][2] - ends[0][0]).max() > 0.05  # it moves
