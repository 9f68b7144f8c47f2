"""MuJoCo starts a run anew when its state is lost, and only a log file and a counter say so. Seen with mujoco 4.0.0."""

import mujoco

XML = """
<mujoco>
  <option timestep="0.1"/>
  <worldbody>
    <body><joint axis="0 1 0"/> <geom type="capsule" size="0.02" fromto="0 0 0 0.1 0 0"/> </body>
  </worldbody>
</mujoco>"""


def run() -> tuple[float, float, int]:
    """Time and angle after 200 steps of 0.1 s, and how many resets there were."""
    model = mujoco.MjModel.from_xml_string(XML)
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, nstep=100)
    data.qvel[0] = 1e11  # what an exploding loop would make
    mujoco.mj_step(model, data, nstep=100)
    return data.time, float(data.qpos[0]), int(data.warning.number.sum())


if __name__ == "__main__":
    print("time (s) {:g} instead of 20, angle {:g}, warnings {}".format(*run()))
