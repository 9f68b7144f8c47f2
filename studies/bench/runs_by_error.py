"""The columns of tables of runs that comparisons at equal error look at."""

from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from studies.bench.store import Array
from twoloop.rows.equal_error import Runs

SETTINGS = ("err_out", "h", "tol")  # a procedure along err_out has a tol, too, which does not vary


def setting_of(rows: pd.DataFrame) -> Array:
    """Value of the setting that varies, of each row; NaN where there is none."""
    found = np.full(len(rows), np.nan)
    for name in SETTINGS:
        if name in rows:
            found = np.where(np.isnan(found), rows[name].to_numpy(float), found)
    return found


def _columns(rows: pd.DataFrame, *more: str) -> dict[str, NDArray[Any]]:
    """Columns that are looked at, and more numbers, as arrays."""
    found: dict[str, NDArray[Any]] = {name: rows[name].to_numpy(float) for name in ("error_q", "floor", *more)}
    found |= {name: rows[name].to_numpy() for name in ("used", "times") if name in rows}
    return found | {"setting": setting_of(rows), "astray": astray(rows).to_numpy()}


def runs_with(rows: pd.DataFrame, what: str) -> Runs:
    """Those of rows of one solver."""
    solver = str(rows["solver"].iloc[0]) if len(rows) and "solver" in rows else ""
    return Runs(_columns(rows, what), np.arange(len(rows)), what, solver)


def by_solver(rows: pd.DataFrame, *costs: str) -> dict[str, Runs]:
    """Those of each solver, in order of appearance; runs without the first of the costs are left out."""
    columns = _columns(rows, *costs)
    codes, names = pd.factorize(rows["solver"])
    return {str(name): Runs(columns, np.flatnonzero(codes == k), costs[0], str(name)) for k, name in enumerate(names)}


def used(run: pd.Series) -> str:
    """The method that a solver took which chooses; a file has nothing where there is none."""
    return run["used"] if isinstance(run.get("used"), str) else ""


def astray(runs: pd.DataFrame) -> pd.Series:
    """Which runs have another motion than the reference; none where that was not looked at."""
    return runs["astray"].isin((True, "True")) if "astray" in runs else pd.Series(False, runs.index)


def errors_of(runs: pd.DataFrame) -> Array:
    return np.maximum(runs["error_q"].to_numpy(float), runs["floor"].to_numpy(float))
