"""Time-stepping loop of a solver with SciPy's interface: stored states and termination."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from references.driver import OutOfTimeError, Task, TimeLimit
from twoloop.problem.problem import Array

SMALLEST_STEP = 10.0  # units in the last place of t: SciPy's own limit, which LSODA lacks


@dataclass
class Steps:
    """Steps of one run."""

    make: Callable[[TimeLimit], Any]  # limit -> the solver at its start; the limit is checked in every evaluation
    # t0, start: that start: y, or [y, y']
    t0: float
    start: Array
    # `raised` says whether a callback of the system raised: such an exception comes through, the solver's do not
    callbacks: Any
    # (t, y) -> whether y, which it moves onto the constraints, is on them
    project: Callable[[float, Array], bool] | None
    times: Array | None  # output times, by the solver's interpolant; None: the end of every step
    limit: TimeLimit
    ends: list[float] = field(default_factory=list)  # start and ends of the accepted steps, s
    stored: list[tuple[float, Array]] = field(default_factory=list)  # times and states: y, or [y, y']
    failure: str = ""  # error message; "": no failure
    solver: Any = None

    @classmethod
    def timed(cls, task: Task, make: Any, start: Array, callbacks: Any, project: Any = None) -> "Steps":
        """Return the timed run, which stores every step, or nothing if the task has output times."""
        times = None if task.times is None else task.times[:0]
        return cls(make, task.t0, start, callbacks, project, times, TimeLimit(task.time_limit))

    @property
    def t(self) -> Array:
        """Return the times of the stored states."""
        return np.array([t for t, _ in self.stored])

    @property
    def states(self) -> Array:
        """Return the stored states, one per column."""
        return np.array([y for _, y in self.stored]).reshape(-1, self.start.size).T

    def go(self) -> None:
        """Integrate to the end or to a failure."""
        self.ends.append(self.t0)
        if self.times is None or self.t0 in self.times[:1]:
            self.stored.append((self.t0, self.start))
        try:
            self.solver = self.make(self.limit)
            wanted = self.times.size if self.times is not None and self.times.size else np.inf  # number of output times
            while self.solver.status == "running" and not self.failure and len(self.stored) < wanted:
                self.failure = self._attempt()
                if not self.failure:
                    self._accept()
        except OutOfTimeError:
            self.failure = "out of time"
        except ValueError as error:  # raised by the implicit solvers' linear algebra for NaN
            if self.callbacks.raised:
                raise
            self.failure = str(error)

    def again(self, times: Array | None) -> "Steps":
        """Return the same steps, untimed, with the states at the given times that were reached; itself for None."""
        if times is None:
            return self
        given = self.make, self.t0, self.start, self.callbacks, self.project
        shown = Steps(*given, times[times <= self.ends[-1]], TimeLimit(None))
        if times[0] <= self.ends[-1]:
            shown.go()
        self.failure = self.failure or shown.failure
        return shown

    def message(self, name: str, advice: str) -> str:
        """Return the message of a failure; "" if there was none."""
        if self.limit.exceeded:
            return self.limit.message(name, self.ends[-1], "take looser tolerances or another method")
        failed = f"{name} failed after t = {self.ends[-1]:.10g}: {self.failure.rstrip('.')}. {advice}"
        return failed if self.failure else ""

    def _state(self) -> Array:
        solver = self.solver
        return np.concatenate([solver.y, solver.yp]) if hasattr(solver, "yp") else solver.y.copy()

    def _attempt(self) -> str:
        """Take a step; return an error message or ""."""
        solver, message = self.solver, self.solver.step()
        if solver.status == "failed":
            return str(message)
        # LSODA would continue in both cases, forever in the second
        if not np.isfinite(self._state()).all():
            return f"the state at t = {solver.t:.10g} is not finite"
        if solver.status == "running" and solver.t - self.ends[-1] < SMALLEST_STEP * np.spacing(abs(solver.t)):
            return f"the step has shrunk to {solver.t - self.ends[-1]:.3g} s"
        return ""

    def _accept(self) -> None:
        """Project and store the state after a step."""
        solver, t = self.solver, float(self.solver.t)
        due: list[float] = []
        if self.times is not None:
            first, last = np.searchsorted(self.times, [self.ends[-1], t], side="right")
            due = self.times[first:last].tolist()
        inside = [moment for moment in due if moment != t]
        if inside:
            # before the projection, because the interpolant depends on the solver's own y and f
            interpolant = solver.dense_output()
            for moment in inside:
                state = np.array(interpolant(moment)).ravel()
                if self._projected(moment, state):
                    self.stored.append((moment, state))
        y = self._state()
        if self.project is not None:
            if not self._projected(t, y):
                return
            solver.y = y.copy()
            if solver.status == "running":
                solver.f = solver.fun(t, solver.y)
        self.ends.append(t)
        if self.times is None or len(due) > len(inside):
            self.stored.append((t, y))

    def _projected(self, t: float, y: Array) -> bool:
        if self.project is None or self.project(t, y):
            return True
        self.failure = f"the projection onto the constraints at t = {t:.10g} did not converge"
        return False
