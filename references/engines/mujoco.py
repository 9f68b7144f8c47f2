"""MuJoCo: the file written by `to_mjcf`, with an integrator and the softness of loop-closing constraints."""

import tempfile
import time
import warnings
from pathlib import Path
from typing import Any, NamedTuple
from xml.etree import ElementTree

import numpy as np

from references.driver import imported
from references.engines.rigid import BALL, Configured, Engine, Motion, Prepared, Rigid, State, freedoms, march
from twoloop.bodies.file_parts import IgnoredWarning


class Settings(NamedTuple):
    """MuJoCo's integrator; solref and solimp of the loop-closing constraints, None: its defaults."""

    integrator: str = "Euler"
    solref: str | None = None
    solimp: str | None = None


def prepare(rigid: Rigid, settings: Settings = Settings()) -> Prepared:  # noqa: B008
    """Build the mechanism in MuJoCo.

    Raises RuntimeError if MuJoCo is not installed. Raises ValueError if MJCF has no counterpart of a joint.
    """
    mujoco = imported("mujoco", extra="engines")
    mujoco.set_mju_user_warning(lambda text: None)  # by default MuJoCo writes them to a file in the working directory
    model = mujoco.MjModel.from_xml_string(file_of(rigid, settings))
    bodies = [model.body(body.name).id for body in rigid.model.bodies]
    of_cut = rigid.cut, f"{rigid.cut} 2"  # a hinge is closed by two connects
    connects = [k for k in range(model.neq) if model.equality(k).name in of_cut]

    def run(t_end: float, n_steps: int, n_stored: int) -> Motion:
        began = time.process_time()
        model.opt.timestep = h = t_end / n_steps
        data = mujoco.MjData(model)
        data.xfrc_applied[bodies, 3:] = rigid.torques
        for body in rigid.model.bodies:
            rates = rigid.rates(body)
            for number, (kind, _) in enumerate(freedoms(body, joint := rigid.parents[body.number][1])):
                first = model.joint(joint.name if number == 0 else f"{joint.name} {number + 1}").dofadr[0]
                width = 3 if kind == BALL else 1
                data.qvel[first : first + width] = rates[number : number + width]

        def step(n: int, t: float) -> str:
            mujoco.mj_step(model, data, nstep=n)
            numbers = data.warning.number
            return f"MuJoCo warns of {mujoco.mjtWarning(int(numbers.argmax())).name}" if numbers.any() else ""

        def see() -> State:
            mujoco.mj_kinematics(model, data)
            mujoco.mj_comPos(model, data)
            mujoco.mj_comVel(model, data)
            twists = np.empty((len(bodies), 6))
            for row, body in zip(twists, bodies, strict=True):
                mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_BODY, body, row, 0)
            poses = data.xpos[bodies].copy(), data.xmat[bodies].reshape(-1, 3, 3).copy()
            mujoco.mj_forward(model, data)  # without this, forces are those of the previous step
            connected = (data.efc_type == mujoco.mjtConstraint.mjCNSTR_EQUALITY) & np.isin(data.efc_id, connects)
            return *poses, twists[:, 3:], twists[:, :3], data.efc_force[connected].reshape(-1, 3).sum(axis=0)

        return march(began, h, n_steps, n_stored, see, step)

    return Prepared(model.body_mass[bodies], model.body_inertia[bodies].max(axis=1), run)


def file_of(rigid: Rigid, settings: Settings) -> str:
    """Return the text of `to_mjcf` with these settings."""
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore", IgnoredWarning)  # initial velocities and torques are set in the data
        path = Path(folder, "model.xml")
        rigid.model.to_mjcf(path)
        root = ElementTree.parse(path).getroot()
    option: Any = root.find("option")
    option.set("integrator", settings.integrator)
    for element in root.findall("equality/*"):
        for name, value in (("solref", settings.solref), ("solimp", settings.solimp)):
            if value is not None:
                element.set(name, value)
    return ElementTree.tostring(root, encoding="unicode")


SOFT, RIGID = Settings("RK4", "0.002 1", "0.999 0.9999 0.001"), Settings("RK4", "1e-9 1", "0.9999 0.9999 0.001")
_CONNECTS = '`integrator="RK4"`; on connects'
ENGINE = Engine(
    *("MuJoCo", "mujoco", prepare, RIGID),
    (
        Configured("default", Settings(), everywhere=True),
        Configured("RK4", Settings("RK4"), '`integrator="RK4"`'),
        Configured("RK4, solref 2 ms", SOFT, f'{_CONNECTS} `solref="{SOFT[1]}" solimp="{SOFT[2]}"`'),
        Configured("RK4, solref 2h", RIGID, f'{_CONNECTS} `solref="{RIGID[1]}" solimp="{RIGID[2]}"`', everywhere=True),
    ),
)
