"""Ctrl-C during a run: it ends the run, which returns what it has, wherever the signal arrives.

An exception that arises between any two instructions of Python finds arrays half written, and machine code between its
calls of Python that knows no way out. So the signal raises `KeyboardInterrupt` only within the functions of a user,
which may take long and from which every caller expects exceptions; elsewhere it is kept until the run looks for it.
"""

import signal
import threading
from types import FrameType, TracebackType
from typing import Any

from twoloop.adapters import PythonFunctions
from twoloop.events import Event

CALLS_A_USER = (PythonFunctions.call.__code__, Event.__call__.__code__)
IMPATIENCE = 3  # signals after which the next one raises at once, whatever is lost


class Interrupts:
    """Stands in for Python's own handler of Ctrl-C as long as it is entered; a handler of the user's stays.

    Attributes
    ----------
    asked : int
        How many signals came.
    """

    def __init__(self) -> None:
        self.asked = 0
        self._stands_in = False

    def __enter__(self) -> "Interrupts":
        if threading.current_thread() is threading.main_thread():  # no other may set handlers, and none gets signals
            self._stands_in = signal.getsignal(signal.SIGINT) is signal.default_int_handler
        if self._stands_in:
            signal.signal(signal.SIGINT, self._heard)
        return self

    def __exit__(self, kind: type[BaseException] | None, error: Any, trace: TracebackType | None) -> bool:
        """Whether what was raised is Ctrl-C: then there is nothing to raise."""
        if self._stands_in:
            signal.signal(signal.SIGINT, signal.default_int_handler)
        return kind is KeyboardInterrupt

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
