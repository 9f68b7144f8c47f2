"""Where a rival is ahead: steps and time per step of both, and what stands in the way.

A part of `studies.work_precision`. The operations of an evaluation as straight-line code are counted for every
mechanism; what runs would take of which nothing is left but these follows from the time of an operation on the four-bar
(`studies.work_precision.limit`).
"""

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import pandas as pd

from references.equations.expressions import NotSymbolic
from references.equations.straight_line import program_of
from studies.bench import tables
from studies.bench.render import number, power
from studies.bench.solvers import DEFAULT, TAYLOR
from studies.bench.store import KeptRows
from studies.work_precision import rivals

GROUP = "operations"
MOST = 3  # mechanisms in the table: those of the least ratio


def collect(kept: KeptRows, quick: bool) -> pd.DataFrame:
    """One row a mechanism: the operations of its accelerations; none where it has no expressions."""
    keys = []
    for name, problem in rivals.problems(quick).items():
        key = f"{GROUP} | {name}"
        keys.append(key)
        if key not in kept:
            try:
                count = program_of(problem.system, 0.0, problem.q0, problem.v0)[0].operations or None
            except NotSymbolic:
                count = None
            kept.add(key, {"group": GROUP, "case": name, "solver": "", "repeat": 0, "operations": count})
    return pd.DataFrame([kept[key] for key in keys])


def findings_of(
    found: dict[str, Any], rows: pd.DataFrame, operations: Mapping[str, float], operation_ns: float
) -> list[dict[str, Any]]:
    """The worst decade of each of the worst mechanisms.

    Parameters
    ----------
    found : dict
        Of `rivals.findings_of`.
    rows : DataFrame
        The medians that it was made of.
    operations : mapping
        Operations of an evaluation by mechanism.
    operation_ns : float
        Time of one in the accelerations that `compiled=True` makes.
    """
    worst = []
    for each in found["mechanisms"]:
        compared = [at | {"case": each["case"]} for at in each["at"] if at["ratio"] is not None]
        worst += sorted(compared, key=lambda at: float(at["ratio"]))[:1]
    chosen = sorted((at for at in worst if at["verdict"] == "behind"), key=lambda at: float(at["ratio"]))[:MOST]
    return [_profile(at, rows[rows["case"] == at["case"]], operations, operation_ns) for at in chosen]


def _profile(
    at: dict[str, Any], rows: pd.DataFrame, operations: Mapping[str, float], operation_ns: float
) -> dict[str, Any]:
    line: dict[str, Any] = {key: at[key] for key in ("case", "error", "ratio")}
    for which in ("ours", "others"):
        solver, seconds = at[which]["solver"], at[which]["call_s"]
        steps = tables.time_for(rows[rows["solver"] == solver], at["error"], "n_steps")
        known = bool(np.isfinite(steps))
        line[which] = {"solver": solver, "steps": steps if known else None, "call_s": seconds}
        line[which]["step_ns"] = 1e9 * seconds / steps if known else None
    own = rows[rows["solver"] == at["ours"]["solver"]]
    inside = tables.time_for(own, at["error"], "inside_s") if "inside_s" in rows else float("nan")
    known = bool(np.isfinite(inside))
    seconds = inside if known else at["ours"]["call_s"]
    if known and line["ours"]["steps"]:
        line["ours"]["step_ns"] = 1e9 * inside / line["ours"]["steps"]
    line["integrators"] = line["ratio"] * at["ours"]["call_s"] / inside if known else None
    evaluations, count = at["ours"]["n_evaluations"], operations.get(at["case"], np.nan)
    # a step of Taylor, which the default takes, too, computes series, not accelerations at points
    counted = bool(evaluations and np.isfinite(evaluations)) and not at["ours"]["solver"].startswith((DEFAULT, TAYLOR))
    line["evaluations"] = evaluations if counted else None
    line["evaluation_ns"] = 1e9 * seconds / evaluations if counted else None
    line["straight_ns"] = count * operation_ns if np.isfinite(count) else None
    told = line["evaluation_ns"] is not None and line["straight_ns"] is not None
    line["without"] = line["ratio"] * line["evaluation_ns"] / line["straight_ns"] if told else None
    return line | {"in_the_way": _in_the_way(line)}


def _in_the_way(line: dict[str, Any]) -> str:
    """What each call pays outside the integrator, where the lead would end without it; so all but the arithmetic of the
    accelerations; else steps or time per step."""
    if line["integrators"] is not None and line["integrators"] >= 1.0:
        return "the call"
    if line["without"] is not None and line["without"] >= 1.0:
        return "overhead"
    steps, others = line["ours"]["steps"], line["others"]["steps"]
    if steps is None or others is None:
        return "not told"
    by_steps = others / steps
    return "steps" if by_steps < line["ratio"] / by_steps else "time per step"


def lines(found: list[dict[str, Any]]) -> Iterator[list[Any]]:
    """Of the table of profiles."""
    for line in found:
        both = (line["ours"], line["others"])
        shares = [f"{number(side['steps'])} × {number(side['step_ns'])}" for side in both]
        names = [f"`{side['solver']}`" for side in both]
        cells = [f"{line['case']}, {power(line['error'])}", names[0], shares[0], names[1], shares[1]]
        yield [*cells, line["evaluation_ns"], line["without"], line["in_the_way"]]
