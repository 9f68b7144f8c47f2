"""Results in folders: writing by `solve_dae(..., store=folder)`, and reading."""

import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from twoloop.checks.arguments import check_path
from twoloop.result.saved_fields import STATES
from twoloop.result.storage import FORMAT, parts_of
from twoloop.run.kept import OF_STEPS, OnDisk, read
from twoloop.run.record import Record, Status

WORDS = "words.json"
STREAMED = ("t", *OF_STEPS, "sol_t", "sol_states", "sol_kinds")
BROKEN_OFF = (
    "The run was interrupted: its process died, or it raised an exception. The result contains what had been stored; "
    "information written at the end of a run, such as its cost and redundant rows, is missing."
)


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


def begin_folder(path: Path, n_q: int) -> OnDisk:
    """Create a folder, which counts as that of an interrupted run until `end_folder`."""
    kept = OnDisk(path)
    words = {"format": FORMAT, "n_q": n_q, "status": int(Status.INTERRUPTED), "message": BROKEN_OFF, "stats": {}}
    (path / WORDS).write_text(json.dumps(words), encoding="utf-8")
    return kept


def end_folder(kept: OnDisk, result: Record) -> None:
    """Write everything that was not written during the run."""
    arrays, words = parts_of(result, inside=False)
    for name in arrays.keys() - {*STREAMED, *STATES}:
        kept.add(name, arrays[name])
    for t, states in () if result.sol is None else result.sol.interpolator.interiors(result.sol.table):
        kept.add("sol_interior_t", t)
        kept.add("sol_interior_states", states)
    words |= {"n_q": len(result.q), "untested": None if result.untested is None else bool(result.untested.all())}
    (kept.folder / WORDS).write_text(json.dumps(words), encoding="utf-8")


def read_folder(path: Path) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
    """Return the arrays and other fields of a folder, as for a file of `Result.save`.

    Raises
    ------
    ValueError
        If the folder was not written by a run.
    """
    try:
        words = json.loads((path / WORDS).read_text(encoding="utf-8"))
        arrays, n = read(path), int(words["n_q"])
        states = arrays.pop("states").T
    except Exception as error:  # the folder may contain anything
        raise ValueError(
            f"path must lead to a file of Result.save, or a folder that solve_dae stored a run in; {str(path)!r} is "
            f"none ({type(error).__name__}: {error})"
        ) from error
    arrays |= {"q": states[:n], "v": states[n : 2 * n], "a": states[2 * n : 3 * n], "lam": states[3 * n :]}
    if words.get("untested") is None:
        arrays.pop("untested", None)
    elif words["untested"]:
        arrays["untested"] = np.ones(len(arrays["h"]), dtype=bool)
    if "sol_end" not in words:  # interrupted run
        arrays = {name: array for name, array in arrays.items() if not name.startswith("sol_")}
    return arrays, words
