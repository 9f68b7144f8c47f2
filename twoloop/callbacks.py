"""The callbacks of a mechanism: the decorator for compiled ones, and the door for plain Python functions."""

import hashlib
import inspect
import itertools
from collections.abc import Callable
from typing import Any, ClassVar
from weakref import WeakValueDictionary

import numpy as np
from numba import njit, objmode
from numba.core.dispatcher import Dispatcher
from numba.core.errors import NumbaError
from numpy.typing import NDArray

from twoloop.kernels.common import CONSTRAINT_CALLBACK, FORCE_CALLBACK, MATRIX_CALLBACK, TANGENT_CALLBACK

Array = NDArray[np.float64]

# kind: (arguments, signature)
KINDS: dict[str, tuple[tuple[str, ...], Any]] = {
    "mass": (("t", "q", "p", "M"), MATRIX_CALLBACK),
    "force": (("t", "q", "v", "p", "Q"), FORCE_CALLBACK),
    "constraint": (("t", "q", "p", "C"), CONSTRAINT_CALLBACK),
    "jacobian": (("t", "q", "p", "Cq"), MATRIX_CALLBACK),
    "constraint_rate": (("t", "q", "p", "Ct"), CONSTRAINT_CALLBACK),
    "gamma": (("t", "q", "v", "p", "Qd"), FORCE_CALLBACK),
    "force_by_q": (("t", "q", "v", "p", "K"), TANGENT_CALLBACK),
    "force_by_v": (("t", "q", "v", "p", "D"), TANGENT_CALLBACK),
    "reaction_by_q": (("t", "q", "lam", "p", "R"), TANGENT_CALLBACK),
}


def callback(kind: str) -> Callable[[Callable[..., None]], Dispatcher]:
    """Compile one callback of a mechanism with the signature that its kind has.

    The function gets the time, the coordinates `q` (n_q,), where the kind has them the velocities `v` (n_q,) or the
    multipliers `lam` (n_c,), the parameters `p`, and the array to fill, which arrives full of zeros (a tangent's of a
    system with a bandwidth only within the band: add to it)::

        @callback("jacobian")
        def jacobian(t, q, p, Cq):
            Cq[0, 0] = q[0]
            Cq[0, 1] = q[1]

    Parameters
    ----------
    kind : str
        "mass" (t, q, p, M), "force" (t, q, v, p, Q), "constraint" (t, q, p, C), "jacobian" (t, q, p, Cq),
        "constraint_rate" (t, q, p, Ct), "gamma" (t, q, v, p, Qd), "force_by_q" (t, q, v, p, K), "force_by_v"
        (t, q, v, p, D) or "reaction_by_q" (t, q, lam, p, R).

    Raises
    ------
    ValueError
        If `kind` is unknown.
    TypeError
        If the function has other arguments, or numba cannot compile it.
    """
    if callable(kind):
        raise TypeError('the decorator needs the kind of callback: write @callback("force"), not @callback')
    if kind not in KINDS:
        raise ValueError(f"kind must be one of {', '.join(KINDS)}; given {kind!r}")
    arguments, signature = KINDS[kind]

    def decorate(function: Callable[..., None]) -> Dispatcher:
        given = tuple(inspect.signature(function).parameters)
        if given != arguments:
            raise TypeError(
                f"{function.__name__} is declared as the callback {kind!r}, whose arguments are "
                f"({', '.join(arguments)}); it has ({', '.join(given)})"
            )
        try:
            try:
                dispatcher = njit(cache=True, error_model="numpy")(function)
                keeper: Any = dispatcher._cache._cache_file  # type: ignore[attr-defined]
                keeper._source_stamp = (keeper._source_stamp, _globals_digest(function))
            except RuntimeError:  # numba has nowhere to keep what is typed at a prompt
                dispatcher = njit(error_model="numpy")(function)
            dispatcher.compile(signature)
        except NumbaError as error:
            raise TypeError(_why_not(kind, function, error)) from error
        dispatcher.disable_compile()
        return dispatcher

    return decorate


def _globals_digest(function: Callable[..., Any]) -> str:
    """What a function takes from its module, for the stamp of its machine code: numba freezes it and forgets it."""
    digest = hashlib.sha256()
    for name in sorted(function.__code__.co_names):
        value = function.__globals__.get(name)
        if isinstance(value, Dispatcher):
            value = (value.py_func.__code__.co_code, value.py_func.__code__.co_consts)
        if isinstance(value, np.ndarray):
            digest.update(name.encode() + value.tobytes())
        elif isinstance(value, (bool, int, float, str, tuple)):
            digest.update(f"{name}={value!r}".encode())
    return digest.hexdigest()


def _why_not(kind: str, function: Callable[..., Any], error: Exception) -> str:
    name = getattr(function, "__name__", "?")
    return (
        f"{kind}: numba cannot compile the function {name!r}. It must use numbers, numpy arrays and functions that "
        f"numba knows (helpers need numba.njit), with arrays of one type (1.0 beside 0.5, not 1) and of the shape that "
        f"{kind} asks for. Numba says:\n{type(error).__name__}: {error}"
    )


class PythonFunctions:
    """Plain Python functions of one system, called through the compiled wrappers below."""

    _count = itertools.count(1)
    registry: ClassVar[WeakValueDictionary[int, "PythonFunctions"]] = WeakValueDictionary()

    def __init__(self, name: str, functions: dict[str, Callable[..., Any]]):
        self.name = name
        self.functions = functions
        self.handle = next(self._count)
        self.registry[self.handle] = self

    def call(self, kind: str, arguments: tuple[Any, ...], out: Array) -> None:
        """Call one function with copies of the arrays, check what comes back and write it to `out`."""
        t = arguments[0]
        try:
            value = self.functions[kind](*arguments)
        except Exception as error:
            error.add_note(f"raised by {kind} of system {self.name!r} at t = {t!r}")
            raise
        store(kind, self.name, t, value, out)


def store(kind: str, name: str, t: float, value: Any, out: Array) -> None:
    """Write what a Python function returned to `out`, or say what is wrong with it."""
    try:
        array = np.asarray(value)
        real = np.issubdtype(array.dtype, np.number) and not np.iscomplexobj(array)
    except ValueError:
        real = False
    if not real:
        raise TypeError(
            f"{kind} of system {name!r} must return a real array of shape {out.shape}; "
            f"at t = {t!r} it returned {value!r}"
        )
    if array.shape != out.shape:
        raise ValueError(
            f"{kind} of system {name!r} must return an array of shape {out.shape}; at t = {t!r} it returned shape "
            f"{array.shape}"
        )
    out[...] = array


def _call_with_two(kind: str, t: float, q: Array, p: Array, out: Array) -> None:
    PythonFunctions.registry[int(p[0])].call(kind, (t, q.copy()), out)


def _call_with_three(kind: str, t: float, q: Array, x: Array, p: Array, out: Array) -> None:
    PythonFunctions.registry[int(p[0])].call(kind, (t, q.copy(), x.copy()), out)


@callback("mass")
def python_mass(t, q, p, M):
    with objmode():
        _call_with_two("mass", t, q, p, M)


@callback("force")
def python_force(t, q, v, p, Q):
    with objmode():
        _call_with_three("force", t, q, v, p, Q)


@callback("constraint")
def python_constraint(t, q, p, C):
    with objmode():
        _call_with_two("constraint", t, q, p, C)


@callback("jacobian")
def python_jacobian(t, q, p, Cq):
    with objmode():
        _call_with_two("jacobian", t, q, p, Cq)


@callback("constraint_rate")
def python_constraint_rate(t, q, p, Ct):
    with objmode():
        _call_with_two("constraint_rate", t, q, p, Ct)


@callback("gamma")
def python_gamma(t, q, v, p, Qd):
    with objmode():
        _call_with_three("gamma", t, q, v, p, Qd)


@callback("force_by_q")
def python_force_by_q(t, q, v, p, K):
    with objmode():
        _call_with_three("force_by_q", t, q, v, p, K)


@callback("force_by_v")
def python_force_by_v(t, q, v, p, D):
    with objmode():
        _call_with_three("force_by_v", t, q, v, p, D)


@callback("reaction_by_q")
def python_reaction_by_q(t, q, lam, p, R):
    with objmode():
        _call_with_three("reaction_by_q", t, q, lam, p, R)


@callback("constraint_rate")
def no_rate(t, q, p, Ct):
    """Constraints that do not depend on time."""


@callback("gamma")
def no_gamma(t, q, v, p, Qd):
    """Stands where gamma is differenced; no kernel calls it."""


@callback("force_by_q")
def no_tangent(t, q, v, p, K):
    """Stands where a tangent is not given, and leaves zeros; no kernel calls it."""


def check_arguments(kind: str, function: Callable[..., Any]) -> None:
    """Raise if a function that returns its array names its arguments t, q, v, but in another order."""
    wanted = KINDS[kind][0][:-2]
    try:
        given = tuple(inspect.signature(function).parameters)
    except (TypeError, ValueError):  # built-in functions have none to look at
        return
    if sorted(given) == sorted(wanted) and given != wanted:
        raise TypeError(
            f"{kind} is called as {kind}({', '.join(wanted)}); the function given takes ({', '.join(given)})"
        )


def compile_returning(kind: str, function: Callable[..., Any]) -> Dispatcher:
    """Compile a function that returns its array, and wrap it to the in-place signature of its kind."""
    arguments, signature = KINDS[kind]
    user = function if isinstance(function, Dispatcher) else njit(function)
    message = f"{kind} returned an array of the wrong shape"

    def with_three(t, q, x, p, out):
        value = user(t, q, x)
        if value.shape != out.shape:
            raise ValueError(message)
        out[:] = value

    def with_two(t, q, p, out):
        value = user(t, q)
        if value.shape != out.shape:
            raise ValueError(message)
        out[:] = value

    in_place = with_three if len(arguments) == 5 else with_two
    try:
        return njit(signature, error_model="numpy")(in_place)
    except Exception as error:  # numba lets some of its own assertions through
        raise TypeError(_why_not(kind, function, error)) from error
