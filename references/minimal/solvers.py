"""heyoka, CyRK and CVODE on a mechanism in minimal coordinates (`minimal.equations`), where no constraints can drift.

Each is used as for redundant coordinates (`heyoka.taylor`, `cyrk.ode`, `sundials.cvode_c`), with the options that are
best there, and the same timing of a second use of the integrator.
"""

from collections.abc import Callable
from functools import lru_cache
from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from references.cyrk import ode
from references.driver import Task, check_task, imported
from references.equations.machine_code import machine_code
from references.equations.straight_line import Program, Value
from references.heyoka import taylor
from references.lines import Line
from references.minimal.equations import Minimal, minimal
from references.sundials import cvode_c
from twoloop.checks.arguments import check_positive
from twoloop.mechanisms import Problem
from twoloop.problem.problem import Array
from twoloop.result.result import Result

FUNCTIONS = ("sin", "cos", "sqrt")  # that equations in minimal coordinates have
_KNOWN: dict[int, tuple[Problem, Minimal]] = {}


def solve_heyoka_minimal(
    problem: Problem,
    t_end: float,
    tol: float = 1e-8,
    *,
    t_eval: ArrayLike | None = None,
    time_limit: float | None = None,
) -> Result:
    """Integrate a mechanism in minimal coordinates by heyoka's Taylor integrator.

    From rest with level links, three of four terms of a pendulum's series vanish. At some orders these include the two
    from which heyoka determines its step: the first step is then much too long, and the run succeeds with a wrong
    state. Another tolerance avoids this; it is not handled here.

    Parameters
    ----------
    problem : Problem
        A problem supported by `minimal`.
    t_end : float
        End time, s; the run starts at 0 with the problem's initial state.
    tol : float
        heyoka's tolerance.
    t_eval, time_limit : see `references.driver`

    Returns
    -------
    Result
        In the problem's coordinates, `a` and `lam` from eq. (6); statistics: n_accepted.

    Raises
    ------
    NoMinimalCoordinates
        A ValueError, if there are no equations for the problem.
    """
    check_positive("tol", tol)
    own, task = _checked(problem, t_end, t_eval, time_limit)
    integrator = _integrator(own, float(tol))
    name, times, rows, failure, steps = taylor.integrate(integrator, np.array(own.start), task, task.t1)
    return task.result(name, times, _states(own, task, rows), failure, n_accepted=steps)


def solve_cvode_minimal(
    problem: Problem,
    t_end: float,
    rtol: float = 1e-8,
    atol: float = 1e-8,
    *,
    t_eval: ArrayLike | None = None,
    time_limit: float | None = None,
) -> Result:
    """Integrate a mechanism in minimal coordinates by CVODE's Adams methods, driven from C.

    Parameters, errors and result as for `solve_heyoka_minimal`, except for CVODE's two tolerances and its counters.
    """
    check_positive("rtol", rtol)
    check_positive("atol", atol)
    own, task = _checked(problem, t_end, t_eval, time_limit)
    functions, start = cvode_c.Functions(_right_hand_side(own, cvode_c.right_hand_side)), np.array(own.start)
    times, rows, failure, counts = cvode_c.integrate(functions, start, task, "Adams", rtol, atol)
    return task.result("CVODE, Adams,", times, _states(own, task, rows), failure, **counts)


def solve_cyrk_minimal(
    problem: Problem,
    t_end: float,
    rtol: float = 1e-8,
    atol: float = 1e-8,
    *,
    method: str = "DOP853",
    t_eval: ArrayLike | None = None,
    time_limit: float | None = None,
) -> Result:
    """Integrate a mechanism in minimal coordinates by one of CyRK's explicit methods, "DOP853" or "Vern8".

    Other parameters, errors and result as for `solve_cvode_minimal`.
    """
    check_positive("rtol", rtol)
    check_positive("atol", atol)
    own, task = _checked(problem, t_end, t_eval, time_limit)
    rate = _right_hand_side(own, ode.right_hand_side)
    times, rows, failure, counts = ode.integrate((rate, None), np.array(own.start), task, method, rtol, atol)
    return task.result(f"CyRK, {method},", times, _states(own, task, rows), failure, **counts)


def _checked(
    problem: Problem, t_end: float, t_eval: ArrayLike | None, time_limit: float | None
) -> tuple[Minimal, Task]:
    """Return the equations of a problem, cached per object because integrators are cached with them, and the task."""
    if not isinstance(problem, Problem):
        raise TypeError(f"problem must be a Problem of twoloop.mechanisms; given {problem!r}")
    start = problem.system, (0.0, t_end), problem.q0, problem.v0
    task = check_task(*start, t_eval, time_limit, derivatives=False)
    if id(problem) not in _KNOWN:
        _KNOWN[id(problem)] = problem, minimal(problem)
    return _KNOWN[id(problem)][1], task


@lru_cache(maxsize=256)
def _integrator(own: Minimal, tol: float) -> Any:
    package = imported("heyoka")
    symbols = package.make_vars(*(f"y{i}" for i in range(len(own.start))))
    motion = list(zip(symbols, own.equations(package)(symbols), strict=True))
    return taylor.built(motion, list(own.start), 0.0, tol, unrolled=True)


@lru_cache(maxsize=64)
def _right_hand_side(own: Minimal, made: Callable[[Any, int], Any]) -> Any:
    """Return the right-hand side as `made` makes it for a solver of a compiled (t, y, rate) -> None."""
    program, n = Program(), len(own.start) // 2
    names = [f"{letter}{i}" for letter in "qv" for i in range(n)]
    functions = SimpleNamespace(**program.functions(FUNCTIONS))
    rates = own.equations(functions)([Value(program, name) for name in names])
    return made(machine_code(n, program.names, enumerate(each.name for each in rates)), 2 * n)


def _states(own: Minimal, task: Task, rows: Array) -> Array:
    """Return [q, v] (2 n_q, n_t) for [angles, rates] given as rows."""
    return np.concatenate(own.states(rows.T)) if len(rows) else np.empty((2 * task.system.n_q, 0))


# in minimal coordinates, where these have a closed form: no solvers of a DAE, and in no ranking
FAMILY = "minimal coordinates"
OWN: dict[str, Any] = {"compared": False, "of_problem": True, "traces": True}
LINES = (
    Line(
        *(f"heyoka, {FAMILY}", "heyoka", FAMILY, solve_heyoka_minimal),
        one_tolerance=True,
        builds_each=True,
        **OWN,
    ),
    *(
        Line(f"CyRK, {method}, {FAMILY}", "cyrk", FAMILY, solve_cyrk_minimal, {"method": method}, **OWN)
        for method in ("DOP853", "Vern8")
    ),
    Line(f"CVODE from C, {FAMILY}", "scikit-sundae", FAMILY, solve_cvode_minimal, **OWN),
)
