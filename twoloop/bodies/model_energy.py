"""Energy of a model: kinetic energy, and potential energy of gravity and springs."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from twoloop.bodies import parameter_layout as layout
from twoloop.checks.arguments import Array, check_columns


@dataclass(frozen=True, eq=False)
class ModelEnergy:
    """Kinetic energy and potential energies of gravity and springs, J, for one state or many.

    Attributes
    ----------
    p : ndarray (n_p,)
        Parameter vector of the model.
    dimension : int
        2 or 3.
    """

    p: Array
    dimension: int

    def __call__(self, t: Any, q: Array, v: Array) -> Any:
        """Evaluate the energies of one state, or of many given as columns."""
        from twoloop.bodies.points import direction_of, place_of  # compiled on import

        flat = np.asarray(q)
        n_q = self._n * (3 if self.dimension == 2 else 7)
        check_columns("q", flat, n_q)
        check_columns("v", np.asarray(v), n_q)

        def between(i: int, at: int, j: int, there: int) -> Any:
            here, end = (self.p[k : k + self.dimension] for k in (at, there))
            return place_of(flat, j, end) - place_of(flat, i, here)

        q, v = (np.asarray(x).reshape(self._n, -1, *np.shape(x)[1:]) for x in (q, v))
        size = layout.PLANAR_BODY if self.dimension == 2 else layout.SPATIAL_BODY
        bodies = self.p[self.dimension : self.dimension + size * self._n].reshape(-1, size)
        masses, gravity = bodies[:, 0], self.p[: self.dimension]
        total = 0.5 * np.einsum("i,ij...->...", masses, v[:, : self.dimension] ** 2)
        total -= np.einsum("i,j,ij...->...", masses, gravity, q[:, : self.dimension])
        if self.dimension == 2:
            total += 0.5 * np.einsum("i,i...->...", bodies[:, 1], v[:, 2] ** 2)
        else:
            J = bodies[:, [1, 4, 5, 4, 2, 6, 5, 6, 3]].reshape(-1, 3, 3)
            spins = _spins(q[:, 3:], v[:, 3:])
            total += 0.5 * np.einsum("ijk,ij...,ik...->...", J, spins, spins)
        for kind, i, at, j, there, more, given, on_first in self._forces:
            if given >= 0:  # no potential is known
                continue
            if kind in (layout.SPRING, layout.PULL):
                length = np.sqrt((between(i, at, j, there) ** 2).sum(axis=0))
                total += 0.5 * self.p[more] * (length - (self.p[more + 2] if kind == layout.SPRING else 0.0)) ** 2
            elif kind == layout.TORSION:
                total += 0.5 * self.p[more] * (self._turned(q, i, j, at, there) - self.p[more + 2]) ** 2
            elif kind == layout.RAIL:
                axis = self.p[at : at + 3]
                if self.dimension == 2:
                    axis = np.array([np.cos(axis[0]), np.sin(axis[0])])
                slid = (direction_of(flat, i, axis) * between(i, on_first, j, there)).sum(axis=0)
                total += 0.5 * self.p[more] * (slid - self.p[more + 2]) ** 2
        return total

    @property
    def _n(self) -> int:
        return int(self.p[self.p.size - layout.HEAD + layout.BODIES])

    @property
    def _forces(self) -> Any:
        head = self.p[self.p.size - layout.HEAD :].astype(int)
        first, n = head[layout.FORCES], head[layout.N_FORCES]
        table = self.p[first : first + layout.FORCE_WIDTH * n].reshape(-1, layout.FORCE_WIDTH).astype(int)
        return table.tolist()

    def _turned(self, q: Array, i: int, j: int, axis: int, zero: int) -> Any:
        if self.dimension == 2:
            return (q[j, 2] if j >= 0 else 0.0) - (q[i, 2] if i >= 0 else 0.0)
        from twoloop.bodies.spatial_places import product  # compiled on import

        one, other = (q[body, 3:] if body >= 0 else (1.0, 0.0, 0.0, 0.0) for body in (i, j))
        relative = product.py_func(one[0], -one[1], -one[2], -one[3], *other)
        start = self.p[zero : zero + 4]
        c, *parts = product.py_func(*relative, start[0], *-start[1:])
        s = sum(x * part for x, part in zip(self.p[axis : axis + 3], parts, strict=True))
        return 4.0 * np.arctan(s / (c + np.sqrt(c * c + s * s)))


def _spins(e: Array, u: Array) -> Array:
    """Return angular velocities in body axes, (n, 3) or (n, 3, n_t)."""
    from twoloop.bodies.rotation import half_spin  # compiled on import

    return 2.0 * np.stack(half_spin.py_func(*np.moveaxis(e, 1, 0), *np.moveaxis(u, 1, 0)), axis=1)
