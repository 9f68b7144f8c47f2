"""Mistakes in joints and bodies that make a model of their own: the note of the problem names what is odd.

Those that raise stand in `tests/bad_input/bodies.py`.
"""

import numpy as np
import pytest

from tests.bad_input.bodies import BODIES, GROUP, planar
from tests.bad_input.impacts import IMPACTS, both_wheels
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
    "moments of inertia that no masses have": (
        heavy(0.1, 0.2, 0.5),
        "No body has the principal moments of inertia of 'top', 0.1, 0.2 and 0.5",
    ),
    "the same joint twice": (
        added(lambda m: m.revolute("ground", "bar", at=(0, 0))),
        "The rows of 'pin', 'revolute bar-ground' are dependent.",
    ),
    "a bar on two pins of the ground": (
        added(lambda m: m.revolute("ground", "bar", at=(1, 0))),
        "3 degrees of freedom. The rows of 'pin', 'revolute bar-ground' are dependent.",
    ),
    "a pin in a weld": (
        added(lambda m: m.fixed("ground", "bar", name="weld")),
        "The rows of 'pin', 'weld' are dependent.",
    ),
    "hinges of a door, in line": (
        hinged(((0, 0, 1), (0, 0, 1)), (0, 0, 0), (0, 0, 1)),
        "1 degree of freedom. The rows of 'hinge 0', 'hinge 1' are dependent.",
    ),
    "hinges of a door, not in line": (hinged(((0, 0, 1), (0, 0.01, 1)), (0, 0, 0), (0, 0, 1)), "0 degrees of freedom."),
    "gears of inconsistent ratios": (both_wheels(2.0, 3.0), "0 degrees of freedom."),
    "a gear twice": (
        both_wheels(-1.0, -1.0),
        "The rows of 'gear of pin 0 and pin 1', 'gear of pin 0 and pin 1 2' are dependent.",
    ),
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
    "degrees as a limit": (
        added(lambda m: m.limit("pin", upper=45.0)),
        "upper limit of pin is 45 rad, more than a turn",
    ),
    "degrees in a drive": (
        added(lambda m: m.drive("pin", lambda t: 30.0 + t)),
        "angle of bar is 30 rad, more than a turn",
    ),
    "degrees in a spring": (
        added(lambda m: m.torsion_spring("pin", stiffness=1.0, angle=20.0)),
        "without torque of torsion spring of pin is 20 rad, more than a turn",
    ),
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


def test_at_least_twenty_kinds_of_mistakes_in_joints_are_caught():
    raised = [case for case in (*BODIES, *IMPACTS) if case.group.startswith(GROUP[:6])]
    assert len(raised) >= 50 and len(ODD) >= 12


def test_points_that_coincide_but_for_rounding_have_no_distance():
    model, knee = SpatialModel(), (0.7, 0.2, 0.1)
    model.rod("shank", (0.1, 0.3, 0.0), knee, radius=0.02, mass=1.0)
    model.rod("thigh", knee, (0.4, 0.9, 1.3), radius=0.02, mass=1.0)
    with pytest.raises(ValueError, match="coincide in the position given"):
        model.distance("shank", knee, "thigh", knee)
