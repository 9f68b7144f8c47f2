"""Cells of the table that a sweep makes: what parameters and measures may be, a column of one kind each."""

from __future__ import annotations

import inspect
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from twoloop.checks.arguments import shown

Row = dict[str, Any]

OWN = ("status", "message", "seconds")  # columns of all rows
ERROR = "ERROR"  # status of a run that raised an exception
LARGEST_INTEGER = 2**63  # integers must be smaller to fit into a column


def failed(message: str, seconds: float = math.nan) -> Row:
    """The row of a run that raised an exception."""
    return {"status": ERROR, "message": message, "seconds": seconds}


def check_measured(measured: Any, known: set[str]) -> Row:
    """The columns that a measure returned; raises TypeError unless they are cells of columns that are not `known`."""
    if not isinstance(measured, Mapping):
        raise TypeError(f"measure must return a mapping of columns; it returned {shown(measured)}")
    row = {}
    for name, value in measured.items():
        if not isinstance(name, str):
            raise TypeError(f"measure must name its columns by strings; it returned {shown(name)}")
        if name in known:
            raise TypeError(f"measure must return columns that the row has not already; it returned {name!r}")
        plain = value.item() if isinstance(value, (np.generic, np.ndarray)) and np.ndim(value) == 0 else value
        if not (plain is None or kind_of(plain) or (isinstance(plain, float) and math.isnan(plain))):
            raise TypeError(
                f"measure must return numbers, strings, True and False or None, cells of a table; {name!r} is "
                f"{shown(value)} of type {type(value).__name__}"
            )
        row[name] = plain
    return row


def kind_of(value: Any) -> str | None:
    """Return the kind of column that a cell belongs to; None if it fits any (a missing number) or no column."""
    if isinstance(value, bool):
        return "True and False"
    if isinstance(value, float) or (isinstance(value, int) and -LARGEST_INTEGER <= value < LARGEST_INTEGER):
        return None if math.isnan(value) else "numbers"
    return "strings" if isinstance(value, str) else None


def fitting(row: Row, kinds: dict[str, str]) -> Row:
    """Return a row that fits the columns, whose kinds are extended; a Parquet column has one kind and valid text."""
    row = {k: value.encode(errors="replace").decode() if isinstance(value, str) else value for k, value in row.items()}
    for name, value in row.items():
        kind = kind_of(value)
        if kind is not None and kinds.setdefault(name, kind) != kind:
            message = (
                f"TypeError: measure must fill a column with one kind; {name!r} had {kinds[name]}, now {shown(value)}"
            )
            return failed(message, row["seconds"])
    return row


def check_parameters(problem_of: Any, parameters: Any) -> list[Row]:
    """The parameters of all runs as plain cells; raises TypeError or ValueError, naming the argument."""
    if not callable(problem_of):
        raise TypeError(f"problem_of must be a function that returns a Problem; given {shown(problem_of)}")
    if isinstance(parameters, (str, Mapping)) or not isinstance(parameters, Sequence):
        raise TypeError(
            f"parameters must be a list of mappings, one for each run, such as [{{'theta3': 0.1}}, {{'theta3': 0.2}}]; "
            f"given {shown(parameters)}"
        )
    if not parameters:
        raise ValueError("parameters must contain at least one run; given none")
    signature, made = inspect.signature(problem_of), []
    kinds: dict[str, str] = {}
    for number, each in enumerate(parameters):
        if not isinstance(each, Mapping):
            raise TypeError(f"parameters[{number}] must be a mapping of names to values; given {shown(each)}")
        if set(each) != set(parameters[0]):
            raise ValueError(
                f"parameters must all have the same names; [0] has {sorted(parameters[0])}, [{number}] {sorted(each)}"
            )
        taken = sorted(set(each) & {*OWN, "run"})
        if taken:
            raise ValueError(f"parameters must not have the name of a standard column; given {taken[0]!r}")
        plain = {name: value.item() if isinstance(value, np.generic) else value for name, value in each.items()}
        for name, value in plain.items():
            kind = kind_of(value)
            if kind is None and not (isinstance(value, float) and math.isnan(value)):
                raise TypeError(
                    f"parameters[{number}][{name!r}] must be a number, a string, True or False, a cell of a table; "
                    f"given {shown(value)}. Give the parts one by one, and let problem_of put them together"
                )
            if kind is not None and kinds.setdefault(name, kind) != kind:
                raise TypeError(
                    f"parameters must be of one kind under one name, as they fill a column of a table; {name!r} has "
                    f"{kinds[name]}, and {shown(value)} in [{number}]"
                )
        try:
            signature.bind(**each)
        except TypeError as error:
            raise TypeError(f"problem_of does not take parameters[{number}]: {error}") from None
        made.append(plain)
    return made
