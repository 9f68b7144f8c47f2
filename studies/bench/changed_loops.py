"""The mechanisms of `closed_loops` with motors, with a light body, and turned in space."""

from collections.abc import Callable
from typing import Any

import numpy as np

from studies.bench import closed_loops as loops
from twoloop.bodies.model_problem import ModelProblem

Make = Callable[[], ModelProblem]

# how names end: a constant torque on the first body, and a PD motor in a joint
DRIVEN, SERVO, TURNED = ", driven", ", PD motor", ", turned"
RATIOS = {", a body 1e2 times lighter": 1e2, ", a body 1e4 times lighter": 1e4}
ANGLE = 0.5  # rad, by which the motor turns its joint
# torque, N m, on the first body; stiffness, N m/rad, and damping, N m s/rad, of the motor in its hinge on the ground
MOTORS: dict[Make, tuple[float, float, float]] = {
    loops.four_bar: (5.0, 200.0, 5.0),
    loops.crank_rocker: (0.5, 200.0, 5.0),
    loops.parallelogram: (20.0, 200.0, 5.0),
    loops.six_bar: (-0.5, 50.0, 2.0),
    loops.slider_crank: (1.0, 200.0, 5.0),
    loops.squeezer: (0.03, 0.05, 1e-4),
    loops.closed_chain: (0.05, 1.0, 0.01),
    loops.rssr: (0.1, 20.0, 1.0),
    loops.bricard: (3.0, 50.0, 5.0),
    loops.governor: (1.0, 50.0, 2.0),
    loops.stewart: (3.0, 2000.0, 60.0),  # of each leg, N/m and N s/m: it has no hinge on the ground
}


LIGHT = {loops.closed_chain: 25, loops.stewart: 0, loops.bricard: 2}  # number of the body, else the second one


def _changed(build: Callable[..., ModelProblem], ending: str) -> Make:
    """What makes a mechanism whose name ends so."""

    def make() -> ModelProblem:
        torque, stiffness, damping = MOTORS[build]
        legs = build is loops.stewart and ending == SERVO
        options: dict[str, Any] = {"Q": loops.ASKEW} if ending == TURNED else {}
        given = build(**options | ({"stiffness": stiffness, "damping": damping} if legs else {}))
        model: Any = given.model
        model.name = given.name + ending
        if ending == DRIVEN:
            spatial = model.dimension == 3
            axis = model.joints[0].axes[0] if spatial and build is not loops.stewart else np.array([0.0, 0.0, 1.0])
            model.torque(model.bodies[0].name, torque * axis if spatial else torque)
        elif ending == SERVO and not legs:
            hinge = model.joints[2 if build is loops.governor else 0]  # an arm: without its spin a governor folds
            model.torsion_spring(hinge, stiffness=stiffness, damping=damping, angle=ANGLE)
        elif ending in RATIOS:
            model.bodies[LIGHT.get(build, 1)].inertia[:] /= RATIOS[ending]  # mass and moments
        return model.problem(given.t_span)

    make.__name__ = build.__name__ + ending.replace(", ", "_").replace(" ", "_")
    return make


MOTORISED = tuple(_changed(build, ending) for build in MOTORS for ending in (DRIVEN, SERVO))
# without the parallelogram, whose known motion is that of its own masses
_OTHERS = [build for build in loops.MECHANISMS if build is not loops.parallelogram]
LIGHTENED = tuple(_changed(build, ending) for build in _OTHERS for ending in RATIOS)
IN_A_FRAME = tuple(_changed(build, TURNED) for build in loops.SPATIAL)
