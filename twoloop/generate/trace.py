"""Trace callbacks: run them in Python on symbols; functions of `math` and `numpy` are replaced by symbolic ones.

A callback must do with symbols exactly what it does with numbers. So a function that may treat symbols differently
raises an exception if it is called with a symbol; the message names the function. The callback is not traced then, even
if it catches the exception. Differences that tracing cannot detect, such as a changed global variable, are found by
comparing numbers (`traced_values.py`).

`Equations` returns the result of every callback of one system as an array of expressions. Without a callback for C_q or
gamma, the results are exact derivatives. Series, eliminations, references and derived callbacks are made from these.

`TraceCache` stores traces for all systems that share their callbacks: coefficients are expressions in the parameters.

- Parameters that are whole numbers are constants in the traces: they may be counts, indices or switches, and zeros and
  ones save operations. Parameters of equal magnitude are one variable.
- So systems that share a cache have the same constants, and the same groups of parameters with equal magnitude.
- A callback that branches on its parameters, or rounds them, is traced for each system anew.
"""

import copy
import functools
import math
import types
from collections.abc import Callable, Sequence
from contextlib import nullcontext, suppress
from functools import partial
from threading import RLock
from typing import Any

import numpy as np
from numpy.typing import NDArray

from twoloop.checks.callbacks import source_location
from twoloop.generate.graph import FUNCTIONS, Affine, Derivative, Graph, Untraceable, symbol_array
from twoloop.generate.parameter_expressions import (
    OPERATORS,
    Parameter,
    ParameterTape,
    Powers,
    Refusal,
    apply_function,
    as_number,
    elementwise,
)
from twoloop.kernels.compile.caches import BoundedCache, garbage_collection_off
from twoloop.kernels.compile.callbacks import KINDS
from twoloop.kernels.compile.dependencies import FunctionCopier, is_library
from twoloop.kernels.compile.linking import Dispatcher
from twoloop.problem.system import ConstrainedSystem

# functions of NumPy that callbacks may call on symbols: each treats an array of objects like an array of numbers
NUMPY_FUNCTIONS = {
    *("add", "append", "atleast_1d", "atleast_2d", "block", "column_stack", "concatenate", "copy", "cross", "diag"),
    *("diagonal", "divide", "dot", "einsum", "expand_dims", "flip", "hstack", "inner", "kron", "matmul", "mean"),
    *("multiply", "ndim", "negative", "outer", "positive", "prod", "ravel", "repeat", "reshape", "roll", "shape"),
    *("size", "square", "squeeze", "stack", "subtract", "sum", "tile", "trace", "transpose", "true_divide", "vdot"),
    *("vstack", "zeros_like", "ones_like", "empty_like", "full_like"),
}
# functions of NumPy that are replaced while callbacks are traced, so that their arrays can contain expressions
ARRAY_CONSTRUCTORS = ("zeros", "ones", "empty")
ARRAY_CONVERSIONS = ("array", "asarray", "ascontiguousarray")


def trace(function: Callable[..., Any], t: Affine, *arguments: Any) -> Any:
    """Run a callback in Python on symbols and return what it returns.

    A compiled callback writes its results to arrays in `arguments` instead. Raise Untraceable if the callback does not
    run on symbols, or may treat symbols differently from numbers; the message says why.
    """
    graph, value = t.graph, None
    with graph.running_callback():
        try:
            value = _CallbackCopier(lambda copy, _: copy).callback(function)(t, *arguments)
        except (Refusal, Untraceable) as refusal:
            raise Untraceable(f"{graph.refusal_reason or refusal}{source_location(refusal)}") from None
        except Exception as error:  # with symbols, a callback may raise any exception
            if not graph.refusal_reason:
                text = str(error).partition("\n")[0].replace("twoloop.generate.graph.", "").replace("Affine", "symbol")
                text = f"it does not run on symbols in the place of t, q and v: {type(error).__name__}: {text}"
                raise Untraceable(f"{text}{source_location(error)}") from error
    return value


def convert_to_expressions(graph: Graph, values: Any) -> Any:
    """Convert the entries of an array, which a callback filled or returned, to expressions; return the array."""
    for index in np.ndindex(values.shape):
        entry = values[index]
        if type(entry) is not Affine:
            try:
                values[index] = Affine(graph, as_number(entry), {})
            except Exception as error:
                raise Untraceable(f"on symbols its entry {index} is {entry!r}, which is not a number") from error
        elif entry.graph is not graph:
            raise Untraceable("it returns t, q or v of another call, which it has kept")
    return values


class _CallbackCopier(FunctionCopier):
    """Copier of callbacks for a trace: copies call the functions of `_Mathematics` instead of `math` and `numpy`."""

    def is_copied(self, value: Any) -> bool:
        return isinstance(value, Dispatcher | types.FunctionType)

    def callback(self, function: Any) -> Any:
        """Return a copy of a callback for a trace; a callback is a function, or an object with a method `__call__`."""
        method = next((vars(each)["__call__"] for each in type(function).__mro__ if "__call__" in vars(each)), None)
        if isinstance(method, types.FunctionType) and not isinstance(function, Dispatcher):
            return types.MethodType(self.replacement_of(method), function)
        return self.replacement_of(function)

    def replacement_of(self, value: Any, names: frozenset[str] = frozenset()) -> Any:
        if isinstance(value, types.MethodType):
            return types.MethodType(self.replacement_of(value.__func__), value.__self__)
        if isinstance(value, functools.partial):
            return functools.partial(self.replacement_of(value.func), *value.args, **value.keywords)
        if isinstance(value, types.ModuleType) and value in (math, np):
            return _Mathematics(value)
        name = getattr(value, "__name__", "")
        if not isinstance(value, type) and callable(value):
            for module in (math, np):
                if name and getattr(module, name, None) is value:
                    return getattr(_Mathematics(module), name)
            if is_library(getattr(value, "__module__", None) or ""):
                return value
        return super().replacement_of(value, names)

    def _add_copy(self, helper: Any) -> None:
        super()._add_copy(helper)
        self.copies[id(helper)].__globals__.setdefault("type", _symbolic_type)


def _symbolic_type(value: Any, *more: Any) -> Any:
    _refuse_symbols(value, "asks for the type of")
    return type(value, *more)


def _first_symbol(value: Any) -> Affine | None:
    """Return the first symbol in a value (a symbol, an array, a list or a tuple); None if there is no symbol."""
    if type(value) is Affine:
        return value
    if isinstance(value, np.ndarray):
        value = value.ravel().tolist() if value.dtype == object else ()
    if isinstance(value, list | tuple):
        return next((symbol for symbol in map(_first_symbol, value) if symbol is not None), None)
    return None


def _has_parameters(value: Any) -> bool:
    """Return whether a value is a Parameter, or an array, list or tuple that contains a Parameter."""
    if isinstance(value, np.ndarray):
        value = value.ravel().tolist() if value.dtype == object else ()
    return any(map(_has_parameters, value)) if isinstance(value, list | tuple) else type(value) is Parameter


def _refuse_symbols(value: Any, verb: str) -> None:
    symbol = _first_symbol(value)
    if symbol is not None:
        symbol.graph.refuse(f"it {verb} what depends on t, q or v")


def _numeric_function(function_of_numbers: Any, name: str) -> Callable[..., Any]:
    """Return a function that calls `function_of_numbers`; with symbols, it raises an exception that contains `name`."""

    @functools.wraps(function_of_numbers)
    def call_with_numbers(*arguments: Any, **options: Any) -> Any:
        _refuse_symbols([*arguments, *options.values()], f"calls {name} on")
        return function_of_numbers(*arguments, **options)

    return call_with_numbers


def _number_or_symbol(numeric: Any, symbolic: Callable[..., Any]) -> Callable[..., Any]:
    """Return a function that calls `numeric` with numbers and `symbolic` with symbols, also those in an array."""

    def call_matching(*arguments: Any) -> Any:
        if _first_symbol(arguments) is None:
            has_parameters = any(type(x) is Parameter for x in arguments)
            return apply_function(numeric.__name__, *arguments) if has_parameters else numeric(*arguments)
        if any(isinstance(x, np.ndarray) for x in arguments if type(x) is not Affine):
            return elementwise(call_matching, arguments)
        return symbolic(*arguments)

    return call_matching


def _is_real_dtype(dtype: Any) -> bool:
    return dtype is None or np.dtype(dtype) == np.float64


def _symbolic_constructor(constructor: Any) -> Callable[..., Any]:
    """Return a substitute for `zeros`, `ones` or `empty`, whose arrays can contain expressions."""

    def construct(shape: Any, dtype: Any = None, **options: Any) -> Any:
        if not _is_real_dtype(dtype):
            return constructor(shape, dtype, **options)
        return np.full(shape, 1.0 if constructor is np.ones else 0.0, dtype=object)

    return construct


def _symbolic_conversion(conversion: Any) -> Callable[..., Any]:
    """Return a substitute for `array`, `asarray` or `ascontiguousarray` that also accepts expressions."""

    def convert(value: Any, dtype: Any = None, **options: Any) -> Any:
        if _first_symbol(value) is None and not _has_parameters(value):
            return conversion(value, dtype, **options)
        if not _is_real_dtype(dtype):
            _refuse_symbols(value, f"makes {np.dtype(dtype).name} of")
        return conversion(value, object, **options)

    return convert


def _symbolic_full(shape: Any, value: Any, dtype: Any = None) -> Any:
    if (
        _first_symbol(value) is None
        and not _has_parameters(value)
        and not (_is_real_dtype(dtype) and np.asarray(value).dtype == np.float64)
    ):
        return np.full(shape, value, dtype)
    if not _is_real_dtype(dtype):
        _refuse_symbols(value, f"makes {np.dtype(dtype).name} of")
    return np.full(shape, value, object)


def _symbolic_norm(x: Any, *more: Any, **options: Any) -> Any:
    if _first_symbol(x) is None:
        return np.linalg.norm(x, *more, **options)
    if more or options or np.ndim(x) != 1:
        _refuse_symbols(x, "calls numpy.linalg.norm, but of a vector, on")
    x = np.asarray(x, dtype=object)
    return (x @ x) ** 0.5


class _Mathematics:
    """Substitute for `math`, `numpy` or a submodule: its attributes are functions that also accept expressions."""

    def __init__(self, module: types.ModuleType):
        self._module = module

    def __getattr__(self, name: str) -> Any:
        original = getattr(self._module, name)
        if isinstance(original, types.ModuleType):
            return _Mathematics(original)
        if isinstance(original, type) or not callable(original):
            return original
        if name in FUNCTIONS or name == "hypot":
            return _number_or_symbol(original, FUNCTIONS.get(name) or OPERATORS[name])
        if name in ("pow", "power"):
            return lambda x, y: x**y
        if self._module is np and name in ARRAY_CONSTRUCTORS:
            return _symbolic_constructor(original)
        if self._module is np and name in ARRAY_CONVERSIONS:
            return _symbolic_conversion(original)
        if original is np.full:
            return _symbolic_full
        if original is np.linalg.norm:
            return _symbolic_norm
        if self._module is np and name in NUMPY_FUNCTIONS:
            return original
        return _numeric_function(original, f"{self._module.__name__}.{name}")


# order in which `Equations.trace_all` traces callbacks
TRACING_ORDER = (
    *("constraint", "constraint_rate", "jacobian", "nonholonomic", "nonholonomic_rate", "mass", "force"),
    *("gamma", "nonholonomic_gamma"),
)
# keys: callbacks for gamma. Values: the two callbacks (C_q and C_t, or A and b) whose derivatives also give gamma
GAMMA_SOURCES = {"gamma": ("jacobian", "constraint_rate"), "nonholonomic_gamma": ("nonholonomic", "nonholonomic_rate")}


class Equations:
    """Results of the callbacks of a system as expressions; each callback is traced when its result is first used.

    parameters : numbers or Parameters that callbacks get as parameters; None: the parameters of the system.
    graph (field) : graph with the recorded operations of all callbacks; its first inputs are t, q and v.
    """

    def __init__(self, system: ConstrainedSystem, parameters: Any = None):
        self.system, self.graph = system, Graph()
        self.parameters = system.parameters if parameters is None else parameters
        self.running_callback: Any = next(
            (x.tape.running_callback for x in self.parameters if type(x) is Parameter), nullcontext
        )
        (self.t,) = self.graph.inputs(1, False)
        self.q, self.v = self.graph.inputs(system.n_q, False), self.graph.inputs(system.n_q, True)
        self._expressions: dict[str, Any] = {}
        self._results_before_copy: dict[str, Any] = {}  # in a copy: results of callbacks that the original has traced

    def trace_all(self) -> "Equations":
        """Trace all callbacks that run on symbols, so that copies of this object reuse the traces; return self."""
        for kind in TRACING_ORDER:
            if not self._is_derived(kind):
                with suppress(Untraceable):  # if a callback is needed, `expressions` raises Untraceable again
                    self.expressions(kind)
        return self

    def copy(self) -> "Equations":
        """Return a copy with its own graph, which may be extended; the copy uses the traces of this object."""
        equations = copy.copy(self)
        equations.graph = self.graph.copy()
        equations.t, equations.q, equations.v = (
            self.t.copy_to_graph(equations.graph),
            *([x.copy_to_graph(equations.graph) for x in state] for state in (self.q, self.v)),
        )
        equations._expressions, equations._results_before_copy = {}, self.graph.traced
        return equations

    def expressions(self, kind: str, v: Sequence[Affine] | None = None) -> Any:
        """Return the result of a callback, such as "mass", as an array of expressions of t, q and v.

        If the system has no such callback, C_q and gamma are derived from other callbacks; other results are zeros.
        `v`: expressions that replace the inputs `self.v`. Raise Untraceable if a callback does not run on symbols.
        """
        if v is not None and "v" in KINDS[kind].state:
            return self._derive_or_trace(kind, v)
        if kind not in self._expressions:
            self._expressions[kind] = self._derive_or_trace(kind, self.v)
        return self._expressions[kind].copy()

    def derivatives(self, kind: str, v: Sequence[Affine] | None = None) -> Any:
        """Return C_q, C_t or gamma as derivatives of other callbacks, even if the system has a callback `kind`."""
        if kind == "jacobian":
            return self._jacobian()
        if kind == "constraint_rate":
            time_derivative = Derivative(self.graph, {only_quantity(self.t): Affine(self.graph, 1.0, {})})
            return symbol_array(time_derivative.differentiate(expr) for expr in self.expressions("constraint"))
        return self._gamma(*GAMMA_SOURCES[kind], self.v if v is None else v)

    def _derive_or_trace(self, kind: str, v: Sequence[Affine]) -> Any:
        """Return the result of the callback `kind`; without this callback, derive C_q or gamma from other callbacks."""
        if self._is_derived(kind):
            return self.derivatives(kind, v)
        if kind in self._results_before_copy and v is self.v:
            exprs = elementwise(lambda expr: expr.copy_to_graph(self.graph), [self._results_before_copy[kind]])
            self.graph.traced.setdefault(kind, exprs.copy())
            return exprs
        return self._trace_callback(kind, v)

    def _is_derived(self, kind: str) -> bool:
        return kind not in self.system.given and kind in ("jacobian", *GAMMA_SOURCES)

    def _trace_callback(self, kind: str, v: Sequence[Affine]) -> Any:
        """Run a callback on symbols and return its result as expressions; return zeros if there is no such callback."""
        system, graph, (out,) = self.system, self.graph, self.system.arrays_of(kind)
        out, shape, p = out.astype(object), out.shape, self.parameters.copy()
        arrays = [symbol_array({"q": self.q, "v": v}[name]) for name in KINDS[kind].state]
        if out.size:
            try:
                with self.running_callback():
                    if not system.called_in_python:
                        trace(getattr(system.functions, kind), self.t, *arrays, p, out)
                    elif kind in system.python_functions:
                        function, parameters_argument = (
                            system.python_functions[kind],
                            (p,) if system.takes_parameters(kind) else (),
                        )
                        out = np.array(trace(function, self.t, *arrays, *parameters_argument), dtype=object)
                    out = convert_to_expressions(graph, out)
                    if out.shape != shape:
                        raise Untraceable(f"on symbols it returns an array of shape {out.shape}, not {shape}")
            except Untraceable as error:
                raise Untraceable(f"{kind} of {system.name!r}: {error}") from error
        graph.traced.setdefault(kind, out.copy())
        return out

    def _jacobian(self) -> Any:
        constraint, unit = self.expressions("constraint"), Affine(self.graph, 1.0, {})
        jacobian = np.empty((self.system.n_c, self.system.n_q), dtype=object)
        for j, coordinate in enumerate(self.q):
            derivative = Derivative(self.graph, {only_quantity(coordinate): unit})
            jacobian[:, j] = [derivative.differentiate(expr) for expr in constraint]
        return jacobian

    def _gamma(self, rows: str, rates: str, v: Sequence[Affine]) -> Any:
        """Return gamma = -d/dt(R v + r) at constant v. `rows`: callback for R (C_q or A); `rates`: for r (C_t or b)."""
        direction = {only_quantity(coordinate): u for coordinate, u in zip(self.q, v, strict=True)}
        total_derivative = Derivative(self.graph, {only_quantity(self.t): Affine(self.graph, 1.0, {}), **direction})
        gamma = self.expressions(rates)
        for i, row in enumerate(self.expressions(rows)):
            minus_gamma = total_derivative.differentiate(gamma[i])
            for entry, u in zip(row, v, strict=True):
                minus_gamma = minus_gamma + total_derivative.differentiate(entry) * u if entry.terms else minus_gamma
            gamma[i] = -minus_gamma
        return gamma


def runs_on_symbols(system: ConstrainedSystem, kind: str, parameters: Any) -> bool:
    """Return whether a compiled callback can be traced with `parameters`, which are numbers or Parameters."""
    equations = Equations(system, parameters)
    state = {"q": equations.q, "v": equations.v, "lam": equations.graph.inputs(system.n_c, True)}
    arrays = [symbol_array(state[name]) for name in KINDS[kind].state]
    outputs = [array.astype(object) for array in system.arrays_of(kind)]
    try:
        with equations.running_callback():
            trace(getattr(system.functions, kind), equations.t, *arrays, equations.parameters.copy(), *outputs)
            for array in outputs:
                convert_to_expressions(equations.graph, array)
    except (Untraceable, ArithmeticError, RecursionError):
        return False
    return True


def only_quantity(expr: Affine) -> int:
    """Return the index of the quantity in an expression with a single term."""
    (quantity,) = expr.terms
    return quantity


Array = NDArray[np.float64]
# array of expressions in parameters, as (scales, indices, products): entry i is scales[i] * products[indices[i]]
ScaledProducts = tuple[Array, NDArray[np.int64], list[Powers]]
Evaluator = Callable[[Any], Array]  # function that evaluates arrays of expressions for the parameters of one system

# random numbers in this range replace parameters in traces: they are of similar size, so that rounding hides no term
GENERIC_RANGE = 0.5, 1.5
# a parameter is a constant in traces if its magnitude is below this value, or above the inverse: powers of such
# parameters might underflow or overflow
MIN_MAGNITUDE = 1e-30

_TRACE_CACHES = BoundedCache()


class TraceCache:
    """Cache of traces, and of results derived from traces, for all systems that share their callbacks.

    parameters : parameters of one of the systems.
    groups : group of each parameter. 0: the parameter is a constant in the traces. 1, 2, ...: number of a group, whose
        parameters have equal magnitudes; with a minus sign if the parameter is negative.
    Fields:
    parameters : what callbacks get as parameters during a trace: the numbers of group 0 unchanged, and in place of
        each other number a Parameter with a random value, which is the same in the whole group except for its sign.
    traced_kinds : names of callbacks that were traced, so they do not branch, and always write to the same entries.
    within_bounds : names of traced callbacks that were found, for one of the systems, to use no index out of bounds.
    """

    def __init__(self, parameters: Array, groups: NDArray[np.int64]):
        self._groups = groups
        size = int(np.abs(self._groups).max(initial=0))
        _, first = np.unique(np.abs(self._groups), return_index=True)
        self._first_of_group = first[self._groups[first] != 0]  # for each group, the index of its first parameter
        self._tape = ParameterTape(np.random.default_rng(7).uniform(*GENERIC_RANGE, size).tolist(), range(size))
        self.parameters = parameters.astype(object) if self._groups.any() else parameters.copy()
        for i in np.flatnonzero(self._groups).tolist():
            signed_group = int(self._groups[i])
            parameter = self._tape.parameters[abs(signed_group) - 1]
            self.parameters[i] = parameter if signed_group > 0 else -parameter
        self.traced_kinds: set[str] = set()
        self.within_bounds: set[str] = set()
        self._results: dict[Any, Any] = {}
        # results of `_scaled_products`; keys: id(array). The arrays are stored, so that no other array gets the same id
        self._arrays: dict[int, tuple[Any, ScaledProducts]] = {}
        self._tracing_lock = RLock()  # one lock for all traces, because they share one ParameterTape

    def equations(self, system: ConstrainedSystem) -> Equations:
        """Return the traced callbacks of a system, with their own copy of the graph, which the caller may extend."""
        if system.called_in_python:  # trace a callback only when needed: a Python function may store symbols
            return Equations(system, self.parameters)
        traced: Equations = self.remembered("equations", lambda: Equations(system, self.parameters).trace_all())
        return traced.copy()

    def magnitudes(self, parameters: Array) -> Array:
        """Return the magnitude of the parameters in each of the groups 1, 2, ... (equal magnitudes, see TraceCache)."""
        return np.abs(parameters[self._first_of_group])

    def product_evaluator(self, parameters: Array) -> Callable[[Powers], Any]:
        """Return a function that evaluates products of powers (type `Powers`) for the `parameters` of one system."""
        return self._tape.product_evaluator(self.magnitudes(parameters))

    def evaluator(self, parameters: Array) -> Evaluator:
        """Return a function that evaluates arrays of expressions for `parameters`; the arrays must never change."""
        product = self.product_evaluator(parameters)

        def evaluate(array: Any) -> Array:
            if array.dtype != object:
                return array
            scales, indices, products = self._scaled_products(array)
            with np.errstate(all="ignore"):
                values: Array = scales * np.array(list(map(product, products)))[indices]
            if not np.isfinite(values).all():  # for example after a division by a sum of parameters that is 0
                raise Untraceable("a number of them is not finite for these parameters")
            return values

        return evaluate

    def _scaled_products(self, array: Any) -> ScaledProducts:
        """Return an array of expressions as ScaledProducts, from the cache if this array object was used before."""
        entry = self._arrays.get(id(array))
        if entry is None:
            powers = [x.powers if type(x) is Parameter else () for x in array.ravel()]
            products = {x: k for k, x in enumerate(dict.fromkeys(powers))}
            scales = np.array([x.scale if type(x) is Parameter else x for x in array.ravel()], dtype=np.float64)
            indices = np.array([products[x] for x in powers], dtype=np.int64)
            scaled = scales.reshape(array.shape), indices.reshape(array.shape), list(products)
            entry = self._arrays[id(array)] = array, scaled
        return entry[1]

    def remembered(self, key: Any, make: Callable[[], Any]) -> Any:
        """Return the cached result for `key`; at the first call, `make` computes it."""
        if key not in self._results:
            with self._tracing_lock:
                if key not in self._results:
                    with garbage_collection_off():  # a collection would free nothing: all new objects stay in the cache
                        self._results[key] = make()
        return self._results[key]


def derive_cached(
    system: ConstrainedSystem, key: Any, make: Callable[[TraceCache], Any], check: Callable[[Any], None]
) -> Any:
    """Return what `make` derives from traces, such as a program, after inserting the parameters of one system.

    `make` gets a TraceCache, and returns an object with a method `specialize`, which inserts the parameters of the
    system. Results are cached by `key`. `check` raises Untraceable if a result does not agree with the callbacks.

    First, the TraceCache that is shared with systems of other parameters is used. If callbacks branch on parameters, or
    `check` fails, a TraceCache of this system alone is used. If this also fails, Untraceable is raised.
    """
    for find_cache in (_own_cache,) if system.called_in_python else (trace_cache_of, _own_cache):
        cache = system.remembered(("trace cache", find_cache), partial(find_cache, system))
        derived = system.remembered((key, find_cache), partial(_derive_shared, system, cache, key, make))
        try:
            if isinstance(derived, Untraceable):
                raise derived
            check(derived)
            cache.traced_kinds |= derived.kinds
            return derived
        except Untraceable as error:
            reason = error
    raise reason


def _derive_shared(system: ConstrainedSystem, cache: TraceCache, key: Any, make: Callable[[TraceCache], Any]) -> Any:
    """Return the result of make(cache) for the parameters of `system`; on failure, return the exception Untraceable."""
    try:
        result = cache.remembered(key, partial(make, cache))
        return result.specialize(
            system, system.remembered(("numbers", cache), partial(cache.evaluator, system.parameters))
        )
    except Untraceable as error:
        return error.with_traceback(None)
    except (ArithmeticError, RecursionError) as error:
        return Untraceable(f"what it makes of its parameters cannot be written down: {error}")


def load_checked_bounds(system: ConstrainedSystem) -> None:
    """Mark callbacks as checked for indices out of bounds if another system with the same TraceCache checked them."""
    if not system.called_in_python:
        system.within_bounds |= shared_cache(system).within_bounds


def share_checked_bounds(system: ConstrainedSystem) -> None:
    """Tell systems with the same TraceCache which traced callbacks were checked for indices out of bounds."""
    if not system.called_in_python:
        cache = shared_cache(system)
        cache.within_bounds |= cache.traced_kinds & system.within_bounds


def shared_cache(system: ConstrainedSystem) -> TraceCache:
    """Return the TraceCache that a system shares with others (see `trace_cache_of`), and store it in the system."""
    return system.remembered(("trace cache", trace_cache_of), partial(trace_cache_of, system))  # type: ignore[no-any-return]


def trace_cache_of(system: ConstrainedSystem) -> TraceCache:
    """Return the TraceCache for systems with equal callbacks, sizes, constant parameters and `_parameter_groups`."""
    parameters = system.parameters
    groups = _parameter_groups(parameters)
    fixed_parameters = parameters[groups == 0] + 0.0  # -0.0 becomes 0.0, so that keys with zeros are equal
    key = (*system.given.items(), system.n_q, system.n_c, system.n_a, groups.tobytes(), fixed_parameters.tobytes())
    cache: TraceCache | None = _TRACE_CACHES.get(key)
    if cache is None:
        _TRACE_CACHES[key] = cache = TraceCache(parameters, groups)
    return cache


def _own_cache(system: ConstrainedSystem) -> TraceCache:
    """Return a new TraceCache for one system alone: all parameters are constants in its traces."""
    return TraceCache(system.parameters, np.zeros(system.parameters.size, dtype=np.int64))


def _parameter_groups(parameters: Array) -> NDArray[np.int64]:
    """Return the group of each parameter: 0 for constants; equal magnitudes share a group. For signs see TraceCache."""
    magnitudes = np.abs(parameters)
    varies = (magnitudes > MIN_MAGNITUDE) & (magnitudes < 1.0 / MIN_MAGNITUDE) & (magnitudes != np.floor(magnitudes))
    _, first, inverse = np.unique(magnitudes[varies], return_index=True, return_inverse=True)
    rank = np.empty(len(first), dtype=np.int64)
    rank[first.argsort()] = np.arange(1, len(first) + 1)
    groups = np.zeros(len(magnitudes), dtype=np.int64)
    groups[varies] = np.copysign(rank[inverse], parameters[varies])
    return groups


class ParameterArrays:
    """Arrays of numbers that stand for arrays of expressions; `write` updates the numbers for new parameters."""

    def __init__(self) -> None:
        # keys: ids of arrays of expressions. Values: the array (stored to keep its id unique), and its array of numbers
        self._arrays: dict[int, tuple[Any, Array]] = {}
        # (array of numbers, indices of entries that `write` overwrites, slice of `values` in `write` with new entries)
        self._number_arrays: list[tuple[Array, NDArray[np.int64], slice]] = []
        self._products: dict[Powers, int] = {}
        self._scales: list[float] = []
        self._product_indices: list[int] = []
        self._gathered_products: tuple[list[Powers], Array, NDArray[np.int64]] | None = None

    def array(self, exprs: Any) -> Array:
        """Return the one array of numbers that stands for `exprs`; if `exprs` contains only numbers, return `exprs`."""
        if exprs.dtype != object:
            return exprs  # type: ignore[no-any-return]
        if id(exprs) not in self._arrays:
            self._arrays[id(exprs)] = exprs, self._numbers_for(exprs)
        return self._arrays[id(exprs)][1]

    def _numbers_for(self, exprs: Any) -> Array:
        """Return a new array with the constants of `exprs`, and 0 for each Parameter until `write` stores its value."""
        entries, begin = exprs.ravel().tolist(), len(self._scales)
        varying = [k for k, entry in enumerate(entries) if type(entry) is Parameter]
        for k in varying:
            self._scales.append(entries[k].scale)
            self._product_indices.append(self._products.setdefault(entries[k].powers, len(self._products)))
            entries[k] = 0.0
        numbers = np.array(entries, dtype=np.float64)
        self._number_arrays.append((numbers, np.array(varying, dtype=np.int64), slice(begin, len(self._scales))))
        self._gathered_products = (
            list(self._products),
            np.array(self._scales),
            np.array(self._product_indices, dtype=np.int64),
        )
        return numbers.reshape(exprs.shape)

    def write(self, product: Callable[[Powers], Any]) -> None:
        """Store values for new parameters in all arrays that `array` returned; `product`: see `product_evaluator`."""
        if self._gathered_products is None:
            return
        products, scales, product_indices = self._gathered_products
        with np.errstate(all="ignore"):
            values = scales * np.array(list(map(product, products)), dtype=np.float64)[product_indices]
        for numbers, varying, values_slice in self._number_arrays:
            numbers[varying] = values[values_slice]
