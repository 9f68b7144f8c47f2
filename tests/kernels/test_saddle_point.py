"""The linear problem M a + G^T lam = r, G a = c: every structure against the whole matrix, by NumPy."""

import numpy as np
import pytest

from tests.chains import chain
from tests.kernels.test_augmented import form, started
from tests.problems import kept
from twoloop.kernels.algebra.saddle_point import solve_both
from twoloop.kernels.data.codes import DONE
from twoloop.kernels.data.common import KIT, VECTOR, WORK, f8, i8
from twoloop.kernels.data.flags import AUGMENTED, FORM, MULTIPLIERS, NULL_SPACE
from twoloop.kernels.evaluation.accelerations import factor_there
from twoloop.kernels.evaluation.inner import factor_dependent, tangents
from twoloop.mechanisms import andrews, four_bar, heavy_top, moderately_stiff_beam, n_four_bar

MECHANISMS = {
    "Andrews, a dense mass": (andrews, NULL_SPACE),
    "four-bar, a diagonal mass": (four_bar, NULL_SPACE),
    "chain": (lambda: chain(3, False), NULL_SPACE),
    "top": (heavy_top, NULL_SPACE),
    "beam, few rows": (moderately_stiff_beam, MULTIPLIERS),
    "many loops": (lambda: n_four_bar(20), AUGMENTED),
}


@kept(i8(KIT, WORK, f8, VECTOR, VECTOR, VECTOR, VECTOR, VECTOR))
def solution(f, w, t, q, r, c, a, lam):
    """All of it at one state, as an evaluation does."""
    code = factor_dependent(f, w, t, q)
    if code == DONE and f.flags[FORM] == NULL_SPACE:
        tangents(f, w, t, q)
    if code == DONE:
        code = factor_there(f, w, t, q)
    if code == DONE:
        solve_both(f, w, r, c, a, lam)
    return code


@pytest.mark.parametrize("name", MECHANISMS)
def test_solution_and_multipliers_are_those_of_the_whole_matrix(name):
    make, expected = MECHANISMS[name]
    problem = make()
    run, system = started(problem), problem.system
    assert form(run) == expected
    n, n_c = system.n_q, system.n_c
    M, G = system.mass(0.0, problem.q0), system.jacobian(0.0, problem.q0)
    whole = np.block([[M, G.T], [G, np.zeros((n_c, n_c))]])
    rng = np.random.default_rng(4)
    for _ in range(3):
        r, c = rng.standard_normal(n), rng.standard_normal(n_c)
        a, lam = np.zeros(n), np.zeros(n_c)
        assert solution(run.kit, run.work, 0.0, problem.q0, r, c, a, lam) == DONE
        known = np.linalg.solve(whole, np.concatenate([r, c]))
        assert np.allclose(np.concatenate([a, lam]), known, rtol=1e-8, atol=1e-8 * np.abs(known).max())
