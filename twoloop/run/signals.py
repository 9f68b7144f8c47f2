"""Let exceptions of a user's signal handlers arrive as themselves, though signals come during machine code."""

import _signal  # type: ignore[import-not-found]  # `signal` makes enumerations of handlers, which takes 8 microseconds
import signal
import threading
from contextlib import AbstractContextManager, nullcontext
from types import FrameType, TracebackType
from typing import Any

from twoloop.problem.callbacks import PythonFunctions
from twoloop.problem.events import Event
from twoloop.problem.system import ConstrainedSystem

CALLS_A_USER = (PythonFunctions.call.__code__, Event.__call__.__code__)
COMPILERS = ("numba", "llvmlite")  # packages that an exception between two instructions leaves unusable
NAMES = ("SIGALRM", "SIGINT", "SIGTERM", "SIGUSR1", "SIGUSR2", "SIGVTALRM", "SIGPROF", "SIGHUP")  # not all on Windows
NUMBERS = [int(getattr(signal, name)) for name in NAMES if hasattr(signal, name)]


class SignalHandlers:
    """Call the user's signal handlers where machine code can pass on their exceptions, and raise these again.

    Python runs handlers at its next instruction, which may be one of numba's: between two pieces of machine code, which
    do not check for exceptions, so that `SystemError` follows; or while numba compiles, which then fails for the rest
    of the process. Handlers wait there. Elsewhere they run at once, but the exception may be taken for one of a
    callback, as for a force that has no value; it is therefore raised again by `check`, between chunks of steps, and
    by `leave`.

    Parameters
    ----------
    ctrl_c : bool
        Whether Python's own handler of Ctrl-C is called like this, too. Runs replace it by one of theirs.
    """

    def __init__(self, ctrl_c: bool = False) -> None:
        self._before: dict[int, Any] = {}
        self._waiting: list[tuple[int, FrameType | None]] = []
        self._raised: BaseException | None = None
        for number in NUMBERS:
            handler = _signal.getsignal(number)
            if callable(handler) and (ctrl_c or handler is not signal.default_int_handler):
                if threading.current_thread() is not threading.main_thread():
                    break  # other threads get no signals
                self._before[number] = handler
                _signal.signal(number, self._receive)

    def _receive(self, number: int, frame: FrameType | None) -> None:
        if within_a_compiler(frame):
            self._waiting.append((number, frame))
        else:
            self._call(number, frame)

    def _call(self, number: int, frame: FrameType | None) -> None:
        try:
            self._before[number](number, frame)
        except BaseException as error:
            self._raised = error
            raise

    def check(self) -> None:
        """Call handlers that wait; raise what a handler raised."""
        while self._waiting and self._raised is None:
            self._call(*self._waiting.pop(0))
        if self._raised is not None:  # it stays, because handlers of Ctrl-C may catch it
            raise self._raised from None

    def leave(self) -> None:
        """Restore the handlers, unless the user has set others meanwhile, and check; once for each object."""
        for number, handler in self._before.items():
            if _signal.getsignal(number) == self._receive:
                _signal.signal(number, handler)
        self.check()

    def __enter__(self) -> "SignalHandlers":
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        if error is not None and error is self._raised:
            self._raised = None  # it arrives with its own traceback
        self.leave()


def signals_of(system: ConstrainedSystem) -> AbstractContextManager[Any]:
    """Return a context for machine code that calls functions of the system in Python, where handlers may run."""
    return SignalHandlers(ctrl_c=True) if system.called_in_python else nullcontext()


def within_a_users_function(frame: FrameType | None) -> bool:
    """Return whether a frame belongs to a call of a user's function by machine code or by the search for events."""
    while frame is not None:
        if frame.f_code in CALLS_A_USER:
            return True
        frame = frame.f_back
    return False


def within_a_compiler(frame: FrameType | None) -> bool:
    """Return whether a frame belongs to a compiler, but not to a user's function called from there."""
    while frame is not None and frame.f_code not in CALLS_A_USER:
        if frame.f_globals.get("__name__", "").partition(".")[0] in COMPILERS:
            return True
        frame = frame.f_back
    return False


def interrupted(error: BaseException) -> bool:
    """Return whether Ctrl-C caused an error that machine code turned into `SystemError`."""
    cause: BaseException | None = error
    while cause is not None and not isinstance(cause, KeyboardInterrupt):
        cause = cause.__cause__
    return cause is not None
