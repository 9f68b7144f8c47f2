"""Writes results to files in NumPy's npz format, without pickle."""

import json
import os
from dataclasses import asdict
from typing import Any

import numpy as np

from twoloop.checks.arguments import check_path
from twoloop.result.saved_fields import COUNTS, NUMBERS, OF_EVENTS, STATES, check_sum
from twoloop.run.record import Record

FORMAT = "twoloop result 1"
ALWAYS = ("t", *STATES, "h")
SOMETIMES = (*COUNTS, "redundant", "atol", "untested")


def parts_of(result: Record, inside: bool = True) -> tuple[dict[str, np.ndarray[Any, Any]], dict[str, Any]]:
    """Return the arrays of a result by name, with or without states within steps, and all other fields."""
    arrays: dict[str, Any] = {name: getattr(result, name) for name in ALWAYS}
    arrays |= {name: getattr(result, name) for name in SOMETIMES if getattr(result, name) is not None}
    n_events = None if result.t_events is None else len(result.t_events)
    for name in OF_EVENTS:
        arrays |= {f"{name}_{k}": array for k, array in enumerate(getattr(result, name) or [])}
    words: dict[str, Any] = {"format": FORMAT, "status": int(result.status), "message": result.message}
    words |= {"stats": asdict(result.stats), "rank": result.rank, "n_events": n_events, "method": result.method}
    words |= {"compiled": result.compiled, "changes": result.changes}
    words |= {name: getattr(result, name) for name in NUMBERS}
    if result.sol is not None and not result.arcs:  # the solution of a joined result consists of those of its arcs
        interpolator, table = result.sol.interpolator, result.sol.table
        arrays |= {"sol_t": table.t, "sol_states": table.states, "sol_kinds": table.kinds}
        words |= {"sol_end": result.sol.t_max, "sol_ranks": interpolator.ranks, "sol_rtol": interpolator.rtol}
        if inside:
            blocks = zip(*interpolator.interiors(table), strict=True)
            arrays["sol_interior_t"], arrays["sol_interior_states"] = (np.concatenate(each) for each in blocks)
    return arrays, words


def save(result: Record, path: str | os.PathLike[str]) -> None:
    """Write a result to a file, see `Result.save`."""
    arrays, words = parts_of(result)
    words["check_sums"] = {name: check_sum(array) for name, array in arrays.items()}
    with check_path(path).open("wb") as file:
        np.savez(file, words=np.array(json.dumps(words)), allow_pickle=False, **arrays)
