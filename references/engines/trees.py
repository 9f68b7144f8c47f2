"""Trees of planar bodies with pins in MuJoCo and Pinocchio, to measure the cost of an evaluation of the dynamics."""

from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np
from scipy.integrate import solve_ivp

from references.driver import imported
from twoloop.mechanisms.planar import GROUND, PlanarBodies
from twoloop.problem.problem import Array

Z = (0.0, 0.0, 1.0)
MOMENTS = np.array([0.6, 0.6, 1.0])  # of a body in space that only rotates about z, relative to the last


class TreeDynamics(NamedTuple):
    """A tree at a state: `evaluate` computes its accelerations, `angular` returns those of the bodies in space (n,)."""

    evaluate: Callable[[], Any]
    angular: Callable[[], Array]


def _outwards(bodies: PlanarBodies) -> Iterator[tuple[int, Array, int, Array]]:
    """Yield each body, its centre relative to its pin, its parent, and the pin relative to the parent's pin.

    In body axes, in depth-first order, as required by Pinocchio.
    """
    hanging: dict[int, list[tuple[int, Array, Array]]] = {}
    for i, (x, y), j, (u, w) in bodies.pins:
        hanging.setdefault(j, []).append((i, np.array([x, y, 0.0]), np.array([u, w, 0.0])))
    stack: list[tuple[int, Array, tuple[int, Array, Array]]]
    stack = [(GROUND, np.zeros(3), child) for child in hanging[GROUND]]
    while stack:
        on, pin, (body, pin_in_child, pin_in_body) = stack.pop()
        yield body, -pin_in_child, on, pin_in_body - pin
        stack += [(body, pin_in_child, child) for child in hanging.get(body, ())]


def _parents(bodies: PlanarBodies) -> dict[int, int]:
    """Return the parent of each body, in the same order."""
    return {body: on for body, _, on, _ in _outwards(bodies)}


def _in_space(parents: dict[int, int], relative: Array) -> Array:
    """Return sums of joint quantities from the ground to each body."""
    sums = np.append(relative, 0.0)  # of the ground, which has the index of the last
    for body, on in parents.items():
        sums[body] += sums[on]
    return sums[:-1]


def _in_joints(parents: dict[int, int], values: Array) -> Array:
    """Return how much quantities of bodies differ from those of their parents."""
    return values - np.append(values, 0.0)[[parents[body] for body in range(len(values))]]


def mujoco_tree(bodies: PlanarBodies, angles: Array, rates: Array) -> TreeDynamics:
    """The tree in MuJoCo at angles and angular velocities in space (n,); an evaluation is `mj_forward`.

    Raises RuntimeError if MuJoCo is not installed.
    """
    mujoco, parents = imported("mujoco", extra="engines"), _parents(bodies)
    spec = mujoco.MjSpec()
    spec.option.gravity = [0.0, -bodies.gravity, 0.0]
    elements, halves = {GROUND: spec.worldbody}, 0.5 * _in_joints(parents, angles)
    for body, centre, on, pin in _outwards(bodies):
        mass = {"mass": bodies.masses[body], "inertia": bodies.inertias[body] * MOMENTS, "explicitinertial": True}
        turned = [np.cos(halves[body]), 0.0, 0.0, np.sin(halves[body])]
        elements[body] = elements[on].add_body(name=str(body), pos=pin, quat=turned, ipos=centre, **mass)
        elements[body].add_joint(type=mujoco.mjtJoint.mjJNT_HINGE, axis=Z)
    model = spec.compile()
    data = mujoco.MjData(model)
    first = [model.body(str(body)).dofadr[0] for body in range(len(angles))]
    data.qvel[first] = _in_joints(parents, rates)
    return TreeDynamics(lambda: mujoco.mj_forward(model, data), lambda: _in_space(parents, data.qacc[first]))


def _in_pinocchio(bodies: PlanarBodies) -> tuple[Any, Any, list[int]]:
    """Return the package, the model, and the index of the joint coordinate of each body."""
    package = imported("pinocchio", "pin", extra="engines")
    model = package.Model()
    model.gravity = package.Motion(np.array([0.0, -bodies.gravity, 0.0]), np.zeros(3))
    joints = {GROUND: 0}
    for body, centre, on, pin in _outwards(bodies):
        place = package.SE3(np.eye(3), pin)
        joints[body] = model.addJoint(joints[on], package.JointModelRZ(), place, str(body))
        inertia = package.Inertia(float(bodies.masses[body]), centre, np.diag(bodies.inertias[body] * MOMENTS))
        model.appendBodyToJoint(joints[body], inertia, package.SE3.Identity())
    return package, model, [model.joints[joints[body]].idx_v for body in range(len(bodies.masses))]


def pinocchio_tree(bodies: PlanarBodies, angles: Array, rates: Array) -> TreeDynamics:
    """Return the same in Pinocchio, with joints about z; an evaluation is `aba`.

    Raises RuntimeError if Pinocchio is not installed.
    """
    (pin, model, first), parents = _in_pinocchio(bodies), _parents(bodies)
    data, q, v, tau = model.createData(), *np.zeros((3, model.nv))
    q[first], v[first] = _in_joints(parents, angles), _in_joints(parents, rates)
    return TreeDynamics(lambda: pin.aba(model, data, q, v, tau), lambda: _in_space(parents, data.ddq[first]))


def end_by_pinocchio(bodies: PlanarBodies, angles: Array, t_end: float, tolerance: float) -> Array:
    """Return coordinates (3 n,) of a tree some time after its release, by SciPy's DOP853 with Pinocchio's `aba`.

    Raises RuntimeError if Pinocchio is not installed.
    """
    (pin, model, first), parents = _in_pinocchio(bodies), _parents(bodies)
    data, y0, tau = model.createData(), np.zeros(2 * model.nv), np.zeros(model.nv)
    y0[first] = _in_joints(parents, angles)

    def rate(t: float, y: Array) -> Array:
        q, v = np.split(y, 2)
        return np.concatenate([v, pin.aba(model, data, q, v, tau)])

    options = {"rtol": tolerance, "atol": tolerance, "method": "DOP853"}
    q = solve_ivp(rate, (0.0, t_end), y0, t_eval=(t_end,), **options).y[: model.nv, 0]
    pin.forwardKinematics(model, data, q)
    coordinates = np.column_stack([np.zeros((len(angles), 2)), _in_space(parents, q[first])])
    for body, centre, *_ in _outwards(bodies):
        coordinates[body, :2] = data.oMi[model.getJointId(str(body))].act(centre)[:2]
    return coordinates.ravel()


ENGINES = {"MuJoCo": mujoco_tree, "Pinocchio": pinocchio_tree}
