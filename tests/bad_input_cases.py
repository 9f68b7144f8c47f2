"""What users get wrong: one entry a kind, which the tests run and from which docs/errors.md is written."""

import datetime
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np

from tests.problems import moving_pivot, moving_pivot_state, pendulum
from twoloop import (
    BDF,
    DOP853,
    ConstrainedSystem,
    Newmark,
    RungeKutta,
    callback,
    consistent_state,
    paper_irk,
    paper_newmark,
    solve_dae,
)
from twoloop.mechanisms import ancf_beam, four_bar, very_flexible_beam
from twoloop.mechanisms.ancf_beam import midpoint_deflection
from twoloop.tableaux import Tableau, gauss, lobatto_iiie, radau_iia, sun_radau_iib

Q0, V0 = [-1.0, 0.0], [0.0, 0.0]
HUGE = 10**400
DAY = datetime.datetime(2016, 1, 1)
DAYS = np.array(["2016-01-01", "2016-01-02"], dtype="datetime64[D]")
MASKED = np.ma.MaskedArray([-1.0, 0.0], mask=[False, True])
WRONG = (TypeError, ValueError)


@dataclass(frozen=True)
class Case:
    """One mistake: what was done, the error that it gets, words that must stand in it, and what to do instead."""

    group: str
    what: str
    call: Callable[[], Any]
    error: type[Exception] | tuple[type[Exception], ...]
    words: str
    advice: str

    @property
    def id(self):
        return f"{self.group}: {self.what}"


@cache
def swinging():
    return pendulum()


@cache
def linkage():
    return four_bar()


def solve(system=None, t_span=(0.0, 1.0), q0=Q0, v0=V0, **options):
    return solve_dae(swinging() if system is None else system, t_span, q0, v0, **options)


def shown(value):
    if value is HUGE:
        return "10**400"
    if isinstance(value, np.ma.MaskedArray):
        return "a masked array"
    if isinstance(value, np.ndarray):
        return f"an array of {value.dtype}, shape {value.shape}"
    return repr(value).replace(repr(HUGE), "10**400") if not isinstance(value, (list, tuple)) else listed(value)


def listed(value):
    inner = ", ".join(shown(each) for each in value)
    return f"({inner})" if isinstance(value, tuple) else f"[{inner}]"


def argument(group, call, name, values):
    """A case for each wrong value of one argument: (value, error, words, advice)."""
    return [
        Case(group, f"`{name}={shown(value)}`", lambda value=value: call(**{name: value}), error, f"{name} {words}", do)
        for value, error, words, do in values
    ]


NUMBERS = "give a list or array of n_q real numbers"
VECTORS = [
    ([1.0], ValueError, r"must have shape \(2,\); given shape \(1,\)", NUMBERS),
    (np.zeros((2, 1)), ValueError, r"must have shape \(2,\); given shape \(2, 1\)", "give one dimension: ravel() it"),
    (0.0, ValueError, r"must have shape \(2,\); given shape \(\)", NUMBERS),
    ([np.nan, 0.0], ValueError, r"must be finite; entries \[0\]", "find out where the NaN comes from"),
    ([0.0, np.inf], ValueError, r"must be finite; entries \[1\]", "find out where the infinity comes from"),
    (["left", "down"], TypeError, "must be an array of real numbers; given .*left", NUMBERS),
    (["1.0", "0.0"], TypeError, "must be an array of real numbers", "convert text to numbers first"),
    (None, TypeError, "must be an array of real numbers; given None", NUMBERS),
    ([1j, 0.0], TypeError, "must be an array of real numbers; given .*1j", "take the real part if that is meant"),
    ([[1.0], [0.0, 1.0]], TypeError, "must be an array of real numbers; given", NUMBERS),
    ([True, False], TypeError, "must be an array of real numbers.*True and False", "write 1.0 and 0.0"),
    ([1.0, True], TypeError, "must be an array of real numbers.*True and False", "write 1.0 and 0.0"),
    (DAYS, TypeError, "must be an array of real numbers.*which holds dates", "convert dates to seconds"),
    (MASKED, TypeError, "must be an array of real numbers; given a masked array", "fill the gaps with filled()"),
    ([HUGE, 0], ValueError, "must hold numbers that fit into a float", "use units in which numbers are moderate"),
    ([object, 0.0], TypeError, "must be an array of real numbers", NUMBERS),
    ([None, 0.0], TypeError, "must be an array of real numbers", NUMBERS),
    ({"x": 1.0}, TypeError, "must be an array of real numbers", NUMBERS),
    ({0.0, 1.0}, TypeError, "must be an array of real numbers", "a set has no order: give a list"),
    ("10", TypeError, "must be an array of real numbers", NUMBERS),
]
FEW_VECTORS = [VECTORS[k] for k in (0, 3, 5, 8, 10, 12, 13, 14)]

POSITIVE = "give a positive number"
POSITIVES = [
    (0.0, ValueError, "must be positive.*given 0.0", POSITIVE),
    (-1e-6, ValueError, "must be positive.*given -1e-06", POSITIVE),
    (np.nan, ValueError, "must be positive.*given nan", POSITIVE),
    ("small", TypeError, "must be a number; given 'small' of type str", POSITIVE),
    (True, TypeError, "must be a number; given True of type bool", POSITIVE),
    (1e-3j, TypeError, "must be a number; given 0.001j", POSITIVE),
    (HUGE, ValueError, "must fit into a float", POSITIVE),
    (DAY, TypeError, "must be a number; given datetime", "give seconds"),
]
FEW_POSITIVES = [POSITIVES[k] for k in (0, 3, 4, 6)]
INFINITE = (np.inf, ValueError, "must be positive and finite; given inf", POSITIVE)
LIST = ([1e-6, 1e-6], TypeError, "must be a number; given", POSITIVE)
NONE = (None, TypeError, "must be a number; given None", POSITIVE)
SHORT_ATOL = ([1e-6, 1e-6, 1e-6], WRONG, "must be a number", "give one number, or one for each coordinate")

SOLVE = [
    *argument("solve_dae", solve, "q0", VECTORS),
    *argument("solve_dae", solve, "v0", FEW_VECTORS),
    *argument(
        "solve_dae",
        solve,
        "t_span",
        [
            ((1.0, 0.0), ValueError, r"must be \(start, end\) with end > start; given \(1.0, 0.0\)", "swap them"),
            ((1.0, 1.0), ValueError, "must be .* with end > start", "give an end after the start"),
            ((0.0, np.nan), ValueError, "must be finite", "give two finite times"),
            ((0.0, np.inf), ValueError, "must be finite", "give two finite times"),
            ((0.0, 1.0, 2.0), ValueError, r"must have shape \(2,\)", "output times go into t_eval"),
            (1.0, ValueError, r"must have shape \(2,\)", "give (start, end)"),
            (("now", "then"), TypeError, "must be an array of real numbers", "give seconds"),
            ((False, True), TypeError, "must be an array of real numbers", "write 0.0 and 1.0"),
            ((0, HUGE), ValueError, "must hold numbers that fit into a float", "give two finite times"),
            (None, TypeError, "must be an array of real numbers", "give (start, end)"),
            (DAYS, TypeError, "must be an array of real numbers", "give seconds"),
        ],
    ),
    *argument(
        "solve_dae",
        solve,
        "t_eval",
        [
            ([0.5, 1.5], ValueError, r"must lie within t_span = \(0.0, 1.0\).*to 1.5", "keep within t_span"),
            ([-0.1, 0.5], ValueError, "must lie within t_span.*from -0.1", "keep within t_span"),
            ([0.5, 0.2], ValueError, r"must be strictly increasing; entry 1 \(0.2\) follows 0.5", "sort them"),
            ([0.2, 0.2], ValueError, "must be strictly increasing", "give each time once"),
            ([], ValueError, "must be a non-empty", "leave it out to get every step"),
            ([[0.1, 0.2]], ValueError, "must be a non-empty one-dimensional array; given shape", "ravel() it"),
            (0.5, ValueError, "must be a non-empty one-dimensional array", "give a list: [0.5]"),
            ([0.1, np.nan], ValueError, r"must be finite; entries \[1\]", "find out where the NaN comes from"),
            (["soon"], TypeError, "must be an array of real numbers", "give seconds"),
            ([0.5 + 1.0j], TypeError, "must be an array of real numbers", "give seconds"),
            ([False, True], TypeError, "must be an array of real numbers", "give seconds"),
            (DAYS, TypeError, "must be an array of real numbers", "give seconds"),
            (MASKED, TypeError, "must be an array of real numbers; given a masked", "fill the gaps with filled()"),
            ([0.5, HUGE], ValueError, "must hold numbers that fit into a float", "keep within t_span"),
            ([0.5, 1.0 - 1e-16], ValueError, "must not come within rounding of the end", "give the end itself"),
        ],
    ),
    Case(
        "solve_dae",
        "`t_eval=[0.2, 0.25]` with `step_size=0.1`",
        lambda: solve(t_eval=[0.2, 0.25], step_size=0.1),
        ValueError,
        r"t_eval must hold multiples of step_size = 0.1.*0.25",
        "give times on the fixed grid, or leave step_size out",
    ),
    *argument("solve_dae", solve, "rtol", [*POSITIVES, INFINITE, LIST, NONE]),
    *argument("solve_dae", solve, "atol", [*POSITIVES, INFINITE, SHORT_ATOL]),
    *argument(
        "solve_dae",
        solve,
        "atol",
        [
            ([1e-6, 0.0], WRONG, "must be", "give positive tolerances"),
            ([1e-6, np.nan], WRONG, "must be", "give positive tolerances"),
            ([True, True], WRONG, "must be", "give positive tolerances"),
            (["small", "small"], WRONG, "must be", "give positive tolerances"),
        ],
    ),
    Case(
        "solve_dae",
        "`rtol=1e-20, atol=1e-20`",
        lambda: solve(rtol=1e-20, atol=1e-20),
        ValueError,
        "rtol and atol must not both be below",
        "raise one of them to 1e-15 or more",
    ),
    *argument("solve_dae", solve, "first_step", [*FEW_POSITIVES, INFINITE]),
    *argument("solve_dae", solve, "max_step", [*FEW_POSITIVES, (None, TypeError, "must be a number", "leave it out")]),
    *argument(
        "solve_dae",
        solve,
        "step_size",
        [
            *FEW_POSITIVES,
            INFINITE,
            (2.0, ValueError, "must not exceed the length of t_span, 1; given 2.0", "give a smaller step"),
        ],
    ),
    Case(
        "solve_dae",
        "`step_size=0.1, first_step=0.1`",
        lambda: solve(step_size=0.1, first_step=0.1),
        ValueError,
        "step_size is a constant step.*first_step",
        "give step_size alone",
    ),
    Case(
        "solve_dae",
        "`step_size=0.1, max_step=0.1`",
        lambda: solve(step_size=0.1, max_step=0.1),
        ValueError,
        "step_size is a constant step.*max_step",
        "give step_size alone",
    ),
    *argument(
        "solve_dae",
        solve,
        "max_steps",
        [
            (0, ValueError, "must be at least 1; given 0", "leave it out for no limit"),
            (-3, ValueError, "must be at least 1; given -3", "leave it out for no limit"),
            (10.0, TypeError, "must be an int; given 10.0", "give an int"),
            (True, TypeError, "must be an int; given True", "give an int"),
            ("many", TypeError, "must be an int; given 'many'", "give an int"),
            (HUGE, ValueError, "must fit into 64 bits", "leave it out for no limit"),
        ],
    ),
    *argument(
        "solve_dae",
        solve,
        "method",
        [
            ("RK45", ValueError, "must be one of SunRadau5.*given 'RK45'", "take one of the names listed"),
            (None, TypeError, "must be a name .*given None", "leave it out for the default"),
            (5, TypeError, "must be a name .*given 5", "take a name or a method object"),
        ],
    ),
    Case(
        "solve_dae",
        "`method=Newmark`, the class",
        lambda: solve(method=Newmark),
        TypeError,
        "method must be a name .*or an object",
        "write Newmark()",
    ),
    Case(
        "solve_dae",
        "`method=gauss(2)`, a tableau",
        lambda: solve(method=gauss(2)),
        TypeError,
        "method must be a name .*or an object",
        "write RungeKutta(gauss(2))",
    ),
    Case(
        "solve_dae",
        "a `Problem` as `system`",
        lambda: solve(linkage()),
        TypeError,
        r"system must be a ConstrainedSystem.*problem\.system",
        "give problem.system",
    ),
    *argument(
        "solve_dae",
        lambda system: solve_dae(system, (0.0, 1.0), Q0, V0),
        "system",
        [
            (None, TypeError, "must be a ConstrainedSystem.*given None", "make one with ConstrainedSystem.from_python"),
            ({"n_q": 2}, TypeError, "must be a ConstrainedSystem", "make one with ConstrainedSystem.from_python"),
        ],
    ),
    Case(
        "solve_dae",
        "the class `ConstrainedSystem` as `system`",
        lambda: solve(ConstrainedSystem),
        TypeError,
        "system must be a ConstrainedSystem",
        "make one with ConstrainedSystem.from_python",
    ),
    *argument(
        "solve_dae",
        solve,
        "progress",
        [
            ("yes", TypeError, "must be True or False; given 'yes'", "give True or leave it out"),
            (1, TypeError, "must be True or False; given 1", "give True or leave it out"),
        ],
    ),
    *argument(
        "solve_dae",
        solve,
        "dense_output",
        [
            ("yes", TypeError, "must be True or False; given 'yes'", "give True or False"),
            (1, TypeError, "must be True or False; given 1", "give True or False"),
        ],
    ),
    Case(
        "solve_dae",
        "`Newmark(beta=1/6)` without `step_size`",
        lambda: solve(method=Newmark(beta=1.0 / 6.0)),
        ValueError,
        "Newmark with beta = 0.166667.*has no error estimate",
        "give step_size, or take beta=1/4",
    ),
    Case(
        "solve_dae",
        "`Newmark(gamma=0.6)` without `step_size`",
        lambda: solve(method=Newmark(gamma=0.6)),
        ValueError,
        "gamma = 0.6 has no error estimate",
        "give step_size, or take gamma=1/2",
    ),
]


# --- the start

THREE = {
    "n_q": 3,
    "n_c": 3,
    "mass": np.eye(3),
    "force": lambda t, q, v: np.zeros(3),
    "constraint": lambda t, q: np.array([q[0], q[1], q[0] + 0.5 * q[1]]),
    "jacobian": lambda t, q: np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [1.0, 0.5, 0.0]]),
}


def linkage_moved():
    q = linkage().q0.copy()
    q[4] += 0.01
    return solve(linkage().system, q0=q, v0=linkage().v0)


def forgotten_rate():
    right = moving_pivot()
    system = ConstrainedSystem.from_python(
        n_q=2,
        n_c=1,
        mass=np.eye(2),
        force=lambda t, q, v: right.force(t, q, v),
        constraint=lambda t, q: right.constraint(t, q),
        jacobian=lambda t, q: right.jacobian(t, q),
        name="moving pivot",
    )
    return solve(system, (0.0, 0.1), *moving_pivot_state(0.0))


def with_tangents(**changed):
    """A pendulum on a spring and a damper, with its tangents."""
    tangents = {
        "force_by_q": lambda t, q, v: np.diag([-4.0, 0.0]),
        "force_by_v": lambda t, q, v: np.diag([0.0, -0.5]),
        "reaction_by_q": lambda t, q, lam: lam[0] * np.eye(2),
    }
    return pendulum(force=lambda t, q, v: np.array([-4.0 * q[0], -9.81 - 0.5 * v[1]]), **{**tangents, **changed})


PROJECT = "project the guess with consistent_state"
FORMULA = "correct the formula, or the constraint that it belongs to"
START = [
    Case(
        "The start of a run",
        "positions 0.1 m off the constraint",
        lambda: solve(q0=[-1.1, 0.0]),
        ValueError,
        r"q0 is not consistent.*'pendulum'.*max\|C.*0.105.*consistent_state",
        PROJECT,
    ),
    Case(
        "The start of a run",
        "a joint of a linkage that does not close",
        linkage_moved,
        ValueError,
        r"q0 is not consistent.*0\.01 \(row 3\).*coordinate \d",
        PROJECT,
    ),
    Case(
        "The start of a run",
        "velocities along the rod",
        lambda: solve(v0=[0.3, 0.0]),
        ValueError,
        r"v0 is not consistent.*max\|C_q v.*0.3.*consistent_state",
        PROJECT,
    ),
    Case(
        "The start of a run",
        "velocities that forget the drive",
        lambda: solve(moving_pivot(), (0.0, 0.1), moving_pivot_state(0.0)[0], moving_pivot_state(0.0)[1] - [0.9, 0.0]),
        ValueError,
        "v0 is not consistent",
        PROJECT,
    ),
    Case(
        "The start of a run",
        "redundant constraints",
        lambda: solve(ConstrainedSystem.from_python(**THREE), q0=np.zeros(3), v0=np.zeros(3)),
        ValueError,
        r"rank 2 < n_c = 3.*row\(s\) \[[012]\] depend on the others \(row [012] = ",
        "leave out the rows named",
    ),
    Case(
        "The start of a run",
        "a constraint without gradient",
        lambda: solve(
            pendulum(constraint=lambda t, q: np.zeros(1), jacobian=lambda t, q: np.zeros((1, 2)), gamma=False)
        ),
        ValueError,
        r"rank 0 < n_c = 1.*row\(s\) \[0\]",
        "leave out the row named",
    ),
    Case(
        "The start of a run",
        "a mass matrix that is not symmetric",
        lambda: solve(pendulum(mass=lambda t, q: np.array([[1.0, 0.5], [0.0, 1.0]]))),
        ValueError,
        "mass of 'pendulum' must be symmetric.*0.5",
        "correct the mass matrix",
    ),
    Case(
        "The start of a run",
        "a mass matrix that is not positive definite",
        lambda: solve(pendulum(mass=np.diag([1.0, -2.0]))),
        ValueError,
        "mass of 'pendulum' must be positive definite",
        "correct the mass matrix",
    ),
    *(
        Case(
            "The start of a run",
            f"`{kind}` returns NaN",
            lambda kind=kind, shape=shape: solve(pendulum(**{kind: lambda *arguments: np.full(shape, np.nan)})),
            ValueError,
            f"start.*{kind} of 'pendulum' returned values that are not finite",
            "find out where the NaN comes from",
        )
        for kind, shape in {
            "mass": (2, 2),
            "force": (2,),
            "constraint": (1,),
            "jacobian": (1, 2),
            "gamma": (1,),
        }.items()
    ),
    *(
        Case(
            "The start of a run",
            f"`{kind}` returns an array of shape (3, 3)",
            lambda kind=kind: solve(pendulum(**{kind: lambda *arguments: np.zeros((3, 3))})),
            ValueError,
            rf"{kind} of system 'pendulum' must return an array of shape .*it returned shape \(3, 3\)",
            "return an array of the shape named",
        )
        for kind in ("mass", "force", "constraint", "jacobian", "gamma", "constraint_rate")
    ),
    *(
        Case(
            "The start of a run",
            f"`force` returns {value!r}",
            lambda value=value: solve(pendulum(force=lambda *arguments: value)),
            TypeError,
            r"force of system 'pendulum' must return a real array of shape \(2,\).*returned",
            "return an array of real numbers",
        )
        for value in (None, "text", [[1.0], [1.0, 2.0]], [1j, 0.0])
    ),
    Case(
        "The start of a run",
        "`jacobian` of twice the right values",
        lambda: solve(pendulum(jacobian=lambda t, q: 2.0 * q[None, :])),
        ValueError,
        r"jacobian of 'pendulum' is not the derivative of constraint.*entry \(0, 0\) is -2, by differences it is -1",
        FORMULA,
    ),
    Case(
        "The start of a run",
        "`jacobian` with one entry wrong by 1e-5",
        lambda: solve(pendulum(jacobian=lambda t, q: np.array([[q[0], q[1] + 1e-5 * q[0]]]))),
        ValueError,
        r"jacobian of 'pendulum' is not the derivative of constraint.*entry \(0, 1\) is -1e-05",
        FORMULA,
    ),
    Case(
        "The start of a run",
        "constraints that depend on time, without `constraint_rate`",
        forgotten_rate,
        ValueError,
        "constraint_rate of 'moving pivot' is not.*or give constraint_rate: the constraints depend on time",
        "give constraint_rate",
    ),
    Case(
        "The start of a run",
        "`gamma` with the wrong sign",
        lambda: solve(pendulum(gamma=lambda t, q, v: np.array([v @ v]))),
        ValueError,
        "gamma of 'pendulum' is not .*entry 0 is",
        "correct the formula, or leave gamma out",
    ),
    Case(
        "The start of a run",
        "`force_by_q` with the wrong sign",
        lambda: solve(with_tangents(force_by_q=lambda t, q, v: np.diag([4.0, 0.0]))),
        ValueError,
        r"force_by_q of 'pendulum' is not .*entry \(0, 0\) is 4",
        "correct the formula, or leave all tangents out",
    ),
    Case(
        "The start of a run",
        "`force_by_q` without `force_by_v`, for a force with damping",
        lambda: solve(with_tangents(force_by_v=None)),
        ValueError,
        r"force_by_v of 'pendulum' is not .*give force_by_v",
        "give force_by_v too",
    ),
    Case(
        "The start of a run",
        "`reaction_by_q` of twice the right values",
        lambda: solve(with_tangents(reaction_by_q=lambda t, q, lam: 2.0 * lam[0] * np.eye(2))),
        ValueError,
        r"reaction_by_q of 'pendulum' is not .*entry \(0, 0\)",
        "correct the formula, or leave reaction_by_q out",
    ),
]


# --- consistent_state


def project(system=None, t=0.0, q=(0.6, -0.8), v=(0.0, 0.0), **options):
    return consistent_state(swinging() if system is None else system, t, q, v, **options)


FINITE = "give a finite time, s"
PROJECTION = [
    Case(
        "consistent_state",
        "a `Problem` as `system`",
        lambda: project(linkage()),
        TypeError,
        r"system must be a ConstrainedSystem.*this is a Problem.*problem\.system",
        "give problem.system",
    ),
    *argument(
        "consistent_state",
        project,
        "t",
        [
            (np.nan, ValueError, "must be finite; given nan", FINITE),
            (np.inf, ValueError, "must be finite; given inf", FINITE),
            ("now", TypeError, "must be a number; given 'now'", FINITE),
            (None, TypeError, "must be a number; given None", FINITE),
            (True, TypeError, "must be a number; given True", FINITE),
            (HUGE, ValueError, "must fit into a float", FINITE),
        ],
    ),
    *argument("consistent_state", project, "q", FEW_VECTORS),
    *argument("consistent_state", project, "v", FEW_VECTORS),
    *argument(
        "consistent_state",
        project,
        "keep",
        [
            ("0", TypeError, "must be a list of indices.*given '0'", "give a list: [0]"),
            (0, TypeError, "must be a list of indices.*given 0", "give a list: [0]"),
            ([True, False], TypeError, "must be a list of indices", "name the coordinates: [0]"),
            ([0.0], TypeError, "must be a list of indices", "give ints"),
            (["x"], TypeError, "must be a list of indices", "give ints"),
            ([2], ValueError, "must hold indices from 0 to 1; given 2", "count from 0"),
            ([-1], ValueError, "must hold indices from 0 to 1; given -1", "count from 0"),
            ([0, 0], ValueError, "must name each coordinate once", "name each once"),
        ],
    ),
    Case(
        "consistent_state",
        "`keep` of all coordinates of a guess that is not consistent",
        lambda: project(q=[0.6, -0.7], keep=[0, 1]),
        ValueError,
        r"keep leaves too little freedom.*\[0, 1\].*rank 0 of 1",
        "keep fewer",
    ),
    Case(
        "consistent_state",
        "`keep` of a coordinate at a dead centre, with a speed",
        lambda: project(q=[1.0, 0.0], v=[1.0, 0.0], keep=[0]),
        ValueError,
        "keep leaves too little freedom.*C_q v",
        "move the guess away from the dead centre",
    ),
    Case(
        "consistent_state",
        "a guess halfway to another assembly",
        lambda: project(q=[0.1, 0.0]),
        ValueError,
        "q does not say on which assembly.*from 0.1 to 1",
        "give a guess nearer to the assembly that is meant",
    ),
    Case(
        "consistent_state",
        "a guess where C_q is zero",
        lambda: project(q=[0.0, 0.0]),
        ValueError,
        r"q cannot be projected.*max\|C\| is 0.5.*nearly loses rank",
        "give a guess nearer to an assembled position",
    ),
    Case(
        "consistent_state",
        "a kept coordinate out of reach",
        lambda: project(q=[1.1, 0.1], keep=[0]),
        ValueError,
        "q cannot be projected.*nearer to an assembled position",
        "keep a value that the mechanism can have",
    ),
    Case(
        "consistent_state",
        "`constraint` returns NaN",
        lambda: project(pendulum(constraint=lambda t, q: np.full(1, np.nan))),
        ValueError,
        "q and v cannot be projected: constraint of 'pendulum' returned values that are not finite",
        "find out where the NaN comes from",
    ),
]


# --- systems


def make(**changed):
    arguments = {
        "n_q": 2,
        "n_c": 1,
        "mass": np.eye(2),
        "force": lambda t, q, v: np.zeros(2),
        "constraint": lambda t, q: q[:1],
        "jacobian": lambda t, q: np.eye(2)[:1],
    }
    return ConstrainedSystem.from_python(**{**arguments, **changed})


def compiled(**changed):
    functions = linkage().system.functions
    arguments = {kind: getattr(functions, kind) for kind in ("mass", "force", "constraint", "jacobian", "gamma")}
    return ConstrainedSystem(**{"n_q": 9, "n_c": 8, "parameters": [1.0, 2.0, 1.5, 3.0], **arguments, **changed})


COUNT = "give the number of coordinates, an int"
SYSTEMS = [
    *argument(
        "ConstrainedSystem.from_python",
        make,
        "n_q",
        [
            (0, ValueError, "must be at least 1; given 0", COUNT),
            (-2, ValueError, "must be at least 1; given -2", COUNT),
            (2.0, TypeError, "must be an int; given 2.0", COUNT),
            ("2", TypeError, "must be an int; given '2'", COUNT),
            (True, TypeError, "must be an int; given True", COUNT),
            (None, TypeError, "must be an int; given None", COUNT),
            (HUGE, ValueError, "must fit into 64 bits", COUNT),
        ],
    ),
    *argument(
        "ConstrainedSystem.from_python",
        make,
        "n_c",
        [
            (-1, ValueError, "must be at least", "give the number of constraints"),
            (True, TypeError, "must be an int; given True", "give the number of constraints"),
            (3, ValueError, "must not exceed n_q = 2; given 3", "leave redundant constraints out"),
        ],
    ),
    *argument(
        "ConstrainedSystem.from_python",
        make,
        "mass",
        [
            (np.eye(3), ValueError, r"must have shape \(2, 2\); given .*shape \(3, 3\)", "give an (n_q, n_q) array"),
            ("heavy", TypeError, "must be an array of real numbers", "give an (n_q, n_q) array or a function"),
            ([[1.0, 0.0], [1.0]], TypeError, "must be an array of real numbers", "give an (n_q, n_q) array"),
            (np.eye(2, dtype=bool), TypeError, "must be an array of real numbers", "write 1.0 and 0.0"),
            (np.eye(2, dtype=complex), TypeError, "must be an array of real numbers", "give real numbers"),
            (1.0, ValueError, r"must have shape \(2, 2\)", "write 1.0 * np.eye(2)"),
        ],
    ),
    *argument(
        "ConstrainedSystem.from_python",
        make,
        "force",
        [
            (None, TypeError, "must be a function; given None", "give force(t, q, v)"),
            ([0.0, -9.81], TypeError, "must be a function; given", "give force(t, q, v)"),
        ],
    ),
    *argument(
        "ConstrainedSystem.from_python",
        make,
        "gamma",
        [(0.0, TypeError, "must be a function; given 0.0", "give gamma(t, q, v), or leave it out")],
    ),
    *argument(
        "ConstrainedSystem.from_python",
        make,
        "constraint_rate",
        [("linear", TypeError, "must be a function; given 'linear'", "give constraint_rate(t, q), or leave it out")],
    ),
    *argument(
        "ConstrainedSystem.from_python",
        make,
        "bandwidth",
        [
            (-1, ValueError, "must be at least 0; given -1", "give an int of at least 0, or leave it out"),
            (1.5, TypeError, "must be an int; given 1.5", "give an int of at least 0, or leave it out"),
        ],
    ),
    Case(
        "ConstrainedSystem.from_python",
        "`force(t, v, q)`: arguments in another order",
        lambda: make(force=lambda t, v, q: np.zeros(2)),
        TypeError,
        r"force is called as force\(t, q, v\); the function given takes \(t, v, q\)",
        "put them in the order named",
    ),
    Case(
        "ConstrainedSystem.from_python",
        "`force_by_v` without `force_by_q`",
        lambda: make(force_by_v=lambda t, q, v: np.zeros((2, 2))),
        ValueError,
        "force_by_v.* go with force_by_q",
        "give force_by_q too",
    ),
    Case(
        "ConstrainedSystem.from_python",
        "`bandwidth` with a mass that is a function",
        lambda: make(bandwidth=1, mass=lambda t, q: np.eye(2)),
        ValueError,
        "bandwidth needs a constant mass",
        "give the mass as an array",
    ),
    *argument(
        "ConstrainedSystem",
        compiled,
        "parameters",
        [
            (["long"], TypeError, "must be an array of real numbers", "give a vector of numbers"),
            ([[1.0, 2.0]], ValueError, "must be a vector of finite numbers", "give a vector of numbers"),
            ([1.0, np.nan, 1.5, 3.0], ValueError, "must be a vector of finite numbers", "give finite numbers"),
            ([True, 2.0, 1.5, 3.0], TypeError, "must be an array of real numbers", "give a vector of numbers"),
            ([HUGE, 2.0, 1.5, 3.0], ValueError, "must hold numbers that fit into a float", "give finite numbers"),
        ],
    ),
    *argument(
        "ConstrainedSystem",
        compiled,
        "constant_mass",
        [
            ("yes", TypeError, "must be True or False; given 'yes'", "give True or False"),
            (1, TypeError, "must be True or False; given 1", "give True or False"),
        ],
    ),
    *argument(
        "ConstrainedSystem",
        compiled,
        "bandwidth",
        [(2, ValueError, "needs a constant mass matrix", "give constant_mass=True where that is so")],
    ),
    Case(
        "ConstrainedSystem",
        "a plain function as `force`",
        lambda: compiled(force=lambda t, q, v, p, Q: None),
        TypeError,
        r"force must be compiled by @twoloop.callback\('force'\).*from_python",
        "decorate it with @callback, or use from_python",
    ),
    Case(
        "ConstrainedSystem",
        "the callback of another kind as `force`",
        lambda: compiled(force=linkage().system.functions.constraint),
        TypeError,
        r"force must be compiled by @twoloop.callback\('force'\)",
        "give the callback made for this kind",
    ),
    Case(
        "callback",
        '`@callback("friction")`',
        lambda: callback("friction"),
        ValueError,
        "kind must be one of mass.*given 'friction'",
        "take one of the kinds named",
    ),
    Case(
        "callback",
        "`@callback` without a kind",
        lambda: callback(lambda t, q, v, p, Q: None),
        TypeError,
        "the decorator needs the kind of callback",
        'write @callback("force")',
    ),
    Case(
        "callback",
        "a force with the arguments `(t, q, Q)`",
        lambda: callback("force")(lambda t, q, Q: None),
        TypeError,
        r"declared as the callback 'force', whose arguments are \(t, q, v, p, Q\); it has \(t, q, Q\)",
        "take the arguments named",
    ),
]


# --- methods and tableaux


def runge_kutta(tableau=None, **options):
    return RungeKutta(gauss(2) if tableau is None else tableau, **options)


EXPLICIT = Tableau("Heun", [[0.0, 0.0], [1.0, 0.0]], [0.5, 0.5], [0.0, 1.0], 2)
DOUBLE = Tableau("double", [[0.25, 0.25], [0.25, 0.25]], [0.5, 0.5], [0.5, 0.5], 2)


def tableau(**changed):
    right = {"name": "midpoint", "A": [[0.5]], "b": [1.0], "c": [0.5], "order": 2}
    return Tableau(**{**right, **changed})


STAGES = "give the number of stages, an int"
UNIT = "give a number from 0 to 1"
METHODS = [
    *argument(
        "RungeKutta",
        lambda tableau: RungeKutta(tableau),
        "tableau",
        [
            (None, TypeError, r"must be a twoloop.tableaux.Tableau.*given None", "give gauss(3), say"),
            ("Gauss6", TypeError, "must be a twoloop.tableaux.Tableau.*given 'Gauss6'", "give gauss(3), say"),
            (DOUBLE, ValueError, "must have distinct nodes", "take another tableau"),
        ],
    ),
    Case(
        "RungeKutta",
        "an explicit tableau with `outer='newton'`",
        lambda: RungeKutta(EXPLICIT, outer="newton"),
        ValueError,
        "tableau must have an invertible A.*Heun.*fixed-point",
        "take outer='fixed-point'",
    ),
    *argument(
        "RungeKutta",
        runge_kutta,
        "outer",
        [
            ("n", ValueError, "must be 'auto', 'fixed-point', 'newton' or 'paper'; given 'n'", "take one of these"),
            (None, TypeError, "must be .*given None", "leave it out"),
        ],
    ),
    *argument("RungeKutta", runge_kutta, "error", [("none", ValueError, "must be 'richardson'", "take one of these")]),
    *argument("RungeKutta", runge_kutta, "variables", [("q", ValueError, "must be 'velocities'", "take one of these")]),
    *argument("RungeKutta", runge_kutta, "partition", [(1, TypeError, "must be 'lasting'", "take one of these")]),
    *argument("RungeKutta", runge_kutta, "inner_tol", FEW_POSITIVES),
    *argument("RungeKutta", runge_kutta, "outer_tol", [*FEW_POSITIVES, INFINITE]),
    Case(
        "RungeKutta",
        "`outer='newton', variables='momenta'`",
        lambda: runge_kutta(outer="newton", variables="momenta"),
        ValueError,
        "outer='newton' goes with variables='velocities' only",
        "take outer='fixed-point' for momenta",
    ),
    Case(
        "RungeKutta",
        "`outer='paper', partition='symmetric'`",
        lambda: runge_kutta(outer="paper", partition="symmetric"),
        ValueError,
        "outer='paper' is the paper's procedure",
        "take outer='fixed-point' for symmetric partitions",
    ),
    *argument(
        "Newmark",
        Newmark,
        "beta",
        [
            (2.0, ValueError, "must be between 0 and 1; given 2.0", UNIT),
            (np.nan, ValueError, "must be between 0 and 1; given nan", UNIT),
            ("1/4", TypeError, "must be a number; given '1/4'", UNIT),
            (True, TypeError, "must be a number; given True", UNIT),
            (HUGE, ValueError, "must fit into a float", UNIT),
        ],
    ),
    *argument("Newmark", Newmark, "gamma", [(-0.5, ValueError, "must be between 0 and 1; given -0.5", UNIT)]),
    *argument("Newmark", Newmark, "error_tol", FEW_POSITIVES),
    *argument(
        "BDF",
        BDF,
        "max_order",
        [
            (0, ValueError, "must be at least 1; given 0", "give 1 to 5"),
            (6, ValueError, "must be at most 5; given 6", "give 1 to 5"),
            (2.0, TypeError, "must be an int; given 2.0", "give 1 to 5"),
            (True, TypeError, "must be an int; given True", "give 1 to 5"),
            ("5", TypeError, "must be an int; given '5'", "give 1 to 5"),
        ],
    ),
    *argument("BDF", BDF, "outer_tol", FEW_POSITIVES[:2]),
    *argument("DOP853", DOP853, "inner_tol", FEW_POSITIVES),
    *argument("paper_irk", paper_irk, "inner_tol", FEW_POSITIVES[:2]),
    *argument("paper_newmark", paper_newmark, "beta", [(2.0, ValueError, "must be between 0 and 1", UNIT)]),
    *(
        case
        for family in (gauss, radau_iia, sun_radau_iib)
        for case in argument(
            family.__name__,
            family,
            "s",
            [
                (0, ValueError, "must be at least 1", STAGES),
                (2.0, TypeError, "must be an int", STAGES),
            ],
        )
    ),
    *argument("gauss", gauss, "s", [(True, TypeError, "must be an int", STAGES), ("3", TypeError, "must be", STAGES)]),
    *argument("gauss", gauss, "s", [(HUGE, ValueError, "must be at most 100", "give a moderate number")]),
    *argument("lobatto_iiie", lobatto_iiie, "s", [(1, ValueError, "must be at least 2", STAGES)]),
    *argument(
        "Tableau",
        tableau,
        "name",
        [(3, TypeError, "must be a string; given 3", "give a string")],
    ),
    *argument(
        "Tableau",
        tableau,
        "A",
        [
            ([[0.5, 0.0]], ValueError, r"must have shape \(1, 1\).*given shape \(1, 2\)", "give s rows and columns"),
            (0.5, ValueError, r"must have shape \(1, 1\)", "give s rows and columns"),
            ([[np.nan]], ValueError, "must be finite", "give finite coefficients"),
            ([["1/2"]], TypeError, "must be an array of real numbers", "give numbers"),
            ([[True]], TypeError, "must be an array of real numbers", "give numbers"),
        ],
    ),
    *argument(
        "Tableau",
        tableau,
        "b",
        [
            ([], ValueError, "must be a vector with one weight for each stage", "give s weights"),
            ([0.9], ValueError, "must sum to 1; the sum of .* is 0.9", "give weights that sum to 1"),
            ([np.inf], ValueError, "must be finite", "give finite coefficients"),
        ],
    ),
    *argument(
        "Tableau",
        tableau,
        "c",
        [
            ([0.5, 1.0], ValueError, r"must have shape \(1,\)", "give s nodes"),
            ([0.25], ValueError, r"must be the row sums of A.*row 0 of A sums to 0.5, and c\[0\] is 0.25", "give A 1"),
        ],
    ),
    *argument(
        "Tableau",
        tableau,
        "order",
        [
            (0, ValueError, "must be at least 1; given 0", "give the classical order"),
            (2.5, TypeError, "must be an int; given 2.5", "give the classical order"),
        ],
    ),
]


# --- ready mechanisms


def beam(n_elements=1, **options):
    usual = {"youngs_modulus": 2e6, "amplitude": 0.02, "angular_frequency": 1.0}
    return ancf_beam(n_elements, **{**usual, **options})


MECHANISMS = [
    *argument(
        "four_bar",
        four_bar,
        "lengths",
        [
            ((1.0, 2.0), ValueError, r"must have shape \(3,\)", "give three lengths"),
            ((1.0, -2.0, 1.5), ValueError, "must be positive", "give positive lengths"),
            ((1.0, np.nan, 1.5), ValueError, "must be finite", "give finite lengths"),
            (("a", "b", "c"), TypeError, "must be an array of real numbers", "give three numbers"),
            ((True, 2.0, 1.5), TypeError, "must be an array of real numbers", "give three numbers"),
        ],
    ),
    *argument("four_bar", four_bar, "ground", [*FEW_POSITIVES, INFINITE]),
    *argument(
        "four_bar",
        four_bar,
        "theta3",
        [
            (np.inf, ValueError, "must be finite; given inf", "give an angle, rad"),
            ("flat", TypeError, "must be a number; given 'flat'", "give an angle, rad"),
            (None, TypeError, "must be a number; given None", "give an angle, rad"),
        ],
    ),
    *argument(
        "four_bar",
        four_bar,
        "branch",
        [
            (0, ValueError, "must be 1 .*or -1 .*given 0", "give 1 or -1"),
            ("up", ValueError, "must be 1 .*or -1 .*given 'up'", "give 1 or -1"),
            (True, ValueError, "must be 1 .*or -1 .*given True", "give 1 or -1"),
        ],
    ),
    Case(
        "four_bar",
        "bars that cannot be assembled",
        lambda: four_bar((0.1, 0.1, 0.1), 5.0),
        ValueError,
        "the linkage cannot be assembled.*Change lengths, ground or theta3",
        "change lengths, ground or theta3",
    ),
    *argument(
        "ancf_beam",
        beam,
        "n_elements",
        [
            (0, ValueError, "must be at least 1; given 0", "give an int of at least 1"),
            (2.5, TypeError, "must be an int; given 2.5", "give an int of at least 1"),
        ],
    ),
    *argument("ancf_beam", beam, "start", [("tip", ValueError, "must be 'node'.*given 'tip'", "take one of these")]),
    *argument("ancf_beam", beam, "youngs_modulus", [*FEW_POSITIVES, INFINITE]),
    *argument("ancf_beam", beam, "length", FEW_POSITIVES[:2]),
    *argument("ancf_beam", beam, "amplitude", [(np.inf, ValueError, "must be finite; given inf", "give metres")]),
    *argument("ancf_beam", beam, "poisson_ratio", [(0.5, ValueError, "must lie between -1 and 0.5", "give 0.3, say")]),
    *argument("ancf_beam", beam, "gravity", [(-9.81, ValueError, "must be at least 0", "gravity acts along -y")]),
    *argument(
        "very_flexible_beam", very_flexible_beam, "n_elements", [("4", TypeError, "must be an int", "give an int")]
    ),
    Case(
        "midpoint_deflection",
        "a beam of an odd number of elements",
        lambda: midpoint_deflection(beam(1).q0),
        ValueError,
        "q must be of an even number of elements.*given 1",
        "take an even number of elements",
    ),
]

CASES = [*SOLVE, *START, *PROJECTION, *SYSTEMS, *METHODS, *MECHANISMS]
