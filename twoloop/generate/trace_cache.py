"""Cache of traces for all systems that share their callbacks: coefficients are expressions in the parameters.

- Parameters that are whole numbers keep their values, as they may be counts, indices or switches, and zeros and ones
  save operations. Parameters of equal magnitude stay equal. So the systems of one cache differ only in other numbers.
- A callback that branches on its parameters, or rounds them, has no such expressions. It is traced for each system.
"""

from collections.abc import Callable
from functools import partial
from threading import RLock
from typing import Any

import numpy as np
from numpy.typing import NDArray

from twoloop.generate.graph import Untraceable
from twoloop.generate.parameter_expressions import Parameter, ParameterTape, Powers
from twoloop.generate.trace import Equations
from twoloop.kernels.compile.caches import BoundedCache, garbage_collection_off
from twoloop.problem.system import ConstrainedSystem

Array = NDArray[np.float64]
Gathered = tuple[Array, NDArray[np.int64], list[Powers]]
Evaluator = Callable[[Any], Array]  # computes the numbers of an array of expressions for one system

# range of the parameters with which callbacks are traced: of like size, so that no term hides another
GENERIC = 0.5, 1.5
# parameters smaller than this, or larger than its inverse, keep their values: their powers would over- or underflow
EXTREME = 1e-30

_CACHES = BoundedCache()


class TraceCache:
    """Cache of the results derived from the callbacks that several systems share.

    Parameters
    ----------
    parameters : ndarray (n_p,)
        Parameters of one of the systems.
    classes : ndarray of int (n_p,)
        Class of each parameter: parameters of equal magnitude share a number from 1 on, negative for negative ones; 0:
        it keeps its value.

    Attributes
    ----------
    parameters : ndarray of float and Parameter (n_p,)
        Parameters with which callbacks are traced.
    traced : set of str
        Kinds of callbacks that were traced: they write the same entries in all systems.
    within_bounds : set of str
        Kinds among these whose bounds `check_bounds` has checked in one of the systems.
    """

    def __init__(self, parameters: Array, classes: NDArray[np.int64]):
        self._classes = classes
        n_numbers = int(np.abs(self._classes).max(initial=0))
        _, first = np.unique(np.abs(self._classes), return_index=True)
        self._first = first[self._classes[first] != 0]  # first index of each number
        self._tape = ParameterTape(np.random.default_rng(7).uniform(*GENERIC, n_numbers).tolist(), range(n_numbers))
        self.parameters = parameters.astype(object) if self._classes.any() else parameters.copy()
        for place in np.flatnonzero(self._classes).tolist():
            which = int(self._classes[place])
            parameter = self._tape.parameters[abs(which) - 1]
            self.parameters[place] = parameter if which > 0 else -parameter
        self.traced: set[str] = set()
        self.within_bounds: set[str] = set()
        self._made: dict[Any, Any] = {}
        # by id; the arrays are stored as well, so that ids are not reused
        self._arrays: dict[int, tuple[Any, Gathered]] = {}
        self._tracing = RLock()  # one lock, as all traces record on one tape

    def equations(self, system: ConstrainedSystem) -> Equations:
        """Return the traced callbacks; their graph can be extended."""
        if system.called_in_python:  # a function may keep its arguments, so it is traced as late as possible
            return Equations(system, self.parameters)
        traced: Equations = self.remembered("equations", lambda: Equations(system, self.parameters).trace_all())
        return traced.copy()

    def numbers(self, parameters: Array) -> Array:
        """Return the magnitudes of a system's parameters, one for each class."""
        return np.abs(parameters[self._first])

    def products(self, parameters: Array) -> Callable[[Powers], Any]:
        """Return a function that evaluates products of atoms for a system's parameters."""
        return self._tape.products(self.numbers(parameters))

    def evaluator(self, parameters: Array) -> Evaluator:
        """Return a function that evaluates arrays of expressions, stored in this cache, for a system's parameters."""
        product = self.products(parameters)

        def evaluate(array: Any) -> Array:
            if array.dtype != object:
                return array
            scales, places, products = self._gathered(array)
            with np.errstate(all="ignore"):
                values: Array = scales * np.array(list(map(product, products)))[places]
            if not np.isfinite(values).all():  # an expression may divide by a sum of parameters that is zero
                raise Untraceable("a number of them is not finite for these parameters")
            return values

        return evaluate

    def _gathered(self, array: Any) -> Gathered:
        """Return the scales of an array's entries, the indices of their products, and the products."""
        entry = self._arrays.get(id(array))
        if entry is None:
            powers = [each.powers if type(each) is Parameter else () for each in array.ravel()]
            products = {each: place for place, each in enumerate(dict.fromkeys(powers))}
            scales = np.array(
                [each.scale if type(each) is Parameter else each for each in array.ravel()], dtype=np.float64
            )
            places = np.array([products[each] for each in powers], dtype=np.int64)
            gathered = scales.reshape(array.shape), places.reshape(array.shape), list(products)
            entry = self._arrays[id(array)] = array, gathered
        return entry[1]

    def remembered(self, what: Any, make: Callable[[], Any]) -> Any:
        """Return the result of `make` of the first call for this key."""
        if what not in self._made:
            with self._tracing:
                if what not in self._made:
                    with garbage_collection_off():  # all of it stays in memory
                        self._made[what] = make()
        return self._made[what]


def derive_cached(
    system: ConstrainedSystem, what: Any, make: Callable[[TraceCache], Any], check: Callable[[Any], None]
) -> Any:
    """Return what `make` derives from shared traces, for one system: the result of its method `of`.

    The system gets a trace of its own if callbacks cannot be traced with variable parameters, or if `check` refuses the
    result, as a callback may treat variable parameters differently from numbers.

    Raises
    ------
    Untraceable
        If the result cannot be derived, or `check` refuses it.
    """
    for find in (_own_cache,) if system.called_in_python else (trace_cache_of, _own_cache):
        cache = system.remembered(("family", find), partial(find, system))
        derived = system.remembered((what, find), partial(_derived_for, system, cache, what, make))
        try:
            if isinstance(derived, Untraceable):
                raise derived
            check(derived)
            cache.traced |= derived.kinds
            return derived
        except Untraceable as error:
            reason = error
    raise reason


def _derived_for(system: ConstrainedSystem, cache: TraceCache, what: Any, make: Callable[[TraceCache], Any]) -> Any:
    """Return the result for a system, or the exception that says why there is none."""
    try:
        shared = cache.remembered(what, partial(make, cache))
        return shared.of(system, system.remembered(("numbers", cache), partial(cache.evaluator, system.parameters)))
    except Untraceable as error:
        return error.with_traceback(None)
    except (ArithmeticError, RecursionError) as error:
        return Untraceable(f"what it makes of its parameters cannot be written down: {error}")


def take_bounds(system: ConstrainedSystem) -> None:
    """Copy the results of `check_bounds` for systems that share the traces, as their callbacks do the same."""
    if not system.called_in_python:
        system.within_bounds |= shared_cache(system).within_bounds


def give_bounds(system: ConstrainedSystem) -> None:
    """Share the results of `check_bounds` for a system with those that have the same traces."""
    if not system.called_in_python:
        cache = shared_cache(system)
        cache.within_bounds |= cache.traced & system.within_bounds


def shared_cache(system: ConstrainedSystem) -> TraceCache:
    """Return the cached traces that a system of compiled callbacks shares with others."""
    return system.remembered(("family", trace_cache_of), partial(trace_cache_of, system))  # type: ignore[no-any-return]


def trace_cache_of(system: ConstrainedSystem) -> TraceCache:
    """Look up the traces that a system of compiled callbacks shares with others."""
    parameters = system.parameters
    classes = _classes(parameters)
    fixed = parameters[classes == 0] + 0.0  # without a sign of zero
    key = (*system.given.items(), system.n_q, system.n_c, system.n_a, classes.tobytes(), fixed.tobytes())
    cache: TraceCache | None = _CACHES.get(key)
    if cache is None:
        _CACHES[key] = cache = TraceCache(parameters, classes)
    return cache


def _own_cache(system: ConstrainedSystem) -> TraceCache:
    """Return traces for one system alone, with its parameters as plain numbers."""
    return TraceCache(system.parameters, np.zeros(system.parameters.size, dtype=np.int64))


def _classes(parameters: Array) -> NDArray[np.int64]:
    """Number the magnitudes of parameters in order of appearance, with the signs; 0: it keeps its value."""
    size = np.abs(parameters)
    varies = (size > EXTREME) & (size < 1.0 / EXTREME) & (size != np.floor(size))
    _, first, which = np.unique(size[varies], return_index=True, return_inverse=True)
    rank = np.empty(len(first), dtype=np.int64)
    rank[first.argsort()] = np.arange(1, len(first) + 1)
    classes = np.zeros(len(size), dtype=np.int64)
    classes[varies] = np.copysign(rank[which], parameters[varies])
    return classes


class ParameterArrays:
    """Arrays of numbers for arrays of expressions in parameters; `write` evaluates all of them at once.

    The same array of expressions always gets the same array of numbers. An array of plain numbers stays itself.
    """

    def __init__(self) -> None:
        # by id; the arrays are stored as well, so that ids are not reused
        self._arrays: dict[int, tuple[Any, Array]] = {}
        self._places: list[tuple[Array, NDArray[np.int64], slice]] = []
        self._products: dict[Powers, int] = {}
        self._scales: list[float] = []
        self._which: list[int] = []
        self._gathered: tuple[list[Powers], Array, NDArray[np.int64]] | None = None

    def array(self, expressions: Any) -> Array:
        """Return the array of numbers for an array of expressions; the next `write` fills it."""
        if expressions.dtype != object:
            return expressions  # type: ignore[no-any-return]
        if id(expressions) not in self._arrays:
            self._arrays[id(expressions)] = expressions, self._numbers_for(expressions)
        return self._arrays[id(expressions)][1]

    def _numbers_for(self, expressions: Any) -> Array:
        entries, begin = expressions.ravel().tolist(), len(self._scales)
        where = [k for k, entry in enumerate(entries) if type(entry) is Parameter]
        for k in where:
            self._scales.append(entries[k].scale)
            self._which.append(self._products.setdefault(entries[k].powers, len(self._products)))
            entries[k] = 0.0
        numbers = np.array(entries, dtype=np.float64)
        self._places.append((numbers, np.array(where, dtype=np.int64), slice(begin, len(self._scales))))
        self._gathered = list(self._products), np.array(self._scales), np.array(self._which, dtype=np.int64)
        return numbers.reshape(expressions.shape)

    def write(self, product: Callable[[Powers], Any]) -> None:
        """Write the numbers for the parameters of `product`, see TraceCache.products."""
        if self._gathered is None:
            return
        products, scales, which = self._gathered
        with np.errstate(all="ignore"):
            values = scales * np.array(list(map(product, products)), dtype=np.float64)[which]
        for numbers, where, part in self._places:
            numbers[where] = values[part]
