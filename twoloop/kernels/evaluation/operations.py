"""Operations of traced programs: their kinds, the layout of their tables, and an interpreter in compiled code.

Programs compute C_q and Gamma if no callback computes them (generate/derived_callbacks.py), and forces, motions and
rows that the user of a model gives as functions (bodies/program_results.py). An exact derivative may overflow where the
function does not, for example that of tanh at large arguments.
"""

import math

from twoloop.kernels.data.common import compiled, exact

# kinds of operations. PENDING: product in a Taylor series whose second factor is known only after the linear equations
# of the present order are solved. RESULT: output of a program
PRODUCT, RECIPROCAL, SQUARE_ROOT, EXPONENTIAL, SINE, COSINE, LOGARITHM, ARCTANGENT, PENDING, SUM, RESULT = range(11)
# columns of a table, a row of which is an operation: kind; index of its result among the nodes (or among the results);
# first term of its first argument, first term of its second argument, and end of the terms of the second
KIND, NODE, FIRST, SECOND, END, N_COLUMNS = range(6)
# a program is a vector of integers: the sizes N_NODES to N_RESULTS, the rows of the table, the node of each term, and
# the index of each result in its array; the last nodes are the results
N_NODES, N_ROWS, N_TERMS, N_RESULTS, HEAD = range(5)


@exact
def operation(kind, x, y):
    """Return the result of an operation; y is the second factor of a product."""
    if kind == PRODUCT:
        z = x * y
    elif kind == RECIPROCAL:
        z = 1.0 / x
    elif kind == SQUARE_ROOT:
        z = math.sqrt(x)
    elif kind == EXPONENTIAL:
        z = math.exp(x)
    elif kind == SINE:
        z = math.sin(x)
    elif kind == COSINE:
        z = math.cos(x)
    elif kind == LOGARITHM:
        z = math.log(x)
    elif kind == ARCTANGENT:
        z = math.atan(x)
    else:
        z = x
    return z


@exact
def affine(nodes, table, columns, numbers, coefficients, constant, begin, end):
    """Return numbers[constant] plus the sum of coefficient times node for the terms begin to end."""
    total = numbers[constant]
    for k in range(begin, end):
        total = total + numbers[coefficients + k] * nodes[int(table[columns + k])]
    return total


@exact
def run_table(table, rows, n_rows, columns, numbers, coefficients, constants, nodes, inputs, t, q, v):
    """Compute all nodes of a table from its inputs t, q and v, which become the nodes from index `inputs` on.

    The table contains integers, or whole floats if it is among the parameters of a model. `rows` and `columns` are
    indices in the table, `coefficients` and `constants` indices in `numbers`.
    """
    nodes[inputs] = t
    for j in range(q.size):
        nodes[inputs + 1 + j] = q[j]
        nodes[inputs + 1 + q.size + j] = v[j]
    for i in range(n_rows):
        row = rows + N_COLUMNS * i
        begin, middle, end = int(table[row + FIRST]), int(table[row + SECOND]), int(table[row + END])
        x = affine(nodes, table, columns, numbers, coefficients, constants + 2 * i, begin, middle)
        y = affine(nodes, table, columns, numbers, coefficients, constants + 2 * i + 1, middle, end)
        nodes[int(table[row + NODE])] = operation(int(table[row + KIND]), x, y)


@exact
def _run_program(program, numbers, nodes, t, q, v):
    """Compute all nodes of a system's program."""
    n_rows = program[N_ROWS]
    columns = HEAD + N_COLUMNS * n_rows
    run_table(program, HEAD, n_rows, columns, numbers, 2 * n_rows, 0, nodes, 0, t, q, v)


@exact
def _results(program):
    """Return the number of results, the first node that is a result, and where their indices begin in the program."""
    n = program[N_RESULTS]
    return n, program[N_NODES] - n, HEAD + N_COLUMNS * program[N_ROWS] + program[N_TERMS]


@compiled
def gamma_by_program(f, w, t, q, v):
    """Compute the rows of Gamma that no callback computes; return whether there is a program and all are finite."""
    program = f.gamma_program
    if program.size == 0:
        return False
    _run_program(program, f.gamma_numbers, w.nodes, t, q, v)
    n, first, indices = _results(program)
    for k in range(n):
        if not math.isfinite(w.nodes[first + k]):
            return False
        w.Gamma[program[indices + k]] = w.nodes[first + k]
    return True


@compiled
def jacobian_by_program(f, w, t, q, G):
    """Compute C_q into the first rows of G, full of zeros; return whether there is a program and all is finite."""
    program = f.jacobian_program
    if program.size == 0:
        return False
    _run_program(program, f.jacobian_numbers, w.nodes, t, q, q)
    n, first, indices = _results(program)
    for k in range(n):
        if not math.isfinite(w.nodes[first + k]):
            return False
    for k in range(n):
        index = program[indices + k]
        G[index // q.size, index % q.size] = w.nodes[first + k]
    return True
