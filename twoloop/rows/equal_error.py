"""The runs of one solver on one mechanism, by error: which are good enough, and what an error between them costs."""

from collections.abc import Iterable, Mapping, Sequence
from functools import cache, lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from twoloop.checks.arguments import Array

DECADE = 10.0 * (1.0 + 1e-9)  # between two runs that lie farther apart nothing is interpolated
NEAR = 2.0  # settings that differ by less are nearly the same
FEWEST = 3  # repetitions that an interval asks for
LOOSEST = 1e-1  # tolerance of which looser ones are of no use
# how solvers begin whose order the tolerance sets, or whose loose runs are too rough for a line
BY_TOLERANCE = ("heyoka", "Taylor", "auto", "the default", "ensemble", "solve_dae", "TRBDF2")
INTERVAL = (2.5, 97.5)  # percentiles that count of times drawn again
LEAST = 1.05  # ratio of times that counts: less is within what machine and order of the calls do
RESAMPLES, SEED = 1000, 25  # draws of the repetitions


@cache
def _rounds(n: int) -> NDArray[np.int64]:
    """Rounds of n repetitions, drawn again (RESAMPLES, n): the same for all runs, as rounds are interleaved."""
    return np.random.default_rng(SEED).integers(0, n, (RESAMPLES, n))


def resampled(times: Iterable[Sequence[float]]) -> Array:
    """Medians of the times of each run over rounds drawn again (n_runs, RESAMPLES); NaN of fewer than three."""
    drawn = [_medians_drawn(tuple(own)) if len(own) >= FEWEST else np.full(RESAMPLES, np.nan) for own in times]
    return np.array(drawn).reshape(-1, RESAMPLES)


@lru_cache(maxsize=20_000)
def _medians_drawn(times: tuple[float, ...]) -> Array:
    return np.asarray(np.median(np.array(times)[_rounds(len(times))], axis=1))


Place = tuple[int, float | None]


class Runs:
    """The runs of one solver on one case that have an error and this cost, by error, in arrays.

    A table of 70 columns takes minutes where it is sorted and cut for every solver and every error.
    """

    def __init__(self, columns: Mapping[str, NDArray[Any]], rows: NDArray[np.int64], what: str, solver: str):
        errors, settings = columns["error_q"][rows], columns["setting"][rows]
        order = np.argsort(errors, kind="stable")  # NaN last
        known = order[~np.isnan(errors[order]) & ~np.isnan(columns[what][rows][order])]
        self.columns, self.rows = columns, rows[known]
        self.floor = float(np.fmax.reduce(columns["floor"][self.rows], initial=-np.inf))
        self.errors = np.maximum(errors[known], columns["floor"][self.rows])
        self.settings, self.of_one_order = settings[known], not solver.startswith(BY_TOLERANCE)
        best = float(settings[~np.isnan(errors)].max(initial=0.0))
        # than which none is looser that the solver can run: tried, or of no use
        self.loosest = best if (settings[np.isnan(errors)] > best).any() else LOOSEST

    def of(self, column: str) -> NDArray[Any]:
        """What stands in a column."""
        return self.columns[column][self.rows]

    def drawn(self) -> Array:
        """`resampled` of the times; NaN where these are not known."""
        known = "times" in self.columns
        return resampled(self.of("times")) if known else np.full((len(self.rows), RESAMPLES), np.nan)

    def used(self, k: int) -> str:
        """The method that the solver took in a run, if it chooses."""
        taken = self.of("used")[k] if "used" in self.columns else ""
        return taken if isinstance(taken, str) else ""


def place_of(runs: Runs, target: float, unasked: bool = False) -> Place | None:
    """How many runs of one solver, by error, are good enough, and where between them and the next the target is.

    All of these count, however much better they are: a user who wants an error takes the cheapest run that has it.
    None: no run is so good, or, unless `unasked`, none was asked for about this: within a decade below the target, at
    the loosest setting that the solver can run, or at nearly the same setting as a looser one that is not good enough
    (the solver leaps over the target). The place between two runs, on the log-log line through them, is None where
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
    """The least cost (of each draw, if there are many) at a place; `costs`: a row a run, by error."""
    n_good, share = place
    best = np.fmin.reduce(costs[:n_good])  # NaN: draws of runs made once, as others are cheaper
    if share is None:
        return np.asarray(best)
    with np.errstate(invalid="ignore"):
        between = np.exp((1.0 - share) * np.log(costs[n_good - 1]) + share * np.log(costs[n_good]))
    return np.fmin(best, between)


def cheapest(runs: Runs, place: Place) -> int:
    """The row of the cheapest run at a place."""
    return int(runs.rows[np.argmin(runs.of("call_s")[: place[0]])])
