"""The plain step against the kernel's, and its parts against what they stand for."""

import numpy as np
import pytest

from references.paper.paper_step import Step, advance, independents, true_states
from twoloop import paper_irk, solve_dae
from twoloop.mechanisms import four_bar
from twoloop.methods.tableaux import sun_radau_iib

SUN = sun_radau_iib(3)
H, LOOPS = 0.02, 1e-12


def test_a_step_is_that_of_the_kernel():
    problem = four_bar()
    for _, q, v in true_states(problem, 5):  # whose motion does not depend on time
        plain, n_outer = advance(problem.system, SUN, 0.0, H, q, v, 1, LOOPS)
        method = paper_irk(inner_tol=1e-12, outer_tol=LOOPS)
        compiled = solve_dae(problem.system, (0.0, H), q, v, method=method, step_size=H)
        assert np.abs(plain - np.concatenate([compiled.q[:, -1], compiled.v[:, -1]])).max() < 1e-9
        assert abs(n_outer - compiled.stats.n_outer) <= 1


def test_prediction_from_the_step_before_saves_iterations_and_changes_no_result():
    problem = four_bar()
    t, q, v = true_states(problem, 5)[2]
    before = Step(problem.system, SUN, t, H, q, v)
    before.converge(LOOPS)
    euler, continued = (Step(problem.system, SUN, t + H, H, before.q1, before.v1) for _ in range(2))
    continued.continue_from(before)
    counts = [step.converge(LOOPS) for step in (euler, continued)]
    assert None not in counts and counts[1] <= counts[0] and np.abs(euler.q1 - continued.q1).max() < 1e-9


def test_a_step_far_too_long_does_not_converge():
    problem = four_bar()
    t, q, v = true_states(problem, 5)[2]
    assert Step(problem.system, SUN, t, 10.0, q, v).converge(LOOPS) is None
    with pytest.raises(RuntimeError, match=r"a step of 10 s at .* does not converge"):
        advance(problem.system, SUN, t, 10.0, q, v, 1, LOOPS)


def test_independents_are_the_columns_without_pivot():
    assert independents(np.array([[0.1, 3.0, 1.0], [2.0, 0.0, 0.5]])) == [2]
