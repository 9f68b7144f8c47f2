"""Test diagonally implicit stages: stability, stiff problems with and without tangents, contacts."""

import numpy as np
import pytest

from tests.marks import slow
from tests.problems import unconstrained, worst
from twoloop import ESDIRK, RungeKutta, solve_dae
from twoloop.kernels.steps.diagonal_step import N_FILTERS
from twoloop.mechanisms import moderately_stiff_beam
from twoloop.mechanisms.ancf_beam import tip_height
from twoloop.methods.runge_kutta import FORMULAS
from twoloop.methods.tableaux import radau_iia

TIMES = np.linspace(0.1, 1.0, 10)


@pytest.fixture(scope="module")
def beam():
    problem = moderately_stiff_beam()
    method = RungeKutta(radau_iia(4), outer="newton", tested="positions")
    fine = solve_dae(problem.system, (0.0, 1.0), problem.q0, problem.v0, method, 1e-6, 1e-6, t_eval=TIMES)
    return problem, tip_height(fine.q)


@pytest.mark.parametrize("formula", FORMULAS)
def test_stability_function_vanishes_at_infinity(formula):
    A, _ = FORMULAS[formula][0]()
    R = lambda z: 1.0 + z * A[-1] @ np.linalg.solve(np.eye(len(A)) - z * A, np.ones(len(A)))  # noqa: E731
    assert abs(R(-1e8)) < 1e-6 and max(abs(R(1j * y)) for y in np.logspace(-2, 4, 50)) < 1.0 + 1e-12


def growth_of_extrapolated_steps(z, filtered):
    """Largest factor by which a step multiplies (y, h y') of h y' = z y: y of the embedded formula, y' of a stage."""
    A, embedded = FORMULAS["TRBDF2"][0]()
    g = A[1, 1]

    def step(y, rate):
        rates = np.array([rate, 0.0, 0.0], dtype=complex)
        for j in (1, 2):
            stage = (y + A[j, :j] @ rates[:j]) / (1.0 - g * z)
            rates[j] = z * stage
        return stage + (embedded - A[-1]) @ rates / (1.0 - g * z) ** filtered, rates[2]

    return np.abs(np.linalg.eigvals(np.transpose([step(1.0, 0.0), step(0.0, 1.0)]))).max()


def test_three_filters_keep_the_extrapolated_steps_stable():
    vibrations, decay = 1j * np.logspace(-2, 5, 200), -np.logspace(-2, 5, 200)
    assert max(growth_of_extrapolated_steps(z, N_FILTERS) for z in [*vibrations, *decay]) < 1.0 + 1e-12
    assert growth_of_extrapolated_steps(-1e8, N_FILTERS) < 1e-6
    assert max(growth_of_extrapolated_steps(z, N_FILTERS - 1) for z in vibrations) > 1.0 + 1e-5


@pytest.mark.parametrize(("formula", "limit"), [("TRBDF2", 3e-3), ("ESDIRK4", 1.5e-3)])
def test_stiff_beam_takes_few_iterations(beam, formula, limit):
    problem, truth = beam
    method = ESDIRK(formula, outer_tol=1e-4)
    result = solve_dae(problem.system, (0.0, 1.0), problem.q0, problem.v0, method, step_size=0.01, t_eval=TIMES)
    assert result.success and np.abs(tip_height(result.q) - truth).max() < limit
    assert result.stats.n_outer < 2.2 * ({"TRBDF2": 2, "ESDIRK4": 5}[formula] * 100)
    assert result.stats.n_jacobians == result.stats.n_outer  # each iterate has its own


def test_error_of_the_stiff_beam_goes_with_the_tolerance(beam):
    problem, truth = beam
    errors, evaluations = [], []
    for tol in (1e-3, 1e-6):
        result = solve_dae(problem.system, (0.0, 1.0), problem.q0, problem.v0, "TRBDF2", tol, tol, t_eval=TIMES)
        errors.append(np.abs(tip_height(result.q) - truth).max())
        evaluations.append(result.stats.n_evaluations)
    assert errors[0] < 5e-3 and errors[1] < 1e-4 and errors[1] < errors[0] / 5
    assert evaluations[1] < 8000  # an explicit method needs 70,000


@pytest.mark.slow
def test_damping_without_a_derivative_by_position():
    """v' = -k v with k = 1e6, beside a free coordinate: J_v is all there is."""
    system = unconstrained(lambda t, q, v: np.array([-1e6 * (v[0] - np.cos(t)), -q[1]]), 2, compile=True)
    result = solve_dae(system, (0.0, 2.0), [0.0, 1.0], [1.0, 0.0], "TRBDF2", 1e-5, 1e-5)
    assert worst(result.q[:, -1], [np.sin(2.0), np.cos(2.0)]) < 3e-3 and result.stats.n_evaluations < 5000


def thrown(stiffness, damping, t):
    """Place at t of a damped mass that is thrown from 0 at 2 m/s against a spring at 0.5, and comes back."""
    bounces, speed = -np.log(1.0 - 0.25 * damping) / damping, 2.0 - 0.5 * damping
    rate = np.sqrt(stiffness - 0.25 * damping**2)
    leaves, speed = bounces + np.pi / rate, speed * np.exp(-0.5 * damping * np.pi / rate)
    return 0.5 - speed / damping * (1.0 - np.exp(-damping * (t - leaves)))


@pytest.mark.parametrize("tol", [1e-7, slow(1e-8)])
def test_derivatives_of_a_contact_do_not_outlive_it(tol):
    """With those of the contact, Newton's method contracts fast enough in the flight behind it."""
    force = lambda t, q, v, p: np.array([-p[1] * v[0] - 0.5 * p[0] * (abs(q[0] - 0.5) + q[0] - 0.5)])  # noqa: E731
    system = unconstrained(force, 1, parameters=[1e4, 1.0], compile=True)
    errors = []
    for numbers in [(k, b) for k in np.logspace(3.5, 5.5, 9) for b in (0.5, 1.0, 2.0)]:
        result = solve_dae(system.with_parameters(numbers), (0.0, 1.5), [0.0], [2.0], "TRBDF2", tol, tol)
        errors.append(abs(result.q[0, -1] - thrown(*numbers, 1.5)) if result.success else np.inf)
    assert max(errors) < 400.0 * tol  # 153; 1354 and 6016 where the derivatives are kept
