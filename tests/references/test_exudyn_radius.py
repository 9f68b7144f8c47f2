"""Exudyn's spectral radius on every mechanism that has a model, and why there are no steps by error control."""

import numpy as np
import pytest

pytest.importorskip("exudyn")

import exudyn as exu

from references.exudyn import run as exudyn_run
from references.exudyn.mechanisms import MODELS, model_of, solve_exudyn
from studies.bench.collector import Case
from studies.bench.solvers import CATALOGUE, RADII, RIVALS
from studies.validation import study as validation
from twoloop.mechanisms import four_bar

PROBLEMS = {problem.name: problem for problem in (make() for make in validation.MAKE)}
TOP = PROBLEMS["heavy top"]


def top_at(radius):
    return solve_exudyn(TOP, 0.2, 200, spectral_radius=radius)


def test_the_radius_reaches_the_solver_and_the_default_is_exudyns():
    default, same, other = top_at(None), top_at(exudyn_run.SPECTRAL_RADIUS), top_at(0.6)
    assert default.success and other.success
    np.testing.assert_array_equal(default.q, same.q)
    assert 1e-12 < np.abs(default.q - other.q).max() < 1e-2


def test_more_damping_is_less_accurate_and_of_order_two():
    fine = solve_exudyn(TOP, 0.2, 6400).q[:, -1]
    errors = {
        (radius, n): np.abs(solve_exudyn(TOP, 0.2, n, spectral_radius=radius).q[:, -1] - fine).max()
        for radius, n in ((0.9, 200), (0.3, 200), (0.3, 400))
    }
    assert errors[0.3, 200] > errors[0.9, 200]
    assert 3.3 < errors[0.3, 200] / errors[0.3, 400] < 4.7


@pytest.mark.parametrize("name", MODELS)
def test_every_model_runs_with_another_radius(name):
    """It was refused where there is a model and an option."""
    solver = CATALOGUE["Exudyn, GeneralizedAlpha 0.6"]
    result = solver.run(Case(name, PROBLEMS[name], 0.02), 1e-3, 0)
    assert result.success and result.t[-1] == pytest.approx(0.02)
    assert np.abs(result.q[:, 0] - PROBLEMS[name].q0).max() < 1e-12


def test_what_its_author_would_take_is_among_the_rivals_and_what_fails_by_its_own_words_is_not():
    names = {f"Exudyn, GeneralizedAlpha {radius:g}" for radius in RADII}
    assert names <= set(CATALOGUE) and names & set(RIVALS) == {"Exudyn, GeneralizedAlpha 0.6"}
    assert {"Exudyn, GeneralizedAlpha", "Exudyn, TrapezoidalIndex2"} <= set(RIVALS)


def test_any_number_of_steps_can_be_asked_for():
    """It takes a multiple of what is stored."""
    result = CATALOGUE["Exudyn, TrapezoidalIndex2"].run(Case("four-bar", four_bar(), 0.1), 0.1 / 10_007, 0)
    assert result.success and result.t[-1] == pytest.approx(0.1)


@pytest.mark.parametrize("name", ["DOPRI5", "ODE23"])
def test_solvers_with_error_control_refuse_joints(name):
    """When one of them no longer does, it belongs into the catalogue."""
    problem = four_bar()
    model = model_of(problem)
    settings = exudyn_run._settings(0.1, 10, 1)
    settings.timeIntegration.automaticStepSize = True
    with exudyn_run._silence(), pytest.raises(exu.ModelError, match="constraints that cannot be solved"):
        model.mbs.SolveDynamic(settings, solverType=getattr(exu.DynamicSolverType, name))
