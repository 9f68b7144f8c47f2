"""Compile common callbacks of mechanisms with constant mass and force and quadratic constraints.

Points and vectors fixed to bodies as coordinates ("natural" coordinates) give such constraints. A row is a constant and
a sum of products c a b of two scalars: a and b are affine functions of q, such as the difference of two coordinates.
Products are not expanded: far from the origin, the squares of coordinates would cancel.

The callbacks are compiled once for all mechanisms; the parameters hold the terms, which `QuadraticSystem` collects::

    p = [n_c, number of entries of the mass, number of products, force (n_q,), constants (n_c,),
         (i, j, m)..., (row, c, begin of a, end of a, begin of b, end of b)..., scalars]

The begin and end of a scalar are indices in p; the scalar is its constant and pairs (i, coefficient).
"""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np

from twoloop.bodies.frames import linear_points
from twoloop.kernels.compile.caches import helper
from twoloop.kernels.compile.callbacks import callback
from twoloop.problem.callbacks import callbacks_in
from twoloop.problem.description import Drawing, Joint
from twoloop.problem.problem import Array
from twoloop.problem.system import ConstrainedSystem

Scalar = Mapping[int | None, float]  # coordinate to coefficient; None: a constant
ONE: Scalar = {None: 1.0}


@helper
def offsets(n_q, p):
    """Return the indices in p of the constants, the mass entries and the products, and the end of the products."""
    constants = 3 + n_q
    entries = constants + int(p[0])
    products = entries + 3 * int(p[1])
    return constants, entries, products, products + 6 * int(p[2])


@helper
def linear_part(p, begin, end, x):
    """Return the scalar in p[begin:end] at x, without its constant."""
    total = 0.0
    for k in range(begin + 1, end, 2):
        total += p[k + 1] * x[int(p[k])]
    return total


@callback("mass")
def mass(t, q, p, M):
    first = offsets(q.size, p)[1]
    for k in range(first, first + 3 * int(p[1]), 3):
        M[int(p[k]), int(p[k + 1])] = p[k + 2]


@callback("force")
def force(t, q, v, p, Q):
    for i in range(q.size):
        Q[i] = p[3 + i]


@callback("constraint")
def constraint(t, q, p, C):
    constants, _, products, end = offsets(q.size, p)
    for row in range(C.size):
        C[row] = p[constants + row]
    for k in range(products, end, 6):
        a, a_end, b, b_end = int(p[k + 2]), int(p[k + 3]), int(p[k + 4]), int(p[k + 5])
        C[int(p[k])] += p[k + 1] * (linear_part(p, a, a_end, q) + p[a]) * (linear_part(p, b, b_end, q) + p[b])


@callback("jacobian")
def jacobian(t, q, p, Cq):
    _, _, products, end = offsets(q.size, p)
    for k in range(products, end, 6):
        row, a, a_end, b, b_end = int(p[k]), int(p[k + 2]), int(p[k + 3]), int(p[k + 4]), int(p[k + 5])
        by_a = p[k + 1] * (linear_part(p, b, b_end, q) + p[b])
        by_b = p[k + 1] * (linear_part(p, a, a_end, q) + p[a])
        for m in range(a + 1, a_end, 2):
            Cq[row, int(p[m])] += by_a * p[m + 1]
        for m in range(b + 1, b_end, 2):
            Cq[row, int(p[m])] += by_b * p[m + 1]


@callback("gamma")
def gamma(t, q, v, p, Qd):
    _, _, products, end = offsets(q.size, p)
    for k in range(products, end, 6):
        a, a_end, b, b_end = int(p[k + 2]), int(p[k + 3]), int(p[k + 4]), int(p[k + 5])
        Qd[int(p[k])] -= 2.0 * p[k + 1] * linear_part(p, a, a_end, v) * linear_part(p, b, b_end, v)


def _energy(mass: Array, force: Array, t: Any, q: Array, v: Array) -> Any:
    """Return kinetic energy with a constant mass and potential of a constant force, J, for one state or many."""
    q, v = np.asarray(q), np.asarray(v)
    return 0.5 * np.einsum("i...,ij,j...->...", v, mass, v) - force @ q


class QuadraticSystem:
    """Collect the rows of a mechanism.

    Parameters
    ----------
    mass : ndarray (n_q, n_q)
        Constant and symmetric.
    force : ndarray (n_q,)
        Constant.

    Examples
    --------
    >>> import numpy as np
    >>> from twoloop.mechanisms.quadratic import QuadraticSystem, fixed, point
    >>> rows = QuadraticSystem(np.eye(2), np.array([0.0, -9.81]))
    >>> rows.distance(point(0), fixed(0.0, 0.0), 1.0)  # a pendulum of 1 m
    0
    >>> rows.system("pendulum").n_c
    1
    """

    def __init__(self, mass: Array, force: Array):
        self.mass, self.force = np.asarray(mass, dtype=float), np.asarray(force, dtype=float)
        self.joints: list[Joint] = []
        self._lines: list[tuple[Sequence[Scalar], Sequence[Scalar]]] = []
        self._constants: list[float] = []
        self._products: list[tuple[int, float, Scalar, Scalar]] = []

    def row(self, *products: tuple[float, Scalar, Scalar]) -> int:
        """Add a row: the sum of c a b over the products (c, a, b) of two scalars is zero; return its number."""
        number = len(self._constants)
        self._constants.append(sum(c * a[None] * b[None] for c, a, b in products if a.keys() == b.keys() == {None}))
        self._products += [(number, *each) for each in products if not each[1].keys() == each[2].keys() == {None}]
        return number

    def distance(self, first: Sequence[Scalar], second: Sequence[Scalar], length: float) -> int:
        """Add a row: half the squared distance of two points, each a list of scalars, is half the squared length."""
        self.line(second, first)
        parts = [(0.5, difference(a, b), difference(a, b)) for a, b in zip(first, second, strict=True)]
        return self.row(*parts, (-0.5 * length**2, ONE, ONE))

    def line(self, first: Sequence[Scalar], second: Sequence[Scalar]) -> None:
        """Add a line between two points to the drawing; `distance` and `link` draw theirs."""
        self._lines.append((first, second))

    def link(self, name: str, i: int, other: Sequence[Scalar], length: float) -> int:
        """Add a row and a joint of this name: point mass q[i], q[i + 1] keeps its distance from another point."""
        row = self.distance(point(i), other, length)
        self.joints.append(Joint(name, (row,), (i, i + 1)))
        return row

    def system(self, name: str, bandwidth: int | None = None) -> ConstrainedSystem:
        """Return the system of the rows so far."""
        entries = [(i, j, self.mass[i, j]) for i, j in np.argwhere(self.mass)]
        sizes = [len(self._constants), len(entries), len(self._products)]
        head = np.concatenate([sizes, self.force, self._constants, np.ravel(entries)])
        end = len(head) + 6 * len(self._products)
        places: list[float] = []
        scalars: list[float] = []
        for row, c, *factors in self._products:
            places += [row, c]
            for scalar in factors:
                pairs = [(i, a) for i, a in scalar.items() if i is not None and a != 0.0]
                scalars += [scalar.get(None, 0.0), *np.ravel(pairs)]
                begin, end = end, end + 1 + 2 * len(pairs)
                places += [begin, end]
        return ConstrainedSystem(
            n_q=self.force.size,
            n_c=len(self._constants),
            **callbacks_in(globals()),
            parameters=np.concatenate([head, places, scalars]),
            constant_mass=True,
            bandwidth=bandwidth,
            joints=self.joints,
            name=name,
        )

    @property
    def energy(self) -> Callable[..., Any]:
        """Return the energy as a function of t, q and v."""
        return partial(_energy, self.mass, self.force)

    def drawing(self, *traced: Sequence[Scalar]) -> Drawing:
        """Return the lines so far, and the paths of the points given."""
        points: list[Sequence[Scalar]] = []

        def index(position: Sequence[Scalar]) -> int:
            if position not in points:
                points.append(position)
            return points.index(position)

        bars = tuple((index(first), index(second)) for first, second in self._lines)
        traces = tuple(index(position) for position in traced)
        matrix = np.zeros((len(points), len(points[0]), self.force.size))
        constant = np.zeros(matrix.shape[:2])
        for k, position in enumerate(points):
            for axis, scalar in enumerate(position):
                constant[k, axis] = scalar.get(None, 0.0)
                for i, coefficient in scalar.items():
                    if i is not None:
                        matrix[k, axis, i] = coefficient
        return Drawing(partial(linear_points, matrix, constant), bars, traces)


def difference(a: Scalar, b: Scalar) -> Scalar:
    """Return the scalar a - b."""
    result = dict(a)
    for place, value in b.items():
        result[place] = result.get(place, 0.0) - value
    return result


def point(i: int) -> list[Scalar]:
    """Return the planar point with coordinates q[i], q[i + 1]."""
    return [{i: 1.0}, {i + 1: 1.0}]


def fixed(*position: float) -> list[Scalar]:
    """Return a point or vector of the ground."""
    return [{None: float(x)} for x in position]
