"""Drive a gripper from its MuJoCo file by the command of its servo."""

from pathlib import Path

from twoloop import solve_dae
from twoloop.bodies import from_mjcf

opening = {"grip": lambda t: 0.03 * t**2 / (0.01 + t**2)}  # m, where the servo wants the left finger
model = from_mjcf(Path(__file__).with_name("gripper.xml"), commands=opening)
problem = model.problem(t_span=(0.0, 2.0))
result = solve_dae(problem.system, problem.t_span, problem.q0, problem.v0, rtol=1e-9, atol=1e-9)
fingers = [problem.joint_coordinate(name).position(result.q[:, -1]) for name in ("left", "right")]
print("the fingers end at {:.5f} m and {:.5f} m".format(*fingers))
