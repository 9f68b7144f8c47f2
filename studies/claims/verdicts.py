"""What a claim is, and how its verdict comes from the rows of the other studies.

All that depends on how another study writes its rows stands here.
"""

import tomllib
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from enum import StrEnum
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from studies.bench import tables
from studies.bench.render import number
from studies.bench.store import Array, read_rows
from studies.reproduction.beam import SOFT, STIFF
from twoloop.mechanisms import four_bar

STUDIES = ("table3_full", "energy", "motion", "step_size", "violation", "beam", "ablation")
DEFAULT = four_bar().name
LONG = 100.0  # s, the length of the paper's runs
BEAM_END = 2.0  # s, of a full run of the beams
BEAMS = (SOFT, STIFF)


class NotRun(Exception):
    """Raised where there is no row to judge by; the text says which."""


def read(folder: Path) -> dict[str, pd.DataFrame]:
    """Read one row a run of every study that has rows in the folder. Raises StudyError if a file is damaged."""
    paths = [path for name in STUDIES if (path := folder / f"{name}.csv").is_file()]
    return {path.stem: _one_a_run(path.stem, read_rows(path)[0]) for path in paths}


def _one_a_run(name: str, table: pd.DataFrame) -> pd.DataFrame:
    if name == "beam" and "error_tip" in table:  # the error by which the beams are judged
        table["error_q"] = table["error_tip"]
    if {"repeat", "error_q", "call_s"} <= set(table):
        repeated = table[table["repeat"].notna()]
        table = pd.concat([tables.medians(repeated), table[table["repeat"].isna()]], ignore_index=True)
    for column in {"lost", "astray"} & set(table):  # no value: the run gave no result
        table[column] = table[column].map(lambda x: str(x) not in ("False", "0", "0.0"))
    return table.assign(floor=table["floor"].fillna(0.0) if "floor" in table else 0.0)


@dataclass(frozen=True)
class Rows:
    """Hold what judges read: one row a run of each study, and the numbers of `experiments.py`."""

    tables: Mapping[str, pd.DataFrame]
    experiments: Mapping[str, float]

    def number(self, key: str) -> float:
        """Return a number of `experiments.py`."""
        if self.experiments.get(key) is None:
            raise NotRun(f"the experiment {key} was not made")
        return float(self.experiments[key])

    def pick(self, study: str, least: float = 0.0, named: str = "", **equal: Any) -> pd.DataFrame:
        """Select the rows in which each column named has that value, or one of a tuple of values.

        Of solvers whose name contains `named`; not run if none covers `least` seconds.
        """
        if study not in self.tables:
            raise NotRun(f"there is no {study}.csv")
        found = self.tables[study]
        found = found[found["solver"].astype(str).str.contains(named, regex=False)]
        found = tables.where(found, **equal)
        if found.empty:
            raise NotRun(f"{study}.csv has no row of {named} with {', '.join(f'{c} = {v}' for c, v in equal.items())}")
        if least and not found["t_end"].max() >= least:
            raise NotRun(f"quick rows: they cover {found['t_end'].max():g} s, and the claim is about {least:g} s")
        return found

    def long(self, study: str, named: str = "", **equal: Any) -> pd.DataFrame:
        """Select rows of runs as long as the paper's."""
        return self.pick(study, LONG, named, **equal)

    def cell(self, group: str, err_in: float, err_out: float, problem: str = DEFAULT) -> pd.Series:
        """Return a cell of Table 3."""
        return self.long("table3_full", group=group, problem=problem, err_in=err_in, err_out=err_out).iloc[0]

    def beam(self, case: str, named: str, **equal: Any) -> pd.DataFrame:
        """Select full runs of a beam."""
        return self.pick("beam", BEAM_END, named, case=case, group="run", **equal)


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
