"""One vocabulary for all studies: a job (problem, solver, settings) becomes a row (errors, counts, time, status)."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from references.four_bar_minimal import MinimalFourBar
from twoloop import Result, Statistics, Status
from twoloop.mechanisms import Problem

Array = NDArray[np.float64]

CHECKED = 4000  # stored instants, evenly chosen, at which errors and violations are taken
LOST = 0.25  # of the largest kinetic energy of the motion: a run with a greater energy error has lost the solution
ASTRAY = 0.1  # of the range of y3: a run that strays farther is out of phase
MEASURED = (
    "error_q",
    "error_v",
    "error_end",
    "energy",
    "y3_max",
    "violation_q",
    "violation_v",
    "violation_early",
    "violation_late",
)
Y3 = 7  # place of y3, the height of bar 3's centre


@dataclass(frozen=True)
class Job:
    """One run to make.

    Attributes
    ----------
    group : str
        Part of the study to which the row belongs.
    solver : str
        Line of a figure or a table.
    run : callable
        run(k) makes the k-th repeat and returns a Result.
    settings : dict
        What tells this job from the others; copied into the row.
    repeats : int
        How often it is run.
    """

    group: str
    solver: str
    problem: Problem
    run: Callable[[int], Result]
    settings: dict[str, Any] = field(default_factory=dict)
    repeats: int = 3


Measure = Callable[[Job, Result, "Truth"], dict[str, Any]]


class Truth:
    """Reference motion of a four-bar linkage, and what can be said of one period of it.

    Attributes
    ----------
    range_y3 : float
        Range of the height of bar 3's centre, m.
    kinetic : float
        Largest kinetic energy, J.
    in_line : dict
        How often two bars come into line in a period, by the angle that then fails as the independent coordinate.
    """

    def __init__(self, problem: Problem):
        self.minimal = MinimalFourBar.from_parameters(problem.parameters)
        q, v = self.minimal.states(np.linspace(0.0, self.minimal.period, 2001))
        self.range_y3 = float(np.ptp(q[Y3]))
        self.kinetic = float((problem.energy(0.0, q, v) - problem.energy(0.0, q, 0.0 * v)).max())
        angles = {"θ1": q[8] - q[5], "θ2": q[8] - q[2], "θ3": q[5] - q[2]}
        self.in_line = {name: int(np.count_nonzero(np.diff(np.sign(np.sin(a))))) for name, a in angles.items()}


def _median_row(job: Job, described: list[dict[str, Any]]) -> dict[str, Any]:
    """The row of a job: its median CPU time, and all else from the repeat of median error."""
    cpu = float(np.median([row["cpu_s"] for row in described]))
    described = sorted(described, key=lambda row: np.inf if np.isnan(row["error_q"]) else row["error_q"])
    row = described[len(described) // 2] | {"cpu_s": cpu, "repeats": len(described)}
    return {"group": job.group, "problem": job.problem.name, "solver": job.solver, **job.settings, **row}


def _describe(result: Result, problem: Problem, truth: Truth, t_end: float) -> dict[str, Any]:
    stats = result.stats
    row: dict[str, Any] = {
        "status": result.status.name,
        "message": result.message,
        "n_steps": stats.n_accepted,
        "n_rejected": _sum(stats.n_rejected_error, stats.n_rejected_convergence),
        "n_evaluations": stats.n_evaluations,
        "n_outer": stats.n_outer,
        "n_inner": stats.n_inner,
        "n_partitions": stats.n_partitions,
        "n_factorizations": stats.n_factorizations,
        "cpu_s": stats.cpu_time,
    }
    row |= dict.fromkeys(MEASURED, np.nan) | {"lost": True, "astray": True}
    if result.t.size == 0:
        return row
    chosen = np.unique(np.linspace(0, result.t.size - 1, CHECKED).astype(int))
    t, q, v = result.t[chosen], result.q[:, chosen], result.v[:, chosen]
    system = problem.system
    drift = problem.energy(result.t, result.q, result.v) - problem.energy(0.0, problem.q0, problem.v0)
    violations = np.array([np.abs(system.constraint(t[k], q[:, k])).max() for k in range(len(t))])
    row["energy"] = float(drift[np.abs(drift).argmax()])
    row["y3_max"] = float(result.q[Y3].max())
    row["violation_q"] = float(violations.max())
    row["violation_early"] = float(violations[t <= 0.1 * t[-1]].max())
    row["violation_late"] = float(violations[t >= 0.9 * t[-1]].max())
    row["violation_v"] = max(
        float(np.abs(system.velocity_constraint(t[k], q[:, k], v[:, k])).max()) for k in range(len(t))
    )
    # Exudyn adds up its steps, so its last time is t_end only to rounding
    if result.success and abs(result.t[-1] - t_end) < 1e-9 * t_end:
        q_true, v_true = truth.minimal.states(t)
        row["error_q"] = float(np.abs(q - q_true).max())
        row["error_v"] = float(np.abs(v - v_true).max())
        row["error_end"] = float(np.abs(q[:, -1] - q_true[:, -1]).max())
        row["lost"] = bool(abs(row["energy"]) > LOST * truth.kinetic)
        row["astray"] = bool(np.abs(q[Y3] - q_true[Y3]).max() > ASTRAY * truth.range_y3)
    return row


def _sum(*values: int | None) -> int | None:
    known = [value for value in values if value is not None]
    return sum(known) if known else None


def _run(job: Job, k: int) -> Result:
    try:
        return job.run(k)
    except RuntimeError as error:  # a foreign solver that is not there is a row too
        nothing, columns = np.empty(0), np.empty((job.problem.system.n_q, 0))
        status, lam = Status.SOLVER_FAILED, np.empty((job.problem.system.n_c, 0))
        return Result(nothing, columns, columns, columns, lam, nothing, status, str(error), Statistics())


def collect(
    jobs: Iterable[Job], truths: dict[str, Truth], t_end: float, measure: Measure | None = None
) -> pd.DataFrame:
    """Run all jobs, round by round so that a slow minute of the machine falls on all alike, under a progress bar.

    `measure(job, result, truth)` adds columns of a study's own to the row; an entry need not be a number, and stays
    with the repeat that becomes the row.
    """
    jobs = list(jobs)
    described: list[list[dict[str, Any]]] = [[] for _ in jobs]
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with Progress(*columns) as progress:
        task = progress.add_task("", total=sum(job.repeats for job in jobs))
        for k in range(max(job.repeats for job in jobs)):
            for job, rows in zip(jobs, described, strict=True):
                if k >= job.repeats:
                    continue
                settings = ", ".join(f"{key}={value:g}" for key, value in job.settings.items())
                progress.update(task, description=f"{job.solver} ({settings})"[:50].ljust(50))
                result, truth = _run(job, k), truths[job.problem.name]
                more = {} if measure is None else measure(job, result, truth)
                rows.append(_describe(result, job.problem, truth, t_end) | more)
                progress.advance(task)
        progress.update(task, description="done".ljust(50))
    return pd.DataFrame([_median_row(job, rows) for job, rows in zip(jobs, described, strict=True)])


def time_for(rows: pd.DataFrame, target: float, what: str = "cpu_s") -> float:
    """CPU time (or another cost) for an error over the run of at most `target`; NaN where no run is that good.

    Between the two runs on either side of the target, on the log-log line through them: solvers whose settings lie
    far apart are not made to look dear by it.
    """
    runs = rows[rows["error_q"].notna()].sort_values("error_q")
    errors, times = runs["error_q"].to_numpy(), runs[what].to_numpy()
    n_good = int((errors <= target).sum())
    if n_good == 0:
        return float("nan")
    best = float(times[:n_good].min())
    if n_good < len(errors):
        x = np.log(errors[n_good - 1 : n_good + 1])
        share = (np.log(target) - x[0]) / (x[1] - x[0])
        between = np.exp((1.0 - share) * np.log(times[n_good - 1]) + share * np.log(times[n_good]))
        best = min(best, float(between))
    return best
