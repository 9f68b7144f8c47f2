"""PyBullet: motors hold every hinge, and motions are damped, until both are switched off. Seen with pybullet 3.2.7.

A bar of 1 m and 1 kg falls from the horizontal for half a second.
"""

import math
import tempfile
from pathlib import Path

import pybullet as p

URDF = """<robot name="bar"><link name="base"/><link name="bar"><inertial><origin xyz="0.5 0 0"/><mass value="1"/>
<inertia ixx="0.001" iyy="0.0833333" izz="0.0833333" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="hinge" type="continuous"><parent link="base"/><child link="bar"/><axis xyz="0 1 0"/></joint></robot>"""


def fallen(motor: bool, damping: bool) -> tuple[float, float]:
    """Angle after half a second, and the energy that it has gained, J."""
    p.connect(p.DIRECT)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "bar.urdf")
        path.write_text(URDF)
        bar = p.loadURDF(str(path), useFixedBase=True, flags=p.URDF_USE_INERTIA_FROM_FILE)
    p.setGravity(0, 0, -9.81)
    p.setTimeStep(1e-4)
    if not motor:
        p.setJointMotorControl2(bar, 0, p.VELOCITY_CONTROL, force=0)
    if not damping:
        p.changeDynamics(bar, 0, linearDamping=0, angularDamping=0)
        p.changeDynamics(bar, 0, jointDamping=0)
    for _ in range(5000):
        p.stepSimulation()
    angle, rate, *_ = p.getJointState(bar, 0)
    p.disconnect()
    return angle, 0.5 * rate**2 / 3.0 - 9.81 * 0.5 * math.sin(angle)


if __name__ == "__main__":
    print("as it comes      ", *fallen(True, True))
    print("motors off       ", *fallen(False, True))
    print("and no damping   ", *fallen(False, False))
