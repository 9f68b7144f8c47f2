"""Exudyn: rigid bodies with Euler parameters, or planar bodies with pins, with Exudyn's joints."""

import time
from typing import Any, NamedTuple

import numpy as np

from references.driver import imported
from references.engines import rigid as parts
from references.engines.rigid import NOT_REPORTED, Configured, Engine, Motion, Prepared, Rigid
from references.exudyn.model import PRISMATIC, REVOLUTE, SPHERICAL, UNIVERSAL, Model, check_steps, frame
from references.exudyn.model import run as run_exudyn

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
    planar = rigid.planar and all(joint.kind != "prismatic" for joint in rigid.model.joints)
    problem = rigid.given if planar else rigid.model.problem((0.0, 1.0))
    dependent = bool(rigid.given.freedom.redundant)
    x, R, v, w = (array[None] for array in (rigid.x, rigid.R, rigid.v, rigid.w))
    start = parts.coordinates(Motion(np.zeros(1), x, R, v, w, NOT_REPORTED[None], 0.0, 0.0), planar)

    def build() -> Any:
        return _model(rigid, planar, *(array[:, 0].reshape(len(rigid.x), -1) for array in start))

    def run(t_end: float, n_steps: int, n_stored: int) -> Motion:
        began = time.process_time()
        every = n_steps // n_stored
        steps = check_steps(problem, t_end, n_steps, settings.solver, every, None, settings.radius)
        model, sensor, axes = build()
        result = run_exudyn(model, steps, dependent_rows=dependent)
        call = time.process_time() - began
        located = parts.states(planar, result.q, result.v)
        f = np.full((result.t.size, 3), np.nan) if sensor < 0 else model.mbs.GetSensorStoredData(sensor)[:, 1:4]
        if not planar and sensor >= 0:
            f = np.einsum("tij,tj->ti", located[1][:, rigid.loops[0].a.number] @ axes, f)
        return Motion(result.t, *located, f, call, result.stats.cpu_time, "" if result.success else result.message)

    result, *_ = build()
    masses, inertias = ([result.mbs.GetObject(body)[name] for body in result.bodies] for name in ("mass", "inertia"))
    moments = [
        J if planar else parts.largest_moment(np.array([0.0, *np.array(J)[[0, 1, 2, 5, 4, 3]]])) for J in inertias
    ]
    return Prepared(np.array(masses), np.array(moments), run)


def _model(rigid: Rigid, planar: bool, q: Any, v: Any) -> tuple[Any, int, Any]:
    """Return the model, a sensor of the force of the first loop-closing joint, and its axes in its first body."""
    locked = {"revolute": REVOLUTE, "prismatic": PRISMATIC, "spherical": SPHERICAL, "universal": UNIVERSAL}
    model = Model(rigid.model.gravity)
    sensor, axes_in_body = -1, np.eye(3)
    for body, state, rate in zip(rigid.model.bodies, q, v, strict=True):
        mass, xx, yy, zz, xy, xz, yz = body.inertia.tolist()
        if planar:
            model.planar_body(mass, zz, state, rate)
        else:
            model.body(mass, (xx, yy, zz, yz, xz, xy), state, rate)
    for joint in rigid.model.joints:
        a, b = joint.a.number, joint.b.number
        if planar:
            on_a, on_b = (tuple(parts.point_of(body, joint)[:2]) for body in (joint.a, joint.b))
            number = model.pin(a, on_a, b, on_b)
            sensor = model.force_sensor(number, False) if joint.name == rigid.cut else sensor
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
        number = model.joint(a, b, point, turned, PLANAR_CUT if flat else locked[joint.kind])
        if joint.name == rigid.cut:
            sensor, axes_in_body = model.force_sensor(number, True), joint.a.rotation.T @ turned
    for first, on_first, second, on_second, values in parts.springs(rigid.model):
        # Exudyn's planar bodies take points in body axes, see Model.planar_body
        ends = (on_first, on_second) if planar else (first.in_space(on_first), second.in_space(on_second))
        model.spring(first.number, ends[0], second.number, ends[1], *values)
    for k in np.flatnonzero(rigid.torques.any(axis=1)):
        model.torque(int(k), rigid.torques[k])
    model.mbs.Assemble()
    return model, sensor, axes_in_body


ENGINE = Engine(
    *("Exudyn", "exudyn", prepare, Settings()),
    (
        Configured("generalized-alpha", Settings(), everywhere=True),
        Configured("trapezoidal", Settings("TrapezoidalIndex2"), "`TrapezoidalIndex2`"),
    ),
)
