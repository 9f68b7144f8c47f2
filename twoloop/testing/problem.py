"""Mechanisms with known motions, as functions of numpy arrays, and runs of a simulator on them within a time limit."""

import ctypes
import threading
from collections.abc import Callable, Mapping
from contextvars import copy_context
from dataclasses import dataclass, field, replace
from typing import Any

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
    """Return the derivative (3, 4) of R(e) a by the Euler parameters; the derivative is linear in them."""
    u = e[1:]
    by_u = (u @ a) * np.eye(3) + np.outer(u, a) - np.outer(a, u) - e[0] * skew(a)
    return 2.0 * np.column_stack([e[0] * a + np.cross(u, a), by_u])


def rate_matrix(e: Array) -> Array:
    """Return G (3, 4): the angular velocity in body axes is 2 G e'."""
    return np.column_stack([-e[1:], e[0] * np.eye(3) - skew(e[1:])])


def euler_parameters(R: Array) -> Array:
    """Return the Euler parameters (4,) of a rotation matrix, with e0 >= 0; the largest one is computed first."""
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
        """Return the acceleration (n_q,) and the multipliers (n_c,) of minimum norm at a consistent state."""
        return solve_saddle_point(self.mass(t, q), self.force(t, q, v), self.jacobian(t, q), self.gamma(t, q, v))

    def reaction(self, joint: KnownJoint, t: float, q: Array, lam: Array) -> tuple[Array, Array]:
        """Return force (n_axes,), N, and torque (0,), (1,) or (3,), N m, of a joint on its first body, at its point.

        Components are along the axes of space. With redundant rows they depend on the choice of lam; lam of `reference`
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


ROTATION, AXIS = 0.7, np.array([1.0, 2.0, -1.5]) / np.sqrt(7.25)  # rotation angle, rad, and its axis in space
TRANSLATION = np.array([1.7, -2.3, 0.9])  # relative to the largest length among the coordinates
Simulate = Callable[[KnownProblem, Array, float], Any]


@dataclass(frozen=True, eq=False)
class Transformed:
    """A problem in the coordinates T q + d, and the inverse transformation.

    Attributes
    ----------
    problem : KnownProblem
        The problem given to the simulator; without `reference`.
    T : ndarray (n_q, n_q)
    d : ndarray (n_q,)
    rows : ndarray (n_c,)
        Scale factors of the rows of C.
    work : float
        Scale factor of energies.
    """

    problem: KnownProblem
    T: Array
    d: Array
    rows: Array
    work: float

    def to_original(self, q: Array, v: Array | None, lam: Array | None) -> tuple[Array, Array | None, Array | None]:
        """Transform states, given as rows, back to the coordinates of the original problem."""
        inverse = np.linalg.inv(self.T)
        return (
            (q - self.d) @ inverse.T,
            None if v is None else v @ inverse.T,
            None if lam is None else lam * self.rows / self.work,
        )


def change_frame(problem: KnownProblem, angle: float = ROTATION, distance: float = 1.0) -> Transformed:
    """Return the problem in a frame rotated by `angle`, rad, and translated by `distance` times the default."""
    T, d = np.eye(problem.n_q), np.zeros(problem.n_q)
    kinds = problem.coordinates
    lengths = [abs(value) for kind, value in zip(kinds, problem.q0, strict=True) if kind in "xyz"]
    shift = distance * TRANSLATION * max(lengths, default=0.0)
    n = 3 if "z" in kinds else 2
    R, p = _rotation(angle, n == 3)
    for k, kind in enumerate(kinds):
        if kind == "x":
            T[k : k + n, k : k + n], d[k : k + n] = R[:n, :n], shift[:n]
        elif kind == "angle":
            d[k] = angle
        elif kind == "e0":  # the product of two quaternions is linear in each
            product = p[0] * np.eye(4)
            product[0, 1:], product[1:, 0] = -p[1:], p[1:]
            product[1:, 1:] += skew(p[1:])
            T[k : k + 4, k : k + 4] = product
    return _transform(problem, T, d, np.ones(problem.n_c), 1.0, _parts_in_frame(problem, R[:n, :n], shift[:n], angle))


def _parts_in_frame(problem: KnownProblem, R: Array, shift: Array, angle: float) -> dict[str, Any]:
    joints = []
    for joint in problem.joints:
        fields: dict[str, Any] = {}
        if joint.bodies[1] == GROUND:
            fields["points"] = joint.points[0], R @ joint.points[1] + shift
            fields["axis"] = None if joint.axis is None else R @ joint.axis
        if joint.motion is not None:
            drive, *rates = joint.motion
            fields["motion"] = (lambda t, drive=drive: drive(t) + angle, *rates)
        joints.append(replace(joint, **fields))
    parameters = dict(problem.parameters)
    if "gravity" in parameters:
        parameters["gravity"] = R @ parameters["gravity"]
    gravity = None if problem.gravity is None else R @ problem.gravity
    return {"joints": tuple(joints), "gravity": gravity, "parameters": parameters}


def _rotation(angle: float, spatial: bool) -> tuple[Array, Array]:
    """Return a rotation matrix (3, 3) and its Euler parameters (4,); in the plane about z."""
    axis = AXIS if spatial else np.array([0.0, 0.0, 1.0])
    R = np.eye(3) + np.sin(angle) * skew(axis) + (1.0 - np.cos(angle)) * skew(axis) @ skew(axis)
    return R, euler_parameters(R)


def change_units(problem: KnownProblem) -> Transformed:
    """Return the problem with lengths in mm and masses in g; the unit of time stays s."""
    T = np.diag([1e3 if kind in "xyz" else 1.0 for kind in problem.coordinates])
    parts: dict[str, Any] = {
        "bodies": tuple(replace(body, mass=1e3 * body.mass, inertia=1e9 * body.inertia) for body in problem.bodies),
        "joints": tuple(
            replace(joint, points=(1e3 * a, 1e3 * b), length=length and 1e3 * length)
            for joint in problem.joints
            for (a, b), length in [(joint.points, joint.length)]
        ),
        "gravity": None if problem.gravity is None else 1e3 * problem.gravity,
        # a metre is 1e3 mm, and a kilogram 1e3 g
        "parameters": {name: value * 1e3 ** sum(DIMENSIONS[name]) for name, value in problem.parameters.items()},
    }
    return _transform(problem, T, np.zeros(problem.n_q), 1e3**problem.row_powers, 1e3 * 1e3**2, parts)


def _transform(
    problem: KnownProblem, T: Array, d: Array, rows: Array, work: float, parts: dict[str, Any]
) -> Transformed:
    inverse = np.linalg.inv(T)

    def original(q: Array) -> Array:
        return inverse @ (np.asarray(q, dtype=float) - d)

    fields: dict[str, Any] = parts | {
        "mass": lambda t, q: work * inverse.T @ problem.mass(t, original(q)) @ inverse,
        "force": lambda t, q, v: work * inverse.T @ problem.force(t, original(q), inverse @ v),
        "constraint": lambda t, q: rows * problem.constraint(t, original(q)),
        "jacobian": lambda t, q: rows[:, None] * problem.jacobian(t, original(q)) @ inverse,
        "constraint_rate": lambda t, q: rows * problem.constraint_rate(t, original(q)),
        "gamma": lambda t, q, v: rows * problem.gamma(t, original(q), inverse @ v),
    }
    energy = problem.energy
    if energy is not None:
        fields["energy"] = lambda t, q, v: work * energy(t, original(q), inverse @ v)
    fields |= {"q0": T @ problem.q0 + d, "v0": T @ problem.v0, "reference": None, "invariants": {}}
    return Transformed(replace(problem, **fields), T, d, rows, work)


def restart_at(problem: KnownProblem, k: int, n_intervals: int) -> KnownProblem:
    """Return the problem started at the k-th state of its known motion, for some intervals between its times."""
    motion = problem.reference
    assert motion is not None
    span = float(motion.t[k]), float(motion.t[k] + n_intervals * (motion.t[1] - motion.t[0]))
    return replace(problem, q0=motion.q[k], v0=motion.v[k], t_span=span, reference=None)


class TimeLimitExceeded(Exception):
    """A run that passed the time limit."""


class _Stop(SystemExit):
    """Raised within a run that has passed the limit; no `except Exception` of a simulator catches it."""


class TimeLimitedSimulator:
    """A simulator whose runs raise `TimeLimitExceeded` after some seconds; after such a run, it is not run again."""

    def __init__(self, simulate: Any, seconds: float | None):
        self._simulate, self._seconds, self.timeout_message = simulate, seconds, ""

    def __call__(self, problem: KnownProblem, times: Array, setting: float) -> Any:
        """Return what the simulator returns, or raise what it raises."""
        if self._seconds is None:
            return self._simulate(problem, times, setting)
        if self.timeout_message:
            raise TimeLimitExceeded(self.timeout_message)
        output: list[Any] = []
        errors: list[BaseException] = []

        def run() -> None:
            try:
                output.append(self._simulate(problem, times, setting))
            except BaseException as error:  # also what pytest.skip raises: it belongs to the caller
                errors.append(error)

        thread = threading.Thread(target=copy_context().run, args=(run,), daemon=True)
        thread.start()
        try:
            thread.join(self._seconds)
        finally:  # also at Ctrl-C
            still_running = thread.is_alive()
            if still_running:
                _stop(thread)
        if still_running:
            self.timeout_message = f"did not end within {self._seconds:g} s"
            raise TimeLimitExceeded(self.timeout_message)
        if errors:
            raise errors[0]
        return output[0]


def _stop(thread: threading.Thread) -> None:
    """Raise `_Stop` in a thread, which ends it once it is back in Python code."""
    assert thread.ident is not None
    ctypes.pythonapi.PyThreadState_SetAsyncExc(ctypes.c_ulong(thread.ident), ctypes.py_object(_Stop))
    thread.join(0.1)


@dataclass(frozen=True, eq=False)
class SimulatorRun:
    """Output of a simulator: states (n_t, n_q), multipliers (n_t, n_c), or the error message."""

    t: Array
    q: Array
    v: Array | None
    lam: Array | None
    error: str = ""
    timed_out: bool = False  # passed the time limit

    @property
    def complete(self) -> bool:
        """True if all numbers are finite."""
        arrays = [array for array in (self.q, self.v, self.lam) if array is not None]
        return not self.error and all(np.isfinite(array).all() for array in arrays)


def run_simulator(simulate: Simulate, problem: KnownProblem, times: Array, setting: float) -> SimulatorRun:
    """Run a simulator on a problem. An exception of the simulator is a failed run; a wrong shape raises."""
    try:
        output = simulate(problem, times.copy(), setting)
    except Exception as error:
        timed_out, nan_states = isinstance(error, TimeLimitExceeded), np.full((times.size, problem.n_q), np.nan)
        message = f"{'' if timed_out else f'{type(error).__name__}: '}{error}".strip().rstrip(":")
        return SimulatorRun(times, nan_states, None, None, message, timed_out)
    parts = output if isinstance(output, tuple) else (output,)
    if not 1 <= len(parts) <= 3:
        raise TypeError(
            f"simulate must return q, (q, v) or (q, v, lam); on {problem.name!r} it returned a tuple of {len(parts)}"
        )
    widths = (problem.n_q, problem.n_q, problem.n_c)
    arrays = [
        _check_array(problem, name, part, (times.size, width))
        for name, part, width in zip(("q", "v", "lam"), parts, widths, strict=False)
    ]
    q, v, lam = [*arrays, None, None][:3]
    if q is None:
        raise TypeError(f"simulate must return at least q; on {problem.name!r} it returned None")
    return SimulatorRun(times, q, v, lam)


def to_original(run: SimulatorRun, transformed: Transformed) -> SimulatorRun:
    """Return a run of a transformed problem in the coordinates of the original."""
    return SimulatorRun(run.t, *transformed.to_original(run.q, run.v, run.lam), run.error)


def _check_array(problem: KnownProblem, name: str, part: Any, shape: tuple[int, int]) -> Array | None:
    """Return an array of the expected shape; None for None."""
    if part is None:
        return None
    try:
        if np.iscomplexobj(part):
            raise TypeError("complex numbers")
        array = np.asarray(part, dtype=float)
    except (TypeError, ValueError) as error:
        raise TypeError(
            f"simulate must return arrays of numbers; on {problem.name!r} {name} is {type(part).__name__}: {error}"
        ) from None
    if array.shape != shape:
        advice = " (transpose it)" if array.shape == shape[::-1] else ""
        raise ValueError(
            f"simulate must return {name} with a row for each time, of shape {shape} on {problem.name!r}; "
            f"it returned shape {array.shape}{advice}"
        )
    return array
