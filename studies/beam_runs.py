"""Runs of the beam study: which solvers, what is measured, against which motion."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from references.beam_reduced import reduced_motion
from references.ida import solve_ida
from references.ida_c import solve_ida_c
from references.index1 import solve_index1
from studies.solvers import ERR_IN, OWN_EXPLICIT
from twoloop import ConstrainedSystem, Result, RungeKutta, Statistics, Status, paper_newmark, solve_dae
from twoloop.mechanisms import Problem, moderately_stiff_beam, very_flexible_beam
from twoloop.mechanisms.ancf_beam import midpoint_deflection, tip_height
from twoloop.plan import Method
from twoloop.tableaux import gauss, radau_iia, sun_radau_iib

Array = NDArray[np.float64]

SOFT, STIFF = "very flexible", "moderately stiff"
CASES: dict[str, Callable[[], Problem]] = {SOFT: very_flexible_beam, STIFF: moderately_stiff_beam}
T_END = 2.0  # s; the paper does not say how long its runs are
PER_SECOND = 10  # instants a second at which the tip's error is taken
DRAWN_PER_SECOND = 100  # of the motion in the figures; the instants above are among them
PAPER_TOL = 1e-5  # Atol = Rtol of the paper, in Sect. 4.1
BINS = 400  # of a curve of step sizes
TRUTH_TOL = 1e-8  # of DOP853, the reference; `truth_rows` says how far it agrees with others

FINER_TOL, CHECK_TOL = 1e-10, 1e-6  # of DOP853 and of Gauss12, that check it

PAPER, NEWMARK, QUARTER = "PaperIRK", "PaperNewmark (beta = 1/2)", "PaperNewmark, beta = 1/4"
NEWTON, NEWTON_4, NEWTON_5 = "RadauIIA5 (Newton)", "RadauIIA7, Newton", "RadauIIA9, Newton"
NEWTON_GAUSS, AUTO = "Gauss6, Newton", "SunRadau5 (auto)"
DIFFERENCES = "RadauIIA7, Newton, by differences"
SWEEPS, OWN_NEWMARK, BDF = "Gauss6 (sweeps)", "Newmark (sweeps)", "BDF (sweeps)"
IDA_C, IDA_C_LOOSE = "IDA from C", "IDA from C, order <= 2, positions tested"
IDA, IDA_LOOSE = "IDA, scikit-sundae", "IDA, scikit-sundae, order <= 2, positions tested"
EXPLICIT = "DOP853, projected"
LOOSE: dict[str, Any] = {"max_order": 2, "error_test": "positions"}  # what lets IDA step over fast vibrations

Run = Callable[[Problem, float, Array], Result]  # (problem, tolerance, instants)


def instants(t_end: float, per_second: int = PER_SECOND) -> Array:
    """Evenly spaced times from 0 to t_end."""
    return np.linspace(0.0, t_end, round(t_end * per_second) + 1)


def _two_loop(method: str | Method, problem: Problem, tol: float, times: Array) -> Result:
    span = (0.0, float(times[-1]))
    return solve_dae(problem.system, span, problem.q0, problem.v0, method, tol, tol, t_eval=times)


def with_less_known(problem: Problem, tangent: bool = False, bandwidth: bool = False) -> ConstrainedSystem:
    """The same system without the tangent of its force, or the bandwidth of its matrices, or both."""
    system = problem.system
    f = system.functions._asdict()
    f.pop("p"), f.pop("flags"), f.pop("force_by_v"), f.pop("reaction_by_q")
    if not tangent:
        f.pop("force_by_q")
    return ConstrainedSystem(
        n_q=system.n_q,
        n_c=system.n_c,
        **f,
        parameters=system.parameters,
        constant_mass=True,
        bandwidth=system.bandwidth if bandwidth else None,
        name=problem.name,
    )


def _by_differences(problem: Problem, tol: float, times: Array) -> Result:
    span = (0.0, float(times[-1]))
    system, method = with_less_known(problem), RungeKutta(radau_iia(4), "newton")
    return solve_dae(system, span, problem.q0, problem.v0, method, tol, tol, t_eval=times)


def _paper(problem: Problem, tol: float, times: Array) -> Result:
    """The paper's procedure; err_out shrinks with the tolerance and is 1e-9 at the paper's 1e-5."""
    method = RungeKutta(sun_radau_iib(3), "paper", "richardson-paper", ERR_IN, 1e-4 * tol)
    return _two_loop(method, problem, tol, times)


def _paper_newmark(beta: float, problem: Problem, err_out: float, times: Array) -> Result:
    return _two_loop(paper_newmark(ERR_IN, err_out, beta), problem, PAPER_TOL, times)


def _ida_c(options: dict[str, Any], problem: Problem, tol: float, times: Array) -> Result:
    span = (0.0, float(times[-1]))
    options = {"t_eval": times, **options}
    return solve_ida_c(problem.system, span, problem.q0, problem.v0, tol, tol, **options)


def _ida(options: dict[str, Any], problem: Problem, tol: float, times: Array) -> Result:
    span = (0.0, float(times[-1]))
    options = {"t_eval": times, **options}
    return solve_ida(problem.system, span, problem.q0, problem.v0, "stabilised", tol, tol, **options)


def _explicit(problem: Problem, tol: float, times: Array) -> Result:
    span = (0.0, float(times[-1]))
    start = problem.q0, problem.v0
    return solve_index1(problem.system, span, *start, "DOP853", tol, tol, stabilisation="projection", t_eval=times)


SOLVERS: dict[str, Run] = {
    PAPER: _paper,
    NEWMARK: partial(_paper_newmark, 0.5),
    QUARTER: partial(_paper_newmark, 0.25),
    NEWTON: partial(_two_loop, "RadauIIA5"),
    NEWTON_4: partial(_two_loop, RungeKutta(radau_iia(4), "newton")),
    NEWTON_5: partial(_two_loop, RungeKutta(radau_iia(5), "newton")),
    DIFFERENCES: _by_differences,
    NEWTON_GAUSS: partial(_two_loop, RungeKutta(gauss(3), "newton")),
    AUTO: partial(_two_loop, "SunRadau5"),
    SWEEPS: partial(_two_loop, "Gauss6"),
    OWN_NEWMARK: partial(_two_loop, "Newmark"),
    BDF: partial(_two_loop, "BDF"),
    OWN_EXPLICIT: partial(_two_loop, "DOP853"),
    IDA_C: partial(_ida_c, {}),
    IDA_C_LOOSE: partial(_ida_c, LOOSE),
    IDA: partial(_ida, {}),
    IDA_LOOSE: partial(_ida, LOOSE),
    EXPLICIT: _explicit,
}


@dataclass(frozen=True)
class BeamJob:
    """One run to make: a solver on a case of the paper at one tolerance (err_out for PaperNewmark)."""

    case: str
    solver: str
    tol: float
    t_end: float = T_END
    repeats: int = 1
    drawn: bool = False  # whether the motion goes into a figure

    @property
    def times(self) -> Array:
        """Instants at which the run stores, and lands if it is a two-loop procedure."""
        return instants(self.t_end, DRAWN_PER_SECOND if self.drawn else PER_SECOND)


@dataclass(frozen=True)
class BeamTruth:
    """The reference motion of a case at evenly spaced times."""

    t: Array
    tip: Array
    middle: Array
    energy: Array


def true_motion(problem: Problem, t_end: float) -> BeamTruth:
    """By SciPy's DOP853 on the equations without constraints, which shares the forces with the solvers judged.

    And with OWN_EXPLICIT, at looser tolerances, the tableau; `truth_rows` has another method for that.
    """
    t = instants(t_end, DRAWN_PER_SECOND)
    q, v = reduced_motion(problem, t, TRUTH_TOL)
    return BeamTruth(t, tip_height(q), midpoint_deflection(q), problem.energy(t, q, v))


def truth_rows(truths: dict[str, BeamTruth]) -> Iterable[dict[str, Any]]:
    """How far the reference agrees with itself at a finer tolerance and with another method, of this project."""
    for case, truth in truths.items():
        problem, t_end = CASES[case](), float(truth.t[-1])
        q, _ = reduced_motion(problem, truth.t, FINER_TOL)
        result = _two_loop(RungeKutta(gauss(6)), problem, CHECK_TOL, instants(t_end))
        for solver, tol, tip, t in (
            ("DOP853, reduced", FINER_TOL, tip_height(q), truth.t),
            ("Gauss12 (sweeps)", CHECK_TOL, tip_height(result.q), result.t),
        ):
            off = float(np.abs(tip - _at(truth, t, truth.tip)).max())
            yield {"group": "truth", "case": case, "solver": solver, "tol": tol, "t_end": t_end, "error_tip": off}


def _at(truth: BeamTruth, t: Array, values: Array) -> Array:
    """Values of the truth at times that are among its own."""
    return values[np.round(t * DRAWN_PER_SECOND).astype(int)]


def measure(job: BeamJob, result: Result, problem: Problem, truth: BeamTruth) -> dict[str, Any]:
    """The row of one run; its errors are NaN if it did not reach the end."""
    stats = result.stats
    rejected = [n for n in (stats.n_rejected_error, stats.n_rejected_convergence) if n is not None]
    row: dict[str, Any] = {
        "status": result.status.name,
        "message": result.message,
        "t_reached": float(result.t[-1]) if result.t.size else 0.0,
        "n_steps": stats.n_accepted,
        "n_rejected": sum(rejected) if rejected else None,
        "n_rejected_convergence": stats.n_rejected_convergence,
        "n_evaluations": stats.n_evaluations,
        "n_jacobians": stats.n_jacobians,
        "n_factorizations": stats.n_factorizations,
        "cpu_s": stats.cpu_time,
        "h_median": float(np.median(result.h)) if result.h.size else np.nan,
        "h_max": float(result.h.max()) if result.h.size else np.nan,
        "error_tip": np.nan,
        "error_middle": np.nan,
        "error_energy": np.nan,
    }
    if result.success and result.t.size == job.times.size:
        seen = np.isin(np.round(result.t * DRAWN_PER_SECOND) % (DRAWN_PER_SECOND // PER_SECOND), 0)
        t, q, v = result.t[seen], result.q[:, seen], result.v[:, seen]
        row["error_tip"] = float(np.abs(tip_height(q) - _at(truth, t, truth.tip)).max())
        row["error_middle"] = float(np.abs(midpoint_deflection(q) - _at(truth, t, truth.middle)).max())
        row["error_energy"] = float(np.abs(problem.energy(t, q, v) - _at(truth, t, truth.energy)).max())
    return row


def _attempt(job: BeamJob, problem: Problem) -> Result:
    try:
        return SOLVERS[job.solver](problem, job.tol, job.times)
    except RuntimeError as error:  # a foreign solver that is not there is a row too
        nothing, columns = np.empty(0), np.empty((problem.system.n_q, 0))
        lam, status = np.empty((problem.system.n_c, 0)), Status.SOLVER_FAILED
        return Result(nothing, columns, columns, columns, lam, nothing, status, str(error), Statistics())


def collect(
    jobs: Iterable[BeamJob], truths: dict[str, BeamTruth]
) -> tuple[list[dict[str, Any]], dict[str, dict[str, Array]]]:
    """Rows of all jobs, in rounds so that a slow minute of the machine falls on all alike, and the curves drawn.

    The CPU time of a row is the median of its repeats; all else repeats exactly.
    """
    jobs = list(jobs)
    problems = {case: make() for case, make in CASES.items()}
    seconds: list[list[float]] = [[] for _ in jobs]
    rows: list[dict[str, Any]] = [{} for _ in jobs]
    curves: dict[str, dict[str, Array]] = {}
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with Progress(*columns) as progress:
        task = progress.add_task("", total=sum(job.repeats for job in jobs))
        for k in range(max(job.repeats for job in jobs)):
            for n, job in enumerate(jobs):
                if k >= job.repeats:
                    continue
                progress.update(task, description=f"{job.case}, {job.solver} ({job.tol:g})"[:50].ljust(50))
                problem = problems[job.case]
                result = _attempt(job, problem)
                seconds[n].append(result.stats.cpu_time)
                rows[n] = measure(job, result, problem, truths[job.case])
                if job.drawn:
                    curves[f"{job.case}, {job.solver}"] = _curves(result)
                progress.advance(task)
    named = [
        {"group": "run", "case": job.case, "solver": job.solver, "tol": job.tol, "t_end": job.t_end}
        | row
        | {"cpu_s": float(np.median(each)), "repeats": len(each)}
        for job, row, each in zip(jobs, rows, seconds, strict=True)
    ]
    return named, curves


def _curves(result: Result) -> dict[str, Array]:
    return {
        "t": result.t,
        "tip": tip_height(result.q),
        "middle": midpoint_deflection(result.q),
        "steps": thinned(result.h),
    }


def thinned(h: Array) -> Array:
    """Steps to draw, (4, n): time, shortest, median and longest in each of up to `BINS` bins of as many steps each."""
    starts = np.concatenate([[0.0], np.cumsum(h)[:-1]])
    n_bins = min(BINS, h.size)
    parts = [np.sort(part) for part in np.array_split(h, n_bins)]
    times = [part[0] for part in np.array_split(starts, n_bins)]
    return np.array([times, *zip(*((part[0], part[part.size // 2], part[-1]) for part in parts), strict=True)])


def free_motion(problem: Problem, tol: float, t_end: float) -> dict[str, Array]:
    """Curves of a run with Newton's method that lands on no instant: the steps are those it chooses."""
    return _curves(solve_dae(problem.system, (0.0, t_end), problem.q0, problem.v0, "RadauIIA5", tol, tol))


def compile_all(solvers: Iterable[str]) -> None:
    """Load the compiled loops of these solvers once: no run that is timed shall do it."""
    problem = very_flexible_beam()
    for solver in solvers:
        if solver not in (IDA_C, IDA_C_LOOSE, IDA, IDA_LOOSE):  # their time is that of the integration alone
            SOLVERS[solver](problem, 1e-3, np.array([0.0, 1e-4]))


def for_error(rows: pd.DataFrame, case: str, solver: str) -> pd.DataFrame:
    """Runs of a solver on a case as `studies.runs.time_for` reads them: the tip's error is the error."""
    found = rows[(rows["group"] == "run") & (rows["case"] == case) & (rows["solver"] == solver)]
    return found.assign(error_q=found["error_tip"])
