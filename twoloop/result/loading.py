"""Results out of files: NumPy's npz, without pickle."""

import json
import os
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from twoloop.problem.system import ConstrainedSystem, check_system
from twoloop.result.folder import read_folder
from twoloop.result.result import Result
from twoloop.result.saved_fields import OF_EVENTS, Fields
from twoloop.result.storage import ALWAYS, FORMAT, SOMETIMES, check_path
from twoloop.run.dense import Interpolator, Table, ranks_at
from twoloop.run.dense_solution import DenseSolution


def load(path: str | os.PathLike[str], system: ConstrainedSystem | None = None) -> Result:
    """Read a result that `Result.save` wrote, or that is in the folder `store` of `solve_dae`.

    Parameters
    ----------
    path : str or path
        The file, or the folder, of which is read what is used.
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
        If the file was not written by `Result.save` nor the folder by `solve_dae`, or it is damaged (says in which
        field), or holds a result of a system of other sizes.
    """
    if system is not None:
        check_system(system)
    path = check_path(path)
    arrays, words = read_folder(path) if path.is_dir() else _read(path)
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
        **{name: getattr(known, name) for name in ("status", "message", "rank", "method", "compiled", "changes")},
        stats=known.statistics,
        system=system,
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
