"""A time limit for the runs of a simulator, without signals or processes."""

import ctypes
import threading
from contextvars import copy_context
from typing import Any

from twoloop.testing.known_problem import Array, KnownProblem

NO_BOUND = (
    "An iteration, or a step size that falls, has no bound: limit the numbers of iterations and of steps, and raise."
)


class DidNotEnd(Exception):
    """A run that passed the time limit."""


class _Stop(SystemExit):
    """Raised within a run that has passed the limit; no `except Exception` of a simulator catches it."""


class Limited:
    """A simulator whose runs raise `DidNotEnd` after some seconds; it is not run again after that."""

    def __init__(self, simulate: Any, seconds: float | None):
        self._simulate, self._seconds, self.over = simulate, seconds, ""

    def __call__(self, problem: KnownProblem, times: Array, setting: float) -> Any:
        """Return what the simulator returns, or raise what it raises."""
        if self._seconds is None:
            return self._simulate(problem, times, setting)
        if self.over:
            raise DidNotEnd(self.over)
        returned: list[Any] = []
        raised: list[BaseException] = []

        def run() -> None:
            try:
                returned.append(self._simulate(problem, times, setting))
            except BaseException as error:  # also what pytest.skip raises: it belongs to the caller
                raised.append(error)

        thread = threading.Thread(target=copy_context().run, args=(run,), daemon=True)
        thread.start()
        try:
            thread.join(self._seconds)
        finally:  # also at Ctrl-C
            late = thread.is_alive()
            if late:
                _stop(thread)
        if late:
            self.over = f"did not end within {self._seconds:g} s"
            raise DidNotEnd(self.over)
        if raised:
            raise raised[0]
        return returned[0]


def _stop(thread: threading.Thread) -> None:
    """Raise `_Stop` in a thread, which ends it once it is back in Python code."""
    assert thread.ident is not None
    ctypes.pythonapi.PyThreadState_SetAsyncExc(ctypes.c_ulong(thread.ident), ctypes.py_object(_Stop))
    thread.join(0.1)
