"""Turn plain functions and matrices given by entries into callbacks, and replace callbacks that are not given."""

import ctypes
import inspect
import math
import secrets
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from types import FunctionType
from typing import Any, ClassVar, NamedTuple
from weakref import WeakValueDictionary

import numpy as np
from numba import njit, objmode
from numpy.typing import NDArray

from twoloop.checks.arguments import Array, check_call, check_real, shaped, shown
from twoloop.kernels.compile.caches import digests_of, give_unique_name
from twoloop.kernels.compile.callbacks import KINDS, compile_callback, zero_callback
from twoloop.kernels.compile.dependencies import digest_of, register_digest
from twoloop.kernels.compile.linking import Dispatcher

Integers = NDArray[np.int64]
Entries = tuple[Integers, Integers]  # row and column indices

LARGE = 64  # with at least this number of coordinates, entries are faster than dense matrices (chains of bars: 36)
# for the kind of callback that returns a dense matrix, the kind that returns the values of its entries
VALUES_OF = {"mass": "mass_values", "jacobian": "jacobian_values"}


def check_entries(name: str, given: Any, shape: tuple[int, int], symmetric: bool) -> Entries:
    """Return rows and columns of the entries of a matrix as int64 vectors; raise TypeError or ValueError if wrong."""
    try:
        rows, columns = map(np.asarray, given)
    except (TypeError, ValueError):
        raise TypeError(f"{name} must be two vectors of int, rows and columns; given {shown(given)}") from None
    for vector in (rows, columns):
        if vector.ndim != 1 or (vector.size and not np.issubdtype(vector.dtype, np.integer)):
            raise TypeError(f"{name} must be two vectors of int, rows and columns; given {shown(given)}")
    if len(rows) != len(columns):
        raise ValueError(f"{name} must be as many rows as columns; given {len(rows)} and {len(columns)}")
    entries = rows.astype(np.int64), columns.astype(np.int64)
    for label, vector, size in zip(("rows", "columns"), entries, shape, strict=True):
        outside = np.flatnonzero((vector < 0) | (vector >= size))
        if outside.size:
            raise ValueError(
                f"{label} of {name} must be from 0 to {size - 1}, as the matrix has shape {shape}; given "
                f"{vector[outside[0]]} at place {outside[0]}"
            )
    places = set(zip(rows.tolist(), columns.tolist(), strict=True)) if symmetric else set()
    unmatched = sorted((i, j) for i, j in places if (j, i) not in places)
    if unmatched:
        i, j = unmatched[0]
        raise ValueError(f"{name} must name both triangles of M: ({i}, {j}) is there, and ({j}, {i}) is not")
    return entries


def dense_callback(kind: str, values: Dispatcher, entries: Entries) -> Dispatcher:
    """Compile the dense callback "mass" or "jacobian" from a callback that returns the values at `entries`."""
    rows, columns = entries
    n = len(rows)

    def dense(t, q, p, out):  # type: ignore[no-untyped-def]
        entry_values = np.zeros(n)
        values(t, q, p, entry_values)
        for k in range(n):
            out[rows[k], columns[k]] += entry_values[k]

    return compile_callback(kind, dense, digests_of(dense))


def dense_matrix(
    function: Callable[..., Any], entries: Entries, shape: tuple[int, int], t: float, q: Any, *p: Any
) -> Any:
    """Return the dense matrix whose entries a plain function returns; they are symbols if it returns symbols."""
    values = np.asarray(function(t, q, *p))
    if values.shape != entries[0].shape:
        return values  # `store` refuses this shape
    matrix = np.zeros(shape, dtype=values.dtype if values.dtype == object else np.float64)
    for i, j, value in zip(*(indices.tolist() for indices in entries), values, strict=True):
        matrix[i, j] = matrix[i, j] + value
    return matrix


# first displacement h of a coordinate q, relative to max(1, |q|); a power of two, so that q + h is exact
FIRST_DISPLACEMENT = 2.0**-6
SHRINKAGE = 0.125  # factor on a displacement over which the constraints are too nonlinear
N_DISPLACEMENTS = 9  # largest number of displacements that are tried
AGREEMENT = 1e-11  # h is accepted if formulas of order 6 and 8 differ by at most this, relative to the entry
ROUNDING = 1e-14  # rounding error of a constraint, relative to its largest value at the displaced points

# weights of (f(k h) - f(-k h)) / h, k = 1 ... 4, in formulas of order 8 and 6 for the derivative of f at 0
ORDER_8 = (4.0 / 5.0, -1.0 / 5.0, 4.0 / 105.0, -1.0 / 280.0)
ORDER_6 = (3.0 / 4.0, -3.0 / 20.0, 1.0 / 60.0, 0.0)


@cache
def differenced_jacobian(constraint: Dispatcher) -> Dispatcher:
    """Compile a callback "jacobian" that differences a callback "constraint".

    Central differences of order 8 at four displacements to either side, multiples of 1/64 of max(1, |q_j|) for each
    coordinate: 8 n_q calls of the constraint. If a formula of order 6 at the same points differs by more than 1e-11 of
    an entry, the constraint bends on a shorter scale (a coordinate of 3e5 m on a bar of 1 m, a mechanism of
    micrometres). Displacements are then repeatedly divided by 8, at another 8 calls each, and each entry is taken where
    the two formulas agree best. For constraints that are smooth on the scale of a metre and a radian, entries are good
    to about 1e-13 of the largest term in the constraint.
    """

    def jacobian(t, q, p, Cq):  # type: ignore[no-untyped-def]
        n_c, n_q = Cq.shape
        displaced = q.copy()
        ahead, behind = np.zeros(n_c), np.zeros(n_c)
        high, low, size, best = np.zeros(n_c), np.zeros(n_c), np.zeros(n_c), np.zeros(n_c)
        for j in range(n_q):
            h = FIRST_DISPLACEMENT * 2.0 ** np.floor(np.log2(max(1.0, abs(q[j]))))
            best[:] = np.inf
            for _ in range(N_DISPLACEMENTS):
                high[:] = 0.0
                low[:] = 0.0
                size[:] = 0.0
                for k in range(4):
                    ahead[:] = 0.0
                    displaced[j] = q[j] + (k + 1) * h
                    constraint(t, displaced, p, ahead)
                    behind[:] = 0.0
                    displaced[j] = q[j] - (k + 1) * h
                    constraint(t, displaced, p, behind)
                    for i in range(n_c):
                        high[i] += ORDER_8[k] * (ahead[i] - behind[i])
                        low[i] += ORDER_6[k] * (ahead[i] - behind[i])
                        size[i] = max(size[i], abs(ahead[i]), abs(behind[i]))
                displaced[j] = q[j]
                accepted = True
                for i in range(n_c):
                    entry, doubt = high[i] / h, abs(high[i] - low[i]) / h + ROUNDING * size[i] / h
                    if doubt < best[i]:
                        best[i] = doubt
                        Cq[i, j] = entry
                    elif not np.isfinite(doubt) and best[i] == np.inf:
                        Cq[i, j] = entry  # no finite entry so far
                    accepted &= abs(high[i] - low[i]) <= AGREEMENT * abs(high[i]) + ROUNDING * size[i]
                if accepted:
                    break
                h *= SHRINKAGE

    return compile_callback("jacobian", jacobian, digests_of(jacobian))


Address = tuple[int, tuple[int, ...]]  # address and shape of a contiguous float64 array, whose boxing would take 0.5 us

KIND_NAMES = tuple(KINDS)
_ARRAYS: dict[Address, Array] = {}  # cached arrays by address and shape: the arrays of a run do not move
MAX_ARRAYS = 1000  # largest number of cached arrays
REAL_DTYPES = "fiu"  # kinds of real dtypes; durations, which NumPy counts as integers, are excluded
MAX_SAMPLED = 10_000  # largest number of entries of a value that is stored to be compared at the end of a run
HANDLE_BITS = 52  # random bits of a handle: a float64 represents it exactly, and two processes get different handles


class PythonFunctions:
    """Plain Python functions of a system, registered so that the compiled `through_python` can call them.

    A number, the handle, is stored before the parameters and identifies this object. It is valid in this process and
    its forks; unpickling registers the functions again. Functions of the kinds in `taking` get the parameters.
    """

    registry: ClassVar[WeakValueDictionary[float, "PythonFunctions"]] = WeakValueDictionary()

    def __init__(self, name: str, functions: dict[str, Callable[..., Any]], taking: frozenset[str]):
        self.name, self.functions, self.taking = name, functions, taking
        self.handle = secrets.randbits(HANDLE_BITS)
        self.registry[self.handle] = self
        self.restart()

    def restart(self) -> None:
        """Discard the samples, at the beginning of a run."""
        # (arguments, value) of a few calls of each kind, each 1.25 times as late as the last: repeated after a run
        self.samples: dict[str, list[tuple[tuple[Any, ...], Any]]] = {kind: [] for kind in self.functions}
        self.n_calls, self._next = dict.fromkeys(self.functions, 0), dict.fromkeys(self.functions, 1)

    def call(self, kind: str, arguments: tuple[Any, ...], p: Address, out: Array) -> None:
        """Call one function with copies of the arrays, check the returned value and write it to `out`."""
        t = arguments[0]
        if kind in self.taking:
            arguments = (*arguments, array_at(*p)[1:].copy())
        try:
            value = self.functions[kind](*arguments)
        except Exception as error:
            error.add_note(f"raised by {kind} of system {self.name!r} at t = {t!r}")
            raise
        store(kind, self.name, t, value, out)
        self.n_calls[kind] += 1
        if self.n_calls[kind] == self._next[kind] and out.size <= MAX_SAMPLED:
            self._next[kind] += 1 + self._next[kind] // 4
            self.samples[kind].append((tuple(np.copy(each) for each in arguments), out.copy()))


def store(kind: str, name: str, t: float, value: Any, out: Array) -> None:
    """Write the value that a Python function returned to `out`; raise if its shape or type is wrong."""
    try:
        array = np.asarray(value)
        real = array.dtype.kind in REAL_DTYPES
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
    """Return the float64 array at an address; valid during the call of the callback that passed the address."""
    array = _ARRAYS.get((address, shape))
    if array is None:
        if len(_ARRAYS) >= MAX_ARRAYS:
            _ARRAYS.clear()
        numbers = (ctypes.c_double * math.prod(shape)).from_address(address)
        array = _ARRAYS[address, shape] = np.ctypeslib.as_array(numbers).reshape(shape)
    return array


def _call(number: int, handle: float, t: float, state: tuple[Address, ...], p: Address, out: Address) -> None:
    functions = PythonFunctions.registry.get(handle)
    if functions is None:
        raise RuntimeError(
            "these callbacks lead to Python functions of a system that is not in this process, or no longer: their "
            "`parameters` are not numbers to keep. Pass the system itself on, by pickle if need be"
        )
    functions.call(KIND_NAMES[number], (t, *[array_at(*address).copy() for address in state]), p, array_at(*out))


@cache
def through_python(kind: str) -> Dispatcher:
    """Compile the callback that calls the Python function of this kind, which the handle in `p` identifies."""
    place = KIND_NAMES.index(kind)

    def at_position(t, q, p, out):  # type: ignore[no-untyped-def]
        number, handle = place, p[0] if p.size > 0 else np.nan
        at_q, at_p, at_out = (q.ctypes.data, q.shape), (p.ctypes.data, p.shape), (out.ctypes.data, out.shape)
        with objmode():
            _call(number, handle, t, (at_q,), at_p, at_out)

    def at_state(t, q, x, p, out):  # type: ignore[no-untyped-def]
        number, handle = place, p[0] if p.size > 0 else np.nan
        at_q, at_x = (q.ctypes.data, q.shape), (x.ctypes.data, x.shape)
        at_p, at_out = (p.ctypes.data, p.shape), (out.ctypes.data, out.shape)
        with objmode():
            _call(number, handle, t, (at_q, at_x), at_p, at_out)

    callback_function = at_position if len(KINDS[kind].state) == 1 else at_state
    callback = compile_callback(kind, callback_function, ("through Python", str(place)))
    register_digest(callback, digest_of(f"through Python, {place}", __file__))
    return callback


@njit
def _fill(value, out):  # type: ignore[no-untyped-def]
    """Copy `value` into `out` of the same shape; numba takes two seconds longer to compile `out[:] = value`."""
    for k in range(out.size):
        out.flat[k] = value.flat[k]


def compile_returning(kind: str, function: Callable[..., Any], takes_p: bool) -> Dispatcher:
    """Compile a function that returns its array, and wrap it to the in-place signature of its kind.

    The machine code is stored beside the source file of the function, if there is one.
    """
    if isinstance(function, ConstantMatrix):
        matrix = function.matrix  # numba freezes what a function encloses, but not the attributes of an object

        def function(t, q):  # type: ignore[no-untyped-def]
            return matrix

    if not isinstance(function, Dispatcher | FunctionType):
        raise TypeError(
            f"{kind}: compile=True takes functions made by def or lambda, with numbers that they enclose; given "
            f"{function!r} of type {type(function).__name__}. Write such a function, or leave compile=True out"
        )
    user = function if isinstance(function, Dispatcher) else njit(give_unique_name(function, digests_of(function)))
    message = f"{kind} returned an array of the wrong shape"

    def at_position(t, q, p, out):  # type: ignore[no-untyped-def]
        value = user(t, q)
        if value.shape != out.shape:
            raise ValueError(message)
        _fill(value, out)

    def at_state(t, q, x, p, out):  # type: ignore[no-untyped-def]
        value = user(t, q, x)
        if value.shape != out.shape:
            raise ValueError(message)
        _fill(value, out)

    def at_position_with_p(t, q, p, out):  # type: ignore[no-untyped-def]
        value = user(t, q, p)
        if value.shape != out.shape:
            raise ValueError(message)
        _fill(value, out)

    def at_state_with_p(t, q, x, p, out):  # type: ignore[no-untyped-def]
        value = user(t, q, x, p)
        if value.shape != out.shape:
            raise ValueError(message)
        _fill(value, out)

    wrappers: Any = ((at_position, at_position_with_p), (at_state, at_state_with_p))
    in_place = wrappers[len(KINDS[kind].state) > 1][takes_p]
    watched = digests_of(in_place)
    code = user.py_func.__code__
    # numba stores machine code beside the file that the code object names: name the file of the user's function
    in_place.__code__ = in_place.__code__.replace(co_filename=code.co_filename, co_firstlineno=code.co_firstlineno)
    in_place.__qualname__ = f"{user.py_func.__qualname__}.{kind}"
    return compile_callback(kind, in_place, watched, named_function=user.py_func)


@dataclass(frozen=True, eq=False)
class ConstantMatrix:
    """Constant mass matrix, which can be called as mass(t, q)."""

    matrix: Array

    def __call__(self, t: float, q: Array) -> Array:
        """Return the matrix."""
        return self.matrix


def check_arguments(kind: str, function: Callable[..., Any], parameters: bool) -> bool:
    """Return whether a function that returns its array takes `p` after the arguments of its kind.

    If the system has `parameters`, it does, unless the last argument is missing, or has a default and another name.
    Raise TypeError if the function names its arguments in another order, or takes another number of them.
    """
    expected = ("t", *KINDS[kind].state)
    try:
        arguments = inspect.signature(function).parameters
    except (TypeError, ValueError):  # built-in functions have no signature
        return parameters
    names = tuple(arguments)
    for order in (expected, (*expected, "p")):
        if sorted(names) == sorted(order) and names != order:
            raise TypeError(
                f"{kind} is called as {kind}({', '.join(order)}); the function given takes ({', '.join(names)})"
            )
    takes_p = parameters and _takes_p(list(arguments.values()), len(expected))
    takes_p_alone = not parameters and names == (*expected, "p")
    remedy = ". Give the numbers that it takes as p: parameters=[...]" if takes_p_alone else ""
    check_call(kind, kind, function, (*expected, "p") if takes_p else expected, remedy)
    return takes_p


def _takes_p(arguments: list[inspect.Parameter], n: int) -> bool:
    """Return whether a function takes `p` after n other arguments."""
    if any(argument.kind == argument.VAR_POSITIONAL for argument in arguments):
        return True
    if len(arguments) <= n:
        return False
    return arguments[n].kind != inspect.Parameter.KEYWORD_ONLY and (
        arguments[n].default is inspect.Parameter.empty or arguments[n].name == "p"
    )


def checked_parameters(parameters: Any) -> Array:
    """Return the parameters as a new vector; raise if they are not finite numbers."""
    p = check_real("parameters", parameters)
    if p.ndim != 1 or not np.isfinite(p).all():
        raise ValueError(f"parameters must be a vector of finite numbers; given {shown(parameters)}")
    return p


def given_callbacks(callbacks: dict[str, Any], n_c: int, n_a: int) -> dict[str, Any]:
    """Return the callbacks that are given, in the order of KINDS; raise if one is unknown, missing or superfluous."""
    unknown = [kind for kind in callbacks if kind not in KINDS]
    if unknown:
        raise TypeError(f"a system has no argument {unknown[0]!r}; its callbacks are {', '.join(KINDS)}")
    n_rows = {"n_c": n_c, "n_a": n_a}
    required = [kind for kind, entry in KINDS.items() if not entry.optional or n_rows.get(entry.needed_by, 0) > 0]
    missing = [kind for kind in required if kind not in callbacks or (KINDS[kind].optional and callbacks[kind] is None)]
    if callbacks.get("mass_values") is not None:
        missing = [kind for kind in missing if kind != "mass"]
    if missing:
        rows = f" with n_a = {n_a}" if "nonholonomic" in missing else ""
        raise TypeError(f"a system{rows} needs {', '.join(missing)}: not given")
    given = {kind: callbacks[kind] for kind in KINDS if not _is_left_out(kind, callbacks)}
    for kind, entry in KINDS.items():
        if kind in given and n_rows.get(entry.shape[0], 1) == 0:
            rows_of = "nonholonomic rows" if entry.shape[0] == "n_a" else "constraints"
            raise ValueError(f"{kind} goes with {rows_of}, {entry.shape[0]} > 0; given for {entry.shape[0]} = 0")
    available = {*given, *(("jacobian",) if "jacobian_values" in given else ())}
    missing = [kind for kind in ("constraint", "jacobian", "gamma") if "kinematics" in given and kind not in available]
    if missing:
        raise ValueError(f"kinematics goes with constraint, jacobian and gamma; {' and '.join(missing)} not given")
    if "force_by_q" not in given and ("force_by_v" in given or "reaction_by_q" in given):
        raise ValueError("force_by_v and reaction_by_q go with force_by_q, which is not given")
    return given


def _is_left_out(kind: str, callbacks: dict[str, Any]) -> bool:
    """Return whether a callback of this kind is missing, None, or the zero callback that replaces a missing one."""
    entry, given = KINDS[kind], callbacks.get(kind)
    if given is None:
        return kind not in callbacks or entry.optional or kind == "mass"  # mass_values may replace it
    return entry.optional and entry.absent != "differences" and given is zero_callback(kind)


def checked_entries(callbacks: dict[str, Any], n_q: int, n_c: int, mass: Any, jacobian: Any) -> dict[str, Entries]:
    """Return the rows and columns of the entries of M and C_q whose values are given; raise if they do not fit."""
    checked: dict[str, Entries] = {}
    for kind, entries, shape in (("mass", mass, (n_q, n_q)), ("jacobian", jacobian, (n_c, n_q))):
        values, name = VALUES_OF[kind], f"{kind}_entries"
        if (callbacks.get(values) is None) != (entries is None):
            given, missing = (name, values) if entries is not None else (values, name)
            raise ValueError(f"{values} and {name} go together: {given} is given, and {missing} is not")
        if entries is not None:
            checked[kind] = check_entries(name, entries, shape, symmetric=kind == "mass")
    return checked


class PlainFunctions(NamedTuple):
    """Plain functions by kind, the matrix entries that they return, and `taking`, the kinds that take parameters p."""

    functions: dict[str, Any]
    entries: dict[str, Entries]
    constant_mass: bool
    taking: frozenset[str]
    p: Array


def plain_functions(
    functions: dict[str, Any], sizes: tuple[int, int, int], entries: tuple[Any, Any], parameters: Any, name: str
) -> PlainFunctions:
    """Return checked plain functions of a system; `sizes`: n_q, n_c, n_a; `entries`: of M and of C_q, or None."""
    n_q, n_c, n_a = sizes
    if functions.get("kinematics") is not None:
        raise TypeError(
            "kinematics fills four arrays in place: compile it by @twoloop.callback('kinematics') and give it "
            "with compiled callbacks to ConstrainedSystem(...)"
        )
    functions = given_callbacks(functions, n_c, n_a)
    checked = checked_entries(functions, n_q, n_c, *entries)
    values_shape = checked["mass"][0].shape if "mass" in checked else ()
    shapes: dict[str, Any] = {"mass": (n_q, n_q), "mass_values": values_shape}
    masses = [kind for kind in shapes if kind in functions]
    constant_mass = not any(callable(functions[kind]) for kind in masses)
    for kind in masses if constant_mass else ():
        matrix = check_real(kind, functions[kind])
        if matrix.shape != shapes[kind]:
            raise ValueError(f"{kind} must have shape {shapes[kind]}; given {shaped(matrix)}")
        functions[kind] = ConstantMatrix(matrix)
    for kind, function in functions.items():
        if not callable(function):
            raise TypeError(f"{kind} must be a function; given {function!r} of type {type(function).__name__}")
    with_parameters = parameters is not None
    taking = frozenset(kind for kind, function in functions.items() if check_arguments(kind, function, with_parameters))
    p = checked_parameters(() if parameters is None else parameters)
    if with_parameters and not taking:
        raise ValueError(
            f"parameters are given, but none of the functions of {name!r} takes them: let those that need them "
            "have p as their last argument, as in mass(t, q, p), or leave parameters out"
        )
    return PlainFunctions(functions, checked, constant_mass, taking, p)


def substitute(kind: str, given: dict[str, Dispatcher]) -> Dispatcher:
    """Return the callback of a kind that is not given: differences of the constraints, or zero."""
    if KINDS[kind].absent != "differences" or "constraint" not in given:
        return zero_callback(kind)
    return differenced_jacobian(given["constraint"])


def callbacks_in(names: Mapping[str, Any]) -> dict[str, Any]:
    """Return the callbacks among a module's `names`, by kind, as arguments of a ConstrainedSystem."""
    return {kind: names[kind] for kind in KINDS if kind in names}
