"""Cache what is traced of callbacks, for all systems that share them: its numbers are expressions in the parameters.

- Parameters that are whole numbers keep their values, as these may be counts, places or switches, and zeros and ones
  leave operations out. What is equal, but for its sign, stays equal. So systems of one cache differ in other numbers.
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
Evaluator = Callable[[Any], Array]  # gives the numbers of an array of expressions for one system

GENERIC = 0.5, 1.5  # range of the parameters with which callbacks are traced: of one size, so that none hides another
EXTREME = 1e-30  # parameters below it, or above its inverse, keep their values: their powers would leave the range

_CACHES = BoundedCache()


class TraceCache:
    """What is derived from the callbacks that some systems share.

    Parameters
    ----------
    parameters : ndarray (n_p,)
        Parameters of one of the systems.
    classes : ndarray of int (n_p,)
        For each parameter the number that it is, counted from 1 and negative for a negative one; 0: it keeps its value.

    Attributes
    ----------
    parameters : ndarray of float and Parameter (n_p,)
        Parameters with which callbacks are traced.
    traced : set of str
        Kinds of callbacks that were traced: they write the same entries in all systems.
    within_bounds : set of str
        Kinds among these that `check_bounds` has checked in one of the systems.
    """

    def __init__(self, parameters: Array, classes: NDArray[np.int64]):
        self._classes = classes
        n_numbers = int(np.abs(self._classes).max(initial=0))
        _, first = np.unique(np.abs(self._classes), return_index=True)
        self._first = first[self._classes[first] != 0]  # first place of each number
        self._tape = ParameterTape(np.random.default_rng(7).uniform(*GENERIC, n_numbers).tolist(), range(n_numbers))
        self.parameters = parameters.astype(object) if self._classes.any() else parameters.copy()
        for place in np.flatnonzero(self._classes).tolist():
            which = int(self._classes[place])
            parameter = self._tape.parameters[abs(which) - 1]
            self.parameters[place] = parameter if which > 0 else -parameter
        self.traced: set[str] = set()
        self.within_bounds: set[str] = set()
        self._made: dict[Any, Any] = {}
        self._arrays: dict[int, tuple[Any, Gathered]] = {}  # by the ids of the arrays, which are kept alive here
        self._tracing = RLock()  # all traces record on one tape

    def equations(self, system: ConstrainedSystem) -> Equations:
        """Return the traced callbacks, with a graph to be extended."""
        if system.called_in_python:  # a function may keep its arguments, so it is traced as late as possible
            return Equations(system, self.parameters)
        traced: Equations = self.remembered("equations", lambda: Equations(system, self.parameters).trace_all())
        return traced.copy()

    def numbers(self, parameters: Array) -> Array:
        """Return the numbers of a system's parameters, one for each class."""
        return np.abs(parameters[self._first])

    def products(self, parameters: Array) -> Callable[[Powers], Any]:
        """Return a function that evaluates products of atoms for a system's parameters."""
        return self._tape.products(self.numbers(parameters))

    def evaluator(self, parameters: Array) -> Evaluator:
        """Return a function that evaluates arrays of expressions, which this cache keeps, for a system's parameters."""
        product = self.products(parameters)

        def evaluate(array: Any) -> Array:
            if array.dtype != object:
                return array
            scales, places, products = self._gathered(array)
            with np.errstate(all="ignore"):
                values: Array = scales * np.array(list(map(product, products)))[places]
            if not np.isfinite(values).all():  # as where an expression divides by a sum of parameters that is zero
                raise Untraceable("a number of them is not finite for these parameters")
            return values

        return evaluate

    def _gathered(self, array: Any) -> Gathered:
        """Return the scales of an array's entries, the places of their products, and the products."""
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
        """Return what `make` returned at the first call for this key."""
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

    The system gets a trace of its own if callbacks cannot be traced with parameters that vary, or if `check` refuses
    the result, as a callback may treat these otherwise than numbers.

    Raises
    ------
    Untraceable
        If it cannot be derived, or is refused.
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
    """Return what is derived for a system, or the reason why it cannot be."""
    try:
        shared = cache.remembered(what, partial(make, cache))
        return shared.of(system, system.remembered(("numbers", cache), partial(cache.evaluator, system.parameters)))
    except Untraceable as error:
        return error.with_traceback(None)
    except (ArithmeticError, RecursionError) as error:
        return Untraceable(f"what it makes of its parameters cannot be written down: {error}")


def take_bounds(system: ConstrainedSystem) -> None:
    """Take over what `check_bounds` found in systems that share the traces, whose callbacks do the same."""
    if not system.called_in_python:
        system.within_bounds |= shared_cache(system).within_bounds


def give_bounds(system: ConstrainedSystem) -> None:
    """Share what `check_bounds` found in a system."""
    if not system.called_in_python:
        cache = shared_cache(system)
        cache.within_bounds |= cache.traced & system.within_bounds


def shared_cache(system: ConstrainedSystem) -> TraceCache:
    """Return the traces that a system of compiled callbacks shares with others."""
    return system.remembered(("family", trace_cache_of), partial(trace_cache_of, system))  # type: ignore[no-any-return]


def trace_cache_of(system: ConstrainedSystem) -> TraceCache:
    """Look up the traces that a system of compiled callbacks shares with others, which `run` puts into systems, too."""
    parameters = system.parameters
    classes = _classes(parameters)
    fixed = parameters[classes == 0] + 0.0  # without a sign of zero
    key = (*system.given.items(), system.n_q, system.n_c, system.n_a, classes.tobytes(), fixed.tobytes())
    cache: TraceCache | None = _CACHES.get(key)
    if cache is None:
        _CACHES[key] = cache = TraceCache(parameters, classes)
    return cache


def _own_cache(system: ConstrainedSystem) -> TraceCache:
    """Return traces for the parameters of a system alone, all of which are plain numbers."""
    return TraceCache(system.parameters, np.zeros(system.parameters.size, dtype=np.int64))


def _classes(parameters: Array) -> NDArray[np.int64]:
    """Number the sizes of parameters in order of appearance, with the signs; 0 for those that keep their values."""
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
        self._arrays: dict[int, tuple[Any, Array]] = {}  # by the ids of the arrays, which are kept alive here
        self._places: list[tuple[Array, NDArray[np.int64], slice]] = []
        self._products: dict[Powers, int] = {}
        self._scales: list[float] = []
        self._which: list[int] = []
        self._gathered: tuple[list[Powers], Array, NDArray[np.int64]] | None = None

    def array(self, expressions: Any) -> Array:
        """Return the numbers of an array of expressions, which the next `write` fills in."""
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
        """Fill in the numbers for the parameters of `product`, see TraceCache.products."""
        if self._gathered is None:
            return
        products, scales, which = self._gathered
        with np.errstate(all="ignore"):
            values = scales * np.array(list(map(product, products)), dtype=np.float64)[which]
        for numbers, where, part in self._places:
            numbers[where] = values[part]
