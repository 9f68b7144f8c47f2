"""Run traced programs in compiled code; define their operations and the layout of their tables.

A traced program is the list of operations that a function does on symbols. If no callback computes C_q or Gamma, a
program does (generate/derived_callbacks.py). Programs also compute forces, prescribed motions and constraint rows that
the user of a model defines by functions (bodies/programs.py). The exact derivative of a function, such as tanh, may
overflow where the function does not: then the caller uses, for example, finite differences. `f`: kit, `w`: workspace.
"""

import math

from twoloop.kernels.data.common import compiled, exact

# kinds of operations. SUM is a sum of terms; RESULT is a sum of terms that is an output of the program. PENDING is a
# product x y of Taylor series without one term: coefficient k of the product omits the unknown coefficient k of y
PRODUCT, RECIPROCAL, SQUARE_ROOT, EXPONENTIAL, SINE, COSINE, LOGARITHM, ARCTANGENT, PENDING, SUM, RESULT = range(11)
# columns of the table of a program, which has one row for each operation. `nodes` are the numbers that the program
# reads and computes. Each argument of an operation is a constant plus terms; a term is a coefficient times a node.
# - KIND: kind of the operation, such as SINE; NODE: index of the operation's result in `nodes`
# - FIRST, SECOND, END: terms FIRST to SECOND - 1 of the list of terms make argument 1, SECOND to END - 1 argument 2
KIND, NODE, FIRST, SECOND, END, N_COLUMNS = range(6)
# A program is a vector of integers. It begins with the numbers of nodes, operations, terms and results, at the indices
# below. Three lists follow: for each operation, the numbers KIND to END; for each term, the index of the node that
# it multiplies; for each result, its index in w.Gamma or in the flattened C_q. The results are the last nodes
N_NODES, N_ROWS, N_TERMS, N_RESULTS, N_SIZES = range(5)


@exact
def result_of_operation(kind, x, y):
    """Return the result of an operation of a `kind`, such as SINE, on its arguments x and (only for PRODUCT) y."""
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
    """Return an argument of an operation: numbers[constant] plus the terms begin, ..., end - 1, see `run_table`."""
    total = numbers[constant]
    for k in range(begin, end):
        total = total + numbers[coefficients + k] * nodes[int(table[columns + k])]
    return total


@exact
def run_table(table, rows, n_rows, columns, numbers, coefficients, constants, nodes, inputs, t, q, v):
    """Do the operations of a program; store t, q, v (from index `inputs` on) and the results of operations in `nodes`.

    The vector `table` (integers, or floats without a fraction) contains a row for each operation; the first row begins
    at index `rows`. From index `columns` on, `table` contains the index of each term's node. The vector `numbers`
    contains the terms' coefficients from index `coefficients` on, and two constants per row from `constants` on.
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
    """Run a program that replaces a callback: store t, q, v and results in `nodes`; `numbers`: its constants."""
    n_rows = program[N_ROWS]
    columns = N_SIZES + N_COLUMNS * n_rows
    run_table(program, N_SIZES, n_rows, columns, numbers, 2 * n_rows, 0, nodes, 0, t, q, v)


@exact
def _result_indices(program):
    """Return n, the first index of n results in w.nodes, and where `program` lists their indices in the output."""
    n = program[N_RESULTS]
    return n, program[N_NODES] - n, N_SIZES + N_COLUMNS * program[N_ROWS] + program[N_TERMS]


@compiled
def gamma_by_program(f, w, t, q, v):
    """Store gamma in w.Gamma by a traced program; return False if no program exists, or a value is not finite."""
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
