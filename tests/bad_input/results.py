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


def remade(**changed):
    return replace(pendulum(), **changed)


def swept(problem_of=four_bar, parameters=({"theta3": 0.1},), **options):
    return sweep(problem_of, parameters, **{"t_span": (0.0, 1e-3), "parallel": "threads", **options})


of_result, of_certify = cases_of("result.to_dataframe, .energy, .plot, .animate"), cases_of("result.certify")
of_problem, of_sweep = cases_of("Problem and Drawing"), cases_of("sweep")
A_PROBLEM = "put the system into a `Problem` with an energy and a drawing, and solve `problem.system`"
ONE_BY_ONE = "let `problem_of` take `L1`, `L2`, `L3`"
RESULTS = [
    of_result("`energy` of a system without a problem", lambda: solve().energy, "knows no energy", A_PROBLEM),
    of_result("`animate` without a drawing", lambda: solve().animate("swing.gif"), "knows no drawing", A_PROBLEM),
    of_result('`animate("swing.avi")`', lambda: solve().animate("swing.avi")).says(r"path must end in .html, .gif, .mp4", "take one of the endings named"),
    of_result("`plot(3)`", lambda: solve().plot(3), "path must be a file name", "give a file name", TypeError),
    of_result("`plot('swing.avi')`", lambda: solve().plot("swing.avi"), r"path must end in .*\.png", "take one of the endings named"),
    of_result("`animate(None)`", lambda: solve().animate(None), "path must be a file name", "give a file name", TypeError),
    of_certify("a result of another solver, or of an older file").when(lambda: replace(solve(), rtol=None, atol=None).certify()).says("certify needs tolerances", "give `rtol` and `atol`"),
    of_certify("a result without its system", lambda: replace(solve(), system=None).certify()).says("certify needs the system", "`load(path, system)`, or `dataclasses.replace(result, system=system)`"),
    of_certify("`t_eval` of one time", lambda: solve(t_eval=[0.05]).certify()).says("certify needs a result with two times or more", "store more: `dense_output=True`, or a longer `t_eval`"),
    Case("citation", "another object", lambda: citation(linkage()), "citation needs a result", "give it a result", TypeError),
    of_problem("`name=3`", lambda: remade(name=3), "name must be a string; given 3", "give text", TypeError),
    of_problem("a mechanism as `system`", lambda: remade(system=pendulum())).says("system must be a ConstrainedSystem; given a Problem", "give problem.system", TypeError),
    of_problem("`system=3`", lambda: remade(system=3), "system must be a ConstrainedSystem", "give problem.system", TypeError),
    of_problem("`q0` of one number", lambda: remade(q0=[1.0]), r"q0 must have shape \(2,\)", "give one number for each coordinate"),
    of_problem("`v0` as text", lambda: remade(v0="fast"), "v0 must be an array of real numbers", "give numbers", TypeError),
    of_problem("`t_span=(1.0, 0.0)`", lambda: remade(t_span=(1.0, 0.0)), "t_span must be .* end > start", "exchange them"),
    of_problem("`energy=9.81`", lambda: remade(energy=9.81), "energy must be a function", "give energy(t, q, v)", TypeError),
    of_problem("an energy of the state alone", lambda: remade(energy=lambda q, v: 0.0)).says(r"energy is called as energy\(t, q, v\); the function given takes \(q, v\)", "take t, q and v", TypeError),
    of_problem("points of t and q", lambda: Drawing(lambda t, q: q[None], [])).says(r"points is called as points\(q\)", "take q", TypeError),
    of_problem("bars as `drawing`", lambda: remade(drawing=[(0, 1)])).says("drawing must be a twoloop.Drawing", "write twoloop.Drawing(points, bars)", TypeError),
    of_problem("two coordinates of one name", lambda: problem(coordinates=("x (m)", "x (m)"))).says("coordinates must be n_q = 2 different names", "name each coordinate"),
    of_problem("a bar to a point that is not there", lambda: problem(drawing=Drawing(bob, [(0, 1)]))).says("must name points from 0 to 0; they name 1", "count the points from 0"),
    of_problem("points of the wrong shape", lambda: problem(drawing=Drawing(np.sum, [(0, 1)]))).says(r"points of a drawing must give an array of shape \(n_points, 2 or 3\)", "give a row for each point"),
    of_problem("`bars=[0, 1]`", lambda: Drawing(bob, [0, 1]), "bars must be pairs", "write `bars=[(0, 1)]`", TypeError),
    of_sweep("a mapping of lists", lambda: swept(parameters={"theta3": [0.1, 0.2]})).says("parameters must be a list of mappings, one for each run", "make a mapping for each run", TypeError),
    of_sweep("a tuple as a parameter", lambda: swept(parameters=[{"lengths": (1.0, 2.0, 1.5)}])).says("must be a number, a string, True or False", ONE_BY_ONE, TypeError),
    of_sweep("a parameter that `problem_of` does not have", lambda: swept(parameters=[{"angle": 0.1}])).says(r"problem_of does not take parameters\[0\]", "name them as `problem_of` does", TypeError),
    of_sweep("`tol=1e-6`", lambda: swept(tol=1e-6), "sweep has no argument 'tol'", "give `rtol` and `atol`", TypeError),
    of_sweep("`t_span=(1.0, 0.0)`", lambda: swept(t_span=(1.0, 0.0)), "t_span must be .* end > start", "exchange them"),
    of_sweep("`out=3`", lambda: swept(out=3), "out must be a file name or a path; given 3", "give a file name", TypeError),
    of_sweep("a `problem_of` that returns a number", lambda: swept(lambda theta3: theta3)).says("problem_of must return a Problem; it returned 0.1", "return the problem", TypeError),
    of_sweep("`workers=0`", lambda: swept(workers=0), "workers must be at least 1", "leave it out: all cores"),
]
