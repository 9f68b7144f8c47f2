"""An MJCF file in MuJoCo and as a model with rigid joints, with the same start and forces, compared beforehand."""

import os
from importlib import import_module
from typing import Any, NamedTuple

import numpy as np

from twoloop.bodies.model_problem import ModelProblem
from twoloop.bodies.rotation import euler_parameters, euler_rates
from twoloop.bodies.spatial_model import SpatialModel
from twoloop.checks.arguments import Array

# prefixes of ignored parts that can be disabled in MuJoCo
SWITCHED_OFF = (
    *("contacts between", "contact", "limits of", "armature of", "frictionloss of", "actuator", "sensor", "keyframe"),
    *("gravcomp of", "stiffness and damping of joint", "equality", "tendon"),
    *("density of the", "viscosity of the", "wind of the"),
)
OFF = ("CONTACT", "LIMIT", "FRICTIONLOSS", "ACTUATION")
SAME = 1e-6  # tolerance of masses and forces, relative to the largest
CLOSED, MOVED = 1e-12, 1e-6  # m: gap of a closed loop; smallest displacement of the start that is reported
INTEGRATORS = ("Euler", "RK4", "implicit", "implicitfast")  # in MuJoCo's order
ITERATIONS, TOLERANCE = 100, 1e-8  # MuJoCo's defaults for its constraint solver
DISPLACED = 0.3  # m and rad: joint displacements at which forces are compared


class Settings(NamedTuple):
    """MuJoCo's settings of a run; None: as in the file. `stiff`: loops as stiff as the step allows."""

    integrator: str | None = None
    stiff: bool = False


class InMuJoCo:
    """A file in MuJoCo, without the parts that the model with rigid joints lacks.

    Parameters
    ----------
    path : path-like
    model : SpatialModel
        The model read by `from_mjcf` from the same file.

    Raises RuntimeError if MuJoCo is not installed. Raises ValueError if MuJoCo rejects the file, or a part that the
    model lacks cannot be disabled.
    """

    def __init__(self, path: str | os.PathLike[str], model: SpatialModel):
        try:
            self.mujoco: Any = import_module("mujoco")
        except ImportError:
            raise RuntimeError("mujoco is not installed: pip install mujoco") from None
        if kept := [each for each in model.ignored if not each.startswith(SWITCHED_OFF)]:
            raise ValueError(
                f"the model of rigid joints lacks {'; '.join(kept)}, which cannot be disabled in MuJoCo: "
                "remove it from the file, or expand it (MuJoCo's mj_saveLastXML)"
            )
        try:
            self.engine = self.mujoco.MjModel.from_xml_path(os.fspath(path))
        except ValueError as error:
            raise ValueError(f"MuJoCo rejects the file: {' '.join(str(error).split())}") from None
        self.model = model
        self._switch_off()
        engine = self.engine
        self.loops = np.flatnonzero(engine.eq_active0)
        self.bodies = np.flatnonzero(engine.body_jntnum > 0)
        if len(self.bodies) != len(model.bodies):
            raise ValueError(f"MuJoCo has {len(self.bodies)} bodies with joints, the model {len(model.bodies)}")
        if not len(self.loops):
            raise ValueError(
                "no connect and no weld is active: the file has no loop, and the joints of a tree cannot open"
            )
        data = self.mujoco.MjData(engine)
        self.mujoco.mj_kinematics(engine, data)
        self.centres = np.empty((len(self.bodies), 3))  # centres of mass in body frames, with fixed parts
        for centre, body in zip(self.centres, self.bodies, strict=True):
            group = np.flatnonzero(engine.body_weldid == body)
            place = np.average(data.xipos[group], axis=0, weights=engine.body_mass[group])
            centre[:] = data.xmat[body].reshape(3, 3).T @ (place - data.xpos[body])
        option = engine.opt
        self.step, self.integrator = option.timestep, INTEGRATORS[option.integrator]
        self.solver = option.solver, option.iterations, option.tolerance
        self.loop_numbers = engine.eq_solref.copy(), engine.eq_solimp.copy()

    def _switch_off(self) -> None:
        """Disable in MuJoCo's model the parts that the model of rigid joints lacks."""
        mujoco, engine = self.mujoco, self.engine
        for name in OFF:
            engine.opt.disableflags |= getattr(mujoco.mjtDisableBit, f"mjDSBL_{name}")
        engine.opt.density = engine.opt.viscosity = 0.0
        engine.body_gravcomp[:] = 0.0
        if engine.opt.disableflags & (mujoco.mjtDisableBit.mjDSBL_EQUALITY | mujoco.mjtDisableBit.mjDSBL_CONSTRAINT):
            engine.eq_active0[:] = 0
        kept = np.isin(engine.eq_type, (mujoco.mjtEq.mjEQ_CONNECT, mujoco.mjtEq.mjEQ_WELD))
        engine.eq_active0[~kept] = 0
        single = int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE)
        for k in range(engine.njnt):
            own = engine.dof_jntid == k
            higher = engine.jnt_stiffnesspoly[k].any() or engine.dof_dampingpoly[own].any()
            if higher or engine.body_jntnum[engine.jnt_bodyid[k]] > 1 or int(engine.jnt_type[k]) not in single:
                engine.jnt_stiffness[k] = engine.jnt_stiffnesspoly[k] = 0.0
                engine.dof_damping[own] = engine.dof_dampingpoly[own] = 0.0
        for k in range(engine.ntendon):
            first, n = engine.tendon_adr[k], engine.tendon_num[k]
            sites = n == 2 and (engine.wrap_type[first : first + n] == mujoco.mjtWrap.mjWRAP_SITE).all()
            lengths = engine.tendon_lengthspring[k]
            if not sites or engine.tendon_limited[k] or lengths[0] != lengths[1]:
                engine.tendon_stiffness[k] = engine.tendon_damping[k] = 0.0
        if engine.dof_armature.any() or engine.tendon_armature.any():
            engine.dof_armature[:] = 0.0
            engine.tendon_armature[:] = 0.0
            mujoco.mj_setConst(engine, mujoco.MjData(engine))

    @property
    def keyframes(self) -> list[str]:
        """Return the names of the keyframes, or their numbers if unnamed."""
        kind = self.mujoco.mjtObj.mjOBJ_KEY
        return [self.mujoco.mj_id2name(self.engine, kind, k) or str(k) for k in range(self.engine.nkey)]

    def start(self, key: str | None) -> tuple[Array, Array, float]:
        """Return joint coordinates and velocities of a keyframe, or of the file's pose, with closed loops, and the gap.

        Raises ValueError if there is no such keyframe, or the loops cannot be closed from there.
        """
        mujoco, engine = self.mujoco, self.engine
        data = mujoco.MjData(engine)
        if key is not None:
            if key not in self.keyframes:
                raise ValueError(f"the file has no keyframe {key!r}; it has {', '.join(self.keyframes) or 'none'}")
            mujoco.mj_resetDataKeyframe(engine, data, self.keyframes.index(key))
        gap = None
        for _ in range(100):
            rows, off = self._rows(data)
            gap = float(np.abs(off).max()) if gap is None else gap
            if np.abs(off).max() < CLOSED:
                break
            mujoco.mj_integratePos(engine, data.qpos, -np.linalg.lstsq(rows, off, rcond=1e-9)[0], 1.0)
        else:
            raise ValueError(
                f"the loops are open by {gap:.2g} m at the start, and cannot be closed from there (residual: "
                f"{np.abs(off).max():.2g}): start from a keyframe in which they are closed (--key)"
            )
        data.qvel[:] -= np.linalg.lstsq(rows, rows @ data.qvel, rcond=1e-9)[0]
        return data.qpos.copy(), data.qvel.copy(), float(gap or 0.0)

    def _rows(self, data: Any) -> tuple[Array, Array]:
        """Return the rows (n, nv) of the loops and their residuals (n,)."""
        mujoco, engine = self.mujoco, self.engine
        given, engine.opt.jacobian = engine.opt.jacobian, mujoco.mjtJacobian.mjJAC_DENSE
        mujoco.mj_forward(engine, data)
        engine.opt.jacobian = given
        own = data.efc_type == mujoco.mjtConstraint.mjCNSTR_EQUALITY
        return data.efc_J.reshape(-1, engine.nv)[own].copy(), data.efc_pos[own].copy()

    def coordinates(self, data: Any) -> tuple[Array, Array]:
        """Return the coordinates of the model (n_q,) and their derivatives by MuJoCo's velocities, (n_q, nv)."""
        n, nv = len(self.bodies), self.engine.nv
        q, by_v = np.empty((n, 7)), np.empty((n, 7, nv))
        moved, turned = np.empty((3, nv)), np.empty((3, nv))
        self.mujoco.mj_kinematics(self.engine, data)
        self.mujoco.mj_comPos(self.engine, data)
        for k, body in enumerate(self.bodies):
            q[k] = self._pose(data, k)
            self.mujoco.mj_jac(self.engine, data, moved, turned, q[k, :3], body)
            by_v[k, :3] = moved
            by_v[k, 3:] = np.array([euler_rates(q[k, 3:], column) for column in turned.T]).T
        return q.reshape(-1), by_v.reshape(-1, nv)

    def _pose(self, data: Any, k: int) -> Array:
        R = data.xmat[self.bodies[k]].reshape(3, 3)
        return np.append(data.xpos[self.bodies[k]] + R @ self.centres[k], euler_parameters(R))

    def compare(self, problem: ModelProblem, start: Array) -> None:
        """Raise ValueError if masses, forces, dampers or loops differ from those of the model of rigid joints.

        Mass matrices and generalised forces of the tree are compared in MuJoCo's coordinates at a displaced position,
        and the admissible velocities of the loops at the start.
        """
        mujoco, engine = self.mujoco, self.engine
        data = mujoco.MjData(engine)
        mujoco.mj_integratePos(engine, data.qpos, DISPLACED * np.random.default_rng(1).uniform(-1, 1, engine.nv), 1.0)
        unit = np.eye(engine.nv)
        q, by_v = self.coordinates(data)
        system = problem.system

        def forces(v: Array) -> tuple[Array, Array]:
            data.qvel[:] = v
            mujoco.mj_forward(engine, data)
            return data.qfrc_passive - data.qfrc_bias, by_v.T @ system.force(0.0, q, by_v @ v)

        def damping(k: int) -> tuple[Array, Array]:
            (one, own), (other, theirs) = forces(unit[k]), forces(-unit[k])  # quadratic velocity terms cancel
            return 0.5 * (one - other), 0.5 * (own - theirs)

        still = forces(np.zeros(engine.nv))
        inertia = np.empty((engine.nv, engine.nv))
        for k in range(engine.nv):
            mujoco.mj_mulM(engine, data, inertia[k], unit[k])
        self._same("masses and inertias", inertia, by_v.T @ system.mass(0.0, q) @ by_v, 0.0)
        least = float(np.abs(inertia).max() + np.abs(still[0]).max())
        self._same("forces at rest (gravity, springs)", still[0], still[1], SAME * least)
        dampers = np.array([damping(k) for k in range(engine.nv)])  # (nv, 2, nv)
        self._same("forces of dampers", dampers[:, 0], dampers[:, 1], SAME * least)
        data.qpos[:], data.qvel[:] = start, 0.0
        rows, _ = self._rows(data)
        q, by_v = self.coordinates(data)
        own = system.jacobian(0.0, q) @ by_v
        ranks = [_rank(each) for each in (rows, own, np.vstack([rows, own]))]
        if len(set(ranks)) > 1:
            raise ValueError(
                f"the loops of MuJoCo's model leave {engine.nv - ranks[0]} velocities, those of the model "
                f"of rigid joints {engine.nv - ranks[1]}, both {engine.nv - ranks[2]}: is one inactive?"
            )

    def _same(self, what: str, engine: Array, own: Array, least: float) -> None:
        off, largest = np.abs(engine - own), max(float(np.abs(engine).max()), float(np.abs(own).max()), least)
        if off.max() > SAME * largest:
            dof = int(off.reshape(-1, self.engine.nv).max(axis=0).argmax())
            body = self.model.bodies[int(np.flatnonzero(self.bodies == self.engine.dof_bodyid[dof])[0])].name
            raise ValueError(
                f"MuJoCo's model differs from the one that was read: {what} differ by {off.max() / largest:.2g} of "
                f"the largest, most at a joint of {body!r}. MuJoCo has something there that `from_mjcf` lacks"
            )

    def simulator(self, qpos: Array, qvel: Array, settings: Settings) -> Any:
        """Return a function for `audit_simulator`, with a given start and settings."""
        mujoco, engine = self.mujoco, self.engine

        def simulate(problem: ModelProblem, times: Array, step: float) -> Array:
            self.set(settings, step)
            data = mujoco.MjData(engine)
            data.qpos[:], data.qvel[:] = qpos, qvel
            states = np.empty((times.size, len(self.bodies), 7))
            for row, n in zip(states, [0, *np.round(np.diff(times) / step).astype(int)], strict=True):
                if n:
                    mujoco.mj_step(engine, data, nstep=int(n))
                if (numbers := data.warning.number).any():
                    warned = mujoco.mjtWarning(int(numbers.argmax())).name.removeprefix("mjWARN_")
                    raise RuntimeError(f"MuJoCo warns of {warned} at {data.time:.3g} s or before")
                mujoco.mj_kinematics(engine, data)
                row[:] = [self._pose(data, k) for k in range(len(self.bodies))]
            return states.reshape(times.size, -1)

        return simulate

    def set(self, settings: Settings, step: float) -> None:
        """Set up MuJoCo's model for a step size."""
        engine, option = self.engine, self.engine.opt
        option.timestep = step
        option.integrator = INTEGRATORS.index(settings.integrator or self.integrator)
        option.solver, option.iterations, option.tolerance = self.solver
        engine.eq_solref[:], engine.eq_solimp[:] = self.loop_numbers
        if settings.stiff:
            engine.eq_solref[self.loops] = 2.0 * step, 1.0
            engine.eq_solimp[self.loops, :3] = 0.9999, 0.9999, 0.001
            option.solver, option.iterations, option.tolerance = self.good_solver

    @property
    def good_solver(self) -> tuple[int, int, float]:
        """Return the constraint solver settings for stiff loops: those of the file, unless they are worse."""
        _, iterations, tolerance = self.solver
        newton = int(self.mujoco.mjtSolver.mjSOL_NEWTON)
        return newton, max(iterations, ITERATIONS), min(tolerance, TOLERANCE)


def _rank(rows: Array) -> int:
    return int(np.linalg.matrix_rank(rows, rtol=SAME)) if rows.size else 0
