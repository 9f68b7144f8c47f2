"""C_q and Gamma by what callbacks were traced to, where they are not given: see generate/derived.py.

An exact derivative may overflow where the callback does not, as that of tanh does for large numbers.
"""

import math

from twoloop.kernels.data.common import compiled, exact
from twoloop.kernels.evaluation import operations as op


@exact
def operation(kind, x, y):
    """The result of an operation; y is the second factor of a product."""
    if kind == op.PRODUCT:
        z = x * y
    elif kind == op.RECIPROCAL:
        z = 1.0 / x
    elif kind == op.SQUARE_ROOT:
        z = math.sqrt(x)
    elif kind == op.EXPONENTIAL:
        z = math.exp(x)
    elif kind == op.SINE:
        z = math.sin(x)
    elif kind == op.COSINE:
        z = math.cos(x)
    elif kind == op.LOGARITHM:
        z = math.log(x)
    elif kind == op.ARCTANGENT:
        z = math.atan(x)
    else:
        z = x
    return z


@exact
def _sum(program, numbers, nodes, terms, coefficients, constant, begin, end):
    """A form: a constant and multiples of nodes."""
    total = constant
    for k in range(begin, end):
        total += numbers[coefficients + k] * nodes[program[terms + k]]
    return total


@exact
def _run(program, numbers, nodes, t, q, v):
    """Make all nodes from t, q and v."""
    n, n_rows = q.size, program[op.N_ROWS]
    terms, coefficients = op.HEAD + op.N_COLUMNS * n_rows, 2 * n_rows
    nodes[0] = t
    for j in range(n):
        nodes[1 + j] = q[j]
        nodes[1 + n + j] = v[j]
    for i in range(n_rows):
        row = op.HEAD + op.N_COLUMNS * i
        begin, middle, end = program[row + op.FIRST], program[row + op.SECOND], program[row + op.END]
        kind, made = program[row + op.KIND], program[row + op.MADE]
        x = _sum(program, numbers, nodes, terms, coefficients, numbers[2 * i], begin, middle)
        y = _sum(program, numbers, nodes, terms, coefficients, numbers[2 * i + 1], middle, end)
        nodes[made] = operation(kind, x, y)


@exact
def _results(program):
    """How many results there are, at which node they begin, and where it stands to what they belong."""
    n = program[op.N_RESULTS]
    return n, program[op.N_NODES] - n, op.HEAD + op.N_COLUMNS * program[op.N_ROWS] + program[op.N_TERMS]


@compiled
def gamma_by_program(f, w, t, q, v):
    """Rows of Gamma that no callback gives, into w.Gamma; whether there is a program and all are finite."""
    program = f.gamma_program
    if program.size == 0:
        return False
    _run(program, f.gamma_numbers, w.nodes, t, q, v)
    n, first, places = _results(program)
    for k in range(n):
        if not math.isfinite(w.nodes[first + k]):
            return False
        w.Gamma[program[places + k]] = w.nodes[first + k]
    return True


@compiled
def jacobian_by_program(f, w, t, q, G):
    """C_q at (t, q) into the first rows of G, full of zeros; whether there is a program and all is finite."""
    program = f.jacobian_program
    if program.size == 0:
        return False
    _run(program, f.jacobian_numbers, w.nodes, t, q, q)
    n, first, places = _results(program)
    for k in range(n):
        if not math.isfinite(w.nodes[first + k]):
            return False
    for k in range(n):
        place = program[places + k]
        G[place // q.size, place % q.size] = w.nodes[first + k]
    return True
