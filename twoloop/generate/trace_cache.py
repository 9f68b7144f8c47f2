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
from twoloop.kernels.compile.caches import Newest, uncollected
from twoloop.problem.system import ConstrainedSystem

Array = NDArray[np.float64]
Gathered = tuple[Array, NDArray[np.int64], list[Powers]]
Evaluator = Callable[[Any], Array]  # of an array of numbers, some of which may be formulas, for one system

GENERIC = 0.5, 1.5  # range of the numbers with which callbacks are traced: of one size, so that none hides another
EXTREME = 1e-30  # what is smaller, or larger than its inverse, stays what it is: its powers would leave the range

_FAMILIES = Newest()


class TraceCache:
    """What is made of the callbacks of some systems.

    Parameters
    ----------
    parameters : ndarray (n_p,)
        Of one of the systems.
    classes : ndarray of int (n_p,)
        Which of its numbers each parameter is, from 1 on, negative for a negative one; 0: it stays what it is.

    Attributes
    ----------
    parameters : ndarray of float and Parameter (n_p,)
        With which callbacks are traced.
    traced : set of str
        Kinds of callbacks that were: they do the same in all systems, at the same places of their arrays.
    """

    def __init__(self, parameters: Array, classes: NDArray[np.int64]):
        self._classes = classes
        n_numbers = int(np.abs(self._classes).max(initial=0))
        _, first = np.unique(np.abs(self._classes), return_index=True)
        self._first = first[self._classes[first] != 0]  # where each number stands first
        self._record = ParameterTape(np.random.default_rng(7).uniform(*GENERIC, n_numbers).tolist(), range(n_numbers))
        self.parameters = parameters.astype(object) if self._classes.any() else parameters.copy()
        for place in np.flatnonzero(self._classes).tolist():
            which = int(self._classes[place])
            known = self._record.parameters[abs(which) - 1]
            self.parameters[place] = known if which > 0 else -known
        self.traced: set[str] = set()
        self.within_bounds: set[str] = set()  # of these, what `check_bounds` has looked at in one of the systems
        self._made: dict[Any, Any] = {}
        self._arrays: dict[int, tuple[Any, Gathered]] = {}  # of formulas, by their ids
        self._tracing = RLock()  # what is traced is put down in one record

    def equations(self, system: ConstrainedSystem) -> Equations:
        """What its callbacks were traced to, as a beginning of a graph."""
        if system.called_in_python:  # may keep what it gets, and so is traced no earlier than it must be
            return Equations(system, self.parameters)
        traced: Equations = self.remembered("equations", lambda: Equations(system, self.parameters).trace_all())
        return traced.copy()

    def numbers(self, parameters: Array) -> Array:
        """The numbers, one for each class, of a system's parameters."""
        return np.abs(parameters[self._first])

    def products(self, parameters: Array) -> Callable[[Powers], Any]:
        """What gives the products of which formulas are multiples, for a system's parameters."""
        return self._record.products(self.numbers(parameters))

    def evaluator(self, parameters: Array) -> Evaluator:
        """What evaluates formulas for a system's parameters; their arrays are those that are kept with the family."""
        product = self.products(parameters)

        def evaluate(array: Any) -> Array:
            if array.dtype != object:
                return array
            scales, places, products = self._gathered(array)
            with np.errstate(all="ignore"):
                made: Array = scales * np.array(list(map(product, products)))[places]
            if not np.isfinite(made).all():  # as a sum of parameters by which a formula divides is zero
                raise Untraceable("a number of them is not finite for these parameters")
            return made

        return evaluate

    def _gathered(self, array: Any) -> Gathered:
        """Numbers of an array as multiples of products of atoms, the places of these, and the products."""
        known = self._arrays.get(id(array))
        if known is None:
            powers = [each.powers if type(each) is Parameter else () for each in array.ravel()]
            products = {each: place for place, each in enumerate(dict.fromkeys(powers))}
            scales = np.array(
                [each.scale if type(each) is Parameter else each for each in array.ravel()], dtype=np.float64
            )
            places = np.array([products[each] for each in powers], dtype=np.int64)
            gathered = scales.reshape(array.shape), places.reshape(array.shape), list(products)
            known = self._arrays[id(array)] = array, gathered  # what is named by its id is held
        return known[1]

    def remembered(self, what: Any, make: Callable[[], Any]) -> Any:
        """What `make` makes of the callbacks, once."""
        if what not in self._made:
            with self._tracing:
                if what not in self._made:
                    with uncollected():  # what is traced all stays, too
                        self._made[what] = make()
        return self._made[what]


def derive_cached(
    system: ConstrainedSystem, what: Any, make: Callable[[TraceCache], Any], check: Callable[[Any], None]
) -> Any:
    """What `make` makes of the callbacks of a family, for one of its systems: what its method `of` gives.

    Where it cannot be traced with formulas, or `check` refuses it (a callback may do with these what it does not with
    numbers), the system gets a family of its own.

    Raises
    ------
    Untraceable
        If it cannot be made of the system, or is refused.
    """
    for family_for in (_alone,) if system.called_in_python else (trace_cache_of, _alone):
        family = system.remembered(("family", family_for), partial(family_for, system))
        made = system.remembered((what, family_for), partial(_made_for, system, family, what, make))
        try:
            if isinstance(made, Untraceable):
                raise made
            check(made)
            family.traced |= made.kinds
            return made
        except Untraceable as error:
            reason = error
    raise reason


def _made_for(system: ConstrainedSystem, family: TraceCache, what: Any, make: Callable[[TraceCache], Any]) -> Any:
    """What a system gets of a family, or why it cannot be had."""
    try:
        shared = family.remembered(what, partial(make, family))
        return shared.of(system, system.remembered(("numbers", family), partial(family.evaluator, system.parameters)))
    except Untraceable as error:
        return error.with_traceback(None)
    except (ArithmeticError, RecursionError) as error:
        return Untraceable(f"what it makes of its parameters cannot be written down: {error}")


def take_bounds(system: ConstrainedSystem) -> None:
    """Let a system have what `check_bounds` has found in others of its family, whose callbacks do the same."""
    if not system.called_in_python:
        family: TraceCache = system.remembered(("family", trace_cache_of), partial(trace_cache_of, system))
        system.within_bounds |= family.within_bounds


def give_bounds(system: ConstrainedSystem) -> None:
    """Let others of its family have what `check_bounds` has found in a system."""
    if not system.called_in_python:
        family: TraceCache = system.remembered(("family", trace_cache_of), partial(trace_cache_of, system))
        family.within_bounds |= family.traced & system.within_bounds


def trace_cache_of(system: ConstrainedSystem) -> TraceCache:
    """The family of a system of compiled callbacks, which depend on their arguments alone."""
    parameters = system.parameters
    classes = _classes(parameters)
    fixed = parameters[classes == 0] + 0.0  # without a sign of zero
    key = (*system.given.items(), system.n_q, system.n_c, system.n_a, classes.tobytes(), fixed.tobytes())
    known: TraceCache | None = _FAMILIES.get(key)
    if known is None:
        _FAMILIES[key] = known = TraceCache(parameters, classes)
    return known


def _alone(system: ConstrainedSystem) -> TraceCache:
    """A family of a system with these parameters only, all of which are plain numbers."""
    return TraceCache(system.parameters, np.zeros(system.parameters.size, dtype=np.int64))


def _classes(parameters: Array) -> NDArray[np.int64]:
    """Which number each parameter is, in the order in which they come, with its sign; 0 where it stays what it is."""
    size = np.abs(parameters)
    varies = (size > EXTREME) & (size < 1.0 / EXTREME) & (size != np.floor(size))
    _, first, which = np.unique(size[varies], return_index=True, return_inverse=True)
    rank = np.empty(len(first), dtype=np.int64)
    rank[first.argsort()] = np.arange(1, len(first) + 1)
    classes = np.zeros(len(size), dtype=np.int64)
    classes[varies] = np.copysign(rank[which], parameters[varies])
    return classes


class ParameterArrays:
    """Arrays in the place of arrays of formulas, all of which `write` fills for some parameters.

    One array stands for one of formulas, however often that is asked for; one that holds plain numbers stays itself.
    """

    def __init__(self) -> None:
        self._arrays: dict[int, tuple[Any, Array]] = {}  # by the ids of those of formulas, which are held
        self._places: list[tuple[Array, NDArray[np.int64], slice]] = []
        self._products: dict[Powers, int] = {}
        self._scales: list[float] = []
        self._which: list[int] = []
        self._gathered: tuple[list[Powers], Array, NDArray[np.int64]] | None = None

    def array(self, formulas: Any) -> Array:
        """What stands in the place of an array; its numbers are there after the next `write`."""
        if formulas.dtype != object:
            return formulas  # type: ignore[no-any-return]
        if id(formulas) not in self._arrays:
            self._arrays[id(formulas)] = formulas, self._made(formulas)
        return self._arrays[id(formulas)][1]

    def _made(self, formulas: Any) -> Array:
        entries, begin = formulas.ravel().tolist(), len(self._scales)
        where = [k for k, entry in enumerate(entries) if type(entry) is Parameter]
        for k in where:
            self._scales.append(entries[k].scale)
            self._which.append(self._products.setdefault(entries[k].powers, len(self._products)))
            entries[k] = 0.0
        numbers = np.array(entries, dtype=np.float64)
        self._places.append((numbers, np.array(where, dtype=np.int64), slice(begin, len(self._scales))))
        self._gathered = list(self._products), np.array(self._scales), np.array(self._which, dtype=np.int64)
        return numbers.reshape(formulas.shape)

    def write(self, product: Callable[[Powers], Any]) -> None:
        """Put in the numbers for parameters, of which `product` gives the products: see TraceCache."""
        if self._gathered is None:
            return
        products, scales, which = self._gathered
        with np.errstate(all="ignore"):
            values = scales * np.array(list(map(product, products)), dtype=np.float64)[which]
        for numbers, where, part in self._places:
            numbers[where] = values[part]
