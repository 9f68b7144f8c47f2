"""Energy over long times: which methods let it drift, with fixed and with variable steps, and why."""

import math
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from functools import cache
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from studies.energy_drift import (
    BDF_LOOP,
    GAUSS,
    GAUSS_12,
    LOBATTO,
    MIDPOINT,
    MOMENTA_LASTING,
    MOMENTA_SYMMETRIC,
    NEWMARK_HALF,
    NEWMARK_QUARTER,
    ONE,
    PAPER_IRK,
    PAPER_NEWMARK_HALF,
    PAPER_NEWMARK_QUARTER,
    RADAU,
    SUN,
    SWITCHING,
    VELOCITIES_LASTING,
    VELOCITIES_SYMMETRIC,
    Partition,
    Variables,
    Variant,
    drift,
    verdict,
    windows,
)
from studies.energy_report import figures, headline, report
from studies.index import put_in_index
from studies.kept_rows import KeptRows, Row
from studies.report import Call, load_rows, parse, save_rows, stamp
from studies.runs import Truth
from twoloop import BDF, Newmark, Result, RungeKutta, paper_irk, paper_newmark, solve_dae
from twoloop.mechanisms import Problem, four_bar
from twoloop.plan import Method
from twoloop.tableaux import gauss, lobatto_iiie, radau_iia, sun_radau_iib

Array = NDArray[np.float64]

GEOMETRIES: dict[str, dict[str, Any]] = {
    ONE: {"lengths": (1.0, 1.2, 0.5), "ground": 1.0, "theta3": math.pi, "branch": 1},
    SWITCHING: {},
}
ERR_OUT = 1e-7
METHODS: dict[str, Method] = {
    SUN: RungeKutta(sun_radau_iib(3)),
    GAUSS: RungeKutta(gauss(3)),
    LOBATTO: RungeKutta(lobatto_iiie(4)),
    RADAU: RungeKutta(radau_iia(3)),
    GAUSS_12: RungeKutta(gauss(6)),
    MIDPOINT: RungeKutta(gauss(1)),
    NEWMARK_QUARTER: Newmark(0.25),
    NEWMARK_HALF: Newmark(0.5),
    PAPER_IRK: paper_irk(),
    BDF_LOOP: BDF(),
    PAPER_NEWMARK_QUARTER: paper_newmark(1e-9, ERR_OUT, beta=0.25),
    PAPER_NEWMARK_HALF: paper_newmark(1e-9, ERR_OUT),
}
SHORT, LONG = 100.0, 10_000.0  # s
QUICK = (75.0, 50.0)  # s, long and short of the quick version
H, H_SMALL = 0.02, 0.01  # s; the smaller one for the methods of order 2, and for BDF, which does not converge with H
BASIC, EVEN = VELOCITIES_LASTING, VELOCITIES_SYMMETRIC
FIXED: dict[str, dict[str, list[Variant]]] = {  # geometry: method: (variables, partition)
    ONE: {
        SUN: [BASIC, MOMENTA_LASTING, MOMENTA_SYMMETRIC],
        GAUSS: [BASIC, MOMENTA_LASTING, EVEN],
        LOBATTO: [BASIC],
        RADAU: [BASIC],
        GAUSS_12: [BASIC],
        MIDPOINT: [BASIC, MOMENTA_LASTING],
        NEWMARK_QUARTER: [BASIC],
        NEWMARK_HALF: [BASIC],
        BDF_LOOP: [BASIC],
    },
    SWITCHING: {
        SUN: [BASIC, EVEN, MOMENTA_LASTING, MOMENTA_SYMMETRIC],
        GAUSS: [BASIC, EVEN, MOMENTA_LASTING, MOMENTA_SYMMETRIC],
        LOBATTO: [BASIC, EVEN, MOMENTA_SYMMETRIC],
        RADAU: [BASIC, EVEN],
        GAUSS_12: [EVEN],
        MIDPOINT: [BASIC, EVEN, MOMENTA_SYMMETRIC],
        NEWMARK_QUARTER: [BASIC],
        NEWMARK_HALF: [BASIC],
        BDF_LOOP: [BASIC],
    },
}
TOLERANCES = {  # Rtol = Atol; for PaperNewmark it is err_out
    PAPER_IRK: 1e-5,
    PAPER_NEWMARK_QUARTER: ERR_OUT,
    PAPER_NEWMARK_HALF: ERR_OUT,
    SUN: 1e-5,
    GAUSS: 1e-5,
    LOBATTO: 1e-5,
    RADAU: 1e-5,
    BDF_LOOP: 1e-5,
}
LADDER = (0.015, 0.01)  # s, smaller steps that tell the order of a drift
LADDERED: list[tuple[str, str, Variant]] = [
    (ONE, SUN, BASIC),
    (ONE, RADAU, BASIC),
    (SWITCHING, SUN, EVEN),
    (SWITCHING, SUN, MOMENTA_SYMMETRIC),
    (SWITCHING, SUN, BASIC),
    (SWITCHING, GAUSS, BASIC),
]
CONTROLLED: dict[str, dict[str, list[Variant]]] = {  # what is run with step-size control beside the basic variant
    ONE: {SUN: [MOMENTA_LASTING]},
    SWITCHING: {GAUSS: [EVEN]},
}
MANY_STEPS = (PAPER_NEWMARK_QUARTER, PAPER_NEWMARK_HALF, BDF_LOOP)  # under step-size control, too many to keep
GOLDEN = (3.0 - math.sqrt(5.0)) / 2.0  # of a period: far from every fraction of few parts, so no phase is left out


@dataclass(frozen=True)
class EnergyJob:
    """One run: with fixed steps h (s), or with step-size control by tol; the other is None."""

    geometry: str
    t_end: float
    solver: str
    h: float | None
    tol: float | None
    variables: Variables
    partition: Partition


def jobs(quick: bool) -> Iterator[EnergyJob]:
    """All runs, the long ones first so that no core waits at the end."""
    long, short = QUICK if quick else (LONG, SHORT)
    for t_end in (long, short):
        for geometry in GEOMETRIES:
            for solver, tol in TOLERANCES.items():
                for variant in (BASIC, *CONTROLLED[geometry].get(solver, [])):
                    yield EnergyJob(geometry, t_end, solver, None, tol, *variant)
            for solver, variants in FIXED[geometry].items():
                h = H_SMALL if solver in (MIDPOINT, NEWMARK_QUARTER, NEWMARK_HALF, BDF_LOOP) else H
                for variant in variants:
                    yield EnergyJob(geometry, t_end, solver, h, None, *variant)
    for geometry, solver, variant in LADDERED:
        for h in LADDER:
            yield EnergyJob(geometry, short, solver, h, None, *variant)


@cache
def truth_of(geometry: str) -> tuple[Problem, Truth]:
    """The linkage and its true motion, once in each process."""
    problem = four_bar(**GEOMETRIES[geometry])
    return problem, Truth(problem)


def method_of(job: EnergyJob) -> Method:
    """The method of a run."""
    method = METHODS[job.solver]
    if not isinstance(method, RungeKutta) or method.outer == "paper":
        return method
    return replace(method, variables=job.variables, partition=job.partition)


def instants(job: EnergyJob, period: float) -> Array | None:
    """Where the energy is taken: None, at every step, or where these are too many at times spread over the phases.

    Landing on such times changes no fixed step, and a small part of many short ones; other controlled steps are so
    long that landing would make another run of it.
    """
    if job.t_end <= SHORT or (job.tol is not None and job.solver not in MANY_STEPS):
        return None
    interval = 0.25 * GOLDEN * period
    if job.h is not None:
        interval = job.h * round(interval / job.h)
    n_intervals = int(job.t_end / interval * (1.0 - 1e-12))
    return interval * np.arange(n_intervals + 1, dtype=np.float64)


def measure(job: EnergyJob) -> Row:
    """Make one run, and say what its energy does."""
    problem, truth = truth_of(job.geometry)
    period = truth.minimal.period
    settings = {"step_size": job.h} if job.tol is None else {"rtol": job.tol, "atol": job.tol}
    result = solve_dae(
        problem.system,
        (0.0, job.t_end),
        problem.q0,
        problem.v0,
        method=method_of(job),
        t_eval=instants(job, period),
        **settings,  # type: ignore[arg-type]
    )
    start = problem.energy(0.0, problem.q0, problem.v0)
    error = problem.energy(result.t, result.q, result.v) - start
    row: Row = asdict(job) | {"problem": problem.name, "period": period, "kinetic": truth.kinetic}
    row |= _counts(result) | {"t_reached": float(result.t[-1]), "largest": float(np.abs(error).max())}
    row["largest_exact"] = float(np.abs(problem.energy(0.0, *truth.minimal.states(result.t)) - start).max())
    row |= dict.fromkeys(("slope", "slope_error", "swing", "n_windows", "error_q"))
    seen = windows(result.t, error, period, job.t_end)
    row["windows"] = {name: values.tolist() for name, values in seen.items()}
    if result.success:
        row["slope"], row["slope_error"] = drift(seen["t"], seen["mean"])
        row |= {"swing": float(np.median(seen["range"])), "n_windows": seen["t"].size}
        if job.t_end <= SHORT:
            row["error_q"] = float(np.abs(result.q - truth.minimal.states(result.t)[0]).max())
    return row


def _counts(result: Result) -> Row:
    stats = result.stats
    return {
        "status": result.status.name,
        "message": result.message,
        "n_steps": stats.n_accepted,
        "n_evaluations": stats.n_evaluations,
        "n_partitions": stats.n_partitions,
        "h_median": float(np.median(result.h)),
    }


def run(call: Call) -> tuple[pd.DataFrame, pd.DataFrame, str]:
    """Make all rows and the series of windows, going on where an interrupted run of the same sources was."""
    first, _ = truth_of(SWITCHING)
    momenta = RungeKutta(sun_radau_iib(3), variables="momenta")
    for method in (momenta, *(METHODS[name] for name in (SUN, PAPER_IRK, NEWMARK_QUARTER, BDF_LOOP))):
        solve_dae(first.system, (0.0, 0.01), first.q0, first.v0, method)  # compile once, not in every process
    line = stamp(call.command)  # before the runs: sources edited meanwhile are not theirs
    keyed = {repr(job): job for job in jobs(call.quick)}
    with KeptRows(call.out / "energy.partial.jsonl", {"quick": call.quick}) as kept:
        rows = kept.collect(keyed, measure)
        seen = [pd.DataFrame(row.pop("windows")).drop(columns="range").assign(run=k) for k, row in enumerate(rows)]
        table, series = pd.DataFrame(rows), pd.concat(seen)
        table["verdict"] = [verdict(row) for _, row in table.iterrows()]
        save_rows(call.out / "energy.csv", table, line)
        save_rows(call.out / "energy_windows.csv", _rounded(series), line)
    return table, series, line


def _rounded(series: pd.DataFrame) -> pd.DataFrame:
    """Five digits, enough for a figure."""
    return series.map(lambda value: float(f"{value:.5g}") if isinstance(value, float) else value)


def main(words: list[str] | None = None, command: str | None = None) -> None:
    """Run the study and write its report."""
    call = parse("energy", __doc__, words, command)
    if call.redraw:
        rows, line = load_rows(call.out / "energy.csv")
        series, _ = load_rows(call.out / "energy_windows.csv")
    else:
        rows, series, line = run(call)
    report(rows, line, call)
    figures(rows, series, call)
    picture = "![Energy over the long run](energy_long.png)"
    text = f"[Report](energy.md), [rows](energy.csv)\n\n{picture}\n\n{headline(rows)}"
    put_in_index(call, "energy", __doc__, text, line)
    print(f"wrote energy.md, energy.csv, energy_windows.csv and figures to {call.out}")


if __name__ == "__main__":
    main()
