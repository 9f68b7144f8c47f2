"""Tables, figures, animations and sweeps that cannot be made."""

from dataclasses import replace

import numpy as np

from tests.bad_input.case import Case, cases_of, linkage, solve
from twoloop import Drawing, citation, sweep
from twoloop.mechanisms import Problem, four_bar, pendulum


def bob(q):
    return q[None]


def problem(**options):
    given = pendulum()
    return Problem("swing", given.system, given.q0, given.v0, (0.0, 1.0), given.energy, **options)


def swept(parameters=({"theta3": 0.1},), **options):
    return sweep(four_bar, parameters, **{"t_span": (0.0, 1e-3), "parallel": "threads", **options})


of_result, of_certify = cases_of("result.to_dataframe, .energy, .plot, .animate"), cases_of("result.certify")
of_problem, of_sweep = cases_of("Problem and Drawing"), cases_of("sweep")
A_PROBLEM = "put the system into a `Problem` with an energy and a drawing, and solve `problem.system`"
ONE_BY_ONE = "let `problem_of` take `L1`, `L2`, `L3`"
RESULTS = [
    of_result("`energy` of a system without a problem", lambda: solve().energy, "knows no energy", A_PROBLEM),
    of_result("`animate` without a drawing", lambda: solve().animate("swing.gif"), "knows no drawing", A_PROBLEM),
    of_result('`animate("swing.avi")`', lambda: solve().animate("swing.avi")).says(
        r"path must end in .html, .gif, .mp4", "choose one of these endings"
    ),
    of_certify("a result of another solver, or of an older file")
    .when(lambda: replace(solve(), rtol=None, atol=None).certify())
    .says("certify needs tolerances", "give `rtol` and `atol`"),
    of_certify("a result without its system", lambda: replace(solve(), system=None).certify()).says(
        "certify needs the system", "`load(path, system)`, or `dataclasses.replace(result, system=system)`"
    ),
    of_certify("`t_eval` of one time", lambda: solve(t_eval=[0.05]).certify()).says(
        "certify needs a result with two times or more", "store more: `dense_output=True`, or a longer `t_eval`"
    ),
    Case(
        "citation", "another object", lambda: citation(linkage()), "citation needs a result", "give it one", TypeError
    ),
    of_problem("two coordinates of one name", lambda: problem(coordinates=("x (m)", "x (m)"))).says(
        "coordinates must be n_q = 2 different names", "name each coordinate"
    ),
    of_problem("a bar to a point that is not there", lambda: problem(drawing=Drawing(bob, [(0, 1)]))).says(
        "must name points from 0 to 0; they name 1", "count the points from 0"
    ),
    of_problem("points of the wrong shape", lambda: problem(drawing=Drawing(np.sum, [(0, 1)]))).says(
        r"points of a drawing must give an array of shape \(n_points, 2 or 3\)", "give a row for each point"
    ),
    of_problem("`bars=[0, 1]`", lambda: Drawing(bob, [0, 1]), "bars must be pairs", "write `bars=[(0, 1)]`", TypeError),
    of_sweep("a mapping of lists", lambda: swept(parameters={"theta3": [0.1, 0.2]})).says(
        "parameters must be a list of mappings, one for each run", "make a mapping for each run", TypeError
    ),
    of_sweep("a tuple as a parameter", lambda: swept(parameters=[{"lengths": (1.0, 2.0, 1.5)}])).says(
        "must be a number, a string, True or False", ONE_BY_ONE, TypeError
    ),
    of_sweep("a parameter that `problem_of` does not have", lambda: swept(parameters=[{"angle": 0.1}])).says(
        r"problem_of does not take parameters\[0\]", "name them as `problem_of` does", TypeError
    ),
    of_sweep("`tol=1e-6`", lambda: swept(tol=1e-6), "sweep has no argument 'tol'", "give `rtol` and `atol`", TypeError),
    of_sweep("`workers=0`", lambda: swept(workers=0), "workers must be at least 1", "leave it out: all cores"),
]
