"""The Taylor integrator of heyoka.py (F. Biscani and D. Izzo, MNRAS 504 (2021) 2614-2628) on a ConstrainedSystem.

It takes the right-hand side as its expressions, here those that `equations.expressions` makes of the callbacks, and
compiles a Taylor series of the whole for each mechanism and each tolerance, which sets the order. Steps follow from the
radius of convergence. It does not keep the constraints. The package is optional: `make peers`, or the extra `peers`.
"""

from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from references.driver import ADVICE, TimeLimit, check_task, imported, longest_step, user_call
from references.equations.expressions import Expressions, expressions_at, functions_of
from references.equations.ode import ode_result
from twoloop.checks.arguments import check_positive
from twoloop.problem.system import ConstrainedSystem
from twoloop.result.result import Result
from twoloop.run.record import Statistics

Array = NDArray[np.float64]

LARGEST_UNROLLED = 9  # coordinates; with more, compiled unrolled, an integrator takes minutes to build
STEPS_A_CALL = 100  # between two looks at the clock


def solve_heyoka(
    system: ConstrainedSystem,
    t_span: tuple[float, float],
    q0: ArrayLike,
    v0: ArrayLike,
    tol: float = 1e-8,
    *,
    t_eval: ArrayLike | None = None,
    time_limit: float | None = None,
    max_step: float | None = None,
) -> Result:
    """Integrate a constrained mechanical system, as the ODE q' = v, v' = a(t, q, v), with heyoka's Taylor integrator.

    What it was given: the accelerations eliminated symbolically, without structural zeros, in an order of least fill;
    `fast_math`; the unrolled form (`compact_mode=False`, up to twice as fast and ten times as long in the building) up
    to `LARGEST_UNROLLED` coordinates; timed is a second use of the integrator, as its tutorials have it: time and state
    are set, and `propagate_until` is called, without output.

    Parameters
    ----------
    system, t_span, q0, v0, t_eval, time_limit, max_step : see `references.driver`
        The clock is looked at every `STEPS_A_CALL` steps.
    tol : float
        heyoka's one tolerance.

    Returns
    -------
    Result
        `a` and `lam` from eq. (6) at the stored states. Of the statistics: n_accepted. The integrator is kept for the
        next run of the same system, start and tolerance, its machine code in heyoka's own cache on disk.
    """
    check_positive("tol", tol)
    task = check_task(system, t_span, q0, v0, t_eval, time_limit, derivatives=False)
    integrator, longest = _integrator(*task.key, float(tol)), longest_step(max_step, task.t1 - task.t0)
    made = integrate(integrator, task.y0, (task.t0, task.t1), task.instants, time_limit, longest)
    times, rows, failure, end, statistics = made
    return ode_result(task.system, times, rows.T, failure, end, statistics)


def integrate(
    integrator: Any, start: Array, span: tuple[float, float], times: Array, time_limit: float | None, longest: float
) -> tuple[Array, Array, str, str, Statistics]:
    """The times that were reached, rows y there, why it failed ("": it did not), what is said if not, statistics."""
    (t0, t1), outcomes = span, imported("heyoka").taylor_outcome
    limit, steps = TimeLimit(time_limit), 0
    with user_call as clock:
        integrator.time, integrator.state[:] = t0, start
        while True:
            outcome, _, _, taken, *_ = integrator.propagate_until(t1, max_steps=STEPS_A_CALL, max_delta_t=longest)
            steps += taken
            if outcome != outcomes.step_limit or limit.passed():
                break
    reached, failure = float(integrator.time), ""
    if outcome == outcomes.step_limit:
        failure = limit.message("heyoka", reached, "take looser tolerances")
    elif outcome != outcomes.time_limit:  # which is what heyoka calls the end
        failure = f"heyoka failed after t = {reached:.10g} with {outcome.name}. {ADVICE}"
    kept = times[times <= (reached if failure else t1)]
    integrator.time, integrator.state[:] = t0, start
    grid = kept if kept.size and kept[0] == t0 else np.append(t0, kept)  # it must begin where the state is
    rows = integrator.propagate_grid(grid, max_delta_t=longest)[-1][grid.size - kept.size :]
    end = f"heyoka, order {integrator.order}, reached the end, t = {t1:g}."
    return kept, rows, failure, end, Statistics(n_accepted=steps, cpu_time=clock.seconds or 0.0)


def rates_of(equations: Expressions, parameters: list[Any] | None = None) -> list[tuple[Any, Any]]:
    """heyoka's variables q, v and their rates."""
    package, n = imported("heyoka"), equations.system.n_q
    symbols = package.make_vars(*(f"{name}{i}" for name in "qv" for i in range(n)))
    state = package.time, symbols[:n], symbols[n:]
    rates = [*symbols[n:], *equations.accelerations(functions_of(package), *state, parameters or [])]
    rates = [package.expression(rate) if isinstance(rate, float) else rate for rate in rates]
    return list(zip(symbols, rates, strict=True))


@lru_cache(maxsize=256)
def _integrator(system: ConstrainedSystem, t0: float, q0: bytes, v0: bytes, tol: float) -> Any:
    return imported("heyoka").taylor_adaptive(
        rates_of(expressions_at(system, t0, q0, v0)),
        [*np.frombuffer(q0), *np.frombuffer(v0)],
        time=t0,
        tol=tol,
        fast_math=True,
        compact_mode=system.n_q > LARGEST_UNROLLED,
    )
