"""Plain functions that return their array, made into callbacks: called as they are, or compiled."""

import ctypes
import inspect
import math
import secrets
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from types import FunctionType
from typing import Any, ClassVar
from weakref import WeakValueDictionary

import numpy as np
from numba import njit, objmode

from twoloop.checks.arguments import Array, check_call
from twoloop.kernels.compile.caches import named_apart, watch
from twoloop.kernels.compile.callbacks import KINDS, compile_callback
from twoloop.kernels.compile.dependencies import digest_of, stands_for
from twoloop.kernels.compile.private import Dispatcher

Address = tuple[int, tuple[int, ...]]  # of a contiguous float64 array, and its shape: numba boxes an array in 0.5 us

KIND_NAMES = tuple(KINDS)
_ARRAYS: dict[Address, Array] = {}  # by where they are: arrays of a run stay where they are
MOST_ARRAYS = 1000
REAL = "fiu"  # kinds of arrays; durations are whole numbers to NumPy, and no forces
HANDLE_BITS = 52  # so that a handle is a float64 exactly; a foreign one, of another process, matches none of ours


class PythonFunctions:
    """Plain Python functions of one system, called through the compiled `through_python`.

    These find them by the handle, which stands before the parameters. It holds in this process and in forks of it;
    unpickled elsewhere, the functions are registered again. Those in `taking` get the parameters.
    """

    registry: ClassVar[WeakValueDictionary[float, "PythonFunctions"]] = WeakValueDictionary()

    def __init__(self, name: str, functions: dict[str, Callable[..., Any]], taking: frozenset[str]):
        self.name, self.functions, self.taking = name, functions, taking
        self.handle = secrets.randbits(HANDLE_BITS)
        self.registry[self.handle] = self

    def call(self, kind: str, arguments: tuple[Any, ...], p: Address, out: Array) -> None:
        """Call one function with copies of the arrays, check what comes back and write it to `out`."""
        t = arguments[0]
        if kind in self.taking:
            arguments = (*arguments, array_at(*p)[1:].copy())
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
        real = array.dtype.kind in REAL
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


def array_at(address: int, shape: tuple[int, ...]) -> Array:
    """The float64 array of a shape at an address, which holds as long as the call of the callback that names it."""
    found = _ARRAYS.get((address, shape))
    if found is None:
        if len(_ARRAYS) >= MOST_ARRAYS:
            _ARRAYS.clear()
        numbers = (ctypes.c_double * math.prod(shape)).from_address(address)
        found = _ARRAYS[address, shape] = np.ctypeslib.as_array(numbers).reshape(shape)
    return found


def _call(number: int, handle: float, t: float, state: tuple[Address, ...], p: Address, out: Address) -> None:
    functions = PythonFunctions.registry.get(handle)
    if functions is None:
        raise RuntimeError(
            "these callbacks lead to Python functions of a system that is not in this process, or no longer: their "
            "`parameters` are not numbers to keep. Pass the system itself on, by pickle if need be"
        )
    functions.call(KIND_NAMES[number], (t, *[array_at(*each).copy() for each in state]), p, array_at(*out))


@cache
def through_python(kind: str) -> Dispatcher:
    """The callback that calls a Python function of this kind, whichever `p` leads to."""
    place = KIND_NAMES.index(kind)

    def with_two(t, q, p, out):  # type: ignore[no-untyped-def]
        number, handle = place, p[0] if p.size > 0 else np.nan
        at_q, at_p, at_out = (q.ctypes.data, q.shape), (p.ctypes.data, p.shape), (out.ctypes.data, out.shape)
        with objmode():
            _call(number, handle, t, (at_q,), at_p, at_out)

    def with_three(t, q, x, p, out):  # type: ignore[no-untyped-def]
        number, handle = place, p[0] if p.size > 0 else np.nan
        at_q, at_x = (q.ctypes.data, q.shape), (x.ctypes.data, x.shape)
        at_p, at_out = (p.ctypes.data, p.shape), (out.ctypes.data, out.shape)
        with objmode():
            _call(number, handle, t, (at_q, at_x), at_p, at_out)

    through = with_two if len(KINDS[kind].state) == 1 else with_three
    made = compile_callback(kind, through, ("through Python", str(place)))
    stands_for(made, digest_of(f"through Python, {place}", __file__))
    return made


@njit
def _fill(value, out):  # type: ignore[no-untyped-def]
    """Put one array in the place of another of its shape; numba compiles `out[:] = value` two seconds longer."""
    for k in range(out.size):
        out.flat[k] = value.flat[k]


def compile_returning(kind: str, function: Callable[..., Any], takes_p: bool) -> Dispatcher:
    """Compile a function that returns its array, and wrap it to the in-place signature of its kind.

    The machine code is kept beside the source of the function, if it has one.
    """
    if isinstance(function, ConstantMatrix):
        matrix = function.matrix  # numba knows what a function encloses, but not the attributes of an object

        def function(t, q):  # type: ignore[no-untyped-def]
            return matrix

    if not isinstance(function, Dispatcher | FunctionType):
        raise TypeError(
            f"{kind}: compile=True takes functions made by def or lambda, with numbers that they enclose; given "
            f"{function!r} of type {type(function).__name__}. Write such a function, or leave compile=True out"
        )
    user = function if isinstance(function, Dispatcher) else njit(named_apart(function, watch(function)))
    message = f"{kind} returned an array of the wrong shape"

    def with_two(t, q, p, out):  # type: ignore[no-untyped-def]
        value = user(t, q)
        if value.shape != out.shape:
            raise ValueError(message)
        _fill(value, out)

    def with_three(t, q, x, p, out):  # type: ignore[no-untyped-def]
        value = user(t, q, x)
        if value.shape != out.shape:
            raise ValueError(message)
        _fill(value, out)

    def with_two_and_p(t, q, p, out):  # type: ignore[no-untyped-def]
        value = user(t, q, p)
        if value.shape != out.shape:
            raise ValueError(message)
        _fill(value, out)

    def with_three_and_p(t, q, x, p, out):  # type: ignore[no-untyped-def]
        value = user(t, q, x, p)
        if value.shape != out.shape:
            raise ValueError(message)
        _fill(value, out)

    wrappers: Any = ((with_two, with_two_and_p), (with_three, with_three_and_p))
    in_place = wrappers[len(KINDS[kind].state) > 1][takes_p]
    watched = watch(in_place)
    code = user.py_func.__code__
    in_place.__code__ = in_place.__code__.replace(co_filename=code.co_filename, co_firstlineno=code.co_firstlineno)
    in_place.__qualname__ = f"{user.py_func.__qualname__}.{kind}"
    return compile_callback(kind, in_place, watched, named=user.py_func)


@dataclass(frozen=True, eq=False)
class ConstantMatrix:
    """A mass(t, q) that does not depend on either."""

    matrix: Array

    def __call__(self, t: float, q: Array) -> Array:
        """The matrix."""
        return self.matrix


def check_arguments(kind: str, function: Callable[..., Any], parameters: bool) -> bool:
    """Whether a function that returns its array takes `p` after what all of its kind take.

    Where there are `parameters`, it does unless that place is missing, or has a default and another name.

    Raises
    ------
    TypeError
        If it names its arguments t, q, v, but in another order, or takes another number of them.
    """
    wanted = ("t", *KINDS[kind].state)
    try:
        given = inspect.signature(function).parameters
    except (TypeError, ValueError):  # built-in functions have none to look at
        return parameters
    names = tuple(given)
    for known in (wanted, (*wanted, "p")):
        if sorted(names) == sorted(known) and names != known:
            raise TypeError(
                f"{kind} is called as {kind}({', '.join(known)}); the function given takes ({', '.join(names)})"
            )
    takes_p = parameters and _takes_p(list(given.values()), len(wanted))
    takes_p_alone = not parameters and names == (*wanted, "p")
    remedy = ". Give the numbers that it takes as p: parameters=[...]" if takes_p_alone else ""
    check_call(kind, kind, function, (*wanted, "p") if takes_p else wanted, remedy)
    return takes_p


def _takes_p(given: list[inspect.Parameter], n: int) -> bool:
    """Whether a function takes `p` after n other arguments."""
    if any(each.kind == each.VAR_POSITIONAL for each in given):
        return True
    if len(given) <= n:
        return False
    return given[n].kind != inspect.Parameter.KEYWORD_ONLY and (
        given[n].default is inspect.Parameter.empty or given[n].name == "p"
    )
