"""SUNDIALS CVODE through scikit-sundae, as its users call it: the compiled right-hand side is called through Python.

The equations are those of `scipy.index1` without stabilisation. See `sundials.cvode_c` for CVODE without Python.
"""

import io
from contextlib import redirect_stdout, suppress
from typing import Any

import numpy as np

from references.driver import ADVICE, OutOfTimeError, Task, TimeLimit, adapter, imported, user_call
from references.lines import Line
from references.scipy.index1 import RightHandSide
from references.sundials.library import SMALLEST_STEP
from twoloop.problem.problem import Array
from twoloop.result.result import Result

MOST_STEPS = 10**7  # between two output times; the default of 500 is too small


@adapter(derivatives=False, independent_rows=True)
def solve_cvode(task: Task, rtol: float = 1e-8, atol: float = 1e-8) -> Result:
    """Integrate a constrained mechanical system, as the ODE q' = v, v' = a(t, q, v), with Adams' methods in CVODE.

    Settings: a compiled right-hand side, and its analytic Jacobian where `equations.straight_line` has it; orders up to
    12; Newton's iteration, the only one available in scikit-sundae. The integration to the end without output is timed.

    Parameters, errors and result as in `references.driver`; statistics: n_evaluations, all calls of the right-hand
    side.
    """
    CVODE = imported("sksundae.cvode", "scikit-sundae", "references").CVODE
    from references.sundials.ida import states_at

    t0, t1, times, y0 = task.t0, task.t1, task.instants, task.y0
    equations = RightHandSide(task.system, t0, task.q0, 0.0)
    y0.setflags(write=False)  # read-only as in CVODE, so that the same signature is compiled
    equations.warm(t0, y0, False)
    options: dict[str, Any] = {"method": "Adams", "rtol": rtol, "atol": atol, "max_num_steps": MOST_STEPS}
    options |= {"min_step": SMALLEST_STEP * (t1 - t0), "max_step": t1 - t0}
    jacobian = equations.jacobian(t0, y0)

    def integrator(limit: TimeLimit) -> Any:
        derivative = equations.function(limit)

        def right_hand_side(t: float, y: Array, rate: Array) -> None:
            rate[:] = derivative(t, y)

        def jacfn(t: float, y: Array, rate: Array, JJ: Array) -> None:
            JJ[:] = jacobian(t, y)  # type: ignore[misc]

        return CVODE(right_hand_side, jacfn=None if jacobian is None else jacfn, **options)

    limit = TimeLimit(task.time_limit)
    timed, outcome = integrator(limit), None
    with redirect_stdout(io.StringIO()), user_call, suppress(OutOfTimeError):  # CVODE prints its failures
        timed.init_step(t0, y0)
        outcome = timed.step(t1, tstop=t1)
    name, counts = "CVODE, Adams,", {"n_evaluations": int(equations.counters[0])}
    if outcome is None:
        failure = limit.message("CVODE", t0, "take looser tolerances")
        return task.result(name, times[:0], np.empty((y0.size, 0)), failure, **counts)
    failure = "" if outcome.success else f"CVODE failed after t = {outcome.t:.10g}: {outcome.message}. {ADVICE}"
    shown = states_at(integrator(TimeLimit(None)), (t0, t1), times[times <= outcome.t], y0)
    return task.result(name, shown.t, shown.y.T, failure, **counts)


LINES = (
    Line("CVODE, Adams", "scikit-sundae", "SUNDIALS", solve_cvode, called_from="Python", keeps=False, checked=True),
)
