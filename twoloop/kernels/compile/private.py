"""What of numba's private parts is used where code is generated; other modules take it from here."""

from copy import copy
from typing import Any

from numba.core import cgutils
from numba.core.dispatcher import Dispatcher

__all__ = ["Dispatcher", "also_for", "cgutils"]


def also_for(function: Dispatcher, signature: Any) -> None:
    """Let a function of one signature be called with another, whose arguments are the same in memory."""
    own: Any = function
    (compiled,) = own.overloads.values()
    own._insert([each._code for each in signature.args], compiled.entry_point, False)
    own.overloads[signature.args] = compiled._replace(signature=signature)
    described = copy(compiled.fndesc)  # for compiled functions that call it
    described.argtypes = signature.args
    own.targetctx.insert_user_function(compiled.entry_point, described, [compiled.library])
