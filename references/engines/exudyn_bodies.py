"""Exudyn: rigid bodies with Euler parameters, or planar bodies with pins, with Exudyn's joints."""

import time
from typing import Any, NamedTuple

import numpy as np

from references.driver import imported
from references.engines import rigid as parts
from references.engines.rigid import UNTOLD, Configured, Engine, Motion, Prepared, Rigid

PLANAR_CUT = [1, 1, 0, 0, 0, 0]


class Settings(NamedTuple):
    """A solver of `references.exudyn.model`; spectral radius of generalized-alpha, None: Exudyn's 0.9."""

    solver: str = "GeneralizedAlpha"
    radius: float | None = None


def prepare(rigid: Rigid, settings: Settings = Settings()) -> Prepared:  # noqa: B008
    """Build the mechanism in Exudyn; the call includes making the model, because a run modifies it.

    Raises RuntimeError if Exudyn is not installed. Raises ValueError if it has no counterpart of a joint.
    """
    imported("exudyn", extra="references")
    from references.exudyn.model import check_steps
    from references.exudyn.model import run as run_exudyn

    planar = rigid.planar and all(joint.kind != "prismatic" for joint in rigid.model.joints)
    problem = rigid.given if planar else rigid.model.problem((0.0, 1.0))
    dependent = bool(rigid.given.freedom.redundant)
    x, R, v, w = (each[None] for each in (rigid.x, rigid.R, rigid.v, rigid.w))
    start = parts.coordinates(Motion(np.zeros(1), x, R, v, w, UNTOLD[None], 0.0, 0.0), planar)

    def build() -> Any:
        return _model(rigid, planar, *(each[:, 0].reshape(len(rigid.x), -1) for each in start))

    def run(t_end: float, n_steps: int, n_stored: int) -> Motion:
        began = time.process_time()
        every = n_steps // n_stored
        steps = check_steps(problem, t_end, n_steps, settings.solver, every, None, settings.radius)
        model, sensor, axes = build()
        made = run_exudyn(model.mbs, model.sensors, np.concatenate(model.reference), steps, None, dependent)
        call = time.process_time() - began
        located = parts.states(planar, made.q, made.v)
        f = np.full((made.t.size, 3), np.nan) if sensor < 0 else model.mbs.GetSensorStoredData(sensor)[:, 1:4]
        if not planar and sensor >= 0:
            f = np.einsum("tij,tj->ti", located[1][:, rigid.loops[0].a.number] @ axes, f)
        return Motion(made.t, *located, f, call, made.stats.cpu_time, "" if made.success else made.message)

    made, *_ = build()
    masses, inertias = ([made.mbs.GetObject(body)[name] for body in made.bodies] for name in ("mass", "inertia"))
    moments = [
        J if planar else parts.largest_moment(np.array([0.0, *np.array(J)[[0, 1, 2, 5, 4, 3]]])) for J in inertias
    ]
    return Prepared(np.array(masses), np.array(moments), run)


def _model(rigid: Rigid, planar: bool, q: Any, v: Any) -> tuple[Any, int, Any]:
    """Return the model, a sensor of the force of the first loop-closing joint, and its axes in its first body."""
    from references.exudyn.model import PRISMATIC, REVOLUTE, SPHERICAL, UNIVERSAL, Model, frame

    locked = {"revolute": REVOLUTE, "prismatic": PRISMATIC, "spherical": SPHERICAL, "universal": UNIVERSAL}
    model = Model(rigid.model.gravity)
    sensor, own, made_of = -1, np.eye(3), {}
    for body, state, rate in zip(rigid.model.bodies, q, v, strict=True):
        mass, xx, yy, zz, xy, xz, yz = body.inertia.tolist()
        if planar:
            model.planar_body(mass, zz, state, rate)
        else:
            model.body(mass, (xx, yy, zz, yz, xz, xy), state, rate)
    for joint in rigid.model.joints:
        a, b = joint.a.number, joint.b.number
        if planar:
            made = model.pin(a, tuple(parts.point_of(joint.a, joint)[:2]), b, tuple(parts.point_of(joint.b, joint)[:2]))
            sensor = model.force_sensor(made, False) if joint.name == rigid.cut else sensor
            continue
        axes = [end.rotation @ parts.axis_of(end, joint) for end in (joint.a, joint.b)]
        turned = frame(axes[0])
        if joint.kind == "prismatic":
            turned = turned[:, [2, 0, 1]]  # along x
        elif joint.kind == "universal":
            turned = np.column_stack([*axes, np.cross(*axes)])
        elif joint.kind not in locked:
            raise ValueError(f"Exudyn is given {', '.join(locked)} joints; {joint.name!r} is {joint.kind}")
        flat = rigid.planar and joint.kind == "spherical"
        turned = np.eye(3) if flat else turned
        point = joint.a.in_space(parts.point_of(joint.a, joint))
        made = model.joint(a, b, point, turned, PLANAR_CUT if flat else locked[joint.kind])
        made_of[joint.name] = made
        if joint.name == rigid.cut:
            sensor, own = model.force_sensor(made, True), joint.a.rotation.T @ turned
    for one, at, other, there, values in parts.springs(rigid.model):
        # Exudyn's planar bodies take points in body axes, see Model.planar_body
        ends = (at, there) if planar else (one.in_space(at), other.in_space(there))
        model.spring(one.number, ends[0], other.number, ends[1], *values)
    for name, (stiffness, damping, angle) in parts.hinge_springs(rigid.model).items():
        joint = next(each for each in rigid.model.joints if each.name == name)
        if not planar:
            model.twist(made_of[name], stiffness, damping, angle)
            continue
        if rigid.model.ground not in (joint.a, joint.b):
            raise ValueError(f"Exudyn is given springs in planar hinges on the ground; {name!r} is another joint")
        model.turn(joint.body.number, stiffness, damping, (1.0 if joint.a is rigid.model.ground else -1.0) * angle)
    for k in np.flatnonzero(rigid.torques.any(axis=1)):
        model.torque(int(k), rigid.torques[k])
    model.mbs.Assemble()
    return model, sensor, own


ENGINE = Engine(
    *("Exudyn", "exudyn", prepare, Settings()),
    (
        Configured("generalized-alpha", Settings(), everywhere=True),
        Configured("trapezoidal", Settings("TrapezoidalIndex2"), "`TrapezoidalIndex2`"),
    ),
)
