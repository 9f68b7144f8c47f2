"""Kinds of operation that callbacks are traced to, and how programs of them are written down."""

# kinds of operation; PENDING: products whose second factors wait for the solution; RESULT: what a program is for
PRODUCT, RECIPROCAL, SQUARE_ROOT, EXPONENTIAL, SINE, COSINE, LOGARITHM, ARCTANGENT, PENDING, SUM, RESULT = range(11)
# columns of the program: kind, the node (or entry) that is made, and where the terms of two forms begin and end
KIND, MADE, FIRST, SECOND, END, N_COLUMNS = range(6)
# a program in one vector of integers: these, its rows, the nodes of all terms, and where each result belongs; results
# are the last nodes
N_NODES, N_ROWS, N_TERMS, N_RESULTS, HEAD = range(5)
