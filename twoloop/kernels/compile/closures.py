"""Functions that enclose callbacks, and are compiled when they are called, for whatever types these calls have."""

from collections.abc import Callable
from contextlib import suppress
from typing import Any

from numba import njit
from numba.core.dispatcher import Dispatcher

from twoloop.kernels.compile.caches import _Cache, named_apart, watch


def kept_when_called(**options: Any) -> Callable[[Callable[..., Any]], Dispatcher]:
    """`numba.njit(**options)`, with machine code on disk that is read where code, values and callbacks are the same.

    What cannot be watched, such as a callback in plain Python, is not kept, and is compiled in every process.
    """

    def decorate(function: Callable[..., Any]) -> Dispatcher:
        watched = watch(function)
        dispatcher = njit(**options)(named_apart(function, watched))
        if watched is not None:
            with suppress(RuntimeError):  # there is no folder that can be written
                dispatcher._cache = _Cache(dispatcher.py_func, *watched, "")
        return dispatcher

    return decorate
