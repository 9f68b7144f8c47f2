"""Rows of many solvers on many mechanisms in bounded time: each from its loosest setting on, until more is of no use.

A solver is asked for no more accuracy on a mechanism once it cannot run it, has passed the time limit, has failed at
two tolerances running, or has taken more than `FAR` times as long as the fastest so far for no smaller an error, at two
settings running. A part of `studies.work_precision`.
"""

from collections.abc import Callable, Sequence

import pandas as pd

from studies.bench import NOTHING_RUN, Run
from studies.store import KeptRows, Row

FAR = 20.0
RUNNING = 2
ENDING = (*NOTHING_RUN, "RAISED", "TIME_LIMIT")

Built = set[tuple[int, str, float]]  # what has been compiled, as `bench.build` keeps it


class _Progress:
    """How one solver has done on one mechanism so far."""

    def __init__(self) -> None:
        self.ended, self.failed, self.far = False, 0, 0

    def judge(self, row: Row, fastest: float | None, all_asked: bool, tolerances: bool) -> None:
        """Take a first repetition into account; `fastest`: the least time so far for no larger an error."""
        self.failed = self.failed + 1 if row["error_q"] is None else 0
        far = fastest is not None and (row["call_s"] or 0.0) > FAR * fastest
        self.far = self.far + 1 if far and row["error_q"] is not None else 0
        hopeless = (tolerances and self.failed >= RUNNING) or (self.far >= RUNNING and not all_asked)
        self.ended = row["status"] in ENDING or hopeless


def collect(
    todo: Sequence[Run],
    kept: KeptRows,
    make: Callable[[Run, int, Built], Row],
    all_asked: Callable[[Run], bool] = lambda run: False,
) -> pd.DataFrame:
    """Rows of all runs that are of use, the repetitions interleaved.

    Parameters
    ----------
    todo : sequence of Run
        Those of one solver on one mechanism from its loosest setting on.
    kept : KeptRows
    make : callable
        make(run, repeat, built) -> row, with case, status, error_q and call_s.
    all_asked : callable, optional
        all_asked(run): the solver is asked for all accuracies on this mechanism, however far behind it is.

    Returns
    -------
    DataFrame
        In the order of the runs, the repetitions of a run one below the other.
    """
    built: Built = set()
    progress: dict[tuple[str, str], _Progress] = {}
    reached: dict[str, list[tuple[float, float]]] = {}  # error and time of the runs on a mechanism
    for repeat in range(max((run.repeats for run in todo), default=0)):
        for run in todo:
            who = progress.setdefault((run.case.name, run.solver.name), _Progress())
            if not _again(run, repeat, kept) if repeat > 0 else who.ended:
                continue
            if run.key(repeat) not in kept:
                kept.add(run.key(repeat), make(run, repeat, built))
            if repeat == 0:
                row, runs = kept[run.key(0)], reached.setdefault(run.case.name, [])
                good = [] if row["error_q"] is None else [cpu for error, cpu in runs if error <= row["error_q"]]
                who.judge(row, min(good, default=None), all_asked(run), run.solver.setting == "tol")
                if row["error_q"] is not None and row["call_s"]:
                    runs.append((row["error_q"], row["call_s"]))
    keys = [run.key(k) for run in todo for k in range(run.repeats)]
    return pd.DataFrame([kept[key] for key in keys if key in kept])


def _again(run: Run, repeat: int, kept: KeptRows) -> bool:
    """Whether a run is repeated: one that was made and ended."""
    if repeat >= run.repeats or run.key(0) not in kept:
        return False
    return kept[run.key(0)]["error_q"] is not None
