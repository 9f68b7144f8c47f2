"""solve_dae: checks the input, drives the compiled integrator in chunks, assembles the Result."""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from twoloop.checks import check_flag, check_positive, check_size, check_span, check_times, check_vector, shown
from twoloop.consistency import check_start, check_system, dependent_rows, not_finite
from twoloop.kernels import common
from twoloop.kernels.banded import banded_pays
from twoloop.kernels.lapack import addresses
from twoloop.methods import PRESETS
from twoloop.plan import Method, Plan
from twoloop.result import Result, Statistics, Status
from twoloop.system import ConstrainedSystem

Array = NDArray[np.float64]

ROUNDING = 1e-15
BUFFER_ROWS = 1024
BUFFER_STEPS = 4096


def solve_dae(
    system: ConstrainedSystem,
    t_span: tuple[float, float],
    q0: ArrayLike,
    v0: ArrayLike,
    method: str | Method = "SunRadau5",
    rtol: float = 1e-8,
    atol: float = 1e-8,
    *,
    t_eval: ArrayLike | None = None,
    first_step: float | None = None,
    max_step: float = np.inf,
    max_steps: int | None = None,
    step_size: float | None = None,
    dense_output: bool = False,
    events: Any = None,
    progress: bool | None = None,
) -> Result:
    """Integrate a constrained mechanical system by a two-loop procedure.

    Parameters
    ----------
    system : ConstrainedSystem
        The problem.
    t_span : (float, float)
        Start and end, s; the end after the start.
    q0, v0 : array_like (n_q,)
        Consistent initial coordinates and velocities (see `consistent_state`).
    method : str or method object
        "SunRadau5" (default), "Gauss4" ... "Gauss16", "RadauIIA5", "Newmark", "BDF", "DOP853", "PaperIRK",
        "PaperNewmark", or an object: `RungeKutta(...)`, `Newmark(...)`, `BDF(...)`, `DOP853(...)`.
    rtol, atol : float
        A step is accepted when its estimated error over atol + rtol |value| is at most 1: the largest component of
        positions and velocities for `RungeKutta` (the root mean square with error="richardson-paper"), `BDF` and
        `DOP853`, the root mean square of the positions for `Newmark`, unless it has `error_tol`, its own test.
    t_eval : array_like, optional
        Increasing times in t_span at which to store the solution; steps are shortened to land on them. None: every
        accepted step is stored.
    first_step : float, optional
        First step to try, s. None: chosen from the accelerations at the start.
    max_step : float
        Largest step, s.
    max_steps : int, optional
        Largest number of accepted steps. None: no limit.
    step_size : float, optional
        Constant step, s: no error control; only the last step is shortened, to end at t_span[1]. Times in `t_eval`
        must then be multiples of it. A step that does not converge ends the run.
    dense_output, events
        Not available yet.
    progress : bool, optional
        True: show a bar (needs the package rich).

    Returns
    -------
    Result
        After a failure, with what was computed so far, `success=False` and a message that says what to try.

    Raises
    ------
    TypeError, ValueError
        If an argument is wrong: before any work, naming it. An exception of a Python callback comes through
        unchanged, with a note that says which callback and at what time.
    NotImplementedError
        If `dense_output` or `events` is asked for.
    """
    check_system(system)
    if check_flag("dense_output", dense_output):
        raise NotImplementedError("dense_output is not available yet; use t_eval to get the solution at given times")
    if events is not None:
        raise NotImplementedError("events are not available yet; search the stored solution (t_eval) instead")
    if progress is not None:
        check_flag("progress", progress)
    method = _check_method(method)
    t0, t1 = check_span(t_span)
    q0 = check_vector("q0", q0, system.n_q)
    v0 = check_vector("v0", v0, system.n_q)
    check_positive("rtol", rtol)
    check_positive("atol", atol)
    if max(rtol, atol) < ROUNDING:
        raise ValueError(
            f"rtol and atol must not both be below {ROUNDING:g}, where rounding hides the error; given {rtol!r} and "
            f"{atol!r}"
        )
    if first_step is not None:
        check_positive("first_step", first_step)
    check_positive("max_step", max_step, infinite=True)
    if step_size is not None:
        check_positive("step_size", step_size)
        if step_size > t1 - t0:
            raise ValueError(f"step_size must not exceed the length of t_span, {t1 - t0:g}; given {step_size!r}")
        if first_step is not None or max_step != np.inf:
            raise ValueError("step_size is a constant step: give neither first_step nor max_step with it")
    if max_steps is not None:
        check_size("max_steps", max_steps, 1)
    times = None if t_eval is None else check_times(t_eval, t0, t1, step_size)
    check_start(system, t0, q0, v0)

    plan = method.plan(system.n_q, float(rtol), float(atol), step_size is not None)
    run = _Run(system, plan, t0, q0, v0, float(rtol), float(atol), step_size)
    if step_size is None:
        run.set_sizes(first_step, float(max_step), t1)
    if max_steps is not None:
        run.control[run.a.MAX_STEPS] = max_steps
    with _progress_bar(progress, method.name, t0, t1) as report:
        return run.go(t1, times, report)


class _Run:
    """The arrays of one run, and the loop over the chunks that the compiled `advance` returns."""

    def __init__(
        self,
        system: ConstrainedSystem,
        plan: Plan,
        t0: float,
        q0: Array,
        v0: Array,
        rtol: float,
        atol: float,
        step_size: float | None,
    ):
        from twoloop.kernels import advance  # compiled, or read from the cache, at the first run of a process

        self.a = advance
        self.system, self.plan, self.t0 = system, plan, t0
        self.work = common.make_work(system.n_q, system.n_c)
        flags = system.functions.flags.copy()
        if system.constant_mass:
            mass = system.mass(t0, q0)
            flags[common.DIAGONAL_MASS] = np.count_nonzero(mass - np.diag(np.diagonal(mass))) == 0
        if system.bandwidth is not None and banded_pays(system.n_q, system.n_c, system.bandwidth):
            flags[common.BANDWIDTH] = system.bandwidth
            self.work.lapack[:] = addresses()
        self.functions = system.functions._replace(flags=flags)
        self.state = np.concatenate([q0, v0, np.zeros(system.n_q + system.n_c)])
        self.new_state = np.zeros_like(self.state)
        self.tolerances = np.zeros(common.N_TOLERANCES)
        self.tolerances[common.ATOL] = atol
        self.tolerances[common.RTOL] = rtol
        self.tolerances[common.ESTIMATE] = step_size is None
        self.control = np.zeros(advance.N_CONTROL)
        self.control[advance.SAFETY] = plan.safety
        self.control[advance.FACTOR_MIN] = plan.factor_min
        self.control[advance.FACTOR_MAX] = plan.factor_max
        self.control[advance.EXPONENT] = plan.exponent
        self.control[advance.MAX_STEP] = np.inf
        self.control[advance.FIXED_STEP] = 0.0 if step_size is None else step_size
        self.control[advance.LIMIT_START] = plan.limit_start
        self.control[advance.LIMIT_FACTOR] = plan.limit_factor
        self.control[advance.LIMIT_MEMORY] = plan.limit_memory
        self.control[advance.SYMMETRIC] = plan.symmetric
        self.control[advance.PREDICTIVE] = plan.predictive
        self.control[advance.LEAST_ERROR] = plan.least_error
        self.control[advance.MAX_STEPS] = np.inf
        self.clock = np.zeros(advance.N_CLOCK)
        self.clock[advance.T] = self.clock[advance.T_START] = t0
        self.clock[advance.H_LIMIT] = plan.limit_start
        self._begin()

    def _begin(self) -> None:
        code = self.a.start(*self.functions, self.work, self.t0, self.state)
        if code == common.DONE:
            return
        n = self.system.n_q
        q, v = self.state[:n], self.state[n : 2 * n]
        if code == common.MASS_NOT_DEFINITE:
            raise ValueError(
                f"mass of {self.system.name!r} must be positive definite; its smallest eigenvalue at t = {self.t0!r} "
                f"is {np.linalg.eigvalsh(self.system.mass(self.t0, q)).min():.3g}"
            )
        raise ValueError(
            f"the accelerations of {self.system.name!r} cannot be found at t = {self.t0!r}: "
            f"{not_finite(self.system, self.t0, q, v)}"
        )

    def set_sizes(self, first_step: float | None, max_step: float, t1: float) -> None:
        """Set the first and the largest step."""
        if first_step is None:
            # Hairer, Norsett & Wanner I, II.4: one per cent of the state's scale over its rate
            n = self.system.n_q
            z, rate = self.state[: 2 * n], self.state[n : 3 * n]
            scale = self.tolerances[common.ATOL] + self.tolerances[common.RTOL] * np.abs(z)
            size, speed = np.linalg.norm(z / scale), np.linalg.norm(rate / scale)
            first_step = float(0.01 * size / speed) if size > 1e-5 and speed > 1e-5 else 1e-6
        self.clock[self.a.H_NEXT] = min(first_step, t1 - self.t0)
        self.control[self.a.MAX_STEP] = max_step

    def go(self, t1: float, times: Array | None, report: Any) -> Result:
        """Advance to t1, chunk by chunk, and assemble the result."""
        a, system = self.a, self.system
        every_step = times is None
        outputs = np.array([t1]) if times is None else np.append(times[times > self.t0], t1)
        if len(outputs) > 1 and outputs[-2] == t1:
            outputs = outputs[:-1]
        self.control[a.STORE_ALL] = every_step
        first_row = every_step or (times is not None and times[0] == self.t0)
        t_parts = [np.array([self.t0])] if first_row else []
        rows = [self.state.copy()[None, :]] if first_row else []
        h_parts: list[Array] = []
        count_parts: list[NDArray[np.int64]] = []
        counted = np.array([[0.0, 0.0, 1.0]])  # so far; the first partition of a run is not a renewal
        out_t, out_steps = np.empty(BUFFER_ROWS), np.empty((BUFFER_STEPS, a.N_STEP_COLUMNS))
        out_state = np.empty((BUFFER_ROWS, len(self.state)))
        filled = np.zeros(2, dtype=np.int64)
        cpu = 0.0
        code = a.BUFFER_FULL
        while code == a.BUFFER_FULL:
            began = time.process_time()
            code = a.advance(
                *self.functions,
                self.work,
                self.plan.step,
                self.plan.options,
                self.plan.memory,
                self.tolerances,
                self.control,
                self.clock,
                self.state,
                self.new_state,
                outputs,
                out_t,
                out_state,
                out_steps,
                filled,
            )
            cpu += time.process_time() - began
            t_parts.append(out_t[: filled[0]].copy())
            rows.append(out_state[: filled[0]].copy())
            steps = out_steps[: filled[1]]
            h_parts.append(steps[:, a.H].copy())
            count_parts.append(np.diff(steps[:, a.ERRORS :], axis=0, prepend=counted).astype(np.int64))
            counted = steps[-1:, a.ERRORS :].copy() if len(steps) else counted
            report(self.clock[a.T])
        t = np.concatenate(t_parts)
        table = np.concatenate(rows)
        if times is not None and times[-1] != t1 and len(t) > 0 and t[-1] == t1:
            t, table = t[:-1], table[:-1]
        n = system.n_q
        errors, failures, partitions = np.concatenate(count_parts).T
        status, message = self._outcome(code)
        return Result(
            t=t,
            q=table[:, :n].T,
            v=table[:, n : 2 * n].T,
            a=table[:, 2 * n : 3 * n].T,
            lam=table[:, 3 * n :].T,
            h=np.concatenate(h_parts),
            status=status,
            message=message,
            stats=self._statistics(cpu),
            rejected_error=errors,
            rejected_convergence=failures,
            partitioned=partitions,
        )

    def _statistics(self, cpu: float) -> Statistics:
        c = self.work.counters
        return Statistics(
            n_accepted=int(c[common.N_ACCEPTED]),
            n_rejected_error=int(c[common.N_REJECTED_ERROR]),
            n_rejected_convergence=int(c[common.N_REJECTED_CONVERGENCE]),
            n_outer=int(c[common.N_OUTER]),
            n_inner=int(c[common.N_INNER]),
            n_evaluations=int(c[common.N_EVALUATIONS]),
            n_partitions=int(c[common.N_PARTITIONS]),
            n_factorizations=int(c[common.N_FACTORIZATIONS]),
            n_jacobians=int(c[common.N_JACOBIANS]),
            cpu_time=cpu,
        )

    def _outcome(self, code: int) -> tuple[Status, str]:
        """Status and message for what `advance` returned."""
        a, t = self.a, float(self.clock[self.a.T])
        n = self.system.n_q
        if code == a.ALL_OUTPUT_DONE:
            return Status.REACHED_END, f"Reached the end, t = {t:g}."
        if code == a.MAX_STEPS_REACHED:
            taken = int(self.control[a.MAX_STEPS])
            return (
                Status.MAX_STEPS,
                f"Stopped at t = {t:.10g} after max_steps = {taken} accepted steps. Raise max_steps, loosen rtol and "
                "atol, or shorten t_span.",
            )
        failure = int(self.clock[a.FAILURE_CODE])
        if code == a.RANK_LOST or (code == a.STEP_TOO_SMALL and failure == common.SINGULAR):
            return (
                Status.RANK_LOST,
                f"Stopped at t = {t:.10g}: the constraint Jacobian has lost rank there "
                f"({dependent_rows(self.system, t, self.state[:n])}), so no choice of independent coordinates exists. "
                "Redundant constraints and singular positions are not handled yet: end t_span before, or change the "
                "geometry.",
            )
        if failure == common.NOT_FINITE:
            # the last attempt began at t: look where it went, to name the callback
            end = t + float(self.clock[a.H_FAILED])
            blame = not_finite(self.system, end, self.state[:n], self.state[n : 2 * n])
            return (
                Status.NOT_FINITE,
                f"Stopped at t = {t:.10g}: a value that is not finite came up just after it ({blame}). The result "
                "holds what was computed before.",
            )
        reason = _REASONS[failure]
        if code == a.FIXED_STEP_FAILED:
            return (
                Status.NOT_CONVERGED,
                f"Stopped at t = {t:.10g}: with the fixed step_size = {self.control[a.FIXED_STEP]:g} {reason}. "
                "Take a smaller step_size, or leave it out for step-size control.",
            )
        return (
            Status.STEP_TOO_SMALL,
            f"Stopped at t = {t:.10g}: the step size fell below the spacing of floating-point numbers; at the last "
            f"attempt {reason}. Look for a discontinuity or a singular position near this time, loosen rtol and "
            "atol, or use coordinates of similar scale.",
        )


_REASONS = {
    common.DONE: "the error estimate stayed above the tolerances",
    common.OUTER_DIVERGED: "the outer loop (stages) did not converge",
    common.INNER_DIVERGED: "the inner loop (Newton on the positions) did not converge",
    common.SINGULAR: "the dependent columns of the constraint Jacobian became singular",
    common.MASS_NOT_DEFINITE: "the mass matrix was not positive definite",
}


def _check_method(method: str | Method) -> Method:
    known = ", ".join(PRESETS)
    if isinstance(method, str):
        if method not in PRESETS:
            raise ValueError(f"method must be one of {known}, or a method object; given {shown(method)}")
        return PRESETS[method]
    if isinstance(method, type) or not callable(getattr(method, "plan", None)):
        raise TypeError(
            f"method must be a name ({known}) or an object such as RungeKutta(gauss(3)); given {shown(method)}"
        )
    return method


@contextmanager
def _progress_bar(progress: bool | None, name: str, t0: float, t1: float) -> Iterator[Any]:
    """A function that takes the time reached; draws a bar when asked to."""
    if not progress:
        yield lambda t: None
        return
    try:
        from rich.progress import Progress
    except ImportError as error:
        raise ImportError("progress=True needs the package rich: pip install rich") from error
    with Progress() as bar:
        task = bar.add_task(f"{name}, t = {t0:g} to {t1:g} s", total=t1 - t0)
        yield lambda t: bar.update(task, completed=t - t0)
