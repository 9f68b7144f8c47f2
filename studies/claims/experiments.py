"""Small runs behind the claims that no other study makes: single steps and runs of a second."""

import warnings
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from references.four_bar_minimal import MinimalFourBar
from references.paper_step import Step, advance, true_states
from studies import end_states, validation
from twoloop import ConstrainedSystem, ConstraintWarning, Result, paper_irk, solve_dae
from twoloop.mechanisms import Problem, four_bar, knife_edge, rolling_disc
from twoloop.tableaux import sun_radau_iib

Array = NDArray[np.float64]

TOL = 1e-5  # Atol = Rtol of the paper
LOOPS = 1e-9  # err_in = err_out of the paper
SUN = sun_radau_iib(3)
NEAR = 1e-3  # of the state known: 100 times the tolerance
TIME_LIMIT = 60.0  # s of a published mechanism
STEP = 0.06  # s, about the median step of the paper's procedure


def make(quick: bool) -> dict[str, float]:
    """All of them."""
    linkage = four_bar()
    states = true_states(linkage, 8 if quick else 40)
    found = local_error(linkage, states) | predictor(linkage, states) | values_alone(linkage)
    return found | generality(validation.MAKE[:: 7 if quick else 1]) | nonholonomic()


def local_error(problem: Problem, states: list[tuple[float, Array, Array]]) -> dict[str, float]:
    """The estimate (26), (27) over the true error of the two half steps; the share of the step made for it alone."""
    truth = MinimalFourBar.from_parameters(problem.parameters)
    ratios, counts = [], np.zeros(2)
    for t, q, v in states:
        (z, one), (fine, two) = (advance(problem.system, SUN, t, STEP, q, v, n, LOOPS) for n in (1, 2))
        true = np.concatenate(truth.states(t + STEP))[:, 0]
        scale = TOL + TOL * np.maximum(np.abs(np.concatenate([q, v])), np.abs(z))
        ratios.append(np.sqrt(np.mean(((z - fine) / scale) ** 2) / np.mean(((fine - true) / scale) ** 2)))
        counts += one, two
    share = float(counts[0] / counts.sum())
    return {"estimate over error": float(np.median(ratios)), "share of the step for the estimate": share}


def predictor(problem: Problem, states: list[tuple[float, Array, Array]]) -> dict[str, float]:
    """Iterations of a step from the Euler prediction, and from the stages of the step before."""
    counts = []
    for t, q, v in states:
        before = Step(problem.system, SUN, t, STEP, q, v)
        before.converge(LOOPS)
        euler, continued = (Step(problem.system, SUN, t + STEP, STEP, before.q1, before.v1) for _ in range(2))
        continued.continue_from(before)
        counts.append([step.converge(LOOPS) for step in (euler, continued)])
    euler_mean, continued_mean = np.array(counts, dtype=float).mean(axis=0)  # NaN where one does not converge
    return {"iterations from Euler": float(euler_mean), "iterations from the step before": float(continued_mean)}


def values_alone(problem: Problem) -> dict[str, float]:
    """A second of the linkage given by functions that return values: calls of C_q an evaluation, and the difference."""
    given, calls = problem.system, 0

    def jacobian(t: float, q: Array) -> Array:
        nonlocal calls
        calls += 1
        return given.jacobian(t, q)

    def run(system: ConstrainedSystem) -> tuple[Array, float]:
        nonlocal calls
        calls = 0
        result = solve_dae(system, (0.0, 1.0), problem.q0, problem.v0, method=paper_irk(), rtol=TOL, atol=TOL)
        if not result.success or not result.stats.n_evaluations:
            raise RuntimeError(f"the linkage given by values: {result.message}")
        return result.q[:, -1], calls / result.stats.n_evaluations

    functions: dict[str, Any] = {"mass": given.mass, "force": given.force, "constraint": given.constraint}
    functions |= {"n_q": given.n_q, "n_c": given.n_c, "jacobian": jacobian}
    compiled, _ = run(given)
    one, with_gamma = run(ConstrainedSystem.from_python(**functions, gamma=given.gamma))
    other, without = run(ConstrainedSystem.from_python(**functions))
    difference = float(np.abs(np.array([one, other]) - compiled).max())
    return {"difference": difference, "calls given": with_gamma, "calls differenced": without}


def ended(problem: Problem) -> tuple[Result, float]:
    """The paper's procedure to the end of a problem's reference, and the error in q of its last state."""
    known = problem.reference
    assert known is not None
    options: dict[str, Any] = {"method": paper_irk(), "rtol": TOL, "atol": TOL, "time_limit": TIME_LIMIT}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConstraintWarning)
        result = solve_dae(problem.system, (0.0, known.t), problem.q0, problem.v0, **options)
    error = end_states.error(result.q[:, -1], known.q)
    assert error is not None
    return result, error


def generality(make: Sequence[Callable[[], Problem]]) -> dict[str, float]:
    """How many of these mechanisms the paper's procedure brings to the state known."""
    right = [result.success and error < NEAR for result, error in (ended(one()) for one in make)]
    return {"mechanisms": float(len(right)), "mechanisms right": float(sum(right))}


def nonholonomic() -> dict[str, float]:
    """Largest error and largest residual of the velocity constraints on two non-holonomic systems."""
    errors, residuals = [], []
    for problem in (knife_edge(), rolling_disc()):
        result, error = ended(problem)
        errors.append(error)
        residuals.append(end_states.violations(problem.system, result)["violation_v"])
    return {"non-holonomic error": max(errors), "non-holonomic violation": max(residuals)}
