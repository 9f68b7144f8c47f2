"""Allocate the workspaces of runs, and keep unused ones for later runs of the same sizes."""

import math
from collections.abc import Mapping
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from twoloop.kernels.control.discontinuities import N_CHANGES, N_PARTS
from twoloop.kernels.data.common import WORK, Work
from twoloop.kernels.data.indices import N_COUNTERS, N_NOTES
from twoloop.kernels.linalg.band import N_ROUTINES
from twoloop.kernels.linalg.markowitz_lu import MAX_ENTRIES_PER_LINE, N_COUNTS, N_LISTS, index_size, values_size

# at most MAX_UNUSED unused workspaces are kept for later runs, each with at most MAX_UNUSED_SIZE floats
MAX_UNUSED, MAX_UNUSED_SIZE = 32, 100_000
WORD, LINE = 8, 8  # WORD: bytes in a number; LINE: numbers in a cache line. Arrays begin at the start of a cache line


class FixedOrderSizes(NamedTuple):
    """Sizes of arrays that only the fixed-order form uses."""

    n_factors: int
    n_mass_values: int
    n_jacobian_values: int
    dense_mass: bool  # True: M varies, and its entries are copied from a full matrix, which a callback fills
    dense_jacobian: bool  # True: the entries of C_q are copied from a full matrix, which a callback fills


# arguments of _create_layout: numbers of coordinates, of constraints C = 0, of non-holonomic constraints A v + b = 0;
# ranks of C_q and of [C_q; A]; whether to allocate arrays of the null-space form; whether to allocate arrays of the
# augmented form; length of the array `nodes`; FixedOrderSizes, or None in other forms; length of the array `matrices`
Sizes = tuple[int, int, int, int, int, bool, bool, int, FixedOrderSizes | None, int]
ArrayRanges = list[tuple[str, int, int, tuple[int, ...]]]  # for each array: name, first offset, end, shape


class Layout(NamedTuple):
    """Offsets of the arrays of a workspace, which consists of a block of floats and a block of integers.

    Kernels receive a table of the addresses and shapes of the arrays. In `table`, an offset (bytes) within a block
    stands for each address: the address of the block of floats must be added where `of_numbers` is 1, and that of the
    block of integers where `of_integers` is 1; both are 0 elsewhere. The first `n_lasting` floats and
    `n_lasting_integers` integers keep data from one step to the next; a step fills all others before it reads them.
    """

    numbers: ArrayRanges
    integers: ArrayRanges
    n_numbers: int
    n_integers: int
    n_lasting: int
    n_lasting_integers: int
    table: NDArray[np.int64]
    of_numbers: NDArray[np.int64]
    of_integers: NDArray[np.int64]


def empty_workspace(sizes: Sizes) -> Work:
    """Return a workspace of `sizes` in its initial state: a new one, or one that a previous run no longer needs."""
    unused = _take_unused_workspace(sizes)
    return _allocate_workspace(sizes) if unused is None else reset_workspace(unused)


def copy_workspace(work: Work) -> Work:
    """Return a workspace with copies of the arrays of `work` that keep data from one step to the next."""
    sizes = work.sizes
    duplicate = _take_unused_workspace(sizes) or _allocate_workspace(sizes)
    for target, source in zip(lasting_arrays(duplicate), lasting_arrays(work), strict=True):
        target[:] = source
    duplicate.changes[:] = 0.0
    return duplicate


def lasting_arrays(work: Work) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Return views of the floats and of the integers of a workspace that keep data from one step to the next."""
    layout = _create_layout(*work.sizes)
    return work.notes.base[: layout.n_lasting], work.counters.base[: layout.n_lasting_integers]


def _take_unused_workspace(sizes: Sizes) -> Work | None:
    unused = _unused_workspaces.get(sizes)
    try:
        return unused.pop() if unused else None
    except IndexError:  # another thread has taken the last workspace of these sizes
        return None


def _allocate_workspace(sizes: Sizes) -> Work:
    layout = _create_layout(*sizes)
    numbers, integers = np.zeros(layout.n_numbers), np.zeros(layout.n_integers, dtype=np.int64)
    arrays: dict[str, Any] = {name: numbers[a:b].reshape(shape) for name, a, b, shape in layout.numbers}
    arrays |= {name: integers[a:b].reshape(shape) for name, a, b, shape in layout.integers}
    arrays["G_of_S"][:] = np.nan
    table = layout.table + layout.of_numbers * numbers.ctypes.data + layout.of_integers * integers.ctypes.data
    return Work(**arrays, sizes=sizes, table=table, address=table.ctypes.data)


def keep_unused_workspace(work: Work) -> None:
    """Keep a small workspace for later runs. If more than MAX_UNUSED are kept, discard those used longest ago."""
    unused = _unused_workspaces.pop(work.sizes, [])
    if work.notes.base.size <= MAX_UNUSED_SIZE and len(unused) < MAX_UNUSED:
        unused.append(work)
    # insert these sizes at the end of the dictionary. The sizes used longest ago, at its beginning, are discarded first
    _unused_workspaces[work.sizes] = unused
    for oldest in list(_unused_workspaces)[:-1]:
        if sum(map(len, list(_unused_workspaces.values()))) <= MAX_UNUSED:
            break
        _unused_workspaces.pop(oldest, None)


_unused_workspaces: dict[Sizes, list[Work]] = {}  # for each combination of sizes, the list of unused workspaces


def reset_workspace(work: Work) -> Work:
    """Reset a workspace in place to its state after allocation, and return it."""
    for view in lasting_arrays(work):
        view[:] = 0
    work.G_of_S[:] = np.nan
    return work


@cache
def cached_run() -> Any:
    """Return the module `cached_run`; the first call imports it, and compiles it or reads it from the disk."""
    from twoloop.kernels import cached_run

    return cached_run


def _fixed_order_shapes(n_q: int, n_c: int, rank: int, form: FixedOrderSizes) -> tuple[dict[str, tuple[int, ...]], ...]:
    """Return {name: shape} of float arrays, and of integer arrays, that have special shapes in the fixed-order form.

    The fixed-order form has no partition. All coordinates are listed as independent. They are also listed as dependent,
    because steps compare predicted and projected positions of the dependent coordinates.
    """
    n, n_redundant = n_q + n_c, n_c - rank
    n_rows = n_c if form.dense_jacobian else 0
    mass_side = n_q if form.dense_mass else 0
    matrices = dict.fromkeys(("L", "S", "W", "A", "MT", "Gx", "G_of_S"), (0, 0))
    empty_vectors = dict.fromkeys(("values", "values_v", "values_a", "right"), (0,))
    numbers: dict[str, tuple[int, ...]] = {
        "augmented": ((n_rows + 1) * n_q * form.dense_jacobian + mass_side * mass_side,),
        **matrices,
        **empty_vectors,
        "D": (n_q + 1, 0),
        "pattern": (n_rows, n_q),
        "mass_pattern": (mass_side, mass_side),
        "z": (n_c,),
        "minimum": ((form.n_factors + n + n_q) * (n_redundant > 0),),
        "predicted": (n_q,),
        "mass_values": (form.n_mass_values,),
        "jacobian_values": (form.n_jacobian_values,),
        "is_independent": (n_c,),
        "factors": (form.n_factors,),
        "pivot_sizes": (n,),
        "unknowns": (n,),
        "solutions": (3 * n + n_c,),
    }
    integers: dict[str, tuple[int, ...]] = {
        "row_entries": (n_c + 1,),
        **{"rows": (rank,), "dependent": (n_q,), "independent": (n_q,), "index": (index_size(0),)},
        **dict.fromkeys(("rows_v", "dependent_v", "independent_v"), (0,)),  # velocities use the arrays of positions
        **dict.fromkeys(("index_v", "index_a"), (index_size(0),)),
    }
    return numbers, integers


@cache
def _create_layout(
    n_q: int,
    n_c: int,
    n_a: int,
    r: int,
    r_v: int,
    reduced: bool,
    augmented: bool,
    n_nodes: int,
    fixed_order: FixedOrderSizes | None,
    n_matrices: int,
) -> Layout:
    """Return the `Layout` of a workspace; the arguments are the numbers of `Sizes`."""
    n_rows = n_c + n_a
    n_redundant = n_rows - r_v
    n_dof = n_q - r_v if reduced else 0
    n_augmented = n_q + r_v if augmented else 0
    n_entries = (n_rows + 1) * n_q
    numbers: dict[str, tuple[int, ...]] = {
        "augmented": (n_entries + n_q * n_q,),  # must be the first array; `entries`, `G` and `M` are parts of it
        "L": (n_q, n_q),
        "S": (r_v, r_v),
        "W": (r_v, n_q),
        "A": (n_dof, n_dof),
        "MT": (n_q, n_dof),
        "D": (n_q - r_v + 1, r_v),
        "Gx": (n_rows, n_q),
        "G_of_S": (n_rows, n_q),
        "pattern": (n_rows, n_q),
        "mass_pattern": (n_q, n_q) if augmented else (0, 0),
        "Gamma_tried": (2, n_rows),
        "rates": (N_PARTS + 1, n_rows),
        "changes": (N_CHANGES, n_q + n_rows),
        **dict.fromkeys(("Q", "x", "y"), (n_q,)),
        "C": (n_c,),
        **dict.fromkeys(("Rate", "Gamma", "g", "lam"), (n_rows,)),
        "z": (r_v,),
        "minimum": (n_redundant * (r_v + n_redundant + 1),),
        "values": (values_size(r),),
        "values_v": (values_size(r_v),),
        "values_a": (values_size(n_augmented, may_be_dense=False),),
        "right": (2 * n_augmented,),
        "predicted": (r,),
        "notes": (N_NOTES,),
        "nodes": (n_nodes,),
        **dict.fromkeys(("mass_values", "jacobian_values", "is_independent", "factors", "pivot_sizes"), (0,)),
        **dict.fromkeys(("unknowns", "solutions"), (0,)),
        "matrices": (n_matrices,),  # must be the last array: it is scratch, which is not copied with a workspace
    }
    integers: dict[str, tuple[int, ...]] = {
        "row_entries": (n_rows + 1 + n_rows * n_q,),
        **{"rows": (r,), "dependent": (r,), "independent": (n_q - r,)},
        **{"rows_v": (r_v,), "dependent_v": (r_v,), "independent_v": (n_q - r_v,), "index_v": (index_size(r_v),)},
        "index_a": (index_size(n_augmented),),
        "order": (n_q,),
        "row_order": (n_rows,),
        "counters": (N_COUNTERS,),
        "lapack": (N_ROUTINES,),
        "index": (index_size(r),),  # must be the last array: its end is scratch, which is not copied
    }
    rows_of_G, mass_side = n_rows + 1, n_q
    if fixed_order is not None:
        fixed_order_shapes = _fixed_order_shapes(n_q, n_c, r, fixed_order)
        numbers |= fixed_order_shapes[0]
        integers |= fixed_order_shapes[1]
        rows_of_G, mass_side = (n_rows + 1) * fixed_order.dense_jacobian, n_q * fixed_order.dense_mass
        n_entries = rows_of_G * n_q
    # without non-holonomic constraints, the arrays for positions also serve for velocities (names that end in _v)
    of_positions = {name for name in integers if n_a == 0 and f"{name}_v" in integers}
    for name in of_positions:
        del integers[f"{name}_v"]
    if n_a == 0:
        del numbers["values_v"]
    of_numbers, n_numbers = _array_ranges(numbers)
    of_integers, n_integers = _array_ranges(integers)
    of_numbers["entries"], of_numbers["G"] = (0, n_entries, (n_entries,)), (0, n_entries, (rows_of_G, n_q))
    of_numbers["M"] = n_entries, n_entries + mass_side * mass_side, (mass_side, mass_side)
    # the last integers of `index` are scratch for the choice of an elimination order, and keep no data between steps
    n_ordering = (N_COUNTS + N_LISTS * min(r, MAX_ENTRIES_PER_LINE)) * r if fixed_order is None else 0
    n_lasting = of_numbers["matrices"][0], of_integers["index"][1] - n_ordering
    if n_a == 0:
        of_numbers["values_v"] = of_numbers["values"]
        of_integers |= {f"{name}_v": of_integers[name] for name in of_positions}
    table = np.zeros(WORK.n_words, dtype=np.int64)
    masks = np.zeros((2, WORK.n_words), dtype=np.int64)
    for mask, ranges in zip(masks, (of_numbers, of_integers), strict=True):
        for name, (begin, _, shape) in ranges.items():
            word = WORK.offsets[name]
            table[word], mask[word] = WORD * begin, 1
            table[word + 1 : word + 1 + len(shape)] = shape
    named_ranges = [[(name, *entry) for name, entry in ranges.items()] for ranges in (of_numbers, of_integers)]
    return Layout(named_ranges[0], named_ranges[1], n_numbers, n_integers, *n_lasting, table, masks[0], masks[1])


def _array_ranges(shapes: Mapping[str, tuple[int, ...]]) -> tuple[dict[str, tuple[int, int, tuple[int, ...]]], int]:
    """Return {name: (first offset, end, shape)} of arrays that begin at cache lines, and the length of their block."""
    ranges, end = {}, 0
    for name, shape in shapes.items():
        size = math.prod(shape)
        ranges[name] = end, end + size, shape
        end += -(-size // LINE) * LINE
    return ranges, end
