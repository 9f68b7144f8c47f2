"""Constraint rows given by functions of the coordinates, evaluated from the results of their program."""

from twoloop.bodies.parameter_layout import RATE
from twoloop.bodies.read_tables import joint_at, joint_places
from twoloop.kernels.compile.caches import helper


@helper
def fill_entries(p, columns, made, first_result, entries):
    """Add the derivatives with respect to the coordinates listed from `columns` on to entries (n_q,)."""
    for m in range(int(p[columns])):
        entries[int(p[columns + 1 + m])] = made[first_result + m]


@helper
def put_entries(p, columns, made, first_result, values, begin):
    """Store the derivatives in values from `begin` on; return the position after the last."""
    for m in range(int(p[columns])):
        values[begin + m] = made[first_result + m]
    return begin + int(p[columns])


@helper
def fill_nonholonomic(p, made, A):
    """Evaluate A."""
    for k in joint_places(p):
        kind, row, _, _, _, _, columns, result = joint_at(p, k)
        if kind == RATE:
            fill_entries(p, columns, made, result + 1, A[row])


@helper
def fill_nonholonomic_gamma(p, made, Qa):
    """Evaluate the right-hand side of A a = Q_a."""
    for k in joint_places(p):
        kind, row, _, _, _, _, _, result = joint_at(p, k)
        if kind == RATE:
            Qa[row] = made[result]
