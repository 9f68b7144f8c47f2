"""Functions that enclose callbacks, and are compiled when they are called, for whatever types these calls have."""

from collections.abc import Callable
from contextlib import suppress
from typing import Any
from weakref import WeakKeyDictionary

from numba import njit
from numba.core.dispatcher import Dispatcher

from twoloop.kernels.compile.caches import CannotBeWatched, Digest, _Cache, named_apart

_STANDS_FOR: WeakKeyDictionary[Dispatcher, str] = WeakKeyDictionary()


def stands_for(callback: Dispatcher, what: str) -> None:
    """Let a callback, which cannot be watched as it goes to Python, be known by this to functions that enclose it."""
    _STANDS_FOR[callback] = what


class _Digest(Digest):
    """One that knows such callbacks."""

    def _add_helper(self, helper: Dispatcher) -> None:
        if helper in _STANDS_FOR:
            self.add(_STANDS_FOR[helper])
        else:
            super()._add_helper(helper)


def kept_when_called(**options: Any) -> Callable[[Callable[..., Any]], Dispatcher]:
    """`numba.njit(**options)`, with machine code on disk that is read where code, values and callbacks are the same."""

    def decorate(function: Callable[..., Any]) -> Dispatcher:
        code, enclosed = _Digest(), _Digest()
        watched = None
        with suppress(CannotBeWatched):
            code.add_function(function, enclosed=False)
            enclosed.add([cell.cell_contents for cell in function.__closure__ or ()])
            watched = code.hash.hexdigest(), enclosed.hash.hexdigest()
        dispatcher = njit(**options)(named_apart(function, watched))
        if watched is not None:
            with suppress(RuntimeError):  # there is no folder that can be written
                dispatcher._cache = _Cache(dispatcher.py_func, *watched, "")
        return dispatcher

    return decorate
