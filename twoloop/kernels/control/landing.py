"""Sizes of steps by which a run lands on a time: those of a fixed grid, and those under step-size control."""

import numpy as np

from twoloop.kernels.control import clock as at
from twoloop.kernels.data.common import merged
from twoloop.kernels.evaluation.constraints import representable_step

NEAR = 4.0  # times that differ by less than so many spacings of floating-point numbers are one


@merged
def on_grid(clock, t, h, target, goal):
    """Size of a step of a fixed grid, how many of the grid it is, and whether it reaches the goal.

    Times are counted, not added up; an output time within a millionth of a step of the grid is on it.
    """
    rounding = NEAR * np.spacing(max(abs(t), abs(target)))
    near = max(1e-6 * h, rounding)
    in_grid = 1.0
    if target <= clock[at.T_START] + clock[at.N_FIXED] * h + near:
        in_grid = 0.0  # a second output time beside the same point of the grid
    end = clock[at.T_START] + (clock[at.N_FIXED] + in_grid) * h
    reaches = goal <= end + near
    size = h
    if abs(t + h - end) > rounding:
        size = end - t  # back to the grid after such an output time
    if reaches and goal < target and abs(goal - end) > rounding:
        in_grid = 0.0
    return size, in_grid, reaches


@merged
def off_grid(control, t, h, left, leaps):
    """Size of a step with step-size control, and whether it reaches the goal, which is so far away."""
    reaches = leaps or h >= left * (1.0 - 1e-10)
    size = h
    if h > 0.5 * left and not reaches:
        size = 0.5 * left  # two equal steps rather than a long and a tiny one
    size = representable_step(t, size)
    if size > control[at.MAX_STEP]:
        size = representable_step(t, size - np.spacing(abs(t + size)))
    return size, reaches
