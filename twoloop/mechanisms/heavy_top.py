"""A spinning heavy top with a fixed point, described by its centre of mass and Euler parameters."""

import numpy as np

from twoloop.mechanisms.ready import ready
from twoloop.mechanisms.spatial import GROUND
from twoloop.mechanisms.spatial_bodies import SpatialBodies
from twoloop.problem.problem import Problem, Reference

GRAVITY = 9.81
MASS, LENGTH = 15.0, 1.0  # kg; m from the fixed point to the centre of mass, along y
INERTIA = (0.234375, 0.46875, 0.234375)  # kg m^2 about the centre of mass
SPIN = np.array([0.0, 150.0, -4.61538])  # rad/s at the start


def heavy_top() -> Problem:
    """The top of the benchmark for Lie-group integrators: its axis initially level, spinning at 150 rad/s."""
    rows = SpatialBodies((0.0, 0.0, -GRAVITY))
    position = np.array([0.0, LENGTH, 0.0])
    body = rows.body("top", MASS, INERTIA, position, np.eye(3), np.cross(SPIN, position), SPIN)
    rows.spherical(body, GROUND, (0.0, 0.0, 0.0))
    q0, v0 = rows.start
    return ready(
        *(rows, "heavy top", q0, v0, 0.2),
        conserved=True,
        parameters={"mass": MASS, "length": LENGTH, "inertia": INERTIA, "spin": tuple(SPIN), "gravity": GRAVITY},
        note="The inertia is about the centre of mass, as in Exudyn's model; some give it about the fixed point.",
        published=Reference(
            t=0.2,
            q=np.array([np.nan, np.nan, np.nan, -0.70828, 0.43878, 0.54573, 0.0894]),
            v=np.full(7, np.nan),
            source="jgerstmayr/EXUDYN, TestModels/heavyTop.py, a comment",
            digits={"q": 5.0},
            verified="Euler's equations about the fixed point",
        ),
        source=(
            "jgerstmayr/EXUDYN, TestModels/heavyTop.py; Bruels and Cardona, J. Comput. Nonlinear Dynam. 5 (2010) 031002"
        ),
        tags=("open chain", "rigid", "spatial"),
        purpose=(
            "A mass matrix of rank 6 of 7, and a fast spin beside a slow precession; energy and the angular momentum "
            "about the vertical are kept by the true motion."
        ),
        invariants={"vertical angular momentum (kg m^2/s)": rows.momentum((0.0, 0.0, 0.0), (0.0, 0.0, 1.0))},
        coordinates=rows.coordinates,
    )
