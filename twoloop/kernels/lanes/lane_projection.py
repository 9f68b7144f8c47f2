"""States of lanes moved onto the constraints, those that are asked for at once."""

import numpy as np

from twoloop.kernels.data.common import compiled
from twoloop.kernels.lanes.lane_room import FINE, LANES, LEFT_TO_MOVE, MOVED, MOVED_BEFORE, ON_CONSTRAINTS

MOST_PASSES = 10
CONTRACTION = 0.5  # of a correction by the next, or the projection does not converge
LARGEST_MOVE, OF_POSITIONS = 1e-14, 1e-14  # correction after which a projection ends: absolute, of the largest position


@compiled
def project_lanes(code, order, control, room, n, new):
    """Put NEW of the lanes that FINE names on the constraints; FINE then says where it could be done."""
    for k in range(LANES):
        room[LEFT_TO_MOVE * LANES + k] = room[FINE * LANES + k]
        room[MOVED_BEFORE * LANES + k] = np.inf
        room[ON_CONSTRAINTS * LANES + k] = 0.0
    code.closer(order, control, room)
    for k in range(LANES):
        room[LEFT_TO_MOVE * LANES + k] = room[FINE * LANES + k]
    for _ in range(MOST_PASSES):
        left = 0.0
        for k in range(LANES):
            room[FINE * LANES + k] = room[LEFT_TO_MOVE * LANES + k]
            left += room[LEFT_TO_MOVE * LANES + k]
        if left == 0.0:
            break
        code.nearer(order, control, room)
        for k in range(LANES):
            if room[LEFT_TO_MOVE * LANES + k] == 0.0:
                continue
            moved, least = room[MOVED * LANES + k], LARGEST_MOVE
            if moved > least:
                for j in range(n):
                    least = max(least, OF_POSITIONS * abs(room[(new + j) * LANES + k]))
            if room[FINE * LANES + k] == 1.0 and moved <= least:
                room[LEFT_TO_MOVE * LANES + k], room[ON_CONSTRAINTS * LANES + k] = 0.0, 1.0
            elif room[FINE * LANES + k] == 0.0 or not moved <= CONTRACTION * room[MOVED_BEFORE * LANES + k]:
                room[LEFT_TO_MOVE * LANES + k] = 0.0
            room[MOVED_BEFORE * LANES + k] = max(moved, least)
    for k in range(LANES):
        room[FINE * LANES + k] = room[ON_CONSTRAINTS * LANES + k]
