"""Exudyn's own models of published mechanisms: second order towards the known state, and what they refuse."""

import numpy as np
import pytest

pytest.importorskip("exudyn")

from references.exudyn.mechanisms import MODELS, has_model, solve_exudyn
from references.exudyn.model import frame
from studies.validation import study as validation
from twoloop import mechanisms

PROBLEMS = {problem.name: problem for problem in (make() for make in validation.MAKE)}
FEWEST = {"spatial slider-crank": 1000, "heavy top": 500, "A04 Bricard": 1000}  # steps from which errors are of order 2


def end_error(problem, n_steps, **options):
    known = problem.reference
    result = solve_exudyn(problem, known.t, n_steps, store_every=n_steps, **options)
    assert result.success, result.message
    assert np.abs(result.q[:, 0] - problem.q0).max() < 1e-12
    assert np.abs(result.v[:, 0] - problem.v0).max() < 1e-12
    return np.abs(result.q[:, -1] - known.q).max(), np.abs(result.v[:, -1] - known.v).max()


@pytest.mark.parametrize("name", [name for name in validation.MODELS if "bodies" not in name])
def test_second_order_towards_the_known_state(name):
    n = FEWEST.get(name, 500)
    coarse, fine = (end_error(PROBLEMS[name], steps) for steps in (n, 2 * n))
    assert fine[0] < 0.02
    for k in range(2):
        assert 3.3 < coarse[k] / fine[k] < 4.7


def test_two_other_solvers():
    for solver in ("TrapezoidalIndex2", "HHT"):
        assert end_error(PROBLEMS["redundant slider-crank"], 2000, solver=solver)[0] < 1e-3


def test_the_list_of_the_study_is_that_of_the_models():
    there = {name for name, problem in PROBLEMS.items() if has_model(problem)} - {"A02, N = 40"}
    assert there == set(validation.MODELS) >= set(MODELS)


def test_other_mechanisms_are_refused():
    with pytest.raises(ValueError, match=r"problem must be of A02 or one of .*given 'double pendulum'"):
        solve_exudyn(mechanisms.double_pendulum(), 1.0, 100)


def test_frames_are_rotations_with_the_columns_given():
    x, y = np.array([0.6, 0.8, 0.0]), np.array([-0.8, 0.6, 0.0])
    for given in ({"x": x}, {"y": x}, {"z": x}, {"x": x, "y": y}, {"y": x, "z": y}, {"x": y, "z": x}):
        made = frame(**given)
        np.testing.assert_allclose(made.T @ made, np.eye(3), atol=1e-15)
        assert np.linalg.det(made) == pytest.approx(1.0)
        for name, column in given.items():
            assert (made[:, "xyz".index(name)] == column).all()
