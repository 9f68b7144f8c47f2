"""Common parts of all adapters: checked arguments, a time limit, and the `Result`.

`adapter` turns solve(task, options ...) into solve(system, t_span, q0, v0, options ...). Common parameters:

system, t_span, q0, v0
    As of `solve_dae`. The callbacks are compiled into the solver's functions at the first run (a few seconds). Solvers
    that take expressions require compiled callbacks with Q_d that do not branch on t, q or v.
rtol, atol : float
    The solver's tolerances for q and v; `tol` for a solver with a single tolerance.
t_eval : array_like, optional
    Increasing output times in t_span, by the solver's own interpolation, in a second run with the same steps that is
    not timed. None: `OUTPUTS` equidistant times, unless the adapter stores the steps.
time_limit, max_step : float, optional
    Wall-clock limit of the integration, s, beyond which a run fails; and for some adapters the largest step, s.

They return a `Result`, with the sign of M a + C_q^T lam = Q, and `a` and `lam` from eq. (6) at the stored states
unless stated otherwise. `h` is empty if steps are not stored; `cpu_time` is that of the call that a user writes
(`user_call`). A failed run returns the states computed so far, `Status.SOLVER_FAILED` and the solver's message.

They raise TypeError or ValueError before any work, naming the invalid argument, and RuntimeError if a package is not
installed. Exceptions of Python callbacks are passed on.
"""

import math
import os
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import wraps
from importlib import import_module
from inspect import signature
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike

from references.equations.rows import IndependentRows, accelerations, with_all_rows
from twoloop.checks.arguments import check_positive, check_span, check_times, check_vector
from twoloop.checks.consistency import check_start
from twoloop.problem.problem import Array
from twoloop.problem.system import ConstrainedSystem, check_system
from twoloop.result.result import Result
from twoloop.run.record import Statistics, Status

OUTPUTS = 1001  # default number of output times of solvers that do not store their steps
STORED = 5000  # about as many steps of a fixed-step solver are stored for the studies

CAUSES = "Look for a discontinuity, a singular position or a value that is not finite near this time, or try"
ADVICE = f"{CAUSES} other tolerances or another method."
POSITIVE = {"rtol", "atol", "tol", "step", "max_step"}  # options that must be positive if given


def cpu_time() -> float:
    """Return the CPU time of this process and of the compilers that it called, s."""
    return time.process_time() + sum(os.times()[2:4])


class UserCall:
    """CPU time of the call that a user of a solver writes.

    An adapter does more: checks, construction of objects that a user would keep, a second run for the output,
    accelerations and multipliers. It wraps the code that the solver's documentation shows for a repeated run in `with
    user_call:`. Adapters that do not use it are timed as a whole. `seconds` is the time of the last call measured;
    `ended` is `cpu_time` at the end of the first call since this was None: it includes construction, but no second run.
    """

    def __init__(self) -> None:
        self.seconds: float | None = None
        self.ended: float | None = None
        self._began: float | None = None

    def __enter__(self) -> Self:
        self._began = time.process_time()
        return self

    def __exit__(self, *_: object) -> None:
        self.seconds, self._began = self.so_far(), None
        self.ended = cpu_time() if self.ended is None else self.ended

    def forget(self) -> None:
        """Reset before a run, because an exception may have interrupted the end of the last call."""
        self.seconds = self.ended = self._began = None

    def so_far(self) -> float:
        """Return the CPU time of the current call, s; 0.0 outside of a call."""
        return 0.0 if self._began is None else time.process_time() - self._began


user_call = UserCall()  # a process makes one run at a time


class OutOfTimeError(Exception):
    """The time limit was exceeded within an evaluation; raised and caught inside an adapter."""


class TimeLimit:
    """Wall-clock limit of a run, counted from the construction of this object; None: no limit.

    `exceeded` is True once a check has found the run past its limit.
    """

    def __init__(self, seconds: float | None):
        self.seconds = seconds
        self.deadline = math.inf if seconds is None else time.monotonic() + seconds
        self.exceeded = False

    def passed(self) -> bool:
        """Return True if the run has exceeded its limit."""
        if time.monotonic() > self.deadline:
            self.exceeded = True
        return self.exceeded

    def check(self) -> None:
        """Raise `OutOfTimeError` if the run has exceeded its limit."""
        if self.passed():
            raise OutOfTimeError

    def message(self, name: str, t: float, advice: str) -> str:
        """Return the message for a solver stopped at t, with advice."""
        return f"{name} was stopped at t = {t:.10g} by time_limit = {self.seconds:g} s. Raise time_limit, or {advice}."


def imported(module: str, name: str = "", extra: str = "peers") -> Any:
    """Return an optional package, or a module of it."""
    try:
        return import_module(module)
    except ImportError as error:
        name = name or module.partition(".")[0]
        command = f"make {extra}, or pip" if extra in ("peers", "engines") else "pip"
        raise RuntimeError(f"{name} is not installed: {command} install 'twoloop[{extra}]'") from error


class Deferred:
    """A module of an optional package of the extra `references`, imported at the first use of one of its names."""

    def __init__(self, module: str, name: str = ""):
        self._module, self._name = module, name

    def __getattr__(self, name: str) -> Any:
        return getattr(imported(self._module, self._name, "references"), name)


@dataclass(frozen=True)
class Task:
    """Checked arguments of a run; `system` has the rows A v + b = 0 below the n_c rows of C."""

    system: ConstrainedSystem
    n_c: int
    t0: float
    t1: float
    q0: Array
    v0: Array
    times: Array | None = None
    time_limit: float | None = None
    rows: IndependentRows | None = None

    @property
    def y0(self) -> Array:
        """Return the initial state [q, v]."""
        return np.concatenate([self.q0, self.v0])

    @property
    def key(self) -> tuple[ConstrainedSystem, float, bytes, bytes]:
        """Return the cache key of equations built for an initial state."""
        return self.system, self.t0, self.q0.tobytes(), self.v0.tobytes()

    @property
    def instants(self) -> Array:
        """Return the output times: those given, or `OUTPUTS` equidistant ones."""
        return np.linspace(self.t0, self.t1, OUTPUTS) if self.times is None else self.times

    def longest(self, max_step: float | None) -> float:
        """Return the largest step: the one given, or the length of the run."""
        return min(math.inf if max_step is None else max_step, self.t1 - self.t0)

    def result(self, name: str, t: Array, rows: Array, failure: str = "", *, h: Any = None, **counts: Any) -> Result:
        """Return the Result of a run.

        `rows` are [q v a lam] (3 n_q + n_c, n_t), or [q v], completed by `a` and `lam` from eq. (6). `failure` is the
        message of a failed run, `h` the step sizes. `counts` are fields of `Statistics` known to the solver, and
        cpu_time, if it is not that of the last `user_call`.
        """
        n = self.system.n_q
        if len(rows) == 2 * n:
            rows = np.concatenate([rows, *accelerations(self.system, t, rows)])
        q, v, a, lam = np.split(rows, [n, 2 * n, 3 * n])
        broken = ""
        if self.rows is not None and self.rows.system is not self.rows.all:
            lam = self.rows.multipliers(t, q, lam)
            broken = self.rows.failure(float(t[-1]), q[:, -1]) if t.size else ""
        status = Status.SOLVER_FAILED if failure or broken else Status.REACHED_END
        message = broken + (failure or f"{name} reached the end, t = {self.t1:g}.")
        stats = Statistics(**{"cpu_time": user_call.seconds or 0.0} | counts)
        return Result(t, q, v, a, lam, np.empty(0) if h is None else h, status, message, stats)


def check_task(
    system: ConstrainedSystem,
    t_span: tuple[float, float],
    q0: ArrayLike,
    v0: ArrayLike,
    t_eval: ArrayLike | None = None,
    time_limit: float | None = None,
    *,
    derivatives: bool = True,
    independent_rows: bool = False,
) -> Task:
    """Return the checked arguments of a run; raise an error if one is invalid.

    `derivatives`: check those of the constraints (adapters that trace the callbacks do so elsewhere);
    `independent_rows`: remove dependent rows of C_q.
    """
    check_system(system)
    t0, t1 = check_span(t_span)
    q0, v0 = check_vector("q0", q0, system.n_q), check_vector("v0", v0, system.n_q)
    if time_limit is not None:
        check_positive("time_limit", time_limit)
    times = None if t_eval is None else check_times(t_eval, t0, t1, None)
    rows = IndependentRows(system, t0, q0) if independent_rows else None
    checked = system if rows is None else rows.system
    check_start(checked, t0, q0, v0, derivatives=derivatives)
    return Task(with_all_rows(checked), checked.n_c, t0, t1, q0, v0, times, time_limit, rows)


def adapter(*, velocity_rows: bool = True, **checks: bool) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Turn solve(task, options ...) into a function of a system, a span and an initial state, which are checked.

    `velocity_rows`: rows A v + b = 0 are supported; `checks`: see `check_task`.
    """

    def decorate(solve: Callable[..., Any]) -> Callable[..., Any]:
        parameters = signature(solve)

        @wraps(solve)
        def checked(system: Any, t_span: Any, q0: Any, v0: Any, *rest: Any, **options: Any) -> Any:
            shared = {name: options.pop(name, None) for name in ("t_eval", "time_limit")}
            arguments = parameters.bind(None, *rest, **options).arguments
            for name in [name for name in POSITIVE & arguments.keys() if arguments[name] is not None]:
                check_positive(name, arguments[name])
                arguments[name] = float(arguments[name])
            arguments["task"] = check_task(system, t_span, q0, v0, **shared, **checks)
            if system.n_a > 0 and not velocity_rows:
                raise ValueError(
                    f"system must have constraints on positions only: this adapter has no rows A v + b = 0; given "
                    f"{system.name!r} with n_a = {system.n_a}. Use one based on accelerations, or solve_dae"
                )
            user_call.seconds = None
            return solve(**arguments)

        return checked

    return decorate
