"""Wrong options of methods and tableaux."""

from functools import partial

import numpy as np

from tests.bad_input.case import FEW_POSITIVES, HUGE, INFINITE, POSITIVE, argument, cases_of
from twoloop import BDF, DOP853, Newmark, RungeKutta, Taylor, paper_irk, paper_newmark
from twoloop.methods.tableaux import Tableau, gauss, lobatto_iiie, radau_iia, sun_radau_iib


def runge_kutta(**options):
    return RungeKutta(gauss(2), **options)


EXPLICIT = Tableau("Heun", [[0.0, 0.0], [1.0, 0.0]], [0.5, 0.5], [0.0, 1.0], 2)
DOUBLE = Tableau("double", [[0.25, 0.25], [0.25, 0.25]], [0.5, 0.5], [0.5, 0.5], 2)


def tableau(**changed):
    right = {"name": "midpoint", "A": [[0.5]], "b": [1.0], "c": [0.5], "order": 2}
    return Tableau(**{**right, **changed})


STAGES = "give the number of stages, an int"
UNIT = "give a number from 0 to 1"
of_runge_kutta = cases_of("RungeKutta")
of_option = partial(argument, "RungeKutta", runge_kutta)
of_tableau = partial(argument, "Tableau", tableau)
of_newmark = partial(argument, "Newmark", Newmark)
METHODS = [
    *argument(
        "RungeKutta",
        lambda tableau: RungeKutta(tableau),
        "tableau",
        (None, TypeError, r"must be a twoloop.methods.tableaux.Tableau.*given None", "give gauss(3), say"),
        ("Gauss6", TypeError, "must be a twoloop.methods.tableaux.Tableau.*given 'Gauss6'", "give gauss(3), say"),
        (DOUBLE, ValueError, "must have distinct nodes", "take another tableau"),
    ),
    of_runge_kutta("an explicit tableau with `outer='newton'`", lambda: RungeKutta(EXPLICIT, outer="newton")).says("tableau must have an invertible A.*Heun.*fixed-point", "take outer='fixed-point'"),
    *of_option("outer", ("n", ValueError, "must be 'auto', 'fixed-point', 'newton' or 'paper'; given 'n'", "take one of the values named"), (None, TypeError, "must be .*given None", "leave it out")),
    *of_option("error", ("none", ValueError, "must be 'richardson'", "take one of the values named")),
    *of_option("partition", (1, TypeError, "must be 'lasting'", "take one of the values named")),
    *of_option("partition", ("no", ValueError, "must be 'lasting'.*'symmetric'; given 'no'", "take one of the values named")),
    *of_option("outer_test", (1, TypeError, "must be 'all'", "take one of the values named")),
    *of_option("inner_tol", *FEW_POSITIVES),
    *of_option("outer_tol", *FEW_POSITIVES, INFINITE, (np.nan, ValueError, "must be positive", POSITIVE)),
    of_runge_kutta("`outer='paper', partition='symmetric'`").when(lambda: runge_kutta(outer="paper", partition="symmetric")).says("outer='paper' is the paper's procedure", "take outer='fixed-point' for symmetric partitions"),
    *of_newmark(
        "beta",
        (2.0, ValueError, "must be between 0 and 1; given 2.0", UNIT),
        (-0.1, ValueError, "must be between 0 and 1; given -0.1", UNIT),
        (np.nan, ValueError, "must be between 0 and 1; given nan", UNIT),
        ("1/4", TypeError, "must be a number; given '1/4'", UNIT),
        (True, TypeError, "must be a number; given True", UNIT),
        (HUGE, ValueError, "must fit into a float", UNIT),
    ),
    *of_newmark("gamma", *[(gamma, ValueError, "must be between 0 and 1; given", UNIT) for gamma in (-0.5, 1.5)]),
    *of_newmark("error_tol", *FEW_POSITIVES),
    *argument(
        "BDF",
        BDF,
        "max_order",
        (0, ValueError, "must be at least 1; given 0", "give an int from 1 to 5"),
        (6, ValueError, "must be at most 5; given 6", "give an int from 1 to 5"),
        (2.0, TypeError, "must be an int; given 2.0", "give an int from 1 to 5"),
        (True, TypeError, "must be an int; given True", "give an int from 1 to 5"),
        ("5", TypeError, "must be an int; given '5'", "give an int from 1 to 5"),
    ),
    *argument("BDF", BDF, "outer_tol", *FEW_POSITIVES[:2]),
    *argument("BDF", BDF, "inner_tol", *FEW_POSITIVES[:1]),
    *argument("Taylor", Taylor, "order", (3, ValueError, "must be", "give an int from 4 to 40"), (41, ValueError, "must be", "give an int from 4 to 40"), (8.5, TypeError, "must be", "give an int from 4 to 40"), ("high", TypeError, "must be", "give an int from 4 to 40")),
    *argument("DOP853", DOP853, "inner_tol", *FEW_POSITIVES),
    *argument("paper_irk", paper_irk, "inner_tol", *FEW_POSITIVES[:2]),
    *argument("paper_newmark", paper_newmark, "beta", (2.0, ValueError, "must be between 0 and 1", UNIT)),
    *(case for family in (gauss, radau_iia, sun_radau_iib, lobatto_iiie) for case in argument(family.__name__, family, "s", (0, ValueError, "must be at least [12]", STAGES), (2.0, TypeError, "must be an int", STAGES))),
    *argument("lobatto_iiie", lobatto_iiie, "s", (1, ValueError, "must be at least 2", STAGES)),
    *argument("gauss", gauss, "s", (True, TypeError, "must be an int", STAGES), ("3", TypeError, "must be", STAGES)),
    *argument("gauss", gauss, "s", (HUGE, ValueError, "must be at most 100", "give a moderate number")),
    *of_tableau("name", (3, TypeError, "must be a string; given 3", "give a string")),
    *of_tableau(
        "A",
        ([[0.5, 0.0]], ValueError, r"must have shape \(1, 1\).*given shape \(1, 2\)", "give s rows and columns"),
        (0.5, ValueError, r"must have shape \(1, 1\)", "give s rows and columns"),
        ([[np.nan]], ValueError, r"must be finite; entries \[\[0, 0\]\] are not", "give finite coefficients"),
        ([["1/2"]], TypeError, "must be an array of real numbers", "give numbers"),
        ([[True]], TypeError, "must be an array of real numbers", "give numbers"),
    ),
    *of_tableau("b", ([], ValueError, "must be a vector with one weight for each stage", "give s weights"), ([0.9], ValueError, "must sum to 1; the sum of .* is 0.9", "give weights that sum to 1"), ([np.inf], ValueError, "must be finite", "give finite coefficients")),
    *of_tableau("c", ([0.5, 1.0], ValueError, r"must have shape \(1,\)", "give s nodes"), ([0.25], ValueError, r"must be the row sums of A.*row 0 of A sums to 0.5, and c\[0\] is 0.25", "give A @ ones")),
    *of_tableau("order", (0, ValueError, "must be at least 1; given 0", "give the classical order"), (2.5, TypeError, "must be an int; given 2.5", "give the classical order")),
]
