"""SUNDIALS' IDA and CVODE, through scikit-sundae and driven from C."""
