"""Rows that are functions of coordinates, in a plane and in space: read from the results of their program."""

from twoloop.bodies.parameter_layout import (
    FIRST,
    HEAD,
    JOINT_WIDTH,
    JOINTS,
    KIND,
    MORE,
    MOTION,
    N_JOINTS,
    RATE,
    ROW,
    SECOND,
    WRITTEN,
)
from twoloop.kernels.compile.caches import helper


@helper
def fill_entries(p, k, made, first_result, entries):
    """Derivatives by the coordinates that the row of a joint at place k depends on, into entries (n_q,)."""
    columns = int(p[k + MORE])
    for m in range(int(p[columns])):
        entries[int(p[columns + 1 + m])] = made[first_result + m]


@helper
def take_entries(p, k, width, skipped, row, values, at):
    """Move the entries of a row of the joint at place k from where they stand in C_q to the values, and clear the row.

    Those by the coordinates of both bodies, less the first few where a row turns alone; see `model_system.entries_of`.
    """
    if int(p[k + KIND]) == WRITTEN:
        columns = int(p[k + MORE])
        for m in range(int(p[columns])):
            j = int(p[columns + 1 + m])
            values[at + m], row[j] = row[j], 0.0
        return at + int(p[columns])
    for body in (int(p[k + FIRST]), int(p[k + SECOND])):
        if body >= 0:
            for j in range(width * body + skipped, width * (body + 1)):
                values[at], row[j] = row[j], 0.0
                at += 1
    return at


@helper
def fill_nonholonomic(p, made, A):
    """A."""
    first, n = int(p[p.size - HEAD + JOINTS]), int(p[p.size - HEAD + N_JOINTS])
    for k in range(first, first + JOINT_WIDTH * n, JOINT_WIDTH):
        if int(p[k + KIND]) == RATE:
            fill_entries(p, k, made, int(p[k + MOTION]) + 1, A[int(p[k + ROW])])


@helper
def fill_nonholonomic_gamma(p, made, Qa):
    """The right-hand side of A a = Q_a."""
    first, n = int(p[p.size - HEAD + JOINTS]), int(p[p.size - HEAD + N_JOINTS])
    for k in range(first, first + JOINT_WIDTH * n, JOINT_WIDTH):
        if int(p[k + KIND]) == RATE:
            Qa[int(p[k + ROW])] = made[int(p[k + MOTION])]
