"""Fit two masses of a slider-crank to a measured motion of the slider."""

import numpy as np
from scipy.optimize import least_squares

from twoloop import solve_dae
from twoloop.bodies import PlanarModel

O, A, B = (0.0, 0.0), (0.26, 0.15), (1.25, 0.0)  # m: bearing, crank pin, slider
model = PlanarModel(name="slider-crank")
model.rod("crank", O, A, mass=1.0, angular_velocity=8.0)
model.rod("rod", A, B, mass=1.0)
model.body("slider", mass=1.0, inertia=0.1, position=B)
model.revolute("ground", "crank", at=O)
model.revolute("crank", "rod", at=A)
model.revolute("rod", "slider", at=B)
model.prismatic("ground", "slider", at=B, axis=(1.0, 0.0))
problem = model.problem(t_span=(0.0, 2.0))
slider_x = model.bodies[-1].coordinates[0]
instants = np.linspace(0.0, 2.0, 81)  # s, of the measurement


def slider(masses, tol=1e-10):
    """Positions of the slider at the instants, with other masses of rod and slider."""
    inertia = masses[0] * np.hypot(B[0] - A[0], B[1] - A[1]) ** 2 / 12.0  # a parameter of its own
    numbers = {"mass of rod": masses[0], "moment of inertia of rod": inertia, "mass of slider": masses[1]}
    changed = problem.with_parameters(numbers)
    run = solve_dae(changed.system, changed.t_span, problem.q0, problem.v0, rtol=tol, atol=tol, t_eval=instants)
    if not run.success:
        raise RuntimeError(run.message)
    return run.q[slider_x]


# In place of a measurement: a run with the true masses, and noise of a tenth of a millimetre.
true_masses, sigma = np.array([2.0, 1.5]), 1e-4  # kg, m
measured = slider(true_masses) + sigma * np.random.default_rng(1).standard_normal(instants.size)

fit = least_squares(lambda masses: (slider(masses) - measured) / sigma, [1.0, 1.0], diff_step=1e-4)
deviation = np.sqrt(np.diag(np.linalg.inv(fit.jac.T @ fit.jac)))
print(fit.message)
for name, value, error in zip(("rod", "slider"), fit.x, deviation, strict=True):
    print(f"mass of the {name}: {value:.4f} kg, standard deviation {error:.4f} kg")
