"""Which engines are run, with which settings: as they come, and as they do best."""

from dataclasses import dataclass
from typing import Any

from references.engines import drake, exudyn_bodies, mujoco, pinocchio

OURS = "twoloop"  # the engine that is none
MODULES = {"mujoco": mujoco, "drake": drake, "pinocchio": pinocchio, "exudyn_bodies": exudyn_bodies}
NAMES = {"mujoco": "MuJoCo", "drake": "Drake", "pinocchio": "Pinocchio", "exudyn_bodies": "Exudyn", OURS: "twoloop"}
PACKAGES = {"mujoco": "mujoco", "drake": "drake", "pinocchio": "pin", "exudyn_bodies": "exudyn"}
SOFT, RIGID = (
    mujoco.Settings("RK4", "0.002 1", "0.999 0.9999 0.001"),
    mujoco.Settings("RK4", "1e-9 1", "0.9999 0.9999 0.001"),
)


@dataclass(frozen=True)
class Configuration:
    """An engine with settings; `how` says in the engine's own words what is set."""

    engine: str
    label: str
    settings: Any = None
    how: str = "nothing"

    @property
    def name(self) -> str:
        return f"{NAMES[self.engine]}, {self.label}"


def _of(engine: str, label: str, how: str = "nothing", *settings: Any) -> Configuration:
    return Configuration(engine, label, MODULES[engine].Settings(*settings), how)


_CONNECTS = '`integrator="RK4"`; on connects'
_PROXIMAL = "`ProximalSettings(1e-14, 1e-3, 20)`, `Kp` 100, `Kd` 20"
CONFIGURATIONS = (
    _of("mujoco", "default"),
    _of("mujoco", "RK4", '`integrator="RK4"`', "RK4"),
    _of("mujoco", "RK4, solref 2 ms", f'{_CONNECTS} `solref="{SOFT[1]}" solimp="{SOFT[2]}"`', *SOFT),
    _of("mujoco", "RK4, solref 2h", f'{_CONNECTS} `solref="{RIGID[1]}" solimp="{RIGID[2]}"`', *RIGID),
    _of("drake", "SAP", "`kSap`"),
    _of("drake", "TAMSI", "`kTamsi`", "kTamsi"),
    _of("drake", "continuous", "a plant with step 0", "continuous"),
    _of("pinocchio", "default"),
    _of("pinocchio", "Euler, Baumgarte", f"semi-implicit Euler; {_PROXIMAL}", "Euler", 1e-3, 20, 10.0),
    _of("pinocchio", "RK4, Baumgarte", f"RK4 of q and v; {_PROXIMAL}", "RK4", 1e-3, 20, 10.0),
    _of("pinocchio", "RK4, mu 1e-8", "as before, with `ProximalSettings(1e-14, 1e-8, 20)`", "RK4", 1e-8, 20, 10.0),
    _of("exudyn_bodies", "generalized-alpha"),
    _of("exudyn_bodies", "trapezoidal", "`TrapezoidalIndex2`", "TrapezoidalIndex2"),
    Configuration(OURS, "default", "auto"),
    Configuration(OURS, "compiled=True", True),  # `settings` of ours: `compiled` of solve_dae
)
# of the gates: the most rigid of an engine
BEST: dict[str, Any] = {"mujoco": RIGID, "drake": drake.Settings(), "pinocchio": pinocchio.Settings("RK4", 1e-3)}
BEST |= {"exudyn_bodies": exudyn_bodies.Settings()}
PLAIN_AND_BEST = (  # which are run with motors on every mechanism
    *("MuJoCo, default", "MuJoCo, RK4, solref 2h", "Drake, SAP", "Pinocchio, RK4, Baumgarte"),
    *("Exudyn, generalized-alpha", f"{NAMES[OURS]}, default"),
)
