"""Small runs behind the claims that no other study makes: single steps and runs of a second."""

import numpy as np
from numpy.typing import NDArray

from references.four_bar_minimal import MinimalFourBar
from studies.cases.four_bar import SECOND, Y3
from studies.claims.iteration import Step, true_states
from twoloop import ConstrainedSystem, paper_irk, solve_dae
from twoloop.mechanisms import Problem, four_bar
from twoloop.tableaux import sun_radau_iib

Array = NDArray[np.float64]

TOL = 1e-5  # Atol = Rtol of the paper
LOOPS = 1e-9  # err_in = err_out of the paper
SUN = sun_radau_iib(3)
ONE_PARTITION = {"lengths": (1.0, 1.2, 0.5), "ground": 1.0, "theta3": np.pi, "branch": 1}
STEP = 0.06  # s, about the median step of the paper's procedure
TRIED = (0.1, 0.15, 0.2, 0.3)  # s, steps at which (33) is tried


def make(quick: bool) -> dict[str, float]:
    """All of them."""
    linkage, phases = four_bar(), 8 if quick else 40
    parts = (local_error(linkage, phases), needless(linkage, phases), predictor(linkage, phases))
    return heights() | parts[0] | parts[1] | parts[2] | values_alone(linkage)


def heights() -> dict[str, float]:
    """Highest y3 of the true motion from rest, m, for several geometries."""
    problems = (four_bar(), four_bar(**SECOND), four_bar(**ONE_PARTITION), four_bar(branch=1))  # type: ignore[arg-type]
    found = {}
    for k, problem in enumerate(problems, 1):
        truth = MinimalFourBar.from_parameters(problem.parameters)
        found[f"highest y3 of geometry {k}"] = float(truth.states(np.linspace(0.0, truth.period, 4001))[0][Y3].max())
    return found


def _steps(problem: Problem, t: float, q: Array, v: Array, n: int) -> tuple[Array, int]:
    """State after n steps that cover STEP, and how many iterations they took."""
    count = 0
    for k in range(n):
        step = Step(problem.system, SUN, t + k * STEP / n, STEP / n, q, v)
        needed, _ = step.converge(LOOPS)
        if needed is None:
            raise RuntimeError(f"a step of {STEP / n:g} s at {t:g} s does not converge")
        q, v, count = step.q1, step.v1, count + needed
    return np.concatenate([q, v]), count


def local_error(problem: Problem, phases: int) -> dict[str, float]:
    """The estimate (26), (27) over the true error of the two half steps; the share of the step made for it alone."""
    truth = MinimalFourBar.from_parameters(problem.parameters)
    ratios, counts = [], np.zeros(2)
    for t, q, v in true_states(problem, phases):
        (z, one), (fine, two) = (_steps(problem, t, q, v, n) for n in (1, 2))
        true = np.concatenate(truth.states(t + STEP))[:, 0]
        scale = TOL + TOL * np.maximum(np.abs(np.concatenate([q, v])), np.abs(z))
        ratios.append(np.sqrt(np.mean(((z - fine) / scale) ** 2) / np.mean(((fine - true) / scale) ** 2)))
        counts += one, two
    share = float(counts[0] / counts.sum())
    return {"estimate over error": float(np.median(ratios)), "share of the step for the estimate": share}


def needless(problem: Problem, phases: int) -> dict[str, float]:
    """Steps that (33) gives up, and those of them whose iteration converges if it is let."""
    given_up = converging = 0
    for h in TRIED:
        for t, q, v in true_states(problem, phases):
            count, refused = Step(problem.system, SUN, t, h, q, v).converge(LOOPS)
            given_up += refused or count is None
            converging += refused and count is not None
    return {"steps given up by (33)": given_up, "of these, converging": converging}


def predictor(problem: Problem, phases: int) -> dict[str, float]:
    """Iterations of a step from the Euler prediction, and from the stages of the step before."""
    counts: list[list[int | None]] = [[], []]
    for t, q, v in true_states(problem, phases):
        before = Step(problem.system, SUN, t, STEP, q, v)
        before.converge(LOOPS)
        euler, continued = (Step(problem.system, SUN, t + STEP, STEP, before.q1, before.v1) for _ in range(2))
        continued.continue_from(before)
        for step, into in zip((euler, continued), counts, strict=True):
            into.append(step.converge(LOOPS)[0])
    means = (float(np.mean(np.array(each, dtype=float))) for each in counts)  # NaN where one does not converge
    return dict(zip(("iterations from Euler", "iterations from the step before"), means, strict=True))


def _one_second(problem: Problem, system: ConstrainedSystem) -> tuple[Array, int]:
    """Positions after a second of the paper's procedure, and its evaluations."""
    result = solve_dae(system, (0.0, 1.0), problem.q0, problem.v0, method=paper_irk(), rtol=TOL, atol=TOL)
    if not result.success or not result.stats.n_evaluations:
        raise RuntimeError(f"the linkage given by values: {result.message}")
    return result.q[:, -1], result.stats.n_evaluations


def values_alone(problem: Problem) -> dict[str, float]:
    """The linkage given by functions that return values: calls an evaluation, with Q_d given and by differences."""
    found: dict[str, float] = {}
    given, calls = problem.system, {"force": 0, "jacobian": 0}
    compiled, _ = _one_second(problem, given)

    def force(t: float, q: Array, v: Array) -> Array:
        calls["force"] += 1
        return given.force(t, q, v)

    def jacobian(t: float, q: Array) -> Array:
        calls["jacobian"] += 1
        return given.jacobian(t, q)

    functions = {"mass": given.mass, "force": force, "constraint": given.constraint, "jacobian": jacobian}
    for case, extra in (("given", {"gamma": given.gamma}), ("by differences", {})):
        system = ConstrainedSystem.from_python(n_q=given.n_q, n_c=given.n_c, **functions, **extra)  # type: ignore[arg-type]
        calls.update(dict.fromkeys(calls, 0))
        end, evaluations = _one_second(problem, system)
        found |= {f"calls of {name}, Q_d {case}": count / evaluations for name, count in calls.items()}
        found[f"difference, Q_d {case}"] = float(np.abs(end - compiled).max())
    return found
