"""Pass on exceptions of the user's signal handlers unchanged, even if a signal arrives while machine code runs."""

# `_signal` is faster than `signal`, whose functions take 8 microseconds to convert each handler to an enum member
import _signal  # type: ignore[import-not-found]
import signal
import sys
import threading
from collections.abc import Container
from types import CodeType, FrameType, TracebackType
from typing import Any

from twoloop.problem.callbacks import PythonFunctions
from twoloop.problem.events import Event
from twoloop.problem.system import ConstrainedSystem

# code objects of the two functions of twoloop that call the user's callbacks and event functions
CALLERS_OF_USER_CODE = (PythonFunctions.call.__code__, Event.__call__.__code__)
COMPILERS = ("numba", "llvmlite")  # packages in which a handler must not raise: their data would be left incomplete
# signals whose handlers are replaced; not all of them exist on Windows
SIGNAL_NAMES = ("SIGALRM", "SIGINT", "SIGTERM", "SIGUSR1", "SIGUSR2", "SIGVTALRM", "SIGPROF", "SIGHUP")
SIGNAL_NUMBERS = [int(getattr(signal, name)) for name in SIGNAL_NAMES if hasattr(signal, name)]


class SignalHandlers:
    """Replace the user's signal handlers; call the originals at safe points, so that their exceptions are not lost.

    Python may call a handler anywhere. An exception that a handler raises while numba compiles breaks numba for the
    rest of the process. So, while a compiler runs, handlers are not called but recorded for later calls. Elsewhere a
    handler is called at once; but if it interrupts Python code that machine code has called, its exception becomes a
    `SystemError`. So `call_delayed`, called between chunks of steps, and `restore` raise the original exception again.
    `ctrl_c`: True replaces Python's own handler of Ctrl-C, too, as `Interrupts` does during integrations.
    """

    def __init__(self, ctrl_c: bool = False) -> None:
        owner = sys._getframe(1)
        while owner.f_back is not None and _package_of(owner.f_back) == "twoloop":
            owner = owner.f_back
        self._owner = owner.f_code  # code of the function of twoloop that the user has called
        self._user_handlers: dict[int, Any] = {}
        self._delayed_calls: list[int] = []  # numbers of signals whose handlers are still to be called
        self._handler_error: BaseException | None = None
        try:
            for number in SIGNAL_NUMBERS:
                handler = _signal.getsignal(number)
                if callable(handler) and (ctrl_c or handler is not signal.default_int_handler):
                    if threading.current_thread() is not threading.main_thread():
                        break  # Python calls signal handlers in the main thread only
                    self._user_handlers[number] = handler
                    _signal.signal(number, self._receive)
        except BaseException:  # raised by the handler of a signal that has arrived meanwhile
            self.restore()
            raise

    def _receive(self, number: int, frame: FrameType | None) -> None:
        if not is_within(frame, {self._owner}):  # `restore` was not called, as an exception came just before
            _signal.signal(number, self._user_handlers[number])
            self._user_handlers[number](number, frame)
        elif is_in_compiler(frame):
            self._delayed_calls.append(number)
        else:
            self._call_handler(number, frame)

    def _call_handler(self, number: int, frame: FrameType | None) -> None:
        try:
            self._user_handlers[number](number, frame)
        except BaseException as error:
            self._handler_error = error
            raise

    def call_delayed(self) -> None:
        """Call the handlers whose calls were delayed; if a handler has raised an exception, raise it again."""
        while self._delayed_calls and self._handler_error is None:
            # do not pass the signal's frame: it is in a compiler, so outer SignalHandlers would delay the call again
            self._call_handler(self._delayed_calls.pop(0), sys._getframe())
        if self._handler_error is not None:  # not reset here: `restore` raises it again if the caller catches it
            raise self._handler_error from None

    def restore(self) -> None:
        """Restore the user's handlers, unless the user has set new ones meanwhile; then call `call_delayed`."""
        for number, handler in self._user_handlers.items():
            if _signal.getsignal(number) == self._receive:
                _signal.signal(number, handler)
        self.call_delayed()

    def __enter__(self) -> "SignalHandlers":
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        if error is not None and error is self._handler_error:
            self._handler_error = None  # `error` leaves the `with` block anyway: `restore` must not raise it again
        self.restore()


def signals_of(system: ConstrainedSystem) -> SignalHandlers:
    """Return a context manager that raises exceptions of signal handlers again, even if its block catches them."""
    return SignalHandlers(ctrl_c=system.called_in_python)


def _package_of(frame: FrameType) -> str:
    return str(frame.f_globals.get("__name__", "")).partition(".")[0]


def is_within(frame: FrameType | None, codes: Container[CodeType]) -> bool:
    """Return True if a stack frame, or one of its callers, executes one of the code objects `codes`."""
    while frame is not None and frame.f_code not in codes:
        frame = frame.f_back
    return frame is not None


def is_in_compiler(frame: FrameType | None) -> bool:
    """Return True if a stack frame is within numba or llvmlite, and not in a user's function that these call."""
    while frame is not None and frame.f_code not in CALLERS_OF_USER_CODE:
        if _package_of(frame) in COMPILERS:
            return True
        frame = frame.f_back
    return False


def raised_by_handler(error: BaseException) -> bool:
    """Return True if a signal handler raised an error: the traceback contains a handler."""
    # find the Python code of each handler: a function, a method, a partial function, or an object with `__call__`
    callables = [_signal.getsignal(number) for number in SIGNAL_NUMBERS]
    functions = [getattr(each, "__func__", getattr(each, "func", each)) for each in callables if callable(each)]
    codes = {getattr(each, "__code__", getattr(type(each).__call__, "__code__", None)) for each in functions} - {None}
    at = error.__traceback__
    while at is not None and at.tb_frame.f_code not in codes:
        at = at.tb_next
    return at is not None


def is_keyboard_interrupt(error: BaseException) -> bool:
    """Return True if an error is a KeyboardInterrupt, or has one in its chain of causes, as a `SystemError` may."""
    cause: BaseException | None = error
    while cause is not None and not isinstance(cause, KeyboardInterrupt):
        cause = cause.__cause__
    return cause is not None
