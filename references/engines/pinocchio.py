"""Pinocchio: a tree in joint coordinates, loops by its constrained dynamics, with a time-stepping loop in Python."""

import time
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from references.driver import imported
from references.engines import rigid as parts
from references.engines.rigid import BALL, NOT_REPORTED, SLIDE, Configured, Engine, Motion, Prepared, Rigid, State
from twoloop.bodies.parts import Body
from twoloop.problem.problem import Array

Acceleration = Callable[[Array, Array], Array]


class Settings(NamedTuple):
    """Semi-implicit ("Euler") or "RK4" steps; mu and iterations, None: the defaults; Baumgarte's parameter."""

    integrator: str = "Euler"
    mu: float | None = None
    iterations: int = 20
    baumgarte: float | None = None  # 1/s: double root


def prepare(rigid: Rigid, settings: Settings = Settings()) -> Prepared:  # noqa: B008
    """Build the mechanism in Pinocchio, with steps in Python as in its examples.

    Raises RuntimeError if Pinocchio is not installed. Raises ValueError if it has no counterpart of a joint.
    """
    pin = imported("pinocchio", "pin", extra="engines")
    model, frames = _tree(pin, rigid)
    constraints = pin.StdVec_RigidConstraintModel()
    for a, on_a, b, on_b in rigid.cut_points():
        ends = [
            (joint, origin * pin.SE3(np.eye(3), point))
            for (joint, origin), point in ((frames[a.number], on_a), (frames[b.number], on_b))
        ]
        kind, axes = pin.ContactType.CONTACT_3D, pin.ReferenceFrame.LOCAL
        constraint = pin.RigidConstraintModel(kind, model, *ends[0], *ends[1], axes)
        if settings.baumgarte is not None:
            gains = constraint.m_baumgarte_parameters
            gains.Kp, gains.Kd = settings.baumgarte**2, 2.0 * settings.baumgarte
            constraint.setBaumgarteCorrectorParameters(gains)
        constraints.append(constraint)
    n_points = {"spherical": 1, "revolute": 2}[rigid.loops[0].kind] if rigid.loops else 0
    proximal = pin.ProximalSettings(*(() if settings.mu is None else (1e-14, settings.mu, settings.iterations)))

    def run(t_end: float, n_steps: int, n_stored: int) -> Motion:
        began = time.process_time()
        h, data = t_end / n_steps, model.createData()
        datas = pin.StdVec_RigidConstraintData()
        for item in constraints:
            datas.append(item.createData())
        pin.initConstraintDynamics(model, data, constraints, datas)
        force = _force(pin, rigid, model, data, frames)

        def acceleration(q: Array, v: Array) -> Array:
            return np.asarray(pin.constraintDynamics(model, data, q, v, force(q, v), constraints, datas, proximal))

        q, v, rate = pin.neutral(model), _start(rigid, frames, model), _rates(model)

        def step(n: int, t: float) -> str:
            nonlocal q, v
            for _ in range(n):
                if settings.integrator == "Euler":
                    v = v + h * acceleration(q, v)
                    q = pin.integrate(model, q, h * v)
                else:
                    q, v = _runge_kutta(acceleration, rate, q, v, h)
                    q = pin.normalize(model, q)
                if not np.isfinite(v).all():
                    return "the accelerations are not finite"
            return ""

        def see() -> State:
            pin.forwardKinematics(model, data, q, v)
            own = [frames[k] for k in range(len(rigid.x))]
            poses = [data.oMi[joint] * origin for joint, origin in own]
            twists = [origin.actInv(data.v[joint]) for joint, origin in own]
            x, R = np.array([item.translation for item in poses]), np.array([item.rotation for item in poses])
            speeds, spins = (
                np.array([pose.rotation @ getattr(twist, part) for pose, twist in zip(poses, twists, strict=True)])
                for part in ("linear", "angular")
            )
            f = NOT_REPORTED
            if n_points:
                acceleration(q, v)
                turned = data.oMi[constraints[0].joint1_id].rotation @ constraints[0].joint1_placement.rotation
                f = turned @ np.sum([item.contact_force.linear for item in list(datas)[:n_points]], axis=0)
            return x, R, speeds, spins, f

        return parts.march(began, h, n_steps, n_stored, see, step)

    inertias = [model.inertias[frames[k][0]] for k in range(len(rigid.x))]
    moments = [float(np.linalg.eigvalsh(item.inertia)[-1]) for item in inertias]
    return Prepared(np.array([item.mass for item in inertias]), np.array(moments), run)


def _tree(pin: Any, rigid: Rigid) -> tuple[Any, dict[int, tuple[int, Any]]]:
    """Return the model, and for each body its joint and the position of its centre of mass relative to it."""
    model = pin.Model()
    model.gravity = pin.Motion(np.array(rigid.model.gravity), np.zeros(3))
    frames = {rigid.model.ground.number: (0, pin.SE3.Identity())}
    # depth-first order: joints in another order silently give wrong accelerations
    ahead = _children(rigid, rigid.model.ground)
    while ahead:
        body = ahead.pop()
        parent, joint = rigid.parents[body.number]
        ahead += _children(rigid, body)
        point = parts.point_of(body, joint)
        number, origin = frames[parent.number]
        place = origin * pin.SE3(parent.rotation.T @ body.rotation, parent.local_point(body.in_space(point)))
        for k, (kind, axis) in enumerate(parts.freedoms(body, joint)):
            kinds = {BALL: pin.JointModelSpherical, SLIDE: pin.JointModelPrismaticUnaligned}
            freedom = kinds[kind]() if kind == BALL else kinds.get(kind, pin.JointModelRevoluteUnaligned)(axis)
            number = model.addJoint(number, freedom, pin.SE3.Identity() if k else place, f"{joint.name} {k + 1}")
        origin = pin.SE3(np.eye(3), -point)
        inertia = pin.Inertia(float(body.inertia[0]), np.zeros(3), parts.tensor(body.inertia))
        model.appendBodyToJoint(number, inertia, origin)
        frames[body.number] = number, origin
    return model, frames


def _children(rigid: Rigid, parent: Body) -> list[Body]:
    return [body for body in rigid.model.bodies if rigid.parents[body.number][0] is parent]


def _start(rigid: Rigid, frames: dict[int, tuple[int, Any]], model: Any) -> Array:
    v = np.zeros(model.nv)
    for body in rigid.model.bodies:
        rates = rigid.rates(body)
        last = model.joints[frames[body.number][0]]
        v[last.idx_v + last.nv - len(rates) : last.idx_v + last.nv] = rates
    return v


def _force(
    pin: Any, rigid: Rigid, model: Any, data: Any, frames: dict[int, tuple[int, Any]]
) -> Callable[[Array, Array], Array]:
    """Return the generalised forces of springs and constant torques as a function of q and v."""
    springs, turning = parts.springs(rigid.model), np.flatnonzero(rigid.torques.any(axis=1))
    if not springs and not turning.size:
        zero = np.zeros(model.nv)
        return lambda q, v: zero

    def force(q: Array, v: Array) -> Array:
        pin.computeJointJacobians(model, data, q)
        tau = np.zeros(model.nv)

        def jacobian(body: int, point: Array) -> Array:
            """Return how a point of a body moves, above how the body turns (6, n_v), in the axes of space."""
            joint = frames[body][0]
            J = pin.getJointJacobian(model, data, joint, pin.ReferenceFrame.LOCAL_WORLD_ALIGNED).reshape(6, -1)
            return np.vstack([J[:3] - pin.skew(point - data.oMi[joint].translation) @ J[3:], J[3:]])

        for k in turning:
            tau += jacobian(int(k), np.zeros(3))[3:].T @ rigid.torques[k]
        for a, on_a, b, on_b, (stiffness, damping, length) in springs:
            ends = [
                (data.oMi[joint] * origin).act(point)
                for (joint, origin), point in ((frames[a.number], on_a), (frames[b.number], on_b))
            ]
            direction = ends[1] - ends[0]
            long = float(np.linalg.norm(direction))
            J = jacobian(b.number, ends[1])[:3] - jacobian(a.number, ends[0])[:3]
            rate = damping and direction @ (J @ v) / long
            tau -= J.T @ ((stiffness * (long - length) + damping * rate) / long * direction)
        return tau

    return force


def _rates(model: Any) -> Callable[[Array, Array], Array]:
    """Return dq/dt as a function of q and v; quaternions (x, y, z, w) of ball joints rotate in body axes."""
    balls = [(joint.idx_q, joint.idx_v) for joint in model.joints if joint.nq == 4]
    if not balls:
        return lambda q, v: v
    places = np.array([(joint.idx_q, joint.idx_v) for joint in model.joints if joint.nq == joint.nv == 1], dtype=int)

    def rate(q: Array, v: Array) -> Array:
        q_rate = np.zeros_like(q)
        q_rate[places[:, 0]] = v[places[:, 1]]
        for i, j in balls:
            f, e, w = q[i : i + 3], q[i + 3], v[j : j + 3]
            q_rate[i : i + 3], q_rate[i + 3] = 0.5 * (e * w + np.cross(f, w)), -0.5 * f @ w
        return q_rate

    return rate


def _runge_kutta(a: Acceleration, rate: Acceleration, q: Array, v: Array, h: float) -> tuple[Array, Array]:
    """Return a step of the classical fourth-order Runge-Kutta method, with quaternions as four numbers."""
    a1, u1 = a(q, v), rate(q, v)
    a2, u2 = a(q + 0.5 * h * u1, v2 := v + 0.5 * h * a1), rate(q + 0.5 * h * u1, v2)
    a3, u3 = a(q + 0.5 * h * u2, v3 := v + 0.5 * h * a2), rate(q + 0.5 * h * u2, v3)
    a4, u4 = a(q + h * u3, v4 := v + h * a3), rate(q + h * u3, v4)
    return q + h / 6.0 * (u1 + 2.0 * (u2 + u3) + u4), v + h / 6.0 * (a1 + 2.0 * (a2 + a3) + a4)


_PROXIMAL = "`ProximalSettings(1e-14, 1e-3, 20)`, `Kp` 100, `Kd` 20"
_EULER, _RK4, _STIFF = (Settings(*each, 20, 10.0) for each in (("Euler", 1e-3), ("RK4", 1e-3), ("RK4", 1e-8)))
ENGINE = Engine(
    *("Pinocchio", "pin", prepare, Settings("RK4", 1e-3)),
    (
        Configured("default", Settings()),
        Configured("Euler, Baumgarte", _EULER, f"semi-implicit Euler; {_PROXIMAL}"),
        Configured("RK4, Baumgarte", _RK4, f"RK4 of q and v; {_PROXIMAL}", everywhere=True),
        Configured("RK4, mu 1e-8", _STIFF, "as before, with `ProximalSettings(1e-14, 1e-8, 20)`"),
    ),
)
