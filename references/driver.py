"""What the adapters of all solvers share: checks of their arguments, and a limit on the time of a run."""

import math
import os
import time
from collections.abc import Iterable
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from twoloop.checks import check_positive, check_span, check_times, check_vector
from twoloop.mechanisms.problem import Problem
from twoloop.system import ConstrainedSystem

Array = NDArray[np.float64]


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


def check_run(
    system: ConstrainedSystem,
    t_span: tuple[float, float],
    q0: ArrayLike,
    v0: ArrayLike,
    t_eval: ArrayLike | None,
    time_limit: float | None,
    step: float | None = None,
    takes_velocity_rows: bool = False,
) -> tuple[float, float, Array, Array, Array | None]:
    """Return start, end, q0, v0 and output times, or say what is wrong with an argument of a run."""
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
    return t0, t1, q0, v0, None if t_eval is None else check_times(t_eval, t0, t1, step)


def check_tolerances(rtol: float, atol: float) -> None:
    """Raise unless both are positive numbers."""
    check_positive("rtol", rtol)
    check_positive("atol", atol)
