"""Points of planar bodies and their rates: helpers of callbacks."""

import math

from twoloop.kernels.compile.caches import helper


@helper
def place_on(q, body, a, b):
    """Return the point (a, b) of a body and its derivative with respect to the angle: x, y, dx, dy."""
    if body < 0:
        return a, b, 0.0, 0.0
    s, c = math.sin(q[3 * body + 2]), math.cos(q[3 * body + 2])
    x, y = c * a - s * b, s * a + c * b
    return q[3 * body] + x, q[3 * body + 1] + y, -y, x


@helper
def motion(v, body, dx, dy):
    """Return the velocity of a point and the part of its acceleration without v'; (dx, dy): derivative by the angle."""
    if body < 0:
        return 0.0, 0.0, 0.0, 0.0
    w = v[3 * body + 2]
    return v[3 * body] + w * dx, v[3 * body + 1] + w * dy, -w * w * dy, w * w * dx
