"""A result as a table of pandas."""

from __future__ import annotations

from typing import Any

from twoloop.checks.optional import needed
from twoloop.problem.description import name_and_unit
from twoloop.run.record import Record


def to_dataframe(result: Record) -> Any:
    """Return a table with one row per stored time, see `Result.to_dataframe`."""
    pandas = needed("pandas", "pandas", "to_dataframe")
    known = result.coordinates
    columns = dict(zip(known, result.q, strict=True))
    for what, values, per in (("velocity", result.v, "s"), ("acceleration", result.a, "s^2")):
        columns |= {_derivative(name, what, per): row for name, row in zip(known, values, strict=True)}
    columns |= {f"lam{k}": row for k, row in enumerate(result.lam)}
    if result.description.energy is not None:
        columns["energy (J)"] = result.energy
    return pandas.DataFrame(columns, index=pandas.Index(result.t, name="t (s)"))


def _derivative(coordinate: str, what: str, per: str) -> str:
    """Return the name of a derivative with its unit, e.g. "x of crank, velocity (m/s)" for "x of crank (m)"."""
    name, unit = name_and_unit(coordinate)
    return f"{name}, {what} ({unit or 1}/{per})"
