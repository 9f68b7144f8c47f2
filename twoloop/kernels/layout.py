"""The workspace of a run, allocated once."""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from twoloop.kernels.algebra.elimination import index_size, values_size
from twoloop.kernels.algebra.lapack import N_ROUTINES
from twoloop.kernels.data.common import N_COUNTERS, N_NOTES, WORK, Work
from twoloop.kernels.evaluation.kinks import PARTS

WORD, LINE = 8, 8  # bytes of a number, and numbers in a line of the cache, at which arrays begin


def make_work(
    n_q: int,
    n_c: int,
    n_a: int = 0,
    rank: int | None = None,
    rank_v: int | None = None,
    reduced: bool = True,
    augmented: bool = False,
    n_nodes: int = 0,
) -> Work:
    """Allocate the workspace of one run; ranks are those of C_q, and of C_q and A, at most n_c and n_c + n_a."""
    n_rows = n_c + n_a
    r = min(n_c, n_q) if rank is None else rank
    r_v = min(n_rows, n_q) if rank_v is None else rank_v
    n_redundant = n_rows - r_v
    n_dof = n_q - r_v if reduced else 0
    size = n_q + r_v if augmented else 0
    n_entries = (n_rows + 1) * n_q
    numbers: dict[str, tuple[int, ...]] = {
        "augmented": (n_entries + n_q * n_q,),
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
        "rates": (PARTS + 1, n_rows),
        **dict.fromkeys(("Q", "x", "y"), (n_q,)),
        "C": (n_c,),
        **dict.fromkeys(("Rate", "Gamma", "g", "lam"), (n_rows,)),
        "z": (r_v,),
        "minimum": (n_redundant * (r_v + n_redundant + 1),),
        "values": (values_size(r),),
        "values_v": (values_size(r_v),),
        "values_a": (values_size(size, may_be_dense=False),),
        "right": (2 * size,),
        "predicted": (r,),
        "notes": (N_NOTES,),
        "nodes": (n_nodes,),
    }
    integers: dict[str, tuple[int, ...]] = {
        "places": (n_rows + 1 + n_rows * n_q,),
        **{"rows": (r,), "dependent": (r,), "independent": (n_q - r,), "index": (index_size(r),)},
        **{"rows_v": (r_v,), "dependent_v": (r_v,), "independent_v": (n_q - r_v,), "index_v": (index_size(r_v),)},
        "index_a": (index_size(size),),
        "order": (n_q,),
        "row_order": (n_rows,),
        "counters": (N_COUNTERS,),
        "lapack": (N_ROUTINES,),
    }
    arrays, addresses = _allocated(numbers, np.float64)
    of_integers, more = _allocated(integers, np.int64)
    arrays, addresses = arrays | of_integers, addresses | more
    everything, begin = arrays["augmented"], addresses["augmented"]
    arrays["entries"], arrays["G"] = everything[:n_entries], everything[:n_entries].reshape((n_rows + 1, n_q))
    arrays["M"] = everything[n_entries:].reshape((n_q, n_q))
    addresses |= {"entries": begin, "G": begin, "M": begin + WORD * n_entries}
    if n_a == 0:
        for name in ("rows", "dependent", "independent", "index", "values"):
            arrays[f"{name}_v"], addresses[f"{name}_v"] = arrays[name], addresses[name]
    arrays["G_of_S"][:] = np.nan
    work = Work(**arrays)
    table = WORK.table(work, addresses)
    return work._replace(table=table, address=table.ctypes.data)


def _allocated(shapes: Mapping[str, tuple[int, ...]], dtype: type) -> tuple[dict[str, Any], dict[str, int]]:
    """Arrays of zeros in one piece of memory, and their addresses: NumPy takes a microsecond to tell that of one."""
    sizes = {name: math.prod(shape) for name, shape in shapes.items()}
    everything: Any = np.zeros(sum(-(-size // LINE) * LINE for size in sizes.values()), dtype=dtype)
    place, begin = 0, everything.ctypes.data
    arrays, addresses = {}, {}
    for name, size in sizes.items():
        arrays[name], addresses[name] = everything[place : place + size].reshape(shapes[name]), begin + WORD * place
        place += -(-size // LINE) * LINE
    return arrays, addresses
