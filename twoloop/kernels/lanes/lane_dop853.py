"""Steps of DOP853 in lanes, as `explicit_step` has them with free stages: the end alone is put on the constraints."""

from twoloop.kernels.data.common import kernel
from twoloop.kernels.lanes.lane_algebra import copy_vectors
from twoloop.kernels.lanes.lane_control import begin_control, choose_steps, end_steps, judge_steps, set_end
from twoloop.kernels.lanes.lane_room import (
    BEGIN,
    N_NUMBERS,
    N_ROWS,
    ORDER,
    PREDICTED_V,
    SLOPES,
    START,
    STEP,
    N,
    places_of,
)


def memory_size(s: int, n: int) -> int:
    """Length of the method's memory, in vectors, for s stages."""
    return (SLOPES + s) * n


@kernel(STEP)
def step_by_dop853(code, settings, control, options, room, status, n_steps, within):
    """A step, no longer than the gap within which the equations are looked at, or states within one, by others."""
    n = settings[N]
    state, _, _, _, a, _, _, memory = places_of(n, settings[N_ROWS], settings[N_NUMBERS])
    start = memory + START * n
    if not within:
        begin_control(options, control, room, n, state, a, start)
        choose_steps(room, control, status, n_steps)
        copy_vectors(room, state, memory + BEGIN * n, 2 * n)
        copy_vectors(room, start, memory + SLOPES * n, n)
    code.stages(settings[ORDER], control, room)
    set_end(room, control)
    if not within:
        end_steps(code, settings, control, room, memory + PREDICTED_V * n)
        judge_steps(options, room, n, a, start, status)
