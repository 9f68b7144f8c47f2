"""One vocabulary for all studies: a job (problem, solver, settings) becomes a row (errors, counts, time, status)."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from references.four_bar_minimal import MinimalFourBar
from twoloop import Result
from twoloop.mechanisms import Problem

Array = NDArray[np.float64]

CHECKED = 4000  # stored instants, evenly chosen, at which violations and the deviation of y3 are taken
LOST = 0.25  # of the largest kinetic energy of the motion: a run with a greater energy error has lost the solution
ASTRAY = 0.1  # of the range of y3: a run that strays farther is out of phase
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


class Truth:
    """Reference motion of a four-bar linkage, and what can be said of one period of it.

    Attributes
    ----------
    range_y3 : float
        Range of the height of bar 3's centre, m.
    kinetic : float
        Largest kinetic energy, J.
    n_collinear : int
        How often bars 1 and 2 come into line in a period.
    """

    def __init__(self, problem: Problem):
        self.minimal = MinimalFourBar.from_parameters(problem.parameters)
        q, v = self.minimal.states(np.linspace(0.0, self.minimal.period, 2001))
        self.range_y3 = float(np.ptp(q[Y3]))
        self.kinetic = float((problem.energy(0.0, q, v) - problem.energy(0.0, q, 0.0 * v)).max())
        self.n_collinear = int(np.count_nonzero(np.diff(np.sign(np.sin(q[5] - q[2])))))


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
    nothing = dict.fromkeys(("error_q", "error_v", "energy", "violation_q", "violation_v", "deviation_y3"), np.nan)
    if result.t.size == 0:
        return {**row, **nothing, "lost": True, "astray": True}
    chosen = np.unique(np.linspace(0, result.t.size - 1, CHECKED).astype(int))
    t, q, v = result.t[chosen], result.q[:, chosen], result.v[:, chosen]
    q_true, _ = truth.minimal.states(t)
    system = problem.system
    energies = problem.energy(result.t, result.q, result.v)
    columns = range(len(chosen))
    row |= nothing
    row["energy"] = float(np.abs(energies - problem.energy(0.0, problem.q0, problem.v0)).max())
    row["violation_q"] = max(float(np.abs(system.constraint(t[k], q[:, k])).max()) for k in columns)
    row["violation_v"] = max(float(np.abs(system.velocity_constraint(t[k], q[:, k], v[:, k])).max()) for k in columns)
    row["deviation_y3"] = float(np.abs(q[Y3] - q_true[Y3]).max())
    # Exudyn adds up its steps, so its last time is t_end only to rounding
    reached = result.success and abs(result.t[-1] - t_end) < 1e-9 * t_end
    if reached:
        q_end, v_end = truth.minimal.states(np.array([t_end]))
        row["error_q"] = float(np.abs(result.q[:, -1] - q_end[:, 0]).max())
        row["error_v"] = float(np.abs(result.v[:, -1] - v_end[:, 0]).max())
    row["lost"] = bool(not reached or row["energy"] > LOST * truth.kinetic)
    row["astray"] = bool(not reached or row["deviation_y3"] > ASTRAY * truth.range_y3)
    return row


def _sum(*values: int | None) -> int | None:
    known = [value for value in values if value is not None]
    return sum(known) if known else None


def collect(jobs: Iterable[Job], truths: dict[str, Truth], t_end: float) -> pd.DataFrame:
    """Run all jobs, round by round so that a slow minute of the machine falls on all alike, under a progress bar."""
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
                rows.append(_describe(job.run(k), job.problem, truths[job.problem.name], t_end))
                progress.advance(task)
        progress.update(task, description="done".ljust(50))
    return pd.DataFrame([_median_row(job, rows) for job, rows in zip(jobs, described, strict=True)])


def cheapest(rows: pd.DataFrame, target: float) -> float:
    """Least CPU time of the rows whose position error at the end is at most `target`; NaN if none is."""
    good = rows[rows["error_q"] <= target]
    return float(good["cpu_s"].min()) if len(good) else float("nan")
