"""SUNDIALS IDA, by scikit-sundae, on any ConstrainedSystem: residual and Jacobian compiled from its callbacks.

IDA solves F(t, y, y') = 0 by variable-order BDF (orders 1 to 5); `sundials.residual` has F. Nothing here uses the
integrator of twoloop.

The highest order and what the error test sees are for systems with fast vibrations that hardly matter. Velocities keep
such vibrations in the error test however loose it is, and the BDF of orders 3 to 5 are unstable for undamped ones that
the step does not resolve. With orders up to 2, and only positions tested, IDA may step over them: on the moderately
stiff beam (`twoloop.mechanisms`, 2 s) that brings the tip's height to 1e-3 m in 3,500 steps, where the defaults take
115,000 even at tolerances of 1e-3, and reach 6e-6 m. On the very flexible beam, whose large motion the vibrations do
change, nothing is gained. The exact tangent saves up to a quarter of the time where Jacobians are frequent, and nothing
where they are not.
"""

import io
import time
from contextlib import redirect_stdout
from types import SimpleNamespace
from typing import Any

import numpy as np
import sksundae
from numpy.typing import ArrayLike, NDArray

from references.driver import CAUSES, Task, TimeLimit, check_choice, check_task, longest_step, result_of, user_call
from references.equations.rows import on_independent_rows
from references.sundials.residual import (
    ALL,
    FORMS,
    columns_of,
    iteration_matrix_at,
    parts_of,
    residual_at,
    space_of,
    start_of,
)
from twoloop.checks.arguments import check_size
from twoloop.problem.system import ConstrainedSystem
from twoloop.result.result import Result
from twoloop.run.record import Statistics

Array = NDArray[np.float64]

ERROR_TESTS = {
    "all": "all unknowns but the algebraic ones",
    "states": "coordinates and velocities, not the integrals of the multipliers",
    "positions": "coordinates only",
}
HIGHEST_ORDER = 5  # of IDA
NOT_TESTED = 1e12  # the absolute tolerance that takes an unknown out of IDA's error test, and out of Newton's
SMALLEST_STEP = (
    1e-12  # of the length of t_span; without a smallest step IDA shrinks its steps towards a NaN without end
)


@on_independent_rows
def solve_ida(
    system: ConstrainedSystem,
    t_span: tuple[float, float],
    q0: ArrayLike,
    v0: ArrayLike,
    form: str = "index1",
    rtol: float = 1e-8,
    atol: float = 1e-8,
    *,
    t_eval: ArrayLike | None = None,
    max_order: int = HIGHEST_ORDER,
    error_test: str = "all",
    time_limit: float | None = None,
    max_step: float | None = None,
) -> Result:
    """Integrate a constrained mechanical system with IDA.

    Parameters
    ----------
    system, t_span, q0, v0, time_limit, max_step : see `references.driver`
        The Jacobian is by differences; with `force_by_q` what is differenced is the residual without the force.
    form : {"index1", "stabilised"}
        How the index is reduced: `sundials.residual`.
    rtol, atol : float
        IDA's tolerances for q, v (and Lam, Mu in the stabilised form). At a given tolerance the error at the end
        scatters by a factor of 2 to 24 (15 runs) with rounding alone, which changes IDA's choice of steps and orders.
    t_eval : array_like, optional
        See `references.driver`. None: every step is stored, which scikit-sundae does by copying all before it.
    max_order : int
        The highest order of the BDF, 1 to 5. Those above 2 are unstable for undamped vibrations that the step does not
        resolve.
    error_test : {"all", "states", "positions"}
        What the error test, and that of Newton's iteration, sees: all unknowns but the algebraic lam of the form
        "index1", q and v, or q alone. IDA's norm is a mean over all unknowns: the fewer it sees, the looser the same
        tolerance. In the form "stabilised" q may then have an error sqrt((2 n_q + 2 n_c)/n_q) times as large, and q
        and v one sqrt(1 + n_c/n_q) times as large.

    Returns
    -------
    Result
        `a` and `lam` as IDA has them. `h` holds the steps when every step is stored. Of the statistics IDA tells
        residual evaluations (n_evaluations), Jacobian evaluations, each with its factorisation (n_factorizations), and,
        when every step is stored, n_accepted.
    """
    check_choice("form", form, FORMS)
    max_order = check_options(max_order, error_test)
    task = check_task(system, t_span, q0, v0, t_eval, time_limit, (rtol, atol))
    start, span = start_of(task.system, form, task.t0, task.q0, task.v0), (task.t0, task.t1)
    absolute = tolerances(task.system, start.shape[1], error_test, float(atol))
    if form == "index1":
        absolute[2 * task.system.n_q :] = NOT_TESTED
    limit, said = TimeLimit(time_limit), io.StringIO()
    options = {
        "rtol": float(rtol),
        "atol": absolute,
        "max_order": max_order,
        "min_step": SMALLEST_STEP * (task.t1 - task.t0),
        "max_step": longest_step(max_step, task.t1 - task.t0),
        "max_num_steps": 10**9,  # per output time
    }
    solver = _solver(task, form, start, options, limit)
    with redirect_stdout(said), user_call as clock:
        if task.times is None:
            outcome = solver.solve(np.array(span), *start)
        else:
            solver.init_step(task.t0, *start)
            outcome = solver.step(task.t1, tstop=task.t1)
    shown = outcome
    if task.times is not None:
        solver = _solver(task, form, start, options, TimeLimit(None))
        shown = states_at(solver, span, task.times[task.times <= outcome.t], *start)
    return _result(task, form, outcome, shown, said.getvalue(), clock.seconds or 0.0, limit)


def check_options(max_order: int, error_test: str) -> int:
    """Return the highest order as an int, or say what is wrong with these options."""
    max_order = check_size("max_order", max_order, 1)
    if max_order > HIGHEST_ORDER:
        raise ValueError(f"max_order must be at most {HIGHEST_ORDER}, the highest of IDA; given {max_order}")
    check_choice("error_test", error_test, ERROR_TESTS)
    return max_order


def tolerances(system: ConstrainedSystem, size: int, error_test: str, atol: float) -> Array:
    """Absolute tolerances (size,) of the unknowns q, v and whatever else there is."""
    each = np.full(size, atol)
    if error_test != "all":
        each[system.n_q * (1 if error_test == "positions" else 2) :] = NOT_TESTED
    return each


def states_at(solver: Any, span: tuple[float, float], times: Array, *start: Array) -> SimpleNamespace:
    """The states of a solver of scikit-sundae at times that the same steps have reached before."""
    t0, t1 = span
    shown = [solver.init_step(t0, *start)]
    if times.size and times[-1] > t0:
        solver.step(t1, "onestep", t1)  # the length of the first step depends on where it is to go
        shown += [solver.step(stop, tstop=t1) for stop in times[times > t0].tolist()]
    if not (times.size and times[0] == t0):
        shown = shown[1:]
    size = start[0].size
    y, yp = (np.array([getattr(each, name, each.y) for each in shown]).reshape(-1, size) for name in ("y", "yp"))
    return SimpleNamespace(t=times, y=y, yp=yp)


def positions_of(task: Task) -> int:
    """How many rows are of C."""
    return task.n_c if task.system.n_c > task.n_c else ALL


def _solver(task: Task, form: str, start: Array, options: dict[str, Any], limit: TimeLimit) -> Any:
    """scikit-sundae's IDA, of compiled functions behind Python ones.

    Past the time limit the residual is NaN: IDA then fails and returns what it has, which is lost with an exception.
    """
    parts = parts_of(task.system, form, positions_of(task))
    residual, matrix = residual_at(parts), iteration_matrix_at(parts)
    space, state = space_of(task.system, form, task.t0, task.q0), start.copy()
    monotonic, deadline = time.monotonic, limit.deadline  # a call of `limit` would be 3 % of an evaluation

    def resfn(t, y, yp, res):  # type: ignore[no-untyped-def]
        if monotonic() > deadline and limit.passed():
            res[:] = np.nan
        else:
            state[0], state[1] = y, yp  # which are read-only arrays
            residual(t, state[0], state[1], *space[:3], res)

    def jacfn(t, y, yp, res, cj, JJ):  # type: ignore[no-untyped-def]
        if not limit.exceeded:
            state[0], state[1] = y, yp
            JJ[:] = 0.0  # it arrives as the last call left it
            matrix(t, cj, state[0], state[1], *space, JJ.T)

    residual(task.t0, state[0], state[1], *space[:3], np.empty(start.shape[1]))  # compiles
    matrix(task.t0, 1.0, state[0], state[1], *space, np.zeros((start.shape[1],) * 2).T)
    return sksundae.ida.IDA(resfn, jacfn=jacfn, **options)


def _result(task: Task, form: str, outcome: Any, shown: Any, said: str, cpu: float, limit: TimeLimit) -> Result:
    """The Result of the states `shown`, of a run that ended as `outcome` says."""
    keep = np.append(True, np.diff(shown.t) > 0.0)  # a failed run comes with its last state twice
    end, failure, every_step = float(np.max(outcome.t)), "", task.times is None
    if outcome.status < 0 and limit.exceeded:
        failure = limit.message("IDA", end, "take looser tolerances")
    elif outcome.status < 0:
        told = " ".join([outcome.message, *said.split()])
        failure = (
            f"IDA failed after t = {end:.10g} with status {outcome.status}: {told} {CAUSES} the other form or other "
            "tolerances."
        )
    statistics = Statistics(
        n_accepted=int(keep.sum()) - 1 if every_step else None,
        n_evaluations=int(outcome.nfev),
        n_factorizations=int(outcome.njev),
        cpu_time=cpu,
    )
    n, m, t = task.system.n_q, task.system.n_c, shown.t[keep]
    columns = columns_of(form, n, m, shown.y.T, shown.yp.T)[:, keep]
    h = np.diff(t) if every_step else None
    return result_of(n, t, columns, f"IDA reached the end, t = {end:g}.", failure, statistics, h)
