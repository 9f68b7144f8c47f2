"""Rows of many solvers on many mechanisms in bounded time: each from its loosest setting on, until more is of no use.

A solver is asked for no more accuracy on a mechanism once it cannot run it, has passed the time limit at two settings
running (a loose one may take longer than the next), has failed at two tolerances running after one that ended, or has
taken more than `FAR` times as long as the fastest of its side, ours or others', so far for no smaller an error, at two
settings running. Where two of its errors lie about a decade apart, or more, it is asked between them, so that nothing
need be interpolated over more, and beyond its ends, be they tolerances or steps, where these leave accuracies out. What
takes `OUTCLASSED` times as long as another of its side is not repeated. A part of `studies.work_precision`.
"""

import itertools
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial

import numpy as np
import pandas as pd

from studies.bench import headline
from studies.bench.cli import Progress
from studies.bench.collector import NOTHING_RUN, Run, Warm
from studies.bench.store import KeptRows, Row
from studies.bench.tables import TIGHTEST
from twoloop.rows.leaderboard import DECADE, LOOSEST, NEAR

FAR = 20.0
RUNNING = 2
ROUNDS = 4  # of asking between settings
APART = 0.5 * DECADE  # errors of which repetitions may lie a decade apart
OUTCLASSED = 10.0  # times the least time of its side: such a run decides nothing, and is made once
CLOSE = 5.0  # times the time of the fastest of its side: what costs more is not asked between its settings
ENDING = (*NOTHING_RUN, "RAISED")
FEWEST_STEPS, MOST_STEPS = 10, 10**6  # of a solver of fixed steps, beyond its grid
COARSER = 10.0**0.5  # of steps where a tolerance changes by a decade

ALWAYS = (headline.DEFAULT, headline.OWN_CODE)  # what a user gets is asked for all accuracies

Side = tuple[str, bool]  # a mechanism, and whether the solver is ours


class _Progress:
    """How one solver has done on one mechanism so far."""

    def __init__(self) -> None:
        self.ended, self.reached, self.failed, self.far, self.stopped = False, False, 0, 0, 0

    def judge(self, row: Row, fastest: float | None, all_asked: bool, tolerances: bool) -> None:
        """Take a first repetition into account; `fastest`: the least time of its side so far for no larger an error."""
        self.reached = self.reached or row["error_q"] is not None
        self.failed = self.failed + 1 if row["error_q"] is None and self.reached else 0
        self.stopped = self.stopped + 1 if row["status"] == "TIME_LIMIT" else 0
        far = fastest is not None and (row["call_s"] or 0.0) > FAR * fastest
        self.far = self.far + 1 if far and row["error_q"] is not None else 0
        hopeless = (tolerances and self.failed >= RUNNING) or (self.far >= RUNNING and not all_asked)
        self.ended = row["status"] in ENDING or self.stopped >= RUNNING or hopeless


def collect(
    todo: Sequence[Run],
    kept: KeptRows,
    make: Callable[[Run, int, Warm], Row],
    all_asked: Callable[[Run], bool] = lambda run: False,
    errors: Sequence[float] = (),
    always_repeated: Callable[[Run], bool] = lambda run: False,
    fine: Callable[[Run], bool] = lambda run: False,
) -> pd.DataFrame:
    """Rows of all runs that are of use, the repetitions interleaved.

    `todo`: those of one solver on one mechanism from its loosest setting on. `make`: make(run, repeat, built) -> row,
    with case, status, error_q and call_s. `all_asked`: all_asked(run): the solver is asked for all accuracies on this
    mechanism, however far behind it is. `errors`: the accuracies that are compared, for which solvers that are not far
    behind the fastest of their side, and those of ALWAYS, are asked between their settings. `always_repeated`:
    always_repeated(run): repeated, however far behind, as its time is compared with that of another such run. `fine`:
    fine(run): asked between its settings, however far behind.

    The rows are in the order of the runs, the repetitions of a run one below the other.
    """
    built: Warm = set()
    progress: dict[tuple[str, str], _Progress] = defaultdict(_Progress)
    reached: dict[Side, list[tuple[float, float]]] = defaultdict(list)  # error and time of the runs on a mechanism
    todo = list(todo)
    lines = Progress(len(todo))  # as if all were made: how many are is known only from their results

    def first(run: Run) -> None:
        row, runs = kept.made(run.key(0), lambda: make(run, 0, built)), reached[_side(run)]
        lines.step(run.label(0), always=False)
        good = [] if row["error_q"] is None else [cpu for error, cpu in runs if error <= row["error_q"]]
        who = progress[run.case.name, run.solver.name]
        who.judge(row, min(good, default=None), all_asked(run), run.solver.setting == "tol")
        if row["error_q"] is not None and row["call_s"]:
            runs.append((row["error_q"], row["call_s"]))

    for run in todo:
        if progress[run.case.name, run.solver.name].ended:
            lines.add(-1)
        else:
            first(run)
    for _ in range(ROUNDS if errors else 0):
        by_solver: dict[tuple[str, str], list[Run]] = defaultdict(list)
        for run in todo:
            by_solver[run.case.name, run.solver.name].append(run)
        more = [run for own in by_solver.values() for run in between(own, kept, reached, errors, fine(own[0]))]
        lines.add(len(more))
        for run in more:
            first(run)
        todo += more
    again = _repeated(todo, kept, always_repeated)
    lines.add(sum(run.repeats - 1 for run in again))
    for repeat in range(1, max((run.repeats for run in todo), default=0)):
        for run in again:
            if repeat < run.repeats:
                kept.made(run.key(repeat), partial(make, run, repeat, built))
                lines.step(run.label(repeat), always=False)
    # a setting that was passed over at first may have been asked for later, and then stands in the list twice
    keys = dict.fromkeys(run.key(k) for run in todo for k in range(run.repeats))
    return pd.DataFrame([kept[key] for key in keys if key in kept])


def is_ours(run: Run) -> bool:
    """Whether a run is by one of our solvers."""
    return run.solver.family == "two-loop"


def _side(run: Run) -> Side:
    return run.case.name, is_ours(run)


def between(
    own: Sequence[Run],
    kept: KeptRows,
    reached: Mapping[Side, Sequence[tuple[float, float]]],
    errors: Sequence[float],
    fine: bool = False,
) -> list[Run]:
    """Runs of one solver on one mechanism where its errors leave more than a decade out, and beyond its ends."""
    rows = {run.value: kept[run.key(0)] for run in own if run.key(0) in kept}
    made = sorted((value for value, row in rows.items() if row["error_q"]), reverse=True)
    if not made:
        return []
    error = {value: max(float(rows[value]["error_q"]), float(rows[value].get("floor") or 0.0)) for value in made}
    fastest = [
        min((cpu for each, cpu in reached[_side(own[0])] if each <= error[value]), default=np.inf) for value in made
    ]
    limit = np.inf if fine or own[0].solver.name in ALWAYS else CLOSE
    close = {value: rows[value]["call_s"] <= limit * least for value, least in zip(made, fastest, strict=True)}
    asked = []
    for loose, tight in itertools.pairwise(made):
        apart, inside = error[loose] / error[tight], any(error[tight] < each < error[loose] for each in errors)
        if inside and apart > APART and loose / tight > NEAR and (close[loose] or close[tight]):
            asked.append(float(np.sqrt(loose * tight)))
    asked += _beyond(own[0], made, error, close, sorted(rows), errors)
    # the nearest tolerances of two digits, or the nearest steps of which the motion takes a whole number
    t_end, steps = own[0].case.t_end, own[0].solver.setting == "h"
    tidy = [t_end / round(t_end / value) if steps else float(f"{value:.2g}") for value in asked]
    return [replace(own[0], value=value) for value in dict.fromkeys(tidy) if value not in rows]


def _beyond(
    run: Run,
    made: Sequence[float],
    error: Mapping[float, float],
    close: Mapping[float, bool],
    tried: Sequence[float],
    errors: Sequence[float],
) -> list[float]:
    """Return settings looser and tighter than those in `made` (loose to tight) with which errors are close.

    Steps so long that the solver failed are no limit: settings between them and the longest step that succeeded are
    tried.
    """
    first, last, asked = made[0], made[-1], []
    loosest, tightest, decade = LOOSEST, TIGHTEST, DECADE
    if run.solver.setting == "h":
        loosest, tightest, decade = run.case.t_end / FEWEST_STEPS, run.case.t_end / MOST_STEPS, COARSER
    if error[first] < max(errors) / DECADE and close[first]:
        failed = [value for value in tried if value > first]
        if not failed and first < loosest:
            asked.append(min(loosest, decade * first))
        elif run.solver.setting == "h" and failed and failed[0] / first > NEAR:
            asked.append(float(np.sqrt(first * failed[0])))
    if last == tried[0] and error[last] > min(errors) and last > tightest and close[last]:
        asked.append(max(tightest, last / decade))
    return asked


def _repeated(todo: Sequence[Run], kept: KeptRows, always: Callable[[Run], bool]) -> list[Run]:
    """Return the runs that ended, and whose times may decide which solver is fastest, see `OUTCLASSED`."""
    sides: dict[Side, list[tuple[float, float, Run]]] = defaultdict(list)
    for run in todo:
        if run.key(0) in kept and (row := kept[run.key(0)])["error_q"] is not None:
            sides[_side(run)].append((row["error_q"], row["call_s"] or 0.0, run))
    found = set()
    for ended in sides.values():
        least = np.inf
        for _, seconds, run in sorted(ended, key=lambda each: each[:2]):
            least = min(least, seconds)
            if seconds <= OUTCLASSED * least or always(run):
                found.add(run.key(0))
    return [run for run in todo if run.key(0) in found]
