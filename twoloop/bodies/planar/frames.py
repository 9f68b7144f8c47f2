"""Evaluate points of planar bodies and their rates: helpers of compiled callbacks."""

import math

from twoloop.kernels.compile.caches import helper


@helper
def place(q, body, p, at):
    """Return the point of a body stored at index `at` of p and its derivative by the angle: x, y, dx, dy."""
    a, b = p[at], p[at + 1]
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


@helper
def angle_of(q, body):
    """Return the angle of a body, or its rate from v."""
    if body < 0:
        return 0.0
    return q[3 * body + 2]


@helper
def direction(q, body, angle, across):
    """Return the unit vector at an angle from the x axis of a body, or the one perpendicular to it."""
    total = angle + angle_of(q, body)
    s, c = math.sin(total), math.cos(total)
    if across:
        return -s, c
    return c, s


@helper
def add(row, body, fx, fy, dx, dy):
    """Add to a row (n_q,) the derivative of fx x + fy y of a point, i.e. the generalised force of (fx, fy) there."""
    if body >= 0:
        row[3 * body] += fx
        row[3 * body + 1] += fy
        row[3 * body + 2] += fx * dx + fy * dy


@helper
def turn(row, body, factor):
    """Add to a row the derivative of a multiple of the angle, i.e. the generalised force of a torque."""
    if body >= 0:
        row[3 * body + 2] += factor
