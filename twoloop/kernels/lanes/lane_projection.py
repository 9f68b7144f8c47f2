"""States of lanes moved onto the constraints, those that are asked for at once."""

from twoloop.kernels.data.common import compiled
from twoloop.kernels.lanes.lane_room import LANES, LEFT_TO_MOVE

MOST_PASSES = 10
CONTRACTION = 0.5  # of a correction by the next, or the projection does not converge
LARGEST_MOVE, OF_POSITIONS = 1e-14, 1e-14  # correction after which a projection ends: absolute, of the largest position


@compiled
def project_lanes(code, order, control, room):
    """Put NEW of the lanes that FINE names on the constraints; FINE then says where it could be done."""
    code.closer(order, control, room)
    for _ in range(MOST_PASSES):
        code.nearer(order, control, room)
        left = 0.0
        for k in range(LANES):
            left += room[LEFT_TO_MOVE * LANES + k]
        if left == 0.0:
            break
