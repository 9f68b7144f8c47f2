"""Evaluate the kinetic energy and the potential energy of gravity and springs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from twoloop.bodies import parameter_layout as layout
from twoloop.bodies.frames import point_of
from twoloop.checks.arguments import Array, check_columns

ROTORS = layout.HINGE_ROTOR, layout.SLIDE_ROTOR


def planar_energy(masses: Array, inertias: Array, gravity: float, t: Any, q: Array, v: Array) -> Any:
    """Return kinetic energy and potential of gravity of planar bodies, J, at one state, or at many given as columns."""
    q, v = np.asarray(q), np.asarray(v)
    check_columns("q", q, 3 * len(masses))
    check_columns("v", v, 3 * len(masses))
    kinetic = 0.5 * (masses @ (v[0::3] ** 2 + v[1::3] ** 2) + inertias @ v[2::3] ** 2)
    return kinetic + gravity * (masses @ q[1::3])


@dataclass(frozen=True, eq=False)
class ModelEnergy:
    """Evaluate kinetic energy and potential energies of gravity and springs, J, for one state or many.

    Attributes
    ----------
    p : ndarray (n_p,)
        Parameter vector of the model.
    dimension : int
        2 or 3.
    potentials : tuple of callable
        Potential energies, J, of springs that are functions of q, such as those of tendons.
    """

    p: Array
    dimension: int
    potentials: tuple[Callable[[Any], Any], ...] = ()

    def __call__(self, t: Any, q: Array, v: Array) -> Any:
        """Evaluate the energies of one state, or of many given as columns."""
        flat, flat_v = np.asarray(q), np.asarray(v)
        n_q = self._n * (3 if self.dimension == 2 else 7)
        check_columns("q", flat, n_q)
        check_columns("v", flat_v, n_q)
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
            from twoloop.bodies.rotation import half_spin  # compiled on import

            spins = 2.0 * np.stack(
                half_spin.py_func(*np.moveaxis(q[:, 3:], 1, 0), *np.moveaxis(v[:, 3:], 1, 0)), axis=1
            )
            total += 0.5 * np.einsum("ijk,ij...,ik...->...", J, spins, spins)
        for force in self._forces:
            kind, i, at_i, j, at_j, more, first_result, _ = force
            if first_result >= 0:  # no potential is known
                continue
            if kind in ROTORS:
                total += 0.5 * self.p[more] * self._coordinate(force).rate(flat, flat_v) ** 2
            elif kind in (layout.SPRING, layout.ZERO_LENGTH_SPRING):
                points = ((i, at_i), (j, at_j))
                ends = (point_of(flat, body, self.p[at : at + self.dimension]) for body, at in points)
                length = np.sqrt(sum((x - y) ** 2 for x, y in zip(*ends, strict=True)))
                total += 0.5 * self.p[more] * (length - (self.p[more + 2] if kind == layout.SPRING else 0.0)) ** 2
            elif kind in (layout.TORSION_SPRING, layout.AXIAL_SPRING):
                total += 0.5 * self.p[more] * (self._coordinate(force).position(flat) - self.p[more + 2]) ** 2
        return total + sum(potential(flat) for potential in self.potentials)

    @property
    def _n(self) -> int:
        return int(self.p[self.p.size - layout.HEAD + layout.BODIES])

    @property
    def _forces(self) -> Any:
        head = self.p[self.p.size - layout.HEAD :].astype(int)
        first, n = head[layout.FORCES], head[layout.N_FORCES]
        table = self.p[first : first + layout.FORCE_WIDTH * n].reshape(-1, layout.FORCE_WIDTH).astype(int)
        return table.tolist()

    def _coordinate(self, force: list[int]) -> Any:
        """Return the coordinate of the joint in which a spring or a rotor acts."""
        from twoloop.bodies.coordinates import Displacement, PlanarAngle, SpatialAngle  # slow to import

        kind, i, at_i, j, at_j, _, _, on_first = force
        turns, d = kind in (layout.TORSION_SPRING, layout.HINGE_ROTOR), self.dimension
        if turns and d == 2:
            return PlanarAngle("", "angle", i, j, 0.0)
        axis = self.p[at_i : at_i + 3] if d == 3 else np.array([np.cos(self.p[at_i]), np.sin(self.p[at_i])])
        if turns:
            return SpatialAngle("", "angle", i, j, tuple(axis), tuple(self.p[at_j : at_j + 4]))
        point_a = self.p[on_first : on_first + d] if on_first >= 0 else np.zeros(d)  # the rate is that of any point
        return Displacement("", "displacement", i, j, tuple(axis), tuple(point_a), tuple(self.p[at_j : at_j + d]))
