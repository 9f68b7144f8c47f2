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

from references.driver import TimeLimit, check_run, check_tolerances, user_call
from references.equations.ode import ADVICE, ode_result, output_times
from references.heyoka.taylor import STEPS_A_CALL
from references.minimal.equations import Minimal, minimal
from references.sundials.cvode_c import METHODS, Functions, integrate
from references.sundials.library import flag_name, library
from twoloop.checks.arguments import check_positive
from twoloop.mechanisms import Problem
from twoloop.result.result import Result
from twoloop.run.record import Statistics

Array = NDArray[np.float64]


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
    t_eval : array_like, optional
        Increasing times at which to store the solution, in a second run that is not timed. None: 1001, evenly.
    time_limit : float, optional
        Wall-clock time that the integration may take, s. None: no limit.

    Returns
    -------
    Result
        In the problem's coordinates, `a` and `lam` from eq. (6); of the statistics n_accepted and cpu_time.

    Raises
    ------
    TypeError, ValueError
        If an argument is wrong; NoMinimalCoordinates, one of the latter, if there are no equations of the problem.
    RuntimeError
        If heyoka is not installed.
    """
    check_positive("tol", tol)
    own, times = _checked(problem, t_end, t_eval, time_limit)
    integrator, outcomes = _integrator(own, float(tol))

    limit, steps = TimeLimit(time_limit), 0
    with user_call as clock:
        integrator.time, integrator.state[:] = 0.0, own.start
        while True:
            outcome, _, _, taken, *_ = integrator.propagate_until(t_end, max_steps=STEPS_A_CALL)
            steps += taken
            if outcome != outcomes.step_limit or limit.passed():
                break
    cpu, reached = clock.seconds or 0.0, float(integrator.time)
    failure = ""
    if outcome == outcomes.step_limit:
        failure = limit.message("heyoka", reached, "take looser tolerances")
    elif outcome != outcomes.time_limit:  # which is what heyoka calls the end
        failure = f"heyoka failed after t = {reached:.10g} with {outcome.name}. {ADVICE}"
    kept = times[times <= (reached if failure else t_end)]
    integrator.time, integrator.state[:] = 0.0, own.start
    grid = kept if kept.size and kept[0] == 0.0 else np.append(0.0, kept)  # it must begin where the state is
    rows = integrator.propagate_grid(grid)[-1][grid.size - kept.size :]
    end = f"heyoka, order {integrator.order}, reached the end, t = {t_end:g}."
    return _result(problem, own, kept, rows, failure, end, Statistics(n_accepted=steps, cpu_time=cpu))


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
    check_tolerances(rtol, atol)
    own, times = _checked(problem, t_end, t_eval, time_limit)
    functions = Functions(_right_hand_side(own), None, None, np.empty(0))
    arguments = (functions, np.array(own.start), 0.0, t_end, METHODS["Adams"], float(rtol), float(atol))
    limit = TimeLimit(time_limit)
    _, flag, reached, statistics = integrate(*arguments, np.empty(0), limit)
    failure = ""
    if limit.exceeded:
        failure = limit.message("CVODE", reached, "take looser tolerances")
    elif flag < 0:
        name = flag_name("CVodeGetReturnFlagName", flag)
        failure = f"CVODE failed after t = {reached:.10g} with {name} ({flag}). {ADVICE}"
    kept = times[times <= reached]
    rows = integrate(*arguments, kept, TimeLimit(None))[0] if kept.size else np.empty((0, len(own.start)))
    end = f"CVODE, Adams, reached the end, t = {t_end:g}."
    return _result(problem, own, kept[: len(rows)], rows, failure, end, statistics)


def _checked(
    problem: Problem, t_end: float, t_eval: ArrayLike | None, time_limit: float | None
) -> tuple[Minimal, Array]:
    if not isinstance(problem, Problem):
        raise TypeError(f"problem must be a Problem of twoloop.mechanisms; given {problem!r}")
    *_, times = check_run(problem.system, (0.0, t_end), problem.q0, problem.v0, t_eval, time_limit)
    return _minimal(_Same(problem)), output_times(times, 0.0, t_end)


class _Same:
    """A problem as a key of a cache: that object and no other."""

    def __init__(self, problem: Problem):
        self.problem = problem

    def __hash__(self) -> int:
        return id(self.problem)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Same) and self.problem is other.problem


@lru_cache(maxsize=64)
def _minimal(same: _Same) -> Minimal:
    return minimal(same.problem)


@lru_cache(maxsize=256)
def _integrator(own: Minimal, tol: float) -> tuple[Any, Any]:
    """An integrator, and heyoka's names of outcomes."""
    try:
        import heyoka
    except ImportError as error:
        raise RuntimeError("heyoka is not installed: make peers, or pip install 'twoloop[peers]'") from error
    symbols = heyoka.make_vars(*(f"y{i}" for i in range(len(own.start))))
    rates = own.equations(heyoka)(symbols)
    equations = list(zip(symbols, rates, strict=True))
    integrator = heyoka.taylor_adaptive(equations, list(own.start), tol=tol, fast_math=True, compact_mode=False)
    return integrator, heyoka.taylor_outcome


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
    problem: Problem, own: Minimal, times: Array, rows: Array, failure: str, end: str, statistics: Statistics
) -> Result:
    states = np.concatenate(own.states(rows.T)) if times.size else np.empty((2 * problem.system.n_q, 0))
    return ode_result(problem.system, times, states, failure, end, statistics)
