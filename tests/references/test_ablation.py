"""The five variants: one motion, the tableau's order, drift where it belongs; two kinds of step by other means."""

from itertools import pairwise

import numpy as np
import pytest
from scipy.optimize import root

from references.paper.ablation import FROZEN_ORDER, VARIANTS, solve_variant
from references.paper.four_bar_minimal import trajectory
from references.paper.paper_step import Step, advance, kkt, true_states
from tests.problems import (
    moving_pivot,
    moving_pivot_state,
    oblique_pendulum,
    oblique_point,
    oblique_start,
    oblique_to_point,
)
from twoloop import Status
from twoloop.mechanisms import four_bar
from twoloop.methods.tableaux import Tableau, gauss, radau_iia, sun_radau_iib

PAPER, FROZEN, PROJECTED, STABILISED, UNPROJECTED = VARIANTS
TABLEAUX = {tableau.name: tableau for tableau in (sun_radau_iib(3), gauss(2), radau_iia(3))}
SUN = sun_radau_iib(3)
LINKAGE = four_bar()


def run(variant, tableau=SUN, t_end=1.0, **options):
    return solve_variant(LINKAGE.system, (0.0, t_end), LINKAGE.q0, LINKAGE.v0, variant, tableau, **options)


def error(result):
    q, v = trajectory(LINKAGE.parameters, result.t)
    return max(np.abs(result.q - q).max(), np.abs(result.v - v).max())


@pytest.mark.parametrize("tableau", TABLEAUX.values(), ids=TABLEAUX)
@pytest.mark.parametrize("variant", VARIANTS)
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
def test_follows_the_tolerance(variant):
    tolerances = (1e-4, 1e-5) if variant == FROZEN else (1e-4, 1e-6, 1e-8)
    results = [run(variant, tol=tol)[0] for tol in tolerances]
    errors = [error(result) for result in results]
    assert all(result.success and result.t[-1] == 1.0 for result in results)
    assert all(fine < 0.5 * coarse for coarse, fine in pairwise(errors))
    assert errors[-1] < (1.0 if variant == FROZEN else 1e-5)


@pytest.mark.parametrize("variant", VARIANTS)
def test_only_without_projection_the_constraints_drift(variant):
    result, _ = run(variant, t_end=5.0, step=0.04)
    assert result.success
    early, late = (np.abs(LINKAGE.system.constraint(0.0, result.q[:, k])).max() for k in (25, -1))
    if variant == UNPROJECTED:
        assert late > 1e-6 and late > 2.0 * early
    else:
        assert max(early, late) < 1e-14


def test_the_multiplier_of_the_stabilised_form_vanishes_with_the_step():
    largest = [run(STABILISED, radau_iia(3), step=step)[1] for step in (0.02, 0.01, 0.005)]
    assert largest[0] > 6.0 * largest[1] > 36.0 * largest[2] > 0.0  # as the stage order, 3
    assert largest[-1] < 1e-3
    assert all(run(variant, step=0.02)[1] == 0.0 for variant in VARIANTS if variant != STABILISED)


def test_a_step_with_positions_in_every_stage_is_that_of_the_paper():
    for _, q, v in true_states(LINKAGE, 5):
        plain, _ = advance(LINKAGE.system, SUN, 0.0, 0.02, q, v, 1, 1e-13)
        result, _ = solve_variant(LINKAGE.system, (0.0, 0.02), q, v, PAPER, SUN, step=0.02)
        assert np.abs(np.concatenate([result.q[:, -1], result.v[:, -1]]) - plain).max() < 1e-10


def test_a_step_with_dependents_frozen_is_that_of_the_paper_without_its_inner_loop():
    for _, q, v in true_states(LINKAGE, 5):
        plain = Step(LINKAGE.system, SUN, 0.0, 0.02, q, v)
        solved = plain.dependents
        plain.dependents = lambda t, q, v: (q, v)  # as they were at the beginning of the step
        for _ in range(30):
            plain.iterate()
        q1, v1 = solved(0.02, plain.q1, plain.v1)
        result, _ = solve_variant(LINKAGE.system, (0.0, 0.02), q, v, FROZEN, SUN, step=0.02)
        assert max(np.abs(result.q[:, -1] - q1).max(), np.abs(result.v[:, -1] - v1).max()) < 1e-9


def test_a_stabilised_step_solves_its_equations():
    """Against a general solver on all equations of the stages at once; Radau IIA ends in its last stage."""
    system, tableau, h = LINKAGE.system, radau_iia(3), 0.02
    n, m, s = system.n_q, system.n_c, 3
    _, q, v = true_states(LINKAGE, 5)[1]
    a, lam = kkt(system, 0.0, q, v)

    def stages(x):
        return np.split(x.reshape(s, 2 * n + 2 * m), [n, 2 * n, 2 * n + m], axis=1)

    def residual(x):
        rates, accelerations, forces, mu = stages(x)
        Q, V = q + h * tableau.A @ rates, v + h * tableau.A @ accelerations
        rows = []
        for j in range(s):
            M, G = system.mass(0.0, Q[j]), system.jacobian(0.0, Q[j])
            rows += [M @ (rates[j] - V[j]) + G.T @ mu[j], M @ accelerations[j] + G.T @ forces[j]]
            rows[-1] = rows[-1] - system.force(0.0, Q[j], V[j])
            rows += [system.constraint(0.0, Q[j]) / h**2, G @ V[j] / h]
        return np.concatenate(rows)

    solution = root(residual, np.tile(np.concatenate([v, a, lam, np.zeros(m)]), s), tol=1e-12)
    rates, accelerations, _, mu = stages(solution.x)
    assert np.abs(residual(solution.x)).max() < 1e-7
    result, largest = solve_variant(system, (0.0, h), q, v, STABILISED, tableau, step=h)
    assert np.abs(result.q[:, -1] - q - h * tableau.b @ rates).max() < 1e-10
    assert np.abs(result.v[:, -1] - v - h * tableau.b @ accelerations).max() < 1e-9
    assert largest == pytest.approx(np.abs(mu).max(), rel=1e-5)


@pytest.mark.parametrize("variant", VARIANTS)
def test_a_moving_pivot_and_a_mass_that_varies(variant):
    """C_t and C_tt that are not zero; an oblique pendulum whose mass matrix depends on t and q."""
    step, near = (2e-3, 0.1) if variant == FROZEN else (0.02, 1e-6)
    q, v = moving_pivot_state(0.0)
    result, _ = solve_variant(moving_pivot(), (0.0, 1.0), q, v, variant, SUN, step=step)
    assert result.success and np.abs(result.q[:, -1] - moving_pivot_state(1.0)[0]).max() < near
    result, _ = solve_variant(oblique_pendulum(), (0.0, 1.0), *oblique_start(), variant, SUN, step=step)
    assert result.success and np.abs(oblique_to_point(result)[0][:, -1] - oblique_point(1.0)[0]).max() < near


def test_counts_tell_what_the_variants_do():
    stats = {variant: run(variant, step=0.02)[0].stats for variant in VARIANTS}
    assert all(each.n_accepted == 50 and each.n_evaluations == 3 * each.n_outer + 51 for each in stats.values())
    assert stats[PAPER].n_factorizations > 2.5 * stats[PAPER].n_evaluations
    assert stats[UNPROJECTED].n_factorizations == stats[UNPROJECTED].n_evaluations + 1  # that of the constant mass
    assert stats[UNPROJECTED].n_inner == 0 < stats[PROJECTED].n_inner <= 100
    assert [each.n_partitions for each in stats.values()] == [50, 50, 0, 0, 0]


def test_what_does_not_converge_or_takes_too_long_is_a_failed_result():
    result, _ = run(PAPER, step=1.0)
    assert result.status is Status.SOLVER_FAILED and "the stage iteration does not converge" in result.message
    result, _ = run(PAPER, t_end=1e4, step=0.01, time_limit=0.05)
    assert result.status is Status.SOLVER_FAILED and "time_limit = 0.05" in result.message and result.t[-1] < 1e4


def test_wrong_arguments_are_named():
    with pytest.raises(ValueError, match=r"variant must be 'positions in every stage', .*; given 'frozen'"):
        run("frozen", step=0.1)
    for options in ({}, {"step": 0.1, "tol": 1e-3}):
        with pytest.raises(ValueError, match="either step, for fixed steps, or tol"):
            run(PAPER, **options)
    with pytest.raises(ValueError, match="tol must be positive"):
        run(PAPER, tol=-1.0)
    euler = Tableau("explicit Euler", np.zeros((1, 1)), np.ones(1), np.zeros(1), 1)
    with pytest.raises(ValueError, match="invertible A; that of explicit Euler"):
        run(PAPER, euler, step=0.1)
    with pytest.raises(ValueError, match="must have gamma"):
        solve_variant(moving_pivot(gamma=False), (0.0, 1.0), *moving_pivot_state(0.0), PAPER, SUN, step=0.1)
