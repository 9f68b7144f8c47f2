"""A digital controller: it reads an arm at 1 kHz, and holds its torque between the samples."""

from twoloop import Integrator
from twoloop.bodies import PlanarModel

PERIOD, TARGET = 1e-3, 0.3  # s, rad
STIFFNESS, DAMPING, RESET = 40.0, 8.0, 150.0  # N m/rad, N m s/rad, N m/(rad s)

model = PlanarModel(name="arm")
link = model.rod("link", (0.0, 0.0), (0.0, -1.0), mass=1.0)  # hangs down
shoulder = model.revolute("ground", link, at=(0.0, 0.0))
model.motor(shoulder, 0.0, name="servo")  # N m, until the controller sets another value
problem = model.problem()
angle = link.coordinates[2]  # index of the angle in q
servo = problem.place("value of servo")  # index of the torque among the parameters

integrator = Integrator(problem.system, rtol=1e-10, atol=1e-10)
sample = integrator.start(0.0, problem.q0, problem.v0)  # checks everything, once
integral, torques = 0.0, []
for _ in range(2000):
    error = TARGET - sample.q[angle]
    integral += PERIOD * error  # memory of the controller: yours, not the integrator's
    torques.append(STIFFNESS * error - DAMPING * sample.v[angle] + RESET * integral)
    sample = integrator.step(PERIOD, inputs={servo: torques[-1]})
print(f"t = {sample.t:g} s, angle {sample.q[angle]:.4f} rad")

result = integrator.result()  # the samples so far
result.plot("sampled_controller.png")
result.animate("sampled_controller.html")
