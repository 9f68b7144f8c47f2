"""Transformed versions of a problem: rotated and translated frame, other units, or a later start."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from twoloop.testing.known_parts import GROUND
from twoloop.testing.known_problem import DIMENSIONS, Array, KnownProblem
from twoloop.testing.spatial_equations import parameters_of, skew

TURN, AXIS = 0.7, np.array([1.0, 2.0, -1.5]) / np.sqrt(7.25)  # rotation angle, rad, and its axis in space
MOVE = np.array([1.7, -2.3, 0.9])  # translation relative to the largest length among the coordinates


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

    def back(self, q: Array, v: Array | None, lam: Array | None) -> tuple[Array, Array | None, Array | None]:
        """Transform states, given as rows, back to the coordinates of the original problem."""
        inverse = np.linalg.inv(self.T)
        return (
            (q - self.d) @ inverse.T,
            None if v is None else v @ inverse.T,
            None if lam is None else lam * self.rows / self.work,
        )


def in_a_frame(problem: KnownProblem, turn: float = TURN, move: float = 1.0) -> Transformed:
    """Return the problem in a frame rotated by `turn`, rad, and translated by `move` times the default."""
    T, d = np.eye(problem.n_q), np.zeros(problem.n_q)
    kinds = problem.coordinates
    lengths = [abs(value) for kind, value in zip(kinds, problem.q0, strict=True) if kind in "xyz"]
    shift = move * MOVE * max(lengths, default=0.0)
    R, p = _rotation(turn, "z" in kinds)
    for k, kind in enumerate(kinds):
        if kind == "x":
            n = 3 if "z" in kinds else 2
            T[k : k + n, k : k + n], d[k : k + n] = R[:n, :n], shift[:n]
        elif kind == "angle":
            d[k] = turn
        elif kind == "e0":  # the product of two quaternions is linear in each
            product = p[0] * np.eye(4)
            product[0, 1:], product[1:, 0] = -p[1:], p[1:]
            product[1:, 1:] += skew(p[1:])
            T[k : k + 4, k : k + 4] = product
    n = 3 if "z" in kinds else 2
    return _change(problem, T, d, np.ones(problem.n_c), 1.0, _parts_in_a_frame(problem, R[:n, :n], shift[:n], turn))


def _parts_in_a_frame(problem: KnownProblem, R: Array, shift: Array, turn: float) -> dict[str, Any]:
    joints = []
    for joint in problem.joints:
        told: dict[str, Any] = {}
        if joint.bodies[1] == GROUND:
            told["points"] = joint.points[0], R @ joint.points[1] + shift
            told["axis"] = None if joint.axis is None else R @ joint.axis
        if joint.motion is not None:
            angle, *rates = joint.motion
            told["motion"] = (lambda t, angle=angle: angle(t) + turn, *rates)
        joints.append(replace(joint, **told))
    parameters = dict(problem.parameters)
    if "gravity" in parameters:
        parameters["gravity"] = R @ parameters["gravity"]
    gravity = None if problem.gravity is None else R @ problem.gravity
    return {"joints": tuple(joints), "gravity": gravity, "parameters": parameters}


def _rotation(turn: float, spatial: bool) -> tuple[Array, Array]:
    """Return a rotation matrix (3, 3) and its Euler parameters (4,); in the plane about z."""
    axis = AXIS if spatial else np.array([0.0, 0.0, 1.0])
    R = np.eye(3) + np.sin(turn) * skew(axis) + (1.0 - np.cos(turn)) * skew(axis) @ skew(axis)
    return R, parameters_of(R)


def in_millimetres_and_grams(problem: KnownProblem) -> Transformed:
    """Return the problem with lengths in mm and masses in g; the unit of time stays s."""
    T = np.diag([1e3 if kind in "xyz" else 1.0 for kind in problem.coordinates])
    parts: dict[str, Any] = {
        "bodies": tuple(replace(body, mass=1e3 * body.mass, inertia=1e9 * body.inertia) for body in problem.bodies),
        "joints": tuple(
            replace(
                joint,
                points=(1e3 * joint.points[0], 1e3 * joint.points[1]),
                length=None if joint.length is None else 1e3 * joint.length,
            )
            for joint in problem.joints
        ),
        "gravity": None if problem.gravity is None else 1e3 * problem.gravity,
        "parameters": {
            name: value * 1e3 ** sum(DIMENSIONS[name]) for name, value in problem.parameters.items()
        },  # a metre is 1e3 mm, and a kilogram 1e3 g
    }
    return _change(problem, T, np.zeros(problem.n_q), 1e3**problem.row_powers, 1e3 * 1e3**2, parts)


def _change(problem: KnownProblem, T: Array, d: Array, rows: Array, work: float, parts: dict[str, Any]) -> Transformed:
    back = np.linalg.inv(T)

    def at(q: Array) -> Array:
        return back @ (np.asarray(q, dtype=float) - d)

    changed: dict[str, Any] = parts | {
        "mass": lambda t, q: work * back.T @ problem.mass(t, at(q)) @ back,
        "force": lambda t, q, v: work * back.T @ problem.force(t, at(q), back @ v),
        "constraint": lambda t, q: rows * problem.constraint(t, at(q)),
        "jacobian": lambda t, q: rows[:, None] * problem.jacobian(t, at(q)) @ back,
        "constraint_rate": lambda t, q: rows * problem.constraint_rate(t, at(q)),
        "gamma": lambda t, q, v: rows * problem.gamma(t, at(q), back @ v),
    }
    energy = problem.energy
    if energy is not None:
        changed["energy"] = lambda t, q, v: work * energy(t, at(q), back @ v)
    changed |= {"q0": T @ problem.q0 + d, "v0": T @ problem.v0, "reference": None, "invariants": {}}
    return Transformed(replace(problem, **changed), T, d, rows, work)


def begun_later(problem: KnownProblem, k: int, n_intervals: int) -> KnownProblem:
    """Return the problem started at the k-th state of its known motion, for some intervals between its times."""
    motion = problem.reference
    assert motion is not None
    span = float(motion.t[k]), float(motion.t[k] + n_intervals * (motion.t[1] - motion.t[0]))
    return replace(problem, q0=motion.q[k], v0=motion.v[k], t_span=span, reference=None)
