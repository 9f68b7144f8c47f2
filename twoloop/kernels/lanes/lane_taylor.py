"""Steps by Taylor series in lanes, as `taylor_step` has them."""

import numpy as np

from twoloop.kernels.data.common import kernel
from twoloop.kernels.lanes.lane_control import MOST_STEPS
from twoloop.kernels.lanes.lane_ends import MANY_STEPS
from twoloop.kernels.lanes.lane_projection import project_lanes
from twoloop.kernels.lanes.lane_room import (
    CHECKS_REDUNDANT,
    EVALUATED,
    FINE,
    GAP,
    LANES,
    ORDER,
    RUNNING,
    STEP,
    UNIT,
    WHICH,
    H,
    X,
    leave,
)

ALLOWED = 0.3  # as in taylor_step.py
MOST_SHORTENED, SHORTENED, GROWTH = 0.1, 0.9, 5.0
MOST_REFUSED = 10  # one after another
FIRST_UNIT = 0.01  # of the span


@kernel(STEP)
def step_by_series(code, settings, control, options, room, status, n_steps, within):
    """A step by the series about its beginning, or states within one."""
    order = settings[ORDER]
    if within:
        for k in range(LANES):
            room[X * LANES + k] = room[X * LANES + k] / room[UNIT * LANES + k]
        code.evaluate(order, control, room)
        return
    for k in range(LANES):  # of stiff motion, steps are as many as its time scales
        if room[RUNNING * LANES + k] == 1.0 and n_steps[int(room[WHICH * LANES + k])] >= MOST_STEPS:
            leave(room, status, k, MANY_STEPS)
    code.series(order, control, room)
    code.lengths(order, control, room)
    for k in range(LANES):  # at places within the step
        if room[FINE * LANES + k] == 1.0 and room[H * LANES + k] > control[GAP]:
            room[EVALUATED * LANES + k] = np.ceil(room[H * LANES + k] / control[GAP]) - 1.0
    code.look(order, control, room)
    code.evaluate(order, control, room)
    project_lanes(code, order, control, room)
    if settings[CHECKS_REDUNDANT] == 1:
        code.redundant(order, control, room)
    code.departure(order, control, room)
    code.defect(order, control, room)
    code.judge(order, control, room)
