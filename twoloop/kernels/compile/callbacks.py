"""Define the kinds of callback that a mechanism may have, such as "mass", and the decorator that compiles a callback.

The table `KINDS` determines the signature that numba compiles, the fields of `Functions` in the kernels, the methods
and the documentation of `ConstrainedSystem`, and adapters for Python functions.

If a callback computes an index, for example into a table, its machine code checks every index at every call: an invalid
index could read memory beyond the end of an array, or crash the process. If all indices are constants or loop counters,
they are not checked, because they are the same at every call: the first call shows whether they are valid.
"""

import ast
import inspect
import re
import textwrap
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, cached_property
from typing import Any

import numba
from numba import jit
from numba.core.dispatcher import Dispatcher

from twoloop.kernels.compile.caches import compile_cached, digests_of, give_unique_name
from twoloop.kernels.compile.dependencies import (
    FunctionCopier,
    frozen_locations,
    frozen_values,
    is_library,
    is_twoloop,
    python_function,
    register_digest,
)
from twoloop.kernels.compile.linking import add_signature, options_of

BOUNDS_CHECK = {"boundscheck": True}  # option of numba: machine code raises IndexError for an invalid index
# built-in functions: if their arguments are safe indices, such as constants or loop counters, their results are, too
SAFE_CALLS = ("len", "min", "max", "abs", "range", "enumerate", "zip", "reversed")


def add_bounds_checks(function: Callable[..., Any]) -> tuple[Callable[..., Any], dict[str, Any]]:
    """Return the function to compile for a callback, and the options of numba with which machine code checks indices.

    The options are empty if no index is computed. If a compiled function that the callback calls (a helper) computes
    indices, the returned function is a copy of the callback that calls copies of all helpers with checks.
    """
    helpers = [helper for place in frozen_locations(function) if (helper := python_function(place.value)) is not None]
    if any(map(has_computed_indices, helpers)):
        return FunctionCopier(_compile_with_bounds_checks).copy_of(function), BOUNDS_CHECK
    return function, BOUNDS_CHECK if has_computed_indices(function) else {}


def _compile_with_bounds_checks(copy: Any, original: Any) -> Any:
    """Return the `copy` of a function; if the `original` is compiled, compile the copy with checks of its indices."""
    helper = python_function(original)
    if helper is None:
        return copy
    copy.__qualname__ = f"{helper.__qualname__}.watched"  # numba must not confuse it with the code without checks
    return jit(**{**options_of(original), **BOUNDS_CHECK})(give_unique_name(copy, digests_of(helper)))


def has_computed_indices(function: Callable[..., Any]) -> bool:
    """Return True if a user's function may have indices other than constants and loop counters, or has no source."""
    if is_twoloop(function.__module__ or "") or is_library(function.__module__ or ""):
        return False
    try:
        tree = ast.parse(textwrap.dedent(inspect.getsource(function)))
    except (OSError, TypeError, SyntaxError):  # the function was typed at a prompt, or is part of a statement (lambda)
        return True
    computed = _computed_names(tree)
    return any(not _is_safe_index(node.slice, computed) for node in ast.walk(tree) if isinstance(node, ast.Subscript))


def _computed_names(tree: ast.AST) -> set[str]:
    """Return names of a function's variables that may have values other than constants, loop counters, array sizes."""
    computed = {node.arg for node in ast.walk(tree) if isinstance(node, ast.arg)}
    while True:
        n_before = len(computed)
        for node in ast.walk(tree):
            if isinstance(node, ast.For):
                targets, value = [node.target], node.iter
            elif isinstance(node, ast.Assign):
                targets, value = node.targets, node.value
            elif isinstance(node, ast.AugAssign | ast.AnnAssign | ast.NamedExpr):
                targets, value = [node.target], None
            else:
                continue
            if value is None or not _is_safe_index(value, computed):
                names = [node for target in targets for node in ast.walk(target) if isinstance(node, ast.Name)]
                computed |= {name.id for name in names if isinstance(name.ctx, ast.Store)}
        if len(computed) == n_before:
            return computed


def _is_safe_index(node: ast.AST | None, computed: set[str]) -> bool:
    """Return True if an index needs no check: it has only constants, array sizes, and variables not in `computed`."""
    if node is None or isinstance(node, ast.Constant):
        return True
    if isinstance(node, ast.Name):
        return node.id not in computed
    if isinstance(node, ast.Attribute):
        return node.attr in ("size", "shape", "ndim") or _is_safe_index(node.value, computed)
    if isinstance(node, ast.Call):
        is_listed = isinstance(node.func, ast.Name) and node.func.id in SAFE_CALLS
        is_len = isinstance(node.func, ast.Name) and node.func.id == "len"
        return is_listed and (is_len or all(_is_safe_index(each, computed) for each in node.args))
    if isinstance(node, ast.Subscript):
        return _is_safe_index(node.value, computed) and _is_safe_index(node.slice, computed)
    if isinstance(node, ast.BinOp | ast.UnaryOp | ast.Tuple | ast.List | ast.Slice):
        kinds = (ast.operator, ast.unaryop, ast.expr_context)  # child nodes that are not expressions: skip them
        return all(_is_safe_index(each, computed) for each in ast.iter_child_nodes(node) if not isinstance(each, kinds))
    return False


f8 = numba.types.float64
VECTOR = numba.types.float64[::1]
READ_ONLY_VECTOR = numba.types.Array(f8, 1, "C", readonly=True)  # machine code for it also accepts writable vectors
MATRIX = numba.types.float64[:, ::1]

# attributes of a system with the sizes of the vectors that callbacks receive; lam: multipliers of C = 0
STATE_SIZES = {"q": "n_q", "v": "n_q", "lam": "n_c"}


@dataclass(frozen=True)
class CallbackKind:
    """Kind of callback: its arguments, and what replaces it if the system has none.

    state : names of the arguments between t and p, such as ("q", "v"); keys of `STATE_SIZES`.
    output : name of the array that the callback fills.
    shape : shape of this array, as names of attributes of a system, such as ("n_c", "n_q").
    meaning : meaning of the output in a few words, for messages.
    note : remarks for the documentation.
    absent : what replaces a callback that is not given. "": nothing, the callback is required; "zeros": a callback that
        leaves its outputs at zero; "differences": a callback that computes finite differences of C (jacobian.py);
        "kernels": nothing, because kernels compute finite differences themselves.
    needed_by : "n_c" or "n_a": the callback is required if this size of the system is above zero; "": no condition.
    more : names and shapes of further arrays that the callback fills. A callback with such arrays must be compiled.
    """

    state: tuple[str, ...]
    output: str
    shape: tuple[str, ...]
    meaning: str
    note: str = ""
    absent: str = ""
    needed_by: str = ""
    more: tuple[tuple[str, tuple[str, ...]], ...] = ()

    @property
    def optional(self) -> bool:
        """Return True if systems may lack this callback, apart from those that need it according to `needed_by`."""
        return self.absent != ""

    @cached_property
    def outputs(self) -> tuple[tuple[str, tuple[str, ...]], ...]:
        """Return the names and shapes of all arrays that the callback fills."""
        return ((self.output, self.shape), *self.more)

    @property
    def arguments(self) -> tuple[str, ...]:
        """Return the names of the arguments of a callback of this kind, including the arrays that it fills."""
        return ("t", *self.state, "p", *(name for name, _ in self.outputs))

    @cached_property
    def signature(self) -> Any:
        """Return the signature with which kernels call a callback: all arrays have writable types."""
        return self._signature(VECTOR)

    @property
    def read_only_signature(self) -> Any:
        """Return the signature for which numba compiles a callback: all arrays except the outputs are read-only."""
        return self._signature(READ_ONLY_VECTOR)

    def _signature(self, input_type: Any) -> Any:
        output_types = [VECTOR if len(shape) == 1 else MATRIX for _, shape in self.outputs]
        return numba.types.void(f8, *[input_type] * len(self.state), input_type, *output_types)

    @property
    def shapes_text(self) -> str:
        """Return the shapes of the outputs as text, such as "(n_c, n_q)"."""
        return ", ".join(f"({', '.join(shape)}{',' if len(shape) == 1 else ''})" for _, shape in self.outputs)


KINDS = {
    "mass": CallbackKind(
        ("q",),
        "M",
        ("n_q", "n_q"),
        "the mass matrix M",
        "Symmetric; positive definite on the velocities that the constraints allow.",
    ),
    "force": CallbackKind(("q", "v"), "Q", ("n_q",), "the force Q"),
    "constraint": CallbackKind(
        ("q",), "C", ("n_c",), "the constraints C", "None: n_c is 0.", absent="zeros", needed_by="n_c"
    ),
    "jacobian": CallbackKind(
        ("q",),
        "Cq",
        ("n_c", "n_q"),
        "C_q, the derivative of constraint with respect to q",
        "None: the exact derivative of constraint if it runs on symbols, otherwise differences of order 8. Differences "
        "cost 8 n_q calls of constraint for each Jacobian (more where the constraint bends on a scale far below "
        "max(1, |q_j|)), and constraint must be defined within 1/16 of max(1, |q_j|) about q. Entries are then good to "
        "about 1e-13 of the largest term in the constraint; if gamma is left out, too, it is good to about 1e-9.",
        absent="differences",
    ),
    "constraint_rate": CallbackKind(
        ("q",),
        "Ct",
        ("n_c",),
        "C_t, the derivative of constraint with respect to t",
        "None: the constraints do not depend on time.",
        absent="zeros",
    ),
    "gamma": CallbackKind(
        ("q", "v"),
        "Qd",
        ("n_c",),
        "Q_d = -((C_q v)_q v + 2 C_qt v + C_tt), the right-hand side of C_q a = Q_d",
        "None: exact if C_q and C_t run on symbols, otherwise by differences of them along the motion.",
        absent="kernels",
    ),
    "force_by_q": CallbackKind(
        ("q", "v"),
        "K",
        ("n_q", "n_q"),
        "dQ/dq, the derivative of force with respect to q",
        "A tangent for Newton's method as the outer loop, as are the two that follow. With it the force is not "
        "differenced; it must not depend on v then unless force_by_v is given too. None: all by differences. What the "
        "stiff part does not need is left out then (how M, and the directions that constraints allow, change with q): "
        "at a tolerance steps are the same, but fixed steps in which bodies turn far may fail to converge.",
        absent="zeros",
    ),
    "force_by_v": CallbackKind(
        ("q", "v"),
        "D",
        ("n_q", "n_q"),
        "dQ/dv, the derivative of force with respect to v",
        "None beside force_by_q: the force does not depend on v.",
        absent="zeros",
    ),
    "reaction_by_q": CallbackKind(
        ("q", "lam"),
        "R",
        ("n_q", "n_q"),
        "d(C_q^T lam)/dq with lam held, the derivative of the reactions with respect to q",
        "None: by differences of C_q, none where C_q does not change.",
        absent="zeros",
    ),
    "nonholonomic": CallbackKind(
        ("q",),
        "A",
        ("n_a", "n_q"),
        "A of the non-holonomic constraints A v + b = 0",
        "None: n_a is 0.",
        absent="zeros",
        needed_by="n_a",
    ),
    "nonholonomic_rate": CallbackKind(
        ("q",), "b", ("n_a",), "b of the non-holonomic constraints A v + b = 0", "None: zero.", absent="zeros"
    ),
    "nonholonomic_gamma": CallbackKind(
        ("q", "v"),
        "Qa",
        ("n_a",),
        "-((A v)_q v + A_t v + b_q v + b_t), the right-hand side of A a = Q_a",
        "None: exact if A and b run on symbols, otherwise by differences of them along the motion.",
        absent="kernels",
    ),
    "kinematics": CallbackKind(
        ("q", "v"),
        "C",
        ("n_c",),
        "C, C_q, C_t and Q_d together",
        "They share sines: one call instead of four. Goes with constraint, jacobian and gamma, and must agree.",
        absent="zeros",
        more=(("Cq", ("n_c", "n_q")), ("Ct", ("n_c",)), ("Qd", ("n_c",))),
    ),
    "mass_values": CallbackKind(
        ("q",),
        "values",
        ("n_mass_values",),
        "the entries of M that mass_entries names",
        "For large systems, beside mass or in its place: nothing of size n_q x n_q is filled where accelerations are "
        "found by sparse factors. Both triangles.",
        absent="zeros",
    ),
    "jacobian_values": CallbackKind(
        ("q",),
        "values",
        ("n_jacobian_values",),
        "the entries of C_q that jacobian_entries names",
        "For large systems, beside jacobian or in its place: nothing of size n_c x n_q is filled where accelerations "
        "are found by sparse factors.",
        absent="zeros",
    ),
}
OPTIONAL_KINDS = tuple(name for name, kind in KINDS.items() if kind.optional)


def callback(kind: str, allocates: bool = True) -> Callable[[Callable[..., None]], Dispatcher]:
    """Compile a callback of a mechanism with the signature of its kind.

    The arguments are the time, the coordinates `q` (n_q,), in some kinds the velocities `v` (n_q,) or the multipliers
    `lam` (n_c,), the parameters `p`, and the array to fill, which contains zeros at first. Add to this array, and
    write to no other. If the system has a `bandwidth`, add to a derivative of forces only within the band::

        @callback("jacobian")
        def jacobian(t, q, p, Cq):
            Cq[0, 0] = q[0]
            Cq[0, 1] = q[1]

    Machine code is cached on disk. It is compiled again after a change of the function, of a compiled function that it
    calls, or of a global variable that they use.

    Parameters
    ----------
    kind : str
        {kinds}.
    allocates : bool
        False: the function creates no arrays. Then references to arrays are not counted, which saves 10 ns per call.

    Raises
    ------
    ValueError
        If `kind` is unknown.
    TypeError
        If the function has other arguments or writes to an input array, or if numba cannot compile it.

    Examples
    --------
    >>> from twoloop import ConstrainedSystem, callback
    >>> @callback("mass")
    ... def mass(t, q, p, M):
    ...     M[0, 0] = p[0]
    >>> @callback("force")
    ... def force(t, q, v, p, Q):
    ...     Q[0] = -p[1] * q[0]
    >>> spring = ConstrainedSystem(n_q=1, n_c=0, mass=mass, force=force, parameters=[2.0, 8.0])
    >>> spring.force(0.0, [0.5], [0.0])
    array([-4.])
    """
    if callable(kind):
        raise TypeError('the decorator needs the kind of callback: write @callback("force"), not @callback')
    if not isinstance(kind, str) or kind not in KINDS:
        raise ValueError(f"kind must be one of {', '.join(KINDS)}; given {kind!r}")

    def decorate(function: Callable[..., None]) -> Dispatcher:
        expected, given = KINDS[kind].arguments, tuple(inspect.signature(function).parameters)
        if given != expected:
            raise TypeError(
                f"{function.__name__} is declared as the callback {kind!r}, whose arguments are "
                f"({', '.join(expected)}); it has ({', '.join(given)})"
            )
        return compile_callback(kind, function, digests_of(function), allocates=allocates)

    return decorate


if callback.__doc__:  # python -OO removes docstrings
    callback.__doc__ = callback.__doc__.format(
        kinds=",\n        ".join(f'"{name}" ({", ".join(kind.arguments)})' for name, kind in KINDS.items())
    )


# option of numba for callbacks: a division by zero yields an infinity or NaN, and no exception
_NUMBA_OPTIONS: dict[str, Any] = {"error_model": "numpy"}


def compile_callback(
    kind: str,
    function: Callable[..., Any],
    digests: tuple[str, str] | None,
    named_function: Callable[..., Any] | None = None,
    allocates: bool = True,
) -> Dispatcher:
    """Compile a function as a callback of the given kind; raise TypeError if this is impossible.

    `digests`: see `compile_cached`. `allocates`: see `callback`. `named_function`: function to name in messages.
    """
    compiled, more = add_bounds_checks(function)
    options = {**_NUMBA_OPTIONS, **more} if allocates else {**_NUMBA_OPTIONS, **more, "_nrt": False}
    if digests is not None:
        digests = f"{digests[0]} {options}", digests[1]
    try:
        dispatcher = compile_cached(compiled, KINDS[kind].read_only_signature, digests, **options)
    except Exception as error:  # numba raises many types of errors, also failed assertions
        dispatcher = _compile_with_writable_inputs(kind, compiled, digests, named_function or function, error, options)
    else:
        add_signature(dispatcher, KINDS[kind].signature)
    if digests is not None:
        # register the digests now: values that the function uses may change later, but the machine code will not
        register_digest(dispatcher, f"{kind} {digests}")
    frozen_values(dispatcher, function)
    return dispatcher


def _compile_with_writable_inputs(
    kind: str,
    function: Callable[..., Any],
    digests: tuple[str, str] | None,
    named_function: Callable[..., Any],
    error: Exception,
    options: dict[str, Any],
) -> Dispatcher:
    """Compile a callback for writable input arrays, because its compilation for read-only ones raised `error`.

    Raise TypeError if this fails, or if `error` has another cause than a called function that rejects read-only arrays.
    """
    try:
        dispatcher = compile_cached(function, KINDS[kind].signature, digests, **options)
    except Exception as second_error:
        raise TypeError(_failure_message(kind, named_function, second_error)) from None
    if _HELPER_REJECTS_READ_ONLY.search(plain := _remove_colours(error)) and "setitem" not in plain:
        return dispatcher
    raise TypeError(
        f"{kind}: the function {_name_and_location(named_function)} must not change the arrays that it is given "
        f"({', '.join([*KINDS[kind].state, 'p'])}), which are those of the run. Copy first\n"
        f"Numba says: {_informative_line(error)}"
    ) from None


# numba's message matches this pattern if a compiled function that the callback calls rejects read-only arrays
_HELPER_REJECTS_READ_ONLY = re.compile(r"Invalid use of type\(CPUDispatcher\(")


@cache
def zero_callback(kind: str) -> Dispatcher:
    """Return a compiled callback that leaves its outputs at zero: it replaces a missing callback of this kind."""

    def leave_zeros(t, q, p, out):
        pass

    def leave_zeros_3(t, q, x, p, out):
        pass

    def leave_zeros_4(t, q, v, p, C, Cq, Ct, Qd):
        pass

    function = leave_zeros if len(KINDS[kind].state) == 1 else leave_zeros_4 if KINDS[kind].more else leave_zeros_3
    return compile_callback(kind, function, ("leaves zeros", ""))


def _failure_message(kind: str, function: Callable[..., Any], error: Exception) -> str:
    return (
        f"{kind}: numba cannot compile the function {_name_and_location(function)}; it must use numbers, numpy arrays "
        f"of one type and of the shape that {kind} asks for, and functions that numba knows (helpers need numba.njit)\n"
        f"Numba says: {_informative_line(error)}"
    )


def _name_and_location(function: Callable[..., Any]) -> str:
    name, code = getattr(function, "__name__", "?"), getattr(function, "__code__", None)
    return f"{name!r} ({code.co_filename}, line {code.co_firstlineno})" if code else repr(name)


# pattern of source excerpts in numba's messages; the last line of an excerpt contains only the sign ^
_SOURCE_EXCERPT = re.compile(r"^File \".*?^[ ]*\^$", re.MULTILINE | re.DOTALL)
# lines of numba's messages that begin like this do not state the reason for an error
_UNINFORMATIVE_LINE = re.compile(
    r"Failed in |- Resolution failure|During: |File \"|>>> |There (is|are) \d+ candidate|- Of which|Overload (in|of) |"
    r"With argument|Rejected as|raised from|None$|Tried |This (is usually|error)|<source elided>|Enable logging"
)


def _remove_colours(error: Exception) -> str:
    return re.sub(r"\x1b\[[0-9;]*m", "", str(error))


def _informative_line(error: Exception) -> str:
    """Return the type of an error, and that line of numba's message which states the reason."""
    message = _remove_colours(error)
    message = re.sub(r":\s*>>> ", ": ", _SOURCE_EXCERPT.sub("", message))  # remove >>> before a rejected signature
    lines = [line.strip() for line in message.splitlines() if line and not line.startswith("    ")]
    useful = [line for line in lines if line and not _UNINFORMATIVE_LINE.match(line) and not line.startswith("def ")]
    return f"{type(error).__name__}: {useful[-1] if useful else message.strip()[:200]}"
