"""Evaluation of the traced programs of a model, which are stored in its parameters."""

import numpy as np

from twoloop.kernels.compile.caches import helper
from twoloop.kernels.data.common import inlined
from twoloop.kernels.evaluation.operations import END, FIRST, KIND, MADE, N_COLUMNS, RESULT, SECOND
from twoloop.kernels.evaluation.program import operation

N_RESULTS, N_NODES, N_ROWS, N_TERMS, PROGRAM = range(5)


@helper
def total(nodes, first, p, columns, coefficients, constant, begin, end):
    """Return a constant plus a linear combination of nodes."""
    made = p[constant]
    for k in range(begin, end):
        made = made + p[coefficients + k] * nodes[first + int(p[columns + k])]
    return made


@helper
def fill_results(place, t, q, v, p, nodes):
    """Evaluate the results of the program at an index of p, followed by all its nodes."""
    first, n_rows, n_terms = int(p[place + N_RESULTS]), int(p[place + N_ROWS]), int(p[place + N_TERMS])
    rows = place + PROGRAM
    columns = rows + N_COLUMNS * n_rows
    coefficients = columns + n_terms
    constants = coefficients + n_terms
    nodes[first] = t
    for j in range(q.size):
        nodes[first + 1 + j] = q[j]
        nodes[first + 1 + q.size + j] = v[j]
    for i in range(n_rows):
        row = rows + N_COLUMNS * i
        kind, made = int(p[row + KIND]), int(p[row + MADE])
        begin, middle, end = int(p[row + FIRST]), int(p[row + SECOND]), int(p[row + END])
        x = total(nodes, first, p, columns, coefficients, constants + 2 * i, begin, middle)
        y = total(nodes, first, p, columns, coefficients, constants + 2 * i + 1, middle, end)
        if kind == RESULT:
            nodes[made] = x
        else:
            nodes[first + made] = operation(kind, x, y)


@inlined
def results_within(place, t, q, v, p):
    """Return the results of the program at an index of p, followed by all its nodes."""
    nodes = np.zeros(int(p[place + N_RESULTS]) + int(p[place + N_NODES]))
    fill_results(place, t, q, v, p, nodes)
    return nodes


results = results_within.py_func  # for Python


@helper
def result(made, place, order):
    """Return a derivative of a motion; zero if there is no motion."""
    if place < 0:
        return 0.0
    return made[place + order]
