"""Test springs whose force is a function of their length, angle or displacement and its rate."""

import numpy as np
import pytest

from tests.bodies.runs import by_hand, moved
from tests.marks import slow
from twoloop.bodies import PlanarModel, SpatialModel

AXIS = np.array([1.0, 2.0, 2.0]) / 3.0


def hinge_and_slide(dimension, law):
    """A bar on a hinge, a block on a slide, both turned, and a spring in each and between them."""
    if dimension == 2:
        model, at = PlanarModel(), [np.array(x) for x in ((0.3, 0.1), (0.8, 0.5), (1.4, 0.2))]
        bar = model.body("bar", mass=2.0, inertia=0.3, position=at[1], angle=0.2, angular_velocity=0.7)
        block = model.body("block", mass=1.5, inertia=0.2, position=at[2], angle=-0.4)
        hinge = model.revolute("ground", bar, at=at[0])
        slide = model.prismatic(bar, block, at=at[2], axis=(1.0, 0.5))
    else:
        model, at = SpatialModel(), [np.array(x) for x in ((0.3, 0.1, 0.2), (0.8, 0.5, 0.1), (1.4, 0.2, 0.6))]
        bar = model.body("bar", mass=2.0, inertia=(0.3, 0.4, 0.5), position=at[1])
        block = model.body("block", mass=1.5, inertia=(0.2, 0.3, 0.2), position=at[2])
        hinge = model.revolute("ground", bar, at=at[0], axis=AXIS)
        slide = model.prismatic(bar, block, at=at[2], axis=(1.0, 0.5, -0.3))
    high = np.eye(dimension)[1]
    model.force(block, at[2], lambda t, q, v: np.cos(t) * q[0] * v[1] * high)
    if law:
        model.torsion_spring(hinge, torque=lambda angle, rate: 7.0 * angle + 0.3 * rate)
        model.axial_spring(slide, force=lambda x, rate: 40.0 * x + 0.5 * rate)
        model.spring("ground", high, block, at[2] + 0.1, force=lambda x, rate: 30.0 * (x - 0.4) + 0.2 * rate)
    else:
        model.torsion_spring(hinge, stiffness=7.0, damping=0.3)
        model.axial_spring(slide, stiffness=40.0, damping=0.5)
        model.spring("ground", high, block, at[2] + 0.1, stiffness=30.0, damping=0.2, length=0.4)
    return model.problem((0.0, 1.0))


@pytest.mark.parametrize("dimension", [slow(2), slow(3)])
def test_a_linear_function_is_a_stiffness_and_a_damping(dimension):
    law, linear = (hinge_and_slide(dimension, law) for law in (True, False))
    generic = np.random.default_rng(3)
    for _ in range(10):
        q, v = law.q0 + 0.2 * generic.uniform(-1.0, 1.0, len(law.q0)), generic.uniform(-1.0, 1.0, len(law.q0))
        one, other = (each.system.force(0.0, q, v) for each in (law, linear))
        np.testing.assert_allclose(one, other, rtol=1e-12, atol=1e-12)


def duffing(length, rate):
    return 30.0 * (length - 1.0) + 200.0 * (length - 1.0) ** 3 + 0.4 * rate


@pytest.mark.parametrize("options", [{"method": "RadauIIA9"}, {"method": "Taylor"}], ids=str)
def test_a_pendulum_on_a_duffing_spring(options):
    model = PlanarModel()
    bob = model.body("bob", mass=1.5, inertia=0.1, position=(0.9, -0.3))
    model.spring("ground", (0.2, 0.1), bob, bob.point(0.0, 0.0), force=duffing, name="string")
    problem = model.problem((0.0, 2.0))

    def acceleration(t, x, rate):
        away = x - (0.2, 0.1)
        length = np.sqrt(away @ away)
        return np.array([0.0, -9.81]) - duffing(length, away @ rate / length) / length * away / 1.5

    known = by_hand(acceleration, [0.9, -0.3, 0.0, 0.0], [2.0])[:2, -1]
    assert not problem.conserved
    np.testing.assert_allclose(moved(problem, **options).q[:2, -1], known, atol=1e-8)


@pytest.mark.parametrize("options", [{}, slow({"compiled": True})], ids=str)
def test_a_cubic_torque_in_a_hinge_in_space(options):
    model = SpatialModel(gravity=(0.0, 0.0, 0.0))
    bar = model.body("bar", mass=2.0, inertia=(0.4, 0.4, 0.4), position=(0.0, 0.0, 0.0), angular_velocity=AXIS)
    hinge = model.revolute("ground", bar, at=(0.0, 0.0, 0.0), axis=AXIS)
    model.torsion_spring(hinge, torque=lambda angle, rate: 2.0 * angle + 5.0 * angle**3 + 0.1 * rate)
    problem = model.problem((0.0, 2.0))
    known = by_hand(lambda t, a, rate: -(2.0 * a + 5.0 * a**3 + 0.1 * rate) / 0.4, [0.0, 1.0], [2.0])
    result = moved(problem, **options)
    angle = 2.0 * np.arctan2(AXIS @ result.q[4:7, -1], result.q[3, -1])
    assert angle == pytest.approx(known[0, -1], abs=1e-8)
