"""Checks of single callbacks: indices within the bounds of arrays, values of entries, a symmetric mass matrix.

An index out of bounds in machine code would read or write other memory. So each callback first runs once in Python,
with its compiled helpers, where an index that is too large raises `IndexError`. Helpers that cannot run in Python are
compiled again with numba's own check. Branches that this call does not take are not checked.
"""

from __future__ import annotations

import linecache
import types
import warnings
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np
from numba import njit

from twoloop.checks.arguments import Array
from twoloop.kernels.compile.callbacks import KINDS
from twoloop.kernels.compile.dependencies import FunctionCopier, is_library, is_twoloop
from twoloop.kernels.compile.linking import Dispatcher

if TYPE_CHECKING:
    from twoloop.problem.system import ConstrainedSystem


OWN_MODULES = {
    *("twoloop.checks.callbacks", "twoloop.generate.graph", "twoloop.generate.trace"),
    *("twoloop.generate.parameter_expressions", "twoloop.bodies.system"),
}
# after an index error, this many numbers are appended to `parameters`: if the error vanishes, the array was too short
N_APPENDED = 4096


def check_bounds(system: ConstrainedSystem, t: float, q: Array, v: Array) -> None:
    """Run every compiled callback of a system once at (t, q, v) with bounds checked; later calls do nothing.

    If a system gives values of entries, large dense matrices are left out, and checked before their first use. Raise
    ValueError if an index is out of bounds; the message names the callback, the index and the sizes of arrays.
    """
    if len(system.within_bounds) == len(KINDS):
        return
    state = {"q": q, "v": v, "lam": np.ones(system.n_c)}
    for kind, entry in KINDS.items():
        if kind in system.entries and system.n_q * (system.n_q if kind == "mass" else system.n_c) > MAX_ENTRIES:
            continue
        check_callback(system, kind, t, [state[name] for name in entry.state])


def check_callback(system: ConstrainedSystem, kind: str, t: float, state: list[Array]) -> None:
    """Run one callback with bounds checked, as `check_bounds` does for all of them."""
    if system.called_in_python or kind in system.within_bounds:
        return
    if kind not in system.given and kind != "jacobian":  # a substitute of twoloop, which calls no user function
        system.within_bounds.add(kind)
        return
    function, p, out = getattr(system.functions, kind), system.parameters, system.arrays_of(kind)
    changed: list[int] = []
    error = _index_error(function, t, state, p, out, changed)
    if changed:
        names = " and ".join([*KINDS[kind].state, "p"][i] for i in changed)
        raise ValueError(
            f"{kind} of {system.name!r} must not change the arrays that it is given: it changes {names}. Copy first"
        )
    if error is not None:
        longer = np.concatenate([p, np.ones(N_APPENDED)])
        too_short = _index_error(function, t, state, longer, out) is None
        filled = ", ".join(f"{name} has shape {x.shape}" for (name, _), x in zip(KINDS[kind].outputs, out, strict=True))
        sizes = [f"{name} has {array.size} entries" for name, array in zip(KINDS[kind].state, state, strict=True)]
        raise ValueError(
            f"{kind} of {system.name!r} goes out of bounds: {error}{source_location(error)}. {', '.join(sizes)}, p has "
            f"{p.size}, {filled} (n_q = {system.n_q}, n_c = {system.n_c})"
            + (". Give more `parameters`: it reads more of them than there are" if too_short else "")
        )
    system.within_bounds.add(kind)


def _index_error(
    function: Dispatcher, t: float, state: list[Array], p: Array, out: list[Array], changed: list[int] | None = None
) -> IndexError | None:
    """Return the first index error, or None; append the indices of changed arrays (`state`, then `p`) to `changed`."""
    for wrap in (_leave_in_python, _compile_with_bounds_checks):
        given = [array.copy() for array in (*state, p)]
        try:
            with warnings.catch_warnings(), np.errstate(all="ignore"):
                warnings.simplefilter("ignore")
                is_own = wrap is _leave_in_python and is_twoloop(function.__module__ or "")
                copy = _own_callback_in_python(function) if is_own else FunctionCopier(wrap).replacement_of(function)
                copy(t, *given, *(np.zeros(array.shape) for array in out))
        except IndexError as error:
            return error
        except Exception:  # the callback may only run compiled; its own errors are raised when it is called later
            continue
        if changed is not None:
            changed += [
                i for i, (one, other) in enumerate(zip(given, (*state, p), strict=True)) if (one != other).any()
            ]
        return None
    return None


def _leave_in_python(function: types.FunctionType, _: Any) -> Any:
    return function


@lru_cache(256)
def _own_callback_in_python(function: Dispatcher) -> Any:
    """Return a copy of a callback of twoloop, cached for all systems because its globals never change."""
    return FunctionCopier(_leave_in_python).replacement_of(function)


def _compile_with_bounds_checks(function: types.FunctionType, _: Any) -> Any:
    return njit(boundscheck=True, error_model="numpy")(function)


def source_location(error: BaseException) -> str:
    """Return, as text, the line and the file of the callback that caused an error; "" if Python does not know them."""
    trace, frames = error.__traceback__, []
    while trace is not None:
        module = trace.tb_frame.f_globals.get("__name__") or ""
        if module not in OWN_MODULES and not is_library(module):
            frames.append((trace.tb_frame.f_code.co_filename, trace.tb_lineno))
        trace = trace.tb_next
    if not frames:
        return ""
    file, line = frames[-1]
    source = linecache.getline(file, line).strip()
    return f", in `{source}` ({file}, line {line})" if source else ""


SAME = 1e-11  # largest difference between equal callbacks, relative to the largest entry
MAX_ENTRIES = 4_000_000  # largest number of entries of a dense matrix that is allocated for a comparison
UNSYMMETRIC = 1e-10  # largest difference of M from its transpose, relative to max|M|, that counts as rounding


def wrong_values(system: ConstrainedSystem, t: float, q: Array) -> str | None:
    """Describe where `mass_values` or `jacobian_values` differ from the dense callbacks, or return None.

    Matrices of more than `MAX_ENTRIES` entries are not compared, because no run of such a system uses them.
    """
    for kind, (rows, columns) in system.entries.items():
        if kind in system.scattered or system.n_q * (system.n_q if kind == "mass" else system.n_c) > MAX_ENTRIES:
            continue
        dense, values = system.evaluate(kind, t, q), system.evaluate(f"{kind}_values", t, q)
        level = SAME * max(float(dense.max(initial=0.0)), -float(dense.min(initial=0.0)))
        np.subtract.at(dense, (rows, columns), values)
        off = np.abs(dense, out=dense)
        if not off.max(initial=0.0) > level:
            continue
        i, j = (int(each) for each in np.unravel_index(int(off.argmax()), off.shape))
        given = float(values[(rows == i) & (columns == j)].sum())
        return (
            f"{kind}_values of {system.name!r} does not give what {kind} gives: entry {(i, j)} is {given:.9g} and "
            f"{float(system.evaluate(kind, t, q)[i, j]):.9g} (near t = {t:.10g}). Correct the values, or name the "
            f"entry in {kind}_entries, or leave one of the two callbacks out"
        )
    return None


def unsymmetric_mass(system: ConstrainedSystem, t: float, q: Array) -> str | None:
    """Describe the entry of M that differs from its transpose, or return None."""
    if "mass" in system.entries:
        i, j, one, other = _largest_of_values(system, t, q)
    else:
        i, j, one, other = _largest_of_matrix(system.mass(t, q))
    if one == other:
        return None
    return (
        f"mass of {system.name!r} must be symmetric; at t = {t:.10g} its entry {(i, j)} is {one:.9g} and its "
        f"entry {(j, i)} is {other:.9g}"
    )


def _largest_of_matrix(mass: Array) -> tuple[int, int, float, float]:
    """Return indices and both values of the entry that differs most from its transpose; zeros if that is rounding."""
    off = np.abs(mass - mass.T)
    if not off.max() > UNSYMMETRIC * np.abs(mass).max():
        return 0, 0, 0.0, 0.0
    i, j = sorted(int(each) for each in np.unravel_index(int(off.argmax()), off.shape))
    return i, j, mass[i, j], mass[j, i]


def _largest_of_values(system: ConstrainedSystem, t: float, q: Array) -> tuple[int, int, float, float]:
    """Return the result of `_largest_of_matrix`, computed from the values of the entries."""
    (rows, columns), values = system.entries["mass"], system.mass_values(t, q)
    where, other = rows * system.n_q + columns, columns * system.n_q + rows
    places = np.unique(where)  # entries in both triangles
    one = np.bincount(np.searchsorted(places, where), values, len(places))
    two = np.bincount(np.searchsorted(places, other), values, len(places))
    off = np.abs(one - two)
    if not off.max(initial=0.0) > UNSYMMETRIC * np.abs(one).max(initial=0.0):
        return 0, 0, 0.0, 0.0
    k = int(off.argmax())
    i, j = int(places[k] // system.n_q), int(places[k] % system.n_q)
    return (i, j, one[k], two[k]) if i < j else (j, i, two[k], one[k])
