"""The Taylor integrator of heyoka.py (F. Biscani and D. Izzo, MNRAS 504 (2021) 2614-2628) on a ConstrainedSystem.

It takes the right-hand side as expressions, from `equations.expressions`, and compiles an integrator for each mechanism
and tolerance, which determines the order; the step size follows from the radius of convergence. Constraints drift.
"""

from functools import lru_cache
from typing import Any

import numpy as np

from references.driver import ADVICE, Task, TimeLimit, adapter, imported, user_call
from references.equations.expressions import Expressions, expressions_at, functions_of
from references.lines import Line
from twoloop.problem.problem import Array
from twoloop.problem.system import ConstrainedSystem
from twoloop.result.result import Result

LARGEST_UNROLLED = 21  # coordinates; for larger systems an unrolled integrator may take minutes to build per tolerance
STEPS = 20_000  # between two checks of the clock, over the number of coordinates: each costs as much as some steps


@adapter(derivatives=False)
def solve_heyoka(task: Task, tol: float = 1e-8, *, max_step: float | None = None) -> Result:
    """Integrate a constrained mechanical system, as the ODE q' = v, v' = a(t, q, v), with heyoka's Taylor integrator.

    Accelerations are eliminated symbolically, exploiting structural zeros, in a minimum-degree order. Up to
    `LARGEST_UNROLLED` coordinates the form is the default, unrolled one (`compact_mode=False`) with `fast_math`, beyond
    it the compact one without, whose steps then take a fifth less time. A second use of the integrator is timed, as in
    its tutorials: time and state are set, and `propagate_until` is called without output. The clock is checked every
    `STEPS` / n_q steps.

    Parameters, errors and result as in `references.driver`; statistics: n_accepted. The integrator is cached for the
    next run of the same system, start and tolerance, and its machine code in heyoka's own cache on disk.
    """
    integrator, longest = _integrator(*task.key, tol), task.longest(max_step)
    name, times, rows, failure, steps = integrate(integrator, task.y0, task, longest)
    return task.result(name, times, rows.T, failure, n_accepted=steps)


def integrate(integrator: Any, start: Array, task: Task, longest: float) -> tuple[str, Array, Array, str, int]:
    """Return the integrator's name, times reached, rows y there, error message or "", and number of steps."""
    outcomes, limit, steps = imported("heyoka").taylor_outcome, TimeLimit(task.time_limit), 0
    most = STEPS // task.system.n_q
    with user_call:
        integrator.time, integrator.state[:] = task.t0, start
        while True:
            outcome, _, _, n_taken, *_ = integrator.propagate_until(task.t1, max_steps=most, max_delta_t=longest)
            steps += n_taken
            if outcome != outcomes.step_limit or limit.passed():
                break
    reached, failure = float(integrator.time), ""
    if outcome == outcomes.step_limit:
        failure = limit.message("heyoka", reached, "take looser tolerances")
    elif outcome != outcomes.time_limit:  # heyoka's status at the end time
        failure = f"heyoka failed after t = {reached:.10g} with {outcome.name}. {ADVICE}"
    times = task.instants[task.instants <= (reached if failure else task.t1)]
    integrator.time, integrator.state[:] = task.t0, start
    grid = times if times.size and times[0] == task.t0 else np.append(task.t0, times)  # must start at the current time
    rows = integrator.propagate_grid(grid, max_delta_t=longest)[-1][grid.size - times.size :]
    times = times[: len(rows)]  # a failure may come earlier this time
    return f"heyoka, order {integrator.order},", times, rows, failure, steps


def rates_of(equations: Expressions, parameters: list[Any] | None = None) -> list[tuple[Any, Any]]:
    """Return heyoka's variables q, v and their rates."""
    package, n = imported("heyoka"), equations.system.n_q
    symbols = package.make_vars(*(f"{name}{i}" for name in "qv" for i in range(n)))
    state = package.time, symbols[:n], symbols[n:]
    rates = [*symbols[n:], *equations.accelerations(functions_of(package), *state, parameters or [])]
    rates = [package.expression(rate) if isinstance(rate, float) else rate for rate in rates]
    return list(zip(symbols, rates, strict=True))


def build_integrator(motion: list[tuple[Any, Any]], start: Any, t0: float, tol: float, unrolled: bool) -> Any:
    """Return the integrator of variables and their rates."""
    options = {"time": t0, "tol": tol, "fast_math": unrolled, "compact_mode": not unrolled}
    return imported("heyoka").taylor_adaptive(motion, start, **options)


@lru_cache(maxsize=256)
def _integrator(system: ConstrainedSystem, t0: float, q0: bytes, v0: bytes, tol: float) -> Any:
    motion, start = rates_of(expressions_at(system, t0, q0, v0)), [*np.frombuffer(q0), *np.frombuffer(v0)]
    return build_integrator(motion, start, t0, tol, system.n_q <= LARGEST_UNROLLED)


HOW: dict[str, Any] = {"keeps": False, "traces": True, "builds_each": True, "one_tolerance": True}
LINES = (Line("heyoka", "heyoka", "heyoka", solve_heyoka, checked=True, **HOW),)
