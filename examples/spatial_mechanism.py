"""A spatial linkage with ball joints (RSSR): the torque that turns its crank at a constant rate."""

import numpy as np

from twoloop import solve_dae
from twoloop.bodies import SpatialModel

O, P, S, D = (0.0, 0.0, 0.0), (0.3, 0.0, 0.0), (0.9, 0.2, 1.0), (0.9, 0.2, 0.3)  # m
RATE = 4.0  # rad/s

model = SpatialModel(name="RSSR")  # gravity=(0.0, 0.0, -9.81)
for name, start, end in (("crank", O, P), ("coupler", P, S), ("rocker", D, S)):
    model.rod(name, start, end, radius=0.02, mass=0.8)
crank = model.revolute("ground", "crank", at=O, axis=(0.0, 0.0, 1.0))
model.spherical("crank", "coupler", at=P)
model.spherical("coupler", "rocker", at=S)
model.revolute("rocker", "ground", at=D, axis=(0.0, 1.0, 0.0))
model.drive(crank, lambda t: RATE * t, name="drive")

problem = model.problem(t_span=(0.0, 2.0 * np.pi / RATE))  # one turn
print(problem.freedom)  # one degree is left: the coupler can spin about its own axis
times = np.linspace(*problem.t_span, 181)
result = solve_dae(problem.system, problem.t_span, problem.q0, problem.v0, rtol=1e-9, atol=1e-9, t_eval=times)
print(result.message)

# The rocker turns about D. Its angle from the vertical is that of its centre.
rocker = next(body for body in model.bodies if body.name == "rocker")
centre = result.q[list(rocker.coordinates[:3])]  # (3, n_t); four Euler parameters follow
angle = np.degrees(np.arctan2(centre[0] - D[0], centre[2] - D[2]))
torque = result.reactions("drive").torque[2]  # about the axis of the crank, N m
print(f"the rocker swings from {angle.min():.1f} to {angle.max():.1f} degrees")
print(f"the crank needs between {torque.min():.2f} and {torque.max():.2f} N m")
result.animate("spatial_mechanism.html")
