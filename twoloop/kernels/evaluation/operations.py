"""Kinds of operations of traced programs, and the layout of their tables for compiled kernels."""

# PENDING: products whose second factors become known with the solution of an order of a series. RESULT: outputs of a
# table
PRODUCT, RECIPROCAL, SQUARE_ROOT, EXPONENTIAL, SINE, COSINE, LOGARITHM, ARCTANGENT, PENDING, SUM, RESULT = range(11)
# columns of a row: the kind, the node (or entry) that it defines, and where the terms of its arguments begin and end
KIND, NODE, FIRST, SECOND, END, N_COLUMNS = range(6)
# a table as a vector of integers: these sizes, its rows, the nodes of all terms, and the entry of each result. Results
# are the last nodes
N_NODES, N_ROWS, N_TERMS, N_RESULTS, HEAD = range(5)
