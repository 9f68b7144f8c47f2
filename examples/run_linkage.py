"""Run the linkage of linkage.py, check the run in three ways, and show it."""

import numpy as np
from linkage import linkage

from twoloop import solve_dae

problem = linkage()
result = solve_dae(problem.system, problem.t_span, problem.q0, problem.v0, rtol=1e-8, atol=1e-8, dense_output=True)
print(result.success, result.message)
print(result.t[-1], result.q[:, -1])  # q and v have one column per accepted step
print(result.stats)  # steps, evaluations, CPU time

pin = result.reactions("revolute OA-AB")
print(f"largest force in pin A: {np.hypot(*pin.force).max():.1f} N")

# 1. Are the joints closed?
violation = max(np.abs(problem.system.constraint(t, q)).max() for t, q in zip(result.t, result.q.T, strict=True))
print(f"constraints are violated by at most {violation:.1e} m")

# 2. Is the energy constant? Here it should be: nothing drives or brakes the linkage.
energies = problem.energy(result.t, result.q, result.v)
print(f"the energy changes by at most {np.abs(energies - energies[0]).max():.1e} J")

# 3. Does another method at a smaller tolerance agree?
other = solve_dae(problem.system, problem.t_span, problem.q0, problem.v0, "DOP853", rtol=1e-11, atol=1e-11)
error = np.abs(result.q[:, -1] - other.q[:, -1]).max()
print(f"at the end, the two runs differ by {error:.1e} m or rad")

state = result.sol(np.linspace(0.0, 10.0, 1000))  # the motion between the steps
print(f"highest position of the centre of bar AB: {state.q[4].max():.4f} m")
result.plot("linkage.png")  # coordinates, energy, violation of the constraints
result.animate("linkage.html")  # open it in a browser; .gif and .mp4 work, too
