"""No compiled callback goes out of the bounds of its arrays: machine code would read or write other memory.

Each callback first runs once in Python, its compiled helpers too, where an index too large is an `IndexError`; what
runs only compiled is compiled a second time with numba's own check. Branches that are not taken then are not seen.
"""

import linecache
import types
import warnings
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
from numba import njit
from numba.core.dispatcher import Dispatcher
from numpy.typing import NDArray

from twoloop.caches import names_in
from twoloop.callbacks import KINDS

if TYPE_CHECKING:
    from twoloop.system import ConstrainedSystem

Array = NDArray[np.float64]

MANY = 4096  # parameters that a callback may ask for beyond those that it has, for telling which array is too short


def check_bounds(system: "ConstrainedSystem", t: float, q: Array, v: Array) -> None:
    """Run every compiled callback of a system once at (t, q, v) where bounds are watched; later calls do nothing.

    Raises
    ------
    ValueError
        Naming the callback, the index and the sizes of its arrays.
    """
    state = {"q": q, "v": v, "lam": np.ones(system.n_c)}
    for kind, entry in KINDS.items():
        check_callback(system, kind, t, [state[name] for name in entry.state])


def check_callback(system: "ConstrainedSystem", kind: str, t: float, state: list[Array]) -> None:
    """Run one callback as `check_bounds` does all."""
    if system.called_in_python or kind in system.within_bounds:
        return
    function, p, out = getattr(system.functions, kind), system.parameters, system.arrays_of(kind)
    given = p.copy()
    error = _index_error(function, t, state, given, out)
    if (given != p).any():
        raise ValueError(
            f"{kind} of {system.name!r} must not change p, in which it wrote entries "
            f"{np.flatnonzero(given != p).tolist()}: every callback and every run gets the same parameters"
        )
    if error is not None:
        longer = np.concatenate([p, np.ones(MANY)])
        too_short = _index_error(function, t, state, longer, out) is None
        filled = ", ".join(f"{name} has shape {x.shape}" for (name, _), x in zip(KINDS[kind].outputs, out, strict=True))
        sizes = [f"{name} has {array.size} entries" for name, array in zip(KINDS[kind].state, state, strict=True)]
        raise ValueError(
            f"{kind} of {system.name!r} goes out of bounds: {error}{_place(error)}. {', '.join(sizes)}, p has "
            f"{p.size}, {filled} (n_q = {system.n_q}, n_c = {system.n_c})"
            + (". Give more `parameters`: it reads more of them than there are" if too_short else "")
        )
    system.within_bounds.add(kind)


def _index_error(function: Dispatcher, t: float, state: list[Array], p: Array, out: list[Array]) -> IndexError | None:
    """The first index out of bounds, if there is one."""
    for wrap in (_in_python, _with_bounds_checked):
        try:
            with warnings.catch_warnings(), np.errstate(all="ignore"):
                warnings.simplefilter("ignore")
                Rewritten(wrap).value(function)(
                    t, *(array.copy() for array in state), p, *(array.copy() for array in out)
                )
        except IndexError as error:
            return error
        except Exception:  # what does not run in Python may run compiled; its own errors come up when it is called
            continue
        return None
    return None


def _in_python(function: types.FunctionType) -> Any:
    return function


def _with_bounds_checked(function: types.FunctionType) -> Any:
    return njit(boundscheck=True, error_model="numpy")(function)


class Rewritten:
    """Copies of functions with other ones in the place of the compiled helpers that they name or enclose."""

    functions: tuple[type, ...] = (Dispatcher,)  # what is copied

    def __init__(self, wrap: Callable[[types.FunctionType], Any]):
        self.wrap = wrap
        self.known: dict[int, Any] = {}

    def value(self, value: Any, names: frozenset[str] = frozenset()) -> Any:
        """What stands in the place of a value; `names` are those in the code that names it."""
        if isinstance(value, self.functions):
            if id(value) not in self.known:
                self._rewrite(value)
            return self.known[id(value)]
        if type(value) is tuple:
            return tuple(self.value(each, names) for each in value)
        if isinstance(value, types.ModuleType):
            helpers = {name: vars(value).get(name) for name in names}
            helpers = {name: each for name, each in helpers.items() if isinstance(each, Dispatcher)}
            if helpers and not value.__name__.startswith("numba"):
                module = types.ModuleType(value.__name__)
                vars(module).update(vars(value) | {name: self.value(each) for name, each in helpers.items()})
                return module
        return value

    def _rewrite(self, helper: Any) -> None:
        function = getattr(helper, "py_func", helper)
        names = frozenset(names_in(function.__code__))
        cells = tuple(types.CellType() for _ in function.__closure__ or ())
        own_globals = dict(function.__globals__)
        copy = types.FunctionType(function.__code__, own_globals, function.__name__, function.__defaults__, cells)
        copy.__kwdefaults__ = function.__kwdefaults__
        self.known[id(helper)] = self.wrap(copy)  # before what it names, which may be itself
        for name in names & set(own_globals):
            own_globals[name] = self.value(own_globals[name], names)
        for cell, original in zip(cells, function.__closure__ or (), strict=True):
            cell.cell_contents = self.value(original.cell_contents, names)


def _place(error: IndexError) -> str:
    """Where in the source an error arose, where Python knows it."""
    trace = error.__traceback__
    while trace is not None and trace.tb_next is not None:
        trace = trace.tb_next
    if trace is None:
        return ""
    file, line = trace.tb_frame.f_code.co_filename, trace.tb_lineno
    source = linecache.getline(file, line).strip()
    return f", in `{source}` ({file}, line {line})" if source and file != __file__ else ""
