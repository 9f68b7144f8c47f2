"""Drake: a discrete plant with the SAP solver, loops closed by ball constraints between bodies."""

import time
from typing import Any, NamedTuple

import numpy as np

from references.driver import imported
from references.engines import rigid as parts
from references.engines.rigid import BALL, HINGE, NOT_REPORTED, SLIDE, Configured, Engine, Motion, Prepared, Rigid
from twoloop.problem.problem import Array


class Settings(NamedTuple):
    """Name the discrete contact approximation of the plant; "continuous": a plant integrated by Drake's simulator."""

    approximation: str = "kSap"


def prepare(rigid: Rigid, settings: Settings = Settings()) -> Prepared:  # noqa: B008
    """Build the mechanism in Drake; the step belongs to the plant, so each call makes a plant.

    Raises RuntimeError if Drake is not installed or rejects a step. Raises ValueError if it has no counterpart of a
    joint.
    """
    simulation = _module("systems.analysis")

    def run(t_end: float, n_steps: int, n_stored: int) -> Motion:
        began = time.process_time()
        h = t_end / n_steps
        plant, bodies = _plant(rigid, settings, h)
        simulator = simulation.Simulator(plant)
        context = simulator.get_mutable_context()
        _start(rigid, plant, context, bodies)
        simulator.Initialize()

        def step(n: int, t: float) -> str:
            try:
                simulator.AdvanceTo(t)
            except RuntimeError as error:
                return str(error).strip().splitlines()[0]
            return ""

        def see() -> parts.State:
            poses = [plant.EvalBodyPoseInWorld(context, body) for body in bodies]
            twists = [plant.EvalBodySpatialVelocityInWorld(context, body) for body in bodies]
            x = np.array([pose.translation() for pose in poses])
            R = np.array([pose.rotation().matrix() for pose in poses])
            v, w = (np.array([getattr(each, part)() for each in twists]) for part in ("translational", "rotational"))
            return x, R, v, w, _force(rigid, plant, context, bodies)

        return parts.march(began, h, n_steps, n_stored, see, step)

    _, bodies = _plant(rigid, settings, 1e-3)
    if refused := run(1e-6, 1, 1).message:
        raise RuntimeError(refused.split(": ", 1)[1])
    inertias = [body.default_spatial_inertia() for body in bodies]
    moments = [float(inertia.CalcRotationalInertia().CalcPrincipalMomentsOfInertia().max()) for inertia in inertias]
    return Prepared(np.array([inertia.get_mass() for inertia in inertias]), np.array(moments), run)


def _module(name: str) -> Any:
    return imported(f"pydrake.{name}", "drake", extra="engines")


def _plant(rigid: Rigid, settings: Settings, h: float) -> tuple[Any, list[Any]]:
    mathematics, multibody, tree = (_module(name) for name in ("math", "multibody.plant", "multibody.tree"))
    plant = multibody.MultibodyPlant(0.0 if settings.approximation == "continuous" else h)
    if settings.approximation != "continuous":
        approximations = multibody.DiscreteContactApproximation
        plant.set_discrete_contact_approximation(getattr(approximations, settings.approximation))
    plant.mutable_gravity_field().set_gravity_vector(rigid.model.gravity)
    drake_bodies = {rigid.model.ground.number: plant.world_body()}
    for body in rigid.model.bodies:
        mass, *moments = body.inertia.tolist()
        unit = tree.UnitInertia().SetFromRotationalInertia(tree.RotationalInertia(*moments), mass)
        drake_bodies[body.number] = plant.AddRigidBody(body.name, tree.SpatialInertia(mass, np.zeros(3), unit))
    for body in rigid.model.bodies:
        parent, joint = rigid.parents[body.number]
        joint_point, freedoms = parts.point_of(body, joint), parts.freedoms(body, joint)
        turned = np.eye(3)
        if len(freedoms) == 2:  # the axes of a universal joint
            turned = np.column_stack([freedoms[0][1], freedoms[1][1], np.cross(freedoms[0][1], freedoms[1][1])])
        frames = []
        for end, R, point in (
            (parent, parent.rotation.T @ body.rotation @ turned, parent.local_point(body.in_space(joint_point))),
            (body, turned, joint_point),
        ):
            pose = mathematics.RigidTransform(mathematics.RotationMatrix.ProjectToRotationMatrix(R), point)
            name = f"{joint.name} on {end.name}"
            frames.append(plant.AddFrame(tree.FixedOffsetFrame(name, drake_bodies[end.number].body_frame(), pose)))
        plant.AddJoint(_joint(joint.name, freedoms, frames))
    for a, on_a, b, on_b in rigid.cut_points():
        plant.AddBallConstraint(drake_bodies[a.number], on_a, drake_bodies[b.number], on_b)
    for a, on_a, b, on_b, (stiffness, damping, length) in parts.springs(rigid.model):
        ends = drake_bodies[a.number], on_a, drake_bodies[b.number], on_b
        plant.AddForceElement(tree.LinearSpringDamper(*ends, length, stiffness, damping))
    plant.Finalize()
    return plant, [drake_bodies[body.number] for body in rigid.model.bodies]


def _joint(name: str, freedoms: list[tuple[str, Any]], frames: list[Any]) -> Any:
    tree = _module("multibody.tree")
    kinds = tuple(kind for kind, _ in freedoms)
    if kinds == (BALL,):
        return tree.BallRpyJoint(name, *frames)
    if kinds == (HINGE, HINGE):
        return tree.UniversalJoint(name, *frames)
    if kinds in ((HINGE,), (SLIDE,)):
        joint_type = tree.RevoluteJoint if kinds == (HINGE,) else tree.PrismaticJoint
        return joint_type(name, *frames, freedoms[0][1])
    raise ValueError(f"Drake is given hinges, slides, balls and universal joints; {name!r} is of {' and '.join(kinds)}")


def _force(rigid: Rigid, plant: Any, context: Any, bodies: list[Any]) -> Array:
    """Return the force of the first loop-closing joint, from the balance of accelerations; Drake does not report it."""
    if not rigid.loops:
        return NOT_REPORTED
    try:
        rates = plant.get_generalized_acceleration_output_port().Eval(context)
    except RuntimeError:  # reported by an adjacent step
        return NOT_REPORTED
    forces = _module("multibody.tree").MultibodyForces(plant)
    plant.CalcForceElementsContribution(context, forces)
    by_v, world = _module("multibody.tree").JacobianWrtVariable.kV, [plant.world_frame()] * 2

    def moved(body: Any, point: Array) -> Array:
        return plant.CalcJacobianTranslationalVelocity(context, by_v, bodies[body.number].body_frame(), point, *world)

    rows = [moved(a, on_a) - moved(b, on_b) for a, on_a, b, on_b in rigid.cut_points()]
    missing = plant.CalcInverseDynamics(context, rates, forces)
    for k in np.flatnonzero(rigid.torques.any(axis=1)):
        J = plant.CalcJacobianAngularVelocity(context, by_v, bodies[k].body_frame(), *world)
        missing -= J.T @ rigid.torques[k]
    forces_ = np.linalg.lstsq(np.vstack(rows).T, missing, rcond=1e-9)[0].reshape(-1, 3)
    return forces_[: {"spherical": 1, "revolute": 2}[rigid.loops[0].kind]].sum(axis=0)


def _start(rigid: Rigid, plant: Any, context: Any, bodies: list[Any]) -> None:
    v = plant.GetVelocities(context).copy()
    for body in rigid.model.bodies:
        joint, rates = plant.GetJointByName(rigid.parents[body.number][1].name), rigid.rates(body)
        v[joint.velocity_start() : joint.velocity_start() + len(rates)] = rates
    plant.SetVelocities(context, v)
    forces = []
    for k in np.flatnonzero(rigid.torques.any(axis=1)):
        force = _module("multibody.plant").ExternallyAppliedSpatialForce()
        force.body_index, force.p_BoBq_B = bodies[k].index(), np.zeros(3)
        force.F_Bq_W = _module("multibody.math").SpatialForce(tau=rigid.torques[k], f=np.zeros(3))
        forces.append(force)
    if forces:
        plant.get_applied_spatial_force_input_port().FixValue(context, forces)


ENGINE = Engine(
    *("Drake", "drake", prepare, Settings()),
    (
        Configured("SAP", Settings(), "`kSap`", everywhere=True),
        Configured("TAMSI", Settings("kTamsi"), "`kTamsi`"),
        Configured("continuous", Settings("continuous"), "a plant with step 0"),
    ),
)
