"""What a claim is, and how its verdict comes from rows."""

import tomllib
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from enum import StrEnum
from pathlib import Path
from typing import Any

import numpy as np

from studies.claims.rows import NotRun, Rows
from studies.render import number

FILE = Path(__file__).with_name("claims.toml")


class Verdict(StrEnum):
    """What the rows say of a claim."""

    HOLDS = "holds"
    PART = "holds in part"
    FAILS = "does not hold"
    CONSISTENT = "consistent"
    CIRCULAR = "holds by construction"
    UNCHECKED = "cannot be checked"
    NOT_RUN = "not run"


@dataclass(frozen=True)
class Judgement:
    """What a judge found.

    Attributes
    ----------
    verdict : Verdict
    values : dict
        The numbers that decide, the first of them most; a list holds a least and a largest.
    why : str
        Of a claim that is not judged.
    """

    verdict: Verdict
    values: Mapping[str, Any] = field(default_factory=dict)
    why: str = ""


Judge = Callable[..., Judgement]  # judge(rows, **options)


def grade(holds: Any, in_part: Any = False) -> Verdict:
    """The verdict of a criterion that is met, met in some of the cases of which the claim speaks, or not met."""
    if bool(holds):
        return Verdict.HOLDS
    return Verdict.PART if bool(in_part) else Verdict.FAILS


def span(values: Iterable[Any]) -> list[float]:
    """Least and largest."""
    array = np.asarray(list(values), dtype=float)
    return [float(array.min()), float(array.max())]


@dataclass(frozen=True)
class Claim:
    """A claim of the paper, as `claims.toml` has it; that file says what its keys mean."""

    key: str
    section: str
    statement: str
    criterion: str
    fixed: str
    judge: str
    number: str
    options: Mapping[str, Any] = field(default_factory=dict)
    circular: str = ""
    stand_in: str = ""
    assumed: bool = False

    def judgement(self, judges: Mapping[str, Judge], rows: Rows) -> Judgement:
        """What the claim's judge makes of the rows; not run where there is nothing to judge by."""
        try:
            found = judges[self.judge](rows, **self.options)
        except NotRun as reason:
            return Judgement(Verdict.NOT_RUN, why=str(reason))
        except KeyError as column:
            return Judgement(Verdict.NOT_RUN, why=f"the rows lack {column}")
        numbers = [x for value in found.values.values() for x in (value if isinstance(value, list) else [value])]
        if not np.isfinite(np.asarray(numbers, dtype=float)).all():
            return Judgement(Verdict.NOT_RUN, why="the rows lack a value that decides")
        if found.verdict is Verdict.HOLDS and self.circular:
            return replace(found, verdict=Verdict.CIRCULAR)
        if found.verdict in (Verdict.HOLDS, Verdict.PART) and self.stand_in:
            return replace(found, verdict=Verdict.CONSISTENT)
        return found

    def text(self, found: Judgement) -> str:
        """The numbers of a judgement in the words of `claims.toml`."""
        if not found.values:
            return "–"
        return self.number.format(**{name: _text(value) for name, value in found.values.items()})


def _text(value: Any) -> str:
    if not isinstance(value, list):
        return number(value)
    low, high = (number(x) for x in value)
    return low if low == high else f"{low} to {high}"


def load(path: Path = FILE) -> list[Claim]:
    """The claims in the order of the paper."""
    return [Claim(key, **entry) for key, entry in tomllib.loads(path.read_text()).items()]
