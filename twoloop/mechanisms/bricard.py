"""IFToMM's A04, Bricard's mechanism, with all 60 rows: five bars of 1 m and 1 kg on the edges of a cube, six hinges.

The coordinates of each bar are its centre and the three columns of its rotation matrix, so the mass matrix is
constant. Six rows per bar enforce orthonormality; a hinge has five rows. The sixth bar is the ground. Geometry and
inertia as in the Exudyn model: bars of 1 x 0.1 x 0.1 m, 100 kg/m^3, gravity along -y.
"""

import numpy as np

from twoloop.bodies.points import box
from twoloop.mechanisms.quadratic import ONE, QuadraticSystem, Scalar, difference, fixed
from twoloop.mechanisms.ready import ready
from twoloop.problem.description import Joint
from twoloop.problem.problem import Array, Problem

GRAVITY = 9.81
WIDTH = 0.1  # m, of the bars
CORNERS = np.array([[0, 0, 0], [1, 0, 0], [1, -1, 0], [1, -1, 1], [0, -1, 1], [0, 0, 1]], dtype=float)
AXES = np.eye(3)[[1, 2, 0, 1, 2, 0]]  # axes of the hinges at the corners
BARS = np.roll(CORNERS, -1, axis=0) - CORNERS
# columns: along the bar, along the hinge at its start, and perpendicular to both
FRAMES = np.array([np.array([bar, axis, np.cross(bar, axis)]).T for bar, axis in zip(BARS, AXES, strict=True)])[:5]
MASSES = np.tile(np.repeat([1.0, 1.0 / 12.0, 0.01 / 12.0, 0.01 / 12.0], 3), 5)  # kg, and the second moments of a bar
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


def _carried(bar: int, direction: Array) -> Vector:
    """Return a body-fixed direction, given at the start."""
    parts = FRAMES[bar].T @ direction
    return [{12 * bar + 3 * k + i: float(parts[k - 1]) for k in (1, 2, 3)} for i in range(3)]


def _dot(a: Vector, b: Vector) -> list[tuple[float, Scalar, Scalar]]:
    return [(1.0, x, y) for x, y in zip(a, b, strict=True)]


def _joint(hinge: int, rows: list[int]) -> Joint:
    """Return the hinge at a corner, acting on the bar that starts there; at the last corner, on the bar that ends."""
    bar, s = (hinge, -0.5) if hinge < 5 else (4, 0.5)
    other = "ground" if hinge in (0, 5) else f"bar {hinge}"
    position, columns = tuple(range(12 * bar, 12 * bar + 3)), tuple(range(12 * bar + 3, 12 * bar + 12))
    return Joint(f"hinge bar {bar + 1}-{other}", tuple(rows), position, columns, (s, 0.0, 0.0))


def _rows() -> QuadraticSystem:
    weight = np.tile([0.0, -GRAVITY, *[0.0] * 10], 5)
    rows = QuadraticSystem(np.diag(MASSES), weight)
    for bar in range(5):
        d = [_vector(bar, k) for k in (1, 2, 3)]
        for column in d:
            rows.row(*[(0.5, x, x) for x in column], (-0.5, ONE, ONE))
        for j, k in ((0, 1), (1, 2), (2, 0)):
            rows.row(*_dot(d[j], d[k]))
    for hinge, axis in enumerate(AXES):
        start = _end(hinge, -0.5) if hinge < 5 else fixed(*CORNERS[5])
        end = _end(hinge - 1, 0.5) if hinge > 0 else fixed(*CORNERS[0])
        numbers = [rows.row((1.0, difference(a, b), ONE)) for a, b in zip(start, end, strict=True)]
        of_one = _carried(hinge - 1, axis) if hinge > 0 else fixed(*axis)
        for across in np.roll(np.eye(3), 1, axis=0):
            if across @ axis == 0.0:
                numbers.append(rows.row(*_dot(of_one, _carried(hinge, across) if hinge < 5 else fixed(*across))))
        rows.joints.append(_joint(hinge, numbers))
    corners, edges = box((1.0, WIDTH, WIDTH))
    for bar in range(5):
        for i, j in edges:
            rows.line(_place(bar, corners[i]), _place(bar, corners[j]))
        rows.line(_end(bar, -0.5), _end(bar, 0.5))
    return rows


def bricard() -> Problem:
    """The mechanism released from rest on the edges of a cube: 60 rows of rank 59, one degree of freedom.

    Examples
    --------
    >>> from twoloop.mechanisms import bricard
    >>> problem = bricard()
    >>> problem.system.n_q, problem.system.n_c, problem.t_span[1]
    (60, 60, 2.0)
    """
    rows = _rows()
    centres = 0.5 * (CORNERS[:5] + CORNERS[1:])
    q0 = np.concatenate([[*centre, *frame.T.ravel()] for centre, frame in zip(centres, FRAMES, strict=True)])
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
            f"{axis} of {what} of bar {bar + 1} ({unit})"
            for bar in range(5)
            for what, unit in (("centre", "m"), ("column 1", "-"), ("column 2", "-"), ("column 3", "-"))
            for axis in "xyz"
        ),
    )
