"""SciPy's solvers and solvers with its interface, on the index-1 form or on the implicit equations."""
