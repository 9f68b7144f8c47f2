"""A spinning heavy top with a fixed point, described by its centre of mass and Euler parameters."""

import numpy as np

from twoloop.bodies.spatial_model import SpatialModel
from twoloop.mechanisms.momentum import Momentum
from twoloop.mechanisms.ready import ready_model
from twoloop.problem.problem import Problem, Reference

GRAVITY = 9.81
MASS, LENGTH = 15.0, 1.0  # kg; m from the fixed point to the centre of mass, along y
INERTIA = (0.234375, 0.46875, 0.234375)  # kg m^2 about the centre of mass
SPIN = np.array([0.0, 150.0, -4.61538])  # rad/s at the start


def heavy_top() -> Problem:
    """The top of the benchmark for Lie-group integrators: its axis initially level, spinning at 150 rad/s.

    Examples
    --------
    >>> from twoloop.mechanisms import heavy_top
    >>> problem = heavy_top()
    >>> problem.system.n_q, problem.system.n_c, problem.t_span[1]
    (7, 4, 0.2)
    """
    model, position = SpatialModel((0.0, 0.0, -GRAVITY), name="heavy top"), np.array([0.0, LENGTH, 0.0])
    motion = {"velocity": np.cross(SPIN, position), "angular_velocity": SPIN}
    model.body("top", mass=MASS, inertia=INERTIA, position=position, **motion)
    model.spherical("top", "ground", at=(0.0, 0.0, 0.0))
    momentum = Momentum(np.array([[MASS, *INERTIA]]), np.zeros(3), np.array([0.0, 0.0, 1.0]))
    return ready_model(
        *(model, 0.2),
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
        invariants={"vertical angular momentum (kg m^2/s)": momentum},
    )
