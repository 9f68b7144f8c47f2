"""Read the tables of a model from its parameters (see `parameter_layout`), and evaluate the programs stored there."""

import numpy as np

from twoloop.bodies import parameter_layout as layout
from twoloop.bodies.parameter_layout import RATE_FUNCTION
from twoloop.kernels.compile.caches import helper
from twoloop.kernels.data.common import exact, inlined
from twoloop.kernels.evaluation.operations import N_COLUMNS, run_table

N_RESULTS, N_NODES, N_ROWS, N_TERMS, PROGRAM = range(5)  # sizes in front of a program; PROGRAM: where it begins


@helper
def fill_results(place, t, q, v, p, nodes):
    """Compute the results of the program at an index of p, followed by its nodes."""
    n_rows, n_terms = int(p[place + N_ROWS]), int(p[place + N_TERMS])
    columns = place + PROGRAM + N_COLUMNS * n_rows
    coefficients = columns + n_terms
    constants = coefficients + n_terms
    inputs = int(p[place + N_RESULTS])
    run_table(p, place + PROGRAM, n_rows, columns, p, coefficients, constants, nodes, inputs, t, q, v)


@inlined
def results_within(place, t, q, v, p):
    """Return the results of the program at an index of p, followed by its nodes."""
    nodes = np.zeros(int(p[place + N_RESULTS]) + int(p[place + N_NODES]))
    fill_results(place, t, q, v, p, nodes)
    return nodes


results = results_within.py_func  # the same function, for calls from Python


@helper
def result(values, place, order):
    """Return a derivative of a motion; zero if there is no motion."""
    if place < 0:
        return 0.0
    return values[place + order]


@exact
def n_bodies(p):
    """Return the number of bodies."""
    return int(p[p.size - layout.HEAD + layout.BODIES])


@exact
def joint_places(p):
    """Return the index at which the table of joints begins."""
    first, n = int(p[p.size - layout.HEAD + layout.JOINTS]), int(p[p.size - layout.HEAD + layout.N_JOINTS])
    return range(first, first + layout.JOINT_WIDTH * n, layout.JOINT_WIDTH)


@exact
def joint_at(p, k):
    """Return row k of the table of joints: kind, row of C, i, its numbers, j, its numbers, more numbers, motion."""
    i, at_i, j, at_j = int(p[k + 2]), int(p[k + 3]), int(p[k + 4]), int(p[k + 5])
    return int(p[k]), int(p[k + 1]), i, at_i, j, at_j, int(p[k + 6]), int(p[k + 7])


@exact
def force_places(p):
    """Return the index at which the table of forces begins."""
    first, n = int(p[p.size - layout.HEAD + layout.FORCES]), int(p[p.size - layout.HEAD + layout.N_FORCES])
    return range(first, first + layout.FORCE_WIDTH * n, layout.FORCE_WIDTH)


@exact
def force_at(p, k):
    """Return row k of the table of forces: kind, i and its numbers, j and its numbers, more numbers, result, point."""
    i, at_i, j, at_j = int(p[k + 1]), int(p[k + 2]), int(p[k + 3]), int(p[k + 4])
    return int(p[k]), i, at_i, j, at_j, int(p[k + 5]), int(p[k + 6]), int(p[k + 7])


@helper
def fill_entries(p, columns, results, first_result, entries):
    """Add the derivatives by the coordinates that p lists from index `columns` on to `entries` (n_q,)."""
    for m in range(int(p[columns])):
        entries[int(p[columns + 1 + m])] = results[first_result + m]


@helper
def put_entries(p, columns, results, first_result, values, begin):
    """Store the derivatives of a row in `values` from index `begin` on; return the index after the last one."""
    for m in range(int(p[columns])):
        values[begin + m] = results[first_result + m]
    return begin + int(p[columns])


@helper
def fill_nonholonomic(p, results, A):
    """Evaluate A, the matrix of the non-holonomic constraints."""
    for k in joint_places(p):
        kind, row, _, _, _, _, columns, result = joint_at(p, k)
        if kind == RATE_FUNCTION:
            fill_entries(p, columns, results, result + 1, A[row])


@helper
def fill_nonholonomic_gamma(p, results, Qa):
    """Evaluate the right-hand side of A a = Q_a."""
    for k in joint_places(p):
        kind, row, _, _, _, _, _, result = joint_at(p, k)
        if kind == RATE_FUNCTION:
            Qa[row] = results[result]
