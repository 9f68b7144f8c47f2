"""Dopri8 of diffrax (P. Kidger) on a ConstrainedSystem: the right-hand side traced by JAX and compiled with the loop.

The equations come from `equations.expressions`. Constraints drift.
"""

from collections.abc import Callable
from functools import lru_cache
from typing import Any

import numpy as np

from references.driver import ADVICE, Task, TimeLimit, adapter, imported, user_call
from references.equations.expressions import Expressions, NotSymbolic, expressions_at, functions_of
from references.lines import Line
from twoloop.checks.arguments import check_size
from twoloop.problem.system import ConstrainedSystem
from twoloop.result.result import Result

LARGEST = 9  # coordinates; larger systems take too long to compile
MAX_STEPS = 10**6  # some seconds, because compiled code cannot check the clock


@adapter(derivatives=False)
def solve_diffrax(task: Task, rtol: float = 1e-8, atol: float = 1e-8, *, most_steps: int = MAX_STEPS) -> Result:
    """Integrate a constrained mechanical system, as the ODE q' = v, v' = a(t, q, v), with diffrax's Dopri8.

    Settings: 64-bit numbers; the whole integration compiled once per system, with the tolerances as arguments; the
    default integral controller, which is faster here than a proportional one; no adjoint, because nothing is
    differentiated; the timed run stores the final state only. Output by the interpolant of order 8.

    Parameters, errors and result as in `references.driver`, for at most `LARGEST` coordinates; statistics: n_accepted,
    n_rejected_error and n_evaluations (13 per step). Compiled code does not check the clock: a run ends after
    `most_steps` steps, including rejected ones, and counts as failed if it took longer than the time limit.
    """
    most_steps, system = check_size("most_steps", most_steps, 1), task.system
    t0, t1, times, start = task.t0, task.t1, task.instants, task.y0
    if system.n_q > LARGEST:
        raise NotSymbolic(
            f"system must have at most {LARGEST} coordinates for diffrax; {system.name!r} has {system.n_q}"
        )
    solve, warm_up_end = _compiled(*task.key, most_steps), t0 + 1e-6 * (t1 - t0)
    solve(t0, warm_up_end, start, rtol, atol, np.array([warm_up_end]))  # compiles
    limit, end = TimeLimit(task.time_limit), np.array([t1])
    with user_call:
        _, status, steps, rejected = solve(t0, t1, start, rtol, atol, end)
    states, failure = np.empty((start.size, 0)), ""
    if limit.passed():
        failure, times = limit.message("diffrax", t1, "take looser tolerances"), times[:0]
    else:
        states = solve(t0, t1, start, rtol, atol, times)[0].T
        if status:
            too_many = steps + rejected >= most_steps
            reason = f"{most_steps} steps were not enough" if too_many else f"diffrax says: {status}"
            failure, finite = f"diffrax failed: {reason}. {ADVICE}", np.isfinite(states).all(axis=0)
            times, states = times[finite], states[:, finite]
    counts = {"n_accepted": steps, "n_rejected_error": rejected, "n_evaluations": 13 * (steps + rejected)}
    return task.result("diffrax", times, states, failure, **counts)


@lru_cache(maxsize=256)
def _compiled(system: ConstrainedSystem, t0: float, q0: bytes, v0: bytes, most_steps: int) -> Callable[..., Any]:
    """Return (t0, t1, y0, rtol, atol, times) -> states as rows, error message or "", steps, rejected steps."""
    jax, diffrax = packages()
    derivative = derivative_of(expressions_at(system, t0, q0, v0))

    @jax.jit
    def run(t0: Any, t1: Any, y0: Any, rtol: Any, atol: Any, times: Any) -> Any:
        return solve_by_dopri8(derivative, t0, t1, y0, (rtol, atol), diffrax.SaveAt(ts=times), most_steps)

    def solve(*arguments: Any) -> Any:
        solution = jax.block_until_ready(run(*arguments))
        good = bool(solution.result == diffrax.RESULTS.successful)
        counts = (int(solution.stats[f"num_{kind}_steps"]) for kind in ("accepted", "rejected"))
        return np.array(solution.ys), "" if good else str(solution.result), *counts

    return solve


def packages() -> tuple[Any, Any]:
    """Return JAX, set to 64-bit numbers, and diffrax."""
    diffrax, jax = imported("diffrax"), imported("jax")
    jax.config.update("jax_enable_x64", True)
    return jax, diffrax


def derivative_of(equations: Expressions) -> Callable[[Any, Any, Any], Any]:
    """Return (t, y, parameters or None) -> y', y = [q, v], in diffrax's signature."""
    (jax, _), n = packages(), equations.system.n_q
    functions = functions_of(jax.numpy)

    def derivative(t: Any, y: Any, p: Any) -> Any:
        q, v, parameters = ([x[i] for i in range(len(x))] for x in (y[:n], y[n:], () if p is None else p))
        a = equations.accelerations(functions, t, q, v, parameters)
        return jax.numpy.concatenate([y[n:], jax.numpy.stack([jax.numpy.asarray(component) for component in a])])

    return derivative


def solve_by_dopri8(
    derivative: Any, t0: Any, t1: Any, y0: Any, tolerances: tuple[Any, Any], saveat: Any, most_steps: int, p: Any = None
) -> Any:
    """Return diffrax's solution by Dopri8 with its default controller."""
    _, diffrax = packages()
    rtol, atol = tolerances
    controller = diffrax.PIDController(rtol=rtol, atol=atol)
    options = {"args": p, "saveat": saveat, "stepsize_controller": controller, "max_steps": most_steps, "throw": False}
    term = diffrax.ODETerm(derivative)
    return diffrax.diffeqsolve(term, diffrax.Dopri8(), t0=t0, t1=t1, dt0=None, y0=y0, **options)


LINES = (Line("Dopri8, diffrax", "diffrax", "diffrax", solve_diffrax, keeps=False, checked=True, traces=True),)
