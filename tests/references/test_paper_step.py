"""Test the paper's step in plain Python, and its five variants: one motion, order of the tableau, drift."""

from itertools import pairwise

import numpy as np
import pytest

from references.paper.ablation import FROZEN_ORDER, VARIANTS, solve_variant
from references.paper.four_bar_minimal import MinimalFourBar
from references.paper.paper_step import Step, advance, true_states
from tests.problems import (
    moving_pivot,
    moving_pivot_state,
    oblique_pendulum,
    oblique_point,
    oblique_start,
    oblique_to_point,
)
from twoloop import Status, paper_irk, solve_dae
from twoloop.mechanisms import four_bar
from twoloop.methods.tableaux import gauss, radau_iia, sun_radau_iib

PAPER, FROZEN, PROJECTED, STABILISED, UNPROJECTED = VARIANTS
TABLEAUX = {tableau.name: tableau for tableau in (sun_radau_iib(3), gauss(2), radau_iia(3))}
SUN = sun_radau_iib(3)
LINKAGE = four_bar()


def run(variant, tableau=SUN, t_end=1.0, **options):
    return solve_variant(LINKAGE.system, (0.0, t_end), LINKAGE.q0, LINKAGE.v0, variant, tableau, **options)


def error(result):
    q, v = MinimalFourBar.from_parameters(LINKAGE.parameters).states(result.t)
    return max(np.abs(result.q - q).max(), np.abs(result.v - v).max())


@pytest.mark.parametrize("tableau", TABLEAUX.values(), ids=TABLEAUX)
@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.slow  # compiles the variants, for half a minute
def test_converges_to_the_true_motion_with_the_order_of_the_tableau(variant, tableau):
    errors = []
    for step in (0.02, 0.01):
        result, _ = run(variant, tableau, step=step)
        assert result.success and result.t.size == round(1.0 / step) + 1 and result.t[-1] == 1.0
        errors.append(error(result))
    order = FROZEN_ORDER if variant == FROZEN else tableau.order
    assert abs(np.log2(errors[0] / errors[1]) - order) < 0.5 + 0.4 * (order == 5)  # asymptotic only with shorter steps
    assert errors[1] < (1.0 if variant == FROZEN else 1e-4)


@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.slow
def test_follows_the_tolerance(variant):
    tolerances = (1e-4, 1e-5) if variant == FROZEN else (1e-4, 1e-6, 1e-8)
    results = [run(variant, tol=tol)[0] for tol in tolerances]
    errors = [error(result) for result in results]
    assert all(result.success and result.t[-1] == 1.0 for result in results)
    assert all(fine < 0.5 * coarse for coarse, fine in pairwise(errors))
    assert errors[-1] < (1.0 if variant == FROZEN else 1e-5)


@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.slow
def test_only_without_projection_the_constraints_drift(variant):
    result, _ = run(variant, t_end=5.0, step=0.04)
    assert result.success
    early, late = (np.abs(LINKAGE.system.constraint(0.0, result.q[:, k])).max() for k in (25, -1))
    if variant == UNPROJECTED:
        assert late > 1e-6 and late > 2.0 * early
    else:
        assert max(early, late) < 1e-14


@pytest.mark.slow
def test_the_multiplier_of_the_stabilised_form_vanishes_with_the_step():
    largest = [run(STABILISED, radau_iia(3), step=step)[1] for step in (0.02, 0.01, 0.005)]
    assert largest[0] > 6.0 * largest[1] > 36.0 * largest[2] > 0.0  # as the stage order, 3
    assert largest[-1] < 1e-3
    assert all(run(variant, step=0.02)[1] == 0.0 for variant in VARIANTS if variant != STABILISED)


@pytest.mark.slow
def test_a_step_with_positions_in_every_stage_is_that_of_the_paper():
    for _, q, v in true_states(LINKAGE, 5):
        plain, _ = advance(LINKAGE.system, SUN, 0.0, 0.02, q, v, 1, 1e-13)
        result, _ = solve_variant(LINKAGE.system, (0.0, 0.02), q, v, PAPER, SUN, step=0.02)
        assert np.abs(np.concatenate([result.q[:, -1], result.v[:, -1]]) - plain).max() < 1e-10


@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.slow
def test_a_moving_pivot_and_a_mass_that_varies(variant):
    """C_t and C_tt that are not zero; an oblique pendulum whose mass matrix depends on t and q."""
    step, near = (2e-3, 0.1) if variant == FROZEN else (0.02, 1e-6)
    q, v = moving_pivot_state(0.0)
    result, _ = solve_variant(moving_pivot(), (0.0, 1.0), q, v, variant, SUN, step=step)
    assert result.success and np.abs(result.q[:, -1] - moving_pivot_state(1.0)[0]).max() < near
    result, _ = solve_variant(oblique_pendulum(), (0.0, 1.0), *oblique_start(), variant, SUN, step=step)
    assert result.success and np.abs(oblique_to_point(result)[0][:, -1] - oblique_point(1.0)[0]).max() < near


@pytest.mark.slow
def test_what_does_not_converge_or_takes_too_long_is_a_failed_result():
    result, _ = run(PAPER, step=1.0)
    assert result.status is Status.SOLVER_FAILED and "the stage iteration does not converge" in result.message
    result, _ = run(PAPER, t_end=1e4, step=0.01, time_limit=0.05)
    assert result.status is Status.SOLVER_FAILED and "time_limit = 0.05" in result.message and result.t[-1] < 1e4


H, LOOPS = 0.02, 1e-12


def test_a_step_is_that_of_the_kernel():
    problem = four_bar()
    for _, q, v in true_states(problem, 5):  # whose motion does not depend on time
        plain, n_outer = advance(problem.system, SUN, 0.0, H, q, v, 1, LOOPS)
        method = paper_irk(inner_tol=1e-12, outer_tol=LOOPS)
        compiled = solve_dae(problem.system, (0.0, H), q, v, method=method, step_size=H)
        assert np.abs(plain - np.concatenate([compiled.q[:, -1], compiled.v[:, -1]])).max() < 1e-9
        assert abs(n_outer - compiled.stats.n_outer) <= 1


def test_a_step_far_too_long_does_not_converge():
    problem = four_bar()
    t, q, v = true_states(problem, 5)[2]
    assert Step(problem.system, SUN, t, 10.0, q, v).converge(LOOPS) is None
    with pytest.raises(RuntimeError, match=r"a step of 10 s at .* does not converge"):
        advance(problem.system, SUN, t, 10.0, q, v, 1, LOOPS)
