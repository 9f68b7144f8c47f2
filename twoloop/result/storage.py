"""Write results to files in NumPy's npz format, without pickle, and to folders."""

import json
import os
import zlib
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from twoloop.checks.arguments import check_path
from twoloop.run.record import OF_STEPS, FileStore, Record, Status

FORMAT = "twoloop result 1"
STATES = ("q", "v", "a", "lam")
COUNTS = ("rejected_error", "rejected_convergence", "partitioned")
NUMBERS = ("rtol", "defect", "widest_gap", "t_end")  # each may be None
EVENT_FIELDS = ("t_events", "q_events", "v_events")
REQUIRED = ("t", *STATES, "h")
OPTIONAL = (*COUNTS, "redundant", "atol", "untested")
METADATA_FILE = "words.json"
STREAMED = ("t", *OF_STEPS, "sol_t", "sol_states", "sol_kinds")
INTERRUPTED = (
    "The run was interrupted: its process died, or it raised an exception. The result contains what had been stored; "
    "information written at the end of a run, such as its cost and redundant rows, is missing."
)


def fields_of(result: Record, inside: bool = True) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
    """Return the arrays of a result by name, with or without states within steps, and all other fields as metadata."""
    arrays: dict[str, Any] = {name: getattr(result, name) for name in REQUIRED}
    arrays |= {name: getattr(result, name) for name in OPTIONAL if getattr(result, name) is not None}
    n_events = None if result.t_events is None else len(result.t_events)
    for name in EVENT_FIELDS:
        arrays |= {f"{name}_{k}": array for k, array in enumerate(getattr(result, name) or [])}
    metadata: dict[str, Any] = {"format": FORMAT, "status": int(result.status), "message": result.message}
    metadata |= {"stats": asdict(result.stats), "rank": result.rank, "n_events": n_events, "method": result.method}
    metadata |= {"compiled": result.compiled, "changes": result.changes}
    metadata |= {name: getattr(result, name) for name in NUMBERS}
    if result.sol is not None and not result.arcs:  # the solution of a joined result consists of those of its arcs
        interpolator, table = result.sol.interpolator, result.sol.table
        arrays |= {"sol_t": table.t, "sol_states": table.states, "sol_kinds": table.kinds}
        metadata |= {"sol_end": result.sol.t_max, "sol_ranks": interpolator.ranks, "sol_rtol": interpolator.rtol}
        if inside:
            blocks = zip(*interpolator.interiors(table), strict=True)
            arrays["sol_interior_t"], arrays["sol_interior_states"] = map(np.concatenate, blocks)
    return arrays, metadata


def save(result: Record, path: str | os.PathLike[str]) -> None:
    """Write a result to a file, see `Result.save`."""
    arrays, metadata = fields_of(result)
    metadata["check_sums"] = {name: checksum(array) for name, array in arrays.items()}
    with check_path(path).open("wb") as file:
        np.savez(file, words=np.array(json.dumps(metadata)), allow_pickle=False, **arrays)


def check_folder(store: Any) -> Path:
    """Return `store` as a path at which a folder can be created; raise an error if it cannot."""
    try:
        path = check_path(store)
    except TypeError as error:
        raise TypeError(f"store{str(error).removeprefix('path')}") from None
    if path.exists() or path.is_symlink():
        raise ValueError(
            f"store must be a folder that does not exist yet; given {str(path)!r}, which exists. Use another name, "
            "or remove it"
        )
    if not path.absolute().parent.is_dir():
        raise ValueError(
            f"store must be inside an existing folder; given {str(path)!r}. Create its parent folder first"
        )
    return path


def begin_folder(path: Path, n_q: int) -> FileStore:
    """Create the folder of a run; until `end_folder` it counts as that of an interrupted run."""
    buffers = FileStore(path)
    metadata = {"format": FORMAT, "n_q": n_q, "status": int(Status.INTERRUPTED), "message": INTERRUPTED, "stats": {}}
    (path / METADATA_FILE).write_text(json.dumps(metadata), encoding="utf-8")
    return buffers


def end_folder(buffers: FileStore, result: Record) -> None:
    """Write everything that was not written during the run."""
    arrays, metadata = fields_of(result, inside=False)
    for name in arrays.keys() - {*STREAMED, *STATES}:
        buffers.add(name, arrays[name])
    for t, states in () if result.sol is None else result.sol.interpolator.interiors(result.sol.table):
        buffers.add("sol_interior_t", t)
        buffers.add("sol_interior_states", states)
    metadata |= {"n_q": len(result.q), "untested": None if result.untested is None else bool(result.untested.all())}
    (buffers.folder / METADATA_FILE).write_text(json.dumps(metadata), encoding="utf-8")


def checksum(array: NDArray[Any]) -> int:
    """Return a checksum of the values of an array, which detects interchanged arrays."""
    return zlib.crc32(np.ascontiguousarray(array).tobytes())
