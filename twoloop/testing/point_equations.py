"""Equations of point masses on massless links; a row is half the squared length of a link."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from twoloop.testing.known_parts import GROUND, Array, KnownBody, KnownJoint

Place = int | tuple[float, ...]  # index of a point, or a ground point


class PointEquations:
    """Point masses in the plane or in space with links of fixed length and springs.

    Parameters
    ----------
    mass : array_like (n_points,) or (n_points, n_points)
        Masses of the points, kg; a matrix for the consistent mass of bars between them.
    weight : array_like (n_points, n_axes)
        Constant force on each point, N.
    links : sequence of (place, place, float)
        Ends, each the index of a point or a ground point, and the length, m.
    springs : sequence of (place, place, float, float)
        Ends, stiffness in N/m and unstressed length in m.
    """

    def __init__(
        self,
        mass: ArrayLike,
        weight: ArrayLike,
        links: Sequence[tuple[Place, Place, float]],
        springs: Sequence[tuple[Place, Place, float, float]] = (),
    ):
        self.weight = np.asarray(weight, dtype=float)
        n_points, n_axes = self.weight.shape
        masses = np.asarray(mass, dtype=float)
        self._points_alone = masses.ndim == 1 and not springs
        self._mass = np.kron(np.diag(masses) if masses.ndim == 1 else masses, np.eye(n_axes))
        self.n_q, self.coordinates = n_points * n_axes, n_points * ("x", "y", "z")[:n_axes]
        self.n_c, self.row_powers = len(links), [2.0] * len(links)
        self._across, self._from = self._differences([link[:2] for link in links])
        self._links, self._lengths = links, np.array([link[2] for link in links])
        self._spring_across, self._spring_from = self._differences([spring[:2] for spring in springs])
        self._stiffness = np.array([spring[2] for spring in springs])
        self._unstressed = np.array([spring[3] for spring in springs])

    @property
    def parameters(self) -> dict[str, ArrayLike]:
        """Return the constants as `KnownProblem.parameters`; of bars, their lengths and masses are in M."""
        n_axes = self.weight.shape[1]
        told: dict[str, ArrayLike] = {"masses": self._mass[::n_axes, ::n_axes], "lengths": self._lengths}
        if np.count_nonzero(told["masses"]) == len(self.weight):
            told["masses"] = np.diag(self._mass)[::n_axes]
        if self._stiffness.size:
            told |= {"spring_stiffnesses": self._stiffness, "spring_lengths": self._unstressed}
        return told | {"gravity": self.weight[0] / self._mass.sum(axis=0)[0]}

    @property
    def parts(self) -> dict[str, Any]:
        """Return points, links and gravity as arguments of `KnownProblem`, if these make up the whole problem."""
        if not self._points_alone or type(self) is not PointEquations:
            return {}
        n_points, n_axes = self.weight.shape
        masses, at = np.diag(self._mass)[::n_axes], np.zeros(n_axes)
        columns = [slice(k * n_axes, (k + 1) * n_axes) for k in range(n_points)]
        joints = []
        for k, (i, j, length) in enumerate(self._links):
            ends = [(end, at) if isinstance(end, int) else (GROUND, np.array(end)) for end in (i, j)]
            pair, points = zip(*ends, strict=True)
            joints.append(KnownJoint("distance", pair, points, slice(k, k + 1), length=length))
        bodies = tuple(KnownBody(float(m), np.zeros(0), own) for m, own in zip(masses, columns, strict=True))
        return {"bodies": bodies, "joints": tuple(joints), "gravity": self.weight[0] / masses[0]}

    def _differences(self, pairs: Sequence[tuple[Place, Place]]) -> tuple[Array, Array]:
        """Return D (n, n_axes, n_q) and d (n, n_axes) such that D q + d are the vectors between the ends."""
        n_points, n_axes = self.weight.shape
        across, start = np.zeros((len(pairs), n_axes, n_points, n_axes)), np.zeros((len(pairs), n_axes))
        for k, ends in enumerate(pairs):
            for end, sign in zip(ends, (1.0, -1.0), strict=True):
                if isinstance(end, tuple):
                    start[k] += sign * np.array(end)
                else:
                    across[k, :, end, :] += sign * np.eye(n_axes)
        return across.reshape(len(pairs), n_axes, n_points * n_axes), start

    def mass(self, t: float, q: Array) -> Array:
        """Return M (n_q, n_q)."""
        return self._mass.copy()

    def force(self, t: float, q: Array, v: Array) -> Array:
        """Return Q (n_q,): weights and springs."""
        total = self.weight.ravel().copy()
        if self._stiffness.size:
            arms = self._spring_across @ q + self._spring_from
            lengths = np.linalg.norm(arms, axis=1)
            pulls = -self._stiffness * (lengths - self._unstressed) / lengths
            total += np.einsum("k,ka,kaq->q", pulls, arms, self._spring_across)
        return total

    def constraint(self, t: float, q: Array) -> Array:
        """Return C (n_c,)."""
        arms = self._across @ q + self._from
        return 0.5 * ((arms**2).sum(axis=1) - self._lengths**2)

    def jacobian(self, t: float, q: Array) -> Array:
        """Return C_q (n_c, n_q)."""
        arms = self._across @ q + self._from
        return (arms[:, None, :] @ self._across)[:, 0, :]

    def constraint_rate(self, t: float, q: Array) -> Array:
        """Return C_t (n_c,), zero."""
        return np.zeros(self.n_c)

    def gamma(self, t: float, q: Array, v: Array) -> Array:
        """Return the right-hand side (n_c,) of C_q a = gamma."""
        return -((self._across @ v) ** 2).sum(axis=1)

    def energy(self, t: float, q: Array, v: Array) -> float:
        """Return the kinetic and potential energy, J."""
        total = 0.5 * v @ self._mass @ v - self.weight.ravel() @ q
        if self._stiffness.size:
            lengths = np.linalg.norm(self._spring_across @ q + self._spring_from, axis=1)
            total += 0.5 * self._stiffness @ (lengths - self._unstressed) ** 2
        return float(total)


class ShakenPoints(PointEquations):
    """Points, the last of which is excited along x by amplitude sin(frequency t)."""

    def __init__(self, amplitude: float, frequency: float, *arguments: Any):
        super().__init__(*arguments)
        self._amplitude, self._frequency = amplitude, frequency

    @property
    def parameters(self) -> dict[str, ArrayLike]:
        """Return the constants, and those of the excitation."""
        return super().parameters | {"force_amplitude": self._amplitude, "force_frequency": self._frequency}

    def force(self, t: float, q: Array, v: Array) -> Array:
        """Return Q (n_q,)."""
        total = super().force(t, q, v)
        total[-self.weight.shape[1]] += self._amplitude * np.sin(self._frequency * t)
        return total


class DrivenPoint(PointEquations):
    """A point on a link with prescribed height y = y0 + rate t; no solution beyond the length of the link."""

    def __init__(self, length: float, height: float, rate: float, gravity: float):
        super().__init__([1.0], [[0.0, -gravity]], [(0, (0.0, 0.0), length)])
        self.n_c, self.row_powers, self._height, self._rate = 2, [2.0, 1.0], height, rate

    @property
    def parameters(self) -> dict[str, ArrayLike]:
        """Return the constants, and those of the drive."""
        return super().parameters | {"drive_height": self._height, "drive_rate": self._rate}

    def constraint(self, t: float, q: Array) -> Array:
        """Return C (2,)."""
        return np.append(super().constraint(t, q), q[1] - self._height - self._rate * t)

    def jacobian(self, t: float, q: Array) -> Array:
        """Return C_q (2, 2)."""
        return np.vstack([super().jacobian(t, q), [0.0, 1.0]])

    def constraint_rate(self, t: float, q: Array) -> Array:
        """Return C_t (2,)."""
        return np.array([0.0, -self._rate])

    def gamma(self, t: float, q: Array, v: Array) -> Array:
        """Return the right-hand side (2,) of C_q a = gamma."""
        return np.append(super().gamma(t, q, v), 0.0)


class EndingForce(PointEquations):
    """Points with a drag proportional to the square root of the remaining time, NaN beyond."""

    def __init__(self, ends: float, *arguments: Any):
        super().__init__(*arguments)
        self._ends = ends

    def force(self, t: float, q: Array, v: Array) -> Array:
        """Return Q (n_q,)."""
        with np.errstate(invalid="ignore"):
            return super().force(t, q, v) - np.sqrt(self._ends - t) * v
