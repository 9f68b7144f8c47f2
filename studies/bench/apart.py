"""Work that may hang, die or raise: in a process of its own, with what it warns of, with a limit on its CPU time."""

import multiprocessing
import signal
import threading
import time
import warnings
from collections.abc import Callable
from typing import Any, Self

from references.driver import user_call
from studies.bench.store import Row
from twoloop import Result

SEPARATOR = " / "  # of warnings


def heard(call: Callable[[], Result]) -> tuple[Result | None, Row]:
    """The result of a call, or None; its status and message, or what was raised; and what it warned of."""
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        try:
            result, told = (made := call()), {"status": made.status.name, "message": made.message}
        except Exception as error:  # of whatever kind: a row
            result, told = None, {"status": "RAISED", "message": f"{type(error).__name__}: {error}"}
    return result, told | {"warned": SEPARATOR.join(str(each.message) for each in said)}


def apart(work: Callable[[], Any], limit: float | None = None) -> Any:
    """Return the result of work() in a fork of this process, which is ended after `limit` s.

    Raises TimeoutError after `limit` s, or EOFError if the process ends without a result; its argument is the exit
    code.
    """
    context = multiprocessing.get_context("fork")
    here, there = context.Pipe(duplex=False)

    process = context.Process(target=lambda: there.send(work()), daemon=True)
    process.start()
    there.close()
    try:
        if not here.poll(limit):
            raise TimeoutError
        return here.recv()
    except EOFError:
        process.join()
        raise EOFError(process.exitcode) from None
    finally:
        process.kill()
        process.join()


class TimeLimit(Exception):
    """Raised in a run that has used up its CPU time."""


class Alarm:
    """Raise TimeLimit in this process when a user's call has used up its CPU time; `rang` says why."""

    def __init__(self, seconds: float, around: float):
        self.seconds, self.around, self.rang = seconds, around, ""
        self._can = hasattr(signal, "setitimer") and threading.current_thread() is threading.main_thread()
        self._began, self._before = 0.0, None

    def __enter__(self) -> Self:
        if self._can:
            self._began = time.process_time()
            # a timer of wall-clock time: one of CPU time makes the clocks of CPU time advance in ticks of 4 ms on Linux
            self._before = signal.signal(signal.SIGALRM, self._look)  # type: ignore[assignment]
            # again and again: an exception raised in a callback of a foreign solver may be swallowed by it
            signal.setitimer(signal.ITIMER_REAL, 1.1 * self.seconds, min(1.0, 0.5 * self.seconds))
        return self

    def __exit__(self, *_: object) -> None:
        if self._can:
            signal.setitimer(signal.ITIMER_REAL, 0.0)
            signal.signal(signal.SIGALRM, self._before)

    def _look(self, *_: object) -> None:
        if user_call.so_far() >= 1.1 * self.seconds:  # a solver's own limit comes first
            self.rang = f"Stopped after {self.seconds:g} s of CPU time, the limit of a run."
        elif time.process_time() - self._began >= self.around:
            self.rang = f"Stopped after {self.around:g} s of CPU time, the limit of all that an adapter does."
        if self.rang:
            raise TimeLimit
