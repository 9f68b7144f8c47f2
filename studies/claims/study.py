"""Which of the paper's claims hold: a verdict and a number for each, from rows of other studies and small runs here."""

import math
import warnings
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd

from references.paper.four_bar_minimal import MinimalFourBar
from references.paper.paper_step import Step, independents, true_states
from studies.bench import cli, end_states
from studies.bench.cli import StudyError
from studies.bench.collector import Case
from studies.bench.render import render
from studies.bench.solvers import CATALOGUE, IMPLICIT, IRK_LINE, NEWMARK, OWN_BDF
from studies.bench.store import Array, Output
from studies.bench.study import run_study, write_index
from studies.claims import judges
from studies.claims.judges import STUDIES, UNTESTABLE, Claim, Judgement, Rows, Verdict, load, read
from studies.reproduction.motion import PASSES
from studies.reproduction.study import PARTS
from studies.validation import study as validation
from twoloop import ConstrainedSystem, ConstraintWarning, Result, RungeKutta, paper_irk, solve_dae
from twoloop.mechanisms import Problem, four_bar, knife_edge, moderately_stiff_beam, rolling_disc, very_flexible_beam
from twoloop.methods.tableaux import sun_radau_iib

TOL = 1e-5  # Atol = Rtol of the paper
LOOPS = 1e-9  # err_in = err_out of the paper
SUN = sun_radau_iib(3)
NEAR = 1e-3  # of the state known: 100 times the tolerance
TIME_LIMIT = 60.0  # s of a published mechanism
STEP = 0.06  # s, about the median step of the paper's procedure
CLOSE = 1e-4  # m or rad, error at which the outer loops are compared
BEAM_END, POWERS = 0.2, range(3, 14)  # s of a beam; 2^k fixed steps
ORDERS = dict(zip(IMPLICIT, (5, 6, 12, 5, 9, 13, 2, 4, 2, 5), strict=True))
STEPS = (4, 5, 6, 8, 10, 12, 16, 20, 24, 32, 48, 64, 96, 128)  # a second
FALLING = (1e-9, 1e-2)  # errors between which an order is seen
ENOUGH = 0.9  # of the order
PROCEDURES = {  # solvers of the catalogue, by the unknowns and the method of the outer loop
    "Lobatto16": "auto, compiled",  # on q and v, as those with the next two; its eight stages run side by side
    "Gauss12": "Gauss12",
    "the paper's": IRK_LINE,
    "BDF": OWN_BDF,  # on accelerations, as Newmark's
    "Newmark's": NEWMARK,
}
ERROR = 1e-6  # m or rad, of positions after 10 s, at which the procedures are compared
PAIRS = 200  # of successive steps at which the choice of coordinates is compared
GEOMETRIES = (  # lengths of the bars and of the ground, m: the assumed one, that of Table 3 beside it, and others
    *((1.0, 2.0, 1.5, 3.0), (0.8, 1.2, 1.0, 2.0), (1.0, 1.2, 0.5, 1.0)),
    *((2.0, 2.0, 1.0, 1.5), (2.0, 2.5, 1.0, 2.0), (1.0, 1.0, 0.5, 0.75)),
)


def make(quick: bool) -> dict[str, float]:
    linkage = four_bar()
    found = predictor(linkage, true_states(linkage, 8 if quick else 40)) | values_alone(linkage)
    found |= generality(validation.MAKE[:: 7 if quick else 1]) | nonholonomic() | ({} if quick else procedures(linkage))
    return found | outer_loops() | orders() | passing(GEOMETRIES[: 1 if quick else None])


def procedures(problem: Problem) -> dict[str, float]:
    """Count the fewest iterations of the outer loop by which each two-loop procedure that reaches ERROR does so."""
    case, counts = Case(problem.name, problem, 10.0, time_limit=TIME_LIMIT), {}
    true_end = MinimalFourBar.from_parameters(problem.parameters).states(case.instants[-1:])[0][:, 0]
    for name, solver in ((name, CATALOGUE[each]) for name, each in PROCEDURES.items()):
        results = (solver.run(case, value, 0) for value in solver.grid(case))
        accurate = [each for each in results if each.success and np.abs(each.q[:, -1] - true_end).max() <= ERROR]
        if accurate:
            counts[f"iterations of {name}"] = float(min(each.stats.n_outer or 0 for each in accurate))
    return counts


def iterations_of_procedures(found: Mapping[str, float]) -> str:
    """Return the counts of `procedures` in words; an empty string after a quick run."""
    counts = {name: found[key] for name in PROCEDURES if (key := f"iterations of {name}") in found}
    return ", ".join(f"{count:,.0f} ({name})" for name, count in counts.items())


def predictor(problem: Problem, states: list[tuple[float, Array, Array]]) -> dict[str, float]:
    """Count the iterations of a step from the Euler prediction, and from the stages of the step before."""
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
    """Run a second of the linkage, given by functions that return values; count calls of C_q an evaluation."""
    given, calls = problem.system, []

    def jacobian(t: float, q: Array) -> Array:
        calls.append(t)
        return given.jacobian(t, q)

    def run(system: ConstrainedSystem) -> tuple[Array, float]:
        calls.clear()
        result = solve_dae(system, (0.0, 1.0), problem.q0, problem.v0, method=paper_irk(), rtol=TOL, atol=TOL)
        if not result.success or not result.stats.n_evaluations:
            raise RuntimeError(f"the linkage given by values: {result.message}")
        return result.q[:, -1], len(calls) / result.stats.n_evaluations

    functions: dict[str, Any] = {"mass": given.mass, "force": given.force, "constraint": given.constraint}
    functions |= {"n_q": given.n_q, "n_c": given.n_c, "jacobian": jacobian}
    compiled, _ = run(given)
    analytic, with_gamma = run(ConstrainedSystem.from_python(**functions, gamma=given.gamma))
    differenced, without = run(ConstrainedSystem.from_python(**functions))
    difference = float(np.abs(np.array([analytic, differenced]) - compiled).max())
    return {"difference": difference, "calls given": with_gamma, "calls differenced": without}


def ended(problem: Problem) -> tuple[Result, float]:
    """Run the paper's procedure to the end of a problem's reference; return result and error in q at the end."""
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
    """Count the mechanisms that the paper's procedure gets right, and those where it keeps its coordinates."""
    right, same = [], [repeated_choices(linkage := four_bar(), ended(linkage)[0])]
    for problem in (one() for one in make):
        result, error = ended(problem)
        right.append(result.success and error < NEAR)
        if problem.system.n_c and not problem.system.n_a and "redundant" not in problem.tags:
            same.append(repeated_choices(problem, result))
    mostly = sum(share > 0.5 for share in same)
    partitions: dict[str, float] = {"partitions seen": len(same), "partitions mostly kept": mostly}
    return partitions | {"mechanisms": len(right), "mechanisms right": sum(right)}


def repeated_choices(problem: Problem, result: Result) -> float:
    """Return the share of steps at which full pivoting picks the same independent coordinates as a step before."""
    kept = []
    for k in np.unique(np.linspace(0, result.t.size - 2, PAIRS).astype(int)):
        matrices = (problem.system.jacobian(float(result.t[n]), result.q[:, n]) for n in (k, k + 1))
        before, after = map(independents, matrices)
        kept.append(before == after)
    return float(np.mean(kept))


def without_tangent(problem: Problem) -> ConstrainedSystem:
    """Return the same system without the tangent of its force and the bandwidth of its matrices."""
    system = problem.system
    tangents = {"force_by_q", "force_by_v", "reaction_by_q"}
    functions: dict[str, Any] = {kind: f for kind, f in system.given.items() if kind not in tangents}
    functions |= {"n_q": system.n_q, "n_c": system.n_c, "parameters": system.parameters}
    return ConstrainedSystem(**functions, constant_mass=True, name=problem.name)


def outer_loops() -> dict[str, float]:
    """Compare evaluations of Newton's method, Jacobian by differences, and of the fixed point, at an error `CLOSE`."""
    found = {}
    known = (("linkage", four_bar(), 1.0), ("very flexible", very_flexible_beam(), BEAM_END))
    for name, problem, t_end in (*known, ("moderately stiff", moderately_stiff_beam(), BEAM_END)):
        start, least = (problem.q0, problem.v0), []
        truth = solve_dae(problem.system, (0.0, t_end), *start, method="DOP853", rtol=LOOPS, atol=LOOPS).q[:, -1]
        for outer in ("fixed-point", "newton"):
            method, system = RungeKutta(SUN, outer, inner_tol=LOOPS, outer_tol=LOOPS), without_tangent(problem)
            made = (solve_dae(system, (0.0, t_end), *start, method=method, step_size=t_end / 2**k) for k in POWERS)
            good = (run for run in made if run.success and np.abs(run.q[:, -1] - truth).max() < CLOSE)
            if (best := next(good, None)) is None:
                raise RuntimeError(f"{outer} comes nowhere within {CLOSE:g} on the {name}")
            least.append(best.stats.n_evaluations or 0)
        found[f"Newton over fixed point, {name}"] = least[1] / least[0]
    return found


def orders() -> dict[str, float]:
    """Count the implicit methods that reach nine tenths of their order, in fixed steps with a lasting partition."""
    problem = four_bar((1.0, 1.2, 0.5), 1.0, math.pi, 1)
    truth, reached = MinimalFourBar.from_parameters(problem.parameters), 0
    for method, order in ORDERS.items():
        seen: list[tuple[float, float]] = []
        for n in STEPS:
            result = solve_dae(problem.system, (0.0, 1.0), problem.q0, problem.v0, method=method, step_size=1.0 / n)
            q, v = truth.states(result.t)
            error = float(np.abs(np.concatenate([result.q - q, result.v - v])).max())
            if result.success and FALLING[0] < error < FALLING[1]:
                seen.append((math.log(n), math.log(error)))
        points = np.array(seen).T
        reached += len(seen) > 1 and -float(np.polyfit(points[0], points[1], 1)[0]) > ENOUGH * order
    return {"methods": len(ORDERS), "methods of their order": reached}


def passing(geometries: Sequence[tuple[float, float, float, float]]) -> dict[str, float]:
    """Count linkages, released with bar 3 horizontal, that pass y3 = 0; the first is the one assumed for the paper."""
    tops = []
    for *lengths, ground in geometries:
        for theta3, branch in ((0.0, -1), (0.0, 1), (math.pi, -1), (math.pi, 1)):
            try:
                problem = four_bar((lengths[0], lengths[1], lengths[2]), ground, theta3, branch)
            except ValueError:  # it cannot be assembled
                continue
            truth = MinimalFourBar.from_parameters(problem.parameters)
            tops.append(float(truth.states(np.linspace(0.0, truth.period, 1000))[0][7].max()))
    n_passing = sum(top > PASSES for top in tops)
    return {"linkages": len(tops), "linkages passing": n_passing, "highest y3, assumed": tops[0]}


def nonholonomic() -> dict[str, float]:
    """Find the largest error and the largest violation of velocities on two non-holonomic systems."""
    errors, residuals = [], []
    for problem in (knife_edge(), rolling_disc()):
        result, error = ended(problem)
        errors.append(error)
        residuals.append(end_states.violations(problem.system, result)["violation_v"])
    return {"non-holonomic error": max(errors), "non-holonomic violation": max(residuals)}


COLUMNS = ("section", "statement", "criterion", "fixed", "judge", "stand_in", "inputs", "circular", "assumed")  # of CSV
Judged = Mapping[str, tuple[Claim, Judgement]]
JUDGES: dict[str, Callable[..., Judgement]] = vars(judges)  # by the names that claims.toml has


def judged(rows: Rows) -> Judged:
    """Judge every claim."""
    return {claim.key: (claim, claim.judgement(JUDGES[claim.judge], rows)) for claim in load()}


def findings_of(pairs: Judged) -> dict[str, Any]:
    """Count the verdicts, and tell the answer, verdict and numbers of each claim."""
    verdicts = [found.verdict for _, found in pairs.values()]
    counts = {verdict: verdicts.count(verdict) for verdict in Verdict}
    untestable, n = sum(counts[verdict] for verdict in UNTESTABLE), len(pairs)
    answer = f"Of {n} claims, {counts[Verdict.HOLDS]} hold, {counts[Verdict.PART]} hold in part, "
    answer += f"{counts[Verdict.FAILS]} do not hold, and {untestable} cannot be tested with what the paper's text gives"
    answer += f"; {counts[Verdict.NOT_RUN]} were not judged" * bool(counts[Verdict.NOT_RUN])
    found: dict[str, Any] = {"answer": f"{answer}.", "n": n, "counts": counts, "untestable": untestable}
    found["after"] = sum(claim.fixed == "after" for claim, _ in pairs.values())
    return found | {"claims": {key: {"verdict": each.verdict, **each.values} for key, (_, each) in pairs.items()}}


def report(output: Output, rows: Rows, line: str) -> dict[str, Any]:
    """Write findings, rows and report; return the findings."""
    pairs = judged(rows)
    lines = [
        {"claim": key, "verdict": found.verdict.value, "number": claim.text(found)}
        | {name: getattr(claim, name) for name in COLUMNS}
        for key, (claim, found) in pairs.items()
    ]
    findings = findings_of(pairs) | {"experiments": dict(rows.experiments)}
    findings["procedures"] = iterations_of_procedures(rows.experiments)
    output.save_findings(findings)
    output.save_rows(pd.DataFrame(lines), line)
    output.write("claims.md", render("claims", findings, {}, lines=lines, stamp=line, quick=output.call.quick))
    return findings


def _work(words: Sequence[str] | None) -> None:
    call = cli.parse("claims", __doc__, words)
    options = ["--quick"] * call.quick + ["--out", str(call.out)]
    missing = [name for name in STUDIES if not (call.redraw or (call.out / f"{name}.csv").exists())]
    if "table3_full" in missing:
        run_study("table3", ["--full", *options])
    if "energy" in missing:
        run_study("energy", options)
    if parts := [name for name in missing if name in PARTS]:
        run_study("reproduction", [*parts, *options])
    with Output(call) as output:
        if call.redraw:
            _, line = output.load_rows()
            made = output.load_findings().get("experiments")
            if not isinstance(made, dict):
                raise StudyError(f"{output.path / 'claims.json'} has no experiments; run python -m studies.claims")
        else:
            made, line = make(call.quick), cli.stamp(call.command)
        findings = report(output, Rows(read(output.path), made), line)
        write_index(output)
    print(f"{findings['answer']} Wrote claims.md, .csv and .json to {output.path}")


def main(words: Sequence[str] | None = None) -> None:
    cli.main(_work, words)
