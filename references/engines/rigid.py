"""Common data of all engine models: poses and twists of bodies in space, joints of a tree, cuts of loops.

Every engine gets the same data: each body's mass and inertia about its centre of mass, a tree of joints whose
coordinates are zero at the start, and the loop-closing joints. A planar mechanism is placed in the plane z = 0; its
loop-closing hinges become ball joints, because the hinges of the tree keep it in the plane. Each file of this folder
says in `ENGINE` what the studies need to know of its engine.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from pathlib import Path
from pkgutil import iter_modules
from typing import Any, NamedTuple

import numpy as np

from twoloop.bodies import SpatialModel
from twoloop.bodies.mjcf_writer import spanning_tree
from twoloop.bodies.model_problem import ModelProblem
from twoloop.bodies.parameter_layout import SPRING, TORQUE
from twoloop.bodies.parts import Body, ModelJoint
from twoloop.bodies.rotation import G, euler_parameters, euler_rates, rotation_matrix
from twoloop.problem.problem import Array

SLIDE, HINGE, BALL = "slide", "hinge", "ball"
FREEDOMS = ("revolute", "prismatic", "universal", "spherical")  # kinds of joints supported in the tree
HALF = 0.5  # m: distance of the two points that represent a loop-closing hinge
Z = (0.0, 0.0, 1.0)


@dataclass(frozen=True)
class Motion:
    """Poses and velocities of the bodies at some times, and the cost of the run."""

    t: Array  # (n_t,), s; the first is 0
    x: Array  # (n_t, n_bodies, 3), m: centres of mass
    R: Array  # (n_t, n_bodies, 3, 3); the columns are the body axes
    v: Array  # (n_t, n_bodies, 3), m/s: velocities of the centres
    w: Array  # (n_t, n_bodies, 3), rad/s: angular velocities along the axes of space
    f: Array  # (n_t, 3), N: force of the first loop-closing joint on its `body`, in space; NaN: not reported
    call_s: float  # CPU time of the call on an existing model ...
    stepping_s: float  # ... and of its steps only
    message: str = ""  # why the run ended early; empty if it did not


@dataclass(frozen=True)
class Prepared:
    """A model in an engine."""

    masses: Array  # (n_bodies,), kg, as the engine has them
    moments: Array  # (n_bodies,), kg m^2: the largest principal moments of inertia
    run: Callable[[float, int, int], Motion]  # run(t_end, n_steps, n_stored) -> Motion, from the start


State = tuple[Array, Array, Array, Array, Array]  # x, R, v, w, f of `Motion` at one instant
NOT_REPORTED = np.full(3, np.nan)


def march(
    began: float, h: float, n_steps: int, n_stored: int, see: Callable[[], State], step: Callable[[int, float], str]
) -> Motion:
    """Return the motion of an engine set up since `began`; step(n, t) takes n steps, to t, and returns "" or an error.

    States are stored at the start and after whole steps at n_stored roughly equidistant times.
    """
    stored, spent, message = [see()], 0.0, ""
    ends = np.unique(np.round(np.linspace(0, n_steps, n_stored + 1)).astype(int))
    for n, end in zip(np.diff(ends).tolist(), ends[1:].tolist(), strict=True):
        start = time.process_time()
        message = step(n, end * h)
        spent += time.process_time() - start
        state = see()
        if not message and not all(np.isfinite(values).all() for values in state[:-1]):
            message = "the state is not finite"
        if message:
            message = f"at {end * h:.3g} s or before: {message}"
            break
        stored.append(state)
    x, R, v, w, f = (np.array(values) for values in zip(*stored, strict=True))
    return Motion(ends[: len(x)] * h, x, R, v, w, f, time.process_time() - began, spent, message)


@dataclass(frozen=True)
class Rigid:
    """A mechanism in space with its initial state."""

    given: ModelProblem
    model: SpatialModel
    planar: bool  # made from a planar mechanism
    # x, R, v, w: of the bodies at the start, as in `Motion` at one instant
    x: Array
    R: Array
    v: Array
    w: Array
    # parents, loops: of `spanning_tree`
    parents: dict[int, tuple[Body, ModelJoint]]
    loops: list[ModelJoint]
    torques: Array  # (n_bodies, 3); constant ones, N m

    @property
    def cut(self) -> str:
        """Return the name of the first loop-closing joint; "" for a tree."""
        return self.loops[0].name if self.loops else ""

    def cut_points(self) -> list[tuple[Body, Array, Body, Array]]:
        """Return pairs of coincident points where loops are cut: one for a ball, two on the axis for a hinge."""
        pairs = []
        for joint in self.loops:
            if joint.kind not in ("spherical", "revolute"):
                raise ValueError(f"a loop is closed by a ball or a hinge; {joint.name!r} is {joint.kind}")
            sides = (0.0,) if joint.kind == "spherical" else (-HALF, HALF)
            for side in sides:
                places = [point_of(body, joint) + side * axis_of(body, joint) for body in (joint.a, joint.b)]
                pairs.append((joint.a, places[0], joint.b, places[1]))
        return pairs

    def rates(self, body: Body) -> Array:
        """Return initial velocities of the joint above a body, in the order of `freedoms`; of a ball in body axes."""
        parent, joint = self.parents[body.number]
        point = body.position + body.rotation @ point_of(body, joint)
        speed, spin = self._twist(body, point) - self._twist(parent, point)
        columns = []
        for kind, axis in freedoms(body, joint):
            turned, zero = body.rotation @ axis, np.zeros((3, 3))
            columns.append(np.vstack([turned, zero[0]] if kind == SLIDE else [zero[0], turned]).reshape(6, 1))
            if kind == BALL:
                columns[-1] = np.vstack([zero, body.rotation])
        return np.linalg.lstsq(np.hstack(columns), np.concatenate([speed, spin]))[0]

    def _twist(self, body: Body, point: Array) -> Array:
        if body is self.model.ground:
            return np.zeros((2, 3))
        w = self.w[body.number]
        return np.array([self.v[body.number] + np.cross(w, point - self.x[body.number]), w])


def largest_moment(inertia: Array) -> float:
    """Return the largest principal moment for the numbers of a body: mass, xx, yy, zz, xy, xz, yz."""
    return float(np.linalg.eigvalsh(tensor(inertia))[-1])


def tensor(inertia: Array) -> Array:
    """Return the inertia tensor (3, 3) for these numbers."""
    _, xx, yy, zz, xy, xz, yz = inertia
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


def point_of(body: Body, joint: ModelJoint) -> Array:
    """Return the point of a joint in the axes of one of its bodies."""
    return np.array((joint.point_a if body is joint.a else joint.point_b).values)


def axis_of(body: Body, joint: ModelJoint) -> Array:
    """Return the axis of a joint in the axes of one of its bodies; z for a ball, which has none."""
    return joint.axes[0 if body is joint.a else 1] if joint.axes else body.rotation.T @ np.array(Z)


def freedoms(body: Body, joint: ModelJoint) -> list[tuple[str, Array]]:
    """Return the freedoms of the joint above a body, in the order of MuJoCo's file: kind and axis in body axes."""
    if joint.kind not in FREEDOMS:
        raise ValueError(f"a joint of a tree must be {', '.join(FREEDOMS)}; {joint.name!r} is {joint.kind}")
    if joint.kind == "spherical":
        return [(BALL, np.array(Z))]
    if joint.kind == "universal":
        ends = zip((joint.a, joint.b), joint.axes, strict=True)
        axes = [body.local_direction(end.rotation @ axis) for end, axis in ends]
        return [(HINGE, axis) for axis in (axes if joint.b is body else axes[::-1])]
    axis = joint.axes[1] if joint.b is body else -joint.axes[0]
    return [(HINGE if joint.kind == "revolute" else SLIDE, axis)]


def springs(model: Any) -> list[tuple[Body, Array, Body, Array, tuple[float, ...]]]:
    """Return both ends of each spring in body axes, with stiffness, damping and length."""
    return [
        (f.first, np.array(f.on_first.values), f.second, np.array(f.on_second.values), f.more.values)
        for f in model.forces
        if f.kind == SPRING
    ]


def rigid_of(problem: ModelProblem) -> Rigid:
    """Return the data for the engines of a planar or spatial model.

    Raises ValueError if it contains a drive, or a force other than a spring or a constant torque.
    """
    given: Any = problem.model
    unsupported = [item.name for item in given.joints if item.kind == "drive"]
    unsupported += [f.name for f in given.forces if f.kind not in (SPRING, TORQUE) or f.function]
    if unsupported:
        raise ValueError(f"engines support bodies, joints, springs and constant torques only; not {unsupported[0]!r}")
    planar = given.dimension == 2
    x, R, v, w = (item[0] for item in states(planar, problem.q0[:, None], problem.v0[:, None]))
    model = _in_space(given, x, R, v, w) if planar else given
    if max(np.abs(np.array([body.position for body in model.bodies]) - x).max(), 0.0) > 1e-9:
        raise ValueError(f"the bodies of {problem.name!r} are not given where they start; give them closed")
    torques = np.zeros_like(x)
    for force in given.forces:
        if force.kind == TORQUE:
            torques[force.second.number] += [0.0, 0.0, *force.more.values] if planar else force.more.values
    return Rigid(problem, model, planar, x, R, v, w, *spanning_tree(model), torques)


def _in_space(given: Any, x: Array, R: Array, v: Array, w: Array) -> SpatialModel:
    """Return a planar model placed in the plane z = 0, with loops cut at ball joints."""
    model = SpatialModel((*given.gravity, 0.0), name=given.name)
    for k, body in enumerate(given.bodies):
        mass, J = body.inertia
        motion = {"velocity": v[k], "angular_velocity": w[k]}
        model.body(body.name, mass=mass, inertia=(0.6 * J, 0.6 * J, J), position=x[k], rotation=R[k], **motion)
    cuts = {joint.name for joint in spanning_tree(given)[1]}
    for joint in given.joints:
        a, b, name = joint.a.name, joint.b.name, joint.name
        point = np.append(joint.a.in_space(np.array(joint.point_a.values)), 0.0)
        if joint.kind == "prismatic":
            angle = joint.rows[0].more.values[0] + joint.a.rotation
            model.prismatic(a, b, at=point, axis=(np.cos(angle), np.sin(angle), 0.0), name=name)
        elif name in cuts:
            model.spherical(a, b, at=point, name=name)
        else:
            model.revolute(a, b, at=point, axis=Z, name=name)
    for a, point, b, on_b, (stiffness, damping, length) in springs(given):
        ends = [np.append(body.in_space(place), 0.0) for body, place in ((a, point), (b, on_b))]
        model.spring(a.name, ends[0], b.name, ends[1], stiffness=stiffness, damping=damping, length=length)
    return model


def states(planar: bool, q: Array, v: Array) -> tuple[Array, Array, Array, Array]:
    """Return x, R, v, w of `Motion` for coordinates (n_q, n_t) of a planar or spatial model."""
    n_t = q.shape[1]
    shaped, rates = (array.T.reshape(n_t, -1, 3 if planar else 7) for array in (q, v))
    n = shaped.shape[1]
    x, speed, R, w = (np.zeros((n_t, n, 3)), np.zeros((n_t, n, 3)), np.zeros((n_t, n, 3, 3)), np.zeros((n_t, n, 3)))
    if planar:
        x[..., :2], speed[..., :2], w[..., 2] = shaped[..., :2], rates[..., :2], rates[..., 2]
        s, c = np.sin(shaped[..., 2]), np.cos(shaped[..., 2])
        R[..., 0, 0], R[..., 0, 1], R[..., 1, 0], R[..., 1, 1], R[..., 2, 2] = c, -s, s, c, 1.0
        return x, R, speed, w
    x[:], speed[:] = shaped[..., :3], rates[..., :3]
    for i, k in np.ndindex(n_t, n):
        e = shaped[i, k, 3:] / np.linalg.norm(shaped[i, k, 3:])
        R[i, k] = rotation_matrix(e)
        w[i, k] = R[i, k] @ (2.0 * G(e) @ rates[i, k, 3:])
    return x, R, speed, w


def coordinates(motion: Motion, planar: bool) -> tuple[Array, Array]:
    """Coordinates and velocities (n_q, n_t) of a model, of a motion in space; Euler parameters of either sign."""
    n_t, n = motion.x.shape[:2]
    if planar:
        angles = np.unwrap(np.arctan2(motion.R[..., 1, 0], motion.R[..., 0, 0]), axis=0)
        q = np.concatenate([motion.x[..., :2], angles[..., None]], axis=2)
        v = np.concatenate([motion.v[..., :2], motion.w[..., 2:]], axis=2)
    else:
        q, v = np.empty((n_t, n, 7)), np.empty((n_t, n, 7))
        q[..., :3], v[..., :3] = motion.x, motion.v
        for i, k in np.ndindex(n_t, n):
            q[i, k, 3:] = euler_parameters(motion.R[i, k])
            v[i, k, 3:] = euler_rates(q[i, k, 3:], motion.w[i, k])
    return q.reshape(n_t, -1).T, v.reshape(n_t, -1).T


class Configured(NamedTuple):
    """Settings with a label; `how` says in the engine's own words what is set."""

    label: str
    settings: Any
    how: str = "nothing"
    everywhere: bool = False  # run on every mechanism, also with motors, lighter bodies and turned


class Engine(NamedTuple):
    """An engine: its name, its package, its function prepare(rigid, settings), and with which settings it is run."""

    name: str
    package: str  # name of the package, which provides the version
    prepare: Callable[..., Prepared]
    most_rigid: Any  # settings with which its models are compared with the mechanism
    configured: tuple[Configured, ...]


@cache
def engines() -> dict[str, Engine]:
    """Return the engines of all modules in this folder, by the names of these."""
    names = sorted(module.name for module in iter_modules([str(Path(__file__).parent)]))
    modules = {name: import_module(f"references.engines.{name}") for name in names}
    return {name: module.ENGINE for name, module in modules.items() if hasattr(module, "ENGINE")}
