"""SciPy's solvers and those with its interface, on the index-1 form or on the equations as they are."""
