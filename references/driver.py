"""What the adapters of all solvers share: their arguments, checked, a limit on the time of a run, and its `Result`.

What is the same for all stands here, and not at each adapter:

system : ConstrainedSystem
    The problem. Callbacks are compiled into what the solver calls at the first run (a few seconds). Solvers that take
    expressions want compiled callbacks which give Q_d and do not branch on t, q or v.
t_span : (float, float)
    Start and end, s; the end after the start.
q0, v0 : array_like (n_q,)
    Consistent initial coordinates and velocities.
rtol, atol : float
    The solver's tolerances of q and v.
t_eval : array_like, optional
    Increasing times in t_span at which to store the solution, by the solver's own interpolation, in a second run of
    the same steps that is not timed. None: `OUTPUTS` times, evenly, if the adapter does not say that it stores steps.
time_limit : float, optional
    Wall-clock time that the integration may take, s. A run past it is a failed one. None: no limit.
max_step : float, optional
    The longest step that the solver may take, s. None: the length of t_span.

They return a `Result`, with the sign of M a + C_q^T lam = Q. `h` is empty where steps are not stored; `cpu_time` is
that of the call that a user writes (`user_call`). A failure gives what was computed before it,
`Status.SOLVER_FAILED` and the solver's text.

They raise TypeError or ValueError, before any work, for a wrong argument, naming it, RuntimeError for a package that is
not installed; an exception of a Python callback comes through.
"""

import math
import os
import time
from collections.abc import Iterable
from dataclasses import dataclass
from importlib import import_module
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from references.equations.rows import with_all_rows
from twoloop.checks.arguments import check_positive, check_span, check_times, check_vector
from twoloop.checks.consistency import check_start
from twoloop.problem.problem import Problem
from twoloop.problem.system import ConstrainedSystem
from twoloop.result.result import Result
from twoloop.run.record import Statistics, Status

Array = NDArray[np.float64]

OUTPUTS = 1001  # instants of the default t_eval of solvers that do not store their steps

CAUSES = "Look for a discontinuity, a singular position or a value that is not finite near this time, or try"
ADVICE = f"{CAUSES} other tolerances or another method."


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

    def left(self) -> float | None:
        """Return what is left, at least 1 ns: the limit of the next part of a run."""
        return None if self.seconds is None else max(1e-9, self.deadline - time.monotonic())

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
        how = "make peers, or pip" if extra == "peers" else "pip"
        raise RuntimeError(f"{name} is not installed: {how} install 'twoloop[{extra}]'") from error


def longest_step(max_step: float | None, span: float) -> float:
    """Return the longest step that a solver may take: what is asked for, or the whole run."""
    if max_step is None:
        return span
    check_positive("max_step", max_step)
    return min(float(max_step), span)


def check_choice(name: str, value: Any, choices: Iterable[str]) -> None:
    """Raise unless `value` is one of these words."""
    if not isinstance(value, str) or value not in choices:
        raise ValueError(f"{name} must be one of {', '.join(choices)}; given {value!r}")


def check_system(system: Any) -> None:
    """Raise unless `system` is a ConstrainedSystem; a `Problem` is told where its system is."""
    if isinstance(system, Problem):
        raise TypeError(f"system must be a ConstrainedSystem; given the Problem {system.name!r}: give problem.system")
    if not isinstance(system, ConstrainedSystem):
        raise TypeError(f"system must be a ConstrainedSystem; given {system!r} of type {type(system).__name__}")


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
    times: Array | None

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


def check_task(
    system: ConstrainedSystem,
    t_span: tuple[float, float],
    q0: ArrayLike,
    v0: ArrayLike,
    t_eval: ArrayLike | None,
    time_limit: float | None,
    tolerances: tuple[float, float] | None = None,
    step: float | None = None,
    takes_velocity_rows: bool = True,
    derivatives: bool = True,
) -> Task:
    """Say what is wrong with an argument of a run, or return all of them.

    `step`: of which output times are multiples; `derivatives`: whether those of the constraints are checked, which
    who traces the callbacks does otherwise.
    """
    if tolerances is not None:
        for name, value in zip(("rtol", "atol"), tolerances, strict=True):
            check_positive(name, value)
    check_system(system)
    if system.n_a > 0 and not takes_velocity_rows:
        raise ValueError(
            f"system must have constraints on positions only: this adapter has no rows A v + b = 0; "
            f"given {system.name!r} with n_a = {system.n_a}. Take one of the accelerations, or solve_dae"
        )
    t0, t1 = check_span(t_span)
    q0 = check_vector("q0", q0, system.n_q)
    v0 = check_vector("v0", v0, system.n_q)
    check_time_limit(time_limit)
    times = None if t_eval is None else check_times(t_eval, t0, t1, step)
    check_start(system, t0, q0, v0, derivatives=derivatives)
    return Task(with_all_rows(system), system.n_c, t0, t1, q0, v0, times)


def result_of(
    n: int, t: Array, columns: Array, end: str, failure: str, statistics: Statistics, h: Array | None = None
) -> Result:
    """The Result of rows [q v a lam] (3 n_q + n_c, n_t); `failure` is the message of a run that failed, `end` else."""
    q, v, a, lam = np.split(columns, [n, 2 * n, 3 * n])
    return Result(
        t=t,
        q=q,
        v=v,
        a=a,
        lam=lam,
        h=np.empty(0) if h is None else h,
        status=Status.SOLVER_FAILED if failure else Status.REACHED_END,
        message=failure or end,
        stats=statistics,
    )
