"""Functions that index arrays by numbers that they compute, as in a table: their bounds are watched in every call.

Without that, machine code reads other memory beyond the end of a table, or ends the process. What functions with
constant indices and counters of loops do, the first call shows, and they are left as they are.
"""

import ast
import inspect
import textwrap
from collections.abc import Callable
from typing import Any

from numba import jit

from twoloop.kernels.compile.caches import named_apart, watch
from twoloop.kernels.compile.dependencies import of_library
from twoloop.kernels.compile.frozen import places, python_function
from twoloop.kernels.compile.private import options_of
from twoloop.kernels.compile.rewritten import Rewritten

WATCHED = {"boundscheck": True}  # for numba
OURS, GENERATED = "twoloop", "twoloop_equations_"  # package and generated modules: their functions stay within bounds
SAFE_CALLS = ("len", "min", "max", "abs", "range", "enumerate", "zip", "reversed")  # with arguments that are safe


def with_bounds_watched(function: Callable[..., Any]) -> tuple[Callable[..., Any], dict[str, Any]]:
    """A function, or its copy with helpers whose bounds are watched, and options that numba needs for it."""
    helpers = [helper for place in places(function) if (helper := python_function(place.value)) is not None]
    if any(map(computes_indices, helpers)):
        return Rewritten(_watched).copy_of(function), WATCHED
    return function, WATCHED if computes_indices(function) else {}


def _watched(copy: Any, original: Any) -> Any:
    """What stands in the place of a compiled helper, with the options that it had; the function itself is no helper."""
    helper = python_function(original)
    if helper is None:
        return copy
    copy.__qualname__ = f"{helper.__qualname__}.watched"  # numba's symbols are made of it
    return jit(**{**options_of(original), **WATCHED})(named_apart(copy, watch(helper)))


def computes_indices(function: Callable[..., Any]) -> bool:
    """Whether an index in the source of a function may depend on more than constants and counters of loops."""
    module = function.__module__ or ""
    if module.partition(".")[0] == OURS or module.startswith(GENERATED) or of_library(module):
        return False
    try:
        tree = ast.parse(textwrap.dedent(inspect.getsource(function)))
    except (OSError, TypeError, SyntaxError):  # typed at a prompt, or a part of a statement
        return True
    computed = _computed(tree)
    return any(not _is_safe(node.slice, computed) for node in ast.walk(tree) if isinstance(node, ast.Subscript))


def _computed(tree: ast.AST) -> set[str]:
    """Names that may stand for other numbers than constants and counters of loops."""
    found = {node.arg for node in ast.walk(tree) if isinstance(node, ast.arg)}
    while True:
        before = len(found)
        for node in ast.walk(tree):
            if isinstance(node, ast.For):
                targets, value = [node.target], node.iter
            elif isinstance(node, ast.Assign):
                targets, value = node.targets, node.value
            elif isinstance(node, ast.AugAssign | ast.AnnAssign | ast.NamedExpr):
                targets, value = [node.target], None
            else:
                continue
            if value is None or not _is_safe(value, found):
                names = (each for target in targets for each in ast.walk(target))
                found |= {each.id for each in names if isinstance(each, ast.Name) and isinstance(each.ctx, ast.Store)}
        if len(found) == before:
            return found


def _is_safe(node: ast.AST | None, computed: set[str]) -> bool:
    """Whether an expression is of constants, counters of loops and sizes alone."""
    if node is None or isinstance(node, ast.Constant):
        return True
    if isinstance(node, ast.Name):
        return node.id not in computed
    if isinstance(node, ast.Attribute):
        return node.attr in ("size", "shape", "ndim") or _is_safe(node.value, computed)
    if isinstance(node, ast.Call):
        named = isinstance(node.func, ast.Name) and node.func.id in SAFE_CALLS
        sized = isinstance(node.func, ast.Name) and node.func.id == "len"
        return named and (sized or all(_is_safe(each, computed) for each in node.args))
    if isinstance(node, ast.Subscript):
        return _is_safe(node.value, computed) and _is_safe(node.slice, computed)
    if isinstance(node, ast.BinOp | ast.UnaryOp | ast.Tuple | ast.List | ast.Slice):
        kept = (ast.operator, ast.unaryop, ast.expr_context)
        return all(_is_safe(each, computed) for each in ast.iter_child_nodes(node) if not isinstance(each, kept))
    return False
