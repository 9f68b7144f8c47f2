"""Saves the rows of a sweep to a Parquet file, from which an interrupted sweep resumes."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from twoloop.checks.optional import needed
from twoloop.sweeps.digests import described, digest_of, digest_of_package

KEY = "twoloop sweep"
DIGESTS = "twoloop sweep, digests"
TWOLOOP = "twoloop itself"


@dataclass(frozen=True)
class Settings:
    """Everything the rows depend on other than their parameters.

    Attributes
    ----------
    words : str
        Description for messages.
    digests : dict
        Digests of code and values, by name.
    """

    words: str
    digests: dict[str, str]


def settings(work: tuple[Any, Any, dict[str, Any]]) -> Settings:
    """Return everything on which the rows of a sweep depend.

    Raises ValueError if a value that a function refers to cannot be compared.
    """
    problem_of, measure, options = work
    words = [described(problem_of), described(measure)] + [described(options)] * bool(options)
    reached = {"problem_of": problem_of, "measure": measure, **options}
    digests = {what: digest_of(what, value) for what, value in reached.items()}
    return Settings(", ".join(words), digests | {TWOLOOP: digest_of_package()})


def write(table: Any, path: Path, made_with: Settings) -> None:
    """Write the rows atomically."""
    needed("pyarrow", "pyarrow", "out=")
    table.attrs |= {KEY: made_with.words, DIGESTS: made_with.digests}
    new = path.with_name(f".{path.name}.new")
    table.to_parquet(new, engine="pyarrow")
    os.replace(new, path)


def read(pandas: Any, path: Path, given: list[dict[str, Any]], made_with: Settings) -> dict[int, dict[str, Any]]:
    """Return the rows of a file by run number; empty if there is no file.

    Raises ValueError if the file belongs to a sweep with other functions, options or parameters.
    """
    needed("pyarrow", "pyarrow", "out=")
    if not path.parent.is_dir():
        raise ValueError(f"out must be a file in a folder that exists; given {str(path)!r}")
    if not path.exists():
        return {}
    advice = "Give another file, or remove this one to start over"
    try:
        table = pandas.read_parquet(path, engine="pyarrow")
    except Exception as error:
        raise ValueError(f"out must be a file that a sweep wrote; {str(path)!r} cannot be read: {error}") from None
    kept = table.attrs.get(KEY)
    if kept is None:
        raise ValueError(f"out must be a file that a sweep wrote; {str(path)!r} holds something else. {advice}")
    if kept != made_with.words:
        raise ValueError(f"out, {str(path)!r}, holds runs of {kept}; this sweep is of {made_with.words}. {advice}")
    digests = table.attrs.get(DIGESTS) or {}
    other = [what for what, digest in made_with.digests.items() if digests.get(what) != digest]
    if other:
        raise ValueError(
            f"out, {str(path)!r}, holds runs of functions or values that have changed: "
            f"{', '.join(other)} (its code, what it encloses, or a global that it uses). {advice}"
        )
    rows = {int(number): row for number, row in zip(table.index, table.to_dict("records"), strict=True)}
    for number, row in rows.items():
        if number >= len(given) or any(not same(row.get(name), value) for name, value in given[number].items()):
            asked = given[number] if number < len(given) else "not asked for"
            of_file = {name: row.get(name) for name in given[0]}
            raise ValueError(f"out, {str(path)!r}, holds other runs: {number} has {of_file}, {asked}. {advice}")
    return rows


def same(kept: Any, value: Any) -> bool:
    """Return True if a cell holds a value; NaN equals NaN here."""
    return bool(kept == value or (kept != kept and value != value))
