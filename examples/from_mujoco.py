"""Read a MuJoCo file whose loop is closed by `connect`, run it with rigid loops, and write it again."""

from pathlib import Path

import numpy as np

from twoloop import solve_dae
from twoloop.bodies import from_mjcf

model = from_mjcf(Path(__file__).with_name("linkage.xml"))
print(model)
print(model.ignored)  # what was not read, in the order of its effect on the motion

problem = model.problem(t_span=(0.0, 2.0))
print(problem.freedom)  # degrees of freedom, and joints whose constraints depend on those of others
print([joint.name for joint in problem.joints])

result = solve_dae(problem.system, problem.t_span, problem.q0, problem.v0, rtol=1e-9, atol=1e-9, dense_output=True)
print(result.message)
print(result.certify())  # recomputes the run with another method and compares

rod = next(body for body in model.bodies if body.name == "rod")
x, _, z = result.q[list(rod.coordinates[:3]), -1]
print(f"at {result.t[-1]:g} s the centre of the rod is at x = {x:.6f} m, z = {z:.6f} m")

gap = max(np.abs(problem.system.constraint(t, q)).max() for t, q in zip(result.t, result.q.T, strict=True))
print(f"the loop opens by at most {gap:.1e} m")
result.animate("from_mujoco.html")
model.to_mjcf("again.xml")
