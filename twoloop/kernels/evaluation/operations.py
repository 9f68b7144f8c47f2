"""Define the operations of traced programs and the layout of their tables, and run programs in compiled code.

Programs compute C_q and Gamma if no callback computes them (generate/derived_callbacks.py), and forces, prescribed
motions and constraint rows that the user of a model defines by functions (bodies/programs.py). An exact derivative may
overflow where the function itself does not, for example the derivative of tanh. `f` is the kit, `w` the workspace.
"""

import math

from twoloop.kernels.data.common import compiled, exact

# kinds of operations. PENDING: product of two Taylor series, of which the coefficient of each order of the second is
# unknown until the linear equations of this order are solved. RESULT: output of a program
PRODUCT, RECIPROCAL, SQUARE_ROOT, EXPONENTIAL, SINE, COSINE, LOGARITHM, ARCTANGENT, PENDING, SUM, RESULT = range(11)
# columns of a table, which has one row for each operation. KIND: kind of the operation. NODE: index of the node (for
# RESULT: of the output) that it computes. FIRST, SECOND, END: the first argument of the operation is the sum of the
# terms FIRST to SECOND - 1, the second argument of the terms SECOND to END - 1
KIND, NODE, FIRST, SECOND, END, N_COLUMNS = range(6)
# A program is a vector of integers: N_SIZES sizes (at the indices below), the rows of the table, the node of each term,
# and the index of each result in its array. Results are numbered after all other nodes
N_NODES, N_ROWS, N_TERMS, N_RESULTS, N_SIZES = range(5)


@exact
def result_of_operation(kind, x, y):
    """Return the result of the operation `kind`, such as SINE, on x; y is the second factor of a product."""
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
def affine_sum(nodes, table, columns, numbers, coefficients, constant, begin, end):
    """Return numbers[constant] plus the sum of coefficient times node over the terms `begin` to `end` - 1.

    `columns` and `coefficients` are as in `run_table`.
    """
    total = numbers[constant]
    for k in range(begin, end):
        total = total + numbers[coefficients + k] * nodes[int(table[columns + k])]
    return total


@exact
def run_table(table, rows, n_rows, columns, numbers, coefficients, constants, nodes, inputs, t, q, v):
    """Compute all `nodes` from t, q and v, which become the input nodes, beginning with index `inputs`.

    The table contains integers, or whole floats if it is among the parameters of a model. `rows` and `columns` are the
    first indices of the operations and of the terms' nodes in `table`; `coefficients` and `constants` are the first
    indices of these numbers in `numbers`.
    """
    nodes[inputs] = t
    for j in range(q.size):
        nodes[inputs + 1 + j] = q[j]
        nodes[inputs + 1 + q.size + j] = v[j]
    for i in range(n_rows):
        row = rows + N_COLUMNS * i
        begin, middle, end = int(table[row + FIRST]), int(table[row + SECOND]), int(table[row + END])
        x = affine_sum(nodes, table, columns, numbers, coefficients, constants + 2 * i, begin, middle)
        y = affine_sum(nodes, table, columns, numbers, coefficients, constants + 2 * i + 1, middle, end)
        nodes[int(table[row + NODE])] = result_of_operation(int(table[row + KIND]), x, y)


@exact
def _run_program(program, numbers, nodes, t, q, v):
    """Compute all `nodes` of a program that replaces a callback of a system, from the inputs t, q and v."""
    n_rows = program[N_ROWS]
    columns = N_SIZES + N_COLUMNS * n_rows
    run_table(program, N_SIZES, n_rows, columns, numbers, 2 * n_rows, 0, nodes, 0, t, q, v)


@exact
def _result_indices(program):
    """Return the number of results, the index of the first result in `nodes`, and where the list of indices begins."""
    n = program[N_RESULTS]
    return n, program[N_NODES] - n, N_SIZES + N_COLUMNS * program[N_ROWS] + program[N_TERMS]


@compiled
def gamma_by_program(f, w, t, q, v):
    """Store Gamma in w.Gamma by a traced program; return False if there is no program, or a value is not finite."""
    program = f.gamma_program
    if program.size == 0:
        return False
    _run_program(program, f.gamma_numbers, w.nodes, t, q, v)
    n, first, indices = _result_indices(program)
    for k in range(n):
        if not math.isfinite(w.nodes[first + k]):
            return False
        w.Gamma[program[indices + k]] = w.nodes[first + k]
    return True


@compiled
def jacobian_by_program(f, w, t, q, G):
    """Store C_q in G (zero on entry) by a traced program; return False if there is none, or a value is not finite."""
    program = f.jacobian_program
    if program.size == 0:
        return False
    _run_program(program, f.jacobian_numbers, w.nodes, t, q, q)
    n, first, indices = _result_indices(program)
    for k in range(n):
        if not math.isfinite(w.nodes[first + k]):
            return False
    for k in range(n):
        index = program[indices + k]
        G[index // q.size, index % q.size] = w.nodes[first + k]
    return True
