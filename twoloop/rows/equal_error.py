"""Runs of one solver on one mechanism, sorted by error: cost at a target error by interpolation."""

from collections.abc import Iterable, Mapping, Sequence
from functools import cache, cached_property, lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from twoloop.checks.arguments import Array

DECADE = 10.0 * (1.0 + 1e-9)  # no interpolation between runs whose errors differ by more
NEAR = 2.0  # settings within this factor count as nearly equal
FEWEST = 3  # repetitions required for a confidence interval
LOOSEST = 1e-1  # loosest useful tolerance
# prefixes of solvers whose order depends on the tolerance, or whose loose runs do not follow a line
BY_TOLERANCE = ("heyoka", "Taylor", "auto", "the default", "ensemble", "solve_dae", "TRBDF2")
INTERVAL = (2.5, 97.5)  # percentiles of the bootstrap distribution
LEAST = 1.05  # smallest relevant ratio of times; less is within the variation of machine and order of calls
RESAMPLES, SEED = 1000, 25  # bootstrap resamples of the repetitions


@cache
def _rounds(n: int) -> NDArray[np.int64]:
    """Return resampled rounds (RESAMPLES, n): the same for all runs, because their repetitions are interleaved."""
    return np.random.default_rng(SEED).integers(0, n, (RESAMPLES, n))


def resampled(times: Iterable[Sequence[float]]) -> Array:
    """Return bootstrap medians of the times of each run (n_runs, RESAMPLES); NaN for fewer than three repetitions."""
    drawn = [_bootstrap_medians(tuple(own)) if len(own) >= FEWEST else np.full(RESAMPLES, np.nan) for own in times]
    return np.array(drawn).reshape(-1, RESAMPLES)


@lru_cache(maxsize=20_000)
def _bootstrap_medians(times: tuple[float, ...]) -> Array:
    return np.asarray(np.median(np.array(times)[_rounds(len(times))], axis=1))


Place = tuple[int, float | None]


class Runs:
    """The runs of one solver on one case with a known error and cost, sorted by error, as arrays.

    Arrays, because sorting and slicing a table of 70 columns for every solver and error takes minutes.
    """

    def __init__(self, columns: Mapping[str, NDArray[Any]], rows: NDArray[np.int64], what: str, solver: str):
        errors, settings = columns["error_q"][rows], columns["setting"][rows]
        order = np.argsort(errors, kind="stable")  # NaN sorts last
        known = order[~np.isnan(errors[order]) & ~np.isnan(columns[what][rows][order])]
        self.columns, self.rows = columns, rows[known]
        self.floor = float(np.fmax.reduce(columns["floor"][self.rows], initial=-np.inf))
        self.errors = np.maximum(errors[known], columns["floor"][self.rows])
        self.settings, self.of_one_order = settings[known], not solver.startswith(BY_TOLERANCE)
        best = float(settings[~np.isnan(errors)].max(initial=0.0))
        # than which none is looser that the solver can run: tried, or of no use
        self.loosest = best if (settings[np.isnan(errors)] > best).any() else LOOSEST

    def of(self, column: str) -> NDArray[Any]:
        """Return a column."""
        return self.columns[column][self.rows]

    @cached_property
    def drawn(self) -> Array:
        """Return `resampled` times; NaN if they are unknown."""
        known = "times" in self.columns
        return resampled(self.of("times")) if known else np.full((len(self.rows), RESAMPLES), np.nan)

    def used(self, k: int) -> str:
        """Return the method used in a run by a solver that chooses its method."""
        taken = self.of("used")[k] if "used" in self.columns else ""
        return taken if isinstance(taken, str) else ""


def place_of(runs: Runs, target: float, unasked: bool = False) -> Place | None:
    """Return the number of runs that reach a target error, and the position of the target on the log-log line.

    All runs below the target count, however accurate: a user takes the cheapest run that reaches the error. Return
    None if no run reaches it, or, unless `unasked`, if no run aimed at it: none is within a decade below the target, at
    the loosest setting that the solver can run, or at nearly the same setting as a looser run above the target (the
    error jumps over the target). The position on the log-log line through the two runs around the target is None if
    they are more than a decade apart, or of different methods or orders.
    """
    errors, settings = runs.errors, runs.settings
    n_good = int((errors <= target).sum())
    if n_good == 0 or target < runs.floor:
        return None
    below, end = errors[n_good - 1], n_good == len(errors)
    joined = not end and 0.0 < errors[n_good] <= DECADE * below
    looser = settings[n_good:, None] / settings[:n_good]
    near = ((looser >= 1.0) & (looser <= NEAR)).any()
    asked = below >= target / DECADE or joined or near or (settings[:n_good] >= runs.loosest).any()
    if not (asked or unasked):
        return None
    if not joined or not runs.of_one_order or runs.used(n_good - 1) != runs.used(n_good):
        return n_good, None
    x = np.log(errors[n_good - 1 : n_good + 1])
    return n_good, float((np.log(target) - x[0]) / (x[1] - x[0]))


def cost_at(costs: Array, place: Place) -> Array:
    """Return the least cost (per resample, if there are many) at a target; `costs`: one row per run, by error."""
    n_good, share = place
    best = np.fmin.reduce(costs[:n_good])  # NaN: runs without repetitions
    if share is None:
        return np.asarray(best)
    with np.errstate(invalid="ignore"):
        between = np.exp((1.0 - share) * np.log(costs[n_good - 1]) + share * np.log(costs[n_good]))
    return np.fmin(best, between)


def cheapest(runs: Runs, place: Place) -> int:
    """Return the index of the cheapest run at a target."""
    return int(runs.rows[np.argmin(runs.of("call_s")[: place[0]])])
