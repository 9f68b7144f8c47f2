"""Compile common callbacks of planar mechanisms with pins, distances and drives.

Coordinates are x, y of the centre of mass and the angle of each body.

The callbacks are compiled once for all of them; the parameters hold the joints, which `PlanarBodies` collects::

    p = [number of bodies, of joints, gravity along -y, (m, J)..., (kind, row, i, ax, ay, j, bx, by, value)...]

A joint ties the point (ax, ay) of body i, in the body's axes from its centre, to the point (bx, by) of body j; the
ground is body -1.
"""

import math
from collections.abc import Callable, Sequence
from functools import partial
from itertools import count
from typing import Any

import numpy as np

from twoloop.bodies.drawings import Sketch
from twoloop.bodies.energy import planar_energy
from twoloop.bodies.geometry import merged
from twoloop.kernels.compile.caches import helper
from twoloop.kernels.compile.callbacks import callback
from twoloop.problem.callbacks import LARGE, callbacks_in
from twoloop.problem.description import Drawing, Joint
from twoloop.problem.problem import Array
from twoloop.problem.system import ConstrainedSystem

PIN = 0.0  # both points coincide: two rows
DISTANCE = 1.0  # half the squared distance of the points is `value`: one row
COORDINATE = 2.0  # q[i] = ax + ay t + bx sin(by t): one row
N_NUMBERS = 9  # of a joint
GROUND = -1


@helper
def place(q, body, p, at):
    """Return the point of a body stored at index `at` of p and its derivative by the angle: x, y, dx, dy."""
    a, b = p[at], p[at + 1]
    if body < 0:
        return a, b, 0.0, 0.0
    s, c = math.sin(q[3 * body + 2]), math.cos(q[3 * body + 2])
    x, y = c * a - s * b, s * a + c * b
    return q[3 * body] + x, q[3 * body + 1] + y, -y, x


@helper
def motion(v, body, dx, dy):
    """Return the velocity of a point and the part of its acceleration without v'; (dx, dy): derivative by the angle."""
    if body < 0:
        return 0.0, 0.0, 0.0, 0.0
    w = v[3 * body + 2]
    return v[3 * body] + w * dx, v[3 * body + 1] + w * dy, -w * w * dy, w * w * dx


@helper
def add(row, body, fx, fy, dx, dy):
    """Add to a row (n_q,) the derivative of fx x + fy y of a point, i.e. the generalised force of (fx, fy) there."""
    if body >= 0:
        row[3 * body] += fx
        row[3 * body + 1] += fy
        row[3 * body + 2] += fx * dx + fy * dy


@callback("mass")
def mass(t, q, p, M):
    for body in range(int(p[0])):
        M[3 * body, 3 * body] = M[3 * body + 1, 3 * body + 1] = p[3 + 2 * body]
        M[3 * body + 2, 3 * body + 2] = p[4 + 2 * body]


@callback("force")
def force(t, q, v, p, Q):
    for body in range(int(p[0])):
        Q[3 * body + 1] = -p[2] * p[3 + 2 * body]


@merged
def fill_rows(t, q, v, p, C, Cq, Ct, Qd):
    """Evaluate those of C, C_q, C_t and gamma that are not None."""
    first = 3 + 2 * int(p[0])
    for k in range(first, first + N_NUMBERS * int(p[1]), N_NUMBERS):
        row, i, j = int(p[k + 1]), int(p[k + 2]), int(p[k + 5])
        if p[k] == COORDINATE:
            frequency = p[k + 7]
            if C is not None:
                C[row] = q[i] - p[k + 3] - p[k + 4] * t - p[k + 6] * math.sin(frequency * t)
            if Cq is not None:
                Cq[row, i] = 1.0
            if Ct is not None:
                Ct[row] = -p[k + 4] - p[k + 6] * frequency * math.cos(frequency * t)
            if Qd is not None:
                Qd[row] = -p[k + 6] * frequency**2 * math.sin(frequency * t)
            continue
        ax, ay, adx, ady = place(q, i, p, k + 3)
        bx, by, bdx, bdy = place(q, j, p, k + 6)
        is_pin = p[k] == PIN
        if C is not None:
            if is_pin:
                C[row], C[row + 1] = ax - bx, ay - by
            else:
                C[row] = 0.5 * ((ax - bx) ** 2 + (ay - by) ** 2) - p[k + 8]
        if Cq is not None:
            if is_pin:
                add(Cq[row], i, 1.0, 0.0, adx, ady)
                add(Cq[row], j, -1.0, 0.0, bdx, bdy)
                add(Cq[row + 1], i, 0.0, 1.0, adx, ady)
                add(Cq[row + 1], j, 0.0, -1.0, bdx, bdy)
            else:
                add(Cq[row], i, ax - bx, ay - by, adx, ady)
                add(Cq[row], j, bx - ax, by - ay, bdx, bdy)
        if Qd is not None:
            au, av, aa, ab = motion(v, i, adx, ady)
            bu, bv, ba, bb = motion(v, j, bdx, bdy)
            if is_pin:
                Qd[row], Qd[row + 1] = ba - aa, bb - ab
            else:
                squares = (bu - au) * (au - bu) + (bv - av) * (av - bv)
                Qd[row] = squares + (ax - bx) * (ba - aa) + (ay - by) * (bb - ab)


@callback("constraint")
def constraint(t, q, p, C):
    fill_rows(t, q, q, p, C, None, None, None)


@callback("jacobian")
def jacobian(t, q, p, Cq):
    fill_rows(t, q, q, p, None, Cq, None, None)


@callback("constraint_rate")
def constraint_rate(t, q, p, Ct):
    fill_rows(t, q, q, p, None, None, Ct, None)


@callback("gamma")
def gamma(t, q, v, p, Qd):
    fill_rows(t, q, v, p, None, None, None, Qd)


@callback("kinematics")
def kinematics(t, q, v, p, C, Cq, Ct, Qd):
    fill_rows(t, q, v, p, C, Cq, Ct, Qd)


@callback("mass_values")
def mass_values(t, q, p, values):
    for body in range(int(p[0])):
        values[3 * body] = values[3 * body + 1] = p[3 + 2 * body]
        values[3 * body + 2] = p[4 + 2 * body]


@callback("jacobian_values")
def jacobian_values(t, q, p, values):
    first, index = 3 + 2 * int(p[0]), 0
    for k in range(first, first + N_NUMBERS * int(p[1]), N_NUMBERS):
        i, j = int(p[k + 2]), int(p[k + 5])
        if p[k] == COORDINATE:
            values[index] = 1.0
            index += 1
            continue
        ax, ay, adx, ady = place(q, i, p, k + 3)
        bx, by, bdx, bdy = place(q, j, p, k + 6)
        fx, fy = ax - bx, ay - by
        for body, sign, dx, dy in ((i, 1.0, adx, ady), (j, -1.0, bdx, bdy)):
            if body < 0:
                continue
            if p[k] == PIN:
                values[index], values[index + 1] = sign, sign * dx
                values[index + 2], values[index + 3] = sign, sign * dy
                index += 4
            else:
                values[index], values[index + 1] = sign * fx, sign * fy
                values[index + 2] = sign * (fx * dx + fy * dy)
                index += 3


def jacobian_entries(joints: Sequence[Sequence[float]]) -> tuple[list[int], list[int]]:
    """Return rows and columns of the entries of `jacobian_values`, in order."""
    rows, columns = [], []
    for kind, first, i, _, _, j, *_ in joints:
        row = int(first)
        if kind == COORDINATE:
            rows.append(row)
            columns.append(int(i))
            continue
        for body in (int(i), int(j)):
            if body == GROUND:
                continue
            x, y, angle = range(3 * body, 3 * body + 3)
            rows += [row, row, row + 1, row + 1] if kind == PIN else [row] * 3
            columns += [x, angle, y, angle] if kind == PIN else [x, y, angle]
    return rows, columns


class PlanarBodies:
    """Collect planar bodies and joints, which are named by kind and bodies: "pin rod-ground".

    Parameters
    ----------
    names : sequence of str
        Names of the bodies.
    masses, inertias : sequence of float
        kg, and kg m^2 about the centre of mass.
    gravity : float
        m/s^2, along -y.

    Examples
    --------
    >>> from twoloop.mechanisms.planar import PlanarBodies
    >>> bodies = PlanarBodies(["crank", "rod"], masses=[1.0, 2.0], inertias=[0.1, 0.2])
    >>> len(bodies.names)
    2
    """

    def __init__(self, names: Sequence[str], masses: Any, inertias: Any, gravity: float = 9.81):
        self.names = tuple(names)
        self.masses, self.inertias = np.asarray(masses, dtype=float), np.asarray(inertias, dtype=float)
        self.gravity, self.n_c = gravity, 0
        self._joints: list[list[float]] = []
        self._named: dict[str, Joint] = {}
        self.pins: list[tuple[int, tuple[float, float], int, tuple[float, float]]] = []

    def _add(
        self, kind: float, rows: int, numbers: list[float], name: str, body: int, point: tuple[float, float]
    ) -> int:
        first = 3 * body
        numbered = tuple(range(self.n_c, self.n_c + rows))
        if name in self._named:
            name = next(new for k in count(2) if (new := f"{name} {k}") not in self._named)
        self._named[name] = Joint(name, numbered, (first, first + 1), (first + 2,), point)
        self._joints.append([kind, float(self.n_c), *numbers])
        self.n_c += rows
        return self.n_c - rows

    def _between(
        self, kind: str, i: int, a: tuple[float, float], j: int, b: tuple[float, float]
    ) -> tuple[str, int, tuple[float, float]]:
        """Return the name of a joint, the body on which it acts (i, or j if i is the ground), and its point there."""
        body, other, point = (j, i, b) if i == GROUND else (i, j, a)
        return f"{kind} {self.names[body]}-{'ground' if other == GROUND else self.names[other]}", body, point

    def pin(self, i: int, a: tuple[float, float], j: int, b: tuple[float, float]) -> int:
        """Add two rows: point a of body i coincides with point b of body j (or of the ground); return the first row."""
        self.pins.append((i, a, j, b))
        return self._add(PIN, 2, [i, *a, j, *b, 0.0], *self._between("pin", i, a, j, b))

    def distance(self, i: int, a: tuple[float, float], j: int, b: tuple[float, float], length: float) -> int:
        """Add one row: the points are `length` apart."""
        return self._add(DISTANCE, 1, [i, *a, j, *b, 0.5 * length**2], *self._between("distance", i, a, j, b))

    def drive(
        self, coordinate: int, start: float, rate: float = 0.0, amplitude: float = 0.0, frequency: float = 0.0
    ) -> int:
        """Add one row: a coordinate is start + rate t + amplitude sin(frequency t); by default it is constant."""
        body, part = divmod(coordinate, 3)
        name = f"drive of {('x', 'y', 'angle')[part]} of {self.names[body]}"
        numbers = [coordinate, start, rate, GROUND, amplitude, frequency, 0.0]
        return self._add(COORDINATE, 1, numbers, name, body, (0.0, 0.0))

    def system(self, name: str) -> ConstrainedSystem:
        """Return the system of the joints added so far."""
        bodies = np.column_stack([self.masses, self.inertias])
        sizes = [len(bodies), len(self._joints), self.gravity]
        driven_by_time = any(joint[0] == COORDINATE and (joint[4] or joint[6]) for joint in self._joints)
        n_q = 3 * len(bodies)
        callbacks: dict[str, Any] = callbacks_in(globals())
        if not driven_by_time:
            del callbacks["constraint_rate"]
        if n_q >= LARGE:
            callbacks |= {"mass_entries": (range(n_q), range(n_q)), "jacobian_entries": jacobian_entries(self._joints)}
            del callbacks["kinematics"]  # which fills a full matrix
        else:
            del callbacks["mass_values"], callbacks["jacobian_values"]
        parameters = np.concatenate([sizes, bodies.ravel(), np.ravel(self._joints)])
        options: dict[str, Any] = {"constant_mass": True, "joints": list(self._named.values()), "name": name}
        return ConstrainedSystem(n_q=n_q, n_c=self.n_c, parameters=parameters, **callbacks, **options)

    @property
    def energy(self) -> Callable[..., Any]:
        """Return the energy as a function of t, q and v."""
        return partial(planar_energy, self.masses, self.inertias, self.gravity)

    @property
    def drawing(self) -> Drawing:
        """Return bodies as lines between their pins; with one pin a uniform rod, or a square if it is at the centre."""
        sketch = Sketch()
        ends: list[list[tuple[float, float]]] = [[] for _ in self.names]
        for i, a, j, b in self.pins:
            for body, point in ((i, a), (j, b)):
                if body == GROUND:
                    sketch.point(body, point)
                elif point not in ends[body]:
                    ends[body].append(point)
        for body, points in enumerate(ends):
            side = np.sqrt(6.0 * self.inertias[body] / self.masses[body])  # of the square of that inertia
            sketch.add_body(body, points, -1.0, (side, side))
        for i, a, j, _ in self.pins:
            if GROUND not in (i, j):
                sketch.trace(i, a)
        return sketch.drawing


def states(*bodies: tuple[complex, float]) -> Array:
    """Return the coordinates (3 n,) of bodies, or their velocities, each given as x + i y and an angle."""
    return np.array([[z.real, z.imag, angle] for z, angle in bodies]).ravel()
