"""Private parts of numba that code generation uses; other modules import them from here."""

from copy import copy
from types import FunctionType
from typing import Any

from numba.core import cgutils
from numba.core.dispatcher import Dispatcher
from numba.core.registry import cpu_target

__all__ = ["Dispatcher", "add_signature", "cgutils", "forget_compiled", "jitable_templates", "options_of"]


def jitable_templates(function: Any) -> list[Any]:
    """Return numba's templates of a function made by `register_jitable`, which it compiles again in each caller.

    The list is empty for any other function.
    """
    context: Any = cpu_target.typing_context
    if not isinstance(function, FunctionType):
        return []
    context.refresh()  # include functions registered since numba last compiled
    try:
        templates = list(getattr(context.resolve_value_type(function), "templates", ()))
    except ValueError:  # numba does not know the function
        return []
    sources = [getattr(getattr(each, "_overload_func", None), "__closure__", None) for each in templates]
    own = [any(cell.cell_contents is function for cell in source or ()) for source in sources]
    return templates if all(own) else []  # another implementation may replace it


def add_signature(function: Dispatcher, signature: Any) -> None:
    """Let a function of one signature be called with another, whose arguments have the same layout in memory."""
    own: Any = function
    (compiled,) = own.overloads.values()
    own._insert([each._code for each in signature.args], compiled.entry_point, False)
    own.overloads[signature.args] = compiled._replace(signature=signature)
    described = copy(compiled.fndesc)  # for compiled functions that call it
    described.argtypes = signature.args
    own.targetctx.insert_user_function(compiled.entry_point, described, [compiled.library])


def options_of(helper: Any) -> dict[str, Any]:
    """Return numba's options of a compiled helper, or of a function made by `register_jitable`."""
    return helper.targetoptions if isinstance(helper, Dispatcher) else jitable_templates(helper)[0]._jit_options


def forget_compiled(function: Any) -> None:
    """Let numba compile a function made by `register_jitable` again at its next call."""
    for template in jitable_templates(function):
        template._impl_cache.clear()
