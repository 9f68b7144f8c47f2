"""Wrong arguments and guesses of consistent_state."""

from functools import partial

import numpy as np

from tests.bad_input.case import FEW_VECTORS, HUGE, argument, cases_of, linkage, swinging
from tests.problems import pendulum
from twoloop import consistent_state


def project(system=None, t=0.0, q=(0.6, -0.8), v=(0.0, 0.0), **options):
    return consistent_state(swinging() if system is None else system, t, q, v, **options)


FINITE = "give a finite time, s"
of_projection = cases_of("consistent_state")
of_argument = partial(argument, "consistent_state", project)
PROJECTION = [
    of_projection("a `Problem` as `system`", lambda: project(linkage())).says(r"system must be a ConstrainedSystem; given a Problem.*problem\.system", "give problem.system", TypeError),
    *of_argument(
        "t",
        (np.nan, ValueError, "must be finite; given nan", FINITE),
        (np.inf, ValueError, "must be finite; given inf", FINITE),
        ("now", TypeError, "must be a number; given 'now'", FINITE),
        (None, TypeError, "must be a number; given None", FINITE),
        (True, TypeError, "must be a number; given True", FINITE),
        (HUGE, ValueError, "must fit into a float", FINITE),
    ),
    *of_argument("q", *FEW_VECTORS),
    *of_argument("v", *FEW_VECTORS),
    *of_argument(
        "keep",
        ("0", TypeError, "must be a list of indices.*given '0'", "give a list: [0]"),
        (0, TypeError, "must be a list of indices.*given 0", "give a list: [0]"),
        ([True, False], TypeError, "must be a list of indices", "name the coordinates: [0]"),
        ([0.0], TypeError, "must be a list of indices", "give ints"),
        (["x"], TypeError, "must be a list of indices", "give ints"),
        ([2], ValueError, "must hold indices from 0 to 1; given 2", "count from 0"),
        ([-1], ValueError, "must hold indices from 0 to 1; given -1", "count from 0"),
        ([0, 0], ValueError, "must name each coordinate once", "name each once"),
    ),
    of_projection("`keep` of all coordinates of a guess that is not consistent").when(lambda: project(q=[0.6, -0.7], keep=[0, 1])).says(r"keep leaves too little freedom.*\[0, 1\].*rank 0 of 1", "keep fewer"),
    of_projection("`keep` of a coordinate at a dead centre, with a speed").when(lambda: project(q=[1.0, 0.0], v=[1.0, 0.0], keep=[0])).says("keep leaves too little freedom.*C_q v", "move the guess away from the dead centre"),
    of_projection("a guess halfway to another assembly", lambda: project(q=[0.1, 0.0])).says("q does not say on which assembly.*from 0.1 to 1", "give a guess nearer to the assembly that is meant"),
    of_projection("a guess where C_q is zero", lambda: project(q=[0.0, 0.0])).says(r"q cannot be projected.*max\|C\| is 0.5.*nearly loses rank", "give a guess nearer to an assembled position"),
    of_projection("a kept coordinate out of reach", lambda: project(q=[1.1, 0.1], keep=[0])).says("q cannot be projected.*nearer to an assembled position", "keep a value that the mechanism can have"),
    of_projection("`constraint` returns NaN").when(lambda: project(pendulum(constraint=lambda t, q: np.full(1, np.nan)))).says("q and v cannot be projected: constraint of 'pendulum' returned values that are not finite", "find out where the NaN comes from"),
]
