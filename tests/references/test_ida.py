"""IDA on any ConstrainedSystem: accuracy against the truth, the forms, failures, time-dependent constraints."""

import numpy as np
import pytest

from references.sundials.ida import FORMS, solve_ida
from tests.problems import LINKAGES, violations
from twoloop import solve_dae


def test_stabilised_form_keeps_both_constraints_and_index_1_drifts():
    problem = LINKAGES["default"]
    kept, drifted = (
        violations(problem.system, solve_ida(problem.system, (0.0, 10.0), problem.q0, problem.v0, form, 1e-8, 1e-8))
        for form in ("stabilised", "index1")
    )
    assert kept[0] < 1e-7 and kept[1] < 2e-6
    assert drifted[0] > 20.0 * kept[0]


@pytest.mark.parametrize("form", FORMS)
def test_result_has_our_shapes_and_signs(form):
    problem = LINKAGES["default"]
    result = solve_ida(problem.system, (0.0, 1.0), problem.q0, problem.v0, form, 1e-9, 1e-9)
    n = result.t.size
    assert result.q.shape == result.v.shape == result.a.shape == (9, n) and result.lam.shape == (8, n)
    assert np.array_equal(result.h, np.diff(result.t)) and result.stats.n_accepted == n - 1
    assert result.stats.n_evaluations >= n - 1 and 0 < result.stats.n_factorizations < n
    for k in (0, n // 2, n - 1):
        t, q, v = result.t[k], result.q[:, k], result.v[:, k]
        unbalanced = (
            problem.system.mass(t, q) @ result.a[:, k]
            + problem.system.jacobian(t, q).T @ result.lam[:, k]
            - problem.system.force(t, q, v)
        )
        assert np.abs(unbalanced).max() < 1e-4
    ours = solve_dae(problem.system, (0.0, 1.0), problem.q0, problem.v0, "Gauss6", 1e-10, 1e-10)
    for mine, theirs in ((ours.q, result.q), (ours.v, result.v), (ours.a, result.a), (ours.lam, result.lam)):
        assert np.abs(mine[:, -1] - theirs[:, -1]).max() < 1e-3
