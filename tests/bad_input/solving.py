"""Wrong arguments of solve_dae."""

from functools import partial

import numpy as np

from tests.bad_input import case
from tests.problems import pendulum
from twoloop import ConstrainedSystem, Newmark, solve_dae
from twoloop.methods.tableaux import gauss

of_solve = case.cases_of("solve_dae")
of_argument = partial(case.argument, "solve_dae", case.solve)


def latch():
    """A force that keeps the latest time at which it was called."""
    latest = [0.0]

    def force(t, q, v):
        latest[0] = max(t, latest[0])
        return np.array([0.0, -latest[0]])

    return force


SOLVE = [
    *of_argument("q0", *case.VECTORS),
    *of_argument("v0", *case.FEW_VECTORS),
    *of_argument(
        "t_span",
        ((1.0, 0.0), ValueError, r"must be \(start, end\) with end > start; given \(1.0, 0.0\)", "swap them"),
        ((1.0, 1.0), ValueError, "must be .* with end > start", "give an end after the start"),
        ((1e6, 1e6 + 1e-10), ValueError, "must be .* further apart than floating-point", "count t from the start"),
        ((0.0, np.nan), ValueError, "must be finite", "give two finite times"),
        ((0.0, np.inf), ValueError, "must be finite", "give two finite times"),
        ((0.0, 1.0, 2.0), ValueError, r"must have shape \(2,\).*given .*2.0\].*t_eval", "output times go into t_eval"),
        (1.0, ValueError, r"must have shape \(2,\).*given the number 1.0: give both", "give (start, end)"),
        (("now", "then"), TypeError, "must be an array of real numbers", "give seconds"),
        ((False, True), TypeError, "must be an array of real numbers", "write 0.0 and 1.0"),
        ((0, case.HUGE), ValueError, "must hold numbers that fit into a float", "give two finite times"),
        (None, TypeError, "must be an array of real numbers", "give (start, end)"),
        (case.DAYS, TypeError, "must be an array of real numbers", "give seconds"),
    ),
    *of_argument(
        "t_eval",
        ([0.5, 1.5], ValueError, r"must lie within t_span = \(0.0, 1.0\).*to 1.5", "keep within t_span"),
        ([-0.1, 0.5], ValueError, "must lie within t_span.*from -0.1", "keep within t_span"),
        ([0.5, 0.2], ValueError, r"must be strictly increasing; entry 1 \(0.2\) follows 0.5", "sort them"),
        ([0.2, 0.2], ValueError, "must be strictly increasing", "give each time once"),
        ([], ValueError, "must be a non-empty", "leave it out to get every step"),
        ([[0.1, 0.2]], ValueError, r"must be a non-empty one-dim.*given shape .*\[\[0.1, 0.2\]\]", "ravel() it"),
        (0.5, ValueError, "must be a non-empty one-dimensional array; given the number 0.5", "give a list: [0.5]"),
        ([0.1, np.nan], ValueError, r"must be finite; entries \[1\] .*given \[nan\]", "find out where the NaN comes from"),
        (["soon"], TypeError, "must be an array of real numbers", "give seconds"),
        ([0.5 + 1.0j], TypeError, "must be an array of real numbers", "give seconds"),
        ([False, True], TypeError, "must be an array of real numbers", "give seconds"),
        (case.DAYS, TypeError, "must be an array of real numbers", "give seconds"),
        (case.MASKED, TypeError, "must be an array of real numbers; given a masked", "fill the gaps with filled()"),
        ([0.5, case.HUGE], ValueError, "must hold numbers that fit into a float", "keep within t_span"),
        ([0.5, 1.0 - 1e-16], ValueError, "must not come within rounding.*given 0.99999", "give the end itself"),
    ),
    of_solve("`t_eval=[0.2, 0.25]` with `step_size=0.1`", lambda: case.solve(t_eval=[0.2, 0.25], step_size=0.1)).says(r"t_eval must hold multiples of step_size = 0.1.*0.25", "give times on the fixed grid, or leave step_size out"),
    *of_argument("rtol", *case.POSITIVES, case.INFINITE, case.LIST, case.NONE),
    *of_argument("atol", *case.POSITIVES, case.INFINITE, case.SHORT_ATOL),
    *of_argument(
        "atol",
        ([1e-6, 0.0], case.WRONG, "must be", "give positive tolerances"),
        ([1e-6, np.nan], case.WRONG, "must be", "give positive tolerances"),
        ([True, True], case.WRONG, "must be", "give positive tolerances"),
        (["small", "small"], case.WRONG, "must be", "give positive tolerances"),
    ),
    of_solve("`rtol=1e-20, atol=1e-20`", lambda: case.solve(rtol=1e-20, atol=1e-20)).says("rtol and atol must not both be below", "raise one of them to 1e-15 or more"),
    *of_argument("time_limit", *case.POSITIVES[:4]),
    *of_argument("first_step", *case.FEW_POSITIVES, case.INFINITE),
    *of_argument("max_step", *case.FEW_POSITIVES, (None, TypeError, "must be a number", "leave it out")),
    *of_argument("step_size", *case.FEW_POSITIVES, case.INFINITE, (2.0, ValueError, "must not exceed the length of t_span, 1; given 2.0", "give a smaller step")),
    of_solve("`step_size=0.1, first_step=0.1`", lambda: case.solve(step_size=0.1, first_step=0.1)).says("step_size is a constant step.*first_step = 0.1", "give step_size alone"),
    of_solve("`step_size=0.1, max_step=0.1`", lambda: case.solve(step_size=0.1, max_step=0.1)).says("step_size is a constant step.*max_step = 0.1", "give step_size alone"),
    *of_argument(
        "max_steps",
        (0, ValueError, "must be at least 1; given 0", "leave it out for no limit"),
        (-3, ValueError, "must be at least 1; given -3", "leave it out for no limit"),
        (10.0, TypeError, "must be an int; given 10.0", "give an int"),
        (True, TypeError, "must be an int; given True", "give an int"),
        ("many", TypeError, "must be an int; given 'many'", "give an int"),
        (case.HUGE, ValueError, "must fit into 64 bits", "leave it out for no limit"),
    ),
    *of_argument("method", ("RK45", ValueError, "must be one of auto.*given 'RK45'", "take one of the names listed"), (None, TypeError, "must be a name .*given None", "leave it out for the default"), (5, TypeError, "must be a name .*given 5", "take a name or a method object")),
    of_solve("`method=Newmark`, the class", lambda: case.solve(method=Newmark)).says("method must be a name .*or an object", "write Newmark()", TypeError),
    of_solve("`method=gauss(2)`, a tableau", lambda: case.solve(method=gauss(2))).says("method must be a name .*or an object", "write RungeKutta(gauss(2))", TypeError),
    *of_argument("compiled", ("yes", ValueError, "must be True, False or 'auto'; given 'yes'", "take one of the values named"), (1, TypeError, "must be True, False or 'auto'; given 1", "take one of the values named")),
    *(
        of_solve(f"`compiled=True` with `method='{method}'`").when(lambda method=method: case.solve(method=method, compiled=True)).says(f"compiled=True goes with 'auto', .*given method {name}", "leave it out, or take a method that is named")
        for method, name in (("RadauIIA5", "Radau IIA"), ("Gauss4", "Gauss"), ("PaperIRK", "Sun"), ("BDF", "BDF"))
    ),
    of_solve("`compiled=True` with `step_size` and the default method").when(lambda: case.solve(step_size=0.1, compiled=True)).says("compiled=True goes with .*given method auto with step_size", "name a method, or leave one of the two out"),
    of_solve(
        "`compiled=True` where a callback branches on q",
        lambda: case.solve(pendulum(force=lambda t, q, v: np.array([0.0, -9.81 if q[0] > 0.0 else -1.0])), compiled=True),
        "compiled=True needs equations .*force of 'pendulum': it branches",
        "leave it out, or write the callback without `if`, `abs`, `max`",
    ),
    of_solve("a force in Python that draws random numbers, or keeps what it did before")
    .when(lambda: case.solve(pendulum(force=latch())))
    .says("force of 'pendulum' gives something else when it is called again with the same t, q and v", "let it depend on its arguments alone; a controller that samples sets inputs of `Integrator.step`; steps of a constant size (`step_size`) are not checked"),
    of_solve("a `Problem` as `system`", lambda: case.solve(case.linkage())).says(r"system must be a ConstrainedSystem.*problem\.system", "give problem.system", TypeError),
    *case.argument(
        "solve_dae",
        lambda system: solve_dae(system, (0.0, 1.0), case.Q0, case.V0),
        "system",
        (None, TypeError, "must be a ConstrainedSystem.*given None", "make one with ConstrainedSystem.from_python"),
        ({"n_q": 2}, TypeError, "must be a ConstrainedSystem", "make one with ConstrainedSystem.from_python"),
    ),
    of_solve("the class `ConstrainedSystem` as `system`", lambda: case.solve(ConstrainedSystem)).says("system must be a ConstrainedSystem", "make one with ConstrainedSystem.from_python", TypeError),
    *of_argument("progress", ("yes", TypeError, "must be True or False; given 'yes'", "give True or leave it out"), (1, TypeError, "must be True or False; given 1", "give True or leave it out")),
    *of_argument("dense_output", ("yes", TypeError, "must be True or False; given 'yes'", "give True or False"), (1, TypeError, "must be True or False; given 1", "give True or False")),
    *of_argument(
        "store",
        (3, TypeError, "must be a file name or a path; given 3", "give the path of a folder to make"),
        (".", ValueError, "must be a folder that does not exist yet; given '.', which exists", "take another name"),
        ("no/run", ValueError, "must be inside an existing folder; given 'no.run'", "make the folder above it"),
    ),
    of_solve("`Newmark(beta=1/6)` without `step_size`", lambda: case.solve(method=Newmark(beta=1.0 / 6.0))).says("Newmark with beta = 0.166667.*has no error estimate", "give step_size, or take beta=1/4"),
    of_solve("`Newmark(gamma=0.6)` without `step_size`", lambda: case.solve(method=Newmark(gamma=0.6))).says("gamma = 0.6 has no error estimate", "give step_size, or take gamma=1/2"),
]
