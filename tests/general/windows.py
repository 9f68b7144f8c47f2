"""IFToMM A02 beside the equation for the angle of its cranks, and the values that Exudyn prints."""

import numpy as np
from scipy.optimize import brentq

from tests.general.mechanism import known, of_problem
from tests.mechanisms.motions import planar
from twoloop.mechanisms import n_four_bar

END = 10.0
# the tip of the first crank at 10 s for N = 2, as Exudyn prints it at h = 2.5e-4 and at half of that: order 2
PRINTED_TIP = np.array([[0.3284552113, 0.9445195467], [0.3284573768, 0.9445187937]])


def windows(n):
    return of_problem(n_four_bar(n), known(planar.a02(n), END), END)


def windows_of_bodies(n):
    return of_problem(n_four_bar(n, "bodies"), known(planar.a02(n, bodies=True), END), END)


def first_singular_time(n):
    """When the cranks first lie on the ground line, to rounding."""
    return float(brentq(lambda t: n_four_bar(n).motion.crank(t)[0], 0.5, 1.0, xtol=1e-15))
