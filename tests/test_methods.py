"""Method objects and presets: options, their checks, and what they say about the paper."""

from dataclasses import FrozenInstanceError, replace

import numpy as np
import pytest

from twoloop import BDF, DOP853, Newmark, RungeKutta, paper_irk, paper_newmark, solve_dae
from twoloop.methods.presets import PRESETS
from twoloop.methods.tableaux import gauss, sun_radau_iib


@pytest.mark.parametrize("order", range(4, 17, 2))
def test_gauss_presets_have_the_order_of_their_name(order):
    tableau = PRESETS[f"Gauss{order}"].tableau
    assert tableau.order == order and tableau.stages == order // 2


@pytest.mark.parametrize("name", ["SunRadau5", "PaperIRK"])
def test_suns_presets_use_table_1(name):
    assert np.abs(PRESETS[name].tableau.A - sun_radau_iib(3).A).max() == 0.0


def test_methods_are_frozen():
    for method in (RungeKutta(gauss(2)), Newmark(), BDF(), DOP853()):
        with pytest.raises(FrozenInstanceError):
            method.inner_tol = 1.0


def test_papers_newmark_has_beta_as_printed_and_takes_another():
    assert paper_newmark().beta == 0.5 and paper_newmark().gamma == 0.5 and paper_newmark(beta=0.25).beta == 0.25
    assert paper_newmark(1e-5, 1e-7).inner_tol == 1e-5 and paper_newmark(1e-5, 1e-7).error_tol == 1e-7


def test_papers_presets_name_their_deviations():
    for words in ("(26)", "(27)", "(31)", "(32)", "(33)", "(34)", "Rotol", "exponent", "Chosen"):
        assert words.lower() in paper_irk.__doc__.lower()
    for words in ("beta = 1/2", "1/4", "Hussein", "err_out"):
        assert words in paper_newmark.__doc__


def test_names_are_different():
    assert len({method.name for method in PRESETS.values()}) == len(PRESETS)


def test_the_papers_criterion_over_all_coordinates_needs_fewer_steps_at_a_loose_tolerance(default_four_bar):
    """Criterion (32), tolerance 1e-3: over y_i alone the outer loop stops too early, and steps become small."""
    problem = default_four_bar
    steps = {}
    for outer_test in ("all", "independent"):
        method = replace(paper_irk(1e-9, 1e-3), outer_test=outer_test)
        result = solve_dae(problem.system, (0.0, 20.0), problem.q0, problem.v0, method, rtol=1e-5, atol=1e-5)
        assert result.success, result.message
        steps[outer_test] = len(result.h)
    assert steps["all"] < 0.8 * steps["independent"]
