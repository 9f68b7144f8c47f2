"""Evaluation of the traced programs of a model, which are stored in its parameters."""

import numpy as np

from twoloop.kernels.compile.caches import helper
from twoloop.kernels.data.common import inlined
from twoloop.kernels.evaluation.operations import N_COLUMNS, run_table

N_RESULTS, N_NODES, N_ROWS, N_TERMS, PROGRAM = range(5)  # sizes in front of a program; nodes follow its results


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


results = results_within.py_func  # for Python


@helper
def result(values, place, order):
    """Return a derivative of a motion; zero if there is no motion."""
    if place < 0:
        return 0.0
    return values[place + order]
