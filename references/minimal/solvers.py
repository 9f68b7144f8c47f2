"""heyoka and CVODE on a mechanism in minimal coordinates (`minimal.equations`): no constraints, nothing drifts.

Each is used as on redundant coordinates (`heyoka.taylor`, `sundials.cvode_c`), with the options that are
best there, and timed the same: a second use of what was built.
"""

import math
from functools import lru_cache
from typing import Any

import numpy as np
from numba import carray, cfunc, njit, types
from numpy.typing import ArrayLike, NDArray

from references.driver import Task, check_task, imported
from references.equations.ode import ode_result
from references.heyoka import taylor
from references.minimal.equations import Minimal, minimal
from references.sundials import cvode_c
from references.sundials.library import library
from twoloop.checks.arguments import check_positive
from twoloop.mechanisms import Problem
from twoloop.result.result import Result
from twoloop.run.record import Statistics

Array = NDArray[np.float64]

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

    From rest with level links, three of four terms of a pendulum's series are zero. At some orders these are the two by
    which heyoka measures its steps: the first is then far too long, and the run ends with success and a wrong state.
    The remedy is another tolerance; nothing is done about it here.

    Parameters
    ----------
    problem : Problem
        One that `minimal` has equations of.
    t_end : float
        s; from 0 on, from the problem's start.
    tol : float
        heyoka's one tolerance.
    t_eval, time_limit : see `references.driver`

    Returns
    -------
    Result
        In the problem's coordinates, `a` and `lam` from eq. (6); of the statistics n_accepted.

    Raises
    ------
    NoMinimalCoordinates
        A ValueError, if there are no equations of the problem.
    """
    check_positive("tol", tol)
    own, task = _checked(problem, t_end, t_eval, time_limit)
    given = np.array(own.start), (0.0, t_end), task.instants, time_limit, t_end
    return _result(own, task, *taylor.integrate(_integrator(own, float(tol)), *given))


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

    Parameters, errors and result are those of `solve_heyoka_minimal`, but for CVODE's two tolerances and its counters.
    """
    own, task = _checked(problem, t_end, t_eval, time_limit, (rtol, atol))
    functions, start = cvode_c.Functions(_right_hand_side(own)), np.array(own.start)
    made = cvode_c.integrate(functions, start, (0.0, t_end), "Adams", rtol, atol, task.instants, time_limit)
    times, rows, failure, statistics = made
    return _result(own, task, times, rows, failure, f"CVODE, Adams, reached the end, t = {t_end:g}.", statistics)


def _checked(
    problem: Problem,
    t_end: float,
    t_eval: ArrayLike | None,
    time_limit: float | None,
    tolerances: tuple[float, float] | None = None,
) -> tuple[Minimal, Task]:
    if not isinstance(problem, Problem):
        raise TypeError(f"problem must be a Problem of twoloop.mechanisms; given {problem!r}")
    span = 0.0, t_end
    task = check_task(problem.system, span, problem.q0, problem.v0, t_eval, time_limit, tolerances, derivatives=False)
    return _minimal(problem), task


def _minimal(problem: Problem) -> Minimal:
    """The equations of a problem, made once for that object, as what is built of them is kept by them."""
    if id(problem) not in _KNOWN:
        _KNOWN[id(problem)] = problem, minimal(problem)
    return _KNOWN[id(problem)][1]


@lru_cache(maxsize=256)
def _integrator(own: Minimal, tol: float) -> Any:
    package = imported("heyoka")
    symbols = package.make_vars(*(f"y{i}" for i in range(len(own.start))))
    equations = list(zip(symbols, own.equations(package)(symbols), strict=True))
    return package.taylor_adaptive(equations, list(own.start), tol=tol, fast_math=True, compact_mode=False)


@lru_cache(maxsize=64)
def _right_hand_side(own: Minimal) -> Any:
    """CVODE's right-hand side function."""
    rates, size = njit(error_model="numpy")(own.equations(math)), len(own.start)
    array_of, pointer = library().N_VGetArrayPointer, types.voidptr

    @cfunc(types.int32(types.float64, pointer, pointer, pointer), error_model="numpy")
    def right_hand_side(t, y, rate, memory):  # type: ignore[no-untyped-def]
        found, place = rates(carray(array_of(y), (size,))), carray(array_of(rate), (size,))
        for i in range(size):
            place[i] = found[i]
        return 0

    return right_hand_side


def _result(
    own: Minimal, task: Task, times: Array, rows: Array, failure: str, end: str, statistics: Statistics
) -> Result:
    states = np.concatenate(own.states(rows.T)) if times.size else np.empty((2 * task.system.n_q, 0))
    return ode_result(task.system, times, states, failure, end, statistics)
