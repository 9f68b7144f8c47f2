"""The workspace of a run, allocated once."""

from typing import Any

import numpy as np

from twoloop.kernels.algebra.elimination import index_size, values_size
from twoloop.kernels.algebra.lapack import N_ROUTINES
from twoloop.kernels.data.common import N_COUNTERS, N_NOTES, WORK, Work
from twoloop.kernels.evaluation.kinks import PARTS


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
    everything = np.zeros(n_entries + n_q * n_q)

    def integers(n: int) -> Any:
        return np.zeros(n, dtype=np.int64)

    def sets(r: int) -> list[Any]:
        return [integers(r), integers(r), integers(n_q - r), integers(index_size(r)), np.zeros(values_size(r))]

    positions = sets(r)
    velocities = positions if n_a == 0 else sets(r_v)
    names = ("rows", "dependent", "independent", "index", "values")
    work = Work(
        M=everything[n_entries:].reshape((n_q, n_q)),
        L=np.zeros((n_q, n_q)),
        G=everything[:n_entries].reshape((n_rows + 1, n_q)),
        entries=everything[:n_entries],
        augmented=everything,
        S=np.zeros((r_v, r_v)),
        W=np.zeros((r_v, n_q)),
        A=np.zeros((n_dof, n_dof)),
        MT=np.zeros((n_q, n_dof)),
        D=np.zeros((n_q - r_v + 1, r_v)),
        Gx=np.zeros((n_rows, n_q)),
        G_of_S=np.full((n_rows, n_q), np.nan),
        pattern=np.zeros((n_rows, n_q)),
        mass_pattern=np.zeros((n_q, n_q) if augmented else (0, 0)),
        places=integers(n_rows + 1 + n_rows * n_q),
        Gamma_tried=np.zeros((2, n_rows)),
        rates=np.zeros((PARTS + 1, n_rows)),
        Q=np.zeros(n_q),
        x=np.zeros(n_q),
        y=np.zeros(n_q),
        C=np.zeros(n_c),
        Rate=np.zeros(n_rows),
        Gamma=np.zeros(n_rows),
        g=np.zeros(n_rows),
        z=np.zeros(r_v),
        lam=np.zeros(n_rows),
        minimum=np.zeros(n_redundant * (r_v + n_redundant + 1)),
        **dict(zip(names, positions, strict=True)),
        **{f"{name}_v": array for name, array in zip(names, velocities, strict=True)},
        index_a=integers(index_size(size)),
        values_a=np.zeros(values_size(size, may_be_dense=False)),
        right=np.zeros(2 * size),
        order=integers(n_q),
        row_order=integers(n_rows),
        counters=integers(N_COUNTERS),
        lapack=integers(N_ROUTINES),
        predicted=np.zeros(r),
        notes=np.zeros(N_NOTES),
        nodes=np.zeros(n_nodes),
    )
    table = WORK.table(work)
    return work._replace(table=table, address=table.ctypes.data)
