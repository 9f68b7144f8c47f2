"""SUNDIALS IDA through scikit-sundae on any ConstrainedSystem, with compiled residual and Jacobian.

IDA solves F(t, y, y') = 0 by variable-order BDF (orders 1 to 5), with F from `sundials.residual`. The integrator of
twoloop is not used.
"""

import io
import time
from contextlib import redirect_stdout
from types import SimpleNamespace
from typing import Any

import numpy as np

from references.driver import CAUSES, Deferred, Task, TimeLimit, adapter, user_call
from references.lines import Line
from references.sundials.library import SMALLEST_STEP
from references.sundials.residual import FORMS, NOT_TESTED, Implicit
from twoloop.checks.arguments import check_choice
from twoloop.problem.problem import Array
from twoloop.result.result import Result

ida = Deferred("sksundae.ida", "scikit-sundae")


@adapter(independent_rows=True)
def solve_ida(
    task: Task, form: str = "index1", rtol: float = 1e-8, atol: float = 1e-8, *, max_step: float | None = None
) -> Result:
    """Integrate a constrained mechanical system with IDA.

    Parameters
    ----------
    form : {"index1", "stabilised"}
        Index reduction, see `sundials.residual`.
    rtol, atol : float
        IDA's tolerances for q, v (and Lam, Mu in the stabilised form). At a given tolerance, rounding alone changes
        IDA's choice of steps and orders, so that the final error scatters by a factor of 2 to 24 (15 runs).
    others : see `references.driver`
        t_eval None: every step is stored, for which scikit-sundae copies all previous ones. The Jacobian is computed by
        differences; with `force_by_q`, of the residual without the force.

    Returns
    -------
    Result
        `a` and `lam` are IDA's. `h` contains the steps if every step is stored. Statistics: residual evaluations
        (n_evaluations), Jacobian evaluations, each with a factorisation (n_factorizations), and, if every step is
        stored, n_accepted.
    """
    check_choice("form", form, tuple(FORMS))
    equations, n, t0, t1 = Implicit(task, form), task.system.n_q, task.t0, task.t1
    absolute = np.full(equations.start.shape[1], atol)
    if form == "index1":
        absolute[2 * n :] = NOT_TESTED
    options = {"rtol": rtol, "atol": absolute, "max_num_steps": 10**9}  # steps per output time
    options |= {"min_step": SMALLEST_STEP * (t1 - t0), "max_step": task.longest(max_step)}
    limit, said = TimeLimit(task.time_limit), io.StringIO()
    solver = _solver(equations, t0, options, limit)
    with redirect_stdout(said), user_call:
        if task.times is None:
            outcome = solver.solve(np.array([t0, t1]), *equations.start)
        else:
            solver.init_step(t0, *equations.start)
            outcome = solver.step(t1, tstop=t1)
    shown, end, failure = outcome, float(np.max(outcome.t)), ""
    if task.times is not None:
        solver = _solver(equations, t0, options, TimeLimit(None))
        shown = states_at(solver, (t0, t1), task.times[task.times <= outcome.t], *equations.start)
    if outcome.status < 0 and limit.exceeded:
        failure = limit.message("IDA", end, "take looser tolerances")
    elif outcome.status < 0:
        told = " ".join([outcome.message, *said.getvalue().split()])
        advice = f"{CAUSES} the other form or other tolerances."
        failure = f"IDA failed after t = {end:.10g} with status {outcome.status}: {told} {advice}"
    keep = np.diff(shown.t, prepend=-np.inf) > 0.0  # a failed run contains its last state twice
    t, rows = shown.t[keep], equations.columns(shown.y.T, shown.yp.T)[:, keep]
    counts = {"n_evaluations": int(outcome.nfev), "n_factorizations": int(outcome.njev)}
    if task.times is not None:
        return task.result("IDA", t, rows, failure, **counts)
    return task.result("IDA", t, rows, failure, h=np.diff(t), n_accepted=t.size - 1, **counts)


def states_at(solver: Any, span: tuple[float, float], times: Array, *start: Array) -> SimpleNamespace:
    """Return the states of a solver of scikit-sundae at times reached before, with the same steps."""
    t0, t1 = span
    shown = [solver.init_step(t0, *start)]
    if times.size and times[-1] > t0:
        solver.step(t1, "onestep", t1)  # the first step size depends on the end time
        shown += [solver.step(stop, tstop=t1) for stop in times[times > t0].tolist()]
    if not (times.size and times[0] == t0):
        shown = shown[1:]
    size = start[0].size
    y, yp = (np.array([getattr(each, name, each.y) for each in shown]).reshape(-1, size) for name in ("y", "yp"))
    return SimpleNamespace(t=times, y=y, yp=yp)


def _solver(equations: Implicit, t0: float, options: dict[str, Any], limit: TimeLimit) -> Any:
    """Return scikit-sundae's IDA with compiled functions called through Python.

    After the time limit the residual is NaN, so that IDA fails and returns its states; with an exception they are lost.
    """
    residual, matrix, space, state = equations.residual, equations.matrix, equations.space, equations.start.copy()
    monotonic, deadline = time.monotonic, limit.deadline  # inlined: calling `limit` would cost 3 % of an evaluation

    def resfn(t, y, yp, res):  # type: ignore[no-untyped-def]
        if monotonic() > deadline and limit.passed():
            res[:] = np.nan
        else:
            state[0], state[1] = y, yp  # copies of read-only arrays
            residual(t, state[0], state[1], *space[:3], res)

    def jacfn(t, y, yp, res, cj, JJ):  # type: ignore[no-untyped-def]
        if not limit.exceeded:
            state[0], state[1] = y, yp
            JJ[:] = 0.0  # contains the values of the last call
            matrix(t, cj, state[0], state[1], *space, JJ.T)

    size = state.shape[1]
    residual(t0, state[0], state[1], *space[:3], np.empty(size))  # compiles
    matrix(t0, 1.0, state[0], state[1], *space, np.zeros((size, size)).T)
    return ida.IDA(resfn, jacfn=jacfn, **options)


HOW: dict[str, Any] = {"called_from": "Python", "own_accelerations": True, "scatters": True}
LINES = (
    Line("IDA, index1", "scikit-sundae", "SUNDIALS", solve_ida, {"form": "index1"}, keeps=False, compared=False, **HOW),
    Line("IDA, stabilised", "scikit-sundae", "SUNDIALS", solve_ida, {"form": "stabilised"}, checked=True, **HOW),
)
