"""IDA on the beam: digits of the tip against DOP853, the options that are for its fast vibrations, wrong options."""

import numpy as np
import pytest

from references.driver import check_task
from references.scipy.index1 import solve_index1
from references.sundials.band import band_of
from references.sundials.ida import solve_ida
from references.sundials.ida_c import solve_ida_c
from references.sundials.residual import Implicit
from tests.problems import without_tangent
from twoloop.mechanisms import four_bar, moderately_stiff_beam, very_flexible_beam
from twoloop.mechanisms.ancf_beam import tip_height

TIMES = np.arange(1, 21) / 10.0
CASES = {
    "flexible": very_flexible_beam(),
    "stiff": moderately_stiff_beam(),
    "stiff, no tangent": without_tangent(moderately_stiff_beam()),
}
FOUR_BAR = four_bar()
ORDER_2 = {"max_order": 2, "error_test": "positions"}
# m, the tip's height at 0.1, 0.2 ... 2 s, by DOP853 on the index-1 equations (index1.py) with rtol = atol =
# 3e-14. From 1e-12 to 3e-14 they change by less than 1e-13 m up to 1 s and 5e-11 m up to 2 s ("flexible"), and by less
# than 1e-13 m ("stiff")
TIPS = {
    "flexible": [
        *(-0.04889632383, -0.21080305102, -0.43825960403, -0.99132942959, -0.94681974317),
        *(-0.89503493135, -0.43993582523, -0.17444842228, 0.18861913997, 0.30070508559),
        *(0.25224936204, -0.11080182336, -0.41807654371, -0.71319941564, -0.98755100567),
        *(-0.93507520597, -0.44640610438, -0.02988628371, 0.13777975652, 0.30702677469),
    ],
    "stiff": [
        *(-0.0453840999809, -0.2535008508492, -0.6143423902931, -0.9007424653775, -0.9960229139661),
        *(-0.7901000114947, -0.4823577177219, -0.1776108896546, 0.0222738879270, 0.0134651697215),
        *(-0.1288442907783, -0.3583401568151, -0.7126479442292, -0.9670104842231, -0.9700153147137),
        *(-0.7114682535221, -0.3792111187407, -0.1469810810625, 0.0103250928598, 0.0013569245972),
    ],
}


def run(name, tolerance, driver=solve_ida_c, **options):
    problem = CASES[name]
    options = {"t_eval": TIMES} | options
    t_end = options["t_eval"][-1]
    return driver(problem.system, (0.0, t_end), problem.q0, problem.v0, rtol=tolerance, atol=tolerance, **options)


def errors(name, result):
    """Largest error of the tip's height up to 1 s, and up to 2 s."""
    assert result.success
    error = np.abs(tip_height(result.q) - TIPS[name][: result.t.size])
    return error[:10].max(), error.max()


@pytest.mark.slow
def test_heights_are_those_of_dop853():
    problem = CASES["flexible"]
    result = solve_index1(problem.system, (0.0, 1.0), problem.q0, problem.v0, "DOP853", 1e-9, 1e-9, t_eval=TIMES[:10])
    assert np.abs(tip_height(result.q) - TIPS["flexible"][:10]).max() < 1e-9


@pytest.mark.slow  # the stiff beam takes the same way
def test_six_digits_of_the_flexible_beam_at_1_s():
    assert errors("flexible", run("flexible", 1e-8, t_eval=TIMES[:10]))[0] < 2e-9


@pytest.mark.slow
def test_the_flexible_beam_forgets_its_start():
    to_1_s, to_2_s = errors("flexible", run("flexible", 1e-8))
    assert to_1_s < 2e-9
    assert to_2_s < 1e-6  # it forgets its start: 500 times the error


def test_six_digits_of_the_stiff_beam_at_2_s():
    assert errors("stiff", run("stiff", 1e-5))[1] < 3e-7


@pytest.mark.parametrize("form", ["stabilised", pytest.param("index1", marks=pytest.mark.slow)])
def test_the_same_through_python(form):
    result = run("flexible", 1e-7, solve_ida, form=form, t_eval=TIMES[:10])
    assert errors("flexible", result)[0] < 3e-7


def test_default_steps_follow_the_vibrations_whatever_the_tolerance():
    result = run("stiff", 1e-3, t_eval=TIMES[:2])
    assert result.stats.n_accepted > 10000 and errors("stiff", result)[1] < 2e-5


def test_order_2_and_positions_step_over_them():
    assert errors("stiff", result := run("stiff", 1e-6, **ORDER_2))[1] < 4e-3 and result.stats.n_accepted < 8000
    assert errors("stiff", run("stiff", 1e-8, **ORDER_2))[1] < 2e-4
    # they do not matter only where the beam is stiff
    assert errors("flexible", run("flexible", 1e-6, **ORDER_2))[1] > 0.1


@pytest.mark.slow
def test_a_banded_matrix_gives_the_same_steps():
    banded, dense = (run("stiff", 1e-2, **ORDER_2, banded=each) for each in (True, False))
    assert banded.stats.n_accepted == pytest.approx(dense.stats.n_accepted, rel=0.05)
    assert np.abs(banded.q - dense.q).max() < 1e-6


def test_bandwidths_in_the_order_of_the_nodes():
    problem = CASES["stiff"]
    task = check_task(problem.system, (0.0, 1.0), problem.q0, problem.v0, None, None)
    order, lower, upper = band_of(Implicit(task, "stabilised"))
    assert sorted(order) == list(range(64)) and (lower, upper) == (25, 23)


@pytest.mark.slow
def test_tangent_gives_the_same_motion():
    given, differenced = (run(name, 1e-6, t_eval=TIMES[:5], **ORDER_2) for name in ("stiff", "stiff, no tangent"))
    assert np.abs(given.q - differenced.q).max() < 3e-3
    assert given.stats.n_factorizations == pytest.approx(differenced.stats.n_factorizations, rel=0.4)


@pytest.mark.slow  # as in the test of order 2 above
def test_orders_and_error_test_reach_ida():
    def steps(**options):
        result = solve_ida_c(FOUR_BAR.system, (0.0, 2.0), FOUR_BAR.q0, FOUR_BAR.v0, rtol=1e-7, atol=1e-7, **options)
        return result.stats.n_evaluations

    assert steps(max_order=1) > 7 * steps(max_order=2) > 14 * steps()  # rounding moves the first ratio from 9 to 13
    assert steps(error_test="positions") < 0.8 * steps()
