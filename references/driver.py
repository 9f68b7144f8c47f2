"""What the adapters of all solvers share: their arguments, checked, a limit on the time of a run, and its `Result`.

`adapter` makes of solve(task, options ...) a function solve(system, t_span, q0, v0, options ...), and all take:

system : ConstrainedSystem
    The problem. Callbacks are compiled into what the solver calls at the first run (a few seconds). Solvers that take
    expressions want compiled callbacks which give Q_d and do not branch on t, q or v.
t_span : (float, float)
    Start and end, s; the end after the start.
q0, v0 : array_like (n_q,)
    Consistent initial coordinates and velocities.
rtol, atol : float
    The solver's tolerances of q and v; `tol` of a solver that has one.
t_eval : array_like, optional
    Increasing times in t_span at which to store the solution, by the solver's own interpolation, in a second run of
    the same steps that is not timed. None: `OUTPUTS` times, evenly, if the adapter does not say that it stores steps.
time_limit : float, optional
    Wall-clock time that the integration may take, s. A run past it is a failed one. None: no limit.
max_step : float, optional
    Of some, the longest step that the solver may take, s. None: the length of t_span.

They return a `Result`, with the sign of M a + C_q^T lam = Q, and `a` and `lam` of eq. (6) at the stored states if the
adapter does not say otherwise. `h` is empty where steps are not stored; `cpu_time` is that of the call that a user
writes (`user_call`). A failure gives what was computed before it, `Status.SOLVER_FAILED` and the solver's text.

They raise TypeError or ValueError, before any work, for a wrong argument, naming it, RuntimeError for a package that is
not installed; an exception of a Python callback comes through.
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

from references.equations.least_norm import accelerations
from references.equations.rows import IndependentRows, with_all_rows
from twoloop.checks.arguments import check_positive, check_span, check_times, check_vector
from twoloop.checks.consistency import check_start
from twoloop.problem.problem import Array, Problem
from twoloop.problem.system import ConstrainedSystem, check_system
from twoloop.result.result import Result
from twoloop.run.record import Statistics, Status

OUTPUTS = 1001  # instants of the default t_eval of solvers that do not store their steps

CAUSES = "Look for a discontinuity, a singular position or a value that is not finite near this time, or try"
ADVICE = f"{CAUSES} other tolerances or another method."
POSITIVE = {"rtol", "atol", "tol", "step", "max_step"}  # options that are numbers above 0, where they are given


def cpu_time() -> float:
    """CPU time of this process and of the compilers that it called, s."""
    return time.process_time() + sum(os.times()[2:4])


class UserCall:
    """The CPU time of the call that a user of a solver writes, by the clock of the process.

    An adapter does more than that: our checks, the building of what a user keeps, a second run for the output,
    accelerations and multipliers. It puts what its solver's documentation has for a second run into
    `with user_call:`. Whatever marks nothing is timed whole.

    Attributes
    ----------
    seconds : float or None
        Of the last call that was marked.
    ended : float or None
        `cpu_time` at the end of the first that was marked since this was None: what was built before it is in it, and
        nothing of a second run for the output.
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
        """Make this as new, before a run: an exception may have come while the last call ended."""
        self.seconds = self.ended = self._began = None

    def so_far(self) -> float:
        """CPU time of the call under way, s; 0.0 outside of it."""
        return 0.0 if self._began is None else time.process_time() - self._began


user_call = UserCall()  # one: a process makes one run at a time


class OutOfTimeError(Exception):
    """The time limit passed within an evaluation; raised and caught inside an adapter."""


class TimeLimit:
    """The wall-clock time that a run may take, from the moment this is made; None: no limit.

    `exceeded` says whether a look at the clock has found the run past it.
    """

    def __init__(self, seconds: float | None):
        self.seconds = seconds
        self.deadline = math.inf if seconds is None else time.monotonic() + seconds
        self.exceeded = False

    def passed(self) -> bool:
        """Look at the clock: whether the run is past its limit."""
        if time.monotonic() > self.deadline:
            self.exceeded = True
        return self.exceeded

    def check(self) -> None:
        """Raise `OutOfTimeError` when the run is past its limit."""
        if self.passed():
            raise OutOfTimeError

    def message(self, name: str, t: float, advice: str) -> str:
        """Say that the solver of this name was stopped at t, and what to do."""
        return f"{name} was stopped at t = {t:.10g} by time_limit = {self.seconds:g} s. Raise time_limit, or {advice}."


def check_time_limit(time_limit: float | None) -> None:
    """Say what is wrong with a time limit."""
    if time_limit is not None:
        check_positive("time_limit", time_limit)


def imported(module: str, name: str = "", extra: str = "peers") -> Any:
    """An optional package, or a module of it."""
    try:
        return import_module(module)
    except ImportError as error:
        name = name or module.partition(".")[0]
        how = f"make {extra}, or pip" if extra in ("peers", "engines") else "pip"
        raise RuntimeError(f"{name} is not installed: {how} install 'twoloop[{extra}]'") from error


def check_problem(problem: Any, parameter: str, expected: str) -> Problem:
    """Return `problem` if it is a `Problem` that has this parameter, as those of one mechanism have."""
    if not isinstance(problem, Problem) or parameter not in problem.parameters:
        given = f"the Problem {problem.name!r}" if isinstance(problem, Problem) else repr(problem)
        raise TypeError(f"problem must be {expected}; given {given}")
    return problem


@dataclass(frozen=True)
class Task:
    """The arguments of a run, checked; `system` has the rows A v + b = 0 below those of C, of which there are n_c."""

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
        """The start [q, v]."""
        return np.concatenate([self.q0, self.v0])

    @property
    def key(self) -> tuple[ConstrainedSystem, float, bytes, bytes]:
        """What equations that are made for a start are kept by."""
        return self.system, self.t0, self.q0.tobytes(), self.v0.tobytes()

    @property
    def instants(self) -> Array:
        """When to store the solution: the times given, or `OUTPUTS` evenly."""
        return np.linspace(self.t0, self.t1, OUTPUTS) if self.times is None else self.times

    def longest(self, max_step: float | None) -> float:
        """The longest step that a solver may take: what is asked for, or the whole run."""
        return min(math.inf if max_step is None else max_step, self.t1 - self.t0)

    def result(self, name: str, t: Array, rows: Array, failure: str = "", *, h: Any = None, **counts: Any) -> Result:
        """The Result of a solver of this name.

        Parameters
        ----------
        t : ndarray (n_t,)
        rows : ndarray (3 n_q + n_c, n_t) or (2 n_q, n_t)
            [q v a lam], or [q v], to which `a` and `lam` of eq. (6) are added.
        failure : str
            The message of a run that failed; "": it reached the end.
        h : ndarray, optional
            Its steps.
        counts
            Those of `Statistics` that it tells, and cpu_time, if that is not of the last `user_call`.
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
    """Say what is wrong with an argument of a run, or return all of them.

    `derivatives`: whether those of the constraints are checked, which who traces the callbacks does otherwise;
    `independent_rows`: whether to leave out rows of C_q that follow from others.
    """
    check_system(system)
    t0, t1 = check_span(t_span)
    q0, v0 = check_vector("q0", q0, system.n_q), check_vector("v0", v0, system.n_q)
    check_time_limit(time_limit)
    times = None if t_eval is None else check_times(t_eval, t0, t1, None)
    rows = IndependentRows(system, t0, q0) if independent_rows else None
    some = system if rows is None else rows.system
    check_start(some, t0, q0, v0, derivatives=derivatives)
    return Task(with_all_rows(some), some.n_c, t0, t1, q0, v0, times, time_limit, rows)


def adapter(*, velocity_rows: bool = True, **checks: bool) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Make of solve(task, options ...) what is called with a system, a span and a start, all of which it checks.

    `velocity_rows`: whether it takes rows A v + b = 0; `checks`: see `check_task`.
    """

    def decorate(solve: Callable[..., Any]) -> Callable[..., Any]:
        known = signature(solve)

        @wraps(solve)
        def checked(system: Any, t_span: Any, q0: Any, v0: Any, *rest: Any, **options: Any) -> Any:
            shared = {name: options.pop(name, None) for name in ("t_eval", "time_limit")}
            given = known.bind(None, *rest, **options).arguments
            for name in [name for name in POSITIVE & given.keys() if given[name] is not None]:
                check_positive(name, given[name])
                given[name] = float(given[name])
            given["task"] = check_task(system, t_span, q0, v0, **shared, **checks)
            if system.n_a > 0 and not velocity_rows:
                raise ValueError(
                    f"system must have constraints on positions only: this adapter has no rows A v + b = 0; given "
                    f"{system.name!r} with n_a = {system.n_a}. Take one of the accelerations, or solve_dae"
                )
            user_call.seconds = None
            return solve(**given)

        return checked

    return decorate
