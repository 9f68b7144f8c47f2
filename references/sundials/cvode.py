"""SUNDIALS CVODE through scikit-sundae, as its users call it: the right-hand side is a compiled function behind Python.

The equations are those of `scipy.index1` without stabilisation. Without Python in its way: `sundials.cvode_c`.
"""

from contextlib import suppress
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from references.driver import OutOfTimeError, TimeLimit, check_choice, check_run, check_tolerances, user_call
from references.equations.nonholonomic import with_all_rows
from references.equations.ode import ADVICE, ode_result, output_times, states_at
from references.equations.redundant_rows import on_independent_rows
from references.scipy.index1 import RightHandSide
from twoloop.checks.consistency import check_start
from twoloop.problem.system import ConstrainedSystem
from twoloop.result.result import Result
from twoloop.run.record import Statistics

Array = NDArray[np.float64]

METHODS = ("Adams", "BDF")
MOST_STEPS = 10**7  # between two output times; its own 500 are soon used up


@on_independent_rows
def solve_cvode(
    system: ConstrainedSystem,
    t_span: tuple[float, float],
    q0: ArrayLike,
    v0: ArrayLike,
    method: str = "Adams",
    rtol: float = 1e-8,
    atol: float = 1e-8,
    *,
    t_eval: ArrayLike | None = None,
    time_limit: float | None = None,
) -> Result:
    """Integrate a constrained mechanical system, as the ODE q' = v, v' = a(t, q, v), with CVODE of scikit-sundae.

    What it was given: a right-hand side that numba compiled, and its analytic Jacobian as straight-line code, up to
    `straight_line.MOST_OPERATIONS`, else differences; timed is the integration to the end, without output.

    Parameters
    ----------
    system : ConstrainedSystem
        The problem. Its callbacks are compiled at the first run (a few seconds).
    t_span : (float, float)
        Start and end, s; the end after the start.
    q0, v0 : array_like (n_q,)
        Consistent initial coordinates and velocities.
    method : {"Adams", "BDF"}
        Orders up to 12, or up to 5; both with Newton's iteration, scikit-sundae's only one.
    rtol, atol : float
        CVODE's tolerances.
    t_eval : array_like, optional
        Increasing times in t_span at which to store the solution, interpolated by CVODE, in a second run of the same
        steps that is not timed. None: 1001 times, evenly.
    time_limit : float, optional
        Wall-clock time that the integration may take, s, looked at in every evaluation. None: no limit.

    Returns
    -------
    Result
        `a` and `lam` from eq. (6) at the stored states; `h` is empty. Of the statistics: n_evaluations, all calls of
        the right-hand side, and cpu_time. A failure gives `Status.SOLVER_FAILED` and scikit-sundae's text.

    Raises
    ------
    TypeError, ValueError
        If an argument is wrong: before any work, naming it.
    RuntimeError
        If scikit-sundae is not installed.
    """
    check_choice("method", method, METHODS)
    check_tolerances(rtol, atol)
    t0, t1, q0, v0, times = check_run(system, t_span, q0, v0, t_eval, time_limit, takes_velocity_rows=True)
    times = output_times(times, t0, t1)
    check_start(system, t0, q0, v0, derivatives=False)
    system = with_all_rows(system)
    try:
        from sksundae.cvode import CVODE
    except ImportError as error:
        raise RuntimeError("scikit-sundae is not installed: pip install 'twoloop[references]'") from error

    equations, y0 = RightHandSide(system, t0, q0, 0.0), np.concatenate([q0, v0])
    y0.setflags(write=False)  # as CVODE hands it over, so that what is compiled here is what it calls
    equations.warm(t0, y0, False)
    options: dict[str, Any] = {"method": method, "rtol": float(rtol), "atol": float(atol), "max_num_steps": MOST_STEPS}
    jacobian = equations.jacobian(t0, y0)

    def integrator(limit: TimeLimit) -> Any:
        derivative = equations.function(limit)

        def right_hand_side(t: float, y: Array, rate: Array) -> None:
            rate[:] = derivative(t, y)

        def jacfn(t: float, y: Array, rate: Array, JJ: Array) -> None:
            JJ[:] = jacobian(t, y)  # type: ignore[misc]

        return CVODE(right_hand_side, jacfn=None if jacobian is None else jacfn, **options)

    limit = TimeLimit(time_limit)
    timed, outcome = integrator(limit), None
    with user_call as clock, suppress(OutOfTimeError):
        timed.init_step(t0, y0)
        outcome = timed.step(t1, tstop=t1)
    statistics = Statistics(n_evaluations=int(equations.counters[0]), cpu_time=clock.seconds or 0.0)
    if outcome is None:
        failure = limit.message("CVODE", t0, "take looser tolerances")
        return ode_result(system, times[:0], np.empty((y0.size, 0)), failure, "", statistics)
    failure = "" if outcome.success else f"CVODE failed after t = {outcome.t:.10g}: {outcome.message}. {ADVICE}"
    shown = states_at(integrator(TimeLimit(None)), (t0, t1), times[times <= outcome.t], y0)
    end = f"CVODE, {method}, reached the end, t = {t1:g}."
    return ode_result(system, shown.t, shown.y.T, failure, end, statistics)
