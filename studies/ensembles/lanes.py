"""Four-bar linkages in lanes of another number than the processor's vectors hold, and what they make of its peak.

A part of `studies.ensembles`: each number of lanes has a process of its own, with kernels of its own in a folder that
is thrown away. Run by hand, `python -m studies.ensembles.lanes N_LANES N_RUNS` prints the row.
"""

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from statistics import median
from typing import Any

from studies.bench.cli import ROOT
from studies.bench.collector import REPEATS
from studies.bench.store import Array
from studies.ensembles import operations
from twoloop.kernels.compile.own_functions import OwnFunctions
from twoloop.kernels.lanes import lane_room

GROUP = "lanes"
FEWER = (2, 4)  # than the processor's vectors hold: these are the number that is usual


def row_of(n_lanes: int, n_runs: int) -> dict[str, Any]:
    """The row of a number of lanes, from a process of its own; the kernels of the usual number are there already."""
    environment = dict(os.environ)
    with tempfile.TemporaryDirectory(prefix="twoloop-lanes-") as folder:
        if n_lanes != lane_room.LANES:
            environment["NUMBA_CACHE_DIR"] = folder
        command = [sys.executable, "-m", __name__, str(n_lanes), str(n_runs)]
        done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True)
    row = {"group": GROUP, "n_lanes": n_lanes, "n_runs": n_runs}
    if done.returncode:
        return row | {"message": (done.stderr.strip().splitlines() or ["no word of why"])[-1]}
    return row | dict(json.loads(done.stdout.splitlines()[-1]))


def rows(n_runs: int, quick: bool) -> list[dict[str, Any]]:
    """A row for each number of lanes."""
    fewer = [] if quick else [n for n in FEWER if n < lane_room.LANES]
    return [row_of(n, n_runs) for n in (*fewer, lane_room.LANES)]


def measured(n_runs: int) -> dict[str, Any]:
    """CPU time of a run in this process, the median of calls after the first; then operations, counted in one call."""
    from studies.ensembles.study import SPAN, USUAL, assembled, in_lanes
    from twoloop.generate import own_lanes

    def seconds(solve: Callable[[float], Array]) -> float:
        began = time.process_time()
        solve(USUAL)
        return (time.process_time() - began) / n_runs

    solve = in_lanes(assembled(n_runs), SPAN)
    solve(USUAL)
    spent = median([seconds(solve) for _ in range(REPEATS)])
    counters = []

    def counted(kind: str, stamp: str, key: str, write: Callable[[], tuple[list[str], str]]) -> OwnFunctions:
        names, text = write()
        made = operations.compiled([*names, operations.COUNT], operations.counting(text))
        counters.append(operations.count_of(made))
        return made

    own_lanes.own_functions = counted  # type: ignore[assignment]
    solve = in_lanes(assembled(n_runs), SPAN)  # of another system, which has no code yet
    solve(USUAL)
    before = sum(count() for count in counters)
    solve(USUAL)
    made = (sum(count() for count in counters) - before) / n_runs
    return {"run_s": spent, "operations": made, "most": operations.most(lane_room.LANES)}


if __name__ == "__main__":
    lane_room.LANES = int(sys.argv[1])  # before what is compiled for it
    print(json.dumps(measured(int(sys.argv[2]))))
