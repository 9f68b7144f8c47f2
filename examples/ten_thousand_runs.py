"""Run ten thousand linkages whose bars are made to half a millimetre, and see how far apart they end."""

import matplotlib.pyplot as plt
import numpy as np

from twoloop import consistent_states, ensemble
from twoloop.mechanisms import four_bar

N_RUNS = 10_000
problem = four_bar()
system = problem.system  # its parameters are the three lengths and the distance of the ground joints, m
random = np.random.default_rng(1)
lengths = system.parameters + 0.5e-3 * random.standard_normal((N_RUNS, 4))

# Bars of other lengths need another start. Coordinate 8, the angle of the third bar, keeps its value.
q0, v0 = consistent_states(system, 0.0, problem.q0, problem.v0, parameters=lengths, keep=[8])
times = np.linspace(0.0, 2.0, 101)
runs = ensemble(system, (0.0, 2.0), q0, v0, parameters=lengths, t_eval=times)
print(runs)
print(runs.q.shape)  # runs, coordinates, times
print(runs.success.all(), runs.message)

low, middle, high = np.quantile(runs.q[:, 8], [0.05, 0.5, 0.95], axis=0)
print(f"after 2 s, nine of ten angles lie within {1e3 * (high - low)[-1]:.2f} mrad")

figure, axes = plt.subplots(layout="constrained")
axes.fill_between(runs.t, 1e3 * (low - middle), 1e3 * (high - middle))
axes.set(xlabel="t (s)", ylabel="angle of bar 3 from the median (mrad)", title=f"5 % to 95 % of {N_RUNS} linkages")
figure.savefig("ten_thousand_runs.png", dpi=110)
