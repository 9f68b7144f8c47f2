"""A table of random linkages without events: runs made together, in lanes, and one by one."""

import time
from collections.abc import Sequence
from typing import Any

import numpy as np

from twoloop import sweep

GROUP = "table"
LANES, SINGLY = "in lanes", "one by one"
# the default of an option with which runs do not go in lanes
OPTIONS: dict[str, dict[str, Any]] = {LANES: {}, SINGLY: {"max_step": np.inf}}


def rows_of(
    linkage: Any, given: Sequence[dict[str, Any]], span: tuple[float, float], parallel: str, workers: int
) -> list[dict[str, Any]]:
    """A row for each way: its time, how many went in lanes, and how the largest energy errors of the runs lie."""
    made = []
    for way, options in OPTIONS.items():
        began = time.perf_counter()
        rows = sweep(linkage, given, t_span=span, parallel=parallel, workers=workers, **options)
        wall = time.perf_counter() - began
        done = rows[rows["status"] == "REACHED_END"]
        made.append(
            {
                **{"group": GROUP, "way": way, "parallel": parallel, "workers": workers, "n_runs": len(rows)},
                **{"wall": wall, "n_done": len(done), "n_in_lanes": int(done["message"].str.contains(LANES).sum())},
                **{"energy_median": done["energy_error"].median(), "energy_error": done["energy_error"].max()},
            }
        )
    return made
