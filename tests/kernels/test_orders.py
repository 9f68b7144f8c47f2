"""Test the convergence order of every method on a pendulum whose pivot moves, by errors of positions and velocities."""

from functools import cache

import numpy as np
import pytest

from tests.marks import slow_but
from tests.problems import moving_pivot, moving_pivot_state, worst
from twoloop import BDF, DOP853, ESDIRK, Newmark, RungeKutta, solve_dae
from twoloop.methods.tableaux import gauss, lobatto_iiie, radau_iia, sun_radau_iib

START = (0.4, 0.0)  # the angle stays below half a radian, and so the independent coordinate the same
TIMES = np.linspace(0.25, 2.0, 8)
METHODS = {
    **{f"gauss({s})": (RungeKutta(gauss(s)), 2 * s) for s in (1, 2, 3, 4)},
    **{f"radau_iia({s})": (RungeKutta(radau_iia(s)), 2 * s - 1) for s in (2, 3)},
    **{f"sun_radau_iib({s})": (RungeKutta(sun_radau_iib(s)), 2 * s - 1) for s in (2, 3)},
    **{f"lobatto_iiie({s})": (RungeKutta(lobatto_iiie(s)), 2 * s - 2) for s in (2, 3, 4)},
    "paper's loop, sun_radau_iib(3)": (RungeKutta(sun_radau_iib(3), outer="paper", outer_tol=1e-14), 5),
    "gauss(3), symmetric": (RungeKutta(gauss(3), partition="symmetric"), 6),
    "newmark(1/4)": (Newmark(beta=0.25), 2),
    "newmark(1/2)": (Newmark(beta=0.5), 2),
    "newmark(1/4, gamma=0.6)": (Newmark(beta=0.25, gamma=0.6), 1),
    "dop853": (DOP853(), 8),
    "dop853, restored": (DOP853("restored"), 8),
    "tr-bdf2": (ESDIRK("TRBDF2"), 2),
    "esdirk4": (ESDIRK("ESDIRK4"), 4),
    **{f"bdf({k})": (BDF(max_order=k), k) for k in range(1, 6)},
}


@cache
def problem():
    return moving_pivot(compile=True), moving_pivot_state(0.0, START, 2.0), moving_pivot_state(TIMES, START, 2.0)


@pytest.mark.parametrize("name", slow_but(METHODS.keys() - {"bdf(2), Newton's method"}, METHODS))
def test_observed_order_is_the_theoretical_one(name):
    method, order = METHODS[name]
    steps_a_second = np.array([8, 16] if order == 8 else [16, 32] if order > 4 else [32, 64])
    system, start, (q, v) = problem()
    errors = []
    for n in steps_a_second:
        result = solve_dae(system, (0.0, 2.0), *start, method=method, step_size=1.0 / n, t_eval=TIMES)
        assert result.success, result.message
        assert len(result.h) == 2 * n
        errors.append((worst(result.q, q), worst(result.v, v)))
    slopes = np.log2(np.array(errors[0]) / np.array(errors[1]))
    assert np.abs(slopes - order).max() < 0.3, (slopes, errors)


def test_newmark_error_constants_have_the_ratio_that_theory_gives():
    # local error |beta - 1/6| h^3: 1/3 for beta = 1/2 as printed, 1/12 for beta = 1/4; hence the step-size control
    system, start, _ = problem()
    steps = {}
    for beta in (0.25, 0.5):
        steps[beta] = solve_dae(system, (0.0, 2.0), *start, method=Newmark(beta=beta, error_tol=1e-7)).stats.n_accepted
    assert steps[0.5] / steps[0.25] == pytest.approx(4.0 ** (1.0 / 3.0), rel=0.05)
