"""Dopri8 of diffrax (P. Kidger) on a ConstrainedSystem: the right-hand side traced by JAX and compiled with the loop.

The equations are those that `equations.expressions` makes of the callbacks. Constraints are not kept. The package is
optional: `make peers`, or the extra `peers`.
"""

from collections.abc import Callable
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from references.driver import ADVICE, TimeLimit, check_task, imported, user_call
from references.equations.expressions import Expressions, NotSymbolic, expressions_at, functions_of
from references.equations.ode import ode_result
from twoloop.checks.arguments import check_size
from twoloop.problem.system import ConstrainedSystem
from twoloop.result.result import Result
from twoloop.run.record import Statistics

Array = NDArray[np.float64]

LARGEST = 9  # coordinates; the compilation of more takes too long
MOST_STEPS = 10**6  # some seconds, in which compiled code looks at no clock; who gets no farther was "not asked"


def solve_diffrax(
    system: ConstrainedSystem,
    t_span: tuple[float, float],
    q0: ArrayLike,
    v0: ArrayLike,
    rtol: float = 1e-8,
    atol: float = 1e-8,
    *,
    t_eval: ArrayLike | None = None,
    time_limit: float | None = None,
    most_steps: int = MOST_STEPS,
) -> Result:
    """Integrate a constrained mechanical system, as the ODE q' = v, v' = a(t, q, v), with diffrax's Dopri8.

    What it was given: 64-bit numbers; the whole integration compiled once a system, tolerances being arguments; the
    integral controller of its default, which is quicker here than a proportional one; `DirectAdjoint` is not needed,
    for nothing is differentiated; the run that is timed stores the end alone.

    Parameters
    ----------
    system, t_span, q0, v0, rtol, atol, t_eval : see `references.driver`
        At most `LARGEST` coordinates.
    time_limit : float, optional
        See `references.driver`. Compiled code does not look at the clock: a run ends after `most_steps` steps, and one
        that took longer than the limit is a failed one.
    most_steps : int
        Steps after which a run ends, rejected ones included.

    Returns
    -------
    Result
        `a` and `lam` from eq. (6) at the stored states; between steps those of the interpolant, of order 8. Of the
        statistics: n_accepted, n_rejected_error and n_evaluations (13 a step).
    """
    most_steps = check_size("most_steps", most_steps, 1)
    task = check_task(system, t_span, q0, v0, t_eval, time_limit, (rtol, atol), derivatives=False)
    system, t0, t1, times, start = task.system, task.t0, task.t1, task.instants, task.y0
    if system.n_q > LARGEST:
        raise NotSymbolic(
            f"system must have at most {LARGEST} coordinates for diffrax; {system.name!r} has {system.n_q}"
        )
    solve = _compiled(*task.key, most_steps)
    start = np.concatenate([q0, v0])

    end, soon = np.array([t1]), t0 + 1e-6 * (t1 - t0)
    solve(t0, soon, start, rtol, atol, np.array([soon]))  # compiles
    limit = TimeLimit(time_limit)
    with user_call as clock:
        _, status, steps, rejected = solve(t0, t1, start, rtol, atol, end)
    statistics = Statistics(
        n_accepted=steps,
        n_rejected_error=rejected,
        n_evaluations=13 * (steps + rejected),
        cpu_time=clock.seconds or 0.0,
    )
    if limit.passed():
        failure = limit.message("diffrax", t1, "take looser tolerances")
        return ode_result(system, times[:0], np.empty((start.size, 0)), failure, "", statistics)
    states, failure = solve(t0, t1, start, rtol, atol, times)[0].T, ""
    if status:
        reason = f"{most_steps} steps were not enough" if steps + rejected >= most_steps else f"diffrax says: {status}"
        failure = f"diffrax failed: {reason}. {ADVICE}"
        kept = np.isfinite(states).all(axis=0)
        times, states = times[kept], states[:, kept]
    return ode_result(system, times, states, failure, f"diffrax reached the end, t = {t1:g}.", statistics)


@lru_cache(maxsize=256)
def _compiled(system: ConstrainedSystem, t0: float, q0: bytes, v0: bytes, most_steps: int) -> Callable[..., Any]:
    """(t0, t1, y0, rtol, atol, times) -> states as rows, what failed ("": nothing), steps, rejected ones."""
    jax, diffrax = packages()
    derivative = derivative_of(expressions_at(system, t0, q0, v0))

    @jax.jit
    def run(t0: Any, t1: Any, y0: Any, rtol: Any, atol: Any, times: Any) -> Any:
        return solved(derivative, t0, t1, y0, (rtol, atol), diffrax.SaveAt(ts=times), most_steps)

    def solve(t0: float, t1: float, y0: Array, rtol: float, atol: float, times: Array) -> Any:
        found = jax.block_until_ready(run(t0, t1, y0, rtol, atol, times))
        good = bool(found.result == diffrax.RESULTS.successful)
        counts = (int(found.stats[f"num_{kind}_steps"]) for kind in ("accepted", "rejected"))
        return np.array(found.ys), "" if good else str(found.result), *counts

    return solve


def packages() -> tuple[Any, Any]:
    """JAX, set to numbers of 64 bits, and diffrax."""
    diffrax, jax = imported("diffrax"), imported("jax")
    jax.config.update("jax_enable_x64", True)
    return jax, diffrax


def derivative_of(equations: Expressions) -> Callable[[Any, Any, Any], Any]:
    """(t, y, parameters or None) -> y', y = [q, v], as diffrax calls it."""
    (jax, _), n = packages(), equations.system.n_q
    functions = functions_of(jax.numpy)

    def derivative(t: Any, y: Any, p: Any) -> Any:
        q, v, parameters = ([x[i] for i in range(len(x))] for x in (y[:n], y[n:], () if p is None else p))
        a = equations.accelerations(functions, t, q, v, parameters)
        return jax.numpy.concatenate([y[n:], jax.numpy.stack([jax.numpy.asarray(each) for each in a])])

    return derivative


def solved(
    derivative: Any, t0: Any, t1: Any, y0: Any, tolerances: tuple[Any, Any], saveat: Any, most_steps: int, p: Any = None
) -> Any:
    """What diffrax makes of it, by Dopri8 with the controller of its default."""
    _, diffrax = packages()
    rtol, atol = tolerances
    return diffrax.diffeqsolve(
        diffrax.ODETerm(derivative),
        diffrax.Dopri8(),
        t0=t0,
        t1=t1,
        dt0=None,
        y0=y0,
        args=p,
        saveat=saveat,
        stepsize_controller=diffrax.PIDController(rtol=rtol, atol=atol),
        max_steps=most_steps,
        throw=False,
    )
