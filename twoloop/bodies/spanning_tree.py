"""Place the bodies of a model by coordinates of joints along a spanning tree.

The joints of the tree are closed for all values of these coordinates; the other joints, which close loops, are not. A
body that no joint with coordinates connects to the ground has its own pose as coordinates.
"""

from __future__ import annotations

import functools
import heapq
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from twoloop.bodies.frames import GROUND
from twoloop.bodies.parts import ModelJoint, Numbers
from twoloop.bodies.rotation import euler_parameters, euler_product, rotated_by
from twoloop.checks.arguments import Array

TURN = 2.0 * np.pi
# the joints that may be part of a tree, and their numbers of coordinates: with few coordinates, few rows remain open
FREEDOMS = {
    "fixed": 0,
    "revolute": 1,
    "prismatic": 1,
    "screw": 1,
    "universal": 2,
    "cylindrical": 2,
    "spherical": 3,
    "planar": 3,
}
DIRECTED = ("revolute", "prismatic", "cylindrical", "screw", "planar")  # joints in space that hold an axis parallel


class Motion(NamedTuple):
    """One coordinate of a joint: an axis of rotation and a displacement, in the axes of a, or of b."""

    which: str  # "angle", "displacement"; "" if the joint has no coordinate of a name
    turn: Any  # rad per unit: a vector, or a number in the plane
    slide: Array  # m per unit
    on_b: bool = False


class Pose(NamedTuple):
    """Rotation, an angle in the plane or Euler parameters in space, and a point."""

    rotation: Any
    point: Array


@dataclass(frozen=True)
class Edge:
    """A joint of the tree; it places one of its bodies, `child`, relative to the other body, which is placed before."""

    joint: ModelJoint | None  # None: a body with its own pose as coordinates
    a: int
    b: int
    child: int  # a or b
    point_a: Array
    point_b: Array
    motions: tuple[Motion, ...]
    first: int  # index of its first coordinate


class TreeState(NamedTuple):
    """Values of the coordinates, and for each edge the pose of b relative to a."""

    x: Array
    relative: tuple[Pose, ...]


def _composed(one: Any, other: Any) -> Any:
    return one + other if np.ndim(one) == 0 else np.array(euler_product(one, other))


def _inverse(rotation: Any) -> Any:
    return -rotation if np.ndim(rotation) == 0 else rotation * (1.0, -1.0, -1.0, -1.0)


def _rotated(rotation: Any, vector: Array) -> Array:
    if np.ndim(rotation) == 0:
        s, c = np.sin(rotation), np.cos(rotation)
        return np.array([c * vector[0] - s * vector[1], s * vector[0] + c * vector[1]])
    return np.array(rotated_by(rotation, vector))


def _rotation(turn: Any) -> Any:
    """Return the rotation by a vector, or by an angle in the plane."""
    if np.ndim(turn) == 0:
        return turn
    half = 0.5 * float(np.sqrt(turn @ turn))
    return np.array([np.cos(half), *(0.5 * np.sinc(half / np.pi) * turn)])


class SpanningTree:
    """Describe the positions of bodies by the coordinates of the joints of a spanning tree.

    Parameters
    ----------
    joints : sequence of ModelJoint
        Without drives.
    n_bodies, dimension : int
    values : callable
        Gives the numbers of a joint.
    zero : callable
        Gives the Euler parameters of b on a at which the angle of a joint in space is zero.
    held : collection of int
        Bodies that stay where they are.
    preferred : collection of str
        Joints that are part of the tree if possible, because their coordinates are bounded.
    """

    def __init__(
        self,
        joints: Sequence[ModelJoint],
        n_bodies: int,
        dimension: int,
        values: Callable[[Numbers], Array],
        zero: Callable[[ModelJoint], Array],
        held: Collection[int] = (),
        preferred: Collection[str] = (),
    ):
        self.dimension, self.width, self.n_bodies = dimension, 3 if dimension == 2 else 7, n_bodies
        self.values, self.zero = values, functools.cache(zero)
        self.edges: list[Edge] = []  # sorted: edges nearer to the ground come first
        self.keys: list[tuple[str, str]] = []  # (joint, "angle" or "displacement") of each coordinate
        # for each coordinate, whether it is a rotation; for each body, the coordinates that move it
        turning: list[bool] = []
        moved_by: dict[int, list[int]] = {}
        parents: dict[int, Edge | None] = {}
        at_body: dict[int, list[ModelJoint]] = {}
        for joint in joints:
            if joint.kind in FREEDOMS:
                for body in (joint.a.number, joint.b.number):
                    at_body.setdefault(body, []).append(joint)
        order = {id(joint): k for k, joint in enumerate(joints)}
        depth: dict[int, int] = {}
        queue: list[Any] = []

        def place(body: int, edge: Edge | None, parent: int | None) -> None:
            parents[body] = edge
            moved_by[body] = [] if parent is None else list(moved_by[parent])
            depth[body] = 0 if parent is None else depth[parent] + 1
            if edge is not None:
                self.edges.append(edge)
                for motion in edge.motions:
                    moved_by[body].append(len(self.keys))
                    self.keys.append((edge.joint.name if edge.joint else "", motion.which))
                    turning.append(bool(np.any(motion.turn)))
            for joint in at_body.get(body, ()):
                # prefer joints with few coordinates, then short branches
                cost = FREEDOMS[joint.kind], joint.name not in preferred, depth[body]
                heapq.heappush(queue, (*cost, order[id(joint)], joint))

        roots = {GROUND, *held}
        for body in sorted(roots):
            place(body, None, None)
        while len(parents) < n_bodies + 1:
            if queue:
                joint = heapq.heappop(queue)[-1]
                a, b = joint.a.number, joint.b.number
                child = b if a in parents else a
                if child not in parents:
                    points = values(joint.point_a), values(joint.point_b)
                    edge = Edge(joint, a, b, child, *points, self._motions(joint), len(self.keys))
                    place(child, edge, a + b - child)
            else:
                body = next(k for k in range(n_bodies) if k not in parents)
                place(body, self._free(body), GROUND)
        used = {id(edge.joint) for edge in self.edges}
        self.closing = [joint for joint in joints if id(joint) not in used]
        self.turning, self.parents = np.array(turning, dtype=bool), parents
        self.moves = np.zeros((n_bodies, len(self.keys)), dtype=bool)
        for body in range(n_bodies):
            self.moves[body, moved_by[body]] = True

    def _free(self, body: int) -> Edge:
        zero, unit = np.zeros(self.dimension), np.eye(self.dimension)
        turns = (1.0,) if self.dimension == 2 else tuple(unit)
        still = 0.0 if self.dimension == 2 else zero
        motions = *(Motion("", still, each) for each in unit), *(Motion("", each, zero) for each in turns)
        return Edge(None, GROUND, body, body, zero, zero, motions, len(self.keys))

    def _motions(self, joint: ModelJoint) -> tuple[Motion, ...]:
        zero = np.zeros(self.dimension)
        if self.dimension == 2:
            if joint.kind == "prismatic":
                (angle,) = self.values(joint.rows[0].more)  # type: ignore[arg-type]
                return (Motion("displacement", 0.0, np.array([np.cos(angle), np.sin(angle)])),)
            return (Motion("angle", 1.0, zero),) if joint.kind == "revolute" else ()
        if joint.kind == "spherical":
            return tuple(Motion("", each, zero) for each in np.eye(3))
        if joint.kind == "universal":
            return Motion("", joint.axes[0], zero), Motion("", joint.axes[1], zero, on_b=True)
        if joint.kind == "fixed":
            return ()
        axis = joint.axes[0]
        turn, slide = Motion("angle", axis, zero), Motion("displacement", zero, axis)
        if joint.kind == "planar":
            across = np.linalg.svd(axis[None])[2][1:]
            return turn, *(Motion("", zero, each) for each in across)
        if joint.kind == "screw":
            return (Motion("angle", axis, joint.pitch / TURN * axis),)
        return {"revolute": (turn,), "prismatic": (slide,), "cylindrical": (turn, slide)}[joint.kind]

    def pose(self, q: Array, body: int) -> Pose:
        """Return the pose of a body."""
        k = self.width * body
        if self.dimension == 2:
            return Pose(0.0, np.zeros(2)) if body == GROUND else Pose(float(q[k + 2]), q[k : k + 2])
        if body == GROUND:
            return Pose(np.array([1.0, 0.0, 0.0, 0.0]), np.zeros(3))
        return Pose(q[k + 3 : k + 7] / np.linalg.norm(q[k + 3 : k + 7]), q[k : k + 3])

    def state(self, q: Array) -> TreeState:
        """Return the state nearest to given poses, determined joint by joint: it has the angles of the poses."""
        x, relative = np.zeros(len(self.keys)), []
        for edge in self.edges:
            pose_a, pose_b = self.pose(q, edge.a), self.pose(q, edge.b)
            back = _inverse(pose_a.rotation)
            apart = pose_b.point + _rotated(pose_b.rotation, edge.point_b)
            apart = apart - pose_a.point - _rotated(pose_a.rotation, edge.point_a)
            given = Pose(_composed(back, pose_b.rotation), _rotated(back, apart))
            own = slice(edge.first, edge.first + len(edge.motions))
            x[own], pose = self._nearest(edge, given)
            relative.append(pose)
        return TreeState(x, tuple(relative))

    def _nearest(self, edge: Edge, given: Pose) -> tuple[Any, Pose]:
        """Return the coordinates of an edge for which its pose is nearest to a given pose, and this nearest pose."""
        joint, motions = edge.joint, edge.motions
        if joint is None:
            return np.zeros(len(motions)), given
        point = np.zeros(self.dimension)
        if self.dimension == 2:
            turned = joint.b.rotation - joint.a.rotation
            if joint.kind == "revolute":
                return given.rotation - turned, Pose(given.rotation, point)
            (turned,) = self.values(joint.rows[1].more)  # type: ignore[arg-type]
            x = np.array([each.slide @ given.point for each in motions])
            return x, Pose(float(turned), sum((d * m.slide for d, m in zip(x, motions, strict=True)), point))
        if joint.kind == "spherical":
            return np.zeros(3), Pose(given.rotation, point)
        if joint.kind == "universal":
            axis_a, axis_b = joint.axes[0], _rotated(given.rotation, joint.axes[1])
            normal = np.cross(axis_a, axis_b)
            size = float(np.linalg.norm(normal))
            normal = normal / size if size > 0.0 else np.linalg.svd(axis_a[None])[2][1]
            tilt = 0.5 * np.pi - np.arctan2(size, axis_a @ axis_b)
            return np.zeros(2), Pose(_composed(_rotation(tilt * normal), given.rotation), point)
        if joint.kind == "fixed":
            zero = euler_parameters(joint.a.rotation.T @ joint.b.rotation)
            return np.zeros(0), Pose(zero if zero @ given.rotation > 0.0 else -zero, point)
        zero, axis = self.zero(joint), joint.axes[0]
        c, *e = euler_product(given.rotation, _inverse(zero))
        angle = 2.0 * float(np.arctan2(axis @ e, c)) if joint.kind != "prismatic" else 0.0
        slid = float(axis @ given.point)
        if joint.kind == "screw":  # the displacement gives the angle; the pose gives it only up to whole turns
            # its displacement in the position given, where its angle is zero
            a, b = joint.a.in_space(np.array(joint.point_a.values)), joint.b.in_space(np.array(joint.point_b.values))
            start = float((joint.a.rotation @ axis) @ (b - a))
            angle += TURN * np.round(((slid - start) * TURN / joint.pitch - angle) / TURN)
            slid = start + angle * joint.pitch / TURN
        rotation = zero if joint.kind == "prismatic" else np.array(euler_product(_rotation(angle * axis), zero))
        if joint.kind == "planar":
            slid_in_plane = [float(each.slide @ given.point) for each in motions[1:]]
            point = given.point - (axis @ given.point) * axis
            return np.array([angle, *slid_in_plane]), Pose(rotation, point)
        point = slid * axis if joint.kind != "revolute" else point
        return np.array([slid if each.which == "displacement" else angle for each in motions]), Pose(rotation, point)

    def moved(self, state: TreeState, step: Array) -> TreeState:
        """Return the state after a change of the coordinates."""
        relative = list(state.relative)
        for k, edge in enumerate(self.edges):
            own = step[edge.first : edge.first + len(edge.motions)]
            if not own.any():
                continue
            pose = relative[k]
            turns = [[d * m.turn for d, m in zip(own, edge.motions, strict=True) if m.on_b == on_b] for on_b in (0, 1)]
            point = pose.point + sum(d * m.slide for d, m in zip(own, edge.motions, strict=True))
            rotation = _composed(_rotation(sum(turns[0])), pose.rotation)
            if turns[1]:
                rotation = _composed(rotation, _rotation(sum(turns[1])))
            if self.dimension == 3:
                rotation = rotation / np.sqrt(rotation @ rotation)
            relative[k] = Pose(rotation, point)
        return TreeState(state.x + step, tuple(relative))

    def place(self, state: TreeState, q: Array) -> Array:
        """Return the coordinates of the bodies; the coordinates of held bodies are taken from q."""
        q, w = q.copy(), self.width
        poses = {body: self.pose(q, body) for body, edge in self.parents.items() if edge is None}
        for edge, pose in zip(self.edges, state.relative, strict=True):
            if edge.child == edge.b:
                on = poses[edge.a]
                rotation = _composed(on.rotation, pose.rotation)
                joint = on.point + _rotated(on.rotation, edge.point_a + pose.point)
                point = joint - _rotated(rotation, edge.point_b)
            else:
                on = poses[edge.b]
                rotation = _composed(on.rotation, _inverse(pose.rotation))
                joint = on.point + _rotated(on.rotation, edge.point_b)
                point = joint - _rotated(rotation, edge.point_a + pose.point)
            if self.dimension == 3:
                rotation = rotation / np.sqrt(rotation @ rotation)
            poses[edge.child] = Pose(rotation, point)
            first = w * edge.child
            q[first : first + self.dimension], q[first + self.dimension : first + w] = point, rotation
        return q

    def tangent(self, q: Array) -> Array:
        """Return the derivatives of the coordinates of the bodies by the coordinates of the tree, (n_q, n)."""
        n, d = len(self.keys), self.dimension
        derivatives = np.zeros((self.n_bodies, self.width, n))
        if n == 0:
            return derivatives.reshape(-1, 0)
        frames, ends, turns, slides, points, signs = self._lines
        bodies = q.reshape(self.n_bodies, self.width)
        matrices = self._matrices(bodies)  # the last matrix belongs to the ground
        slide = signs * np.einsum("kij,kj->ki", matrices[frames], slides)
        turn = turns * signs[:, 0] if d == 2 else signs * np.einsum("kij,kj->ki", matrices[frames], turns)
        point = np.vstack([bodies[:, :d], np.zeros(d)])[ends] + np.einsum("kij,kj->ki", matrices[ends], points)
        arms = bodies[:, None, :d] - point  # (n_bodies, n, d)
        if d == 2:
            swept = np.stack([-arms[..., 1], arms[..., 0]], axis=-1) * turn[:, None]
            derivatives[:, 2] = turn
        else:
            swept = np.cross(turn, arms)
            e = bodies[:, 3:]
            derivatives[:, 3] = -0.5 * e[:, 1:] @ turn.T
            derivatives[:, 4:] = 0.5 * (e[:, :1, None] * turn.T + np.cross(turn, e[:, None, 1:]).transpose(0, 2, 1))
        derivatives[:, :d] = (swept + slide).transpose(0, 2, 1)
        derivatives *= self.moves[:, None]
        return derivatives.reshape(-1, n)

    @functools.cached_property
    def _lines(self) -> tuple[Any, ...]:
        """Return arrays, by coordinate: the body of its axes, body b, its motion, its point on b, its sign."""
        lines = [(edge, motion) for edge in self.edges for motion in edge.motions]
        return (
            np.array([edge.b if motion.on_b else edge.a for edge, motion in lines]),
            np.array([edge.b for edge, _ in lines]),
            np.array([motion.turn for _, motion in lines]),
            np.array([motion.slide for _, motion in lines]),
            np.array([edge.point_b for edge, _ in lines]),
            np.array([[1.0 if edge.child == edge.b else -1.0] for edge, _ in lines]),
        )

    def _matrices(self, bodies: Array) -> Array:
        """Return the rotation matrices of the bodies and, last, of the ground, (n_bodies + 1, d, d)."""
        matrices = np.tile(np.eye(self.dimension), (self.n_bodies + 1, 1, 1))
        if self.dimension == 2:
            s, c = np.sin(bodies[:, 2]), np.cos(bodies[:, 2])
            matrices[:-1] = np.array([[c, -s], [s, c]]).transpose(2, 0, 1)
            return matrices
        for k, column in enumerate(np.eye(3)):
            matrices[:-1, :, k] = np.array(rotated_by(bodies[:, 3:].T, column)).T
        return matrices

    def loop(self, joint: ModelJoint) -> list[str]:
        """Return the names of the joints of the tree that form a loop with a joint outside the tree."""
        ways: list[list[Edge]] = []
        for body in (joint.a.number, joint.b.number):
            ways.append([])
            while (edge := self.parents[body]) is not None:
                ways[-1].append(edge)
                body = edge.a + edge.b - body
        first, second = ([edge for edge in way if edge not in other] for way, other in (ways, ways[::-1]))
        return [edge.joint.name for edge in (*first, *second[::-1]) if edge.joint is not None]

    def is_mirrored(self, joint: ModelJoint, q: Array) -> bool:
        """Return True if a joint in space has closed with its axis, or its frame, turned over."""
        if self.dimension == 2 or joint.kind not in (*DIRECTED, "fixed"):
            return False
        a, b = (self.pose(q, body.number).rotation for body in (joint.a, joint.b))
        if joint.kind in DIRECTED:
            axes = [_rotated(rotation, axis) for rotation, axis in zip((a, b), joint.axes, strict=True)]
            if float(axes[0] @ axes[1]) < 0.0:
                return True
        if joint.kind in ("fixed", "prismatic"):
            relative = _composed(_inverse(a), b)
            zero = (
                euler_parameters(joint.a.rotation.T @ joint.b.rotation) if joint.kind == "fixed" else self.zero(joint)
            )
            return abs(float(relative @ zero)) < np.sqrt(0.5)
        return False
