"""Evaluations for each second of motion that a method takes for an error: a bound for every preset, on two mechanisms.

The bounds are a quarter above what the methods took when they were written; a method that becomes cheaper passes.
On Andrews' mechanism most methods would take fewer than a hundred steps, which none may that looks at stages only.
"""

import numpy as np
import pytest

from tests.problems import quick
from twoloop import solve_dae
from twoloop.mechanisms import andrews, four_bar
from twoloop.methods.presets import PRESETS

TOLERANCES = (1e-3, 1e-5, 1e-7, 1e-9)
ERROR = 1e-5  # of a coordinate at the end ...
LOOSE = {"Newmark": 1e-3}  # ... but of a method of second order
ELSEWHERE = {"PaperIRK", "PaperNewmark", "TRBDF2", "ESDIRK4"}  # bounded in tests of their own
BOUNDS = {
    "auto": (440, 43_000),
    "Lobatto16": (440, 43_000),
    "SunRadau5": (830, 70_000),
}  # on the four-bar, on Andrews' mechanism
BOUNDS |= {"Gauss4": (820, 65_000), "Gauss6": (760, 54_000), "Gauss8": (580, 75_000), "Gauss10": (610, 82_000)}
BOUNDS |= {"Gauss12": (670, 91_000), "Gauss14": (670, 102_000), "Gauss16": (820, 114_000)}
BOUNDS |= {"RadauIIA5": (510, 38_000), "RadauIIA9": (530, 46_000), "RadauIIA13": (440, 54_000)}
BOUNDS |= {"Newmark": (1_600, 94_000), "BDF": (470, 65_000), "DOP853": (290, 50_000), "Adams": (190, 17_000)}
BOUNDS |= {"Taylor": (280, 27_500)}


def evaluations(problem, method, target):
    """Evaluations a second at an error, on the log-log line between the runs on either side of it."""
    t_end, runs = problem.reference.t, []
    for tolerance in TOLERANCES:
        options = {"method": method, "rtol": tolerance, "atol": tolerance}
        result = solve_dae(problem.system, (0.0, t_end), problem.q0, problem.v0, **options)
        assert result.success, result.message
        error = float(np.abs(result.q[:, -1] - problem.reference.q).max())
        runs.append((error, result.stats.n_evaluations / t_end))
        if error < target:
            break
    assert runs[-1][0] < target, f"the least error of {method} is {runs[-1][0]:.1e}"
    errors, counts = (np.log(np.array(each)) for each in zip(*runs[-2:], strict=True))
    return float(np.exp(np.interp(np.log(target), errors[::-1], counts[::-1])))


def test_every_preset_has_a_bound():
    assert set(BOUNDS) == set(PRESETS) - ELSEWHERE


@pytest.mark.parametrize("method", quick(BOUNDS, 4))
@pytest.mark.parametrize("make", quick([four_bar, andrews]))
def test_evaluations_at_an_error_are_bounded(make, method):
    assert evaluations(make(), method, LOOSE.get(method, ERROR)) < BOUNDS[method][make is andrews]
