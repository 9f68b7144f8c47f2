"""The beam without constraints: against a two-loop procedure, and what it refuses."""

from copy import copy

import numpy as np
import pytest

from references.scipy.beam_reduced import reduced_motion
from twoloop import solve_dae
from twoloop.mechanisms import four_bar, very_flexible_beam

TIMES = [0.0, 0.03, 0.05]


@pytest.fixture(scope="module")
def problem():
    return very_flexible_beam()


def test_the_constrained_beam_moves_alike(problem):
    q, v = reduced_motion(problem, TIMES, 1e-11)
    result = solve_dae(problem.system, (0.0, TIMES[-1]), problem.q0, problem.v0, "Gauss12", 1e-11, 1e-11, t_eval=TIMES)
    assert np.abs(result.q - q).max() < 1e-10 and np.abs(result.v - v).max() < 1e-6
    for k, t in enumerate(TIMES):
        assert np.abs(problem.system.constraint(t, q[:, k])).max() < 1e-16


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"problem": four_bar()}, "problem must be a beam of ancf_beam"),
        ({"tol": -1.0}, "tol must be positive"),
        ({"t_eval": []}, "t_eval must be a non-empty"),
        ({"t_eval": [0.2, 0.1]}, "t_eval"),
    ],
)
def test_wrong_input_is_named(problem, change, words):
    arguments = {"problem": problem, "t_eval": TIMES, "tol": 1e-8}
    with pytest.raises(TypeError if "problem" in change else ValueError, match=words):
        reduced_motion(**{**arguments, **change})


def test_a_start_that_is_not_finite_is_an_error(problem):
    moving = copy(problem)
    object.__setattr__(moving, "v0", np.full(problem.v0.size, np.nan))  # which Problem itself refuses
    with pytest.raises(RuntimeError, match=r"DOP853 .* cannot start: the accelerations are not finite"):
        reduced_motion(moving, TIMES, 1e-8)
