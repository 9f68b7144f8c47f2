"""What the energy of a run does: windows, slope, verdict."""

import math

import numpy as np
import pandas as pd

from studies.bench.store import Array

EPS = float(np.finfo(float).eps)
RESOLVED = 3.0  # standard errors from which a slope counts as one
DRIFTS, SLOWLY, ROUNDS, IRREGULAR = "drifts", "drifts within the swing", "drifts within rounding", "changes irregularly"
NO_DRIFT, IS_LOST = "no drift", "lost"
DRIFTING = (DRIFTS, SLOWLY, ROUNDS)  # verdicts of runs with a slope; irregular changes have none, nor are they calm
WINDOWS = 100  # at most, in which the energy error is averaged
BLOCKS = 10  # of windows; the scatter of their slopes is the uncertainty of the slope


def windows(t: Array, error: Array, period: float, t_end: float) -> dict[str, Array]:
    """Mean and range of the energy error in windows of whole periods, WINDOWS or fewer."""
    width = math.ceil(t_end / WINDOWS / period) * period
    edges = width * np.arange(int(t[-1] / width) + 1)
    parts = np.split(error, np.searchsorted(t, edges))[1:-1]
    return {
        "t": edges[:-1] + 0.5 * width,
        "mean": np.array([part.mean() for part in parts]),
        "range": np.array([np.ptp(part) for part in parts]),
    }


def drift(t: Array, mean: Array) -> tuple[float, float]:
    """Slope of the windows' means by least squares, and its standard error from the slopes of BLOCKS parts.

    The scatter between blocks is right for a random walk, to which the residuals of one line would be blind, and errs
    on the safe side for an oscillation. Raises ValueError if there are fewer than two windows a block, from which no
    scatter can be told.
    """
    if t.size < 2 * BLOCKS:
        raise ValueError(f"the slope of an energy error needs {2 * BLOCKS} windows or more; given {t.size}: run longer")
    slope = float(np.polyfit(t, mean, 1)[0])
    parts = np.array_split(np.arange(t.size), BLOCKS)
    slopes = [np.polyfit(t[part], mean[part], 1)[0] for part in parts]
    return slope, float(np.std(slopes, ddof=1) / math.sqrt(BLOCKS))


def verdict(row: pd.Series) -> str:
    """What the energy of a run does, from the numbers of its row alone.

    Without a slope a run is free of drift only where no change above the swing could hide in the scatter of its
    windows: a net slope of nothing may be a walk that came back.
    """
    if row["status"] != "REACHED_END":
        status = str(row["status"]).lower().replace("_", " ")
        return status if pd.isna(row["t_reached"]) else f"{status} at {row['t_reached']:.4g} s"
    if row["lost"]:
        return IS_LOST
    if abs(row["slope"]) <= RESOLVED * row["slope_error"]:
        return NO_DRIFT if bound(row) <= row["swing"] else IRREGULAR
    change = abs(row["slope"]) * row["t_end"]
    if change <= EPS * row["kinetic"] * row["n_steps"]:
        return ROUNDS
    return DRIFTS if change > row["swing"] else SLOWLY


def bound(row: pd.Series) -> float:
    """The greatest change of the energy over a run, J, that the scatter of its windows does not exclude."""
    return float((abs(row["slope"]) + RESOLVED * row["slope_error"]) * row["t_end"])
