"""The page of joints: how each is called, how many freedoms it leaves, and a picture, drawn by moving its bodies.

The code on the page is run. The bodies are then moved along motions that are checked to be free, and drawn in each
position.
"""

import itertools
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.collections import PolyCollection
from numpy.typing import NDArray
from shapes import Shape, ball, bar, box, circle, face, rectangle, seen, tube

from twoloop import consistent_state
from twoloop.bodies import PlanarModel, SpatialModel
from twoloop.bodies.rotation import euler_rates, rotation_matrix

Array = NDArray[np.float64]

STEPS = 12  # from the position given to the farthest
COLOURS = {"ground": (0.62, 0.62, 0.64), "a": (0.85, 0.52, 0.24), "b": (0.22, 0.47, 0.72)}
BEGINNING = """# Joints

In each picture the ground is grey, body `a` is orange and body `b` is blue. Pale bodies show where the joint lets them
go. The code makes the joint in a `model` that has these bodies. [Bodies and joints](../bodies.md) explains the models.

<!-- Written by `python docs/generate.py`: do not edit it. -->
"""


@dataclass(frozen=True)
class Kind:
    """A joint: its title, what it does, the code, shapes by the names of bodies, and motions of the bodies."""

    title: str
    text: str
    code: str
    shapes: dict[str, Shape]
    motions: tuple[dict[str, tuple[float, ...]], ...]  # velocities: x, y, angle, or x, y, z and a rotation vector
    bars: tuple[tuple[str, Any, str, Any], ...] = ()  # lines between points of bodies
    only_forth: bool = False
    below: bool = False  # whether all is in front of the ground
    lines: tuple[Array, ...] = field(default=())  # of the ground


ROD = [bar((0.0, 0.0), (1.0, 0.0))]
BASE = [rectangle(0.0, -0.2, 0.3, 0.4)]
RAIL = [rectangle(0.5, -0.13, 2.0, 0.1)]
PLANAR = (
    Kind(
        "Revolute",
        "A pin: b turns on a.",
        'model.revolute("ground", "b", at=(0.0, 0.0))',
        {"ground": BASE, "b": ROD},
        ({"b": (0.0, 0.0, 0.7)},),
    ),
    Kind(
        "Prismatic",
        "A slide: b moves along an axis of a, and does not turn on it.",
        'model.prismatic("ground", "b", at=(0.5, 0.0), axis=(1.0, 0.0))',
        {"ground": RAIL, "b": [rectangle(0.5, 0.07, 0.5, 0.3)]},
        ({"b": (0.6, 0.0, 0.0)},),
    ),
    Kind(
        "Fixed",
        "Both bodies move as one.",
        'model.fixed("ground", "b")',
        {"ground": [rectangle(0.0, 0.0, 0.25, 0.9)], "b": [rectangle(0.6, 0.0, 0.95, 0.14)]},
        (),
    ),
    Kind(
        "Distance",
        "A rod without mass: a point of b stays as far from a point of a.",
        'model.distance("ground", (0.0, 0.0), "b", (0.8, 0.4))',
        {"ground": BASE, "b": [rectangle(1.05, 0.4, 0.5, 0.3)]},
        ({"b": (-0.2, 0.4, 0.0)}, {"b": (0.0, 0.0, 0.9, 0.8, 0.4)}),
        (("ground", (0.0, 0.0), "b", (0.8, 0.4)),),
    ),
    Kind(
        "Gear",
        "Two hinges that turn in a ratio.",
        'model.revolute("ground", "a", at=(0.0, 0.0), name="one")\n'
        'model.revolute("ground", "b", at=(0.75, 0.0), name="other")\n'
        'model.gear("one", "other", ratio=-0.5 / 0.25)',
        {
            "a": [circle(0, 0, 0.5, 16), bar((0, 0), (0.3, 0.0), 0.03)],
            "b": [circle(0.75, 0, 0.25, 8), bar((0.75, 0), (0.9, 0), 0.03)],
        },
        ({"a": (0.0, 0.0, 0.16), "b": (0.0, 0.0, -0.32, 0.75, 0.0)},),
        only_forth=True,
    ),
    Kind(
        "Rack",
        "A pinion on a rack: a hinge and a slide that move together.",
        'model.revolute("ground", "a", at=(0.0, 0.0), name="pinion")\n'
        'model.prismatic("ground", "b", at=(0.0, -0.3), axis=(1.0, 0.0), name="slide")\n'
        'model.rack("pinion", "slide", radius=0.3)',
        {"a": [circle(0, 0, 0.3, 12), bar((0, 0), (0.2, 0), 0.03)], "b": [rectangle(0.0, -0.39, 1.6, 0.14)]},
        ({"a": (0.0, 0.0, 0.7), "b": (0.21, 0.0, 0.0)},),
        only_forth=True,
    ),
    Kind(
        "Rolling",
        "A wheel that rolls on a line of a without slipping.",
        'model.rolling("ground", "b", radius=0.35, axis=(1.0, 0.0))',
        {"ground": [rectangle(0.5, -0.4, 2.2, 0.1)], "b": [circle(0, 0, 0.35), bar((0, 0), (0.27, 0.0), 0.03)]},
        ({"b": (1.1, 0.0, -1.1 / 0.35)},),
        only_forth=True,
    ),
    Kind(
        "Skate",
        "A blade, seen from above: its point does not move sideways. It turns, and goes ahead: non-holonomic.",
        'model.skate("b", at=(0.0, 0.0), axis=(1.0, 0.0))',
        {"b": [rectangle(0.0, 0.0, 0.9, 0.4), bar((-0.25, 0), (0.25, 0), 0.03)]},
        ({"b": (1.2, 0.0, 0.9)},),
        only_forth=True,
    ),
    Kind(
        "Point on a curve",
        "A point of b stays on a curve of a, as a pin in a slot.",
        'model.point_on_curve("ground", "b", at=(0.0, 0.25), curve=lambda x, y: y - 0.25 * np.cos(3.0 * x))',
        {"b": [bar((0.0, 0.25), (0.0, 0.85), 0.06)]},
        ({"b": (0.9, 0.0, 0.0)}, {"b": (0.0, 0.0, 0.5, 0.0, 0.25)}),
        lines=(np.column_stack([x := np.linspace(-1.2, 1.2, 100), 0.25 * np.cos(3.0 * x)]),),
    ),
    Kind(
        "Rope",
        "A rope of constant length through points of bodies, here over two small pulleys of the ground.",
        'model.rope([("a", (-0.5, -0.5)), ("ground", (-0.5, 0.5)), ("ground", (0.5, 0.5)), ("b", (0.5, -0.5))])',
        {"a": [rectangle(-0.5, -0.6, 0.3, 0.2)], "b": [rectangle(0.5, -0.6, 0.3, 0.2)]},
        ({"a": (0.0, 0.5, 0.0), "b": (0.0, -0.5, 0.0)},),
        (
            ("a", (-0.5, -0.5), "ground", (-0.5, 0.5)),
            ("ground", (-0.5, 0.5), "ground", (0.5, 0.5)),
            ("ground", (0.5, 0.5), "b", (0.5, -0.5)),
        ),
    ),
    Kind(
        "Coupling",
        "A function of the coordinates of joints that stays zero, here of the angles of two hinges.",
        'model.revolute("ground", "a", at=(-0.6, 0.0), name="one")\n'
        'model.revolute("ground", "b", at=(0.6, 0.0), name="other")\n'
        'model.coupling(["one", "other"], lambda x, y: y - 2.0 * x)',
        {"a": [bar((-0.6, 0.0), (-0.1, 0.0))], "b": [bar((0.6, 0.0), (1.1, 0.0))]},
        ({"a": (0.0, 0.0, 0.4, -0.6, 0.0), "b": (0.0, 0.0, 0.8, 0.6, 0.0)},),
        only_forth=True,
    ),
)

SPATIAL = (
    Kind(
        "Revolute",
        "A hinge: b turns on a about an axis.",
        'model.revolute("ground", "b", at=(0.0, 0.0, 0.0), axis=(0.0, 0.0, 1.0))',
        {
            "ground": tube((0, 0, -0.55), (0, 0, -0.11), 0.22),
            "b": [*tube((0, 0, -0.1), (0, 0, 0.3), 0.22), *box((0.7, 0, 0.1), (1.0, 0.16, 0.16))],
        },
        ({"b": (0.0, 0.0, 0.0, 0.0, 0.0, 0.6)},),
    ),
    Kind(
        "Prismatic",
        "A slide: b moves along an axis of a, and does not turn on it.",
        'model.prismatic("ground", "b", at=(0.0, 0.0, 0.0), axis=(1.0, 0.0, 0.0))',
        {"ground": box((0.0, 0.0, 0.0), (2.4, 0.18, 0.18)), "b": box((0.0, 0.0, 0.0), (0.5, 0.45, 0.45))},
        ({"b": (0.7, 0.0, 0.0, 0.0, 0.0, 0.0)},),
    ),
    Kind(
        "Cylindrical",
        "A sleeve: b slides along an axis of a, and turns about it.",
        'model.cylindrical("ground", "b", at=(0.0, 0.0, 0.0), axis=(1.0, 0.0, 0.0))',
        {
            "ground": tube((-1.2, 0, 0), (1.2, 0, 0), 0.09),
            "b": [*tube((-0.25, 0, 0), (0.25, 0, 0), 0.22), *box((0, 0, 0.4), (0.2, 0.16, 0.5))],
        },
        ({"b": (0.7, 0.0, 0.0, 0.0, 0.0, 0.0)}, {"b": (0.0, 0.0, 0.0, 0.9, 0.0, 0.0)}),
    ),
    Kind(
        "Spherical",
        "A ball joint: both bodies share a point.",
        'model.spherical("ground", "b", at=(0.0, 0.0, 0.0))',
        {
            "ground": tube((0, 0, -0.6), (0, 0, -0.12), 0.2),
            "b": [*ball((0, 0, 0), 0.2), *box((0.6, 0, 0), (0.9, 0.14, 0.14))],
        },
        ({"b": (0.0, 0.0, 0.0, 0.0, 0.0, 0.5)}, {"b": (0.0, 0.0, 0.0, 0.0, 0.5, 0.0)}),
    ),
    Kind(
        "Universal",
        "A cross: one of its axes is fixed in a, the other, perpendicular, in b.",
        'model.universal("ground", "b", at=(0.0, 0.0, 0.0), axes=((0.0, 1.0, 0.0), (0.0, 0.0, 1.0)))',
        {
            "ground": [
                *box((-0.85, 0, 0), (0.7, 0.14, 0.14)),
                *box((-0.45, 0, 0), (0.1, 0.6, 0.16)),
                *box((-0.15, 0.25, 0), (0.5, 0.1, 0.16)),
                *box((-0.15, -0.25, 0), (0.5, 0.1, 0.16)),
                *tube((0, -0.3, 0), (0, 0.3, 0), 0.06),
            ],
            "b": [
                *box((0.85, 0, 0), (0.7, 0.14, 0.14)),
                *box((0.45, 0, 0), (0.1, 0.16, 0.6)),
                *box((0.15, 0, 0.25), (0.5, 0.16, 0.1)),
                *box((0.15, 0, -0.25), (0.5, 0.16, 0.1)),
                *tube((0, 0, -0.3), (0, 0, 0.3), 0.06),
            ],
        },
        ({"b": (0.0, 0.0, 0.0, 0.0, 0.0, 0.5)}, {"b": (0.0, 0.0, 0.0, 0.0, 0.5, 0.0)}),
    ),
    Kind(
        "Planar",
        "A table: b slides in a plane of a, and turns about the axis across it.",
        'model.planar("ground", "b", at=(0.0, 0.0, 0.0), axis=(0.0, 0.0, 1.0))',
        {"ground": box((0, 0, -0.05), (2.2, 1.8, 0.08)), "b": box((0.0, 0.0, 0.15), (0.6, 0.35, 0.28))},
        ({"b": (0.7, 0.0, 0.0, 0.0, 0.0, 0.0)}, {"b": (0.0, 0.6, 0.0, 0.0, 0.0, 0.7)}),
        below=True,
    ),
    Kind(
        "Fixed",
        "Both bodies move as one.",
        'model.fixed("ground", "b")',
        {"ground": box((0, 0, 0), (0.2, 0.7, 0.8)), "b": box((0.6, 0.0, 0.0), (0.95, 0.18, 0.18))},
        (),
    ),
    Kind(
        "Distance",
        "A rod without mass: a point of b stays as far from a point of a.",
        'model.distance("ground", (0.0, 0.0, 0.0), "b", (0.7, 0.0, 0.3))',
        {"ground": tube((0, 0, -0.4), (0, 0, 0.0), 0.15), "b": box((0.95, 0.0, 0.3), (0.5, 0.3, 0.3))},
        ({"b": (-0.15, 0.0, 0.35, 0.0, 0.0, 0.0)}, {"b": (0.0, 0.45, 0.0, 0.0, 0.0, 0.0)}),
        (("ground", (0.0, 0.0, 0.0), "b", (0.7, 0.0, 0.3)),),
    ),
    Kind(
        "Gear",
        "Two hinges that turn in a ratio of whole numbers; their axes may have any direction.",
        'model.revolute("ground", "a", at=(0.0, 0.0, 0.0), axis=(0.0, 0.0, 1.0), name="one")\n'
        'model.revolute("ground", "b", at=(0.6, 0.0, 0.3), axis=(1.0, 0.0, 0.0), name="other")\n'
        'model.gear("one", "other", ratio=2 / 1)',
        {
            "a": [*tube((0, 0, -0.05), (0, 0, 0.05), 0.6, 36), *box((0.25, 0, 0.08), (0.5, 0.06, 0.06))],
            "b": [*tube((0.55, 0, 0.3), (0.65, 0, 0.3), 0.3, 24), *box((0.7, 0, 0.42), (0.06, 0.06, 0.24))],
        },
        ({"a": (0.0, 0.0, 0.0, 0.0, 0.0, 0.3), "b": (0.0, 0.0, 0.0, 0.6, 0.0, 0.0, 0.6, 0.0, 0.3)},),
        only_forth=True,
    ),
    Kind(
        "Rack",
        "A pinion on a rack: a hinge and a slide that move together.",
        'model.revolute("ground", "a", at=(0.0, 0.0, 0.3), axis=(0.0, 1.0, 0.0), name="pinion")\n'
        'model.prismatic("ground", "b", at=(0.0, 0.0, 0.0), axis=(1.0, 0.0, 0.0), name="slide")\n'
        'model.rack("pinion", "slide", radius=-0.3)',
        {
            "a": [*tube((0, -0.05, 0.3), (0, 0.05, 0.3), 0.3, 24), *box((0.1, -0.07, 0.3), (0.2, 0.04, 0.05))],
            "b": box((0.0, 0.0, -0.06), (1.8, 0.2, 0.12)),
        },
        ({"a": (0.0, 0.0, 0.0, 0.0, -0.9, 0.0, 0.0, 0.0, 0.3), "b": (0.27, 0.0, 0.0, 0.0, 0.0, 0.0)},),
        only_forth=True,
    ),
    Kind(
        "Rolling",
        "A thin wheel that rolls on a plane of the ground without slipping, upright or leaning: non-holonomic.",
        'model.rolling("b", radius=0.4, axis=(0.0, 1.0, 0.0), foot=(0.0, 0.0, -0.4))',
        {
            "ground": box((0.5, 0.1, -0.45), (2.4, 1.4, 0.06)),
            "b": [*tube((0, -0.03, 0), (0, 0.03, 0), 0.4, 36), *box((0.15, -0.04, 0), (0.3, 0.02, 0.05))],
        },
        ({"b": (0.9, 0.0, 0.0, 0.0, 0.9 / 0.4, 0.0)},),
        only_forth=True,
        below=True,
    ),
    Kind(
        "Rolling ball",
        "A ball that rolls on a plane of a body without slipping: non-holonomic.",
        'model.rolling_ball("b", radius=0.3, foot=(0.0, 0.0, -0.3))',
        {
            "ground": box((0.4, 0.0, -0.35), (2.2, 1.2, 0.06)),
            "b": [*box((0, 0, 0), (0.6, 0.05, 0.05)), *ball((0, 0, 0), 0.3)],
        },
        ({"b": (0.9, 0.0, 0.0, 0.0, 0.9 / 0.3, 0.0)},),
        only_forth=True,
        below=True,
    ),
    Kind(
        "Screw",
        "A thread: b slides along an axis of a in proportion to its rotation.",
        'model.screw("ground", "b", at=(0.0, 0.0, 0.0), axis=(1.0, 0.0, 0.0), pitch=1.5)',
        {"ground": tube((-1.1, 0, 0), (1.1, 0, 0), 0.12), "b": box((0.0, 0.0, 0.0), (0.4, 0.5, 0.5))},
        ({"b": (1.5 * 0.4, 0.0, 0.0, 2.0 * np.pi * 0.4, 0.0, 0.0)},),
    ),
    Kind(
        "Point on a line",
        "A point of b stays on a line of a, as a pin in a straight slot.",
        'model.point_on_line("ground", "b", at=(0.0, 0.0, 0.0), axis=(1.0, 0.0, 0.0))',
        {
            "ground": [*box((0.0, 0.12, 0.0), (2.2, 0.12, 0.12)), *box((0.0, -0.12, 0.0), (2.2, 0.12, 0.12))],
            "b": [
                *box((0.0, 0.0, 0.0), (0.24, 0.05, 0.05)),
                *ball((0, 0, 0), 0.11),
                *box((0.0, 0.0, 0.45), (0.12, 0.12, 0.7)),
            ],
        },
        ({"b": (0.7, 0.0, 0.0, 0.0, 0.0, 0.0)}, {"b": (0.0, 0.0, 0.0, 0.0, 0.6, 0.0)}),
    ),
    Kind(
        "Point on a curve",
        "A point of b stays on a curve of a, where two functions are zero, or on a surface, where one is.",
        "curve = lambda x, y, z: (y, z - 0.25 * np.cos(3.0 * x))\n"
        'model.point_on_curve("ground", "b", at=(0.0, 0.0, 0.25), curve=curve)',
        {
            "ground": [x for k in range(-11, 12) for x in ball((0.1 * k, 0.0, 0.25 * np.cos(0.3 * k)), 0.04)],
            "b": [*ball((0, 0, 0.25), 0.09), *box((0.0, 0.0, 0.65), (0.1, 0.1, 0.7))],
        },
        ({"b": (0.8, 0.0, 0.0, 0.0, 0.0, 0.0)},),
    ),
    Kind(
        "Rope",
        "A rope of constant length through points of bodies, here over two small pulleys of the ground.",
        "x, z = 0.5, 0.5\n"
        'over = [("a", (-x, 0.0, -z)), ("ground", (-x, 0.0, z)), ("ground", (x, 0.0, z)), ("b", (x, 0.0, -z))]\n'
        "model.rope(over)",
        {"a": box((-0.5, 0.0, -0.6), (0.3, 0.3, 0.2)), "b": box((0.5, 0.0, -0.6), (0.3, 0.3, 0.2))},
        ({"a": (0.0, 0.0, 0.5, 0.0, 0.0, 0.0), "b": (0.0, 0.0, -0.5, 0.0, 0.0, 0.0)},),
        (
            ("a", (-0.5, 0.0, -0.5), "ground", (-0.5, 0.0, 0.5)),
            ("ground", (-0.5, 0.0, 0.5), "ground", (0.5, 0.0, 0.5)),
            ("ground", (0.5, 0.0, 0.5), "b", (0.5, 0.0, -0.5)),
        ),
    ),
    Kind(
        "Coupling",
        "A function of the coordinates of joints that stays zero, here of a slide and a hinge.",
        'model.prismatic("ground", "a", at=(-0.6, 0.0, 0.0), axis=(1.0, 0.0, 0.0), name="slide")\n'
        'model.revolute("ground", "b", at=(0.6, 0.0, 0.0), axis=(0.0, 0.0, 1.0), name="hinge")\n'
        'model.coupling(["slide", "hinge"], lambda x, angle: angle - 2.0 * x)',
        {"a": box((-0.6, 0.0, 0.0), (0.4, 0.3, 0.3)), "b": box((0.9, 0.0, 0.0), (0.7, 0.16, 0.16))},
        ({"a": (0.3, 0.0, 0.0, 0.0, 0.0, 0.0), "b": (0.0, 0.0, 0.0, 0.0, 0.0, 0.6, 0.6, 0.0, 0.0)},),
        only_forth=True,
    ),
)


def text() -> str:
    """Return the page; the code of each joint is run."""
    parts = [BEGINNING]
    for heading, kinds, model_of in (("In a plane", PLANAR, planar), ("In space", SPATIAL, spatial)):
        parts.append(f"## {heading}\n")
        parts += [section(kind, problem_of(kind, model_of)[1], heading.split()[-1]) for kind in kinds]
    return "\n".join(parts)


def draw(folder: Path) -> None:
    """Draw the picture of each joint."""
    for where, kinds, model_of in (("plane", PLANAR, planar), ("space", SPATIAL, spatial)):
        for kind in kinds:
            picture(kind, *problem_of(kind, model_of), folder / file_name(kind, where))


def problem_of(kind: Kind, model_of: Callable[[Kind], Any]) -> tuple[Any, Any]:
    """Return the model with the joint, made by the code that the page shows, and its problem."""
    model = model_of(kind)
    exec(kind.code, {"model": model, "np": np})
    return model, model.problem()


def file_name(kind: Kind, where: str) -> str:
    """Return the name of the picture of a joint."""
    return f"joint-{kind.title.lower().replace(' ', '-')}-{where}.png"


def section(kind: Kind, problem: Any, where: str) -> str:
    """Return the section of one joint."""
    noun = "degree" if problem.freedom.degrees == 1 else "degrees"
    bodies = "the body has" if len(kind.shapes.keys() - {"ground"}) == 1 else "both bodies together have"
    return (
        f"### {kind.title}, in {'a ' if where == 'plane' else ''}{where}\n\n{kind.text} With it, {bodies} "
        f"{problem.freedom.degrees} {noun} of freedom.\n\n```python\n{kind.code}\n```\n\n"
        f"![{kind.title}]({file_name(kind, where)})\n"
    )


def planar(kind: Kind) -> PlanarModel:
    """The bodies, without joints."""
    model = PlanarModel()
    for name in kind.shapes:
        if name != "ground":
            model.body(name, mass=1.0, inertia=0.1, position=_centre(kind, name))
    return model


def spatial(kind: Kind) -> SpatialModel:
    """The bodies, without joints."""
    model = SpatialModel()
    for name in kind.shapes:
        if name != "ground":
            model.body(name, mass=1.0, inertia=(0.1, 0.1, 0.1), position=_centre(kind, name))
    return model


def _centre(kind: Kind, name: str) -> Array:
    """The middle of the first polygon, or of all: wheels have their centre first."""
    first = kind.shapes[name][0] if kind.shapes[name][0].shape[1] == 2 else np.vstack(kind.shapes[name])
    return np.round(0.5 * (first.max(axis=0) + first.min(axis=0)), 9)


def positions(kind: Kind, model: Any, problem: Any) -> Iterator[Array]:
    """Where the bodies are drawn, (n_q,): along the motions, and as given."""
    for motion, side in itertools.product(kind.motions, (1.0,) if kind.only_forth else (1.0, -1.0)):
        q, v = problem.q0.copy(), np.zeros_like(problem.q0)
        for name, rate in motion.items():
            body = next(each for each in model.bodies if each.name == name)
            v[list(body.coordinates)] = _rates(body, side * np.array(rate))
        if np.abs(problem.system.rows(0.0, q) @ v).max(initial=0.0) > 1e-12:
            raise ValueError(f"the motion {motion} of {kind.title} is not free")
        for step in range(STEPS):
            q = consistent_state(problem.system, 0.0, q + v / STEPS, 0.0 * v, check_assembly=False)[0]
            rows, speed = problem.system.rows(0.0, q), np.linalg.norm(v)
            v = v - np.linalg.lstsq(rows, rows @ v, rcond=1e-12)[0]
            v *= speed / np.linalg.norm(v)
            if step == STEPS - 1 or (kind.only_forth and step == STEPS // 2):
                yield q
    yield problem.q0


def _rates(body: Any, motion: Array) -> Array:
    """Velocities of the coordinates of a body: (velocity, rotation, its place), the last the origin where left out."""
    turns = 1 if len(body.position) == 2 else 3
    velocity, spin = motion[: len(body.position)], motion[len(body.position) :][:turns]
    arm = body.position - np.resize(np.append(motion[len(body.position) + turns :], np.zeros(3)), len(body.position))
    if turns == 1:
        return np.array([velocity[0] - spin[0] * arm[1], velocity[1] + spin[0] * arm[0], spin[0]])
    return np.append(velocity + np.cross(spin, arm), euler_rates((1.0, 0.0, 0.0, 0.0), spin))


def picture(kind: Kind, model: Any, problem: Any, path: Path) -> None:
    """Draw the ground, the bodies where they may go, and where they are."""
    figure, axes = plt.subplots(figsize=(3.6, 2.3))
    flat, faces = isinstance(model, PlanarModel), []
    *ghosts, here = positions(kind, model, problem)
    for number, q in enumerate((*ghosts, here)):
        alpha = 1.0 if q is here else 0.22
        for name, shape in kind.shapes.items():
            layer = -1 if name == "ground" and (flat or kind.below) else number * flat
            if name != "ground" or q is here:
                faces += [face(layer, placed(model, q, name, polygon), COLOURS[name], alpha) for polygon in shape]
        for one, at, other, there in kind.bars:
            ends = [placed(model, q, name, np.array([point]))[0] for name, point in ((one, at), (other, there))]
            line = seen(np.array(ends))[0]
            axes.plot(*line.T, "o-", color="0.25", lw=2.0, ms=4.0, alpha=alpha, zorder=3)
    for line in kind.lines:
        axes.plot(*line.T, color=COLOURS["ground"], lw=4.0, zorder=0)
    faces.sort(key=lambda each: each.order)
    fills, edges = [each.fill for each in faces], [each.edge for each in faces]
    outlines = [each.outline for each in faces]
    axes.add_collection(PolyCollection(outlines, facecolors=fills, edgecolors=edges, linewidths=0.8 if flat else 0.4))
    axes.set_aspect("equal")
    axes.autoscale_view()
    axes.margins(0.04)
    axes.axis("off")
    figure.savefig(path, dpi=100, bbox_inches="tight", pad_inches=0.03, metadata={"Software": None})
    plt.close(figure)


def placed(model: Any, q: Array, name: str, polygon: Array) -> Array:
    """A polygon of a body, in space."""
    if name == "ground":
        return polygon
    body = next(each for each in model.bodies if each.name == name)
    state = q[list(body.coordinates)]
    if len(state) == 3:
        s, c = np.sin(state[2]), np.cos(state[2])
        return state[:2] + (polygon - body.position) @ np.array([[c, s], [-s, c]])
    return state[:3] + (polygon - body.position) @ rotation_matrix(state[3:]).T
