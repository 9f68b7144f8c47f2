"""Propagate the exceptions of a user's signal handlers unchanged, although signals arrive during machine code."""

# module `signal` tries to convert each handler to an enum member, which takes 8 microseconds; `_signal` does not
import _signal  # type: ignore[import-not-found]
import signal
import threading
from contextlib import AbstractContextManager, nullcontext
from types import FrameType, TracebackType
from typing import Any

from twoloop.problem.callbacks import PythonFunctions
from twoloop.problem.events import Event
from twoloop.problem.system import ConstrainedSystem

# code objects of the functions of twoloop that call functions of the user
CALLERS_OF_USER_CODE = (PythonFunctions.call.__code__, Event.__call__.__code__)
COMPILERS = ("numba", "llvmlite")  # packages that break if an exception is raised between two of their instructions
# signals whose handlers are replaced; not all of them exist on Windows
SIGNAL_NAMES = ("SIGALRM", "SIGINT", "SIGTERM", "SIGUSR1", "SIGUSR2", "SIGVTALRM", "SIGPROF", "SIGHUP")
SIGNAL_NUMBERS = [int(getattr(signal, name)) for name in SIGNAL_NAMES if hasattr(signal, name)]


class SignalHandlers:
    """Replacement of the user's signal handlers: calls them at safe points, and raises their exceptions again.

    Python calls a handler before its next instruction, which may belong to numba. If the handler raises an exception,
    this breaks numba for the rest of the process during compilation, and becomes a `SystemError` in Python code that
    machine code called. So the call of a handler is delayed while a compiler runs. Elsewhere the handler is called at
    once; `call_delayed` (between chunks of steps) and `restore` raise its exception again, if others have caught it.
    `ctrl_c`: whether to replace Python's own handler of Ctrl-C, too, as `Interrupts` does during integrations.
    """

    def __init__(self, ctrl_c: bool = False) -> None:
        self._user_handlers: dict[int, Any] = {}
        self._delayed_calls: list[tuple[int, FrameType | None]] = []
        self._handler_error: BaseException | None = None
        for number in SIGNAL_NUMBERS:
            handler = _signal.getsignal(number)
            if callable(handler) and (ctrl_c or handler is not signal.default_int_handler):
                if threading.current_thread() is not threading.main_thread():
                    break  # other threads get no signals
                self._user_handlers[number] = handler
                _signal.signal(number, self._receive)

    def _receive(self, number: int, frame: FrameType | None) -> None:
        if is_in_compiler(frame):
            self._delayed_calls.append((number, frame))
        else:
            self._call_handler(number, frame)

    def _call_handler(self, number: int, frame: FrameType | None) -> None:
        try:
            self._user_handlers[number](number, frame)
        except BaseException as error:
            self._handler_error = error
            raise

    def call_delayed(self) -> None:
        """Call the delayed handlers; raise the exception of a handler, if there was one."""
        while self._delayed_calls and self._handler_error is None:
            self._call_handler(*self._delayed_calls.pop(0))
        if self._handler_error is not None:  # kept for `restore`, because the caller may catch a KeyboardInterrupt
            raise self._handler_error from None

    def restore(self) -> None:
        """Restore the user's handlers, unless the user has set other ones meanwhile; then call delayed handlers."""
        for number, handler in self._user_handlers.items():
            if _signal.getsignal(number) == self._receive:
                _signal.signal(number, handler)
        self.call_delayed()

    def __enter__(self) -> "SignalHandlers":
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        if error is not None and error is self._handler_error:
            self._handler_error = None  # `error` is this exception or replaces it: `restore` must not raise it again
        self.restore()


def signals_of(system: ConstrainedSystem) -> AbstractContextManager[Any]:
    """Return a context for machine code that may call functions of the system in Python, see `SignalHandlers`."""
    return SignalHandlers(ctrl_c=True) if system.called_in_python else nullcontext()


def is_in_user_function(frame: FrameType | None) -> bool:
    """Return whether a frame belongs to a call of a user's function by machine code or by the search for events."""
    while frame is not None:
        if frame.f_code in CALLERS_OF_USER_CODE:
            return True
        frame = frame.f_back
    return False


def is_in_compiler(frame: FrameType | None) -> bool:
    """Return whether a frame belongs to a running compiler, and not to a user's function that the compiler called."""
    while frame is not None and frame.f_code not in CALLERS_OF_USER_CODE:
        if frame.f_globals.get("__name__", "").partition(".")[0] in COMPILERS:
            return True
        frame = frame.f_back
    return False


def raised_by_handler(error: BaseException) -> bool:
    """Return whether an error was raised by a signal handler, according to its traceback."""
    # a handler is a function, a method, a partial function, or an object with a method `__call__`
    callables = [_signal.getsignal(number) for number in SIGNAL_NUMBERS]
    functions = [getattr(each, "__func__", getattr(each, "func", each)) for each in callables if callable(each)]
    codes = {getattr(each, "__code__", getattr(type(each).__call__, "__code__", None)) for each in functions} - {None}
    at = error.__traceback__
    while at is not None and at.tb_frame.f_code not in codes:
        at = at.tb_next
    return at is not None


def is_keyboard_interrupt(error: BaseException) -> bool:
    """Return whether an error, such as a `SystemError` of machine code, is or was caused by a KeyboardInterrupt."""
    cause: BaseException | None = error
    while cause is not None and not isinstance(cause, KeyboardInterrupt):
        cause = cause.__cause__
    return cause is not None
