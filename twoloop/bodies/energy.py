"""Evaluate the kinetic energy and the potential energy of gravity and springs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from twoloop.bodies import parameter_layout as layout
from twoloop.bodies.frames import angle_of, on_grid, point_of, vector_of
from twoloop.bodies.rotation_rates import euler_product, parameters_of
from twoloop.checks.arguments import Array, check_columns


@dataclass(frozen=True, eq=False)
class PlanarEnergy:
    """Evaluate kinetic energy and potential of gravity of planar bodies, J, for one state or many."""

    masses: Array
    inertias: Array
    gravity: float

    def __call__(self, t: Any, q: Array, v: Array) -> Any:
        """Evaluate for one state, or for many given as columns."""
        q, v = np.asarray(q), np.asarray(v)
        check_columns("q", q, 3 * len(self.masses))
        check_columns("v", v, 3 * len(self.masses))
        kinetic = 0.5 * (self.masses @ (v[0::3] ** 2 + v[1::3] ** 2) + self.inertias @ v[2::3] ** 2)
        return kinetic + self.gravity * (self.masses @ q[1::3])


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
        flat, flat_v = np.asarray(q), v
        n_q = self._n * (3 if self.dimension == 2 else 7)
        check_columns("q", flat, n_q)
        check_columns("v", np.asarray(v), n_q)

        def between(i: int, at_i: int, j: int, at_j: int) -> Any:
            point_i, point_j = (self.p[k : k + self.dimension] for k in (at_i, at_j))
            return on_grid(flat, point_of(flat, j, point_j)) - on_grid(flat, point_of(flat, i, point_i))

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
        for kind, i, at_i, j, at_j, more, first_result, on_first in self._forces:
            if first_result >= 0:  # no potential is known
                continue
            if kind in (layout.HINGE_ROTOR, layout.SLIDE_ROTOR):
                total += 0.5 * self.p[more] * self._rate(flat, np.asarray(flat_v), kind, i, at_i, j, at_j) ** 2
            elif kind in (layout.SPRING, layout.ZERO_LENGTH_SPRING):
                length = np.sqrt((between(i, at_i, j, at_j) ** 2).sum(axis=0))
                total += 0.5 * self.p[more] * (length - (self.p[more + 2] if kind == layout.SPRING else 0.0)) ** 2
            elif kind == layout.TORSION_SPRING:
                total += 0.5 * self.p[more] * (self._turned(flat, i, j, at_i, at_j) - self.p[more + 2]) ** 2
            elif kind == layout.AXIAL_SPRING:
                axis = self.p[at_i : at_i + 3]
                if self.dimension == 2:
                    axis = np.array([np.cos(axis[0]), np.sin(axis[0])])
                slid = (on_grid(flat, vector_of(flat, i, axis)) * between(i, on_first, j, at_j)).sum(axis=0)
                total += 0.5 * self.p[more] * (slid - self.p[more + 2]) ** 2
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

    def _rate(self, q: Array, v: Array, kind: int, i: int, at_i: int, j: int, at_j: int) -> Any:
        """Return the rate of a joint with a rotor."""
        if self.dimension == 2:
            return angle_of(v, j) - angle_of(v, i)
        from twoloop.bodies.rotation import half_spin  # compiled on import

        def spin(body: int) -> Any:
            if body < 0:
                return np.zeros((3, *q.shape[1:]))
            e, u = (x[7 * body + 3 : 7 * body + 7] for x in (q, v))
            return 2.0 * on_grid(q, vector_of(q, body, half_spin.py_func(*e, *u)))

        def cross(a: Any, b: Any) -> Any:
            return np.cross(a, b, axis=0)

        axis = on_grid(q, vector_of(q, i, self.p[at_i : at_i + 3]))
        spins = spin(i), spin(j)
        if kind == layout.HINGE_ROTOR:
            return (axis * (spins[1] - spins[0])).sum(axis=0)
        arm = on_grid(q, vector_of(q, j, self.p[at_j : at_j + 3]))
        still = np.zeros((3, *q.shape[1:]))
        (x_i, u_i), (x_j, u_j) = (
            (still, still) if body < 0 else (q[7 * body : 7 * body + 3], v[7 * body : 7 * body + 3]) for body in (i, j)
        )
        speed = u_j + cross(spins[1], arm) - u_i - cross(spins[0], x_j + arm - x_i)
        return (axis * speed).sum(axis=0)

    def _turned(self, q: Array, i: int, j: int, axis: int, zero: int) -> Any:
        if self.dimension == 2:
            return angle_of(q, j) - angle_of(q, i)
        relative = euler_product(parameters_of(q, i, -1.0), parameters_of(q, j))
        start = self.p[zero : zero + 4]
        c, *parts = euler_product(relative, (start[0], *-start[1:]))
        s = sum(x * part for x, part in zip(self.p[axis : axis + 3], parts, strict=True))
        return 4.0 * np.arctan(s / (c + np.sqrt(c * c + s * s)))
