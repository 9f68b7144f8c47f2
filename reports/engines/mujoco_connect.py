"""MuJoCo: what a shorter step gains with the default connect, and with a rigid one. Seen with mujoco 4.0.0.

A four-bar linkage falls for a second. With the default solref the end of the motion converges to another one, for any
integrator. `solref="1e-9 1"` is raised to twice the time step (refsafe), so the loop stiffens with the step.
"""

import mujoco
import numpy as np

XML = """
<mujoco>
  <option integrator="{integrator}" timestep="{step}"/>
  <default>
    <joint axis="0 1 0"/>
    <geom type="capsule" size="0.02" contype="0" conaffinity="0"/>
    <equality {connect}/>
  </default>
  <worldbody>
    <body>
      <joint/> <geom fromto="0 0 0  0 0 1"/>
      <body pos="0 0 1">
        <joint/> <geom fromto="0 0 0  2 0 0.5"/>
        <body name="rocker" pos="2 0 0.5">
          <joint/> <geom fromto="0 0 0  0.5 0 -1.5"/>
        </body>
      </body>
    </body>
  </worldbody>
  <equality> <connect body1="rocker" anchor="0.5 0 -1.5"/> </equality>
</mujoco>"""
RIGID = 'solref="1e-9 1" solimp="0.9999 0.9999 0.001"'


def end(integrator: str, step: float, connect: str) -> np.ndarray:
    """Where the linkage is after a second."""
    model = mujoco.MjModel.from_xml_string(XML.format(integrator=integrator, step=step, connect=connect))
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, nstep=round(1.0 / step))
    return np.array(data.qpos)


if __name__ == "__main__":
    best = end("RK4", 2e-5, RIGID)
    for integrator, connect in (("Euler", ""), ("RK4", ""), ("RK4", RIGID)):
        off = [np.abs(end(integrator, step, connect) - best).max() for step in (2e-3, 5e-4, 1e-4)]
        print(f"{integrator:6s}{connect or 'default connect':48s}", *(f"{each:.1e}" for each in off))
