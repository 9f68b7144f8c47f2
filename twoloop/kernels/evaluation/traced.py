"""Compare calls of callbacks with their traces in numbers, see generate/traced_values.py.

Every number has a bound of its rounding error, in units of EPS, which is at least the size of its terms.
"""

import math

from numba import types

from twoloop.kernels.data.common import INTEGERS, KIT, MATRIX, VECTOR, exact, i8, kernel
from twoloop.kernels.evaluation import operations as op
from twoloop.kernels.evaluation.operations import operation

VALUE, BOUND = range(2)  # rows of `nodes`

EPS = 2.0**-52
SAME = 1e-9  # relative to the largest number: a larger difference counts unless it may be rounding, which is ...
ROUNDED = 200.0 * EPS  # ... this multiple of the bound


@exact
def _sum(columns, coefficients, constant, nodes, begin, end):
    """Return an affine expression, and its bound."""
    total, bound = constant, abs(constant)
    for k in range(begin, end):
        term = coefficients[k] * nodes[VALUE, columns[k]]
        total += term
        bound += abs(term) + abs(coefficients[k]) * nodes[BOUND, columns[k]]
    return total, bound


@exact
def _operation(kind, x, dx, y, dy):
    """Return the result of an operation, and its bound."""
    z = operation(kind, x, y)
    if kind == op.PRODUCT:
        dz = abs(x) * dy + abs(y) * dx
    elif kind == op.RECIPROCAL:
        dz = dx * z * z
    elif kind == op.SQUARE_ROOT:
        dz = min(0.5 * dx / z, math.sqrt(dx / EPS)) if dx > 0.0 else 0.0
    elif kind == op.EXPONENTIAL:
        dz = dx * z
    elif kind == op.LOGARITHM:
        dz = dx / abs(x)
    elif kind == op.ARCTANGENT:
        dz = dx / (1.0 + x * x)
    else:
        dz = dx
    dz += abs(z)
    return z, 0.0 if math.isnan(dz) else dz


@exact
def _traced(program, columns, coefficients, constants, nodes, values, bounds):
    """Compute results and bounds from the inputs, which are the first nodes."""
    for i in range(len(program)):
        first, second, end = program[i, op.FIRST], program[i, op.SECOND], program[i, op.END]
        x, dx = _sum(columns, coefficients, constants[i, 0], nodes, first, second)
        if program[i, op.KIND] == op.RESULT:
            values[program[i, op.NODE]], bounds[program[i, op.NODE]] = x, dx
        else:
            y, dy = _sum(columns, coefficients, constants[i, 1], nodes, second, end)
            z, dz = _operation(program[i, op.KIND], x, dx, y, dy)
            nodes[VALUE, program[i, op.NODE]], nodes[BOUND, program[i, op.NODE]] = z, dz


@exact
def _differences(called, traced, bounds):
    """Count the numbers that differ beyond rounding; those that are not finite do."""
    count = 0
    for i in range(called.shape[1]):
        largest = 0.0
        for k in range(len(called)):
            if math.isfinite(called[k, i]):
                largest = max(largest, abs(called[k, i]))
        for k in range(len(called)):
            if not abs(called[k, i] - traced[k, i]) <= SAME * largest + ROUNDED * bounds[k, i]:
                count += 1
    return count


@kernel(
    i8(KIT, INTEGERS, INTEGERS, MATRIX, types.int64[:, ::1], INTEGERS, VECTOR, MATRIX, MATRIX, MATRIX, MATRIX, MATRIX)
)
def compare(f, sizes, which, states, program, columns, coefficients, constants, nodes, called, traced, bounds):
    """Compare callbacks at states [t, q, v] with their traces, with bounds of rounding; each row is a state.

    Returns how many numbers differ by more than SAME of the largest at these states plus ROUNDED times the bound.

    `sizes`: n_q, n_c and n_a; `which`: 1 for each of KINDS in traced_values.py to be compared; `called`: zeros.
    """
    n, n_c, n_a = sizes[0], sizes[1], sizes[2]
    for k in range(len(states)):
        t, q, v, out = states[k, 0], states[k, 1 : 1 + n], states[k, 1 + n :], called[k]
        for i in range(1 + 2 * n):
            nodes[VALUE, i], nodes[BOUND, i] = states[k, i], 0.0
        _traced(program, columns, coefficients, constants, nodes, traced[k], bounds[k])
        place = 0
        if which[0]:
            f.mass(t, q, f.p, out[: n * n].reshape((n, n)))
            place += n * n
        if which[1]:
            f.force(t, q, v, f.p, out[place : place + n])
            place += n
        if which[2]:
            f.constraint(t, q, f.p, out[place : place + n_c])
            place += n_c
        if which[3]:
            f.jacobian(t, q, f.p, out[place : place + n_c * n].reshape((n_c, n)))
            place += n_c * n
        if which[4]:
            f.constraint_rate(t, q, f.p, out[place : place + n_c])
            place += n_c
        if which[5]:
            f.gamma(t, q, v, f.p, out[place : place + n_c])
            place += n_c
        if which[6]:
            f.nonholonomic(t, q, f.p, out[place : place + n_a * n].reshape((n_a, n)))
            place += n_a * n
        if which[7]:
            f.nonholonomic_rate(t, q, f.p, out[place : place + n_a])
            place += n_a
        if which[8]:
            f.nonholonomic_gamma(t, q, v, f.p, out[place : place + n_a])
    return _differences(called, traced, bounds)
