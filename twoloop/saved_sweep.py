"""The rows of a sweep in a file of Parquet, from which an interrupted one goes on."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

from twoloop.optional import needed

KEY = "twoloop sweep"


def settings(work: tuple[Any, Any, dict[str, Any]]) -> str:
    """What the rows depend on beside their parameters, in words."""
    problem_of, measure, options = work
    words = [_name(problem_of), _name(measure), *(f"{name}={_name(options[name])}" for name in sorted(options))]
    return ", ".join(words)


def _name(value: Any) -> str:
    """A function by where it stands: its address differs from process to process."""
    if isinstance(value, (list, tuple)):
        return f"[{', '.join(map(_name, value))}]"
    name = getattr(value, "__qualname__", None)
    return repr(value) if name is None else f"{value.__module__}.{name}"


def write(table: Any, path: Path, made_with: str) -> None:
    """Write the rows, whole or not at all."""
    needed("pyarrow", "pyarrow", "out=")
    table.attrs[KEY] = made_with
    new = path.with_name(f".{path.name}.new")
    table.to_parquet(new, engine="pyarrow")
    os.replace(new, path)


def read(pandas: Any, path: Path, given: list[dict[str, Any]], made_with: str) -> dict[int, dict[str, Any]]:
    """The rows of a file by their numbers; none where there is no file.

    Raises
    ------
    ValueError
        If the file is not of this sweep: of other functions, options or parameters.
    """
    needed("pyarrow", "pyarrow", "out=")
    if not path.parent.is_dir():
        raise ValueError(f"out must be a file in a folder that exists; given {str(path)!r}")
    if not path.exists():
        return {}
    advice = "Give another file, or remove this one to begin anew"
    try:
        table = pandas.read_parquet(path, engine="pyarrow")
    except Exception as error:
        raise ValueError(f"out must be a file that a sweep wrote; {str(path)!r} cannot be read: {error}") from None
    kept = table.attrs.get(KEY)
    if kept is None:
        raise ValueError(f"out must be a file that a sweep wrote; {str(path)!r} holds something else. {advice}")
    if kept != made_with:
        raise ValueError(f"out, {str(path)!r}, holds runs of {kept}; this sweep is of {made_with}. {advice}")
    rows = {int(number): row for number, row in zip(table.index, table.to_dict("records"), strict=True)}
    for number, row in rows.items():
        if number >= len(given) or any(row.get(name) != value for name, value in given[number].items()):
            asked = given[number] if number < len(given) else "not asked for"
            of_file = {name: row.get(name) for name in given[0]}
            raise ValueError(f"out, {str(path)!r}, holds other runs: {number} has {of_file}, {asked}. {advice}")
    return rows
