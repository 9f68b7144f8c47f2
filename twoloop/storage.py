"""Results in files: NumPy's npz, without pickle."""

import json
import os
import zipfile
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from twoloop.checks import shown
from twoloop.consistency import check_system
from twoloop.dense import DenseSolution, Interpolator, Table, ranks_at
from twoloop.result import Result
from twoloop.saved_fields import COUNTS, NUMBERS, OF_EVENTS, STATES, Fields, check_sum
from twoloop.system import ConstrainedSystem

Array = NDArray[np.float64]

FORMAT = "twoloop result 1"
ALWAYS = ("t", *STATES, "h")
SOMETIMES = (*COUNTS, "redundant", "atol", "untested")


def check_path(path: Any) -> Path:
    """Return `path` as a Path, or say that it is none."""
    if not isinstance(path, (str, os.PathLike)) or "\0" in str(path):
        raise TypeError(f"path must be a file name or a path; given {shown(path)} of type {type(path).__name__}")
    return Path(path)


def save(result: Result, path: str | os.PathLike[str]) -> None:
    """Write a result to a file, see `Result.save`."""
    arrays: dict[str, Any] = {name: getattr(result, name) for name in ALWAYS}
    arrays |= {name: getattr(result, name) for name in SOMETIMES if getattr(result, name) is not None}
    n_events = None if result.t_events is None else len(result.t_events)
    for name in OF_EVENTS:
        arrays |= {f"{name}_{k}": array for k, array in enumerate(getattr(result, name) or [])}
    words: dict[str, Any] = {"format": FORMAT, "status": int(result.status), "message": result.message}
    words |= {"stats": asdict(result.stats), "rank": result.rank, "n_events": n_events, "method": result.method}
    words |= {name: getattr(result, name) for name in NUMBERS}
    if result.sol is not None:
        interpolator, table = result.sol.interpolator, result.sol.table
        arrays |= {"sol_t": table.t, "sol_states": table.states, "sol_kinds": table.kinds}
        words |= {"sol_end": result.sol.t_max, "sol_ranks": interpolator.ranks, "sol_rtol": interpolator.rtol}
        if interpolator.parts > 1:
            arrays["sol_interior_t"], arrays["sol_interior_states"] = interpolator.interiors(table)
    words["check_sums"] = {name: check_sum(array) for name, array in arrays.items()}
    with check_path(path).open("wb") as file:
        np.savez(file, words=np.array(json.dumps(words)), allow_pickle=False, **arrays)


def load(path: str | os.PathLike[str], system: ConstrainedSystem | None = None) -> Result:
    """Read a result that `Result.save` wrote.

    Parameters
    ----------
    path : str or path
        The file.
    system : ConstrainedSystem, optional
        The system that was solved; only with it `result.sol`, `result.reactions`, `result.energy`, `result.plot` and
        `result.animate` have all that they need. None: `result.sol` is None.

    Returns
    -------
    Result
        As it was saved.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    TypeError, ValueError
        If the file was not written by `Result.save` or is damaged (says in which field), or holds a result of a system
        of other sizes.
    """
    if system is not None:
        check_system(system)
    path = check_path(path)
    arrays, words = _read(path)
    known = Fields(str(path), arrays, words)
    if system is not None:
        sizes, given = known.sizes, (system.n_q, system.n_c + system.n_a)
        if sizes != given:
            raise ValueError(
                f"system must be the one that was solved, with n_q = {sizes[0]} and n_c + n_a = {sizes[1]}; "
                f"{system.name!r} has {given[0]} and {given[1]}"
            )
    always: dict[str, Any] = {name: arrays[name] for name in ALWAYS}
    optional: dict[str, Any] = {name: arrays.get(name) for name in SOMETIMES} | known.numbers
    if known.n_events is not None:
        optional |= {name: [arrays[f"{name}_{k}"] for k in range(known.n_events)] for name in OF_EVENTS}
    return Result(
        **always,
        **optional,
        status=known.status,
        message=known.message,
        stats=known.statistics,
        rank=known.rank,
        system=system,
        method=known.method,
        sol=None if system is None or "sol_t" not in arrays else _solution(system, arrays, words),
    )


def _read(path: Path) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
    """Arrays and words of a file, whatever is in it, or that it is none of ours."""
    ours = f"path must lead to a file written by Result.save; {str(path)!r}"
    arrays: dict[str, NDArray[Any]] = {}
    field = ""
    with path.open("rb") as file:
        try:
            with zipfile.ZipFile(file) as archive:
                for name in archive.namelist():
                    field = f": {name.removesuffix('.npy')} cannot be read"
                    with archive.open(name) as member:
                        arrays[name.removesuffix(".npy")] = np.lib.format.read_array(member, allow_pickle=False)
                        if member.read(1):  # which also compares the check sum of the archive
                            raise ValueError("the array is followed by something else")
            field = ""
            words = json.loads(str(arrays["words"]))
        except Exception as error:  # a damaged archive raises nearly anything
            raise ValueError(f"{ours} is none{field} ({type(error).__name__}: {error})") from error
    if not isinstance(words, dict) or words.get("format") != FORMAT:
        raise ValueError(f"{ours} holds something else")
    return arrays, words


def _solution(system: ConstrainedSystem, arrays: dict[str, Any], words: dict[str, Any]) -> DenseSolution:
    t, states = (np.ascontiguousarray(arrays[name]) for name in ("sol_t", "sol_states"))
    table = Table(t, states, arrays["sol_kinds"])
    start, row, rtol = float(t[0]), states[0], words["sol_rtol"]
    ranks = ranks_at(system, start, row[: system.n_q], row[system.n_q : 2 * system.n_q], rtol)
    if words["sol_ranks"] != list(ranks):
        raise ValueError(
            f"system must be the one that was solved: ranks of its constraints are {list(ranks)} at the start of the "
            f"run; sol_ranks in the file are {words['sol_ranks']}"
        )
    atol = arrays.get("atol", np.full(system.n_q, rtol))  # older files have none
    interpolator = Interpolator(system, start, row, rtol, atol, ranks)
    if "sol_interior_t" in arrays:
        interpolator.keep(arrays["sol_interior_t"], arrays["sol_interior_states"])
    return DenseSolution(interpolator, table, words["sol_end"])
