"""The Taylor integrator of heyoka.py (F. Biscani and D. Izzo, MNRAS 504 (2021) 2614-2628) on a ConstrainedSystem.

It takes the right-hand side as its expressions, here those that `references.expressions` makes of the callbacks, and
compiles a Taylor series of the whole for each mechanism and each tolerance, which sets the order. Steps follow from the
radius of convergence. It does not keep the constraints. The package is optional: `make peers`, or the extra `peers`.
"""

from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from references.driver import TimeLimit, check_run, longest_step, user_call
from references.expressions import Expressions, functions_of
from references.nonholonomic import with_all_rows
from references.ode import ADVICE, ode_result, output_times
from twoloop.checks import check_positive
from twoloop.consistency import check_start
from twoloop.result import Result, Statistics
from twoloop.system import ConstrainedSystem

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
    system : ConstrainedSystem
        The problem, of compiled callbacks, which give Q_d and do not branch on q or v.
    t_span : (float, float)
        Start and end, s; the end after the start.
    q0, v0 : array_like (n_q,)
        Consistent initial coordinates and velocities.
    tol : float
        heyoka's one tolerance.
    t_eval : array_like, optional
        Increasing times in t_span at which to store the solution, by the Taylor series of the steps, in a second run
        that is not timed. None: 1001 times, evenly.
    time_limit : float, optional
        Wall-clock time that the integration may take, s, looked at every `STEPS_A_CALL` steps. A run past it is a
        failed one. None: no limit.
    max_step : float, optional
        The longest step that it may take, s. None: the length of t_span.

    Returns
    -------
    Result
        `a` and `lam` from eq. (6) at the stored states; `h` is empty. Of the statistics: n_accepted and cpu_time, that
        of the call. The integrator is kept for the next run of the same system, start and tolerance, its machine code
        in heyoka's own cache on disk. A failure gives what was computed before it, and `Status.SOLVER_FAILED`.

    Raises
    ------
    TypeError, ValueError
        If an argument is wrong, or the equations cannot be had as expressions: before any work, naming it.
    RuntimeError
        If heyoka is not installed.
    """
    check_positive("tol", tol)
    t0, t1, q0, v0, times = check_run(system, t_span, q0, v0, t_eval, time_limit, takes_velocity_rows=True)
    times = output_times(times, t0, t1)
    check_start(system, t0, q0, v0, derivatives=False)
    system = with_all_rows(system)
    integrator, outcomes = _integrator(system, t0, q0.tobytes(), v0.tobytes(), float(tol))
    start = np.concatenate([q0, v0])

    longest = longest_step(max_step, t1 - t0)
    limit, steps = TimeLimit(time_limit), 0
    with user_call as clock:
        integrator.time, integrator.state[:] = t0, start
        while True:
            outcome, _, _, taken, *_ = integrator.propagate_until(t1, max_steps=STEPS_A_CALL, max_delta_t=longest)
            steps += taken
            if outcome != outcomes.step_limit or limit.passed():
                break
    cpu, reached = clock.seconds or 0.0, float(integrator.time)
    failure = ""
    if outcome == outcomes.step_limit:
        failure = limit.message("heyoka", reached, "take looser tolerances")
    elif outcome != outcomes.time_limit:  # which is what heyoka calls the end
        failure = f"heyoka failed after t = {reached:.10g} with {outcome.name}. {ADVICE}"
    kept = times[times <= (reached if failure else t1)]
    integrator.time, integrator.state[:] = t0, start
    grid = kept if kept.size and kept[0] == t0 else np.append(t0, kept)  # it must begin where the state is
    states = integrator.propagate_grid(grid, max_delta_t=longest)[-1].T[:, grid.size - kept.size :]
    end = f"heyoka, order {integrator.order}, reached the end, t = {t1:g}."
    return ode_result(system, kept, states, failure, end, Statistics(n_accepted=steps, cpu_time=cpu))


@lru_cache(maxsize=256)
def _integrator(system: ConstrainedSystem, t0: float, q0: bytes, v0: bytes, tol: float) -> tuple[Any, Any]:
    """An integrator, and heyoka's names of outcomes."""
    try:
        import heyoka
    except ImportError as error:
        raise RuntimeError("heyoka is not installed: make peers, or pip install 'twoloop[peers]'") from error
    n, state = system.n_q, np.concatenate([np.frombuffer(q0), np.frombuffer(v0)])
    symbols = heyoka.make_vars(*(f"{name}{i}" for name in "qv" for i in range(n)))
    equations = Expressions(system, t0, state[:n], state[n:])
    rates = [*symbols[n:], *equations.accelerations(functions_of(heyoka), heyoka.time, symbols[:n], symbols[n:])]
    rates = [heyoka.expression(rate) if isinstance(rate, float) else rate for rate in rates]
    integrator = heyoka.taylor_adaptive(
        list(zip(symbols, rates, strict=True)),
        state.tolist(),
        time=t0,
        tol=tol,
        fast_math=True,
        compact_mode=n > LARGEST_UNROLLED,
    )
    return integrator, heyoka.taylor_outcome
