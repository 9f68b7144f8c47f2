"""Where the entries of Newton's matrix of a large system are, and its program."""

import numpy as np
from numpy.typing import NDArray

from twoloop.checks.at_position import NEARBY
from twoloop.kernels.linalg.sparse_lu import groups_of, in_groups, newton_program
from twoloop.kernels.linalg.symbolic_factorization import N_UPDATES, Entries
from twoloop.problem.system import ConstrainedSystem

Array = NDArray[np.float64]

DISPLACED = 1e-3  # relative to max(1, |value|): coordinates and velocities, to see what they change
SPARSE = 0.2  # of the multiplications of dense factors: a program with more of them is not worth its indices


def newton_form(
    system: ConstrainedSystem,
    t0: float,
    q0: Array,
    mass: Entries,
    jacobian: Entries,
    together: list[tuple[int, ...]],
    stiff: list[int],
) -> tuple[NDArray[np.int32], int] | None:
    """The program of Newton's matrix, see sparse_lu.py, and the number of groups of columns that are differenced.

    None where it is not sparse, or cannot be found.
    """
    found: set[tuple[int, int]] = set()
    rng = np.random.default_rng(9)
    size, lam = max(1.0, float(np.abs(q0).max())), rng.uniform(0.5, 1.5, system.n_c)
    most = SPARSE * system.n_q**2
    for share in NEARBY[:2]:
        q = q0 + share * size * rng.uniform(-1.0, 1.0, system.n_q)
        try:
            found |= _entries(system, t0, q, rng.uniform(-1.0, 1.0, system.n_q), lam, most)
        except Exception:  # outside what the callbacks are made for; what is missed is found on the way
            continue
        if len(found) > most:
            return None
    places = np.array(sorted(found), dtype=np.int64).reshape(-1, 2)
    tangents = in_groups((places[:, 0], places[:, 1]), system.n_q)
    program = newton_program(system.n_q, system.n_c, mass, jacobian, tangents, together, stiff)
    if program is None or program[N_UPDATES] > SPARSE * system.n_q**3 / 3.0:
        return None
    return program, int(groups_of(tangents, system.n_q).max(initial=-1)) + 1


def _entries(system: ConstrainedSystem, t: float, q: Array, v: Array, lam: Array, most: float) -> set[tuple[int, int]]:
    """Where Q - C_q^T lam changes with a coordinate, and Q with a velocity, and the same mirrored."""

    def reaction(q: Array) -> Array:
        if "jacobian" not in system.entries:
            return lam @ system.jacobian(t, q)
        rows, columns = system.entries["jacobian"]
        return np.bincount(columns, system.jacobian_values(t, q) * lam[rows], len(q)).astype(np.float64)

    force, of_rows = system.force(t, q, v), reaction(q)
    found: set[tuple[int, int]] = set()
    for j in range(len(q)):
        moved, faster = q.copy(), v.copy()
        moved[j] += DISPLACED * max(1.0, abs(q[j]))
        faster[j] += DISPLACED * max(1.0, abs(v[j]))
        changed = (system.force(t, moved, v) != force) | (reaction(moved) != of_rows)
        changed |= system.force(t, q, faster) != force
        for i in np.flatnonzero(changed).tolist():
            found |= {(i, j), (j, i)}
        if len(found) > most:
            break
    return found
