"""Test mistakes in joints and bodies that make a model all the same: the note of the problem names what is odd.

Those that raise stand in `tests/bad_input/bodies.py`.
"""

import numpy as np
import pytest

from tests.bad_input.bodies import planar
from tests.bad_input.impacts import both_wheels
from twoloop.bodies import PlanarModel, SpatialModel


def hinged(axis, *points):
    """A door on hinges."""
    model = SpatialModel(name="door")
    model.body("door", mass=1.0, inertia=(0.1, 0.1, 0.1), position=(0.5, 0.0, 0.0))
    for k, (at, along) in enumerate(zip(points, axis, strict=True)):
        model.revolute("ground", "door", at=at, axis=along, name=f"hinge {k}")
    return model


def added(change):
    model = planar()
    change(model)
    return model


def turned(angle):
    model = PlanarModel(name="turned")
    model.body("arm", mass=1.0, inertia=0.1, position=(0.0, 0.0), angle=angle)
    return model


def heavy(*moments):
    model = SpatialModel(name="heavy")
    model.body("top", mass=1.0, inertia=moments, position=(0.0, 0.0, 0.0))
    return model


ODD = {
    "moments of no masses": (
        heavy(0.1, 0.2, 0.5),
        "No body has the principal moments of inertia of 'top', 0.1, 0.2 and",
    ),
    "a bar on two pins of the ground": (
        added(lambda m: m.revolute("ground", "bar", at=(1, 0))),
        "3 degrees of freedom. The rows of 'pin', 'revolute bar-ground' are dependent.",
    ),
    "hinges of a door, in line": (
        hinged(((0, 0, 1), (0, 0, 1)), (0, 0, 0), (0, 0, 1)),
        "1 degree of freedom. The rows of 'hinge 0', 'hinge 1' are dependent.",
    ),
    "hinges of a door, not in line": (hinged(((0, 0, 1), (0, 0.01, 1)), (0, 0, 0), (0, 0, 1)), "0 degrees of freedom."),
    "gears of inconsistent ratios": (both_wheels(2.0, 3.0), "0 degrees of freedom."),
    "a curve that is no curve": (
        added(lambda m: m.point_on_curve("ground", "block", at=(1, 0), curve=lambda x, y: 0.0 * x, name="slot")),
        "The rows of 'slot' are dependent.",
    ),
    "a point beside its curve": (
        added(lambda m: m.point_on_curve("ground", "block", at=(1.0, 0.2), curve=lambda x, y: y)),
        "Bodies were moved to close the joints, y of block by 0.2 m.",
    ),
    "a body without a joint": (planar(), "'block' has no joint, and no force acts on it."),
    "a motor where a drive is": (
        added(lambda m: (m.motor("pin", 1.0), m.drive("pin", lambda t: t))),
        "'motor of pin' acts where 'drive of pin' prescribes the motion",
    ),
    "a stop, which `solve_dae` does not know": (
        added(lambda m: m.limit("pin", lower=-1.0)),
        "solve_with_stops handles its stops; solve_dae ignores them.",
    ),
    "degrees as the angle of a body": (turned(90.0), "angle of arm is 90 rad, more than a turn: angles are in rad"),
}


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("what", ODD)
def test_the_note_names_what_is_odd(what):
    model, words = ODD[what]
    assert words in model.problem().note


def test_a_model_without_mistakes_has_a_short_note():
    model = both_wheels(-1.0)
    model.spring("wheel 0", (0.0, 0.1), "ground", (0.0, 0.5), stiffness=3.0)
    model.motor("pin 1", lambda t: np.sin(t))
    model.torsion_spring("pin 0", stiffness=1.0, angle=-np.pi)
    assert model.problem().note == "1 degree of freedom."
    assert heavy(0.0333, 0.0333, 0.0667).problem().note == "6 degrees of freedom."  # a plate, rounded
    assert turned(2.0 * np.pi).problem().note == "3 degrees of freedom."
