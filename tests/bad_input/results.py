"""Tables, figures, animations and sweeps that cannot be made."""

from dataclasses import replace

import numpy as np

from tests.bad_input.case import Case, linkage, solve
from twoloop import Drawing, citation, sweep
from twoloop.mechanisms import Problem, four_bar, pendulum


def bob(q):
    return q[None]


def problem(**options):
    given = pendulum()
    return Problem("swing", given.system, given.q0, given.v0, (0.0, 1.0), given.energy, **options)


def swept(problem_of=four_bar, parameters=({"theta3": 0.1},), **options):
    return sweep(problem_of, parameters, **{"t_span": (0.0, 1e-3), "parallel": "threads", **options})


def of_result(what, call, words, advice):
    return Case("result.to_dataframe, .energy, .plot, .animate", what, call, ValueError, words, advice)


def of_certify(what, call, words, advice):
    return Case("result.certify", what, call, ValueError, words, advice)


def of_problem(what, call, error, words, advice):
    return Case("Problem and Drawing", what, call, error, words, advice)


def of_sweep(what, call, error, words, advice):
    return Case("sweep", what, call, error, words, advice)


A_PROBLEM = "put the system into a `Problem` with an energy and a drawing, and solve `problem.system`"
ONE_BY_ONE = "let `problem_of` take `L1`, `L2`, `L3`"
RESULTS = [
    of_result("`energy` of a system without a problem", lambda: solve().energy, "knows no energy", A_PROBLEM),
    of_result("`animate` without a drawing", lambda: solve().animate("swing.gif"), "knows no drawing", A_PROBLEM),
    of_result(
        '`animate("swing.avi")`',
        lambda: solve().animate("swing.avi"),
        r"path must end in .html, .gif, .mp4",
        "choose one of these endings",
    ),
    of_certify(
        "a result of another solver, or of an older file",
        lambda: replace(solve(), rtol=None, atol=None).certify(),
        "certify needs tolerances",
        "give `rtol` and `atol`",
    ),
    of_certify(
        "a result without its system",
        lambda: replace(solve(), system=None).certify(),
        "certify needs the system",
        "`load(path, system)`, or `dataclasses.replace(result, system=system)`",
    ),
    of_certify(
        "`t_eval` of one time",
        lambda: solve(t_eval=[0.05]).certify(),
        "certify needs a result with two times or more",
        "store more: `dense_output=True`, or a longer `t_eval`",
    ),
    Case(
        "citation", "another object", lambda: citation(linkage()), TypeError, "citation needs a result", "give it one"
    ),
    of_problem(
        "two coordinates of one name",
        lambda: problem(coordinates=("x (m)", "x (m)")),
        ValueError,
        "coordinates must be n_q = 2 different names",
        "name each coordinate",
    ),
    of_problem(
        "a bar to a point that is not there",
        lambda: problem(drawing=Drawing(bob, [(0, 1)])),
        ValueError,
        "must name points from 0 to 0; they name 1",
        "count the points from 0",
    ),
    of_problem(
        "points of the wrong shape",
        lambda: problem(drawing=Drawing(np.sum, [(0, 1)])),
        ValueError,
        r"points of a drawing must give an array of shape \(n_points, 2 or 3\)",
        "give a row for each point",
    ),
    of_problem("`bars=[0, 1]`", lambda: Drawing(bob, [0, 1]), TypeError, "bars must be pairs", "write `bars=[(0, 1)]`"),
    of_sweep(
        "a mapping of lists",
        lambda: swept(parameters={"theta3": [0.1, 0.2]}),
        TypeError,
        "parameters must be a list of mappings, one for each run",
        "make a mapping for each run",
    ),
    of_sweep(
        "a tuple as a parameter",
        lambda: swept(parameters=[{"lengths": (1.0, 2.0, 1.5)}]),
        TypeError,
        "must be a number, a string, True or False",
        ONE_BY_ONE,
    ),
    of_sweep(
        "a parameter that `problem_of` does not have",
        lambda: swept(parameters=[{"angle": 0.1}]),
        TypeError,
        r"problem_of does not take parameters\[0\]",
        "name them as `problem_of` does",
    ),
    of_sweep("`tol=1e-6`", lambda: swept(tol=1e-6), TypeError, "sweep has no argument 'tol'", "give `rtol` and `atol`"),
    of_sweep(
        "`workers=0`", lambda: swept(workers=0), ValueError, "workers must be at least 1", "leave it out: all cores"
    ),
]
