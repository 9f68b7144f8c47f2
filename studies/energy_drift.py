"""What the energy of a run does: windows, slope, verdict; and the names of what the energy study compares."""

import math
from typing import Literal

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from studies.runs import LOST

Array = NDArray[np.float64]

SUN, GAUSS, LOBATTO, RADAU = "Sun Radau IIB(3)", "Gauss(3)", "Lobatto IIIE(4)", "Radau IIA(3)"
GAUSS_12, MIDPOINT = "Gauss(6)", "implicit midpoint"
NEWMARK_QUARTER, NEWMARK_HALF = "Newmark, β = 1/4", "Newmark, β = 1/2"
PAPER_IRK, BDF_LOOP = "PaperIRK", "BDF"
PAPER_NEWMARK_QUARTER, PAPER_NEWMARK_HALF = "PaperNewmark, β = 1/4", "PaperNewmark, β = 1/2"
ONE, SWITCHING = "one partition", "switching"
Variables = Literal["velocities", "momenta"]
Partition = Literal["lasting", "symmetric"]
Variant = tuple[Variables, Partition]
VELOCITIES_LASTING: Variant = ("velocities", "lasting")
VELOCITIES_SYMMETRIC: Variant = ("velocities", "symmetric")
MOMENTA_LASTING: Variant = ("momenta", "lasting")
MOMENTA_SYMMETRIC: Variant = ("momenta", "symmetric")

EPS = float(np.finfo(float).eps)
RESOLVED = 3.0  # standard errors from which a slope counts as one
WANTED = 100.0  # times less than Sun's method on (q_i, v_i): what the study is asked to show
DRIFTS, CREEPS, ROUNDS, WANDERS, NO_DRIFT, IS_LOST = "drifts", "creeps", "rounding", "wanders", "no drift", "lost"
WINDOWS = 100  # at most, in which the energy error is averaged
BLOCKS = 10  # of windows; the scatter of their slopes is the uncertainty of the slope
KEY = ["geometry", "solver", "h", "tol", "variables", "partition"]


def windows(t: Array, error: Array, period: float, t_end: float) -> dict[str, Array]:
    """Mean, range and largest magnitude of the energy error in windows of whole periods, WINDOWS or fewer."""
    width = math.ceil(t_end / WINDOWS / period) * period
    edges = width * np.arange(int(t[-1] / width) + 1)
    parts = np.split(error, np.searchsorted(t, edges))[1:-1]
    return {
        "t": edges[:-1] + 0.5 * width,
        "mean": np.array([part.mean() for part in parts]),
        "range": np.array([np.ptp(part) for part in parts]),
        "largest": np.array([np.abs(part).max() for part in parts]),
    }


def drift(t: Array, mean: Array) -> tuple[float, float]:
    """Slope of the windows' means by least squares, and its standard error from the slopes of BLOCKS parts.

    The scatter between blocks is right for a random walk, to which the residuals of one line would be blind, and
    errs on the safe side for an oscillation.
    """
    slope = float(np.polyfit(t, mean, 1)[0])
    parts = np.array_split(np.arange(t.size), BLOCKS)
    slopes = [np.polyfit(t[part], mean[part], 1)[0] for part in parts]
    return slope, float(np.std(slopes, ddof=1) / math.sqrt(BLOCKS))


def verdict(row: pd.Series) -> str:
    """What the energy of a run does, from the numbers of its row alone."""
    if row["status"] != "REACHED_END":
        return f"failed at {row['t_reached']:.4g} s"
    if row["largest"] > LOST * row["kinetic"]:
        return IS_LOST
    change = abs(row["slope"]) * row["t_end"]
    if abs(row["slope"]) <= RESOLVED * row["slope_error"]:
        return NO_DRIFT if change <= row["swing"] else WANDERS
    if change <= EPS * row["kinetic"] * row["n_steps"]:
        return ROUNDS
    return DRIFTS if change > row["swing"] else CREEPS


def bound(row: pd.Series) -> float:
    """The greatest slope, J/s, that the scatter of a run does not exclude."""
    return abs(row["slope"]) + RESOLVED * row["slope_error"]


def pick(rows: pd.DataFrame, geometry: str, solver: str, variant: Variant, fixed: bool = True) -> pd.Series:
    """One of the long runs."""
    chosen = rows[(rows["geometry"] == geometry) & (rows["solver"] == solver) & (rows["t_end"] == rows["t_end"].max())]
    chosen = chosen[(chosen["variables"] == variant[0]) & (chosen["partition"] == variant[1])]
    return chosen[chosen["h"].notna() == fixed].iloc[0]


def times_less(rows: pd.DataFrame, row: pd.Series) -> float:
    """By how much Sun's method on (q_i, v_i) drifts more at the same step, at least."""
    same = rows[(rows["geometry"] == row["geometry"]) & (rows["t_end"] == row["t_end"]) & (rows["h"] == row["h"])]
    same = same[(same["solver"] == SUN) & (same["variables"] == "velocities") & (same["partition"] == "lasting")]
    return float("nan") if same.empty else abs(same["slope"].iloc[0]) / bound(row)


def error_of(rows: pd.DataFrame, row: pd.Series) -> float:
    """Largest position error of the short run with the settings of a long one."""
    short = rows[rows["t_end"] == rows["t_end"].min()]
    same = (short[KEY].fillna(0.0) == row[KEY].fillna(0.0)).all(axis=1)
    return float(short[same]["error_q"].iloc[0])
