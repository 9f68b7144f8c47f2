"""Whether values of entries belong to the dense matrices beside them, and M has them on both sides."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from twoloop.checks.arguments import Array

if TYPE_CHECKING:
    from twoloop.problem.system import ConstrainedSystem


SAME = 1e-11  # relative: values that two callbacks must share
MOST = 4_000_000  # numbers of a dense matrix that is made for a comparison
UNSYMMETRIC = 1e-10  # of the largest entry of M, by which entries that must be the same may differ


def wrong_values(system: ConstrainedSystem, t: float, q: Array) -> str | None:
    """Say where `mass_values` or `jacobian_values` do not give what dense callbacks beside them give, or None.

    Matrices of more than `MOST` numbers are not made: no run of such a system asks for them.
    """
    for kind, (rows, columns) in system.entries.items():
        if kind in system.scattered or system.n_q * (system.n_q if kind == "mass" else system.n_c) > MOST:
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
    """Say which entry of M is not that of its transpose, or None."""
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
    """The entry that differs most from that of the transpose, and both; (0, 0, 0.0, 0.0) where that is rounding."""
    off = np.abs(mass - mass.T)
    if not off.max() > UNSYMMETRIC * np.abs(mass).max():
        return 0, 0, 0.0, 0.0
    i, j = sorted(int(each) for each in np.unravel_index(int(off.argmax()), off.shape))
    return i, j, mass[i, j], mass[j, i]


def _largest_of_values(system: ConstrainedSystem, t: float, q: Array) -> tuple[int, int, float, float]:
    """The same from the entries."""
    (rows, columns), values = system.entries["mass"], system.mass_values(t, q)
    where, other = rows * system.n_q + columns, columns * system.n_q + rows
    places = np.unique(where)  # of both triangles
    one = np.bincount(np.searchsorted(places, where), values, len(places))
    two = np.bincount(np.searchsorted(places, other), values, len(places))
    off = np.abs(one - two)
    if not off.max(initial=0.0) > UNSYMMETRIC * np.abs(one).max(initial=0.0):
        return 0, 0, 0.0, 0.0
    k = int(off.argmax())
    i, j = int(places[k] // system.n_q), int(places[k] % system.n_q)
    return (i, j, one[k], two[k]) if i < j else (j, i, two[k], one[k])
