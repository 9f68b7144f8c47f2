"""The mechanisms of `closed_loops` driven by a constant torque on the first body, and with a PD motor in a joint."""

from collections.abc import Callable
from typing import Any

import numpy as np

from studies.bench.closed_loops import (
    bricard,
    closed_chain,
    crank_rocker,
    four_bar,
    governor,
    parallelogram,
    rssr,
    six_bar,
    slider_crank,
    squeezer,
    stewart,
)
from twoloop.bodies.model_problem import ModelProblem

Make = Callable[[], ModelProblem]

DRIVEN, SERVO = ", driven", ", PD motor"  # how names end
ANGLE = 0.5  # rad, by which the motor turns its joint
# torque, N m, on the first body; stiffness, N m/rad, and damping, N m s/rad, of the motor in its hinge on the ground
MOTORS: dict[Make, tuple[float, float, float]] = {
    four_bar: (5.0, 200.0, 5.0),
    crank_rocker: (0.5, 200.0, 5.0),
    parallelogram: (20.0, 200.0, 5.0),
    six_bar: (-0.5, 50.0, 2.0),
    slider_crank: (1.0, 200.0, 5.0),
    squeezer: (0.03, 0.05, 1e-4),
    closed_chain: (0.05, 1.0, 0.01),
    rssr: (0.1, 20.0, 1.0),
    bricard: (3.0, 50.0, 5.0),
    governor: (1.0, 50.0, 2.0),
    stewart: (3.0, 2000.0, 60.0),  # of each leg, N/m and N s/m: it has no hinge on the ground
}


def _motorised(build: Make, ending: str) -> Make:
    def make() -> ModelProblem:
        torque, stiffness, damping = MOTORS[build]
        legs = build is stewart and ending == SERVO
        given = stewart(stiffness, damping) if legs else build()
        model: Any = given.model
        model.name = given.name + ending
        if ending == DRIVEN:
            spatial = model.dimension == 3
            axis = model.joints[0].axes[0] if spatial and build is not stewart else np.array([0.0, 0.0, 1.0])
            model.torque(model.bodies[0].name, torque * axis if spatial else torque)
        elif not legs:
            hinge = model.joints[2 if build is governor else 0]  # an arm: without its spin a governor folds
            model.torsion_spring(hinge, stiffness=stiffness, damping=damping, angle=ANGLE)
        return model.problem(given.t_span)

    make.__name__ = build.__name__ + ending.replace(", ", "_").replace(" ", "_")
    return make


MOTORISED = tuple(_motorised(build, ending) for build in MOTORS for ending in (DRIVEN, SERVO))
