"""Mechanisms with known motions: bodies, joints, equations as functions of numpy arrays, start and reference."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Drive = tuple[Callable[[float], float], Callable[[float], float], Callable[[float], float]]
GROUND = -1


@dataclass(frozen=True, eq=False)
class KnownBody:
    """A point mass, or a rigid body with its centre of mass as reference.

    Attributes
    ----------
    mass : float
        kg.
    inertia : ndarray (0,), (1,) or (3,)
        kg m^2: empty for a point, the moment in the plane, or the principal moments in body axes.
    columns : slice
        Its coordinates in q: centre of mass, then an angle or four Euler parameters.

    Examples
    --------
    >>> from twoloop.testing import problems
    >>> problem = next(each for each in problems() if each.bodies)
    >>> problem.bodies[0].mass > 0.0
    True
    """

    mass: float
    inertia: Array
    columns: slice


@dataclass(frozen=True, eq=False)
class KnownJoint:
    """A joint between two bodies, or a body and the ground.

    Attributes
    ----------
    kind : str
        "revolute", "spherical" (both bodies share a point), "distance" (of two points), "prismatic" (in the plane: a
        point of the body stays on a line of the ground, and its angle is constant) or "drive" (the angle of the first
        body is a function of time).
    bodies : (int, int)
        Indices in `KnownProblem.bodies`; -1 is the ground.
    points : (ndarray, ndarray)
        Point on each body in body axes, relative to its centre; on the ground in space, m.
    rows : slice
        Its rows of C.
    axis : ndarray or None
        Direction in the axes of the second body: of a spatial hinge, (3,), or of the line of a slider, (2,).
    length : float or None
        Length of a distance, m.
    motion : tuple of callable or None
        The angle of a drive as a function of time, rad, and its first two derivatives.

    Examples
    --------
    >>> from twoloop.testing import problems
    >>> problem = next(each for each in problems() if each.joints)
    >>> len(problem.joints[0].bodies)
    2
    """

    kind: str
    bodies: tuple[int, int]
    points: tuple[Array, Array]
    rows: slice
    axis: Array | None = None
    length: float | None = None
    motion: Drive | None = None


def skew(a: Array) -> Array:
    """Return the matrix of the cross product with a vector (3,)."""
    return np.array([[0.0, -a[2], a[1]], [a[2], 0.0, -a[0]], [-a[1], a[0], 0.0]])


def rotate(e: Array, a: Array) -> Array:
    """Return R(e) a, a quadratic form in the Euler parameters (4,)."""
    u = e[1:]
    return (e[0] ** 2 - u @ u) * a + 2.0 * u * (u @ a) + 2.0 * e[0] * np.cross(u, a)


def rotate_jacobian(e: Array, a: Array) -> Array:
    """Return the derivative (3, 4) of R(e) a with respect to the Euler parameters, which is linear in these."""
    u = e[1:]
    by_u = (u @ a) * np.eye(3) + np.outer(u, a) - np.outer(a, u) - e[0] * skew(a)
    return 2.0 * np.column_stack([e[0] * a + np.cross(u, a), by_u])


def rate_matrix(e: Array) -> Array:
    """Return G (3, 4): the angular velocity in body axes is 2 G e'."""
    return np.column_stack([-e[1:], e[0] * np.eye(3) - skew(e[1:])])


def euler_parameters(R: Array) -> Array:
    """Return the Euler parameters (4,) of a rotation matrix, computed from the largest one, with e0 >= 0."""
    products = np.empty((4, 4))
    products[0, 0], products[1:, 1:] = 1.0 + np.trace(R), R + R.T + (1.0 - np.trace(R)) * np.eye(3)
    products[0, 1:] = products[1:, 0] = R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]
    best = products[int(np.argmax(np.diag(products)))]
    return best / np.linalg.norm(best) * (1.0 if best[0] >= 0.0 else -1.0)


Quantity = Callable[[float, Array, Array], float]
DIMENSIONS = {  # of parameters: powers of the units of length and mass; the unit of time is s
    **{"masses": (0, 1), "inertias": (2, 1), "gravity": (1, 0), "lengths": (1, 0), "spring_stiffnesses": (0, 1)},
    **{"spring_lengths": (1, 0), "force_amplitude": (1, 1), "force_frequency": (0, 0), "drive_height": (1, 0)},
    **{"drive_rate": (1, 0), "torque": (2, 1)},
}


@dataclass(frozen=True, eq=False)
class Motion:
    """A reference motion confirmed by two different methods.

    Attributes
    ----------
    t : ndarray (n_t,)
        Equidistant times from the start to the end of the problem, s.
    q, v : ndarray (n_t, n_q)
        Coordinates and velocities, one row per time.
    lam : ndarray (n_t, n_c)
        Multipliers of M a + C_q^T lam = Q; of minimum norm if rows are redundant.
    digits : dict of str to ndarray (n_t,)
        "q", "v", "lam": decimals on which the two methods agree, relative to max(1, largest value of the motion).
    growth : ndarray (n_t,)
        Largest growth factor of a perturbation of an earlier state, with q and v relative to their largest values.
        At least 1.

    Examples
    --------
    >>> from twoloop.testing import problems
    >>> problem = next(each for each in problems() if each.name == "pendulum")
    >>> motion = problem.reference
    >>> motion.q.shape == motion.v.shape, bool(motion.t[0] == problem.t_span[0])
    (True, True)
    """

    t: Array
    q: Array
    v: Array
    lam: Array
    digits: Mapping[str, Array]
    growth: Array

    @property
    def scales(self) -> tuple[float, float]:
        """Return the largest coordinate and velocity of the motion, at least 1, to which errors are relative."""
        return max(1.0, float(np.abs(self.q).max())), max(1.0, float(np.abs(self.v).max()))


@dataclass(frozen=True, eq=False)
class KnownProblem:
    """Equations M(t, q) a + C_q^T lam = Q(t, q, v), C(t, q) = 0, initial state, and known properties of the motion.

    Attributes
    ----------
    name : str
        Name for `problems` and `check_simulator`.
    mass : callable
        mass(t, q) -> M (n_q, n_q), nonsingular on the null space of C_q.
    force : callable
        force(t, q, v) -> Q (n_q,).
    constraint, jacobian, constraint_rate : callable
        constraint(t, q) -> C (n_c,), and its derivatives C_q (n_c, n_q) and C_t (n_c,).
    gamma : callable
        gamma(t, q, v) -> right-hand side (n_c,) of C_q a = gamma.
    energy : callable or None
        energy(t, q, v) -> J, if it is conserved.
    q0, v0 : ndarray (n_q,)
        Consistent initial state, read-only.
    t_span : (float, float)
        Start and end of the motion, s.
    tags : tuple of str
        Keys of `TAGS`.
    coordinates : tuple of str
        Kind of each coordinate: "x", "y", "z" of a point, m; "angle" in the plane from the x axis, or "relative" to
        another body, rad; "e0" ... "e3", Euler parameters.
    row_powers : ndarray (n_c,)
        Power of the unit of length in each row of C: 1 for m, 2 for m^2, 0 for an angle.
    reference : Motion or None
        The known motion; None if the motion does not exist up to the end.
    invariants : mapping of str to callable
        Further conserved functions of (t, q, v).
    singular_times : tuple of float
        Times at which C_q loses rank.
    ends : float or None
        Time beyond which no motion exists, so that a simulator must report a failure.
    period : float or None
        Period of the motion, s, if it is periodic.
    bodies : tuple of KnownBody
        Points or rigid bodies, if these, `joints` and `gravity` make up the whole problem; otherwise empty.
    joints : tuple of KnownJoint
        Joints in the order of their rows.
    gravity : ndarray (2,) or (3,) or None
        m/s^2.
    parameters : mapping of str to ndarray
        Constants of the equations, by the names of `DIMENSIONS`: masses and moments of the bodies, gravity, lengths of
        links and so on. Points of bodies are with `joints`.
    note : str
        Purpose of the problem.

    Examples
    --------
    >>> from twoloop.testing import problems
    >>> problem = next(each for each in problems() if each.name == "pendulum")
    >>> problem.mass(0.0, problem.q0).shape, problem.q0.shape
    ((2, 2), (2,))
    """

    name: str
    mass: Callable[[float, Array], Array]
    force: Callable[[float, Array, Array], Array]
    constraint: Callable[[float, Array], Array]
    jacobian: Callable[[float, Array], Array]
    constraint_rate: Callable[[float, Array], Array]
    gamma: Callable[[float, Array, Array], Array]
    energy: Quantity | None
    q0: Array
    v0: Array
    t_span: tuple[float, float]
    tags: tuple[str, ...]
    coordinates: tuple[str, ...]
    row_powers: Array
    reference: Motion | None = None
    invariants: Mapping[str, Quantity] = field(default_factory=dict)
    singular_times: tuple[float, ...] = ()
    ends: float | None = None
    period: float | None = None
    bodies: tuple[KnownBody, ...] = ()
    joints: tuple[KnownJoint, ...] = ()
    gravity: Array | None = None
    parameters: Mapping[str, Array] = field(default_factory=dict)
    note: str = ""

    def __post_init__(self) -> None:
        for name in ("q0", "v0"):  # read-only: a simulator might step in place
            start = np.array(getattr(self, name), dtype=float)
            start.flags.writeable = False
            object.__setattr__(self, name, start)

    @property
    def n_q(self) -> int:
        """Number of coordinates."""
        return self.q0.size

    @property
    def n_c(self) -> int:
        """Number of rows of C."""
        return self.row_powers.size

    def acceleration(self, t: float, q: Array, v: Array) -> tuple[Array, Array]:
        """Return the acceleration (n_q,) and multipliers (n_c,) at a consistent state; minimum norm."""
        return solve_saddle_point(self.mass(t, q), self.force(t, q, v), self.jacobian(t, q), self.gamma(t, q, v))

    def reaction(self, joint: KnownJoint, t: float, q: Array, lam: Array) -> tuple[Array, Array]:
        """Return force (n_axes,), N, and torque (0,), (1,) or (3,), N m, of a joint on its first body, at its point.

        Components along the axes of space. With redundant rows they depend on the choice of lam; that of `reference`
        has minimum norm.
        """
        body = self.bodies[joint.bodies[0]]
        position = q[body.columns]
        on_body = -self.jacobian(t, q)[joint.rows, body.columns].T @ lam[joint.rows]
        point = joint.points[0]
        if body.inertia.size == 0:
            return on_body, np.zeros(0)
        n_axes = point.size
        force, turning = on_body[:n_axes], on_body[n_axes:]
        if n_axes == 2:
            s, c = np.sin(position[2]), np.cos(position[2])
            arm = np.array([c * point[0] - s * point[1], s * point[0] + c * point[1]])
            return force, turning - (arm[0] * force[1] - arm[1] * force[0])
        e = position[3:]
        torque = 0.5 * rotate(e, rate_matrix(e) @ turning)
        return force, torque - np.cross(rotate(e, point), force)

    def __repr__(self) -> str:
        return f"KnownProblem({self.name!r}: {', '.join(self.tags)}; n_q = {self.n_q}, n_c = {self.n_c})"


def solve_saddle_point(M: Array, Q: Array, J: Array, gamma: Array) -> tuple[Array, Array]:
    """Return the solution a, lam of M a + J^T lam = Q, J a = right, with minimum norm of lam."""
    n, m = J.shape[1], J.shape[0]
    matrix = np.zeros((n + m, n + m))
    matrix[:n, :n], matrix[:n, n:], matrix[n:, :n] = M, J.T, J
    scale = np.ones(n + m)
    for _ in range(5):  # equilibration (Ruiz 2001), so that ranks do not depend on units
        size = np.abs(scale[:, None] * matrix * scale).max(axis=1)
        scale /= np.sqrt(np.where(size > 0.0, size, 1.0))
    gamma = scale * np.concatenate([Q, gamma])
    unknowns, _, rank, _ = np.linalg.lstsq(scale[:, None] * matrix * scale, gamma, rcond=1e-12)
    a, lam = np.split(scale * unknowns, [n])
    if rank < n + m:  # minimum norm in the original units of the rows
        lam = np.linalg.lstsq(J.T, J.T @ lam, rcond=1e-11)[0]
    return a, lam
