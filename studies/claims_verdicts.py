"""What a claim of the paper is, and how its verdict comes from rows."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

import numpy as np
import pandas as pd

from studies.report import number
from studies.runs import time_for
from twoloop.mechanisms import four_bar

Rows = Mapping[str, pd.DataFrame]  # of the studies by name, and of this one by "claims"

DEFAULT = four_bar().name
LONG = 100.0  # s, the length of the paper's runs


class Verdict(StrEnum):
    """What the rows say of a claim."""

    HOLDS = "holds"
    CONDITIONS = "holds with conditions"
    FAILS = "does not hold"
    UNCHECKED = "cannot be checked"


class NoRows(Exception):
    """A claim has no rows to be judged by; the text says which, and why."""


@dataclass(frozen=True)
class Judgement:
    """What a judge found.

    Attributes
    ----------
    number : str
        The numbers that decide.
    verdict : Verdict
    why : str
        What they mean, and the condition where there is one.
    """

    number: str
    verdict: Verdict
    why: str


@dataclass(frozen=True)
class Claim:
    """A claim of the paper.

    Attributes
    ----------
    section : str
        Where the paper makes it.
    statement : str
        The claim in this project's words.
    runs : str
        What was run or computed.
    rows : dict
        Study: (what picks its rows, the columns that the judge reads).
    criterion : str
        From which numbers the verdict follows, and how.
    judge : callable
        judge(rows) applies the criterion; raises NoRows where there is nothing to judge by.
    assumed : bool
        Whether the answer depends on the geometry of the linkage, which is assumed.
    """

    section: str
    statement: str
    runs: str
    rows: dict[str, tuple[str, tuple[str, ...]]]
    criterion: str
    judge: Callable[[Rows], Judgement]
    assumed: bool = False

    def judgement(self, rows: Rows) -> Judgement:
        """The judge's, or that there is nothing to judge by."""
        try:
            return self.judge(rows)
        except NoRows as reason:
            return Judgement("–", Verdict.UNCHECKED, str(reason))


def grade(holds: bool, in_part: bool = False) -> Verdict:
    """The verdict of a criterion that is met, met in part, or not met."""
    if holds:
        return Verdict.HOLDS
    return Verdict.CONDITIONS if in_part else Verdict.FAILS


def not_run(why: str) -> Callable[[Rows], Judgement]:
    """The judge of a claim for which there are no rows in any study."""

    def judge(rows: Rows) -> Judgement:
        raise NoRows(why)

    return judge


def pick(rows: Rows, study: str, **equal: Any) -> pd.DataFrame:
    """The rows of a study in which each column named has that value (or one of a tuple of values)."""
    if study not in rows:
        raise NoRows(f"there is no {study}.csv")
    found = rows[study]
    for column, value in equal.items():
        found = found[found[column].isin(value if isinstance(value, tuple) else (value,))]
    if found.empty:
        settings = ", ".join(f"{column} = {value}" for column, value in equal.items())
        raise NoRows(f"{study}.csv has no row with {settings} at this scale")
    return found


def one(rows: Rows, study: str, **equal: Any) -> pd.Series:
    """The first of them."""
    return pick(rows, study, **equal).iloc[0]


def value(rows: Rows, check: str, case: str, problem: str | None = DEFAULT, **equal: Any) -> float:
    """A number of claims.csv; with problem=None the only one of its name."""
    if problem is not None:
        equal["problem"] = problem
    return float(one(rows, "claims", check=check, case=case, **equal)["value"])


def long_enough(runs: pd.DataFrame, least: float = LONG) -> pd.DataFrame:
    """The runs as they are, if they are as long as the claim asks for."""
    t_end = float(runs["t_end"].max())
    if t_end < least:
        raise NoRows(f"quick run: it covers {t_end:g} s, and the claim is about {least:g} s")
    return runs


def cost(runs: pd.DataFrame, target: float, what: str) -> float:
    """Cost `what` of these runs for an error of at most `target`; NaN where it lies outside the errors they reach."""
    errors = runs["error_q"].dropna()
    if errors.empty or not errors.min() <= target <= errors.max():
        return float("nan")
    return time_for(runs, target, what)


def cell(rows: Rows, group: str, err_in: float, err_out: float, problem: str = DEFAULT) -> pd.Series:
    """A cell of Table 3."""
    return one(rows, "table3", group=group, problem=problem, err_in=err_in, err_out=err_out)


def span(values: Any) -> str:
    """Least and largest of some numbers, in few digits."""
    array = np.asarray(list(values), dtype=float)
    low, high = number(array.min()), number(array.max())
    return low if low == high else f"{low} to {high}"
