"""Ctrl-C during a run: it ends the run, which returns what it has, wherever the signal arrives.

An exception that arises between any two instructions of Python finds arrays half written, and machine code between its
calls of Python that knows no way out. So the signal raises `KeyboardInterrupt` only within the functions of a user,
which may take long and from which every caller expects exceptions; elsewhere it is kept until the run looks for it.
"""

import _signal  # type: ignore[import-not-found]  # `signal` makes enumerations of handlers, which takes 8 microseconds
import signal
from contextlib import suppress
from types import FrameType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from twoloop.problem.callbacks import PythonFunctions
from twoloop.problem.events import Event
from twoloop.problem.system import ConstrainedSystem
from twoloop.run.record import Record, Statistics, Status, explained

Array = NDArray[np.float64]

CALLS_A_USER = (PythonFunctions.call.__code__, Event.__call__.__code__)
IMPATIENCE = 3  # signals after which the next one raises at once, whatever is lost


class Interrupts:
    """Stands in for Python's own handler of Ctrl-C, from when it listens until it is left; a user's handler stays.

    Before, Ctrl-C raises, as ever: that takes less, where all that is half written then is thrown away.

    Attributes
    ----------
    asked : int
        How many signals came.
    """

    asked, _stands_in = 0, False

    def listen(self) -> "Interrupts":
        """Keep signals from here on, but for those within the functions of a user."""
        if _signal.getsignal(signal.SIGINT) is signal.default_int_handler:
            with suppress(ValueError):  # in threads other than the main one, which get no signals
                _signal.signal(signal.SIGINT, self._heard)
                self._stands_in = True
        return self

    def answers(self) -> bool:
        """Whether Ctrl-C that was raised is to be answered by a result: not the fourth, nor a user's handler's."""
        self.listen()  # where the handler is Python's own
        return self._stands_in and self.asked <= IMPATIENCE

    def leave(self) -> None:
        """Let Python's own handler have its place again."""
        if self._stands_in:
            _signal.signal(signal.SIGINT, signal.default_int_handler)

    def _heard(self, number: int, frame: FrameType | None) -> None:
        self.asked += 1
        if self.asked > IMPATIENCE or _within_a_users_function(frame):
            raise KeyboardInterrupt


def _within_a_users_function(frame: FrameType | None) -> bool:
    while frame is not None:
        if frame.f_code in CALLS_A_USER:
            return True
        frame = frame.f_back
    return False


def said_of_interrupt(t: float, table: Array) -> str:
    """What is said of a run that Ctrl-C ended at t, with these rows [q, v, a, lam]."""
    gaps = int(np.isnan(table[:, -1:]).sum())  # where one of them is missing, all are
    unknown = f" Accelerations and multipliers are NaN at {gaps} of its times." if gaps else ""
    return f"Interrupted from the keyboard at t = {t:.10g}. The result holds what was computed before.{unknown}"


def not_begun(system: ConstrainedSystem, t0: float, events: list[Any] | None, method: str) -> Record:
    """What is returned of a run that Ctrl-C ended before the accelerations at its start were known."""
    n_q, none = system.n_q, np.zeros(0)
    columns = np.zeros((n_q, 0))
    found = None if events is None else [none for _ in events]
    states = None if events is None else [np.zeros((0, n_q)) for _ in events]
    return Record(
        t=none,
        q=columns,
        v=columns.copy(),
        a=columns.copy(),
        lam=np.zeros((system.n_c + system.n_a, 0)),
        h=none.copy(),
        status=Status.INTERRUPTED,
        message=said_of_interrupt(t0, columns.T) + explained(Status.INTERRUPTED),
        stats=Statistics(n_accepted=0),
        t_events=found,
        q_events=states,
        v_events=states,
        system=system,
        method=method,
    )
