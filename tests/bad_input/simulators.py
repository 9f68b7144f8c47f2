"""Simulators that are checked with wrong arguments, or return what is no motion."""

import numpy as np

from tests.bad_input.case import cases_of
from twoloop.testing import check_simulator, problems


def still(problem, times, tolerance):
    return np.tile(problem.q0, (times.size, 1))


def check(simulate=still, problems="pendulum", **options):
    return check_simulator(simulate, problems, **options)


def returns(make):
    """A check of a simulator that returns make(n_t, n_c)."""
    return check(lambda problem, times, tolerance: make(times.size, problem.n_c))


of_check, of_return, of_problems = cases_of("check_simulator"), cases_of("simulate"), cases_of("testing.problems")
ROWS, ARRAYS = "return a row for each of `times`", "return arrays of numbers: q, (q, v) or (q, v, lam)"
FALLING = "give tolerances such as (1e-4, 1e-6)"
MULTIPLES = "give numbers of steps such as (100, 200, 400)"
NAMES = "give 'smoke', 'all', or names of `problems()`"
SIMULATORS = [
    of_check("the path of a file", lambda: check("solver.py")).says("simulate must be a function of .*given 'solver.py' of type str", "import the function", TypeError),
    of_check("a simulator of the problem alone", lambda: check(lambda problem: None)).says(r"simulate is called as simulate\(problem, times, tolerance\); the function given takes \(problem\)", "take the three arguments", TypeError),
    of_check("a problem that is not there", lambda: check(problems="five_bar"), "problems must be.*'five_bar'", NAMES),
    of_check("a number among the problems", lambda: check(problems=["pendulum", 3]), "problems must be.*given 3", NAMES),
    of_check("a number of problems", lambda: check(problems=3), "problems must be a list; given 3", NAMES, TypeError),
    of_check("no problem", lambda: check(problems=[]), "problems must name at least one", NAMES),
    of_check("no tolerance", lambda: check(tolerances=[]), "tolerances must be numbers between 0 and 1", FALLING),
    of_check("one tolerance", lambda: check(tolerances=1e-6), "tolerances must be a list", "write [1e-6]", TypeError),
    of_check("a tolerance of 0", lambda: check(tolerances=[0.0]), "between 0 and 1; given .0.0.", FALLING),
    of_check("tolerances as text", lambda: check(tolerances=["1e-6"]), "tolerances must be numbers", FALLING),
    of_check("tolerances that grow", lambda: check(tolerances=[1e-6, 1e-4]), "tolerances must fall", FALLING),
    of_check("one number of steps", lambda: check(steps=[100]), "steps must be two or more", MULTIPLES),
    of_check("a number instead of steps", lambda: check(steps=100), "steps must be a list", MULTIPLES, TypeError),
    of_check("steps between the times", lambda: check(steps=[100, 250]), "each a multiple of 100", MULTIPLES),
    of_check("fewer and fewer steps", lambda: check(steps=[200, 100]), "two or more increasing numbers", MULTIPLES),
    of_check("steps in seconds", lambda: check(steps=[1e-2, 1e-3]), "two or more increasing numbers", MULTIPLES),
    of_check("an order without steps", lambda: check(order=4), "order is for simulators of fixed steps", MULTIPLES),
    of_check("an order of 0", lambda: check(steps=[100, 200], order=0.0), "order must be a positive", "leave it out"),
    of_check("an order as text", lambda: check(steps=[100, 200], order="4"), "order must be a positive", "write order=4"),
    of_check("no time", lambda: check(time_limit=0), "time_limit must be a positive number", "leave it out, or give None"),
    of_return("a column for each time", lambda: returns(lambda n, m: np.zeros((2, n)))).says(r"of shape \(101, 2\).*returned shape \(2, 101\) \(transpose it\)", "return q.T"),
    of_return("too many columns", lambda: returns(lambda n, m: np.zeros((n, 3))), r"returned shape \(101, 3\)", ROWS),
    of_return("one velocity for each time", lambda: returns(lambda n, m: (np.zeros((n, 2)), np.zeros(n)))).says("return v with a row for each time", ROWS),
    of_return("multipliers of another number").when(lambda: returns(lambda n, m: (np.zeros((n, 2)), None, np.zeros((n, 2))))).says(r"return lam .*\(101, 1\)", "return one for each row of C"),
    of_return("nothing", lambda: returns(lambda n, m: None), "it returned None", ARRAYS, TypeError),
    of_return("text", lambda: returns(lambda n, m: "done"), "arrays of numbers.*q is str", ARRAYS, TypeError),
    of_return("four things", lambda: returns(lambda n, m: (1, 2, 3, 4)), "a tuple of 4", ARRAYS, TypeError),
    of_return("complex numbers", lambda: returns(lambda n, m: np.full((n, 2), 1j))).says("arrays of numbers.*complex", "take the real part if that is meant", TypeError),
    of_problems("a tag that is not there", lambda: problems("curly"), "tags must be of smoke.*'curly'", "look at `problem.tags`"),
    of_problems("a number", lambda: problems(3), "tags must be a list; given 3", "give a tag", TypeError),
]
