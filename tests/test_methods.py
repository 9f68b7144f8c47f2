"""Method objects and presets: options, their checks, and what they say about the paper."""

from dataclasses import replace

import pytest

from twoloop import paper_irk, solve_dae
from twoloop.methods.presets import PRESETS


@pytest.mark.parametrize("order", range(4, 17, 2))
def test_gauss_presets_have_the_order_of_their_name(order):
    tableau = PRESETS[f"Gauss{order}"].tableau
    assert tableau.order == order and tableau.stages == order // 2


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
