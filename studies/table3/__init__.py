"""Table 3 of the paper: computation time of both two-loop procedures over their tolerances, and of other solvers."""

from studies.table3.study import main as main
