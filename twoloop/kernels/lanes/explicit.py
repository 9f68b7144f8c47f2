"""Steps of explicit methods in lanes, by DOP853 and by Taylor series.

Stages are not projected, as in `explicit_step`: only the end is projected onto the constraints. Step-size control of a
series is code generated for the mechanism, see generate/lane_code.py.
"""

import numpy as np

from twoloop.kernels.data.common import kernel
from twoloop.kernels.lanes.control import MOST_STEPS, begin_control, choose_steps, end_steps, judge_steps, set_end
from twoloop.kernels.lanes.layout import (
    BEGIN,
    CHECKS_REDUNDANT,
    EVALUATED,
    FINE,
    GAP,
    LANES,
    MANY_STEPS,
    N_NUMBERS,
    N_ROWS,
    ORDER,
    PREDICTED_V,
    RUN,
    RUNNING,
    SLOPES,
    START,
    STEP,
    UNIT,
    H,
    N,
    X,
    leave_run,
    places_of,
)
from twoloop.kernels.lanes.operations import copy_vectors, project_lanes


def memory_size(s: int, n: int) -> int:
    """Return the length of the method's memory, in vectors, for s stages."""
    return (SLOPES + s) * n


@kernel(STEP)
def step_by_dop853(code, settings, control, options, work, status, n_steps, within):
    """Make a step that is not longer than the largest gap between evaluations, or compute states within a step."""
    n = settings[N]
    state, _, _, _, a, _, _, memory = places_of(n, settings[N_ROWS], settings[N_NUMBERS])
    start = memory + START * n
    if not within:
        begin_control(options, control, work, n, state, a, start)
        choose_steps(work, control, status, n_steps)
        copy_vectors(work, state, memory + BEGIN * n, 2 * n)
        copy_vectors(work, start, memory + SLOPES * n, n)
    code.stages(settings[ORDER], control, work)
    set_end(work, control)
    if not within:
        end_steps(code, settings, control, work, memory + PREDICTED_V * n)
        judge_steps(options, work, n, a, start, status)


@kernel(STEP)
def step_by_series(code, settings, control, options, work, status, n_steps, within):
    """Make a step by the series about its beginning, or compute states within one."""
    order = settings[ORDER]
    if within:
        for k in range(LANES):
            work[X * LANES + k] = work[X * LANES + k] / work[UNIT * LANES + k]
        code.evaluate(order, control, work)
        return
    for k in range(LANES):  # stiff motion takes as many steps as its time scales
        if work[RUNNING * LANES + k] == 1.0 and n_steps[int(work[RUN * LANES + k])] >= MOST_STEPS:
            leave_run(work, status, k, MANY_STEPS)
    code.series(order, control, work)
    code.lengths(order, control, work)
    for k in range(LANES):  # evaluations at places within the step
        if work[FINE * LANES + k] == 1.0 and work[H * LANES + k] > control[GAP]:
            work[EVALUATED * LANES + k] = np.ceil(work[H * LANES + k] / control[GAP]) - 1.0
    code.check_within(order, control, work)
    code.evaluate(order, control, work)
    project_lanes(code, order, control, work)
    if settings[CHECKS_REDUNDANT] == 1:
        code.redundant(order, control, work)
    code.departure(order, control, work)
    code.defect(order, control, work)
    code.judge(order, control, work)
