"""Find the integrator, solref and time step that MuJoCo needs for the closed loops of an MJCF file.

The file in MuJoCo and the model with rigid joints have the same start and forces, which is checked beforehand.
"""

import csv
import json
import os
import warnings
from dataclasses import dataclass, replace
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from twoloop.audit.simulator import Audit, AuditedRun, audit_simulator
from twoloop.bodies.file_parts import IgnoredWarning, about
from twoloop.bodies.mjcf_reader import from_mjcf
from twoloop.bodies.model_problem import ModelProblem
from twoloop.bodies.rotation import euler_parameters, euler_rates, rotation_matrix
from twoloop.bodies.spatial.model import SpatialModel
from twoloop.checks.arguments import Array, check_positive
from twoloop.run.projection import consistent_state

# prefixes of ignored parts that can be disabled in MuJoCo
DISABLED_PARTS = (
    *("contacts between", "contact", "limits of", "frictionloss of", "actuator", "the command of", "sensor"),
    *("actuatorfrcrange of", "the damping ratio of", "stiffness and damping of joint", "equality", "tendon"),
)
DISABLE_FLAGS = ("CONTACT", "LIMIT", "FRICTIONLOSS", "ACTUATION")
AGREEMENT = 1e-6  # largest difference of masses and forces, relative to the largest of them
CLOSED, MOVED = 1e-12, 1e-6  # m: gap of a closed loop; smallest displacement of the start that is reported
INTEGRATORS = ("Euler", "RK4", "implicit", "implicitfast")  # in MuJoCo's order
ITERATIONS, TOLERANCE = 100, 1e-8  # MuJoCo's defaults for its constraint solver
CHANGE_FACTOR = 1.4  # a setting that changes more of the file must be cheaper by this factor
ENDINGS = (".json", ".csv")
DISPLACED = 0.3  # m and rad: joint displacements at which forces are compared


class Settings(NamedTuple):
    """MuJoCo's settings of a run; None: as in the file. `stiff`: loops as stiff as the step allows."""

    integrator: str | None = None
    stiff: bool = False


class MujocoModel:
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
        if unsupported := [part for part in model.ignored if not part.startswith(DISABLED_PARTS)]:
            raise ValueError(
                f"the model of rigid joints lacks {'; '.join(unsupported)}, which cannot be disabled in MuJoCo: "
                "remove it from the file"
            )
        try:
            self.engine = self.mujoco.MjModel.from_xml_path(os.fspath(path))
        except ValueError as error:
            raise ValueError(f"MuJoCo rejects the file: {' '.join(str(error).split())}") from None
        self.model = model
        model.forces = [each for each in model.forces if not any(each is other for other in model.actuators)]
        self._disable_parts()
        engine = self.engine
        self.loops = np.flatnonzero(engine.eq_active0)
        heavy, moving = sum(body.inertia.any() for body in model.bodies), np.flatnonzero(engine.body_jntnum > 0)
        if len(moving) != heavy:
            raise ValueError(f"MuJoCo has {len(moving)} bodies with joints, the model {heavy}")
        # for each body of the model, the body in MuJoCo; massless bodies of the model move with its first joints only
        following = np.cumsum([0, *(body.inertia.any() for body in model.bodies)])[:-1]
        self.bodies = moving[following]
        self.n_joints = [
            k + 1 - int(np.flatnonzero(following == following[k])[0]) if not body.inertia.any() else 0
            for k, body in enumerate(model.bodies)
        ]
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

    def _disable_parts(self) -> None:
        """Disable in MuJoCo's model the parts that the model of rigid joints lacks."""
        mujoco, engine = self.mujoco, self.engine
        for name in DISABLE_FLAGS:
            engine.opt.disableflags |= getattr(mujoco.mjtDisableBit, f"mjDSBL_{name}")
        if engine.opt.disableflags & (mujoco.mjtDisableBit.mjDSBL_EQUALITY | mujoco.mjtDisableBit.mjDSBL_CONSTRAINT):
            engine.eq_active0[:] = 0
        kept = [mujoco.mjtEq.mjEQ_CONNECT, mujoco.mjtEq.mjEQ_WELD]
        kept += (
            [mujoco.mjtEq.mjEQ_JOINT, mujoco.mjtEq.mjEQ_TENDON]
            if any(each.kind == "coupling" for each in self.model.joints)
            else []
        )
        loops = np.isin(engine.eq_type, kept)
        engine.eq_active0[~loops] = 0
        free = int(mujoco.mjtJoint.mjJNT_FREE)
        for k in range(engine.njnt):
            dofs = engine.dof_jntid == k
            higher = engine.jnt_stiffnesspoly[k].any() or engine.dof_dampingpoly[dofs].any()
            if higher or (int(engine.jnt_type[k]) == free and engine.jnt_stiffness[k]):
                engine.jnt_stiffness[k] = engine.jnt_stiffnesspoly[k] = 0.0
                engine.dof_damping[dofs] = engine.dof_dampingpoly[dofs] = 0.0
        winding = mujoco.mjtWrap.mjWRAP_SPHERE, mujoco.mjtWrap.mjWRAP_CYLINDER
        for k in range(engine.ntendon):
            first, n = engine.tendon_adr[k], engine.tendon_num[k]
            winds = np.isin(engine.wrap_type[first : first + n], winding).any()
            if winds or engine.tendon_stiffnesspoly[k].any() or engine.tendon_dampingpoly[k].any():
                engine.tendon_stiffness[k] = engine.tendon_damping[k] = 0.0
                engine.tendon_stiffnesspoly[k] = engine.tendon_dampingpoly[k] = 0.0

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
            rows, residuals = self._rows(data)
            gap = float(np.abs(residuals).max()) if gap is None else gap
            if np.abs(residuals).max() < CLOSED:
                break
            mujoco.mj_integratePos(engine, data.qpos, -np.linalg.lstsq(rows, residuals, rcond=1e-9)[0], 1.0)
        else:
            raise ValueError(
                f"the loops are open by {gap:.2g} m at the start, and cannot be closed from there (residual: "
                f"{np.abs(residuals).max():.2g}): start from a keyframe in which they are closed (--key)"
            )
        data.qvel[:] -= np.linalg.lstsq(rows, rows @ data.qvel, rcond=1e-9)[0]
        return data.qpos.copy(), data.qvel.copy(), float(gap or 0.0)

    def _rows(self, data: Any) -> tuple[Array, Array]:
        """Return the rows (n, nv) of the loops and their residuals (n,)."""
        mujoco, engine = self.mujoco, self.engine
        jacobian, engine.opt.jacobian = engine.opt.jacobian, mujoco.mjtJacobian.mjJAC_DENSE
        mujoco.mj_forward(engine, data)
        engine.opt.jacobian = jacobian
        equality = data.efc_type == mujoco.mjtConstraint.mjCNSTR_EQUALITY
        return data.efc_J.reshape(-1, engine.nv)[equality].copy(), data.efc_pos[equality].copy()

    def coordinates(self, data: Any) -> tuple[Array, Array]:
        """Return the coordinates of the model (n_q,) and their derivatives by MuJoCo's velocities, (n_q, nv)."""
        n, nv = len(self.bodies), self.engine.nv
        q, by_v = np.empty((n, 7)), np.empty((n, 7, nv))
        translation, rotation = np.empty((3, nv)), np.empty((3, nv))
        self.mujoco.mj_kinematics(self.engine, data)
        self.mujoco.mj_comPos(self.engine, data)
        for k, body in enumerate(self.bodies):
            q[k] = self._pose(data, k)
            self.mujoco.mj_jac(self.engine, data, translation, rotation, q[k, :3], body)
            if self.n_joints[k]:  # later joints of the body in MuJoCo do not move this massless body
                later = (self.engine.dof_bodyid == body) & (self.engine.dof_jntid > self._joint(k))
                translation[:, later] = rotation[:, later] = 0.0
            by_v[k, :3] = translation
            by_v[k, 3:] = np.array([euler_rates(q[k, 3:], column) for column in rotation.T]).T
        return q.reshape(-1), by_v.reshape(-1, nv)

    def _pose(self, data: Any, k: int) -> Array:
        R = data.xmat[self.bodies[k]].reshape(3, 3)
        if not self.n_joints[k]:
            return np.append(data.xpos[self.bodies[k]] + R @ self.centres[k], euler_parameters(R))
        engine, own = self.engine, self._joint(k)
        place = data.xanchor[own].copy()
        if engine.jnt_type[own] == self.mujoco.mjtJoint.mjJNT_SLIDE:
            place += (data.qpos - engine.qpos0)[engine.jnt_qposadr[own]] * data.xaxis[own]
        last = engine.body_jntadr[self.bodies[k]] + engine.body_jntnum[self.bodies[k]] - 1
        for joint in range(last, own, -1):
            at = engine.jnt_qposadr[joint]
            if engine.jnt_type[joint] == self.mujoco.mjtJoint.mjJNT_HINGE:
                R = R @ about(engine.jnt_axis[joint], engine.qpos0[at] - data.qpos[at])
            elif engine.jnt_type[joint] == self.mujoco.mjtJoint.mjJNT_BALL:
                R = R @ rotation_matrix(data.qpos[at : at + 4]).T
        return np.append(place, euler_parameters(R))

    def _joint(self, k: int) -> int:
        """Return the number in MuJoCo of the joint that a massless body has."""
        return int(self.engine.body_jntadr[self.bodies[k]]) + self.n_joints[k] - 1

    def compare(self, problem: ModelProblem, start: Array) -> None:
        """Raise ValueError if masses, forces, dampers or loops differ from the model of rigid joints.

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
            ahead, back = forces(unit[k]), forces(-unit[k])  # quadratic velocity terms cancel
            return 0.5 * (ahead[0] - back[0]), 0.5 * (ahead[1] - back[1])

        at_rest = forces(np.zeros(engine.nv))
        inertia = np.empty((engine.nv, engine.nv))
        for k in range(engine.nv):
            mujoco.mj_mulM(engine, data, inertia[k], unit[k])
        self._check_equal("masses and inertias", inertia, by_v.T @ system.mass(0.0, q) @ by_v, 0.0)
        scale = float(np.abs(inertia).max() + np.abs(at_rest[0]).max())
        self._check_equal("forces at rest (gravity, springs)", at_rest[0], at_rest[1], AGREEMENT * scale)
        dampers = np.array([damping(k) for k in range(engine.nv)])  # (nv, 2, nv)
        self._check_equal("forces of dampers", dampers[:, 0], dampers[:, 1], AGREEMENT * scale)
        data.qpos[:], data.qvel[:] = start, 0.0
        rows, _ = self._rows(data)
        q, by_v = self.coordinates(data)
        model_rows = system.jacobian(0.0, q) @ by_v
        ranks = [_rank(matrix) for matrix in (rows, model_rows, np.vstack([rows, model_rows]))]
        if len(set(ranks)) > 1:
            raise ValueError(
                f"the loops of MuJoCo's model leave {engine.nv - ranks[0]} velocities, those of the model "
                f"of rigid joints {engine.nv - ranks[1]}, both {engine.nv - ranks[2]}: is one inactive?"
            )

    def _check_equal(self, name: str, mujoco: Array, model: Array, scale: float) -> None:
        """Raise ValueError if two arrays differ, relative to the largest entry, or to `scale` if that is larger."""
        differences, largest = np.abs(mujoco - model), max(float(np.abs([mujoco, model]).max()), scale)
        if differences.max() > AGREEMENT * largest:
            relative = differences.max() / largest
            dof = int(differences.reshape(-1, self.engine.nv).max(axis=0).argmax())
            body = self.model.bodies[int(np.flatnonzero(self.bodies == self.engine.dof_bodyid[dof])[0])].name
            raise ValueError(
                f"MuJoCo's model differs from the one that was read: {name} differ by {relative:.2g} of "
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
            option.solver, option.iterations, option.tolerance = self.stiff_solver

    @property
    def stiff_solver(self) -> tuple[int, int, float]:
        """Return the constraint solver settings for stiff loops: the file's settings, unless they are worse."""
        _, iterations, tolerance = self.solver
        newton = int(self.mujoco.mjtSolver.mjSOL_NEWTON)
        return newton, max(iterations, ITERATIONS), min(tolerance, TOLERANCE)


def _rank(rows: Array) -> int:
    return int(np.linalg.matrix_rank(rows, rtol=TOLERANCE)) if rows.size else 0


CANDIDATES = (Settings(stiff=True), Settings("RK4", stiff=True))


@dataclass(frozen=True)
class MjcfAudit:
    """Errors of MuJoCo on a file, as given and with stiffer loops; `print(audit)` shows them.

    Attributes
    ----------
    file, start : str
        The file, and the initial state.
    left_out : tuple of str
        Parts of the file that are omitted from both motions: contacts, actuators, limits, ...
    notes : tuple of str
    as_it_is : str
        Description of the error at the step of the file.
    audits : tuple of Audit
        With the settings of the file; with loops as stiff as the step allows; the same with RK4.
    advice : str
        Settings for the requested error and their cost; empty if none of the audits reaches it.

    Examples
    --------
    >>> from twoloop.audit import MjcfAudit
    >>> audit = MjcfAudit("linkage.xml", "its pose", ("contacts",), (), "error 0.02", (), "")
    >>> audit.left_out
    ('contacts',)
    """

    file: str
    start: str
    left_out: tuple[str, ...]
    notes: tuple[str, ...]
    as_it_is: str
    audits: tuple[Audit, ...]
    advice: str

    def __str__(self) -> str:
        first = self.audits[0]
        lines = [f"{self.file}: MuJoCo against rigid loops, {first.t_end:g} s from {self.start}", *self.notes]
        lines += [f"Neither motion has: {'; '.join(_combine_items(self.left_out))}."] if self.left_out else []
        measure = "error: largest of any body's centre (m) or axes; two references of rigid loops differ by"
        lines += [f"{measure} {first.apart:.1g}", ""]
        smallest = min((run.error for audit in self.audits for run in audit.runs if not run.message), default=np.nan)
        end = self.advice or f"Nothing tried reaches an error of {first.error:g}; the smallest is {smallest:.2g}."
        return "\n".join([*lines, *(f"{audit}\n" for audit in self.audits), self.as_it_is, end])

    def write(self, path: str | os.PathLike[str]) -> None:
        """Write everything as JSON, or the runs as CSV, by the suffix of the path.

        Raises
        ------
        ValueError
            If the suffix is neither.
        """
        file = Path(path)
        check_ending(file)
        if file.suffix == ".json":
            audits = [
                {
                    **{name: getattr(audit, name) for name in ("label", "t_end", "error", "apart", "order", "floor")},
                    "runs": [_row(run) for run in audit.runs],
                    "reaching": _row(audit.reaching) if audit.reaching else None,
                }
                for audit in self.audits
            ]
            names = ("file", "start", "left_out", "notes", "as_it_is", "advice")
            fields = {name: getattr(self, name) for name in names}
            file.write_text(json.dumps({**fields, "audits": audits}, indent=1) + "\n", encoding="utf-8")
            return
        with file.open("w", encoding="utf-8", newline="") as stream:
            table = csv.DictWriter(stream, ["label", *AuditedRun._fields])
            table.writeheader()
            table.writerows({"label": audit.label, **_row(run)} for audit in self.audits for run in audit.runs)


def _combine_items(left_out: tuple[str, ...]) -> list[str]:
    """Return what is left out, with several items combined, e.g. "limits of 8 joints"."""
    parts = [item.partition(" of joint ")[::2] for item in left_out]
    items: dict[str, None] = {}
    for item, (kind, joint) in zip(left_out, parts, strict=True):
        n = sum(other_kind == kind and bool(name) for other_kind, name in parts)
        items[f"{kind} of {n} joints" if joint and n > 1 else item] = None
    return list(items)


def check_ending(file: Path) -> None:
    """Raise ValueError if an audit cannot be written to a file with this suffix."""
    if file.suffix not in ENDINGS:
        raise ValueError(f"--out takes a file that ends in {' or '.join(ENDINGS)}; given {str(file)!r}")


def _row(run: AuditedRun) -> dict[str, Any]:
    return {name: None if value != value else value for name, value in run._asdict().items()}


def audit_mjcf(
    path: str | os.PathLike[str], *, error: float = 1e-3, t_end: float = 2.0, key: str | None = None
) -> MjcfAudit:
    """Compare MuJoCo's motion of a file with that of its rigid loops, and find settings for a requested error.

    Three settings are run with several steps: those of the file, then loops as stiff as the step allows (solref of
    twice the step, the smallest value that MuJoCo accepts by default), with the file's integrator and with RK4.

    Parameters
    ----------
    path : path-like
        An MJCF file with loops closed by connect or weld.
    error : float, optional
        Requested error: the largest over all times of any body's centre (m) or axes.
    t_end : float, optional
        Duration of the motion, s.
    key : str, optional
        Name of the initial keyframe, or its number if unnamed. None: the pose of the file, at rest.

    Returns
    -------
    MjcfAudit

    Raises
    ------
    RuntimeError
        If MuJoCo is not installed, or the reference motion is less accurate than the requested error.
    ValueError
        If an argument is invalid, the file has no loop, nothing moves, or MuJoCo's masses, springs, dampers or loops
        differ from those of `from_mjcf`.

    Notes
    -----
    Parts of the file ignored by `twoloop.bodies.from_mjcf` are disabled in MuJoCo as well, and listed.

    Examples
    --------
    It needs MuJoCo.

    >>> import tempfile
    >>> from pathlib import Path
    >>> from twoloop.audit import audit_mjcf
    >>> TEXT = '''
    ... <mujoco>
    ...   <default>
    ...     <geom type="capsule" size="0.02" mass="1" contype="0" conaffinity="0"/>
    ...     <joint axis="0 1 0"/>
    ...   </default>
    ...   <worldbody>
    ...     <body name="crank">
    ...       <joint/>
    ...       <geom fromto="0 0 0 0.1 0 0.3"/>
    ...       <body name="rod" pos="0.1 0 0.3">
    ...         <joint/>
    ...         <geom fromto="0 0 0 0.7 0 0.1"/>
    ...         <body name="rocker" pos="0.7 0 0.1">
    ...           <joint/>
    ...           <geom fromto="0 0 0 -0.1 0 -0.4"/>
    ...         </body>
    ...       </body>
    ...     </body>
    ...   </worldbody>
    ...   <equality>
    ...     <connect body1="rocker" anchor="-0.1 0 -0.4"/>
    ...   </equality>
    ... </mujoco>
    ... '''
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = Path(folder) / "linkage.xml"
    ...     _ = path.write_text(TEXT)
    ...     audit = audit_mjcf(path, error=1e-2, t_end=0.2)
    >>> len(audit.audits), bool(audit.advice)
    (3, True)
    """
    check_positive("error", error)
    check_positive("t_end", t_end)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", IgnoredWarning)  # listed instead
        model = from_mjcf(path)
    mujoco_model = MujocoModel(path, model)
    mujoco = mujoco_model.mujoco
    mujoco.set_mju_user_warning(lambda text: None)  # by default MuJoCo writes them to a file in the working directory
    try:
        qpos, qvel, gap = mujoco_model.start(key)
        problem = model.problem((0.0, t_end))
        mujoco_model.compare(problem, qpos)
        data = mujoco.MjData(mujoco_model.engine)
        data.qpos[:] = qpos
        q, by_v = mujoco_model.coordinates(data)
        q, v = consistent_state(problem.system, 0.0, q, by_v @ qvel, check_assembly=False)
        problem = replace(problem, q0=q, v0=v)
        integrator, audits = mujoco_model.integrator, []
        for settings in (Settings(), *(candidate for candidate in CANDIDATES if candidate.integrator != integrator)):
            simulate, label = mujoco_model.simulator(qpos, qvel, settings), _label(settings, integrator)
            audits.append(audit_simulator(simulate, problem, step=mujoco_model.step, error=error, label=label))
    finally:
        mujoco.set_mju_user_warning(None)
    notes = [problem.note]
    notes += [f"The loops were open by {gap:.2g} m there and are closed first."] if gap > MOVED else []
    keyframes = [name for name in mujoco_model.keyframes if name != key]
    notes += [f"Other starts, by --key: {', '.join(keyframes)}."] if keyframes else []
    floor = audits[-1].floor or 0.0
    if floor > error:
        notes.append(
            f"Even stiff loops with RK4 have an error of {floor:.2g}, much more than expected: neighbouring motions "
            "diverge too fast, or MuJoCo's mechanism differs from the one that was read. Do not trust this audit."
        )
    left_out = tuple(item for item in model.ignored if not item.startswith("sensor"))
    left_out += ("the forces of actuators",) if model.actuators else ()
    start = "the pose of the file" if key is None else f"the keyframe {key!r}"
    advice = _advice(mujoco_model, audits)
    as_it_is = _error_at_step(audits[0], mujoco_model.step)
    return MjcfAudit(os.fspath(path), start, left_out, tuple(notes), as_it_is, tuple(audits), advice)


def _error_at_step(audit: Audit, step: float) -> str:
    """Return the error of the file at its own step, from the run with the nearest step."""
    run = min(audit.runs, key=lambda run: abs(np.log(run.step / step)))
    if not 0.7 < run.step / step < 1.5:
        why = "a 50th of the time, the longest tried" if step > run.step else "the shortest tried"
        return f"As it is the file was not run: its step is {1e3 * step:.4g} ms, and {1e3 * run.step:.4g} ms is {why}."
    return f"As it is, at {1e3 * run.step:.4g} ms: {run.message or f'error {run.error:.2g}, gap {run.gap:.1g} m'}."


def _label(settings: Settings, integrator: str) -> str:
    if settings == Settings():
        return f"as the file is: {integrator}, solref and solimp as given"
    return f"{settings.integrator or integrator}, loops as stiff as the step allows"


def _advice(mujoco_model: MujocoModel, audits: list[Audit]) -> str:
    """Describe the settings that reach the error: the cheapest, or others that change less and cost little more."""
    costs = {choice: run.cpu_s for choice, audit in enumerate(audits) if (run := audit.reaching)}
    if not costs:
        return ""
    limit = CHANGE_FACTOR * min(costs.values())
    choice = next(choice for choice, cost in costs.items() if cost <= limit)  # `costs` begins with the fewest changes
    audit, run, settings = audits[choice], audits[choice].reaching, (Settings(), *CANDIDATES)[choice]
    assert run is not None
    option = f'timestep="{run.step:.6g}" integrator="{settings.integrator or mujoco_model.integrator}"'
    if settings.stiff and mujoco_model.stiff_solver != mujoco_model.solver:
        _, iterations, tolerance = mujoco_model.stiff_solver
        option += f' solver="Newton" iterations="{iterations}" tolerance="{tolerance:g}"'
    lines = [f"For an error of {audit.error:g} (measured {run.error:.2g}, gap {run.gap:.1g} m) write:"]
    lines += [f"  <option {option}/>"]
    if settings.stiff:
        lines += [f'  on every connect and weld: solref="{2.0 * run.step:.6g} 1" solimp="0.9999 0.9999 0.001"']
    factor = audit.t_end / run.cpu_s
    lines += [f"Cost here: {1e3 / factor:.3g} ms of CPU for 1 s of motion, {factor:.3g} times real time."]
    return "\n".join(lines)
