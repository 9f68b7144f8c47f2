"""Why the paper's time over ours is not one factor in Table 3: causes and readings of the text, tested on the rows."""

from functools import partial
from itertools import product
from typing import Any, Literal

import numpy as np
import pandas as pd
from scipy.optimize import least_squares

from studies.bench.collector import Case, Run, Solver
from studies.bench.solvers import ERR_IN, IRK, PAPER_TOL
from studies.bench.tables import where
from studies.table3.cells import FAMILIES, PAPER_IRK, PRINTED, TOLERANCES, least, machine
from twoloop import Result, RungeKutta, solve_dae
from twoloop.methods.tableaux import sun_radau_iib

UNEQUAL = 1.2  # times of the same run, largest over least, beyond which they are no result
FLAT = 1.5  # a cause explains the pattern if the largest ratio over the smallest is at most this
Reading = Literal["all", "independent"]
READINGS: dict[Reading, str] = {"all": "all of z", "independent": "y_i only"}  # what criterion (32) is taken over


def cells(rows: pd.DataFrame, exchanged: bool = False) -> pd.DataFrame:
    """List cells of both: printed time, our least time and counts; exchanged: err_in and err_out of the IRK swapped."""
    lines = []
    for group, (i, e_in), (j, e_out) in product(FAMILIES, enumerate(TOLERANCES), enumerate(TOLERANCES)):
        swapped = exchanged and group == "Table 3: IRK"
        paper = PRINTED[group][j][i] if swapped else PRINTED[group][i][j]
        ours = machine(rows, group, e_in, e_out)
        if paper is not None and ours is not None:
            attempts = float(ours["n_steps"]) + float(ours["n_rejected"])
            lines.append((group, paper, least(ours), *ours[["n_evaluations", "n_inner"]].astype(float), attempts))
    return pd.DataFrame(lines, columns=["group", "paper", "call_s", "evaluations", "inner", "attempts"])


def span(ratio: pd.Series) -> float:
    """Return the largest over the smallest: 1 if one factor explains all."""
    return float(ratio.max() / ratio.min())


def fit(table: pd.DataFrame) -> dict[str, float]:
    """Fit, in logs, the cost model: printed time = e (evaluations + i inner iterations + p attempted steps).

    i is at most 1: an evaluation contains inner iterations, so that one of them cannot cost more.
    """

    def cost(x: np.ndarray) -> np.ndarray:
        scale, inner, attempt = np.exp(x)
        model = scale * (table["evaluations"] + inner * table["inner"] + attempt * table["attempts"])
        return np.asarray(np.log(model / table["paper"]), dtype=float)

    found = least_squares(cost, np.log([2e-5, 0.2, 4.0]), bounds=(np.log(1e-9), np.log([1.0, 1.0, 1e3])))
    residual = cost(found.x)
    rms, span = np.sqrt(np.mean(residual**2)), np.exp(residual.max() - residual.min())
    return {"attempt": float(np.exp(found.x[2])), "rms": float(rms), "span": float(span)}


def partition_cost(rows: pd.DataFrame) -> float:
    """Return the seconds of one partition by full pivoting, from runs with and without it in every step.

    The partition is that of `partition="symmetric"`, in fixed steps of the midpoint rule, which has few evaluations.
    """
    solvers = (f"fixed step, {name}" for name in ("lasting", "symmetric"))
    kept, every = (where(rows, group="partition", solver=name).iloc[0] for name in solvers)
    evaluation = kept["call_s"] / kept["n_evaluations"]
    # the two runs do not iterate equally often
    extra = every["call_s"] - evaluation * every["n_evaluations"]
    return float(extra / every["n_steps"])


def _paper_irk(test: Reading, case: Case, err_out: float, repeat: int) -> Result:
    method = RungeKutta(sun_radau_iib(3), "paper", "richardson-paper", ERR_IN, err_out, outer_test=test)
    return solve_dae(*case.start, method=method, rtol=PAPER_TOL, atol=PAPER_TOL)


def reading_runs(case: Case) -> list[Run]:
    """List both readings of (32) along err_out, with err_in at its finest."""
    made = []
    for test, what in READINGS.items():
        fixed, run = {"err_in": ERR_IN, "outer_test": test}, partial(_paper_irk, test)
        solver = Solver(f"{IRK}, (32) on {what}", "two-loop", "compiled", True, "err_out", run, fixed=fixed)
        made += [Run(case, solver, err_out, "reading", 1) for err_out in TOLERANCES]
    return made


def readings(rows: pd.DataFrame) -> list[dict[str, Any]]:
    """Tell how far evaluations along err_out of each reading of (32) are from the printed row, and whether in phase."""
    found = []
    for what in READINGS.values():
        runs = where(rows, group="reading", solver=f"{IRK}, (32) on {what}", err_in=ERR_IN)
        runs = runs.set_index("err_out").reindex(TOLERANCES)
        if runs["status"].eq("REACHED_END").all():
            apart = np.log(runs["n_evaluations"].to_numpy(float) / PAPER_IRK[-1])
            # about its mean, as the factor between both is free
            found.append({"over": what, "rms": float(np.std(apart)), "astray": bool(runs["astray"].iloc[0])})
    return found


def causes(rows: pd.DataFrame) -> dict[str, Any]:
    """Find the paper's times over ours by procedure, and what each cause and reading leaves of the pattern."""
    table = cells(rows)
    partition = partition_cost(rows)
    by_time = table["paper"] / table["call_s"]
    found: dict[str, Any] = {"flat": FLAT, "one_constant": span(by_time) <= FLAT, "span_time": span(by_time)}
    by_count = span(table["paper"] / table["evaluations"])
    by_partition = span(table["paper"] / (table["call_s"] + partition * table["attempts"]))
    found |= {"span_evaluations": by_count, "evaluations_explain": by_count <= FLAT, "partition_us": 1e6 * partition}
    found |= {"span_partition": by_partition, "partition_explains": by_partition <= FLAT}
    found["fits"] = {"as labelled": fit(table), "exchanged": fit(cells(rows, exchanged=True))}
    literal, exchanged = found["fits"].values()
    found["exchanged_fits_better"] = exchanged["rms"] < literal["rms"]
    return found | {"readings": readings(rows)}
