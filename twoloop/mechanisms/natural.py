"""Define mechanisms whose coordinates are those of points and vectors: pendulums, chains, Bricard's mechanism."""

import math
from dataclasses import dataclass

import numpy as np
from scipy.optimize import brentq
from scipy.special import ellipj, ellipk

from twoloop.bodies.drawings import box
from twoloop.checks.arguments import check_finite, check_size
from twoloop.mechanisms.quadratic import ONE, QuadraticSystem, Scalar, difference, fixed, point
from twoloop.mechanisms.registry import ready
from twoloop.problem.description import Joint
from twoloop.problem.problem import Array, Condition, Problem, Reference

GRAVITY = 9.81  # m/s^2
CVODE_GRAVITY = 13.7503716360407456549801915596211144  # (2 K(m = 1/2))^2: a quarter of the period is 1/2


@dataclass(frozen=True)
class Swing:
    """Evaluate the motion of a pendulum of length L released from the horizontal, by Jacobi's elliptic functions.

    With k^2 = 1/2 and u = sqrt(g / L) t, the angle from the downward vertical is 2 arcsin(k sn(K - u)) (Whittaker,
    Analytical Dynamics, Sect. 44).
    """

    length: float
    gravity: float
    side: int

    def __call__(self, t: float) -> tuple[Array, Array]:
        """Return the states q, v (2,) at t."""
        pace, m = math.sqrt(self.gravity / self.length), 0.5
        sn, cn, dn, _ = ellipj(ellipk(m) - pace * t, m)
        # sin and cos of twice arcsin(k sn), whose cosine is dn
        sine, cosine = 2.0 * math.sqrt(m) * sn * dn, 1.0 - 2.0 * m * sn * sn
        rate = -2.0 * math.sqrt(m) * pace * cn
        q = self.length * np.array([self.side * sine, -cosine])
        return q, self.length * rate * np.array([self.side * cosine, sine])

    @property
    def period(self) -> float:
        """Return the period, 4 K(1/2) sqrt(L / g), s."""
        return float(4.0 * ellipk(0.5) * math.sqrt(self.length / self.gravity))


def _pendulum(name: str, gravity: float, side: int, t_end: float, **attributes: object) -> Problem:
    rows = QuadraticSystem(np.eye(2), np.array([0.0, -gravity]))
    rows.link("link", 0, fixed(0.0, 0.0), 1.0)
    motion = Swing(1.0, gravity, side)
    q, v = motion(t_end)
    lam = np.array([v @ v - gravity * q[1]])
    return ready(
        *(rows, name, np.array([float(side), 0.0]), np.zeros(2), t_end),
        conserved=True,
        drawing=rows.drawing(point(0)),
        parameters={"length": 1.0, "mass": 1.0, "gravity": gravity},
        reference=Reference(
            t=t_end,
            q=q,
            v=v,
            lam=lam,
            period=motion.period,
            source="closed form, Jacobi's elliptic functions (SciPy)",
            digits={"q": 13.0, "v": 13.0, "lam": 12.0},
            verified="the equation for the angle, extrapolated in extended precision: 13 digits in q and v",
        ),
        motion=motion,
        tags=("open chain", "rigid", "planar"),
        coordinates=("x (m)", "y (m)"),
        **attributes,  # type: ignore[arg-type]
    )


def pendulum(start: float = -1.0) -> Problem:
    """Return the pendulum A01 of IFToMM's library of benchmarks: 1 kg on 1 m, released from the horizontal.

    Parameters
    ----------
    start : {-1, 1}
        Initial x, m: -1 as in MBSbenchmarksInOpenSim, 1 as in the specification of the library.

    Raises
    ------
    TypeError, ValueError
        If `start` is neither -1 nor 1.

    Examples
    --------
    >>> from twoloop.mechanisms import pendulum
    >>> problem = pendulum()
    >>> problem.system.n_q, problem.system.n_c, problem.t_span[1]
    (2, 1, 10.0)
    """
    if check_finite("start", start) not in (-1.0, 1.0):
        raise ValueError(f"start must be -1 or 1 (m, x of the bob at the start); given {start!r}")
    return _pendulum(
        "A01 pendulum",
        9.81,
        int(start),
        10.0,
        source="IFToMM library of benchmarks, A01; RehabEngGroup/MBSbenchmarksInOpenSim, A01_SimplePendulum.rst",
        purpose="The simplest constrained motion, known in closed form at all times: what is wrong here is the method.",
        note="The library's pass rule asks for 2000 s.",
        condition=Condition(
            t_end=2000.0,
            n_outputs=4000,
            coordinates=(0, 1),
            velocities=(),
            threshold=1e-3,
            low=1e-1,
            high=1e-3,
            source=(
                "lim.ii.udc.es/mbsbenchmark, A01_specification (duration, outputs, threshold, limits); the formula of "
                "the error is recalled from Gonzalez et al. (2006)"
            ),
        ),
    )


def projection_pendulum() -> Problem:
    """Return the pendulum of SUNDIALS' projection example: its period is exactly 2 s, so that it returns after 30 s.

    Examples
    --------
    >>> from twoloop.mechanisms import projection_pendulum
    >>> problem = projection_pendulum()
    >>> problem.system.n_q, problem.system.n_c, problem.t_span[1]
    (2, 1, 30.0)
    """
    return _pendulum(
        "projection pendulum",
        CVODE_GRAVITY,
        1,
        30.0,
        source="LLNL/sundials, examples/cvode/serial/cvPendulum_dns.c",
        purpose=(
            "Whether constraints kept by projection also keep the phase: after 15 periods the end is the start. CVODE "
            "at a tolerance of 1e-9 is printed with an error of 1.8e-6 in y with projection, of 1.7e-3 without."
        ),
    )


MAX_MASSES = 20  # masses of a closed chain, as far as it was checked
SLACK = 0.8  # distance of the pins of a closed chain relative to the total length of its links


def _free_masses(n: int) -> QuadraticSystem:
    """Return n masses of 1 / n kg, without rows."""
    weight = np.zeros(2 * n)
    weight[1::2] = -GRAVITY / n
    return QuadraticSystem(np.eye(2 * n) / n, weight)


def _chain_coordinates(n: int) -> tuple[str, ...]:
    return tuple(f"{axis}{i + 1} (m)" for i in range(n) for axis in "xy")


def double_pendulum() -> Problem:
    """Return two masses of 1/2 kg on two links of 1 m, released from rest with both links level.

    The motion is chaotic, which costs about one digit over the usual run of 3 s.

    Examples
    --------
    >>> from twoloop.mechanisms import double_pendulum
    >>> problem = double_pendulum()
    >>> problem.system.n_q, problem.system.n_c, problem.t_span[1]
    (4, 2, 3.0)
    """
    rows = _free_masses(2)
    rows.link("link 1", 0, fixed(0.0, 0.0), 1.0)
    rows.link("link 2", 2, point(0), 1.0)
    return ready(
        *(rows, "double pendulum", np.array([1.0, 0.0, 2.0, 0.0]), np.zeros(4), 3.0),
        conserved=True,
        drawing=rows.drawing(point(2)),
        parameters={"n": 2, "length": 1.0, "mass": 0.5, "gravity": GRAVITY},
        source="textbook problem; the start was chosen for this project",
        tags=("open chain", "rigid", "planar"),
        purpose="Two degrees of freedom without a closed form: errors grow with the motion, which is chaotic.",
        coordinates=_chain_coordinates(2),
    )


def closed_chain(n: int = 4) -> Problem:
    """Return a chain of n equal masses pinned at both ends: n + 1 links, n - 1 degrees of freedom.

    The total length of the links is 1 m, the distance of the pins 0.8 m. The chain is released from a regular polygon
    through the pins whose first two links are exchanged, so that the motion is not symmetric.

    Parameters
    ----------
    n : int
        Number of masses, 2 to 20.

    Returns
    -------
    Problem
        With a reference for n = 2, 4, 5, 10 and 20.

    Raises
    ------
    TypeError, ValueError
        If n is not an integer from 2 to 20.

    Examples
    --------
    >>> from twoloop.mechanisms import closed_chain
    >>> problem = closed_chain()
    >>> problem.system.n_q, problem.system.n_c, problem.t_span[1]
    (8, 5, 1.0)
    """
    n = check_size("n", n, 2)
    if n > MAX_MASSES:
        raise ValueError(f"n must be at most {MAX_MASSES}, as far as the chain was checked; given {n}")
    rows, length = _free_masses(n), 1.0 / (n + 1)
    for i in range(n):
        rows.link(f"link {i + 1}", 2 * i, point(2 * i - 2) if i > 0 else fixed(0.0, 0.0), length)
    rows.link(f"link {n + 1}", 2 * n - 2, fixed(SLACK, 0.0), length)
    name = f"closed chain of {n}"
    return ready(
        *(rows, name, _chain_positions(n)[1:-1].ravel(), np.zeros(2 * n), 1.0),
        system=rows.system(name, bandwidth=2),
        conserved=True,
        drawing=rows.drawing(point(2 * (n // 2))),
        parameters={"n": n, "length": length, "mass": 1.0 / n, "gravity": GRAVITY},
        note="Masses, lengths and start were chosen for this project.",
        source="a question of users: SolveDAE/solve_dae, issue 46; moorepants/learn-multibody-dynamics, issue 239",
        tags=("closed chain", "rigid", "planar"),
        purpose=(
            "A loop of any length, on which solvers are reported to abort from five links on; the number of degrees of "
            "freedom grows with n, and so does the chaos."
        ),
        coordinates=_chain_coordinates(n),
    )


def _chain_positions(n: int) -> Array:
    """Return the initial positions of pins and masses (n + 2, 2)."""
    links = n + 1
    # an arc of `links` equal chords with span SLACK: sin(links a) / (links sin(a)) = SLACK
    a = brentq(lambda a: math.sin(links * a) / (links * math.sin(a)) - SLACK, 1e-6, math.pi / links, xtol=1e-15)
    angles = (2.0 * np.arange(links) - n) * a
    angles[:2] = angles[1::-1]
    steps = np.column_stack([np.cos(angles), np.sin(angles)]) / links
    return np.vstack([np.zeros(2), np.cumsum(steps, axis=0)])


# IFToMM's A04 with all 60 rows: five bars of 1 m and 1 kg on the edges of a cube, six hinges. The coordinates of each
# bar are its centre and the three columns of its rotation matrix, so the mass matrix is constant. Six rows per bar
# enforce orthonormality; a hinge has five rows. The sixth bar is the ground. Geometry and inertia as in the Exudyn
# model: bars of 1 x 0.1 x 0.1 m, 100 kg/m^3, gravity along -y.
WIDTH = 0.1  # m, of the bars
BRICARD_CORNERS = np.array([[0, 0, 0], [1, 0, 0], [1, -1, 0], [1, -1, 1], [0, -1, 1], [0, 0, 1]], dtype=float)
BRICARD_AXES = np.eye(3)[[1, 2, 0, 1, 2, 0]]  # axes of the hinges at the corners
BRICARD_BARS = np.roll(BRICARD_CORNERS, -1, axis=0) - BRICARD_CORNERS
# columns: along the bar, along the hinge at its start, and perpendicular to both
BRICARD_FRAMES = np.array(
    [np.array([bar, axis, np.cross(bar, axis)]).T for bar, axis in zip(BRICARD_BARS, BRICARD_AXES, strict=True)]
)[:5]
BRICARD_MASSES = np.tile(
    np.repeat([1.0, 1.0 / 12.0, 0.01 / 12.0, 0.01 / 12.0], 3), 5
)  # kg, and the second moments of a bar, kg m^2
Vector = list[Scalar]


def _vector(bar: int, k: int) -> Vector:
    """Return the centre (k = 0) or column k of the rotation matrix of a bar."""
    return [{12 * bar + 3 * k + i: 1.0} for i in range(3)]


def _place(bar: int, point: Array) -> Vector:
    """Return a point of a bar, given in body axes relative to the centre."""
    parts = (1.0, *point.tolist())
    return [{12 * bar + 3 * k + i: part for k, part in enumerate(parts) if part} for i in range(3)]


def _end(bar: int, s: float) -> Vector:
    """Return the point at s, from -0.5 to 0.5, along a bar."""
    return _place(bar, np.array([s, 0.0, 0.0]))


def _direction(bar: int, direction: Array) -> Vector:
    """Return a body-fixed direction, given at the start."""
    parts = BRICARD_FRAMES[bar].T @ direction
    return [{12 * bar + 3 * k + i: float(parts[k - 1]) for k in (1, 2, 3)} for i in range(3)]


def _dot(a: Vector, b: Vector) -> list[tuple[float, Scalar, Scalar]]:
    return [(1.0, x, y) for x, y in zip(a, b, strict=True)]


def _bricard_joint(hinge: int, rows: list[int]) -> Joint:
    """Return the hinge at a corner, acting on the bar that starts there; at the last corner, on the bar that ends."""
    bar, s = (hinge, -0.5) if hinge < 5 else (4, 0.5)
    other = "ground" if hinge in (0, 5) else f"bar {hinge}"
    position, columns = tuple(range(12 * bar, 12 * bar + 3)), tuple(range(12 * bar + 3, 12 * bar + 12))
    return Joint(f"hinge bar {bar + 1}-{other}", tuple(rows), position, columns, (s, 0.0, 0.0))


def _bricard_rows() -> QuadraticSystem:
    weight = np.tile([0.0, -GRAVITY, *[0.0] * 10], 5)
    rows = QuadraticSystem(np.diag(BRICARD_MASSES), weight)
    for bar in range(5):
        columns = [_vector(bar, k) for k in (1, 2, 3)]
        for column in columns:
            rows.row(*[(0.5, x, x) for x in column], (-0.5, ONE, ONE))
        for j, k in ((0, 1), (1, 2), (2, 0)):
            rows.row(*_dot(columns[j], columns[k]))
    for hinge, axis in enumerate(BRICARD_AXES):
        start = _end(hinge, -0.5) if hinge < 5 else fixed(*BRICARD_CORNERS[5])
        end = _end(hinge - 1, 0.5) if hinge > 0 else fixed(*BRICARD_CORNERS[0])
        numbers = [rows.row((1.0, difference(a, b), ONE)) for a, b in zip(start, end, strict=True)]
        carried_axis = _direction(hinge - 1, axis) if hinge > 0 else fixed(*axis)
        for perpendicular in np.roll(np.eye(3), 1, axis=0):
            if perpendicular @ axis == 0.0:
                numbers.append(
                    rows.row(
                        *_dot(carried_axis, _direction(hinge, perpendicular) if hinge < 5 else fixed(*perpendicular))
                    )
                )
        rows.joints.append(_bricard_joint(hinge, numbers))
    corners, edges = box((1.0, WIDTH, WIDTH))
    for bar in range(5):
        for i, j in edges:
            rows.line(_place(bar, corners[i]), _place(bar, corners[j]))
        rows.line(_end(bar, -0.5), _end(bar, 0.5))
    return rows


def bricard() -> Problem:
    """Return Bricard's mechanism released from rest on the edges of a cube: 60 rows of rank 59, one degree of freedom.

    Examples
    --------
    >>> from twoloop.mechanisms import bricard
    >>> problem = bricard()
    >>> problem.system.n_q, problem.system.n_c, problem.t_span[1]
    (60, 60, 2.0)
    """
    rows = _bricard_rows()
    centres = 0.5 * (BRICARD_CORNERS[:5] + BRICARD_CORNERS[1:])
    q0 = np.concatenate([[*centre, *frame.T.ravel()] for centre, frame in zip(centres, BRICARD_FRAMES, strict=True)])
    return ready(
        *(rows, "A04 Bricard", q0, np.zeros(60), 2.0),
        conserved=True,
        drawing=rows.drawing(_end(1, 0.5)),
        parameters={"length": 1.0, "width": WIDTH, "mass": 1.0, "gravity": GRAVITY},
        note="The run of the benchmark is 10 s long.",
        source=(
            "IFToMM library of benchmarks, A04; RehabEngGroup/MBSbenchmarksInOpenSim, A04_BricardsMechanism.rst; "
            "jgerstmayr/EXUDYN, TestModels/bricardMechanism.py"
        ),
        tags=("closed chain", "rigid", "spatial", "redundant"),
        purpose=(
            "A loop that moves only because its geometry is special: counted by rows it is rigid, and one of the 60 "
            "follows from the others at every position, though not from any fixed choice of them."
        ),
        coordinates=tuple(
            f"{axis} of {part} of bar {bar + 1} ({unit})"
            for bar in range(5)
            for part, unit in (("centre", "m"), ("column 1", "-"), ("column 2", "-"), ("column 3", "-"))
            for axis in "xyz"
        ),
    )
