"""Reads results from files in NumPy's npz format, without pickle."""

import json
import os
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from twoloop.checks.arguments import check_path
from twoloop.problem.system import ConstrainedSystem, check_system
from twoloop.result.folder import read_folder
from twoloop.result.result import Result
from twoloop.result.saved_fields import OF_EVENTS, Fields
from twoloop.result.storage import ALWAYS, FORMAT, SOMETIMES
from twoloop.run.dense import Interpolator, Table, ranks_at
from twoloop.run.dense_solution import DenseSolution


def load(path: str | os.PathLike[str], system: ConstrainedSystem | None = None) -> Result:
    """Read a result written by `Result.save`, or stored in a folder by `solve_dae(..., store=folder)`.

    Parameters
    ----------
    path : str or path
        The file, or the folder, whose arrays are memory-mapped.
    system : ConstrainedSystem, optional
        The system that was solved, required by `result.sol`, `result.reactions`, `result.energy`, `result.plot` and
        `result.animate`. None: `result.sol` is None.

    Returns
    -------
    Result
        The result as saved.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    TypeError, ValueError
        If the file was not written by `Result.save`, or the folder not by `solve_dae`; if it is damaged (the message
        names the field); or if the system has other sizes.

    Examples
    --------
    >>> import tempfile
    >>> from pathlib import Path
    >>> from twoloop import load, solve_dae
    >>> from twoloop.mechanisms import four_bar
    >>> problem = four_bar()
    >>> result = solve_dae(problem.system, (0.0, 1.0), problem.q0, problem.v0)
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     result.save(Path(folder) / "run.npz")
    ...     loaded = load(Path(folder) / "run.npz")
    >>> bool((loaded.q == result.q).all())
    True
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
    """Return the arrays and other fields of a file; raise ValueError if it was not written by `Result.save`."""
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
                        if member.read(1):  # reading to the end verifies the checksum of the archive
                            raise ValueError("the array is followed by other data")
            field = ""
            words = json.loads(str(arrays["words"]))
        except Exception as error:  # a damaged archive may raise any exception
            raise ValueError(f"{ours} is none{field} ({type(error).__name__}: {error})") from error
    if not isinstance(words, dict) or words.get("format") != FORMAT:
        raise ValueError(f"{ours} has other contents")
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
    atol = arrays.get("atol", np.full(system.n_q, rtol))  # absent in older files
    interpolator = Interpolator(system, start, row, rtol, atol, ranks)
    if "sol_interior_t" in arrays:
        interpolator.keep(arrays["sol_interior_t"], arrays["sol_interior_states"])
    return DenseSolution(interpolator, table, words["sol_end"])
