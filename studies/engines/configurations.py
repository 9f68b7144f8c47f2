"""Which engines are run, with which settings: as they come, and as they do best."""

from dataclasses import dataclass
from typing import Any

from references.engines import drake, exudyn_bodies, mujoco, pinocchio

OURS = "twoloop"  # the engine that is none
MODULES = {"mujoco": mujoco, "drake": drake, "pinocchio": pinocchio, "exudyn_bodies": exudyn_bodies}
NAMES = {"mujoco": "MuJoCo", "drake": "Drake", "pinocchio": "Pinocchio", "exudyn_bodies": "Exudyn", OURS: "twoloop"}
PACKAGES = {"mujoco": "mujoco", "drake": "drake", "pinocchio": "pin", "exudyn_bodies": "exudyn"}
RIGID = mujoco.Settings("RK4", "1e-9 1", "0.9999 0.9999 0.001")


@dataclass(frozen=True)
class Configuration:
    """An engine with settings; `how` says in the engine's own words what is set."""

    engine: str
    label: str
    settings: Any = None
    how: str = "nothing"

    @property
    def name(self) -> str:
        """In tables and rows."""
        return f"{NAMES[self.engine]}, {self.label}"


CONFIGURATIONS = (
    Configuration("mujoco", "default", mujoco.Settings()),
    Configuration("mujoco", "RK4", mujoco.Settings("RK4"), '`integrator="RK4"`'),
    Configuration(
        "mujoco",
        "RK4, solref 2 ms",
        mujoco.Settings("RK4", "0.002 1", "0.999 0.9999 0.001"),
        '`integrator="RK4"`; on connects `solref="0.002 1" solimp="0.999 0.9999 0.001"`',
    ),
    Configuration(
        "mujoco",
        "RK4, solref 2h",
        RIGID,
        '`integrator="RK4"`; on connects `solref="1e-9 1" solimp="0.9999 0.9999 0.001"`',
    ),
    Configuration("drake", "SAP", drake.Settings(), "`kSap`"),
    Configuration("drake", "TAMSI", drake.Settings("kTamsi"), "`kTamsi`"),
    Configuration("drake", "continuous", drake.Settings("continuous"), "a plant with step 0"),
    Configuration("pinocchio", "default", pinocchio.Settings()),
    Configuration(
        "pinocchio",
        "Euler, Baumgarte",
        pinocchio.Settings("Euler", 1e-3, baumgarte=10.0),
        "semi-implicit Euler; `ProximalSettings(1e-14, 1e-3, 20)`, `Kp` 100, `Kd` 20",
    ),
    Configuration(
        "pinocchio",
        "RK4, Baumgarte",
        pinocchio.Settings("RK4", 1e-3, baumgarte=10.0),
        "RK4 of q and v; `ProximalSettings(1e-14, 1e-3, 20)`, `Kp` 100, `Kd` 20",
    ),
    Configuration(
        "pinocchio",
        "RK4, mu 1e-8",
        pinocchio.Settings("RK4", 1e-8, baumgarte=10.0),
        "as before, with `ProximalSettings(1e-14, 1e-8, 20)`",
    ),
    Configuration("exudyn_bodies", "generalized-alpha", exudyn_bodies.Settings()),
    Configuration("exudyn_bodies", "trapezoidal", exudyn_bodies.Settings("TrapezoidalIndex2"), "`TrapezoidalIndex2`"),
    Configuration(OURS, "default"),
)
BEST: dict[str, Any] = {  # of the gates: the most rigid of an engine
    "mujoco": RIGID,
    "drake": drake.Settings(),
    "pinocchio": pinocchio.Settings("RK4", 1e-3),
    "exudyn_bodies": exudyn_bodies.Settings(),
}
PLAIN_AND_BEST = (  # which are run with motors on every mechanism
    *("MuJoCo, default", "MuJoCo, RK4, solref 2h", "Drake, SAP", "Pinocchio, RK4, Baumgarte"),
    *("Exudyn, generalized-alpha", f"{NAMES[OURS]}, default"),
)
