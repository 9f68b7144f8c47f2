"""What a claim is, and how its verdict comes from rows."""

import tomllib
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from enum import StrEnum
from pathlib import Path
from typing import Any

import numpy as np

from studies.bench.render import number
from studies.bench.store import Array
from studies.claims.rows import NotRun, Rows

FILE = Path(__file__).with_name("claims.toml")


class Verdict(StrEnum):
    """What the rows say of a claim."""

    HOLDS = "holds"
    PART = "holds in part"
    FAILS = "does not hold"
    CONSISTENT = "consistent"
    ASSUMED = "not reproduced (inputs assumed)"
    CIRCULAR = "holds by construction"
    NOT_RUN = "not run"


UNTESTABLE = (Verdict.CONSISTENT, Verdict.ASSUMED, Verdict.CIRCULAR)  # our runs cannot decide, whatever they give


@dataclass(frozen=True)
class Judgement:
    """Hold a verdict, the numbers that decide (a list: least and largest), and why a claim was not judged."""

    verdict: Verdict
    values: Mapping[str, Any] = field(default_factory=dict)
    why: str = ""


def decide(met: Iterable[Any], in_part: Any = None, **values: Any) -> Judgement:
    """Decide by conditions: all met, or some of the cases of which the claim speaks, or none."""
    conditions = [bool(condition) for condition in met]
    if all(conditions):
        return Judgement(Verdict.HOLDS, values)
    part = any(conditions) if in_part is None else in_part
    return Judgement(Verdict.PART if part else Verdict.FAILS, values)


def span(values: Iterable[Any]) -> list[float]:
    """Return the least and the largest; NaN where a value is."""
    array = np.asarray(list(values), dtype=float)
    return [float(array.min()), float(array.max())]


def span_known(ratios: Array) -> list[float]:
    """Return the least and the largest of the known values."""
    if not (known := ratios[np.isfinite(ratios)]).size:
        raise NotRun("no error that both sides reach")
    return span(known)


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
    inputs: str = ""
    assumed: bool = False

    def judgement(self, judge: Callable[..., Judgement], rows: Rows) -> Judgement:
        """Judge the claim from the rows; "not run" where there is nothing to judge by."""
        try:
            found = judge(rows, **self.options)
        except NotRun as reason:
            return Judgement(Verdict.NOT_RUN, why=str(reason))
        except KeyError as column:
            return Judgement(Verdict.NOT_RUN, why=f"the rows lack {column}")
        if not np.isfinite(np.hstack(list(found.values.values()))).all():
            return Judgement(Verdict.NOT_RUN, why="the rows lack a value that decides")
        holds = Verdict.CONSISTENT if self.stand_in or self.inputs else Verdict.HOLDS
        marked = {Verdict.HOLDS: Verdict.CIRCULAR if self.circular else holds}
        marked[Verdict.FAILS] = Verdict.ASSUMED if self.inputs else Verdict.FAILS
        return replace(found, verdict=marked.get(found.verdict, found.verdict))

    def text(self, found: Judgement) -> str:
        """Tell the numbers of a judgement in the words of `claims.toml`."""
        if found.verdict is Verdict.NOT_RUN:
            return found.why
        values = {name: value if isinstance(value, list) else [value] for name, value in found.values.items()}
        texts = {name: " to ".join(dict.fromkeys(map(number, value))) for name, value in values.items()}
        return self.number.format(**texts)


def load() -> list[Claim]:
    """Load the claims in the order of the paper."""
    return [Claim(key, **entry) for key, entry in tomllib.loads(FILE.read_text()).items()]
